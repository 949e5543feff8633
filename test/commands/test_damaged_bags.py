# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Damaged bags and what is no bag: never good, never played, recovered as far as intact."""

import json
import os
import re

import pytest

from pkm_twin.bags.reader import inspect
from test.support.command import forked
from test.support.robots import often


class TestDamage:
    @pytest.mark.parametrize("step", often(503, 37))
    def test_cuts_never_pass(self, twin, tiny, tmp_path, step):
        twin.good("check", tiny)
        whole = tiny.read_bytes()
        path = tmp_path / "cut.mcap"
        codes = set()
        for size in [*range(0, len(whole), step), len(whole) - 1]:
            path.write_bytes(whole[:size])
            result = twin("check", path)
            assert result.out == ""
            result.one_line_error()
            codes.add(result.code)
        assert codes == {1, 3}

    @pytest.mark.parametrize("content", [b"", b"no bag at all", b"\x89MCAP0\r\n"])
    def test_what_is_no_bag(self, twin, tmp_path, content):
        path = tmp_path / "bad.mcap"
        path.write_bytes(content)
        result = twin("check", path, "--json")
        data = json.loads(result.out)
        assert result.code == 1
        assert (data["good"], data["salvageable"]) == (False, 0)
        assert data["error"] in result.one_line_error()

    def test_missing_file(self, twin, tmp_path):
        assert "no such file" in twin("check", tmp_path / "absent.mcap").one_line_error()
        assert twin("check").code == 2


class TestRecover:
    def test_then_check(self, twin, sample, tmp_path):
        whole = sample.read_bytes()
        cut, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
        cut.write_bytes(whole[: len(whole) * 3 // 4])
        refused = forked(tmp_path, "check", cut)
        assert refused.code == 3
        assert twin("torques", "delta_cu", cut).code == 3
        promised = int(re.search(r"(\d+) intact messages", refused.one_line_error())[1])
        done = forked(tmp_path, "recover", cut, saved, "--json")
        assert (done.code, done.err) == (3, "")
        facts = json.loads(done.out)
        assert not facts["lossless"]
        assert facts["messages"] == promised == inspect(saved).message_count
        assert promised > 800
        assert cut.read_bytes() == whole[: len(whole) * 3 // 4]
        assert twin("check", saved).code == 0

    def test_refusals(self, twin, tiny, tmp_path):
        target = tmp_path / "target.mcap"
        target.write_text("mine")
        assert "exists" in twin.refused("recover", tiny, target)
        assert target.read_text() == "mine"
        twin.good("recover", tiny, target, "--overwrite")
        assert inspect(target).message_count == 60
        (tmp_path / "text").write_text("no bag")
        for source in (tmp_path / "text", tmp_path / "absent"):
            twin.refused("recover", source, tmp_path / "new.mcap")
            assert not (tmp_path / "new.mcap").exists()
        assert twin("recover", tiny).code == 2


class TestPlay:
    """The player itself is tested over the middleware; here only what the command refuses."""

    @pytest.mark.parametrize(
        ("arguments", "code", "text"),
        [
            (("--remap", "no pair"), 2, "FROM:=TO"),
            (("--speed", "fast"), 2, "speed"),
            (("--rate", "0"), 2, "speed"),
            (("--speed", "nan"), 2, "nan"),
            (("--topic", "/absent"), 1, "/absent"),
            (("--remap", "/joint_states:=/1", "--quiet"), 1, "'/1' is no topic name"),
        ],
    )
    def test_refusals(self, twin, tiny, arguments, code, text):
        result = twin("play", tiny, *arguments)
        assert (result.code, result.out) == (code, "")
        assert text in result.err
        assert "Traceback" not in result.err

    def test_a_damaged_bag_is_not_played(self, twin, tiny, tmp_path):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(tiny.read_bytes()[:-10])
        assert "recovered" in twin.refused("play", cut, code=3)


def test_only_regular_files(twin, tmp_path):
    fifos = [tmp_path / f"x.{ending}" for ending in ("mcap", "csv")]
    for path in fifos:
        os.mkfifo(path)
    for path, kind in ((fifos[0], "FIFO"), (fifos[1], "FIFO"), ("/dev/zero", "device")):
        for command in (
            ("check", path),
            ("recover", path, tmp_path / "new.mcap"),
            ("play", path),
            ("torques", "delta", path, "--out", tmp_path / "t.csv"),
        ):
            assert kind in twin.refused(*command)
