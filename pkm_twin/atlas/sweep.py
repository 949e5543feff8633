# SPDX-License-Identifier: Apache-2.0
"""What a kind of atlas is: a grid, the fields on it, and how one chunk of it is computed."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

import pkm_twin
from pkm_twin.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

POSITIVE: Final = {"valid_min": 0.0}
SHARE: Final = {"units": "1", "valid_min": 0.0, "valid_max": 1.0}
FLAG: Final = {"valid_min": 0, "valid_max": 1}
NONE: Final[Mapping[str, Any]] = MappingProxyType({})
"""Attributes by what a variable can be (CF conventions, 2.5.1): checked when a file is opened."""

Array = NDArray[np.float64]
Values = dict[str, NDArray[Any]]


def about(what: str, units: str = "", bounds: Mapping[str, Any] = NONE) -> dict[str, Any]:
    """Attributes of a variable: what it can be, its unit where it has one, and what it is."""
    return {**bounds, **({"units": units} if units else {}), "long_name": what}


@dataclass(frozen=True, eq=False)
class Variable:
    """A small array with named dimensions, held whole: coordinates and summaries."""

    dims: tuple[str, ...]
    values: NDArray[Any]
    attrs: Mapping[str, Any]


def axis(name: str, values: Any, what: str, units: str = "") -> Variable:
    """The coordinate of a dimension of its name."""
    return Variable((name,), np.asarray(values), about(what, units))


def number(value: Any, what: str, units: str = "", bounds: Mapping[str, Any] = NONE) -> Variable:
    """A single number."""
    return Variable((), np.array(value), about(what, units, bounds))


@dataclass(frozen=True)
class Field:
    """A large array that is computed chunk by chunk; its first two dimensions are the grid's."""

    dims: tuple[str, ...]
    attrs: Mapping[str, Any]
    dtype: str = "f8"


@dataclass(frozen=True)
class Chunk:
    """Rows ``start`` to ``stop`` of the grid's second axis at one index of the first."""

    first: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Sweep:
    """One atlas to be computed. Frozen and small: workers get it whole with every chunk.

    Subclasses name the fields, give the coordinates, and compute a chunk. What a chunk holds
    depends on the sweep alone, never on who computes it or beside what.
    """

    robot: Robot

    kind: ClassVar[str]
    fields: ClassVar[Mapping[str, Field]]

    @property
    def coordinates(self) -> dict[str, Variable]:
        """Coordinates of the dimensions, by name; a dimension's own coordinate has its name."""
        raise NotImplementedError

    @property
    def settings(self) -> dict[str, Any]:
        """What made this atlas besides the robot, for the file and for resuming; plain values."""
        raise NotImplementedError

    @property
    def rows_a_chunk(self) -> int:
        """Rows of the grid's second axis in one chunk."""
        raise NotImplementedError

    def evaluate(self, chunk: Chunk) -> Values:
        """Fields of a chunk, shape (rows, ...); other names are partial results for summaries."""
        raise NotImplementedError

    def summaries(self, partial: Iterable[Values]) -> dict[str, Variable]:
        """Results over the whole grid from the chunks' partial results, in the chunks' order."""
        for _ in partial:
            pass
        return {}

    @property
    def sizes(self) -> dict[str, int]:
        """Length of every dimension."""
        return {
            dim: length
            for variable in self.coordinates.values()
            for dim, length in zip(variable.dims, variable.values.shape, strict=True)
        }

    @property
    def points(self) -> int:
        """Samples to compute; the unit of progress."""
        return sum(self.count(chunk) for chunk in self.chunks())

    def count(self, chunk: Chunk) -> int:
        """Samples of one chunk."""
        raise NotImplementedError

    @property
    def grid(self) -> tuple[str, str]:
        """The two dimensions that every field begins with."""
        first, second = next(iter(self.fields.values())).dims[:2]
        return first, second

    def chunks(self) -> list[Chunk]:
        """All chunks, in the order of the file."""
        outer, inner = (self.sizes[dim] for dim in self.grid)
        rows = self.rows_a_chunk
        return [
            Chunk(i, start, min(start + rows, inner))
            for i in range(outer)
            for start in range(0, inner, rows)
        ]

    @property
    def attributes(self) -> dict[str, str]:
        """Global attributes of the file: everything that made it."""
        grid = self.robot.grid()
        return {
            "title": f"{self.kind} map of {self.robot.name}",
            "Conventions": "CF-1.10",
            "kind": self.kind,
            "robot": self.robot.name,
            "mechanism": self.robot.mechanism,
            "pose": " ".join(self.robot.pose_names),
            "layout": grid.kind,
            "height": grid.height,
            "lateral": " ".join(grid.lateral),
            "zero_torsion": "yes" if grid.zero_torsion else "no",
            "robot_parameters": json.dumps(self.robot.parameter_sections(), sort_keys=True),
            "settings": json.dumps(self.settings, sort_keys=True),
            "pkm_twin_version": pkm_twin.__version__,
        }

    @property
    def fingerprint(self) -> str:
        """Equal for two sweeps exactly if their results are."""
        digest = hashlib.sha256(json.dumps(self.attributes, sort_keys=True).encode())
        digest.update(self.robot.graph.key.encode())
        digest.update(self.robot.own_inertial.tobytes())
        digest.update(str(self.rows_a_chunk).encode())
        for name, variable in self.coordinates.items():
            digest.update(name.encode() + np.ascontiguousarray(variable.values).tobytes())
        return digest.hexdigest()


@dataclass(frozen=True)
class Kind:
    """What is drawn of a stored atlas of one kind; each package of a kind has its own.

    ``figures``: name to the function that draws it; ``page``: the plotly figure; ``title``: of
    the page; ``help``: the line below it.
    """

    name: str
    figures: Mapping[str, Callable[[Dataset], Figure]]
    page: Callable[[Dataset], Any]
    title: Callable[[Dataset], str]
    help: str


def plain(value: Any) -> Any:
    """Parameters as plain lists and numbers; what is infinite is the text ``inf``."""
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return value
