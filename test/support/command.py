# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""`pkm-twin` in this process, and what a command left behind."""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from pkm_twin.apps import cli

REPOSITORY = Path(__file__).parents[2]
SHELL = (">", ">>", "<", "|", "&&", ";", "2>")
"""Words of a line that are the shell's."""
_FORK = multiprocessing.get_context("fork")


@dataclass(frozen=True)
class Result:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    def one_line_error(self) -> str:
        """The error, which has to be one line without a traceback."""
        lines = self.err.strip().splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("pkm-twin: ")
        return lines[0]


class Commands:
    """``pkm-twin`` in this process: the fixture ``twin``, which is called with a line's words."""

    def __init__(self, capture: Any) -> None:
        """``capture`` is the fixture capsys."""
        self._capture = capture

    def __call__(self, *words: Any) -> Result:
        """What a command gives."""
        self._capture.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main([str(word) for word in words])
        captured = self._capture.readouterr()
        return Result(int(end.value.code or 0), captured.out, captured.err)

    def good(self, *words: Any, code: int = 0) -> Result:
        """The same of a command that ends with this code."""
        result = self(*words)
        assert result.code == code, result.err
        return result

    def told(self, *words: Any, code: int = 0) -> Any:
        """What ``--json`` tells with this exit code; NaN and Infinity are no JSON."""
        return json.loads(self.good(*words, "--json", code=code).out, parse_constant=_refuse)

    def refused(self, *words: Any, code: int = 1) -> str:
        """The one line of a command that is refused with this code, and prints nothing else."""
        result = self.good(*words, code=code)
        assert result.out == ""
        return result.one_line_error()


def _refuse(token: str) -> None:
    raise AssertionError(f"{token} is no JSON")


def command(capture: Any, *words: Any) -> Result:
    """What a command gives, run in this process; ``capture`` is the fixture capsys."""
    return Commands(capture)(*words)


def typed_line(twin: Callable[..., Result], line: str) -> Result:
    """What a line gives as it is typed; one that pipes, in processes of its own.

    :param twin: the fixture that runs a command in this process.
    """
    program, *words = shlex.split(line)
    if program == "pkm-twin" and words[-2:-1] == [">"] and not set(words[:-2]) & set(SHELL):
        result = twin(*words[:-2])
        Path(words[-1]).write_text(result.out, encoding="utf-8")
        return replace(result, out="")
    if not set(words) & set(SHELL):
        return twin(*words)
    program = f"{shlex.quote(sys.executable)} -m pkm_twin.apps.cli"
    shell = f'pkm-twin() {{ {program} "$@"; }}\n{line}'
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, env=environment)
    return Result(done.returncode, done.stdout, done.stderr)


def forked(folder: Path, *arguments: Any, limit: int = resource.RLIM_INFINITY, out: str = "") -> Result:
    """What a command gives in a fork of this process: it may be ended, and need not import.

    :param folder: where it runs.
    :param limit: bytes at which its files end.
    :param out: a device that takes what it prints.
    """
    outputs = [folder / "stdout.txt", folder / "stderr.txt"]
    outputs[0].touch()
    opened = [Path(out) if out else outputs[0], outputs[1]]
    process = _FORK.Process(target=_run, args=(folder, arguments, opened, limit))
    process.start()
    process.join()
    printed, err = (path.read_text() for path in outputs)
    for path in outputs:
        path.unlink()
    assert process.exitcode is not None
    return Result(process.exitcode, printed, err)


def _run(folder: Path, arguments: tuple[Any, ...], outputs: list[Path], limit: int) -> None:
    os.chdir(folder)
    # As a process has them that writes into files.
    sys.stdout, sys.stderr = outputs[0].open("w"), outputs[1].open("w", buffering=1)
    # What a library writes past Python.
    for number, stream in enumerate((sys.stdout, sys.stderr), 1):
        os.dup2(stream.fileno(), number)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    cli.main([str(argument) for argument in arguments])
