# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The package's sources, and which of its modules each imports, for types alone too."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DEMO = {"pkm_twin.demo.run", "pkm_twin.demo.tracking"}
REGISTRIES = {"pkm_twin.apps.nodes"} | DEMO
"""Modules that name nodes, which become processes."""
PACKAGES = ("pkm_twin", "delta_dynamics", "stiffness_monitor")


@cache
def sources() -> dict[str, Path]:
    """Every module by its dotted name."""
    paths = (path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py")))
    return {_module(path): path for path in paths}


def _module(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def nodes(module: str) -> tuple[ast.AST, ...]:
    """All of a module's syntax."""
    return tuple(ast.walk(ast.parse(sources()[module].read_text(encoding="utf-8"))))


@cache
def imports(module: str) -> frozenset[str]:
    """What a module imports, wherever in it: modules, also where a name of one is imported.

    A text that names a module of another room, as ``import_module`` takes it, counts as well.
    """
    found = set()
    for node in nodes(module):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{module}: a relative import"
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if name in sources() else node.module for name in whole}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            name = node.value.partition(":")[0]
            named = "." in name and name in sources() and room(name) != room(module)
            if named and module not in REGISTRIES:
                found.add(name)
    return frozenset(found)


def within(module: str, package: str) -> bool:
    """Whether a module is a package or in it."""
    return module == package or module.startswith(package + ".")


def room(module: str) -> str:
    """The folder that a module belongs to; nodes apart from theirs, as pkm_twin's own modules."""
    first, *rest = module.split(".")
    if first != "pkm_twin":
        return f"{first}.node" if rest and re.search("nodes?$", rest[0]) else first
    if not rest or not (ROOT / first / rest[0]).is_dir():
        return module
    folder = f"{first}.{rest[0]}"
    # The base class of nodes is in ros.
    return f"{folder}.node" if rest[1:] == ["node"] and rest[0] != "ros" else folder


@cache
def arrows() -> frozenset[tuple[str, str]]:
    """Pairs of rooms: who imports, and what."""
    return frozenset(
        (room(module), room(name))
        for module in sources()
        for name in imports(module)
        if name in sources() and room(name) != room(module)
    )
