# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin`` alone and ``--help``: every command once, by task, its purpose whole."""

import os
import re
import subprocess
import sys

from pkm_twin.apps.cli import app
from pkm_twin.apps.groups import MAX_HELP_WIDTH, commands, group_by_task
from test.support.command import REPOSITORY, typed_line

ALL = commands()


def test_every_command_has_one_task():
    named = [name for names in group_by_task().values() for name in names]
    assert sorted(named) == sorted(ALL)


def test_help_lists_every_purpose_whole(twin):
    words = " ".join(twin("--help").out.split())
    for name, command in app.commands.items():
        assert f" {name} {command.get_short_help_str(MAX_HELP_WIDTH)}" in words
    assert "..." not in words.split("Robots:")[1]


def test_help_has_no_types_of_python(twin):
    for name in ("compliance", "map", "map delta compliance", "fit"):
        help_text = twin(*name.split(), "--help").out
        usage, _, arguments = help_text.partition("Arguments:")
        assert not re.search(r"[{}]|\[OPTIONS\].*\[OPTIONS\]", usage.splitlines()[0])
        assert "<" not in arguments.partition("Options:")[0]


def test_each_line_of_the_greeting_is_a_command_that_runs(twin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    alone = twin()
    lines = re.findall(r"^  (pkm-twin (?:\S+ )*\S+?)(?:  .*)?$", alone.out, re.MULTILINE)
    assert len(lines) == 3
    assert alone.code == 2
    for line in lines:
        # The page serves until a signal: its help is enough here.
        result = typed_line(twin, f"{line} --help" if " view " in line else line)
        assert result.code == 0, result.err


def test_an_older_name_runs_the_same_command(twin):
    names = ("monitor-torques", "guard-check")
    new, old = (twin(name, "--help").out.partition("Arguments:")[2] for name in names)
    assert new == old != ""


LINES = {
    "pkm-twin inf": "info",
    "pkm-twin --vers": "--version",
    "pkm-twin map delta comp": "compliance",
    "pkm-twin atlas x comp": "compliance",
    "pkm-twin info delta --plat": "--platform",
    "pkm-twin export fmu delta --kind to": "torques",
}


def test_words_are_completed_in_bash_by_the_line_of_the_help(tmp_path, twin):
    program = tmp_path / "bin" / "pkm-twin"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m pkm_twin.apps.cli "$@"\n')
    program.chmod(0o755)
    path = os.pathsep.join([str(program.parent), os.environ["PATH"]])
    root = {"PYTHONPATH": str(REPOSITORY), "PATH": path}
    (source,) = re.findall("eval .*", twin("--help").out)
    for line, word in LINES.items():
        count = len(line.split()) - 1
        typed = f"COMP_WORDS=({line}); COMP_CWORD={count}; _pkm_twin_completion pkm-twin"
        done = subprocess.run(
            ["bash", "-c", f'set -u; {source}; {typed}; echo "${{COMPREPLY[@]}}"'],
            env=os.environ | root,
            capture_output=True,
            text=True,
        )
        assert done.stdout.split() == [word], done.stderr
