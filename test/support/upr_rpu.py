# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The strain-energy method of the 2UPR-RPU paper in closed form (equations 1 to 37), on numpy."""

from __future__ import annotations

import numpy as np


def limbs(robot, pose):
    """Of each limb its unit wrenches at o, shape (6, 3), and its elements' compliances on them.

    Wrenches: f1 along the limb, f2 along y through B (UPR) or along X through A (RPU), the couple m
    about tau (equations 1 and 19). Each joint's compliance is that of its own directions, with f1,
    f2 and m projected to its centre (equations 5 to 14, 21 to 25). Elements: R joint, bar, U joint.
    """
    a, b = robot.geometry.platform_radius, robot.geometry.base_radius
    z, beta, gamma = pose
    rho = z / np.cos(beta)
    x, y = np.eye(3)[0], np.array([0.0, np.cos(beta), np.sin(beta)])
    turned = np.kron(np.eye(2), np.column_stack((x, y, np.cross(x, y))))
    m, j = robot.members, robot.joints_compliance
    for i, diameter in enumerate(m.diameter):
        area, second = np.pi * diameter**2 / 4, np.pi * diameter**4 / 64
        if i == 2:
            limb = b * np.cos(beta) - a, -b * np.sin(beta) - rho
        else:
            side = (-1.0, 1.0)[i]
            limb = (
                side * (a * np.cos(gamma) - b),
                rho - side * a * np.sin(gamma),
            )
        size = np.hypot(*limb)
        across, up = limb / size
        if i == 2:
            # The couple's parts along the limb's bending axis and along the limb itself.
            bend, turn, revolute, universal = -across, up, j.rpu_revolute, j.rpu_universal
            wrenches = [[0, across, up, a * up, 0, 0], [1, 0, 0, 0, 0, -a]]
            sideways, about = revolute[0], revolute[4]
            first, last = across**2 * universal[1] + up**2 * universal[2], universal[0]
        else:
            bend, turn, revolute, universal = across, -up, j.upr_revolute, j.upr_universal
            arm = side * a * np.cos(gamma), -side * a * np.sin(gamma)
            wrenches = [
                [across, 0, up, 0, arm[1] * across - arm[0] * up, 0],
                [0, 1, 0, rho, 0, side * b],
            ]
            sideways, about = revolute[1], revolute[3]
            first, last = across**2 * universal[0] + up**2 * universal[2], universal[1]
        stretch, flex = size / (m.youngs_modulus * area), size / (m.youngs_modulus * second)
        slip = size * m.shear_factor / (m.shear_modulus * area)
        twist = size / (m.shear_modulus * 2 * second)
        # Force f2 acts at one end of the limb, the joint R stands at the other: moment -L f2.
        entries = [
            (
                revolute[2],
                sideways + size**2 * about,
                -size * bend * about,
                bend**2 * about + turn**2 * revolute[5],
            ),
            (
                stretch,
                slip + flex * size**2 / 3,
                -0.5 * bend * flex * size,
                bend**2 * flex + turn**2 * twist,
            ),
            (first, last, 0.0, universal[5]),
        ]
        factors = [robot.element_compliance.get(f"{i + 1}{e}", 1.0) for e in "RBU"]
        yield (
            turned @ np.array([*wrenches, [0, 0, 0, 0, 0, 1]]).T,
            [
                f * np.array([[c11, 0, 0], [0, c22, c23], [0, c23, c33]])
                for f, (c11, c22, c23, c33) in zip(factors, entries, strict=True)
            ],
        )


def closed_form(robot, pose, wrench):
    """Compliance, shape (6, 6), and the energies of the nine elements (equations 34 to 38)."""
    found = [(unit, elements, np.linalg.inv(sum(elements))) for unit, elements in limbs(robot, pose)]
    compliance = np.linalg.inv(sum(unit @ stiff @ unit.T for unit, _, stiff in found))
    moved = compliance @ wrench
    loads = [(elements, stiff @ unit.T @ moved) for unit, elements, stiff in found]
    return compliance, np.array([w @ c @ w / 2 for elements, w in loads for c in elements])
