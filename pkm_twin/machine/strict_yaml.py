# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read plain YAML: tags, aliases, merges and duplicate keys are rejected."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

import yaml

from pkm_twin.errors import FileError, ParameterError
from pkm_twin.files import read_bounded

MAX_FILE_SIZE: Final = 256 * 1024
"""Largest parameter file that is read, bytes; the shipped ones are below 4 kB."""


class _StrictLoader(yaml.SafeLoader):
    """Plain YAML only: no tags, aliases, merges or duplicate keys, no integer beyond all floats.

    Numbers are decimal: 1_0, 1:30 and 010 are numbers in YAML 1.1 (10, 90, 8), and slips here.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not allowed in parameter files")
        event = self.peek_event()  # type: ignore[no-untyped-call]
        if getattr(event, "tag", None) is not None:
            raise yaml.YAMLError("tags are not allowed in parameter files")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        if any(key.tag == "tag:yaml.org,2002:merge" for key, _ in node.value):
            raise yaml.YAMLError("merge keys are not allowed in parameter files")
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        if len(mapping) < len(node.value):
            seen = set()
            for key, _ in node.value:
                name = self.construct_object(key, deep=True)
                if name in seen:
                    raise yaml.YAMLError(f"key {name!r} occurs twice")
                seen.add(name)
        return mapping

    def construct_yaml_int(self, node: Any) -> int:
        if not re.fullmatch(r"[-+]?(0|[1-9][0-9]*)", node.value):
            raise yaml.YAMLError(f"{node.value}: write a decimal number, or text in quotes")
        value: int = super().construct_yaml_int(node)
        if value.bit_length() > 1023:
            raise yaml.YAMLError("an integer too large for a float")
        return value

    def construct_yaml_float(self, node: Any) -> Any:
        if "_" in node.value or ":" in node.value:
            raise yaml.YAMLError(f"{node.value}: write a decimal number, or text in quotes")
        value = float(super().construct_yaml_float(node))
        # Too small for a float: as a text it is rejected by the path of its key.
        return value or (node.value if re.match(r"[-+]?[0.]*[1-9]", node.value) else value)


_StrictLoader.add_constructor("tag:yaml.org,2002:int", _StrictLoader.construct_yaml_int)
_StrictLoader.add_constructor("tag:yaml.org,2002:float", _StrictLoader.construct_yaml_float)
# YAML 1.1 reads 1e-10 and 5.0e6 as strings; here they are numbers.
_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a parameter file.

    :raises ParameterError: not readable, too large, not plain YAML, or not a mapping.
    """
    try:
        text = read_bounded(path, MAX_FILE_SIZE, "plain YAML").decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileError(path, error, "plain YAML") from None
    return parse_yaml(text, str(path))


def parse_yaml(text: str, name: str) -> dict[str, Any]:
    """Parse the text of a parameter file.

    :param name: the file's.
    :raises ParameterError: not plain YAML, or not a mapping.
    """
    try:
        data = yaml.load(text, Loader=_StrictLoader)  # noqa: S506
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        if isinstance(error, ParameterError):
            raise
        if str(getattr(error, "problem", "")).endswith("got '['"):
            at = error.problem_mark  # type: ignore[union-attr]
            key = re.split(r"[{,\s]", text[: at.index])[-1]
            key += re.split(r":\s|[,}\s]", text[at.index :])[0]
            quoted = f'quotes around brackets in braces: "{key}"'
            raise ParameterError(f"{name}: line {at.line + 1}", key, quoted) from None
        raise FileError(name, error, "plain YAML") from None
    if not isinstance(data, dict):
        raise ParameterError(name, type(data).__name__, "a mapping of keys to values")
    return data
