# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""`pkm-twin map` from the command line to the pictures."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pkm_twin.maps.kinds import KINDS
from pkm_twin.maps.run import run
from pkm_twin.maps.store import Parts, open_map
from test.commands.conftest import coarse_pictures  # noqa: F401
from test.maps.conftest import CHUNK, few, same
from test.support.command import forked

ROOT = Path(__file__).parents[2]
SWEEP = ["map", "five_bar", "strain-energy", "--points", "2000", "--no-picture"]
PROGRAM = f"""
from pkm_twin.apps import cli
from pkm_twin.maps.kind import Kind
Kind.chunk = {CHUNK}
cli.main()
"""
SMALL = ["map", "five_bar", "workspace", "--points", "1000"]


def environment():
    """Of a process that runs a command."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}


@pytest.fixture
def call(twin, tmp_path, monkeypatch):
    """Run a command in the test's folder, in this process: call("map", "show", "a.nc", code=1)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")

    def called(*words, code=0):
        result = twin(*words)
        assert result.code == code, result.err
        return result

    return called


@pytest.mark.usefixtures("short")
def test_a_map_to_pictures_and_shown_again(call, tmp_path):
    """The answer is the first line; the file says what made it; `atlas` is the older name."""
    pytest.importorskip("plotly")
    out = call(*SMALL, "--out", "a.nc", "--jobs", "1").out
    assert "reachable" in out.splitlines()[0]
    with open_map(tmp_path / "a.nc") as data:
        assert data.attrs["robot"] == "five_bar"
        assert "arm" in data.attrs["robot_parameters"]
        names = [str(name) for name in data.case.values]
        assert f"{float(data.volume):.4g} {data.volume.attrs['units']}" in out
    for name in names:
        picture = tmp_path / (f"a_{name}.png" if len(names) > 1 else "a.png")
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.name in out
    told = json.loads(call("atlas", "show", "a.nc", "--out", "b", "--html", "--json").out)
    assert all((tmp_path / name).exists() for name in told["pictures"])
    assert "Plotly" in (tmp_path / "b.html").read_text()
    made = {name: (tmp_path / name).read_bytes() for name in (*told["pictures"], "b.html")}
    for name in (told["pictures"][0], "b.html"):
        (tmp_path / name).write_bytes(b"mine")
        for other in made:
            if other != name:
                (tmp_path / other).unlink(missing_ok=True)
        assert name in call("map", "show", "a.nc", "--out", "b", "--html", code=1).err
        assert (tmp_path / name).read_bytes() == b"mine"
        call("map", "show", "a.nc", "--out", "b", "--html", "--overwrite")
        assert (tmp_path / name).read_bytes() != b"mine"


@pytest.mark.usefixtures("short")
def test_planes_go_through_a_given_pose(call, tmp_path):
    call("map", "five_bar", "payload", "--points", "60", "--at", "0.05,0.3", "--out", "a.nc")
    with open_map(tmp_path / "a.nc") as data:
        assert data.through.values.tolist() == [[0.05, 0.3]]
        assert 0.05 in data.row_value.values and 0.3 in data.column_value.values


@pytest.mark.usefixtures("chunks")
def test_interrupted_and_resumed(call, tmp_path):
    """Ctrl-C leaves finished parts; the same command goes on, with the same file."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *SWEEP, "--out", "cut.nc"],
        cwd=tmp_path,
        env=environment(),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    parts = tmp_path / "cut.nc.parts"
    while process.poll() is None and len(list(parts.glob("*.npz"))) < 2:
        time.sleep(0.005)
    # As a terminal does it: to the workers too, and an impatient person more than once.
    for _ in range(3):
        os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate()
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert "continues from there" in errors
    assert parts.exists()
    assert not (tmp_path / "cut.nc").exists()
    call(*SWEEP, "--out", "cut.nc", "--jobs", "1")
    assert not parts.exists()
    call(*SWEEP, "--out", "whole.nc", "--jobs", "1")
    assert same(tmp_path / "whole.nc", tmp_path / "cut.nc")


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["delta", "pose-error"], 1, "uncertainty"),
        (["delta", "weather"], 2, "workspace"),
        (["delta", "show", "a.nc"], 2, "a.nc"),
        (["upr_rpu", "strain-energy", "--wrench", "1,2"], 2, "six numbers"),
        (["delta", "modess"], 2, "did you mean 'modes'"),
        (["delt", "modes"], 1, "did you mean"),
        (["delta", "workspace", "--wrench", "0,0,1,0,0,0"], 2, "--wrench"),
        (["upr_rpu", "strain-energy", "--energy", "3"], 2, "--energy"),
        (["upr_rpu", "strain-energy", "--wrench", "0,0,0,0,0,0"], 2, "not all zero"),
        (["prru", "isotropy", "--energy", "nan"], 2, "energy"),
        (["delta", "isotropy", "--spheres"], 1, "two tilts"),
        (["stewart", "payload", "--regular"], 1, "about an axis"),
        (["delta", "payload", "--at", "1,2"], 2, "a pose"),
        (["delta", "payload", "--at", "5,5,5"], 1, "pose"),
        (["delta", "workspace", "--points", "9" * 18], 2, "--points"),
        (["show", "none.nc"], 1, "none.nc"),
    ],
)
def test_refusals_are_one_line(words, code, text, call, tmp_path):
    result = call("map", *words, code=code)
    assert text in result.err
    assert "Traceback" not in result.err
    assert list(tmp_path.iterdir()) == []
    assert result.err.count("\n") == 1


def test_each_kind_says_its_own_options(call):
    shared = {
        "--points",
        "--regular",
        "--out",
        "--jobs",
        "--at",
        "--along",
        "--singularity",
        "--payload",
    }
    own = {
        "workspace": set(),
        "strain-energy": {"--wrench", "--elements"},
        "isotropy": {"--energy", "--spheres"},
        "cutting-depth": {"--teeth", "--tangential", "--damping"},
    }
    assert all(kind in call("map", "delta", "--help").out for kind in KINDS)
    for kind, options in own.items():
        text = call("map", "delta", kind, "--help").out
        for option in set().union(shared, *own.values()):
            assert (option in text) == (option in shared | options)


def test_damaged_maps_are_one_line(strain, tmp_path):
    whole = strain[1].read_bytes()
    rng = np.random.default_rng(5)
    for k in (0, 1, 4):
        damaged = bytearray(whole[: len(whole) // 3] if k == 0 else whole)
        for _ in range(40 * k):
            # Where the file says what it holds, not in its numbers.
            damaged[rng.integers(0, 60_000)] ^= 255
        (tmp_path / "b.nc").write_bytes(damaged)
        # HDF5 may end the process.
        result = forked(tmp_path, "map", "show", "b.nc")
        assert result.code == 1, result
        assert result.err.startswith("pkm-twin: b.nc: ")
        assert result.err.count("\n") == 1


def test_output_that_cannot_be_written_is_one_line(call, small_maps, tmp_path):
    shutil.copy(small_maps["workspace delta_cu"], tmp_path / "a.nc")
    result = forked(tmp_path, "map", "show", "a.nc", out="/dev/full")
    assert result.code == 1
    assert result.err.count("\n") == 1
    (tmp_path / "a_clearance.png").unlink(missing_ok=True)
    (tmp_path / "a_clearance.png").mkdir()
    result = call("map", "show", "a.nc", code=1)
    assert "a_clearance.png" in result.err
    assert result.err.count("\n") == 1


@pytest.mark.usefixtures("chunks")
@pytest.mark.parametrize("limit", [1_000, 100_000])
def test_a_full_disk_costs_no_finished_chunk(limit, tmp_path):
    """While chunks are written, and while HDF5 joins them: one line, and the rest goes on."""
    out = tmp_path / "a.nc"
    ended = forked(tmp_path, *SWEEP, "--jobs", "1", "--out", out, limit=limit)
    assert ended.code == 1, ended
    assert ended.err.count("\n") == 1
    assert "File too large" in ended.err
    assert not out.exists()
    assert not list(tmp_path.rglob("*.tmp"))
    sweep = few()
    left = len(Parts(out, sweep).pending())
    assert left == (0 if limit > 1_000 else len(sweep.chunks()))
    run(sweep, out, workers=1)
    assert not Parts(out, sweep).folder.exists()
