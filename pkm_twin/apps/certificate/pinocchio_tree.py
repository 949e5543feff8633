# SPDX-License-Identifier: Apache-2.0
"""The same machine as a Pinocchio tree with loops cut open.

Another route than the maximal one in every part: a spanning tree of Pinocchio's joints, a rod as a
body of its own on a universal joint, loops as the relative twist of two frames in the inner one's
axes, inertia forces by recursive Newton-Euler, positions by Newton's method in many equal steps.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
import pinocchio as pin

from pkm_twin.apps.certificate.description import (
    BASE,
    Array,
    Body,
    Description,
    Joint,
    Machine,
    Rod,
    UnfitError,
    across,
    cross,
    read,
    with_laws,
)

STEPS: Final = 64
"""Steps from home to a state."""
_LOCAL: Final = pin.ReferenceFrame.LOCAL
_WORLD: Final = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
_COST: Final = {
    "fixed": 0,
    "revolute": 1,
    "prismatic": 1,
    "cylindrical": 2,
    "universal": 2,
    "translation": 3,
    "spherical": 3,
}


class Loop(NamedTuple):
    """A cut joint: frames on both bodies, in base axes at home."""

    joint: Joint
    inner: int
    outer: int


class Motion(NamedTuple):
    """The tree's configuration, rates and accelerations."""

    q: Array
    v: Array
    a: Array


class PinocchioTree:
    """A machine as a tree of Pinocchio's with loop constraints.

    :raises UnfitError: a description that cannot be read, or that is no tree with loops.
    """

    name = "Pinocchio"

    def __init__(self, description: Description) -> None:
        self.machine: Final[Machine] = read(description)
        self.model = pin.Model()
        self.model.gravity.linear = self.machine.gravity
        self._places: dict[str, tuple[int, Array]] = {BASE: (0, np.zeros(3))}
        self._axes: dict[str, list[int]] = {}
        self._cut: list[Joint] = []
        self._ends: list[tuple[int, int]] = []
        self._grow()
        for rod in self.machine.rods:
            self._hang(rod)
        for name, body in self.machine.bodies.items():
            self._load(name, body)
        if self.machine.payload is not None:
            self._load(self.machine.platform, self.machine.payload)
        self._loops = [
            Loop(j, self._frame(j.inner, j.at), self._frame(j.outer, j.at)) for j in self._cut
        ]
        self._tool = self._frame(self.machine.platform, self.machine.origin)
        self.data = self.model.createData()
        self._driven = np.array([self._axes[j.name][0] for j in self.machine.actuated])
        self._others = np.setdiff1d(np.arange(self.model.nv), self._driven)
        self._neutral = pin.neutral(self.model)
        self._assembled: dict[bytes, Array] = {}

    # The tree

    def _grow(self) -> None:
        """A spanning tree from the base outwards: actuated joints first, then fewest freedoms."""
        joints = list(self.machine.joints)
        while len(self._places) <= len(self.machine.bodies):
            edges = [j for j in joints if (j.inner in self._places) != (j.outer in self._places)]
            if edges:
                joint = min(edges, key=lambda j: (not j.actuated, _COST[j.kind]))
                joints.remove(joint)
                self._attach(joint)
            else:
                # Held by rods alone: it hangs free, with what joints carry on from it.
                name = next(
                    name
                    for name in (self.machine.platform, *self.machine.bodies)
                    if name not in self._places
                )
                at = self.machine.bodies[name].com
                free = self.model.addJoint(0, pin.JointModelFreeFlyer(), _shift(at), f"free {name}")
                self._places[name] = (free, at)
        self._cut = joints
        for joint in joints:
            if joint.actuated:
                raise UnfitError(f"joints.{joint.name}: actuated joints close a loop of their own")

    def _attach(self, joint: Joint) -> None:
        back = joint.outer in self._places
        parent, child = (joint.outer, joint.inner) if back else (joint.inner, joint.outer)
        carrier, origin = self._places[parent]
        sign = -1.0 if back else 1.0
        axes = sign * (joint.axes[::-1] if back else joint.axes)
        if joint.kind == "fixed":
            self._places[child] = (carrier, origin)
            return
        models: list[Any]
        if joint.kind == "revolute":
            models = [pin.JointModelRevoluteUnaligned(axes[0])]
        elif joint.kind == "prismatic":
            models = [pin.JointModelPrismaticUnaligned(axes[0])]
        elif joint.kind == "cylindrical":
            models = [
                pin.JointModelPrismaticUnaligned(axes[0]),
                pin.JointModelRevoluteUnaligned(axes[0]),
            ]
        elif joint.kind == "universal":
            models = [pin.JointModelRevoluteUnaligned(axis) for axis in axes]
        elif joint.kind == "translation":
            models = [pin.JointModelTranslation()]
        else:
            models = [pin.JointModelSpherical()]
        offset, places = joint.at - origin, []
        for number, model in enumerate(models):
            name = f"{joint.name}.{number}"
            carrier = self.model.addJoint(carrier, model, _shift(offset), name)
            offset = np.zeros(3)
            places.append(self.model.joints[carrier].idx_v)
        self._places[child] = (carrier, joint.at)
        # Axis by axis as the description counts them; the values count outer against inner.
        self._axes[joint.name] = places[::-1] if back and joint.kind == "universal" else places

    def _hang(self, rod: Rod) -> None:
        """A rod as a body on two revolutes across it, its other end a ball to be closed."""
        carrier, origin = self._places[rod.inner]
        unit = (rod.ends[1] - rod.ends[0]) / rod.length
        offset = rod.ends[0] - origin
        for number, axis in enumerate(across(unit)):
            model = pin.JointModelRevoluteUnaligned(axis)
            carrier = self.model.addJoint(
                carrier, model, _shift(offset), f"rod {rod.name}.{number}"
            )
            offset = np.zeros(3)
        turning = rod.mass * rod.length**2 / 12 * (np.eye(3) - np.outer(unit, unit))
        middle = (rod.ends[1] - rod.ends[0]) / 2
        inertia = pin.Inertia(rod.mass, middle, turning)
        self.model.appendBodyToJoint(carrier, inertia, pin.SE3.Identity())
        far = self._add_frame(carrier, rod.ends[1] - rod.ends[0])
        self._ends.append((far, self._frame(rod.outer, rod.ends[1])))

    def _load(self, name: str, body: Body) -> None:
        carrier, origin = self._places[name]
        if carrier:
            inertia = pin.Inertia(body.mass, body.com - origin, body.inertia)
            self.model.appendBodyToJoint(carrier, inertia, pin.SE3.Identity())

    def _frame(self, body: str, at: Array) -> int:
        carrier, origin = self._places[body]
        return self._add_frame(carrier, at - origin)

    def _add_frame(self, carrier: int, offset: Array) -> int:
        name = f"frame {self.model.nframes}"
        frame = pin.Frame(name, carrier, 0, _shift(offset), pin.FrameType.OP_FRAME)
        return int(self.model.addFrame(frame))

    # Loops

    def _jacobian(self, frame: int, axes: Any) -> Array:
        return np.asarray(pin.getFrameJacobian(self.model, self.data, frame, axes))

    def _relative(self, loop: Loop) -> Array:
        """Twist of the outer frame against the inner one per tree rate, in the inner's axes."""
        between = self.data.oMf[loop.inner].actInv(self.data.oMf[loop.outer])
        moved = between.toActionMatrix() @ self._jacobian(loop.outer, _LOCAL)
        result: Array = moved - self._jacobian(loop.inner, _LOCAL)
        return result

    def _held(self, loop: Loop) -> tuple[Array, Array]:
        """Directions in which a cut joint holds, shape (rows, 6), and how far it stands open."""
        between = self.data.oMf[loop.inner].actInv(self.data.oMf[loop.outer])
        turn, gap = between.rotation, between.translation
        kind, axes = loop.joint.kind, loop.joint.axes
        rows, open_by = [], []
        if kind in ("revolute", "universal", "spherical", "fixed"):
            # The outer frame's own origin: its velocity is that of the twist there.
            for k in range(3):
                rows.append(np.concatenate([np.eye(3)[k], cross(gap, np.eye(3)[k])]))
                open_by.append(gap[k])
        if kind in ("prismatic", "cylindrical"):
            for side in across(axes[0]):
                rows.append(np.concatenate([side, cross(gap, side)]))
                open_by.append(side @ gap)
        if kind in ("revolute", "cylindrical"):
            tilt = cross(axes[0], turn @ axes[0])
            for side in across(axes[0]):
                rows.append(np.concatenate([np.zeros(3), side]))
                open_by.append(side @ tilt)
        if kind in ("prismatic", "fixed", "translation"):
            angle = pin.log3(turn)
            for k in range(3):
                rows.append(np.concatenate([np.zeros(3), np.eye(3)[k]]))
                open_by.append(angle[k])
        if kind == "universal":
            other = turn @ axes[1]
            rows.append(np.concatenate([np.zeros(3), cross(other, axes[0])]))
            open_by.append(axes[0] @ other - axes[0] @ axes[1])
        return np.array(rows), np.array(open_by)

    def _loop_rows(self) -> tuple[Array, Array]:
        """Jacobian of all loops, shape (rows, nv), and how far they stand open; data is up."""
        rows, open_by = [np.zeros((0, self.model.nv))], [np.zeros(0)]
        for loop in self._loops:
            held, gap = self._held(loop)
            rows.append(held @ self._relative(loop))
            open_by.append(gap)
        for far, end in self._ends:
            rows.append((self._jacobian(far, _WORLD) - self._jacobian(end, _WORLD))[:3])
            open_by.append(self.data.oMf[far].translation - self.data.oMf[end].translation)
        return np.vstack(rows), np.concatenate(open_by)

    def _drift(self) -> Array:
        """Second derivative of the loops where the tree's acceleration is zero; data is up."""
        drift = [np.zeros(0)]
        for loop in self._loops:
            drift.append(self._loop_drift(loop))
        for far, end in self._ends:
            drift.append(self._classical(far) - self._classical(end))
        return np.concatenate(drift)

    def _classical(self, frame: int) -> Array:
        motion = pin.getFrameClassicalAcceleration(self.model, self.data, frame, _WORLD)
        result: Array = motion.linear
        return result

    def _twist(self, loop: Loop) -> tuple[Array, Array]:
        """The outer frame's twist against the inner, in the inner's axes, and its change there.

        Both of shape (6,); data has places, rates and accelerations.
        """
        model, data = self.model, self.data
        between = data.oMf[loop.inner].actInv(data.oMf[loop.outer])
        inner = pin.getFrameVelocity(model, data, loop.inner, _LOCAL)
        relative = between.act(pin.getFrameVelocity(model, data, loop.outer, _LOCAL)) - inner
        change = between.act(pin.getFrameAcceleration(model, data, loop.outer, _LOCAL))
        change = change - pin.getFrameAcceleration(model, data, loop.inner, _LOCAL)
        # The outer twist in the inner's axes also changes because these axes turn.
        return relative.vector, (change + relative.cross(inner)).vector

    def _loop_drift(self, loop: Loop) -> Array:
        relative, change = self._twist(loop)
        between = self.data.oMf[loop.inner].actInv(self.data.oMf[loop.outer])
        held, _ = self._held(loop)
        # How the held directions themselves change.
        turning = np.zeros_like(held)
        slide = relative[:3] + cross(relative[3:], between.translation)
        for k, row in enumerate(held):
            turning[k, 3:] = cross(slide, row[:3])
        if loop.joint.kind == "universal":
            other = between.rotation @ loop.joint.axes[1]
            turning[-1, 3:] = cross(cross(relative[3:], other), loop.joint.axes[0])
        result: Array = held @ change + turning @ relative
        return result

    # Positions and rates

    def _place(self, q: Array) -> None:
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)

    def assemble(self, q: Array) -> Array:
        """The tree's configuration at ``q``, shape (n,), reached from home in equal steps.

        :raises UnfitError: Newton's method does not close the loops on the way.
        """
        q = np.asarray(q, dtype=float)
        if q.tobytes() not in self._assembled:
            # One is enough: torques, place and masses are asked for one state after another.
            self._assembled = {q.tobytes(): self._follow(q - self.machine.home)}
        return self._assembled[q.tobytes()]

    def _follow(self, way: Array) -> Array:
        full: Array = self._neutral
        for number in range(1, STEPS + 1):
            ahead = np.zeros(self.model.nv)
            ahead[self._driven] = way / STEPS
            self._place(full)
            rows, _ = self._loop_rows()
            ahead[self._others] = _least(rows[:, self._others], -rows @ ahead)
            full = self._close(pin.integrate(self.model, full, ahead), number)
        return full

    def _close(self, full: Array, number: int) -> Array:
        last = math.inf
        for _ in range(12):
            self._place(full)
            rows, gap = self._loop_rows()
            step = np.zeros(self.model.nv)
            step[self._others] = _least(rows[:, self._others], -gap)
            length = float(np.abs(step).max(initial=0.0))
            if length > min(last / 2, 0.3):
                break
            full, last = pin.integrate(self.model, full, step), length
            if length < 1e-15:
                break
        if last > 1e-12:
            raise UnfitError(f"loops stay open {number} / {STEPS} of the way from home")
        return full

    def _tangent(self) -> Array:
        """Tree rates per actuated rate, shape (nv, n); data is up."""
        rows, _ = self._loop_rows()
        tangent = np.zeros((self.model.nv, len(self._driven)))
        tangent[self._driven, np.arange(len(self._driven))] = 1.0
        tangent[self._others] = _least(rows[:, self._others], -rows @ tangent)
        return tangent

    def motion(self, q: Array, qd: Array, qdd: Array) -> tuple[Motion, Array]:
        """The whole tree's motion, and the tree's rates per actuated rate, shape (nv, n)."""
        full = self.assemble(q)
        self._place(full)
        tangent = self._tangent()
        rows, _ = self._loop_rows()
        v = tangent @ qd
        pin.forwardKinematics(self.model, self.data, full, v, np.zeros(self.model.nv))
        pin.updateFramePlacements(self.model, self.data)
        a = tangent @ qdd
        a[self._others] -= _least(rows[:, self._others], self._drift())
        return Motion(full, v, a), tangent

    # What is asked for

    def platform(self, q: Array) -> tuple[Array, Array]:
        """Position of the reference point, shape (3,), m, and rotation from home, (3, 3)."""
        self._place(self.assemble(q))
        place = self.data.oMf[self._tool]
        return place.translation.copy(), place.rotation.copy()

    def jacobian(self, q: Array) -> Array:
        """The platform's twist at its reference point per joint rate, shape (6, n)."""
        self._place(self.assemble(q))
        return self._jacobian(self._tool, _WORLD) @ self._tangent()

    def inverse_dynamics(
        self, q: Array, qd: Array, qdd: Array, wrench: Array | None = None
    ) -> Array:
        """Efforts of the actuated joints, shape (n,), N m or N; arguments as in maximal.py."""
        qd, qdd = np.asarray(qd, dtype=float), np.asarray(qdd, dtype=float)
        motion, tangent = self.motion(q, qd, qdd)
        self._place(motion.q)
        tool = self._jacobian(self._tool, _WORLD)
        rubbing = [(joint, self._rate_rows(joint)) for joint in self._rubbing()]
        pin.forwardKinematics(self.model, self.data, *motion)
        pin.updateFramePlacements(self.model, self.data)
        drags = []
        for joint, rows in rubbing:
            own = rows @ motion.v
            drag = joint.viscous * own + joint.coulomb * np.sign(own)
            if joint.rotor_inertia:
                drag = drag + joint.rotor_inertia * self._changes(joint, motion)
            drags.append(rows.T @ drag)
        effort = pin.rnea(self.model, self.data, *motion)
        if wrench is not None:
            effort = effort - tool.T @ np.asarray(wrench, dtype=float)
        for drag in drags:
            effort = effort + drag
        for k, joint in enumerate(self.machine.actuated):
            own = joint.viscous * qd[k] + joint.coulomb * np.sign(qd[k]) + joint.offset
            effort[self._driven[k]] += own + joint.rotor_inertia * qdd[k]
        return with_laws(self.machine.actuated, q, qd, tangent.T @ effort)

    def mass_matrix(self, q: Array) -> Array:
        """Inertia felt at the actuated joints, shape (n, n), kg m2, kg or kg m."""
        full = self.assemble(q)
        self._place(full)
        tangent = self._tangent()
        rates = [(joint, self._rate_rows(joint) @ tangent) for joint in self._rubbing()]
        # Column by column: crba wants a tree numbered depth first.
        still = np.zeros(self.model.nv)
        weight = pin.rnea(self.model, self.data, full, still, still).copy()
        columns = [pin.rnea(self.model, self.data, full, still, t) - weight for t in tangent.T]
        result: Array = np.array(columns) @ tangent
        for joint, rows in rates:
            result += joint.rotor_inertia * rows.T @ rows
        result += np.diag([joint.rotor_inertia for joint in self.machine.actuated])
        return result

    def _rubbing(self) -> list[Joint]:
        """Passive joints with friction or a rotor."""
        return [
            joint
            for joint in self.machine.joints
            if not joint.actuated and (joint.viscous or joint.coulomb or joint.rotor_inertia)
        ]

    def _rate_rows(self, joint: Joint) -> Array:
        """A joint's own rates per tree rate, shape (axes, nv); data is up."""
        if joint.name in self._axes:
            return np.eye(self.model.nv)[self._axes[joint.name]]
        loop = next(loop for loop in self._loops if loop.joint is joint)
        relative = self._relative(loop)
        axis = joint.axes[0] if len(joint.axes) else np.zeros(3)
        if joint.kind == "prismatic":
            return (axis @ relative[:3])[None]
        if joint.kind == "revolute":
            return (axis @ relative[3:])[None]
        if joint.kind == "cylindrical":
            return np.array([axis @ relative[:3], axis @ relative[3:]])
        if joint.kind == "universal":
            between = self.data.oMf[loop.inner].actInv(self.data.oMf[loop.outer])
            axes = np.array([joint.axes[0], between.rotation @ joint.axes[1]]).T
            return _least(axes, relative[3:])
        raise UnfitError(f"joints.{joint.name}: a {joint.kind} joint has no rates of its own")

    def _changes(self, joint: Joint, motion: Motion) -> Array:
        """Change of a joint's own rates, shape (axes,); data has accelerations."""
        if joint.name in self._axes:
            result: Array = motion.a[self._axes[joint.name]]
            return result
        if joint.kind not in ("revolute", "prismatic"):
            raise UnfitError(f"joints.{joint.name}: a rotor on a {joint.kind} joint")
        _, change = self._twist(next(loop for loop in self._loops if loop.joint is joint))
        # Along or about the axis nothing of the other directions' products is left.
        part = change[:3] if joint.kind == "prismatic" else change[3:]
        return np.array([joint.axes[0] @ part])


def _shift(offset: Array) -> Any:
    return pin.SE3(np.eye(3), np.asarray(offset, dtype=float))


def _least(matrix: Array, right: Array) -> Array:
    """The least-squares solution, of least length where it is not the only one."""
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=1e-12)[0], dtype=np.float64)
