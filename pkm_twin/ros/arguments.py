# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Check the command lines of nodes and launch files."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

from pkm_twin.errors import UnknownNameError

USAGE = """usage: {words} [--help] [--version] [--ros-args -p PARAMETER:=VALUE -r FROM:=TO ...]

{summary}

Runs until SIGINT or SIGTERM. For its parameters see docs/nodes.md, section {node}, or use
`ros2 param describe /{node} PARAMETER` while it runs."""


def answer(name: str, summary: str, arguments: Sequence[str], others: str = "") -> None:
    """Print help or the version and exit, if the command line asks for one.

    :param arguments: the words after the command's name.
    :param others: name in the help of the words before the options that name nodes.
    :raises SystemExit: 0 if something was printed, 2 for an argument that no node has.
    """
    end = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
    own = arguments[:end]
    if not own:
        return
    if own[0] in ("-h", "--help"):
        print(USAGE.format(words=f"{name} {others}".strip(), summary=summary, node=others or name))
        raise SystemExit(0)
    if own[0] == "--version":
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(version("pkm_twin"))
        except PackageNotFoundError:
            print("pkm_twin, not installed")
        raise SystemExit(0)
    print(f"cannot start: unknown argument {own[0]!r}; give parameters as --ros-args -p NAME:=VALUE", file=sys.stderr)
    raise SystemExit(2)


def check_launch_arguments(file: str, given: Iterable[str], declared: Iterable[str]) -> None:
    """Reject arguments of ``ros2 launch`` that the launch file on its command line lacks.

    A file that includes it has arguments of its own, which launch does not distinguish.

    :param file: path of the launch file; ``given``: words ``NAME:=VALUE``.
    :raises UnknownNameError: one is not declared.
    """
    own = Path(file)
    named = any(
        own.resolve() == Path(word).resolve() or (before, word) == ("pkm_twin", own.name)
        for before, word in pairwise(sys.argv)
    )
    known = set(declared)
    for word in given if named else ():
        name = word.partition(":=")[0]
        if name not in known:
            raise UnknownNameError("launch argument", name, known)
