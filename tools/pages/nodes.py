# SPDX-License-Identifier: Apache-2.0
"""Tables of parameters in docs/nodes.md: ``python -m tools.pages.nodes docs/nodes.md``.

They are those that the nodes declare.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from pathlib import Path
from typing import Any, Final

from pkm_twin.apps.nodes import MODULES
from pkm_twin.streams.settings import Setting

COMMON: Final = ("autostart", "executor", "queue_depth", "thread_priority")
"""Parameters of every node, in a table of their own."""
GIVEN: Final = {"command_gate": ("on_stop:=gravity",)}
"""Without it the gate has no payload."""
HEAD: Final = "| parameter | default | unit, values | changeable | |\n|---|---|---|---|---|\n"


def rows_of(node: str) -> dict[str, tuple[Any, Setting]]:
    """What a node declares: the default, and what it means; in this process, for a moment."""
    # Nobody else's node is meant.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    import rclpy

    from pkm_twin.ros.node import TwinNode

    module = importlib.import_module(MODULES[node])
    (kind,) = {
        value
        for value in vars(module).values()
        if isinstance(value, type) and value.__module__ == module.__name__
        if issubclass(value, TwinNode)
    }
    options = [word for value in GIVEN.get(node, ()) for word in ("-p", value)]
    rclpy.init(args=["--ros-args", "--log-level", "error", *options])
    try:
        made = kind()
        try:
            return dict(made.rows)
        finally:
            made.destroy_node()
    finally:
        rclpy.shutdown()


def row(name: str, default: Any, setting: Setting) -> str:
    """A parameter's line of the table."""
    cells = [
        f"`{name}`", setting.usual or _value(default), _values(setting),
        "" if setting.fixed else "yes", setting.text,
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |\n"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"`{value}`" if value else "empty"
    if isinstance(value, int | float):
        return f"{value:.6g}" if isinstance(value, float) else str(value)
    if value and not any(isinstance(v, str) or v for v in value):
        return "zeros"
    return ", ".join(map(_value, value))


def _values(setting: Setting) -> str:
    if setting.choices:
        return ", ".join(f"`{word}`" for word in setting.choices)
    if setting.low is None or setting.high is None:
        return setting.unit
    low, high = (
        str(int(v)) if v == int(v) < 1e8 else f"{v:g}" for v in (setting.low, setting.high)
    )
    return f"{low} to {high} {setting.unit}".strip()


def page(text: str) -> str:
    """The page with today's tables."""
    for node in MODULES:
        found = rows_of(node)
        common = HEAD + "".join(row(name, *found.pop(name)) for name in COMMON)
        own = HEAD + "".join(row(name, *entry) for name, entry in found.items())
        text = _replaced(text, node, own)
    return _replaced(text, "All nodes", common)


def _replaced(text: str, section: str, table: str) -> str:
    begin = text.index(f"\n## {section}\n")
    start = text.index("\n| parameter |", begin) + 1
    return text[:start] + table + text[re.compile(r"\n(?!\|)").search(text, start).end() :]


def main() -> None:
    """Write the tables into the page."""
    path = Path(sys.argv[1])
    path.write_text(page(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
