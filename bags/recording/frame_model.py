# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Elastic frame of the 2UPR-RPU machine on PyNite: the displacement method.

Each limb is one beam element of PyNite (exact for loads at its ends) whose drive is locked; each
joint is an element of six springs along its own axes, free where its compliance is infinite; the
platform is a single node that the joints reach over rigid offsets. PyNite assembles and solves.
The twin goes the other way: screws of the limbs' constraint forces and Castigliano's theorem.

May import: Pynite, numpy, the standard library.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from Pynite import FEModel3D
from Pynite.Spring3D import Spring3D

Array = NDArray[np.float64]

ELEMENTS: Final = ("1R", "1B", "1U", "2R", "2B", "2U", "3R", "3B", "3U")
"""Elastic elements: limb number, then R joint, bar or U joint."""

_DIRECTIONS: Final = ("FX", "FY", "FZ", "MX", "MY", "MZ")


class FrameSolution(NamedTuple):
    """What a load does to the frame."""

    deflection: Array
    """Translation of the platform's origin and small rotation, fixed axes, shape (6,), m, rad."""
    energies: dict[str, float]
    """Strain energy of each of `ELEMENTS`, J."""


class _JointSpring(Spring3D):  # type: ignore[misc]
    """Six springs at a point between two nodes, each node reached over a rigid offset.

    :param at: the joint's centre, shape (3,), m.
    :param axes: the joint's axes as columns, shape (3, 3).
    :param compliance: three translations, m/N, and three rotations, rad/(N m); infinite: free.
    :param extra: further translational compliance in series, fixed axes, shape (3, 3), m/N.
    """

    def __init__(
        self,
        name: str,
        i_node: Any,
        j_node: Any,
        at: Array,
        axes: Array,
        compliance: Array,
        extra: Array | None = None,
    ) -> None:
        super().__init__(name, i_node, j_node, 1.0)
        self.own_translation = axes @ np.diag(compliance[:3]) @ axes.T
        self.extra = np.zeros((3, 3)) if extra is None else extra
        self.translation = np.linalg.inv(self.own_translation + self.extra)
        self.rotation = axes @ np.diag(1.0 / compliance[3:]) @ axes.T
        self.relative = np.hstack((-_rigid(i_node, at), _rigid(j_node, at)))

    def Ke(self) -> Array:
        """Return the element's stiffness in global axes, shape (12, 12)."""
        stiffness = np.zeros((6, 6))
        stiffness[:3, :3] = self.translation
        stiffness[3:, 3:] = self.rotation
        product: Array = self.relative.T @ stiffness @ self.relative
        return product

    def F(self, combo_name: str = "Combo 1") -> Array:
        """Return the element's end forces in global axes, shape (12, 1)."""
        force: Array = self.Ke() @ np.asarray(self.D(combo_name), dtype=float)
        return force

    def energies(self, combo: str) -> tuple[float, float]:
        """Return the strain energy in the joint's own springs and in the extra compliance, J."""
        moved = self.relative @ _displacement(self.i_node, self.j_node, combo)
        force = self.translation @ moved[:3]
        own = force @ self.own_translation @ force + moved[3:] @ self.rotation @ moved[3:]
        return 0.5 * float(own), 0.5 * float(force @ self.extra @ force)


class UprRpuFrame:
    """Finite-element frame of the 2UPR-RPU machine.

    :param params: the machine's parameters in the YAML schema's shape (geometry, members,
        joints_compliance, element_compliance), SI units.
    """

    def __init__(self, params: Mapping[str, Any]) -> None:
        self.base_radius = float(params["geometry"]["base_radius"])
        self.platform_radius = float(params["geometry"]["platform_radius"])
        members = params["members"]
        self.youngs_modulus = float(members["youngs_modulus"])
        self.shear_modulus = float(members["shear_modulus"])
        self.diameter = np.broadcast_to(np.asarray(members["diameter"], dtype=float), (3,))
        self.shear_factor = float(members.get("shear_factor", 1.0))
        self.joints = {name: np.asarray(values, dtype=float) for name, values in params["joints_compliance"].items()}
        given = params.get("element_compliance") or {}
        self.factors = {name: float(given.get(name, 1.0)) for name in ELEMENTS}

    def placement(self, pose: ArrayLike) -> tuple[Array, Array]:
        """Return the platform's origin, shape (3,), and axes as columns, shape (3, 3).

        :param pose: height z of the platform's origin, m, then the rotations beta about the fixed
            X axis and gamma about the platform's y axis, rad.
        """
        z, beta, gamma = np.asarray(pose, dtype=float)
        cb, sb, cg, sg = math.cos(beta), math.sin(beta), math.cos(gamma), math.sin(gamma)
        axes = np.array([[cg, 0.0, sg], [sb * sg, cb, -sb * cg], [-cb * sg, sb, cb * cg]])
        return np.array([0.0, -z * math.tan(beta), z]), axes

    def corners(self, pose: ArrayLike) -> tuple[Array, Array]:
        """Return the limbs' ends on platform and base, each of shape (3, 3), one row a limb, m."""
        pattern = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        origin, axes = self.placement(pose)
        return origin + self.platform_radius * pattern @ axes.T, self.base_radius * pattern

    def limb_lengths(self, pose: ArrayLike) -> Array:
        """Return the three limbs' lengths, shape (3,), m."""
        upper, lower = self.corners(pose)
        lengths: Array = np.linalg.norm(upper - lower, axis=1)
        return lengths

    def compliance(self, pose: ArrayLike) -> Array:
        """Return the compliance at the platform's origin, fixed axes, shape (6, 6)."""
        model = self._model(pose)
        for column, direction in enumerate(_DIRECTIONS):
            model.add_node_load("o", direction, 1.0, case=f"case {column}")
            model.add_load_combo(f"combo {column}", {f"case {column}": 1.0})
        _solve(model)
        return np.column_stack([_moved(model.nodes["o"], f"combo {column}") for column in range(6)])

    def solve(self, pose: ArrayLike, wrench: ArrayLike) -> FrameSolution:
        """Load the platform at its origin, fixed axes, and return deflection and energies.

        :param wrench: force and moment, shape (6,), N and N m.
        """
        model = self._model(pose)
        for direction, value in zip(_DIRECTIONS, np.asarray(wrench, dtype=float), strict=True):
            model.add_node_load("o", direction, float(value), case="wrench")
        model.add_load_combo("load", {"wrench": 1.0})
        _solve(model)
        energies = dict.fromkeys(ELEMENTS, 0.0)
        for name, joint in model.springs.items():
            own, shear = joint.energies("load")
            energies[name] += own
            energies[f"{name[0]}B"] += shear
        for name, bar in model.members.items():
            moved = _displacement(bar.i_node, bar.j_node, "load")
            energies[name] += 0.5 * float(moved @ np.asarray(bar.Ke(), dtype=float) @ moved)
        return FrameSolution(_moved(model.nodes["o"], "load"), energies)

    def _model(self, pose: ArrayLike) -> Any:
        origin, axes = self.placement(pose)
        upper, lower = self.corners(pose)
        fixed_x, platform_y = np.array([1.0, 0.0, 0.0]), axes[:, 1]
        universal = np.column_stack((fixed_x, platform_y, np.cross(fixed_x, platform_y)))

        model = FEModel3D()
        poisson = self.youngs_modulus / (2.0 * self.shear_modulus) - 1.0
        model.add_node("o", *map(float, origin))
        for limb in range(3):
            number = limb + 1
            diameter = float(self.diameter[limb])
            area = math.pi * diameter**2 / 4.0
            second = math.pi * diameter**4 / 64.0
            bar = upper[limb] - lower[limb]
            length = float(np.linalg.norm(bar))
            along = bar / length
            base, foot, head = f"base {number}", f"foot {number}", f"head {number}"
            for name, point in ((base, lower[limb]), (foot, lower[limb]), (head, upper[limb])):
                model.add_node(name, *map(float, point))
            model.def_support(base, True, True, True, True, True, True)
            model.add_section(f"round {number}", area, second, second, 2.0 * second)
            softer = self.factors[f"{number}B"]
            moduli = self.youngs_modulus / softer, self.shear_modulus / softer
            model.add_material(f"bar {number}", *moduli, poisson, 0.0)
            model.add_member(f"{number}B", foot, head, f"bar {number}", f"round {number}")
            # PyNite's beams do not shear. Under loads at the ends alone the shear force is the
            # same all along, so its displacement can stand in series with the bar's foot.
            shear = self.shear_factor * length / (moduli[1] * area)
            sheared = shear * (np.eye(3) - np.outer(along, along))
            if limb < 2:
                down = -along
                revolute = np.column_stack((np.cross(platform_y, down), platform_y, down))
                foot_joint = (f"{number}U", universal, self.joints["upr_universal"])
                head_joint = (f"{number}R", revolute, self.joints["upr_revolute"])
            else:
                down = -along
                revolute = np.column_stack((fixed_x, np.cross(down, fixed_x), down))
                foot_joint = (f"{number}R", revolute, self.joints["rpu_revolute"])
                head_joint = (f"{number}U", universal, self.joints["rpu_universal"])
            for (name, frame, values), i_node, j_node, point, extra in (
                (foot_joint, base, foot, lower[limb], sheared),
                (head_joint, head, "o", upper[limb], None),
            ):
                model.springs[name] = _JointSpring(
                    name,
                    model.nodes[i_node],
                    model.nodes[j_node],
                    point,
                    frame,
                    self.factors[name] * values,
                    extra,
                )
        return model


def _solve(model: Any) -> None:
    model.analyze_linear(check_stability=False, sparse=False)


def _rigid(node: Any, at: Array) -> Array:
    """Return the map from a node's six displacements to those of a point fixed to it."""
    x, y, z = at - np.array([node.X, node.Y, node.Z])
    lever = np.eye(6)
    lever[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return lever


def _moved(node: Any, combo: str) -> Array:
    return np.array([float(getattr(node, name)[combo]) for name in ("DX", "DY", "DZ", "RX", "RY", "RZ")])


def _displacement(i_node: Any, j_node: Any, combo: str) -> Array:
    return np.concatenate((_moved(i_node, combo), _moved(j_node, combo)))
