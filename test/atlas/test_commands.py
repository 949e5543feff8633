# SPDX-License-Identifier: Apache-2.0
"""`pkm-twin atlas` and `pkm-twin show` from the command line to the pictures."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pkm_twin.atlas.store import open_atlas
from test.atlas.conftest import same

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, "-m", "pkm_twin.apps.cli"]
SWEEP = ["atlas", "upr_rpu", "strain-energy", "--wrench", "P2", "--points", "20000"]


def environment():
    return {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}


def call(*words, folder, code=0):
    result = subprocess.run(
        [*COMMAND, *map(str, words)],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == code, result.stderr
    return result


def test_atlas_to_pictures_and_show(tmp_path):
    pytest.importorskip("plotly")
    out = call(*SWEEP, "--out", "a.nc", "--workers", "1", folder=tmp_path).stdout
    assert "paper, table 2" in out
    for name in ("plane", "factors", "slices", "global"):
        picture = tmp_path / f"a_{name}.png"
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert str(picture.name) in out
    with open_atlas(tmp_path / "a.nc") as data:
        assert data.attrs["robot"] == "upr_rpu"
        assert "youngs_modulus" in data.attrs["robot_parameters"]
        assert data.attrs["pkm_twin_version"]
        assert data.energy.dims == ("z", "tilt", "azimuth")
        assert data.energy.attrs["units"] == "J"
    call("show", "a.nc", "--out", "b", "--html", folder=tmp_path)
    assert (tmp_path / "b_plane.png").exists()
    assert "Plotly" in (tmp_path / "b.html").read_text()


def test_interrupted_and_resumed(tmp_path):
    """Ctrl-C leaves finished parts; the same command goes on, with the same file."""
    words = ["atlas", "upr_rpu", "strain-energy", "--points", "300000", "--no-picture"]
    call(*words, "--out", "whole.nc", folder=tmp_path)
    process = subprocess.Popen(
        [*COMMAND, *words, "--out", "cut.nc"],
        cwd=tmp_path,
        env=environment(),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    parts = tmp_path / "cut.nc.parts"
    end = time.monotonic() + 60
    while time.monotonic() < end and len(list(parts.glob("*.npz"))) < 2:
        time.sleep(0.005)
    # As a terminal does it: to the workers too, and an impatient person more than once.
    for _ in range(3):
        os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert "goes on from there" in errors
    assert parts.exists()
    assert not (tmp_path / "cut.nc").exists()
    call(*words, "--out", "cut.nc", folder=tmp_path)
    assert not parts.exists()
    assert same(tmp_path / "whole.nc", tmp_path / "cut.nc")


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["atlas", "upr_rpu", "isotropy"], 1, "masses"),
        (["atlas", "delta", "strain-energy"], 1, "elastic"),
        (["atlas", "delta", "weather"], 1, "workspace"),
        (["atlas", "upr_rpu", "strain-energy", "--wrench", "1,2"], 2, "six numbers"),
        (["show", "none.nc"], 1, "none.nc"),
    ],
)
def test_refusals_are_one_line(words, code, text, tmp_path):
    result = call(*words, folder=tmp_path, code=code)
    assert text in result.stderr
    assert "Traceback" not in result.stderr
    assert list(tmp_path.iterdir()) == []
