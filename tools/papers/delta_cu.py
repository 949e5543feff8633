# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Delta-CU paper: rigid-body dynamics by virtual work, and natural modes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics import inverse_dynamics
from pkm_twin import Robot, load
from pkm_twin.codegen.arrays import Array
from pkm_twin.report import plots
from stiffness_monitor.modes import Modes, modes
from tools.papers.rows import Comparison, Paper, Printed, Row

TEST: Final = "test/validation/test_delta_cu_paper.py::"
REACTIONS_TEST: Final = "test/validation/test_reactions_pinocchio.py::"

HOME_ANGLE: Final = 0.22
"""Arm angle about which the worked example moves, rad; not printed, fitted to tables 2 and 3."""
LOAD: Final = np.array([0.0, 0.0, -25.0, 0.0, 0.0, 0.0])
"""Wrench on the platform in the worked example, N; not printed, fitted to tables 4 to 6."""
SIGNS: Final = np.array([-1.0, 1.0, 1.0])
"""Signs of cos(pi t / 5) of arms I to III; the paper gives the lone minus to arm II."""
RATE: Final = np.pi / 5
PAPER_AXES: Final = np.array([1.0, 1.0, -1.0])
"""The paper's z points from the base to the platform."""
AXES: Final = np.array([[0.5, 0.867, 0.0], [1.0, 0.0, 0.0], [-0.5, 0.865, 0.0]])
"""Directions of the torque vectors in tables 4 to 6."""
DIRECTIONS: Final = np.array([-1.0, 1.0, 1.0])
"""Sign of a positive torque (towards the platform) along these directions."""

TIME: Final = np.arange(6.0)
TABLE_1: Final = {
    "arm_length": "190",
    "arm outer diameter": "40",
    "forearm_length": "390",
    "forearm outer diameter, limbs I and II": "16",
    "density of limbs I and II, arms and forearms": "2000",
    "forearm outer diameter, limb III": "20",
    "density, forearm of limb III": "7870",
    "platform density": "2700",
    "platform_mass": "0.2179",
    "platform_radius": "51",
    "base density": "7870",
    "base_radius": "87",
    "arm_mass": "0.2548",
    "forearm_mass": "0.0771",
}
"""Lengths in mm, masses in kg, densities in kg/m3. The forearm of limb III is 390 mm long too."""
TABLE_2: Final = (
    "0 0 0",
    "-79.2 43.2 92.3",
    "-209 122 49.5",
    "-181 105 -110.8",
    "-69.7 37.8 -86.7",
    "0 0 0",
)
"""Platform velocity at ``TIME``, mm/s, without the zeros that fill every number to two decimals.

The paper has -10.80 for -110.8; -108.0 may be meant too (docs/validation.md).
"""
TABLE_3: Final = (
    "-62.7 29.2 109",
    "-111 67.4 55.4",
    "-101 59.9 -159",
    "126 -75.4 -66.6",
    "83.6 -50.2 71.2",
    "67.6 -23.5 95.6",
)
"""Platform acceleration, mm/s2; the scan has 17.20 for 71.2."""
TABLES_4_TO_6: Final = (
    (
        "3004.216 5209.801 6.485",
        "2956.351 5126.797 6.383",
        "2174.312 3770.301 4.693",
        "243.502 422.272 0.526",
        "-1038.569 -1801.048 -2.242",
        "-1505.380 -2610.575 -3.250",
    ),
    (
        "810.950 0.423 -1.639",
        "415.204 0.216 -0.840",
        "-1150.498 -0.600 2.326",
        "-2705.968 -1.411 5.471",
        "-2124.554 -1.108 4.296",
        "-1924.884 -1.003 3.892",
    ),
    (
        "-258.344 446.919 -0.562",
        "-110.394 190.975 -0.240",
        "661.579 -1144.492 1.439",
        "1498.542 -2592.387 3.259",
        "1230.477 -2128.651 2.676",
        "951.241 -1645.590 2.069",
    ),
)
"""Torque vectors of arms I to III, base axes, N mm."""


def find_motion(time: ArrayLike = TIME, signs: Array = SIGNS, home: float = HOME_ANGLE) -> tuple[Array, Array, Array]:
    """Return the arms' angles, velocities and accelerations of the worked example, shape (k, 3)."""
    phase = RATE * np.asarray(time, float)[:, None]
    cosine, sine = signs * np.cos(phase), signs * np.sin(phase)
    return home + cosine, -RATE * sine, -(RATE**2) * cosine


def find_velocity(robot: Robot, q: Array, qd: Array) -> Array:
    """Return the platform's velocity in the paper's axes, mm/s."""
    velocity: Array = 1e3 * PAPER_AXES * np.einsum("nij,nj->ni", robot.jacobian(q), qd)
    return velocity


def find_acceleration(robot: Robot, q: Array, qd: Array, qdd: Array) -> Array:
    """Return the platform's acceleration in the paper's axes, mm/s2."""
    return 1e3 * PAPER_AXES * robot.pose_acceleration(q, qd, qdd)


def read_numbers(lines: Sequence[str]) -> Array:
    """Return the numbers of a printed table, shape (k, 3)."""
    return np.array([line.split() for line in lines], float)


def find_printed_torques() -> Array:
    """Project tables 4 to 6 on the arms' axes: torques, positive towards the platform, N m."""
    vectors = np.stack([read_numbers(lines) for lines in TABLES_4_TO_6], 1)
    along = np.einsum("kax,ax->ka", vectors, AXES) / np.einsum("ax,ax->a", AXES, AXES)
    torques: Array = 1e-3 * DIRECTIONS * along
    return torques


def find_torque_vectors(robot: Robot, torques: Array) -> Array:
    """Return torques (k, 3) about the arms' axes as vectors (k, arm, 3), N mm."""
    azimuths = robot.geometry.azimuths  # type: ignore[attr-defined]
    # Towards the platform: from the limb's radial direction to the paper's z.
    axes = np.stack((np.sin(azimuths), -np.cos(azimuths), np.zeros(3)), -1)
    vectors: Array = 1e3 * torques[..., None] * axes
    return vectors


def measure_difference(computed: Array, printed: Array) -> tuple[float, float]:
    """Return the root mean square and the largest of the differences."""
    error = computed - printed
    return float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())


@cache
def find_modes(name: str) -> Modes:
    """Return the six lowest modes with all arms at the example's home angle."""
    robot = load(name)
    return modes(robot, robot.forward(np.full(3, HOME_ANGLE)))


@cache
def compare_deltas(acceleration: float, loaded: bool) -> tuple[float, float]:
    """Compare torques of `delta` and `delta_cu` for the same random arm motions.

    Arm angles are within 1 rad of the home angle, as in the example, where both machines have a
    singularity index above 0.1.

    :param acceleration: standard deviation of the arms' accelerations, rad/s2; that of the
        velocities is its root, rad/s.
    :param loaded: with the example's load on the platform.
    :returns: RMS torque of `delta` divided by that of `delta_cu`, and the fraction of the torques
        whose magnitude is larger in `delta`.
    """
    rng = np.random.default_rng(0)
    robots = [load(name) for name in ("delta", "delta_cu")]
    q = rng.uniform(HOME_ANGLE - 1.0, HOME_ANGLE + 1.0, (5000, 3))
    for robot in robots:
        q = q[robot.try_forward(q)[1]]
        q = q[robot.singularity(q) > 0.1]
    qd, qdd = rng.normal(0.0, [[[acceleration**0.5]], [[acceleration]]], (2, *q.shape))
    wrench = LOAD if loaded else None
    delta, delta_cu = (np.abs(inverse_dynamics(robot, q, qd, qdd, wrench)) for robot in robots)
    ratio = np.sqrt(np.mean(delta**2) / np.mean(delta_cu**2))
    return float(ratio), float(np.mean(delta > delta_cu))


def draw_motion(file: Path) -> None:
    """Draw the platform's velocity and acceleration in the example, tables 2 and 3 as dots."""
    robot = load("delta_cu")
    time = np.linspace(0.0, 5.0, 251)
    q, qd, qdd = find_motion(time)
    figure, columns = plots.make_subplots(2, 1)
    curves = (
        (
            find_velocity(robot, q, qd),
            TABLE_2,
            "velocity (mm/s)",
            "Figure 3: how fast is the platform?",
        ),
        (
            find_acceleration(robot, q, qd, qdd),
            TABLE_3,
            "acceleration (mm/s²)",
            "Figure 4: how does it accelerate?",
        ),
    )
    for (ax,), (values, table, unit, title) in zip(columns, curves, strict=True):
        _draw_curves(ax, time, values, read_numbers(table), "xyz")
        plots.label(ax, "time (s)", unit, f"{title} Dots: table")
    plots.save(figure, file)


def draw_torques(file: Path) -> None:
    """Draw the arms' torques in the example, the printed ones as dots."""
    time = np.linspace(0.0, 5.0, 251)
    torques = inverse_dynamics(load("delta_cu"), *find_motion(time), LOAD)
    figure, ((ax,),) = plots.make_subplots(1, 1)
    _draw_curves(ax, time, torques, find_printed_torques(), ("arm I", "arm II", "arm III"))
    question = "Figures 5 to 7: which torque does each arm need? Dots: tables 4 to 6"
    plots.label(ax, "time (s)", "torque (N m)", question)
    plots.save(figure, file)


def _draw_curves(ax: Any, time: Array, values: Array, printed: Array, names: Sequence[str]) -> None:
    for k, name in enumerate(names):
        style = {"color": plots.COLOURS[k], "linestyle": plots.LINE_STYLES[k]}
        ax.plot(time, values[:, k], label=name, **style)
        ax.plot(TIME, printed[:, k], "o", color=plots.COLOURS[k], fillstyle="none")
    ax.legend()


def draw_modes(file: Path, first: int) -> None:
    """Draw three mode shapes from the mode ``first`` on; the machine at rest is grey."""
    found = find_modes("delta_cu")
    names = [name.rpartition(" ")[0] for name in found.nodes]
    lines = {n: np.array([k for k, name in enumerate(names) if name == n]) for n in dict.fromkeys(names) if n}
    ends = [line[-1] for name, line in lines.items() if name.startswith("forearm")]
    # Round the platform, by the corners' azimuths.
    x, y, _ = (found.positions[ends] - found.positions[0]).T
    ring = np.array(ends)[np.argsort(np.arctan2(y, x))]
    lines["platform"] = np.array([*ring, ring[0]])
    figure = plots.pyplot().figure(figsize=(plots.WIDTH, 3.6), layout="constrained")
    for panel, k in enumerate(range(first - 1, first + 2), start=1):
        ax = figure.add_subplot(1, 3, panel, projection="3d")
        shape = found.shapes[k, :, :3]
        moved = found.positions + 0.08 * shape / np.linalg.norm(shape, axis=1).max()
        for name, line in lines.items():
            colour = plots.COLOURS[1 if name == "forearm I" else 0]
            ax.plot(*found.positions[line].T, color="0.7", linewidth=1)
            ax.plot(*moved[line].T, color=colour, linewidth=2)
        ax.set_title(f"mode {k + 1}: {found.frequencies[k]:.1f} Hz")
        ax.set_box_aspect(np.ptp(found.positions, axis=0), zoom=1.35)
        ax.view_init(elev=12, azim=-60)
        ax.set_axis_off()
    question = "delta_cu: which parts move in each mode? Orange: R-C-U forearm; grey: at rest"
    plots.write_title(figure, question, 10)
    plots.save(figure, file)


def find_rows() -> Paper:
    """Compute the paper's tables and return its rows."""
    robot = load("delta_cu")
    q, qd, qdd = find_motion()
    torques = inverse_dynamics(robot, q, qd, qdd, LOAD)
    velocity, acceleration = find_velocity(robot, q, qd), find_acceleration(robot, q, qd, qdd)
    printed = find_printed_torques()
    differences = (
        measure_difference(velocity, read_numbers(TABLE_2))[0],
        measure_difference(acceleration, read_numbers(TABLE_3))[0],
        measure_difference(torques, printed)[0],
        measure_difference(torques, printed)[1],
    )
    still = inverse_dynamics(robot, q, np.zeros(3), np.zeros(3), LOAD)
    ratio, larger = compare_deltas(1.0, True)
    found = find_modes("delta_cu")
    frequencies = ", ".join(f"{f:.1f}" for f in found.frequencies)
    summary = (
        "Delta-CU paper: its equations agree to rounding, but for misprints in 13 to 16. "
        "Tables 2 to 6, with two numbers that were fitted to them: "
        "velocities differ by {:.1f} mm/s rms, accelerations by {:.1f} mm/s², torques by "
        "{:.2f} N m, at most {:.2f}. ".format(*differences)
        + f"Statics alone differ by {measure_difference(still, printed)[0]:.2f} N m: "
        "the tables hardly test dynamics.",
        "Delta-CU paper, not confirmed: torques of a Delta are equal in the paper's example "
        f"(in random motions like it {ratio:.3f} times as large, {100 * larger:.0f} % of them "
        "larger); modes 4 to 6 are in the forearms, not at the elbows.",
    )
    return Paper(
        "delta_cu",
        "Delta-CU: dynamics by virtual work",
        {"equation": 23, "table": 6, "figure": 8},
        summary,
        (
            *_find_equations(),
            *_find_tables(velocity, acceleration, torques),
            *_find_figures(frequencies),
        ),
    )


def _find_equations() -> tuple[Row, ...]:
    motion = "pkm_twin.kinematics.motion.Motion."
    same = (TEST + "test_equations",)
    misprinted = (*same, TEST + "test_equations_13_to_16_are_misprinted")
    balance = (REACTIONS_TEST + "test_every_joint_of_random_machines",)
    errata = "[misprinted](validation.md#delta-cu-dynamics-by-virtual-work)"
    virtual_work = "delta_dynamics.torques.virtual_work."
    return (
        Row(
            "equation",
            (1, 2),
            "closure of a limb, and its derivative",
            (
                "pkm_twin.mechanisms.delta.Delta.make_parts",
                "pkm_twin.kinematics.constraints.distance_equation",
            ),
            same,
            "lost in the scan; equations 3 and 9 show what they are",
        ),
        Row(
            "equation",
            (3,),
            "platform velocity from the arms' velocities",
            ("pkm_twin.robot.robot.Robot.jacobian",),
            (TEST + "test_table_2_velocity", *same),
        ),
        Row(
            "equation",
            (4, 5),
            "derivative of equation 1",
            ("pkm_twin.kinematics.motion.Row",),
            same,
            "lost in the scan, as part of equation 6",
        ),
        Row(
            "equation",
            (6,),
            "platform acceleration",
            ("pkm_twin.robot.robot.Robot.pose_acceleration",),
            (TEST + "test_table_3_acceleration", *same),
            "partly lost in the scan",
        ),
        Row(
            "equation",
            (7, 8),
            "velocities of the centres of arm and forearm",
            (motion + "velocity",),
            same,
        ),
        Row(
            "equation",
            (9,),
            "vector loop of a limb",
            ("pkm_twin.mechanisms.delta.Delta.make_parts",),
            same,
        ),
        Row(
            "equation",
            (10, 11, 12),
            "angular velocity of a forearm",
            (motion + "set_rates",),
            same,
        ),
        Row(
            "equation",
            (13, 14),
            "platform acceleration along a limb",
            (motion + "set_accelerations",),
            misprinted,
            errata,
        ),
        Row(
            "equation",
            (15,),
            "acceleration of a forearm's centre",
            (motion + "acceleration", virtual_work + "Forces.add_rod"),
            misprinted,
            f"{errata}, partly lost in the scan",
        ),
        Row(
            "equation",
            (16,),
            "angular acceleration of a forearm",
            (motion + "set_accelerations", virtual_work + "Forces.add_rod"),
            misprinted,
            errata,
        ),
        Row(
            "equation",
            (17, 18),
            "force and moment balance of an arm, reactions at A and B",
            ("delta_dynamics.reactions",),
            balance,
        ),
        Row(
            "equation",
            (19, 20),
            "force and moment balance of a forearm, reactions at B and C",
            ("delta_dynamics.reactions",),
            balance,
        ),
        Row(
            "equation",
            (21,),
            "force balance of the platform",
            ("delta_dynamics.reactions",),
            balance,
            "the parallelograms' moments are not in the paper",
        ),
        Row(
            "equation",
            (22,),
            "virtual work of all bodies",
            (virtual_work + "Forces",),
            same,
            "partly lost in the scan",
        ),
        Row(
            "equation",
            (23,),
            "torques of the arms",
            (virtual_work + "inverse_dynamics",),
            (TEST + "test_tables_4_to_6_torques", *same),
            "partly lost in the scan",
        ),
    )


def _find_tables(velocity: Array, acceleration: Array, torques: Array) -> tuple[Row, ...]:
    errata = "[digits corrected](validation.md#delta-cu-dynamics-by-virtual-work)"
    rows = [
        Row(
            "table",
            (1,),
            "dimensions, masses, densities",
            ("pkm_twin.load",),
            (TEST + "test_table_1",),
            "all in the robot's file; the base's density has no effect",
        ),
        Row(
            "table",
            (2,),
            "platform velocity",
            (__name__ + ".find_velocity",),
            (TEST + "test_table_2_velocity",),
            f"three significant digits, then zeros; t = 3 s: {errata}",
            (_compare("table 2, velocity", "mm/s", TABLE_2, velocity),),
        ),
        Row(
            "table",
            (3,),
            "platform acceleration",
            (__name__ + ".find_acceleration",),
            (TEST + "test_table_3_acceleration",),
            f"three significant digits, then zeros; t = 4 s: {errata}",
            (_compare("table 3, acceleration", "mm/s²", TABLE_3, acceleration),),
        ),
    ]
    vectors = find_torque_vectors(load("delta_cu"), torques)
    for k, (limb, table) in enumerate(zip(("I", "II", "III"), TABLES_4_TO_6, strict=True)):
        compared = _compare(f"table {4 + k}, torque of arm {limb}", "N mm", table, vectors[:, k])
        rows.append(
            Row(
                "table",
                (4 + k,),
                f"torque of arm {limb}, as a vector",
                ("delta_dynamics.inverse_dynamics",),
                (TEST + "test_tables_4_to_6_torques",),
                "printed to six or seven digits",
                (compared,),
            )
        )
    return tuple(rows)


def _compare(title: str, unit: str, table: Sequence[str], values: Array) -> Comparison:
    values = np.round(values, 6) + 0.0  # no negative zeros
    lines = {
        f"{time:g} s": [Printed(text, v) for text, v in zip(line.split(), row, strict=True)]
        for time, line, row in zip(TIME, table, values.tolist(), strict=True)
    }
    return Comparison(f"Delta-CU, {title}", tuple(f"{a}, {unit}" for a in "xyz"), lines)


def _find_figures(frequencies: str) -> tuple[Row, ...]:
    return (
        Row("figure", (1,), "the mechanism", note="lost in the scan"),
        Row(
            "figure",
            (2,),
            "the virtual prototype",
            ("pkm_twin.view.drawing.draw",),
            note="lost in the scan; here the machine of the robot's file",
            pictures=("robot_delta_cu.png",),
        ),
        Row(
            "figure",
            (3, 4),
            "velocity and acceleration of the platform, by ADAMS",
            (__name__ + ".draw_motion",),
            (TEST + "test_table_2_velocity", TEST + "test_table_3_acceleration"),
            "curves lost in the scan; the paper states that they agree with tables 2 and 3",
            pictures=("delta_cu_motion.png",),
            drawn_by={"delta_cu_motion.png": draw_motion},
        ),
        Row(
            "figure",
            (5, 6, 7),
            "torques of arms I to III, by ADAMS",
            (__name__ + ".draw_torques",),
            (
                TEST + "test_tables_4_to_6_torques",
                TEST + "test_conclusion_1_torques_of_a_delta_are_larger",
            ),
            "curves lost in the scan; the paper states that they agree with tables 4 to 6",
            pictures=("delta_cu_torques.png",),
            drawn_by={"delta_cu_torques.png": draw_torques},
        ),
        Row(
            "figure",
            (8,),
            "six natural modes (orange: the R-C-U forearm)",
            ("stiffness_monitor.modes.modes",),
            (TEST + "test_conclusion_2_mode_shapes",),
            f"frequencies lost in the scan, here {frequencies} Hz. Modes 1 to 3 agree: platform, "
            "forearms and the joints between them. Modes 4 to 6: in print more deformation at the "
            "joints of arm and forearm; here the forearms bend, and these joints, rigid in the "
            "file, hardly move",
            pictures=("delta_cu_modes_1_3.png", "delta_cu_modes_4_6.png"),
            drawn_by={
                "delta_cu_modes_1_3.png": partial(draw_modes, first=1),
                "delta_cu_modes_4_6.png": partial(draw_modes, first=4),
            },
        ),
    )
