# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Identify a program by its content and by the source files of the functions that write it."""

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
"""Dotted name and path of a module."""
_IMPORT: Final = re.compile(rb"import[ \t]+(\([^)]*\)|.*)")
_NAME: Final = re.compile(r"[\w.]+")
_PACKAGE: Final = f"{os.sep}__init__.py"
_COMPILER_MODULE: Final = "pkm_twin.codegen.code"
"""Module whose source, with the sources that it imports, is part of every key."""


@dataclass(frozen=True)
class ProgramKey:
    """The identity of a program: equal keys stand for the same program.

    ``text``: everything that the writing functions are given. ``writers``: the modules of these
    functions and classes.
    """

    text: str = ""
    writers: frozenset[str] = frozenset()

    def extend(self, text: str, *writers: Callable[..., Any]) -> ProgramKey:
        """Return the key of a program made from this one with further content and writers."""
        modules = (module for writer in writers for module in _writer_modules(writer))
        return ProgramKey(f"{self.text} {text}", self.writers.union(modules))

    @property
    def sources(self) -> frozenset[str]:
        """Source files of the writers and of codegen, and of all modules that these import."""
        return _find_sources(self.writers)

    def digest(self, *more: str) -> str:
        """Return the cache name of the program; it changes with the content and any source file."""
        writers = [name if _source_file(name) else f"{name} {_UNSAVED}" for name in sorted(self.writers)]
        return digest(self.text, *writers, *sorted(_read_source(file)[0] for file in self.sources), *more)


EMPTY: Final = ProgramKey()
_UNSAVED: Final = uuid4().hex
"""A text that differs in every process: stands for the source of writers without a file."""


def _writer_modules(writer: Callable[..., Any]) -> Iterator[str]:
    if isinstance(writer, partial):
        for part in (writer.func, *writer.args):
            if callable(part):
                yield from _writer_modules(part)
    else:
        yield writer.__module__


def _source_file(module: str) -> str:
    """Return the source file of a loaded module; empty if it has none."""
    name = getattr(sys.modules.get(module), "__file__", None) or ""
    return name if name.endswith(".py") else ""


@cache
def _find_sources(writers: frozenset[str]) -> frozenset[str]:
    todo: list[Module] = [(name, _source_file(name)) for name in {*writers, _COMPILER_MODULE} if _source_file(name)]
    found = set(todo)
    while todo:
        new = _find_imports(*todo.pop()) - found
        found |= new
        todo += new
    return frozenset(file for _, file in found)


@cache
def _find_imports(module: str, file: str) -> frozenset[Module]:
    """Find the modules of its own package and of pkm_twin that a file imports.

    The text is searched, so imports inside functions and imports for type checking count, too.
    """
    homes = dict((_package_root(_COMPILER_MODULE, _source_file(_COMPILER_MODULE)), _package_root(module, file)))
    found = set()
    for package, names in _read_source(file)[1]:
        for name in [package] if package else names:
            home = homes.get(name.partition(".")[0])
            if home is None:
                continue
            place = _module_file(home, name)
            found.add((name, place))
            if place.endswith(_PACKAGE):
                found |= {(f"{name}.{part}", _module_file(home, f"{name}.{part}")) for part in names}
    return frozenset(one for one in found if one[1])


def _package_root(module: str, file: str) -> tuple[str, str]:
    """Return the top-level package of a module and the folder that contains the package."""
    depth = module.count(".") + 1 + file.endswith(_PACKAGE)
    return module.partition(".")[0], file.rsplit(os.sep, depth)[0]


@cache
def _module_file(folder: str, module: str) -> str:
    """Find the file of a module below a folder; empty if there is none."""
    base = os.path.join(folder, *module.split("."))
    return next((file for file in (f"{base}.py", base + _PACKAGE) if os.path.isfile(file)), "")


@cache
def _read_source(file: str) -> tuple[str, list[tuple[str, list[str]]]]:
    """Read a file's digest and its imports: each module with the names imported from it."""
    with open(file, "rb") as opened:
        data = opened.read()
    found = []
    for match in _IMPORT.finditer(data):
        # The line before "import": empty, or "from MODULE".
        before = data[data.rfind(b"\n", 0, match.start()) + 1 : match.start()].split()
        if not before or (len(before) == 2 and before[0] == b"from"):
            module = before[1].decode() if before else ""
            found.append((module, _NAME.findall(match[1].decode())))
    return hashlib.sha256(data).hexdigest(), found
