# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Look up commands, map kinds and exports of this package and, by entry points, of other packages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from pkm_twin.errors import PkmTwinError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")


class Extensible(Mapping[str, T], Generic[T]):
    """Objects by name, loaded on demand: the package's own, then entry points.

    Entry points are read only for a name that is not the package's own, or to list all names: this
    opens a file of every installed package. An entry point cannot replace one of the package's own.
    """

    def __init__(
        self,
        group: str,
        kind: type[Any],
        own: Iterable[str],
        load: Callable[[str], Any],
        convert: Callable[[Any], Any] = lambda found: found,
    ) -> None:
        """Set the functions that load objects.

        ``load``: returns the object of a name of ``own``. ``kind``: type of the entry points of
        ``group``; ``convert``: makes the object from an entry point.
        """
        self.group, self.kind, self._own = group, kind, dict.fromkeys(own)
        self._load, self._convert = load, convert
        self._loaded: dict[str, T] = {}

    @cached_property
    def points(self) -> dict[str, EntryPoint]:
        """The entry points of other packages."""
        from importlib.metadata import entry_points

        return {one.name: one for one in entry_points(group=self.group) if one.name not in self._own}

    def __getitem__(self, name: str) -> T:
        """Load the object of a name.

        :raises PkmTwinError: an entry point cannot be loaded, or names something else.
        """
        if name not in self._loaded:
            own = name in self._own
            self._loaded[name] = self._load(name) if own else self._load_entry_point(self.points[name])
        return self._loaded[name]

    def _load_entry_point(self, point: EntryPoint) -> Any:
        try:
            found = point.load()
        except Exception as error:
            fault = f"{type(error).__name__}: {error}"
        else:
            if isinstance(found, self.kind) or (isinstance(found, type) and issubclass(found, self.kind)):
                return self._convert(found)
            fault = f"is a {type(found).__name__}"
        what = f"entry point {self.group}: {point.name} = {point.value}"
        expected = f"{self.kind.__module__}.{self.kind.__name__}"
        raise PkmTwinError(f"{what}: {fault}; expected a {expected}") from None

    def __contains__(self, name: object) -> bool:
        return name in self._own or name in self.points

    def __iter__(self) -> Iterator[str]:
        yield from self._own
        yield from self.points

    def __len__(self) -> int:
        return len(self._own) + len(self.points)
