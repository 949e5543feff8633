# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""3-PRRU paper: dynamics by virtual work, and dynamic isotropy. It prints no numbers."""

from __future__ import annotations

from typing import Final

import numpy as np

from delta_dynamics import energy_transfer_range, max_driving_force_range, tilted_pose
from pkm_twin import load
from tools.papers.rows import Paper, Row

TEST: Final = "test/validation/test_prru_paper.py::"
LAWS: Final = "test/laws/test_isotropy.py::"
PRRU: Final = "pkm_twin.mechanisms.prru.Prru."
MOTION: Final = "pkm_twin.kinematics.motion.Motion."
LIMB: Final = "pkm_twin.kinematics.limb_pose.LimbPose"
CHAIN: Final = "pkm_twin.kinematics.posed.PoseChain.attach"
TORQUES: Final = "delta_dynamics.torques.virtual_work."
GEOMETRY: Final = (TEST + "test_position",)
LINK: Final = (TEST + "test_upper_link_follows_the_platform",)
VELOCITIES: Final = (TEST + "test_velocity_maps",)
FORCES: Final = (TEST + "test_driving_forces_with_the_links_at_the_sliders",)
INDICES: Final = (TEST + "test_indices_of_isotropy",)
SPHERES: Final = "map prru isotropy --spheres"
TILTS: Final = (0.0, 45.0)
"""Level, and the largest tilt of the paper's images, degrees."""


def _equation(numbers: str, content: str, functions: tuple[str, ...], tests: tuple[str, ...], note: str = "") -> Row:
    """Return the row of equations "a" or "a-b"."""
    first, _, last = numbers.partition("-")
    span = tuple(range(int(first), int(last or first) + 1))
    return Row("equation", span, content, functions, tests, note)


EQUATIONS: Final = (
    _equation("1", "platform's pose by alpha, beta, gamma", (CHAIN,), GEOMETRY),
    _equation("2-3", "lower link's frame at the slider joint", (PRRU + "make_parts",), GEOMETRY),
    _equation(
        "4",
        "upper link's frame",
        (PRRU + "make_parts",),
        (*LINK, TEST + "test_equation_4_is_a_rotation_once_its_entry_is_corrected"),
        "wrong in print: row 1, column 2, -cφ cθ cψ - sφ cψ is no entry of a rotation; -cφ cθ **sψ** - sφ cψ is",
    ),
    _equation(
        "5",
        "pose rates, and their 3 x 9 arrangement",
        (),
        FORCES,
        "the arrangement is not needed: accelerations come without Hessians",
    ),
    _equation("6-7", "loop closure; U_i from the platform", (LIMB,), GEOMETRY),
    _equation("8", "U_i from the limb", (LIMB,), GEOMETRY, "entry as in equation 4"),
    _equation("9", "slider heights", (LIMB,), GEOMETRY),
    _equation(
        "10",
        "U_i stays in the limb's plane",
        (LIMB,),
        GEOMETRY,
        "wrong in print: tan of the limb's rotation; of its azimuth φ",
    ),
    _equation(
        "11",
        "parasitic gamma, x, y",
        (LIMB, "pkm_twin.kinematics.programs.solve_pose"),
        (*GEOMETRY, TEST + "test_equation_11_holds_as_it_is_printed"),
    ),
    _equation(
        "12",
        "swing θ of a limb",
        (LIMB,),
        GEOMETRY,
        "wrong in print: acos loses the sign of an inward swing; asin of the horizontal distance",
    ),
    _equation("13-16", "upper link's rotation ψ", (PRRU + "make_parts",), LINK),
    _equation(
        "17",
        "platform-fixed axis in the limb's frame",
        (PRRU + "make_parts",),
        (*LINK, TEST + "test_the_vector_of_equation_17_is_the_tangential_one"),
        "wrong in print: radial vector (-r c, -r s, 0); tangential (-r s, r c, 0), as in equation 13",
    ),
    _equation("18", "platform's linear map", (MOTION + "linear_jacobian",), VELOCITIES),
    _equation("19-21", "platform's angular map", (MOTION + "angular_jacobian",), VELOCITIES),
    _equation(
        "22",
        "J_M, platform's velocity map",
        ("pkm_twin.robot.robot.Robot.platform_jacobian", MOTION + "set_rates"),
        VELOCITIES,
    ),
    _equation("23", "platform's acceleration", (MOTION + "set_accelerations",), FORCES),
    _equation("24", "J, Jacobian matrix", ("pkm_twin.robot.robot.Robot.jacobian",), VELOCITIES),
    _equation("25", "sliders' accelerations", ("delta_dynamics.joint_motion",), FORCES),
    _equation(
        "26",
        "links' linear maps",
        (MOTION + "linear_jacobian",),
        FORCES,
        "the paper has both links' mass at the slider joint: `link_com: 0`; the shipped file 0.5",
    ),
    _equation("27-29", "links' angular maps", (MOTION + "angular_jacobian",), VELOCITIES),
    _equation(
        "30",
        "J_Hij, links' velocity maps",
        ("pkm_twin.robot.robot.Robot.body_jacobians", MOTION + "set_rates"),
        VELOCITIES,
    ),
    _equation("31", "links' accelerations", (MOTION + "set_accelerations",), FORCES),
    _equation("32-33", "Q_M of the platform", (TORQUES + "Forces.add_inertia",), FORCES),
    _equation("34-35", "Q_S of the sliders", (TORQUES + "Forces.add_inertia",), FORCES),
    _equation(
        "36-37",
        "Q_Hij of the links",
        (TORQUES + "Forces.add_inertia",),
        FORCES,
        "wrong in print: couple -I a; -I α",
    ),
    _equation("38-39", "virtual power", (TORQUES + "Forces.generalised_forces",), FORCES),
    _equation(
        "40-41",
        "driving forces F_d",
        (
            "delta_dynamics.inverse_dynamics",
            TORQUES + "driving_forces",
            "delta_dynamics.torques.at_pose._write_pose_torques",
        ),
        FORCES,
    ),
    _equation(
        "42-43",
        "E_M and E_all",
        ("delta_dynamics.energy_matrices",),
        INDICES,
        "wrong in print: in the first line of 43 the sum ends before the rotational energy",
    ),
    _equation("44", "eta_KE, energy transfer", ("delta_dynamics.energy_transfer",), INDICES),
    _equation(
        "45",
        "unit vector of the pose rates",
        ("delta_dynamics.torques.isotropy._normalise_directions",),
        INDICES,
    ),
    _equation("46", "eta_KE by the direction", ("delta_dynamics.energy_transfer",), INDICES),
    _equation("47", "F_max", ("delta_dynamics.max_driving_force",), INDICES),
    _equation(
        "48",
        "100 J, no acceleration",
        ("delta_dynamics.max_driving_force",),
        INDICES,
        "`--energy` and Xddot of `max_driving_force`",
    ),
)


def find_rows() -> Paper:
    """Compute what the paper says of its figures, and return its rows."""
    poses = tilted_pose(0.85, np.radians([[60.0], [180.0], [300.0]]), np.radians(TILTS))
    robot = load("prru")
    eta = energy_transfer_range(robot, poses).spread
    force = max_driving_force_range(robot, poses).spread
    images = (
        (
            3,
            "energy",
            "eta_KE on spheres",
            "map_prru_isotropy_spheres_energy.png",
            f"at a tilt of 45 degrees the spheres at 60, 180 and 300 degrees are equal, each "
            f"direction turned with the pose; greatest minus least {eta[0, 1]:.3f}, level "
            f"{eta[0, 0]:.3f}; up to 22 degrees it falls with the masses of the shipped file",
        ),
        (
            4,
            "force",
            "F_max on spheres",
            "map_prru_isotropy_spheres_force.png",
            f"greatest minus least {force[0, 1]:.0f}, {force[1, 1]:.0f} and {force[2, 1]:.0f} N, "
            f"level {force[0, 0]:.0f} N; not quite equal, as zero acceleration is meant in alpha "
            "and beta, which a turn does not keep",
        ),
    )
    statements = (
        TEST + "test_spheres_repeat_every_120_degrees",
        TEST + "test_spheres_become_uneven_with_the_tilt",
    )
    figures = [
        Row(
            "figure",
            (1, 2),
            "machine and coordinates",
            (PRRU + "make_parts",),
            GEOMETRY,
            pictures=("robot_prru.png",),
        ),
        *(
            Row(
                "figure",
                (number,),
                what,
                ("pkm_twin.maps.spheres.find_spheres",),
                statements,
                note,
                pictures=(file,),
                drawn_by={"map_prru_isotropy": SPHERES},
            )
            for number, _, what, file, note in images
        ),
    ]
    return Paper(
        "prru",
        "3-PRRU: dynamics and dynamic isotropy",
        {"equation": 48, "table": 0, "figure": 4},
        (
            "3-PRRU: all 48 equations agree to rounding, seven corrected; the paper prints no "
            "dimensions and no values. Figures 3 and 4 have its symmetry and trend.",
        ),
        (*EQUATIONS, *figures),
    )
