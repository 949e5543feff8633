# SPDX-License-Identifier: Apache-2.0
"""The same machine as a MuJoCo tree, its loops closed without MuJoCo's soft constraints.

The tree is made of the joints that come last and leave most freedom, so it is another one than the
Pinocchio judge's. Points and directions move by MuJoCo's kinematics, their Jacobians and the
Jacobians' derivatives; ``mj_inverse`` gives the tree's forces, which are projected on the actuated
joints by least squares over all loops. Body frames stand in the base's at home.

MuJoCo wants some inertia in whatever moves: TINY is added to every body.
"""

from __future__ import annotations

import math
from typing import Any, Final
from xml.etree import ElementTree as Xml

import mujoco
import numpy as np

from pkm_twin.apps.certificate.description import (
    BASE,
    Array,
    Body,
    Description,
    Joint,
    Rod,
    UnfitError,
    across,
    cross,
    read,
    with_laws,
)
from pkm_twin.apps.certificate.rows import Jet, Moving, Rows

STEPS: Final = 64
"""Steps from home to a state."""
TINY: Final = 1e-14
"""Mass (kg) and moments of inertia (kg m2) that are added to every body."""
_KINDS: Final = {
    "fixed": (),
    "revolute": ("hinge",),
    "prismatic": ("slide",),
    "cylindrical": ("slide", "hinge"),
    "universal": ("hinge", "hinge"),
}
_FREEDOM: Final = {
    "fixed": 0,
    "revolute": 1,
    "prismatic": 1,
    "universal": 2,
    "cylindrical": 2,
    "translation": 3,
    "spherical": 3,
}


class MujocoTree(Moving):
    """A machine as a tree of MuJoCo's with loop constraints.

    :raises UnfitError: a description that cannot be read.
    """

    name = "MuJoCo"

    def __init__(self, description: Description) -> None:
        self.machine = read(description)
        self._cut: list[Joint] = []
        self._model = mujoco.MjModel.from_xml_string(self._document())
        self._data = mujoco.MjData(self._model)
        self.size = int(self._model.nv)
        self._bodies = {
            name: int(self._model.body(f"body {name}").id) for name in self.machine.bodies
        }
        self._ends = {
            rod.name: int(self._model.body(f"rod {rod.name}").id) for rod in self.machine.rods
        }
        self._neutral = self._data.qpos.copy()
        self._assembled: dict[bytes, Array] = {}

    # The tree

    def _document(self) -> str:
        root = Xml.Element("mujoco")
        Xml.SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
        option = Xml.SubElement(root, "option", gravity=_text(self.machine.gravity))
        Xml.SubElement(option, "flag", contact="disable", constraint="disable")
        elements = {BASE: Xml.SubElement(root, "worldbody")}
        joints = list(self.machine.joints)
        while len(elements) <= len(self.machine.bodies):
            edges = [
                (joint.actuated, _FREEDOM[joint.kind], number)
                for number, joint in enumerate(joints)
                if (joint.inner in elements) != (joint.outer in elements)
            ]
            if edges:
                joint = joints.pop(max(edges)[2])
                back = joint.outer in elements
                ends = (joint.outer, joint.inner)
                parent, child = ends if back else ends[::-1]
                elements[child] = self._body(elements[parent], child)
                self._add_joint(elements[child], joint, back)
            else:
                # Held by rods alone: it hangs free.
                child = next(name for name in self.machine.bodies if name not in elements)
                elements[child] = self._body(elements[BASE], child)
                Xml.SubElement(elements[child], "freejoint")
        self._cut = joints
        for rod in self.machine.rods:
            self._add_rod(elements[rod.inner], rod)
        return Xml.tostring(root, encoding="unicode")

    def _body(self, parent: Xml.Element, name: str) -> Xml.Element:
        element = Xml.SubElement(parent, "body", name=f"body {name}")
        body = self.machine.bodies[name]
        if name == self.machine.platform and self.machine.payload is not None:
            body = _joined(body, self.machine.payload)
        _weigh(element, body)
        return element

    def _add_joint(self, element: Xml.Element, joint: Joint, back: bool) -> None:
        sign = -1.0 if back else 1.0
        axes = sign * (joint.axes[::-1] if back else joint.axes)
        steps: list[tuple[str, Array]]
        if joint.kind == "spherical":
            steps = [("ball", np.zeros(3))]
        elif joint.kind == "translation":
            steps = [("slide", axis) for axis in np.eye(3)]
        else:
            kinds = _KINDS[joint.kind]
            steps = list(zip(kinds, np.resize(axes, (len(kinds), 3)), strict=True))
        for kind, axis in steps:
            Xml.SubElement(element, "joint", type=kind, pos=_text(joint.at), axis=_text(axis))

    def _add_rod(self, parent: Xml.Element, rod: Rod) -> None:
        element = Xml.SubElement(parent, "body", name=f"rod {rod.name}")
        unit = (rod.ends[1] - rod.ends[0]) / rod.length
        turning = rod.mass * rod.length**2 / 12 * (np.eye(3) - np.outer(unit, unit))
        _weigh(element, Body(rod.mass, rod.ends.mean(0), turning))
        for axis in across(unit):
            Xml.SubElement(element, "joint", type="hinge", pos=_text(rod.ends[0]), axis=_text(axis))

    # Motion of points and directions

    def _moved(self, body: int, at: Array) -> Jet:
        model, data = self._model, self._data
        point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ at
        columns, change = np.zeros((3, self.size)), np.zeros((3, self.size))
        mujoco.mj_jac(model, data, columns, None, point, body)
        mujoco.mj_jacDot(model, data, change, None, point, body)
        return Jet(point, columns, columns @ data.qvel, change @ data.qvel)

    def point(self, body: str, at: Array) -> Jet:
        """A point fixed in a body, by its place at home (m)."""
        return self.still(at) if body == BASE else self._moved(self._bodies[body], at)

    def spin(self, body: str) -> Jet:
        """A body's angular velocity; as a vector it is nothing, its value is zero."""
        if body == BASE:
            return self.still(np.zeros(3))
        model, data, number = self._model, self._data, self._bodies[body]
        columns, change = np.zeros((3, self.size)), np.zeros((3, self.size))
        mujoco.mj_jac(model, data, None, columns, data.xpos[number], number)
        mujoco.mj_jacDot(model, data, None, change, data.xpos[number], number)
        return Jet(np.zeros(3), columns, columns @ data.qvel, change @ data.qvel)

    def direction(self, body: str, axis: Array) -> Jet:
        """A direction fixed in a body, by its components at home."""
        if body == BASE:
            return self.still(axis)
        value = self._data.xmat[self._bodies[body]].reshape(3, 3) @ axis
        spin = self.spin(body)
        columns = np.array([cross(column, value) for column in spin.columns.T]).T
        rate = cross(spin.rate, value)
        return Jet(value, columns, rate, cross(spin.bias, value) + cross(spin.rate, rate))

    def loops(self) -> list[Joint]:
        """The joints that the tree leaves out."""
        return self._cut

    def rod_rows(self, rod: Rod) -> Rows:
        """A rod's far end stays on its ball."""
        gap = self._moved(self._ends[rod.name], rod.ends[1]).minus(
            self.point(rod.outer, rod.ends[1])
        )
        return Rows(gap.value, gap.columns, gap.bias)

    # Positions and rates

    def _place(self, full: Array, rates: Array | None = None) -> None:
        self._data.qpos[:] = full
        self._data.qvel[:] = 0.0 if rates is None else rates
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_comVel(self._model, self._data)

    def _stepped(self, full: Array, step: Array) -> Array:
        result = full.copy()
        mujoco.mj_integratePos(self._model, result, step, 1.0)
        return result

    def assemble(self, q: Array) -> Array:
        """The tree's configuration at ``q``, shape (n,), reached from home in equal steps.

        :raises UnfitError: Newton's method does not close the loops on the way.
        """
        q = np.asarray(q, dtype=float)
        if q.tobytes() not in self._assembled:
            self._assembled = {q.tobytes(): self._follow(q - self.machine.home)}
        return self._assembled[q.tobytes()]

    def _follow(self, way: Array) -> Array:
        full: Array = self._neutral
        for number in range(1, STEPS + 1):
            self._place(full)
            full = self._stepped(full, self._tangent() @ way / STEPS)
            full = self._close(full, way * number / STEPS, number)
        return full

    def _close(self, full: Array, way: Array, number: int) -> Array:
        last = math.inf
        for _ in range(12):
            self._place(full)
            step = self._solve(-self.closures().value, self.missing(way))
            length = float(np.abs(step).max())
            if length > min(last / 2, 0.3):
                break
            full, last = self._stepped(full, step), length
            if length < 1e-15:
                break
        if last > 1e-12:
            raise UnfitError(f"loops stay open {number} / {STEPS} of the way from home")
        return full

    def _solve(self, closed: Array, driven: Array) -> Array:
        columns = np.vstack([self.closures().columns, self.drives().columns])
        right = np.concatenate([closed, driven])
        return np.asarray(np.linalg.lstsq(columns, right, rcond=1e-12)[0])

    def _tangent(self) -> Array:
        n = len(self.machine.actuated)
        return self._solve(np.zeros((len(self.closures().value), n)), np.eye(n))

    # What is asked for

    def platform(self, q: Array) -> tuple[Array, Array]:
        """Position of the reference point, shape (3,), m, and rotation from home, (3, 3)."""
        self._place(self.assemble(q))
        machine = self.machine
        rotation = self._data.xmat[self._bodies[machine.platform]].reshape(3, 3).copy()
        return self.point(machine.platform, machine.origin).value, rotation

    def jacobian(self, q: Array) -> Array:
        """The platform's twist at its reference point per joint rate, shape (6, n)."""
        self._place(self.assemble(q))
        return self.twist_columns() @ self._tangent()

    def inverse_dynamics(
        self, q: Array, qd: Array, qdd: Array, wrench: Array | None = None
    ) -> Array:
        """Efforts of the actuated joints, shape (n,), N m or N; arguments as in maximal.py."""
        qd, qdd = np.asarray(qd, dtype=float), np.asarray(qdd, dtype=float)
        data, full = self._data, self.assemble(q)
        self._place(full)
        tangent = self._tangent()
        self._place(full, tangent @ qd)
        change = self._solve(-self.closures().bias, qdd - self.drives().bias)
        force = np.zeros(self.size)
        if wrench is not None:
            force -= self.twist_columns().T @ np.asarray(wrench, dtype=float)
        for joint in self.machine.joints:
            if joint.viscous or joint.coulomb or joint.offset or joint.rotor_inertia:
                row = self.rates(joint)
                own = row.columns @ data.qvel
                drag = joint.viscous * own + joint.coulomb * np.sign(own) + joint.offset
                if joint.rotor_inertia:
                    drag = drag + joint.rotor_inertia * (row.columns @ change + row.bias)
                force += row.columns.T @ drag
        data.qacc[:] = change
        mujoco.mj_inverse(self._model, data)
        tau = tangent.T @ (force + data.qfrc_inverse)
        return with_laws(self.machine.actuated, q, qd, tau)

    def mass_matrix(self, q: Array) -> Array:
        """Inertia felt at the actuated joints, shape (n, n), kg m2, kg or kg m."""
        self._place(self.assemble(q))
        tangent = self._tangent()
        # The weight is the effort where nothing moves.
        rows = []
        for acceleration in (np.zeros(self.size), *tangent.T):
            self._data.qacc[:] = acceleration
            mujoco.mj_inverse(self._model, self._data)
            rows.append(self._data.qfrc_inverse.copy())
        result: Array = (np.array(rows[1:]) - rows[0]) @ tangent + self.rotors(tangent)
        return result


def _weigh(element: Xml.Element, body: Body) -> None:
    moments, axes = np.linalg.eigh(body.inertia)
    # eigh may leave a mirror image.
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    turn = np.zeros(4)
    mujoco.mju_mat2Quat(turn, axes.ravel())
    Xml.SubElement(
        element,
        "inertial",
        pos=_text(body.com),
        quat=_text(turn),
        mass=repr(float(body.mass + TINY)),
        diaginertia=_text(np.maximum(moments, 0.0) + TINY),
    )


def _joined(one: Body, other: Body) -> Body:
    """Two rigid bodies as one."""
    mass = one.mass + other.mass
    com = (one.mass * one.com + other.mass * other.com) / mass
    inertia = np.zeros((3, 3))
    for body in (one, other):
        arm = body.com - com
        inertia += body.inertia + body.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Body(mass, com, inertia)


def _text(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
