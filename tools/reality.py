# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A part of docs/validation.md: public recordings of real machines. ``make reality``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pkm_twin import Robot, load
from pkm_twin.apps.fit_report import report_drive
from pkm_twin.identification.calibration import HELD_OUT_INTERVAL, Calibration, Errors, calibrate, list_geometric_paths
from pkm_twin.identification.calibration_state import Poses, rotations
from pkm_twin.identification.drives import GRAVITY, drive_friction
from pkm_twin.identification.measurements import read_poses
from pkm_twin.recordings import Dialect, read_table
from pkm_twin.report.terminal import format_report
from test.support.pages import write_section

Array = NDArray[np.float64]

DATA = Path(__file__).parents[1] / "examples/machines/hexapod"
HOME = 0.5743
"""Height of the platform's nodes at home, from which the recording counts z, m."""
SPOOL = 0.011391
"""Effective radius of the leg's spool, m."""
ALONE = "eight numbers a leg, each leg by itself"
PRIOR = 0.01
"""Standard deviation of nodes, m, in the fit a leg as in the calibration."""
BALL, FOOT = "ball", "foot"


def fit_a_leg(robot: Robot, poses: Poses) -> Array:
    """Eight numbers a leg by its own residual: both nodes, zero length and metres a unit.

    Shape (6, 8); nodes known to PRIOR, residuals of equal weight.
    """
    assert poses.rotation is not None
    joints, found = robot.graph.joints, []
    for k in range(6):
        nodes = [joints[f"{FOOT}_{k + 1}"].at, joints[f"{BALL}_{k + 1}"].at - robot.graph.origin]
        own = robot.controller
        start = np.concatenate([*nodes, [-own.offsets[k] / own.factors[k], 1.0 / own.factors[k]]])

        def left(p: Array, k: int = k, start: Array = start, noise: float = 2e-4) -> Array:
            return np.concatenate([leg_residual(p, k, poses) / noise, (p[:6] - start[:6]) / PRIOR])

        found.append(least_squares(left, start, x_scale="jac").x)
    return np.array(found)


def leg_residual(p: Array, k: int, poses: Poses) -> Array:
    """Return the distance of a leg's nodes minus its length by the motor, (poses,), m."""
    assert poses.rotation is not None
    apart = poses.position + poses.rotation @ p[3:6] - p[:3]
    return np.asarray(np.linalg.norm(apart, axis=1) - p[6] - p[7] * poses.joints[:, k])


def leg_poses(legs: Array, poses: Poses) -> Array:
    """Return the distance of measured poses from those of fitted legs, (poses,), m."""
    assert poses.rotation is not None
    away = []
    for row in range(len(poses.joints)):
        turned = rotations().from_matrix(poses.rotation[row])

        def left(v: Array, row: int = row, turned: object = turned) -> Array:
            r = (rotations().from_rotvec(v[3:]) * turned).as_matrix()
            one = Poses(poses.joints[row : row + 1], v[None, :3], r[None])
            return np.concatenate([leg_residual(legs[k], k, one) for k in range(6)])

        fit = least_squares(left, np.append(poses.position[row], np.zeros(3)), x_scale=0.01)
        away.append(np.linalg.norm(fit.x[:3] - poses.position[row]))
    return np.array(away)


def lengths(robot: Robot, found: Calibration, poses: Poses) -> Array:
    """Return leg lengths by the motors minus those of the calibrated machine at measured poses, m."""
    assert poses.rotation is not None
    graph, q = found.robot.graph, found.joint_map.positions(poses.joints)
    out = np.empty_like(q)
    for k in range(6):
        ball = graph.joints[f"{BALL}_{k + 1}"].at - graph.origin
        apart = poses.position + poses.rotation @ ball - graph.joints[f"{FOOT}_{k + 1}"].at
        at_home = graph.joints[f"{BALL}_{k + 1}"].at - graph.joints[f"{FOOT}_{k + 1}"].at
        home = graph.joints[robot.joint_names[k]].home
        out[:, k] = q[:, k] - home - (np.linalg.norm(apart, axis=1) - np.linalg.norm(at_home))
    return out


def recorded(robot: Robot) -> Poses:
    """Read the grid of poses, z from the base."""
    poses = read_poses(DATA / "grid_180x180.csv", robot, Dialect(units={"length": "mm"}))
    return Poses(poses.joints, poses.position + np.array([0.0, 0.0, HOME]), poses.rotation)


def section() -> str:
    """Write the part of the page."""
    robot = load(DATA / "hexapod.yaml")
    poses = recorded(robot)
    count = len(poses.joints)
    paths = list_geometric_paths(robot, robot.controller.positions(poses.joints))
    rows: dict[str, list[list[Errors]]] = {"the file": [], "`calibrate`": [], ALONE: []}
    for k in range(HELD_OUT_INTERVAL):
        # `calibrate` holds out the last of every four poses.
        part = _rolled(poses, HELD_OUT_INTERVAL - 1 - k)
        last = np.arange(count) % HELD_OUT_INTERVAL == HELD_OUT_INTERVAL - 1
        away = leg_poses(fit_a_leg(robot, part.part(~last)), part.part(last))
        found = calibrate(robot, part, paths)
        held = [[a.held_out[k] for a in found.agreements] for k in range(2)]
        held.append([Errors(_rms(away), float(away.max()))])
        for own, errors in zip(rows.values(), held, strict=True):
            own.append(errors)
    table = "\n".join(_row(name, own) for name, own in rows.items())
    halves = _transfer(robot, poses)
    columns = read_table(DATA / "leg_currents.csv")
    drive = drive_friction(GRAVITY * SPOOL * columns["mass_kg"], columns["iq_up_A"], columns["iq_down_A"])
    told = format_report(report_drive(drive))
    return SECTION.format(count=count, table=table, halves=halves, drive=told)


def _rolled(poses: Poses, by: int) -> Poses:
    assert poses.rotation is not None
    return Poses(*(np.roll(one, by, 0) for one in (poses.joints, poses.position, poses.rotation)))


def _row(name: str, errors: list[list[Errors]]) -> str:
    """Write a fit's row: errors of the held-out poses, of positions and perhaps of rotations."""
    each = [one[0].rms for one in errors]
    angles = [one[1].rms for one in errors if len(one) > 1]
    worst = max(one[0].worst for one in errors)
    cells = [f"{1e3 * value:.2f}" for value in (_rms(np.array(each)), worst)]
    cells += [f"{1e3 * _rms(np.array(angles)):.2f}" if angles else ""]
    return f"| {name} | " + " | ".join(cells) + " |"


def _transfer(robot: Robot, poses: Poses) -> str:
    """Calibrated on one half of the grid, leg lengths of the other."""
    left = poses.position[:, 0] < 0.0
    one, other = poses.part(left), poses.part(~left)
    paths = list_geometric_paths(robot, robot.controller.positions(one.joints))
    found = calibrate(robot, one, paths)
    miss = lengths(robot, found, other)
    miss = miss - miss.mean(0)
    return f"{1e3 * _rms(miss):.2f} mm rms, {1e3 * np.abs(miss).max():.2f} mm at worst"


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


SECTION = """## Real machines

No public recording has the motor torques of a whole parallel machine.
`make reality` prints this section from public recordings of Jugglebot, a 6-UPS hexapod with spools
([source](https://github.com/Project-DeepBlue-Juggling/Jugglebot), MIT licence;
[files](../examples/machines/hexapod)).

**Poses**: {count} poses on a grid at one height, by motion capture. Each of four fits leaves out every fourth pose, so that each
pose is left out once. The table has the errors of the poses left out:

| model | RMS, mm | worst, mm | RMS, mrad |
|---|---|---|---|
{table}

The last row is an independent fit with scipy.

After a calibration with the half of the grid at x < 0, the leg lengths of the other half are off by {halves} (one offset per
leg removed). The recording has no other heights, tilts above 2 degrees, loads or days.

**A drive** lifts four weights at one speed; `pkm-twin fit --drive leg_currents.csv --spool-radius 0.011391` prints:

```text
{drive}
```

A constant friction does not explain the data: friction grows with the load. The owner repeated the test with weighed
masses: 0.0564 +- 0.0011 N m/A. Holding currents differ by up to 1.5 A with the direction of approach, so compare a model
with currents of slow motion in both directions.
"""  # noqa: E501


if __name__ == "__main__":
    write_section("reality", section(), Path(sys.argv[1]))
