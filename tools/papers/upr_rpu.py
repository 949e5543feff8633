# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""2UPR-RPU paper: stiffness by screw theory and strain energy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from pkm_twin import Robot, load
from pkm_twin.codegen.arrays import Array
from stiffness_monitor import regular_workspace, strain_energy
from test.support.workspaces import even_samples, polar_samples
from tools.papers.rows import Comparison, Paper, Printed, Row

TEST: Final = "test/validation/test_upr_rpu_paper.py::"
LOAD: Final = (30.0, -50.0, -40.0, 10.0, -20.0, 50.0)
"""Load of table 1, N and N m."""
COMPONENTS: Final = ("x, µm", "y, µm", "z, µm", "rx, µrad", "ry, µrad", "rz, µrad")
TABLE_1: Final = {
    "configuration 1": (
        (-0.6, 0.0, 0.0),
        "3.400 -1.062 0.006 0.646 2.671 7.756",
        "3.503 -1.137 0.006 0.701 2.852 8.287",
    ),
    "configuration 2": (
        (-0.6, math.radians(5), math.radians(-3)),
        "3.627 -1.184 -0.119 0.863 2.170 8.459",
        "3.862 -1.265 -0.125 0.911 2.276 8.924",
    ),
}
"""Pose; deflections by theory, and by finite elements."""
ELEMENTS: Final = ("1R", "1B", "1U", "2R", "2B", "2U", "3R", "3B", "3U")
TABLE_2: Final = {
    "P1": ((0.0, 0.0, 1.0, 0.0, 0.0, 0.0), "0.044 0.254 0.146 0.044 0.254 0.146 0.007 0.083 0.023"),
    "P2": (
        (0.8, 0.3, 0.52, 0.0, 0.0, 0.0),
        "1.39e-4 0.036 1.99e-4 9.55e-4 0.122 6.06e-4 0.007 0.825 0.008",
    ),
    "P3": (
        (0.52, 0.3, 0.8, 0.5, 0.7, 0.51),
        "0.002 0.216 0.003 0.004 0.194 0.011 0.007 0.550 0.012",
    ),
}
"""Load, N and N m; global strain-energy factors of the elements."""
HEIGHTS: Final = np.arange(-1.0, -0.24, 0.05)
"""Heights of the circles of the prescribed workspace, m."""
MAXIMA: Final = {"1R": "0.08", "1B": "0.45", "1U": "0.25", "3R": "0.02", "3B": "0.5", "3U": "0.07"}
"""Largest factors under P1 that section 4 states for figure 7."""
FRAME: Final = "stiffness_monitor.frame."
SOLVED: Final = "stiffness_monitor.programs.SymbolicFrame."
UPR_RPU: Final = "pkm_twin.mechanisms.upr_rpu.UprRpu."
LIMBS: Final = "stiffness_monitor.limb_stiffness"
RESPONSE: Final = "stiffness_monitor.platform_response"
ENERGIES: Final = "stiffness_monitor.programs.write_response"
CLOSED: Final = ("test/laws/test_stiffness.py::test_closed_form",)
LIMB: Final = (TEST + "test_limb_stiffness_is_the_papers",)
SHARES: Final = "map upr_rpu strain-energy --elements --regular --at=-0.6,0,0"
LOADS: Final = " ".join(
    f"--wrench {name}={','.join(f'{x:g}' for x in wrench)}" for name, (wrench, _) in TABLE_2.items()
)
SHARES_DRAWN: Final = "map_upr_rpu_shares"
"""Prefix of the names of the pictures of figures 6 to 10."""


def _equation(
    numbers: Sequence[int],
    content: str,
    functions: tuple[str, ...],
    tests: tuple[str, ...],
    note: str = "",
) -> Row:
    return Row("equation", tuple(numbers), content, functions, tests, note)


EQUATIONS: Final = (
    _equation((1, 19), "unit wrenches of a limb", (UPR_RPU + "limb_wrenches",), LIMB),
    _equation((2,), "forces in a bar's section", (FRAME + "deformations",), CLOSED),
    _equation(
        (3, 20),
        "bar compliance C_B",
        (FRAME + "deformations",),
        CLOSED,
        "the effective shear area is not printed: here the whole section, shear factor 1",
    ),
    _equation((4, 9, 14, 26), "strain energies", (SOLVED + "energies",), CLOSED),
    _equation(
        (5, 6, 7, 11, 12, 13, 21, 22, 23, 24),
        "limb wrenches in a joint's axes",
        (FRAME + "Frame._add_joint",),
        CLOSED,
    ),
    _equation((8, 25), "joint compliances", (UPR_RPU + "make_parts",), CLOSED),
    _equation(
        (15,),
        "compliance of the UPR limbs' U joint",
        (UPR_RPU + "make_parts",),
        (TEST + "test_table_1_does_not_hang_on_the_lost_entry",),
        "last entry lost; 3.22e-11 rad/(N m), that of the RPU limb: no digit of table 1 changes "
        "between 1e-11 and 3.22e-11",
    ),
    _equation((10,), "R joint on limb wrenches", (UPR_RPU + "make_parts",), CLOSED),
    _equation((16, 27), "limb compliance C_i", (UPR_RPU + "make_parts", LIMBS), LIMB),
    _equation((17, 28), "limb stiffness K_i", (LIMBS,), LIMB),
    _equation((18,), "deformation of a UPR limb", (LIMBS,), LIMB),
    _equation((29, 31, 32), "deformations, virtual work", (SOLVED + "apply_wrench",), LIMB),
    _equation(
        (30,),
        "balance of the platform, J_i",
        (UPR_RPU + "limb_wrenches",),
        LIMB,
        "z of a pose is not defined: here the Z coordinate of o",
    ),
    _equation((33, 34), "stiffness K", (SOLVED + "factorise", "stiffness_monitor.stiffness"), LIMB),
    _equation((35,), "compliance C", (SOLVED + "factorise", RESPONSE), CLOSED),
    _equation((36,), "amplitudes W_i", ("stiffness_monitor.limbs.LimbStiffness.amplitudes",), LIMB),
    _equation((37,), "total strain energy U", (RESPONSE, ENERGIES), CLOSED),
    _equation((38,), "local strain-energy factors", (RESPONSE, ENERGIES), CLOSED),
    _equation(
        (39,),
        "global strain-energy factors",
        ("pkm_twin.maps.kinds.strain_energy.StrainEnergy.facts",),
        (TEST + "test_table_2_over_the_volume", TEST + "test_table_2_over_points_on_rays"),
        "the integral is over the volume; the sum over N points depends on where they are",
    ),
    _equation(
        (40,),
        "limits",
        ("stiffness_monitor.reachable",),
        (TEST + "test_limits_bound_the_reachable_workspace",),
    ),
)


def _compare(printed: str, values: Array) -> list[Printed]:
    return [Printed(t, float(v)) for t, v in zip(printed.split(), values, strict=True)]


def _find_deflections(robot: Robot) -> tuple[Comparison, Comparison]:
    """Compute table 1, compared with its theory and with its finite elements."""
    theory, elements = {}, {}
    for name, (pose, one, other) in TABLE_1.items():
        found = 1e6 * np.asarray(strain_energy(robot, pose, LOAD).deflection)
        theory[name], elements[name] = _compare(one, found), _compare(other, found)
    return (
        Comparison("2UPR-RPU, table 1, theory", COMPONENTS, theory),
        Comparison("2UPR-RPU, table 1, finite elements", COMPONENTS, elements),
    )


def find_rows() -> Paper:
    """Compute the paper's tables and statements, and return its rows."""
    robot = load("upr_rpu")
    theory, elements = _find_deflections(robot)
    circles = regular_workspace(robot, HEIGHTS)
    means = []
    for where, poses in (
        ("over the volume", even_samples(circles)),
        ("over points on rays from the axis", polar_samples(circles)),
    ):
        lines = {}
        for name, (wrench, printed) in TABLE_2.items():
            factors = strain_energy(robot, poses, wrench).factors
            lines[name] = _compare(printed, factors.mean(axis=0))
        means.append(Comparison(f"2UPR-RPU, table 2, mean {where}", ELEMENTS, lines))
    columns = [ELEMENTS.index(name) for name in MAXIMA]
    vertical = {
        where: strain_energy(robot, even_samples(layers), TABLE_2["P1"][0])
        for where, layers in (
            ("plane z = -600 mm", regular_workspace(robot, [-0.6])),
            ("prescribed workspace", circles),
        )
    }
    maxima = Comparison(
        "2UPR-RPU, maxima stated of figure 7",
        tuple(MAXIMA),
        {
            where: _compare(" ".join(MAXIMA.values()), one.factors.max(axis=0)[columns])
            for where, one in vertical.items()
        },
    )
    # Where limbs 1 and 2 change places, as gamma changes its sign.
    uneven = max(np.abs(one.factors[:, 1] - one.factors[:, 4]).max() for one in vertical.values())
    volume, rays = (one.lines["P1"][2].value for one in means)
    (z, beta, gamma), printed, _ = TABLE_1["configuration 2"]
    round_bars = robot.changed(members={"shear_factor": 1.127})
    own, apart, sheared = (
        1e6 * np.asarray(strain_energy(one, pose, LOAD).deflection)
        for one, pose in (
            (robot, (z, beta, gamma)),
            (robot, (z * math.cos(beta), beta, gamma)),
            (round_bars, (z, beta, gamma)),
        )
    )
    far = 100 * np.abs(apart / np.array(printed.split(), float) - 1).max()
    shear = 100 * np.abs(sheared / own - 1).max()
    solid = [n for line in elements.lines.values() for n in line]
    softer = [100 * (float(n.text) / n.value - 1) for n in solid if len(n.text.strip("-0.")) > 1]
    small = [n for name in ("P2", "P3") for n in means[0].lines[name]]
    loads = max(abs(n.value - float(n.text)) for n in small)
    tables = (
        Row(
            "table",
            (1,),
            "deflections of two poses",
            ("stiffness_monitor.strain_energy",),
            (
                TEST + "test_table_1_theory",
                TEST + "test_table_1_finite_elements_within_the_papers_error",
            ),
            f"with z as the distance of o from O, configuration 2 is off by {far:.1f} %; a round "
            f"bar's shear factor, 1.127, changes it by {shear:.2f} %; printed errors of theory: "
            "at most 7.8 %",
            comparisons=(theory, elements),
        ),
        Row(
            "table",
            (2,),
            "global strain-energy factors",
            ("pkm_twin.maps.kinds.strain_energy.StrainEnergy.facts",),
            (TEST + "test_table_2_over_the_volume", TEST + "test_table_2_over_points_on_rays"),
            f"`pkm-twin {SHARES} {LOADS}` prints the means over the volume",
            comparisons=tuple(means),
        ),
    )
    kind = "pkm_twin.maps.kinds.strain_energy.StrainEnergy."
    even = TEST + "test_distributions_symmetric_about_gamma_zero"
    drawn = SHARES_DRAWN
    figures = (
        Row(
            "figure",
            (1,),
            "machine",
            (UPR_RPU + "make_parts",),
            CLOSED,
            pictures=("robot_upr_rpu.png",),
        ),
        Row(
            "figure",
            (2, 3),
            "free bodies of the limbs",
            (UPR_RPU + "limb_wrenches",),
            LIMB,
            "sketches; the forces in them are equations 1 and 19",
        ),
        Row(
            "figure", (4,), "finite elements, deformed", note="another program's picture; its displacements are table 1"
        ),
        Row(
            "figure",
            (5,),
            "reachable and prescribed workspace",
            ("stiffness_monitor.regular_workspace",),
            (
                TEST + "test_regular_workspace",
                TEST + "test_reachable_symmetric_about_gamma_zero",
            ),
            "symmetric about gamma = 0; the prescribed workspace is the stack of white circles",
            pictures=("map_upr_rpu_workspace_singularity.png",),
            drawn_by={"map_upr_rpu_workspace": "map upr_rpu workspace --at=-0.6,0,0"},
        ),
        Row(
            "figure",
            (6,),
            "strain energy under P1",
            (kind + "found",),
            (even, TEST + "test_stated_maxima_at_z_600"),
            "even in gamma; in the plane z = -600 mm least within 2 degrees of the level pose",
            pictures=(f"{drawn}_P1_energy_slices.png",),
            drawn_by={drawn: f"{SHARES} {LOADS}"},
        ),
        Row(
            "figure",
            (7,),
            "local factors under P1, slices",
            (kind + "figures",),
            (even, TEST + "test_stated_maxima_at_z_600"),
            "limb 2 mirrors limb 1; the paper has each factor even in gamma, here those of limb 3 "
            f"alone are: with gamma's sign 1B changes by up to {uneven:.2f}",
            comparisons=(maxima,),
            pictures=tuple(f"{drawn}_P1_elements_{k}_slices.png" for k in (1, 2, 3)),
        ),
        Row(
            "figure",
            (8,),
            "local factors under P1, plane z = -600 mm",
            (kind + "figures",),
            (TEST + "test_vertical_load_at_home", TEST + "test_stated_maxima_at_z_600"),
            "in the level pose 1U and 2U hold 0.249 each, 1R and 2R 0.073",
            pictures=tuple(f"{drawn}_P1_elements_{k}_plane.png" for k in (1, 2, 3)),
        ),
        Row(
            "figure",
            (9,),
            "three bars under P2",
            (kind + "figures",),
            (TEST + "test_table_2_over_the_volume",),
            pictures=(f"{drawn}_P2_elements_1_slices.png",),
        ),
        Row(
            "figure",
            (10,),
            "three bars under P3",
            (kind + "figures",),
            (TEST + "test_table_2_over_the_volume",),
            pictures=(f"{drawn}_P3_elements_1_slices.png",),
        ),
    )
    return Paper(
        "upr_rpu",
        "2UPR-RPU: stiffness by screws and strain energy",
        {"equation": 40, "table": 2, "figure": 10},
        (
            f"2UPR-RPU, agrees: table 1 within {theory.largest:.0f} units of the last digit; table "
            f"2, P2 and P3, within {loads:.3f} over the volume; figures 5 to 10, but for the "
            "symmetry of one limb's factors.",
            "2UPR-RPU, does not agree: table 2, P1: the mean share of 1U is printed as 0.146; over "
            f"the volume it is {volume:.3f}, over points on rays, dense at the axis, {rays:.3f}. "
            f"The paper's finite elements are {min(softer):.0f} to {max(softer):.0f} % softer.",
        ),
        (*EQUATIONS, *tables, *figures),
    )
