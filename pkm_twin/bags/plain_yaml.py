# SPDX-License-Identifier: Apache-2.0
"""YAML that others wrote, read in bounded time: no tags, no aliases, not deep."""

from __future__ import annotations

from typing import Any, Final

import yaml

MAX_DEPTH: Final = 50
"""Deepest nesting; rosbag2 writes eight."""
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def load_plain(text: str) -> object:
    """Read plain YAML.

    :raises ValueError: it is none, in one line why.
    """
    depth = 0
    try:
        # Events come before anything is built: a few aliases may stand for gigabytes.
        for event in yaml.parse(text, Loader=_LOADER):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            line = event.start_mark.line + 1 if event.start_mark else 0
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"an alias in line {line}")
            if depth > MAX_DEPTH:
                raise ValueError(f"nested deeper than {MAX_DEPTH} in line {line}")
        return yaml.load(text, Loader=_LOADER)  # noqa: S506  a safe loader
    except (yaml.YAMLError, OverflowError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from None
