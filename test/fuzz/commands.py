# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Words of the command line in any order."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import random
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from pkm_twin.apps import cli
from pkm_twin.apps.options import NOT_JUDGED, REFUSED, SALVAGED, USAGE
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.mechanisms import catalogue
from pkm_twin.robot.robot import Robot
from test.fuzz.bags import small_bag
from test.fuzz.tally import Kind

REPOSITORY = Path(__file__).resolve().parents[2]
CODES = (0, REFUSED, USAGE, SALVAGED, NOT_JUDGED)
EACH = 1000
"""One line in so many is run as a process of its own, too."""


class Once:
    """What every command line would make anew, made once: shipped robots."""

    def __init__(self) -> None:
        self.robots: dict[str, Robot] = {}
        self.shipped = functools.cache(read_yaml)
        self.read, self.build = read_yaml, catalogue.robot_of_data

    def read_yaml(self, path: Path) -> dict[str, Any]:
        return self.shipped(path) if path.parent == catalogue.config_folder() else self.read(path)

    def robot_of_data(self, data: Any, name: str) -> Robot:
        key = repr((name, data))
        if key not in self.robots:
            self.robots[key] = self.build(data, name)
        return self.robots[key]

    @contextlib.contextmanager
    def used(self) -> Iterator[None]:
        with (
            mock.patch.object(catalogue, "read_yaml", self.read_yaml),
            mock.patch.object(catalogue, "robot_of_data", self.robot_of_data),
        ):
            yield


class Commands(Kind):
    """Words of the command line in any order: an exit code of the list, one line where refused."""

    name = "command lines"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.turn = 0
        self.once = Once()
        small_bag(folder / "a.mcap")
        (folder / "cut.mcap").write_bytes((folder / "a.mcap").read_bytes()[:900])
        rows = "".join(f"{n / 100},0.1,{0.1 + n / 1000},0.1\n" for n in range(20))
        (folder / "m.csv").write_text("time,arm_1.position,arm_2.position,arm_3.position\n" + rows)
        with contextlib.suppress(FileExistsError):
            os.mkfifo(folder / "fifo.mcap")
        self.words = [
            *("delta", "delta_cu", "prru", "upr_rpu", "delt", "a.mcap", "cut.mcap", "m.csv", "."),
            *("fifo.mcap", "absent", "/dev/zero", "/dev/null", "", "-", "--", "0", "-0.6", "nan"),
            *("1e400", "0.1", "x" * 300, "\udcff", "a\nb", "o.mcap"),
        ]
        payload = [["--payload", "0.1,0,0,0"], ["--payload", "1e300"], ["--load-times", "0,0.001"]]
        payload += [["--payload", "0.2", "--load-times", "0.001,9"]]
        topic = [["--topic", "/joint_states"], ["--topic", "/none"]]
        table = [["--out", "o.csv"], ["--out", "o.txt"], ["--overwrite"], ["--overwrite"]]
        beyond = [["--beyond-limits"]]
        loads = ("1,2,3,4,5,6", "0,0,0,0,0,0", "1", "1e300,0,0,0,0,0")
        load_case = [["--wrench", text] for text in loads]
        elastic = [["--json"], *beyond, *load_case]
        judged = [["--json"], *payload, *topic, ["--robot", "upr_rpu"]]
        judged += [["--residual", text] for text in ("0.5", "5", "nan")]
        self.lines: list[tuple[list[str], list[list[str]]]] = [
            (["robots"], []),
            (["--version"], []),
            (["info", "five_bar"], [["--json"]]),
            (["info", "stewart"], [["--json"], ["--platform", "x"]]),
            (["urdf", "five_bar"], [["--platform", "x"]]),
            (["convert", "prru"], [["--platform", "x"]]),
            (["show", "absent.nc"], [["--html"], ["--out", "."], ["a.mcap"]]),
            (["certify", "absent.yaml"], [["--states", "-1"]]),
            (["info", "delta_cu"], [["--json"]]),
            (["info", "upr_rpu"], [["--json"]]),
            (["compliance", "upr_rpu", "-0.6", "0", "0"], elastic),
            (["compliance", "upr_rpu", "-0.25", "0.1", "0"], elastic),
            (["compliance", "prru", "0.5", "0.1", "0"], elastic),
            (["check", "a.mcap", "--robot", "delta_cu"], judged),
            (["check", "cut.mcap"], judged),
            (["recover", "cut.mcap", "o.mcap"], [["--json"], ["--overwrite"]]),
            (["recover", "a.mcap", "o.mcap"], [["--json"], ["--overwrite"]]),
            (["torques", "delta", "m.csv", "--no-picture"], [*table, *payload, *topic, *beyond]),
            (["torques", "delta_cu", "a.mcap", "--no-picture"], [*table, *payload, *topic]),
        ]

    def draw(self, rng: random.Random) -> list[str]:
        start, options = rng.choice(self.lines)
        line = list(start)
        if options:
            for part in rng.choices(options, k=rng.randrange(4)):
                line += part
        # Now and then a word too much, too few, or in the place of another.
        if rng.random() < 0.4:
            at = rng.randint(0, len(line))
            line[at : at + rng.randint(0, 2)] = rng.choices([*self.words, "--help", "--x"], k=rng.randrange(3))
        return line

    def check(self, example: list[str]) -> str:
        for name in ("o.csv", "o.mcap"):
            (self.folder / name).unlink(missing_ok=True)
        self.turn += 1
        run = self.in_process if self.turn % EACH else self.as_process
        code, out, err = run(example)
        assert code in CODES, code
        assert "Traceback" not in err
        assert code != NOT_JUDGED or "check" in example, example
        if code == REFUSED and err:
            assert len(err.splitlines()) == 1 and err.startswith("pkm-twin: "), err
        if "--json" in example and code == 0 and out.lstrip().startswith("{"):
            json.loads(out, parse_constant=lambda token: 1 / 0)
        return "good" if code == 0 else f"exit code {code}"

    def in_process(self, words: list[str]) -> tuple[object, str, str]:
        out, err = io.StringIO(), io.StringIO()
        code: object = 0
        before = Path.cwd()
        os.chdir(self.folder)
        try:
            with (
                self.once.used(),
                contextlib.redirect_stdout(out),
                contextlib.redirect_stderr(err),
            ):
                try:
                    cli.main(list(words))
                except SystemExit as end:
                    code = end.code or 0
        finally:
            os.chdir(before)
        return code, out.getvalue(), err.getvalue()

    def as_process(self, words: list[str]) -> tuple[object, str, str]:
        if any("\0" in word for word in words):
            return self.in_process(words)
        done = subprocess.run(
            [sys.executable, "-m", "pkm_twin.apps.cli", *words],
            capture_output=True,
            stdin=subprocess.DEVNULL,
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        )
        return (
            done.returncode,
            done.stdout.decode("utf-8", "replace"),
            done.stderr.decode("utf-8", "replace"),
        )

    def corpus(self) -> Iterator[tuple[str, Any]]:
        """A file is a list of lines as a shell splits them."""
        for name, content in super().corpus():
            for line in content.decode().splitlines():
                yield f"{name}: {line}", shlex.split(line, comments=True)
