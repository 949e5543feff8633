# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute a machine as a MuJoCo tree with loops closed without MuJoCo's soft constraints.

The tree consists of the joints with the most freedoms, the last ones first, so that it differs from
the Pinocchio engine's. Body frames coincide with the base frame at home.

MuJoCo's compiler requires some inertia of every moving body: COMPILER_INERTIA is added to every
body, and removed again from the compiled model.
"""

from __future__ import annotations

from typing import Any, Final
from xml.etree import ElementTree as Xml

import mujoco
import numpy as np

from pkm_twin.certify.description import BASE, Array, Body, Description
from pkm_twin.certify.rows import Frame
from pkm_twin.certify.trees import Steps, Tree

COMPILER_INERTIA: Final = 1e-14
"""Mass (kg) and moments of inertia (kg m2) added to every body for the compiler."""


class MujocoTree(Tree):
    """A machine as a MuJoCo tree with loop constraints.

    :raises UnfitError: the description cannot be read.
    """

    name = "MuJoCo"
    widest = True

    def __init__(self, description: Description) -> None:
        self._root = Xml.Element("mujoco")
        Xml.SubElement(self._root, "compiler", angle="radian", inertiafromgeom="false")
        self._elements = {BASE: Xml.SubElement(self._root, "worldbody")}
        self._weights: list[tuple[str, float, Array]] = []
        super().__init__(description)

    def add_body(self, name: str, parent: str, at: Array, steps: Steps | None, body: Body) -> None:
        """Add a body to the tree; three rotations are a ball joint."""
        element = Xml.SubElement(self._elements[parent], "body", name=f"body {name}")
        self._elements[name] = element
        moments, axes = np.linalg.eigh(body.inertia)
        # The eigenvectors may form a reflection instead of a rotation.
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, axes.ravel())
        moments = np.maximum(moments, 0.0)
        self._weights.append((str(element.get("name")), body.mass, moments))
        Xml.SubElement(
            element,
            "inertial",
            pos=_format_numbers(body.com),
            quat=_format_numbers(turn),
            mass=repr(float(body.mass + COMPILER_INERTIA)),
            diaginertia=_format_numbers(moments + COMPILER_INERTIA),
        )
        kinds = [("hinge" if turns else "slide", axis) for turns, axis in steps or ()]
        if steps is None:
            Xml.SubElement(element, "freejoint")
        elif [kind for kind, _ in kinds] == ["hinge"] * 3:
            kinds = [("ball", np.zeros(3))]
        for kind, axis in kinds:
            Xml.SubElement(element, "joint", type=kind, pos=_format_numbers(at), axis=_format_numbers(axis))

    def finish(self) -> int:
        """Compile the model."""
        option = Xml.SubElement(self._root, "option", gravity=_format_numbers(self.machine.gravity))
        Xml.SubElement(option, "flag", contact="disable", constraint="disable")
        self._model = mujoco.MjModel.from_xml_string(Xml.tostring(self._root, encoding="unicode"))
        for name, mass, moments in self._weights:
            number = self._model.body(name).id
            self._model.body_mass[number], self._model.body_inertia[number] = mass, moments
        self._data = mujoco.MjData(self._model)
        self._start = self._data.qpos.copy()
        return int(self._model.nv)

    def neutral(self) -> Array:
        """Return the configuration at home."""
        return np.asarray(self._start)

    def set_state(self, full: Array, rates: Array) -> None:
        """Set the tree's configuration and velocities, shape (size,)."""
        self._frames: dict[str, Frame] = {}
        self._data.qpos[:], self._data.qvel[:] = full, rates
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_comVel(self._model, self._data)

    def step_from(self, full: Array, step: Array) -> Array:
        """Return the configuration after a small motion, shape (size,)."""
        result = full.copy()
        mujoco.mj_integratePos(self._model, result, step, 1.0)
        return result

    def frame(self, body: str) -> Frame:
        """Return a body's frame, which coincides with the base frame at home."""
        if body not in self._frames:
            model, data = self._model, self._data
            number = int(model.body(f"body {body}").id)
            place = data.xpos[number].copy()
            columns, change = np.zeros((6, self.size)), np.zeros((6, self.size))
            mujoco.mj_jac(model, data, columns[:3], columns[3:], place, number)
            mujoco.mj_jacDot(model, data, change[:3], change[3:], place, number)
            rotation = data.xmat[number].reshape(3, 3).copy()
            self._frames[body] = Frame(np.zeros(3), place, rotation, columns, columns @ data.qvel, change @ data.qvel)
        return self._frames[body]

    def forces(self, change: Array) -> Array:
        """Compute MuJoCo's inverse dynamics of the tree, shape (size,)."""
        self._data.qacc[:] = change
        result = np.zeros(self.size)
        # mj_inverse would factorise the mass matrix of the tree, which may be singular.
        mujoco.mj_rne(self._model, self._data, 1, result)
        return result


def _format_numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
