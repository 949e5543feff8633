# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write tables of docs/nodes.md and topics of docs/security/policy.xml from the nodes' tables.

``python -m tools.pages.nodes docs/nodes.md docs/security/policy.xml``
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any, Final

from pkm_twin.apps.nodes import MODULES
from pkm_twin.settings import Setting
from pkm_twin.streams.topics import Topic
from test.support.pages import write_section

GIVEN: Final = {"command_gate": ("on_stop:=gravity",)}
"""Parameters with which all parameters of a node are declared."""
GROUPS: Final = {"in": "topics subscribe", "out": "topics publish", "service": "services reply"}


def class_of(node: str) -> Any:
    """Return the class of a node."""
    from pkm_twin.ros.node import TwinNode

    module = importlib.import_module(MODULES[node])
    (kind,) = {
        value
        for value in vars(module).values()
        if isinstance(value, type) and value.__module__ == module.__name__
        if issubclass(value, TwinNode)
    }
    return kind


def rows_of(node: str) -> dict[str, tuple[Any, Setting]]:
    """Return a node's declared parameters with their defaults, from a node in this process."""
    # Discover no other nodes.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
    import rclpy

    options = [word for value in GIVEN.get(node, ()) for word in ("-p", value)]
    rclpy.init(args=["--ros-args", "--log-level", "error", *options])
    try:
        made = class_of(node)()
        try:
            return dict(made.rows)
        finally:
            made.destroy_node()
    finally:
        rclpy.shutdown()


def row(name: str, default: Any, setting: Setting) -> str:
    """Write a parameter's line."""
    given, values = setting.usual or _value(default), _values(setting)
    if isinstance(default, int | float) and not setting.usual and values:
        given, values = f"{given} {values}", ""
    parts = [given, values, "" if setting.fixed else "live"]
    return f"* `{name}` ({'; '.join(filter(None, parts))}): {setting.text}\n"


def topic_row(row: Topic) -> str:
    """Write a topic's line."""
    when = f"only with {row.when}: " if row.when else ""
    kept = "; transient local" if row.latched else ""
    return f"* {row.direction} `{row.name}` ({row.kind}): {when}{row.text}{kept}\n"


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
        told = all(re.search(rf"\b{word}\b", setting.text) for word in setting.choices)
        return "" if told else ", ".join(f"`{word}`" for word in setting.choices)
    return setting.unit


def parts() -> dict[str, str]:
    """Write the page's parts between the marks of each node, and of all nodes."""
    rows = {node: {k: row(k, *v) for k, v in rows_of(node).items()} for node in MODULES}
    times = Counter(line for own in rows.values() for line in own.values())
    shared = sorted(line for line, count in times.items() if count > 1)
    common = [line for line in shared if times[line] == len(rows)]
    rest = [line for line in shared if line not in common]
    found = {"all nodes": "".join([*common, "\nSome nodes also have:\n\n", *rest])}
    for node, own in rows.items():
        topics = "".join(map(topic_row, class_of(node).topics.values()))
        lines = "".join(line for line in own.values() if line not in shared)
        some = [name for name, line in own.items() if 1 < times[line] < len(rows)]
        names = ", ".join(f"`{name}`" for name in some)
        also = f"Also, as [other nodes](#all-nodes): {names}."
        found[node] = f"{topics}\nParameters:\n\n{lines}\n{also}"
    return found


def policy(text: str) -> str:
    """Return the security policy with the nodes' present topics and services."""
    for node in MODULES:
        found = class_of(node).topics.values()
        allowed = "".join(
            _group(head, [row.name for row in found if row.direction == way]) for way, head in GROUPS.items()
        )
        start = text.index("/>\n", text.index(f'node="{node}"')) + len("/>\n")
        text = text[:start] + allowed + text[text.index("        </profile>", start) :]
    return text


def _group(head: str, names: list[str]) -> str:
    tag = head.partition("s ")[0]
    lines = [f"  <{tag}>{name.replace('<joint>', '*')}</{tag}>\n" for name in names]
    lines = [f'<{head}="ALLOW">\n', *lines, f"</{tag}s>\n"] if names else []
    return "".join(f"          {line}" for line in lines)


def main() -> None:
    """Write the tables into the page, and the topics into the policy."""
    page, allowed = map(Path, sys.argv[1:])
    for name, text in parts().items():
        write_section(name, text, page)
    allowed.write_text(policy(allowed.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
