# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The questions of the documentation, asked of machines of the templates: two commands each.

An answer is judged by a number of its own: another engine, a difference, a machine built anew.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from delta_dynamics import inverse_dynamics
from pkm_twin import Robot
from pkm_twin.certify.maximal import Maximal
from pkm_twin.robot.derivatives import joint_rates
from test.support.command import Commands
from test.support.robots import load, partly_long

MACHINES = {
    "rrr3_planar": ("planar", 0.02, "elbow_x"),
    "agile_eye": ("spherical", 0.15, "middle"),
    "rrr4_planar": ("redundant", 0.02, "elbow_x"),
    "rss6": ("hexapod", 0.02, "reach"),
    "orthoglide": ("translational", 0.02, "leg"),
}
"""What it is, the radius of its circle, m or rad, and the length that a design varies."""


@dataclass
class Asked:
    """A machine, the commands, and a motion that the first question plans."""

    name: str
    twin: Commands
    folder: Path
    table: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.file = f"examples/machines/{self.name}.yaml"
        self.robot: Robot = load(self.file)
        _, self.radius, self.length = MACHINES[self.name]
        self.motion = self.folder / "motion.csv"

    def column(self, what: str) -> Any:
        """Of all actuated joints, shape (samples, n)."""
        return np.stack([self.table[f"{name}.{what}"] for name in self.robot.joint_names], -1)

    def write(self, name: str, columns: dict[str, Any]) -> Path:
        """A table."""
        path = self.folder / name
        rows = np.column_stack(list(columns.values())).tolist()
        path.write_text("\n".join(",".join(map(str, row)) for row in [list(columns), *rows]))
        return path


def how_fast(a: Asked) -> None:
    """A circle, as fast as limits allow: at each moment one is used up, and none exceeded."""
    told = a.twin.told(
        "path",
        a.file,
        "--circle",
        a.radius,
        "--fastest",
        "--rate",
        2000,
        "--out",
        a.motion,
        "--no-picture",
    )
    rows = list(csv.DictReader(a.motion.open()))
    a.table = {key: np.array([float(row[key]) for row in rows]) for key in rows[0] if rows[0][key]}
    assert a.table["time"][-1] == pytest.approx(told["duration_s"], abs=1e-3)
    # The efforts of an engine of its own; of shared ones what they do at the joints that lead.
    robot, description = a.robot, a.robot.parameter_sections()
    lead, by = robot.graph.leading, robot.drive_jacobian(a.column("position"))
    for joint in set(robot.joint_names) - set(robot.graph.leads):
        description["joints"][joint] |= {"actuated": False, "limits": {}}
    engine, done = Maximal(description), a.column("effort")
    for k in range(5, len(rows), len(rows) // 4):
        motion = (a.column(what)[k, lead] for what in ("position", "velocity", "acceleration"))
        right = engine.inverse_dynamics(*motion, np.zeros(6))
        np.testing.assert_allclose(by[k].T @ done[k], right, atol=1e-6 * np.abs(done).max())
    used = np.abs(done) / robot.limits.effort
    assert used.max() < 1.001
    if robot.limits.velocity is not None:
        used = np.hstack([used, np.abs(a.column("velocity")) / robot.limits.velocity])
    assert (used[5:-5].max(1) > 0.9).mean() > 0.9


def which_drive(a: Asked) -> None:
    """Peaks and RMS over time of the motion's own columns."""
    told = a.twin.told("size", a.file, a.motion)["drives"]
    weights = np.gradient(a.table["time"])
    for k, name in enumerate(a.robot.joint_names):
        joint, effort = told[name]["joint"], a.column("effort")[:, k]
        unit = a.robot.effort_units[k].replace(" ", "_")
        assert joint[f"peak_effort_{unit}"] == pytest.approx(np.abs(effort).max(), rel=1e-6)
        rms = np.sqrt((weights * effort**2).sum() / weights.sum())
        assert joint[f"rms_effort_{unit}"] == pytest.approx(rms, rel=1e-2)


def which_bearing(a: Asked) -> None:
    """Loads of every joint, or which components nothing determines."""
    told = a.twin.told("loads", a.file, a.motion, "--no-picture")["joints"]
    assert set(a.robot.joint_names) <= {name.split(" at ")[0] for name in told}
    for one in told.values():
        assert one["undetermined"] or one["force_peak_N"] >= one["force_rms_N"] >= 0.0


def how_strong(a: Asked) -> None:
    """The payload at rest on the path: with it one drive gives its limit."""
    words = ("map", a.file, "payload", "--along", a.motion, "--out", a.folder / "payload.csv")
    com = (0.0, 0.0, 0.0)
    if a.name == "agile_eye":
        # At the centre no drive feels it.
        assert "turns about" in a.twin.refused(*words)
        com = (0.02, 0.0, 0.1)
        words += ("--payload", "1,0.02,0,0.1")
    told = a.twin.told(*words, "--no-picture")["worst"][0]
    loaded = a.robot.changed(payload={"mass": told["value"], "com": com})
    q = loaded.inverse(list(told["pose"].values()))
    drive = a.robot.joint_names.index(told["element"])
    share = np.abs(inverse_dynamics(loaded, q, 0 * q, 0 * q)) / a.robot.limits.effort
    assert share.max() == pytest.approx(share[drive], rel=1e-6) == pytest.approx(1.0, rel=1e-4)


def is_it_good(a: Asked) -> None:
    """The plan as a recording; and with one drive's effort 30 % too great."""
    told = a.twin.told("check", a.motion, "--robot", a.file)
    assert told["verdict"] == "good"
    if a.robot.redundant:
        return
    first = f"{a.robot.joint_names[0]}.effort"
    bad = a.write("bad.csv", a.table | {first: 1.3 * a.table[first]})
    assert a.twin.told("check", bad, "--robot", a.file, code=1)["verdict"] == "bad"


def what_friction(a: Asked) -> None:
    """Friction 1.5 times the file's, found from efforts that the file does not explain."""
    robot, t = a.robot, np.arange(0.0, 8.0, 0.01)
    waves = np.array([[np.sin((k + 2 + j) * t + j) for j in range(2)] for k in range(6)]).sum(1)
    size = [0.3 * a.radius] * len(robot.pose_names)
    pose = robot.home() + waves[: len(size)].T * size
    q = robot.inverse(pose)
    qd = np.gradient(q, t, axis=0, edge_order=2)
    rough = robot.changed(friction={"viscous": 1.5 * robot.friction.viscous, "coulomb": 1.5 * robot.friction.coulomb})
    effort = inverse_dynamics(rough, q, qd, np.gradient(qd, t, axis=0, edge_order=2))
    columns = {"time": t} | {f"{n}.position": q[:, k] for k, n in enumerate(robot.joint_names)}
    columns |= {f"{n}.effort": effort[:, k] for k, n in enumerate(robot.joint_names)}
    table, out = a.write("run.csv", columns), a.folder / "fitted.yaml"
    words = ("fit", a.file, table, "--what", "friction", "--friction", "coulomb", "--no-report")
    if robot.redundant:
        assert "share" in a.twin.refused(*words, "--out", out)
        return
    a.twin.good(*words, "--out", out)
    found = load(out).friction
    np.testing.assert_allclose(found.coulomb, rough.friction.coulomb, rtol=0.1)


def what_dimensions(a: Asked) -> None:
    """The zero of one joint is off by 2 mrad or 0.2 mm, and found."""
    robot, out = a.robot, a.folder / "true.yaml"
    poses = robot.home() + a.radius * np.random.default_rng(2).uniform(-2, 2, (40, len(robot.home())))
    q = robot.inverse(poses)
    off = 2e-3 if robot.joint_units[0] == "rad" else 2e-4
    position, rotation = robot.platform(q)
    columns = {f"{n}.position": q[:, k] - off * (k == 0) for k, n in enumerate(robot.joint_names)}
    columns |= dict(zip("xyz", position.T, strict=True))
    columns |= dict(zip(("qx", "qy", "qz", "qw"), Rotation.from_matrix(rotation).as_quat().T, strict=True))
    words = (
        "calibrate",
        a.file,
        a.write("poses.csv", columns),
        "--only",
        "joint_map",
        "--out",
        out,
    )
    if robot.redundant:
        assert "zeros" in a.twin.refused(*words)
        return
    a.twin.good(*words)
    given = yaml.safe_load(out.read_text())["joint_map"][robot.joint_names[0]]
    assert abs(given["offset"]) == pytest.approx(off, rel=0.02)


def which_length(a: Asked) -> None:
    """The best of a range: no machine of a grid, built anew, needs less effort."""
    path, own = f"parameters.{a.length}", a.robot.number(f"parameters.{a.length}")
    told = a.twin.told(
        "design",
        a.file,
        "--vary",
        f"{path}={0.95 * own}:{1.05 * own}",
        "--path",
        a.motion,
        "--minimise",
        "peak-effort",
        "--starts",
        2,
        "--no-picture",
    )
    pose, rate, change = (
        np.stack([a.table[f"{name}{what}"] for name in a.robot.pose_names], -1)
        for what in ("", ".velocity", ".acceleration")
    )

    def peak(value: float) -> float:
        made = a.robot.with_file_values({path: value})
        q = made.inverse(pose)
        efforts = inverse_dynamics(made, q, *joint_rates(made, q, rate, change))
        return float(np.abs(efforts).max())

    grid = [peak(own * (1.0 + part)) for part in (-0.05, -0.02, 0.0, 0.02, 0.05)]
    assert peak(told["numbers"][path]) <= min(grid) * (1.0 + 1e-6)


def how_exact(a: Asked) -> None:
    """Zeros of the joints by 0.1 mrad or mm: the Jacobian's columns, squared and added."""
    told = a.twin.told("design", a.file, "--tolerance", "joints.*.offset=1e-4", "--path", a.motion)
    q = a.robot.inverse(np.stack([a.table[name] for name in a.robot.pose_names], -1))
    twist = 1e-4 * a.robot.platform_jacobian(q) @ a.robot.drive_jacobian(q)
    squares = (twist**2).sum(-1)
    for key, rows in (("rms_position_m", squares[:, :3]), ("rms_angle_rad", squares[:, 3:])):
        assert told[key] == pytest.approx(np.sqrt(rows.sum(1).mean()), rel=1e-6, abs=1e-11)
    turns = a.name == "agile_eye"
    farthest = squares[:, 3:].sum(1) if turns else squares[:, :3].sum(1)
    worst = [a.table[name][farthest.argmax()] for name in a.robot.pose_names]
    assert list(told["worst_pose"]) == pytest.approx(worst, abs=1e-6)
    shares = [row["share"] for row in told["contributions"].values()]
    assert sum(shares) == pytest.approx(1.0, abs=1e-9)


def how_does_it_move_elsewhere(a: Asked) -> None:
    """As MJCF: MuJoCo reads it, and its bodies weigh what the machine's do."""
    mujoco = pytest.importorskip("mujoco")
    out = a.folder / "machine.xml"
    a.twin.good("export", "mjcf", a.file, "--out", out)
    model = mujoco.MjModel.from_xml_path(str(out))
    graph = a.robot.graph
    mass = sum(b.mass for b in graph.bodies.values()) + sum(r.mass for r in graph.rods.values())
    assert model.body_mass.sum() == pytest.approx(mass, rel=1e-6)


QUESTIONS = (
    how_fast,
    which_drive,
    which_bearing,
    how_strong,
    is_it_good,
    what_friction,
    what_dimensions,
    which_length,
    how_exact,
    how_does_it_move_elsewhere,
)


@pytest.mark.parametrize("name", partly_long(MACHINES, "rrr3_planar"))
def test_ten_questions_have_an_answer(name: str, twin: Commands, tmp_path: Path) -> None:
    asked = Asked(name, twin, tmp_path)
    for question in QUESTIONS:
        question(asked)
