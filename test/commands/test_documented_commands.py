# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Every `pkm-twin` line of every page: it parses as it stands, and it runs as it stands."""

import itertools
import re
import shlex
import subprocess
from functools import cache

import pytest

from pkm_twin.apps.cli import app
from test.commands.conftest import REPOSITORY
from test.support.command import SHELL, typed_line
from test.support.pages import assert_output

NOT_RUN = {
    r"pkm-twin .*\b(my_delta|converted|mine|ankle)\..*": "of a page's own file: test/docs",
    r"pkm-twin view .*": "serves until a signal: test/view runs it in a browser",
    r"pkm-twin play .*": "needs ROS: test_player runs it over the real middleware",
    r"pkm-twin map .* --scheduler .*": "needs a Dask cluster: test/maps/test_run.py has one",
    r"pkm-twin map \w+ [\w-]+( --html)?( --out \S+)?( --html)?": "minutes: the "
    "whole grid of its kind; test/maps/test_commands.py runs each on few points",
    r"pkm-twin map .* --points \d{5,}.*": "minutes: as many points as the picture has",
}
"""Lines that are parsed but not run, and why."""
ENDS = {"pkm-twin recover damaged.mcap saved.mcap": 3}
"""Exit codes other than 0, as the page says."""
SLOW = (
    r"pkm-twin (torques (\S+\.mcap|\S+ \S+\.mcap|better\.yaml)|map|design|excite|"
    r"path stewart|check (bags/\w+|\S+ --(robot|topic|payload|history))|trend|"
    r"fit (delta_cu|upr_rpu)|calibrate (delta_cu|examples/machines/hexapod|.*--plan)|"
    r"size (delta_cu bags/|\S+ large)|path \S+/delta_1130|.*\| pkm-twin|export fmu .*--kind|"
    r"lobes|path delta_cu .*--shaper)\b.*"
)
"""Lines of seconds that other tests run on smaller files: with `make long`."""
PROGRAMS = ("pkm-twin ", "head -c ")
"""Ours, and what prepares a file for it."""
INLINE_NAMES = r"ROBOT|FILE|BAG|TOPIC|COMMAND|KIND|HOST| N\b"
"""Words that stand for something in running text; a line to type has none."""


def pages():
    """Markdown files that people read as they are: of a clone, or of sources without git."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "*.md"],
        cwd=REPOSITORY,
        capture_output=True,
        check=False,
        text=True,
    ).stdout.split("\0")
    if listed == [""]:
        folders = ("", "docs", "bags", "examples")
        found = [path for name in folders for path in (REPOSITORY / name).glob("*.md")]
        listed = [path.relative_to(REPOSITORY).as_posix() for path in found]
    # Made from the commands themselves.
    own = ("test/", "docs/commands.md")
    return sorted(name for name in listed if name and not name.startswith(own))


def typed(text):
    """Lines of these programs in a page's code blocks, and the output that the page prints."""
    lines = []
    for block in re.finditer(r"^```(\w*)[^\n]*\n(.*?)^```|(?:^ {4}[^\n]*\n)+", text, re.M | re.S):
        if block[1] == "text":
            if lines and not lines[-1][1]:
                lines[-1][1] = block[2]
            continue
        # A line may be continued on the next.
        for line in re.sub(r"\\\n\s*", " ", block[2] or block[0]).splitlines():
            words = line.strip().removeprefix("$ ")
            if words.startswith(PROGRAMS):
                lines.append([words.split("  #")[0].split(" # ")[0].strip(), ""])
            else:
                lines.append(["", "another's"])
    return [(line, output) for line, output in lines if line]


def quoted(text):
    """Commands between backquotes in running text and tables, those without placeholders."""
    for words in re.findall(r"`(pkm-twin [^`\n]+)`", text):
        if not re.search(INLINE_NAMES, words):
            yield words


@cache
def commands():
    found = {}
    for page in pages():
        text = (REPOSITORY / page).read_text(encoding="utf-8")
        for line, output in typed(text):
            found[page, line] = found.get((page, line), "") or output
        for line in quoted(text):
            found.setdefault((page, line), None)
    return found


def reason(line):
    return next((why for like, why in NOT_RUN.items() if re.fullmatch(like, line)), None)


@pytest.fixture(scope="module")
def tree():
    """All commands with their options."""
    return app


@pytest.mark.parametrize(("page", "line"), [pair for pair in commands() if pair[1].startswith(PROGRAMS[0])])
def test_it_parses_as_it_stands(tree, page, line):
    """Every word is an argument or option of the command, with a value of its type."""
    words = shlex.split(line)[1:]
    # What the shell does with it is no word of the command.
    words = list(itertools.takewhile(lambda word: word not in SHELL, words))
    if words[0].startswith("-"):
        assert words[0] in {name for option in tree.params for name in option.opts}
        return
    command = tree.get_command(None, words[0])
    assert command is not None
    # A command's name alone, in running text, is only named.
    if "--help" not in words and (commands()[page, line] is not None or len(words) > 1):
        command.make_context(words[0], words[1:])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A clone, as far as the lines read it: what is not there they have to make."""
    path = tmp_path_factory.mktemp("typed")
    for name in ("bags", "config", "examples"):
        (path / name).symlink_to(REPOSITORY / name)
    return path


@pytest.mark.timeout(900)
@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.long)])
def test_it_runs_as_it_stands(folder, slow, twin, monkeypatch):
    """In the order of the page, in one folder: a later line may use what an earlier one wrote."""
    monkeypatch.chdir(folder)
    done = {}
    for (page, line), output in commands().items():
        if output is None or reason(line) or (re.fullmatch(SLOW, line) and not slow):
            continue
        if line not in done:
            done[line] = result = typed_line(twin, line)
            if missing := re.search(r"(\w+) is not installed; pip install", result.err):
                pytest.importorskip(missing[1])
            assert result.code == ENDS.get(line, 0), f"{page}: {line}\n{result.err}"
            assert "Traceback" not in result.err
        if output:
            assert_output(output, done[line].out)
    assert len(done) >= 8
    assert sum(bool(output) for output in commands().values()) >= 20


def test_the_list_of_what_is_not_run_is_of_use():
    lines = [line for _, line in commands()]
    for like in NOT_RUN:
        assert any(re.fullmatch(like, line) for line in lines), like
    for line in ENDS:
        assert line in lines
