# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Printers' files in and out, against their firmware's kinematics."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pkm_twin.errors import ParameterError
from pkm_twin.robot.printers import read_printer
from test.commands.conftest import REPOSITORY
from test.identification.partial_cases import Towers
from test.support.command import Commands
from test.support.robots import partly_long

STEP = 40.0 / (200 * 16)
REAL = Towers(
    111.3,
    np.radians([210.6, 329.7, 90.0]),
    np.array([215.2, 214.9, 215.1]),
    np.array([339.2, 339.9, 340.3]),
)
GUESS = Towers(
    112.0,
    np.radians([210.0, 330.0, 90.0]),
    np.full(3, 215.0),
    155.0 + np.full(3, np.sqrt(215.0**2 - 112.0**2)),
)


def contacts(spots: np.ndarray) -> np.ndarray:
    """Carriages below their endstops where the firmware's way down touches the bed, (k, 3)."""
    z = np.zeros(len(spots))
    for _ in range(30):
        travel = GUESS.travel(np.column_stack([spots, z]))
        z -= REAL.nozzle(travel)[:, 2]
    return GUESS.travel(np.column_stack([spots, z]))


def ring(count: int, radius: float) -> np.ndarray:
    turn = 2 * np.pi * np.arange(count) / count + np.radians(30.0)
    return radius * np.stack([np.cos(turn), np.sin(turn)], -1)


SPOTS = np.vstack([[[0.0, 0.0]], ring(6, 70.0), ring(6, 35.0)])


def klipper(distances: int = 0) -> str:
    above = GUESS.ends - np.sqrt(GUESS.arms**2 - GUESS.radius**2)
    lines = ["[printer]", "kinematics: delta", "delta_radius: 1  # replaced below"]
    for k, limb in enumerate("abc"):
        lines += [f"[stepper_{limb}]", f"position_endstop = {above[k]:.6f}"]
        if limb == "a":
            lines += ["rotation_distance: 20", "gear_ratio: 1:2", "microsteps: 16", "arm_length: 215"]
    lines += ["#*# [printer]", f"#*# delta_radius = {GUESS.radius:.6f}", "#*# [delta_calibrate]"]
    for k, travel in enumerate(contacts(SPOTS)):
        steps = ",".join(f"{value / STEP:.3f}" for value in travel)
        lines += [f"#*# height{k} = 0.0", f"#*# height{k}_pos = {steps}"]
    rng = np.random.default_rng(4)
    for k in range(distances):
        ends = GUESS.travel(np.column_stack([rng.uniform(-60, 60, (2, 2)), np.zeros(2)]))
        length = np.linalg.norm(np.subtract(*REAL.nozzle(ends)))
        lines.append(f"#*# distance{k} = {length:.6f}")
        for side, travel in enumerate(ends):
            steps = ",".join(f"{value / STEP:.3f}" for value in travel)
            lines.append(f"#*# distance{k}_pos{side + 1} = {steps}")
    return "\n".join(lines)


def deltas(text: str) -> dict[str, dict[str, float]]:
    """Numbers of a Klipper configuration by section."""
    found: dict[str, dict[str, float]] = {}
    for line in text.splitlines():
        if line.startswith("["):
            section = found.setdefault(line.strip("[]"), {})
        elif ":" in line:
            key, value = line.split(":")
            section[key] = float(value)
    return found


def test_klipper_end_to_end(twin: Commands, tmp_path: Path) -> None:
    """Heights and distances of a printer find its numbers, and its own configuration has them."""
    config, robot, data, out = (tmp_path / n for n in ("p.cfg", "p.yaml", "p.csv", "o.yaml"))
    config.write_text(klipper(distances=8))
    twin.good("printer", config, "--out", robot, "--data", data)
    told = twin.told("calibrate", robot, data, "--measure", "height,distance", "--out", out)
    assert told["scale"]["determined"]
    assert told["measurements"]["height"]["count"] == len(SPOTS)
    assert told["measurements"]["height"]["after"]["rms"] < 2e-6
    found = deltas(twin.good("export", "printer", out, "--firmware", "klipper").out)
    assert found["printer"]["delta_radius"] == pytest.approx(REAL.radius, abs=0.05)
    arms = np.array([found[f"stepper_{k}"]["arm_length"] for k in "abc"])
    angles = np.radians([found[f"stepper_{k}"]["angle"] for k in "abc"])
    np.testing.assert_allclose(arms, REAL.arms, atol=0.1)
    np.testing.assert_allclose(angles, REAL.angles, atol=1e-3)
    # The written printer touches the bed where this one did.
    radius = found["printer"]["delta_radius"]
    above = np.array([found[f"stepper_{k}"]["position_endstop"] for k in "abc"])
    there = Towers(radius, angles, arms, above + np.sqrt(arms**2 - radius**2))
    assert np.abs(there.nozzle(contacts(SPOTS))[:, 2]).max() < 5e-3


def test_heights_alone_leave_the_scale(twin: Commands, tmp_path: Path) -> None:
    config, robot, data, out = (tmp_path / n for n in ("p.cfg", "p.yaml", "p.csv", "o.yaml"))
    config.write_text(klipper())
    twin.good("printer", config, "--out", robot, "--data", data)
    words = ("calibrate", robot, data, "--measure", "height", "--out", out)
    told = twin.told(*words)
    assert told["scale"]["determined"] is False
    numbers = told["parameters"]
    assert not any(numbers[f"geometry.arm_lengths[{k}]"]["observed"] for k in range(3))
    printed = twin.good(*words, "--overwrite").out
    assert "scale is not determined" in " ".join(printed.split())
    assert max(map(len, printed.splitlines())) < 400


def logs() -> dict[str, str]:
    """What the same printer's probing looks like with other firmware."""
    above = GUESS.ends - np.sqrt(GUESS.arms**2 - GUESS.radius**2)
    z = GUESS.nozzle(contacts(SPOTS))
    start = f"M665 L215.000 R112.000 H{above[0]:.4f}"
    order = {"c": 0, "x": 4, "y": 6, "z": 2, "yz": 1, "zx": 3, "xy": 5}
    g33 = " ".join(f"{name}:{z[k, 2]:+.5f}" for name, k in order.items())
    heights = " ".join(f"{value:.5f}" for value in z[:, 2])
    g30 = "\n".join(f"G30 P{k} X{x:.5f} Y{y:.5f} Z-99999" for k, (x, y) in enumerate(SPOTS.tolist()))
    lines = "\n".join(f"X:{x:.4f} Y:{y:.4f} Z:{h:.4f}" for x, y, h in z.tolist())
    return {
        "marlin": f"{start} S80\nM666 X0 Y0 Z0\nG33 Auto Calibrate\n.{g33}\n.c:+0.1 x:+0.2",
        "reprapfirmware": f"{start} B85\nM666 X0 Y0 Z0\n{g30}\n"
        f"G32 bed probe heights: {heights}, mean 0.1, deviation from mean 0.2",
        "smoothieware": f"M665 L215 R112 Z{above[0]:.4f}\nM666 X0 Y0 Z0\nG29.1\n{lines}",
    }


@pytest.mark.parametrize("firmware", ["marlin", "reprapfirmware", "smoothieware"])
def test_probe_tables_of_other_firmware(firmware: str, twin: Commands, tmp_path: Path) -> None:
    """They give the carriages at contact."""
    log, robot, data = (tmp_path / n for n in ("log.txt", "p.yaml", "p.csv"))
    log.write_text(logs()[firmware])
    twin.good("printer", log, "--out", robot, "--data", data, "--probe-radius", "70")
    table = np.genfromtxt(data, delimiter=",", names=True)
    rows = np.array([list(row) for row in table])
    places = REAL.nozzle(-1e3 * rows[:, :3])
    assert len(rows) == (7 if firmware == "marlin" else len(SPOTS))
    assert np.abs(places[:, 2] - 1e3 * rows[:, 3]).max() < 1e-3


def test_a_height_map(twin: Commands, tmp_path: Path) -> None:
    """Rows are from the least y, columns from the least x; a bare 0 was not probed."""
    text = (
        "M665 L215 R112 H155\nM666 X0 Y0 Z0\n"
        "RepRapFirmware height map file v2\n"
        "xmin,xmax,ymin,ymax,radius,xspacing,yspacing,xnum,ynum\n"
        "-40.00,40.00,-40.00,40.00,45.00,40.00,40.00,3,3\n"
        "0, 0.010, 0\n0.020, 0.030, 0.040\n0, 0.050, 0\n"
    )
    (tmp_path / "h.csv").write_text(text)
    twin.good("printer", tmp_path / "h.csv", "--out", tmp_path / "p.yaml", "--data", tmp_path / "p.csv")
    rows = np.genfromtxt(tmp_path / "p.csv", delimiter=",", skip_header=1)
    places = GUESS.nozzle(-1e3 * rows[:, :3])
    expected = [[0, -40, 0.01], [-40, 0, 0.02], [0, 0, 0.03], [40, 0, 0.04], [0, 40, 0.05]]
    np.testing.assert_allclose(places, expected, atol=1e-6)


@pytest.mark.parametrize("firmware", partly_long(["marlin", "reprapfirmware", "klipper"], "marlin"))
def test_configurations_are_read_back(firmware: str, twin: Commands, tmp_path: Path) -> None:
    config, robot, data = (tmp_path / n for n in ("p.cfg", "p.yaml", "p.csv"))
    config.write_text(klipper())
    twin.good("printer", config, "--out", robot, "--data", data)
    text = robot.read_text().replace("arm_lengths: [0.215,", "arm_lengths: [0.2163,")
    robot.write_text(text.replace("{offset: -0.338", "{offset: -0.3391"))
    written = twin.good("export", "printer", robot, "--firmware", firmware).out
    again = tmp_path / "again.yaml"
    if firmware == "klipper":
        full = written + "\n".join(klipper().splitlines()[3:]).replace("position_endstop", "#")
        full = re.sub(r"(?m)^(arm_length: 215)$|^#\*# (\[printer\]|delta_radius.*)$", "", full)
    else:
        full = written + logs()[firmware].split("\n", 2)[2]
    config.write_text(full)
    options = ["--probe-radius", "70", "--firmware", firmware]
    twin.good("printer", config, "--out", again, "--data", data, "--overwrite", *options)
    numbers = [
        np.array(re.findall(r"-?\d+\.\d+", path.read_text().split("geometry:")[1]), float) for path in (robot, again)
    ]
    np.testing.assert_allclose(numbers[1], numbers[0], atol=2e-6)


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("[printer]\nkinematics: delta\n", "delta_radius"),
        ("M665 L215 R112 H155\nM666 X0 Y0 Z0\n", "probe table"),
        ("M665 R112\nX:0 Y:0 Z:0\n", "M665 L"),
    ],
)
def test_what_is_missing_is_named(text: str, field: str, twin: Commands, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(text)
    words = ("printer", tmp_path / "a.txt", "--out", tmp_path / "b.yaml", "--data", tmp_path / "c.csv")
    assert field in twin.refused(*words)
    assert not (tmp_path / "b.yaml").exists()


def test_tables_of_pairs_and_units(twin: Commands, tmp_path: Path) -> None:
    """A distance's other pose in its own columns, or by its row; lengths in mm."""
    robot = tmp_path / "p.yaml"
    config = tmp_path / "p.cfg"
    config.write_text(klipper(distances=6))
    data = tmp_path / "p.csv"
    twin.good("printer", config, "--out", robot, "--data", data)
    results = []
    rows = [line.split(",") for line in data.read_text().splitlines()[1:]]
    joints = [f"stepper_{k}.position" for k in "abc"]
    lines = [",".join([*joints, "to", "height [mm]", "distance [mm]"])]
    for row in rows:
        if row[6]:
            lines.append(",".join([*row[:3], "", row[6], ""]))
        else:
            lines.append(",".join([*row[:3], str(len(lines) + 1), "", str(1e3 * float(row[7]))]))
            lines.append(",".join([*row[3:6], "", "", ""]))
    other = tmp_path / "q.csv"
    other.write_text("\n".join(lines))
    for path in (data, other):
        words = ("calibrate", robot, path, "--measure", "height,distance", "--overwrite")
        results.append(twin.told(*words, "--out", tmp_path / "o.yaml")["parameters"])
    for name, number in results[0].items():
        assert results[1][name]["value"] == pytest.approx(number["value"], abs=1e-6), name


def test_a_plan_is_a_table_to_fill_in(twin: Commands, tmp_path: Path) -> None:
    config, robot, data = (tmp_path / n for n in ("p.cfg", "p.yaml", "p.csv"))
    config.write_text(klipper())
    twin.good("printer", config, "--out", robot, "--data", data)
    plan = tmp_path / "plan.csv"
    words = ("calibrate", robot, data, "--measure", "height", "--plan", plan)
    told = twin.told(*words, "--count", 3)
    assert told["count"] == 3 and len(told["position_deviation_m"]) == 4
    head, *rows = plan.read_text().splitlines()
    assert head.split(",")[-1] == "height" and len(rows) == 3
    # In the data's range: on the bed.
    places = GUESS.nozzle(-1e3 * np.array([row.split(",")[:3] for row in rows], float))
    assert np.abs(places[:, 2]).max() < 2.0
    for what, code in (("distance", 1), ("length", 2)):
        line = ("calibrate", robot, "--measure", what, "--plan", tmp_path / "d.csv")
        twin.refused(*line, code=code)
    twin.refused("calibrate", robot)
    # No calibration follows for drives that share.
    line = ("calibrate", REPOSITORY / "examples/machines/rrr4_planar.yaml", "--measure", "distance")
    line += ("--plan", tmp_path / "d.csv", "--within", "x=0:0.01,y=0:0.01,yaw=0:0.1")
    assert "for calibrations" in twin.refused(*line)


NAMED = {
    "[printer]\nkinematics: rotary_delta\n[stepper_a]\nupper_arm_length: 170": "kinematics",
    "M665 L278 R145\nM666 X0 Y0 Z0\n> G33 Auto Calibrate\n.Height:295 Ex:+0.0\nstd dev:2.6": "G33",
    "M665 L100 R145\nM666 X0 Y0 Z0\nG33\nc:0.1 x:0.1 y:0.2 z:0.1": "M665 L",
    "[printer]\nkinematics: delta\ndelta_radius: 200\n[stepper_a]\narm_length: 150\n"
    "position_endstop: 250": "arm_length",
}


@pytest.mark.parametrize("text", NAMED)
def test_what_is_no_linear_delta_s_is_named(text: str) -> None:
    with pytest.raises(ParameterError) as error:
        read_printer(text, None, 85.0)
    assert error.value.field.endswith(NAMED[text])


@pytest.mark.parametrize("line", ["[", "", "G30", " \t["])
def test_many_lines_are_read_in_linear_time(line: str) -> None:
    """Else this takes minutes."""
    with pytest.raises(ParameterError):
        read_printer(f"{line}\n" * 100_000, None, 85.0)
