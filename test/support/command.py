# SPDX-License-Identifier: Apache-2.0
"""`pkm-twin` in this process, and what a command left behind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from pkm_twin.apps import cli


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


def command(capture: Any, *arguments: Any) -> Result:
    """What a command gives, run in this process; ``capture`` is the fixture capsys."""
    capture.readouterr()
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    captured = capture.readouterr()
    return Result(int(end.value.code or 0), captured.out, captured.err)
