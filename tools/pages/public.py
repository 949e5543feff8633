# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write the public names: ``python -m tools.pages.public docs/public_names.txt``.

Python names, the command line and exported C come from the code. Names of nodes, launch files and
robot files come from their pages, which other tests compare with the code.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import delta_dynamics
import pkm_twin
import stiffness_monitor
from pkm_twin import design, errors, paths
from pkm_twin.apps.cli import app
from tools.pages.commands import leaves

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    "nodes": ("node", r"^All nodes|^[a-z]+_[a-z_]+$"),
    "launch": ("launch", r"\.launch\.py$"),
    "parameters": ("file", ""),
}
"""Pages with public names: prefix of a line of the file, and pattern of the headings above names."""
ENTRY = re.compile(r"^\* (?:(?:in|out|service) |\*\*)?`([^`]+)`", re.MULTILINE)


def groups() -> Iterator[tuple[str, list[str]]]:
    """Return the public names by group."""
    for module in (pkm_twin, delta_dynamics, stiffness_monitor, paths, design):
        yield f"python {module.__name__}", module.__all__
        for name in module.__all__:
            kind = getattr(module, name)
            # What else a robot has is the package's own.
            if isinstance(kind, type) and kind is not pkm_twin.Robot:
                fields = {*dir(kind), *getattr(kind, "__dataclass_fields__", ())}
                yield f"python {name}", [f for f in fields if f[0] != "_"]
    members = re.search(r"members: \[(inverse, .*?)\]", page("api"), re.DOTALL)
    assert members is not None
    yield "python Robot", re.split(r",\s+", members[1])
    kinds = [name for name, value in vars(errors).items() if isinstance(value, type)]
    yield "python pkm_twin.errors", [name for name in kinds if name.endswith("Error")]
    for name, command in app.commands.items():
        for words, leaf in leaves(name, command).items():
            options = [one for p in leaf.params for one in [*p.opts, *p.secondary_opts]]
            yield f"command {words}", [one for one in options if one.startswith("-")]
    source = (ROOT / "pkm_twin/export/c_package.py").read_text(encoding="utf-8")
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    static = {arg for call in calls if ast.unparse(call.func) == "self.hidden.append" for arg in call.args}
    named = [c.args[0] for c in calls if ast.unparse(c.func) in ("add_routine", "Routine") and c not in static]
    functions = [n.value for n in named if isinstance(n, ast.Constant) and n.value != "terms"]
    yield "exported C pkm_ROBOT_", ["parameters", *functions]
    above = ""
    for name, (kind, wanted) in PAGES.items():
        for part in re.split(r"^(?:#+ |\*\*(?=`))", page(name), flags=re.MULTILINE)[1:]:
            heading = part.splitlines()[0].replace("`", "").removesuffix("**")
            above = heading if ": " in heading else above
            heading = f"{above} {heading}" if f"### `{heading}`" in page(name) else heading
            if re.search(wanted, heading):
                yield f"{kind} {heading}", ENTRY.findall(part)


def page(name: str) -> str:
    """Read a page."""
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def names() -> str:
    """Write the file: a line per group, without empty groups."""
    lines = (f"{group}: {' '.join(sorted(set(those)))}\n" for group, those in groups() if those)
    return "".join(lines)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(names(), encoding="utf-8")
