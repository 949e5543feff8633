# SPDX-License-Identifier: Apache-2.0
"""`pkm-twin atlas` and `pkm-twin show` from the command line to the pictures."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pkm_twin.atlas import kinds
from pkm_twin.atlas.run import run
from pkm_twin.atlas.store import Parts, open_atlas
from pkm_twin.atlas.strain_energy.sweep import strain_energy_sweep
from test.atlas.conftest import same
from test.support.command import forked
from test.support.robots import load, partly_long

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-m", "pkm_twin.apps.cli"]
SWEEP = ["atlas", "upr_rpu", "strain-energy", "--wrench", "P2", "--points", "20000"]
SPHERES = ["atlas", "prru", "isotropy", "--points", "2000"]


def environment():
    """Of a process that runs a command."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}


@pytest.fixture(scope="module")
def sweep():
    """What the command SWEEP computes."""
    return strain_energy_sweep(load("upr_rpu"), "P2", 20_000)


@pytest.fixture
def call(twin, tmp_path, monkeypatch):
    """Run a command in the test's folder, in this process: call("show", "a.nc", code=1)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")

    def called(*words, code=0):
        result = twin(*words)
        assert result.code == code, result.err
        return result

    return called


def test_an_atlas_says_what_made_it(call, tmp_path):
    few = [*SWEEP[:-1], "2000"]
    out = call(*few, "--out", "a.nc", "--no-picture", "--workers", "1").out
    assert "paper, table 2" in out
    with open_atlas(tmp_path / "a.nc") as data:
        assert data.attrs["robot"] == "upr_rpu"
        assert "youngs_modulus" in data.attrs["robot_parameters"]
        assert data.attrs["pkm_twin_version"]
        assert data.energy.dims == ("z", "tilt", "azimuth")
        assert data.energy.attrs["units"] == "J"


@pytest.mark.parametrize(
    "words", partly_long([SWEEP, SPHERES], SPHERES), ids=lambda words: words[2]
)
def test_atlas_to_pictures_and_show(words, call, tmp_path):
    pytest.importorskip("plotly")
    out = call(*words, "--out", "a.nc", "--workers", "1").out
    figures = kinds.KINDS[words[2]].figures
    for name in figures:
        picture = tmp_path / f"a_{name}.png"
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert str(picture.name) in out
    call("show", "a.nc", "--out", "b", "--html")
    for name in figures:
        assert (tmp_path / f"b_{name}.png").exists()
    assert "Plotly" in (tmp_path / "b.html").read_text()


def test_interrupted_and_resumed(call, small_atlases, tmp_path):
    """Ctrl-C leaves finished parts; the same command goes on, with the same file."""
    words = ["atlas", "prru", "modes", "--points", "60", "--no-picture"]
    process = subprocess.Popen(
        [*COMMAND, *words, "--out", "cut.nc"],
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
    call(*words, "--out", "cut.nc", "--workers", "1")
    assert not parts.exists()
    assert same(small_atlases["modes prru whole"], tmp_path / "cut.nc")


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["atlas", "five_bar", "isotropy"], 1, "three pose coordinates"),
        (["atlas", "delta", "pose-error"], 1, "uncertainty"),
        (["atlas", "delta", "weather"], 1, "workspace"),
        (["atlas", "upr_rpu", "strain-energy", "--wrench", "1,2"], 2, "six numbers"),
        (["atlas", "delta", "modess"], 1, "did you mean 'modes'"),
        (["atlas", "delt", "modes"], 1, "did you mean"),
        (["atlas", "delta", "workspace", "--wrench", "P1"], 2, "--wrench"),
        (["atlas", "prru", "isotropy", "--least-clearance", "0.1"], 2, "--least-clearance"),
        (["atlas", "upr_rpu", "strain-energy", "--beyond-limits"], 2, "--beyond-limits"),
        (["atlas", "upr_rpu", "strain-energy", "--wrench", "0,0,0,0,0,0"], 1, "not zero"),
        (["atlas", "prru", "isotropy", "--height", "nan"], 1, "height"),
        (["atlas", "delta", "workspace", "--points", "9" * 18], 2, "--points"),
        (["show", "none.nc"], 1, "none.nc"),
    ],
)
def test_refusals_are_one_line(words, code, text, call, tmp_path):
    result = call(*words, code=code)
    assert text in result.err
    assert "Traceback" not in result.err
    assert list(tmp_path.iterdir()) == []
    if code == 1:
        assert result.err.count("\n") == 1


def test_each_kind_says_its_own_options(call):
    shared = {"--points", "--out", "--workers", "--scheduler", "--html", "--overwrite"}
    bounds = {"--least-singularity", "--least-clearance"}
    own = {
        "workspace": bounds,
        "strain-energy": {"--wrench", "--payload", "--along", *bounds},
        "isotropy": {"--height", "--energy", "--beyond-limits"},
        "modes": set(),
    }
    whole = call("atlas", "delta", "--help")
    assert whole.code == 0 and all(kind in whole.out for kind in own)
    for kind, options in own.items():
        text = call("atlas", "delta", kind, "--help").out
        for option in set().union(shared, *own.values()):
            assert (option in text) == (option in shared | options)


def test_damaged_atlases_are_one_line(strain, tmp_path):
    whole = strain[1].read_bytes()
    rng = np.random.default_rng(5)
    for k in (0, 1, 4):
        damaged = bytearray(whole[: len(whole) // 3] if k == 0 else whole)
        for _ in range(40 * k):
            # Where the file says what it holds, not in its numbers.
            damaged[rng.integers(0, 60_000)] ^= 255
        (tmp_path / "b.nc").write_bytes(damaged)
        # HDF5 may end the process.
        result = forked(tmp_path, "show", "b.nc")
        assert result.code == 1, result
        assert result.err.startswith("pkm-twin: b.nc: ")
        assert result.err.count("\n") == 1


def test_output_that_cannot_be_written_is_one_line(call, small_atlases, tmp_path):
    shutil.copy(small_atlases["workspace delta_cu"], tmp_path / "a.nc")
    result = forked(tmp_path, "show", "a.nc", out="/dev/full")
    assert result.code == 1
    assert result.err.count("\n") == 1
    (tmp_path / "a_sections.png").unlink(missing_ok=True)
    (tmp_path / "a_sections.png").mkdir()
    result = call("show", "a.nc", code=1)
    assert "a_sections.png" in result.err
    assert result.err.count("\n") == 1


@pytest.mark.parametrize("limit", [20_000, 1_000_000])
def test_a_full_disk_costs_no_finished_chunk(limit, sweep, tmp_path):
    """While chunks are written, and while HDF5 joins them: one line, and the rest goes on."""
    out = tmp_path / "a.nc"
    words = [*SWEEP, "--no-picture", "--workers", "1", "--out", out]
    ended = forked(tmp_path, *words, limit=limit)
    assert ended.code == 1, ended
    assert ended.err.count("\n") == 1
    assert "File too large" in ended.err
    assert not out.exists()
    assert not list(tmp_path.rglob("*.tmp"))
    run(sweep, out, workers=1)
    assert not Parts(out, sweep).folder.exists()
