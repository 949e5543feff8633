# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What identifies a program: what it is made of, and the sources of those who write it."""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Final
from uuid import uuid4

from pkm_twin.codegen.cache import digest

Module = tuple[str, str]
"""Dotted name and file."""
_IMPORT: Final = re.compile(rb"import[ \t]+(\([^)]*\)|.*)")
_NAME: Final = re.compile(r"[\w.]+")
_PACKAGE: Final = f"{os.sep}__init__.py"
_COMPILER: Final = "pkm_twin.codegen.code"


@dataclass(frozen=True)
class ProgramKey:
    """A program's identity; keys that are equal are of one program.

    ``text``: all of a program's content that its writers are given. ``writers``: modules whose
    functions and classes write it.
    """

    text: str = ""
    writers: frozenset[str] = frozenset()

    def also(self, text: str, *writers: Callable[..., Any]) -> ProgramKey:
        """The key of what is made of this, of further content and by further writers."""
        modules = (module for writer in writers for module in _modules(writer))
        return ProgramKey(f"{self.text} {text}", self.writers.union(modules))

    @property
    def sources(self) -> frozenset[str]:
        """Files of the writers, of codegen, and of all that these import of their packages."""
        return _sources(self.writers)

    def digest(self, *more: str) -> str:
        """Name of the program that is stored; changes with its content and with any source."""
        writers = [name if _file(name) else f"{name} {_UNSAVED}" for name in sorted(self.writers)]
        return digest(self.text, *writers, *sorted(_read(file)[0] for file in self.sources), *more)


EMPTY: Final = ProgramKey()
_UNSAVED: Final = uuid4().hex
"""Of writers without a file: another text in every process."""


def _modules(writer: Callable[..., Any]) -> Iterator[str]:
    if isinstance(writer, partial):
        for part in (writer.func, *writer.args):
            if callable(part):
                yield from _modules(part)
    else:
        yield writer.__module__


def _file(module: str) -> str:
    """The source of a loaded module; empty where there is none."""
    name = getattr(sys.modules.get(module), "__file__", None) or ""
    return name if name.endswith(".py") else ""


@cache
def _sources(writers: frozenset[str]) -> frozenset[str]:
    todo: list[Module] = [(name, _file(name)) for name in {*writers, _COMPILER} if _file(name)]
    found = set(todo)
    while todo:
        new = _imports(*todo.pop()) - found
        found |= new
        todo += new
    return frozenset(file for _, file in found)


@cache
def _imports(module: str, file: str) -> frozenset[Module]:
    """What a file imports of its own package and of this one.

    Read from the text, so an import inside a function counts, and one for types too.
    """
    homes = dict((_home(_COMPILER, _file(_COMPILER)), _home(module, file)))
    found = set()
    for package, names in _read(file)[1]:
        for name in [package] if package else names:
            home = homes.get(name.partition(".")[0])
            if home is None:
                continue
            place = _place(home, name)
            found.add((name, place))
            if place.endswith(_PACKAGE):
                found |= {(f"{name}.{part}", _place(home, f"{name}.{part}")) for part in names}
    return frozenset(one for one in found if one[1])


def _home(module: str, file: str) -> tuple[str, str]:
    """The package that a module is in, and the folder of that."""
    depth = module.count(".") + 1 + file.endswith(_PACKAGE)
    return module.partition(".")[0], file.rsplit(os.sep, depth)[0]


@cache
def _place(folder: str, module: str) -> str:
    """The file of a module below a folder; empty where there is none."""
    base = os.path.join(folder, *module.split("."))
    return next((file for file in (f"{base}.py", base + _PACKAGE) if os.path.isfile(file)), "")


@cache
def _read(file: str) -> tuple[str, list[tuple[str, list[str]]]]:
    """Digest of a file's content, and its imports: modules, and the names taken from them."""
    with open(file, "rb") as opened:
        data = opened.read()
    found = []
    for match in _IMPORT.finditer(data):
        # What stands before it in its line: nothing, or the module.
        before = data[data.rfind(b"\n", 0, match.start()) + 1 : match.start()].split()
        if not before or (len(before) == 2 and before[0] == b"from"):
            module = before[1].decode() if before else ""
            found.append((module, _NAME.findall(match[1].decode())))
    return hashlib.sha256(data).hexdigest(), found
