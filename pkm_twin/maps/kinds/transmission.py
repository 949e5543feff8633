# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map a linkage as a transmission: its ratio, and the effort and inertia of each joint."""

from __future__ import annotations

import numpy as np

from pkm_twin import transmission
from pkm_twin.codegen.arrays import Array
from pkm_twin.maps.kind import Case, Found, Kind
from pkm_twin.robot.robot import Robot


class Ratio(Kind):
    """Map the ratio of the transmission: how far the actuators move per joint motion."""

    name, what, answer = "ratio", "ratio in the direction of least actuator motion", "lowest"
    question, element, largest = "how strongly does the linkage reduce?", "actuator", False

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return the case, without a unit if joints or coordinates differ in theirs."""
        joints, poses = {*robot.joint_units}, {*robot.pose_units}
        unit = f"{joints.pop()}/{poses.pop()}" if len(joints) == len(poses) == 1 else ""
        return (Case(self.name, self.what, unit, self.answer, self.largest),)

    def elements(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of the actuated joints."""
        return robot.joint_names

    def axes(self, robot: Robot) -> tuple[str, ...]:
        """Return the components of directions, which are unit vectors of pose rates."""
        return tuple(f"d{name}/dt" for name in robot.pose_names)

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the least singular value of dq/dx; ``element``: the actuator that moves most."""
        table = robot.inverse_jacobian(q) * _length_factors(robot.joint_units, robot.size)[:, None]
        table = table / _length_factors(robot.pose_units, robot.size)
        _, values, ways = np.linalg.svd(table)
        direction = ways[..., -1, :]
        moved = np.abs((table @ direction[..., None])[..., 0])
        return Found(values[..., -1], direction, moved.argmax(-1))

    def arrays(self, robot: Robot, poses: Array) -> dict[str, Array]:
        """Return actuator positions, shape (k, n), and ratios, shape (k, n, m)."""
        t = transmission(robot)
        return {"actuator": t.joint_to_actuator(poses).position, "ratio": t.ratio(poses)}


class JointEffort(Ratio):
    """Map the effort of each joint alone that the actuators can apply within their limits."""

    name, what, answer = "joint-effort", "largest effort of {}, others zero", "weakest"
    question, element = "how strong is the joint?", "element"

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return one case per pose coordinate."""
        units = ["N m" if unit == "rad" else "N" for unit in robot.pose_units]
        return _list_joint_cases(self, robot, units)

    def elements(self, robot: Robot) -> tuple[str, ...]:
        """Return no names: several actuators may be at their limits."""
        return ()

    def axes(self, robot: Robot) -> tuple[str, ...]:
        """Return no axes: each joint has its case."""
        return ()

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the largest effort of the case's joint."""
        limits = transmission(robot).effort_limits(robot.forward(q))
        return Found(limits[..., robot.pose_names.index(case.name), 1])

    def arrays(self, robot: Robot, poses: Array) -> dict[str, Array]:
        """Return the arrays of the kind :class:`Ratio`, and the effort limits, shape (k, m, 2)."""
        own = {"effort_limits": transmission(robot).effort_limits(poses)}
        return super().arrays(robot, poses) | own


class JointInertia(JointEffort):
    """Map the inertia that each joint alone feels, rotors included."""

    name, what, answer = "joint-inertia", "inertia of {}, others at rest", "heaviest"
    question, largest = "how heavy does the joint feel?", True

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return one case per pose coordinate."""
        robot.massive()
        units = ["kg m2" if unit == "rad" else "kg" for unit in robot.pose_units]
        return _list_joint_cases(self, robot, units)

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the diagonal entry of the case's joint."""
        k = robot.pose_names.index(case.name)
        return Found(transmission(robot).inertia(robot.forward(q))[..., k, k])

    def arrays(self, robot: Robot, poses: Array) -> dict[str, Array]:
        """Return the arrays of the kind :class:`Ratio`, and the inertias, shape (k, m, m)."""
        return Ratio.arrays(self, robot, poses) | {"inertia": transmission(robot).inertia(poses)}


def _list_joint_cases(kind: Kind, robot: Robot, units: list[str]) -> tuple[Case, ...]:
    return tuple(
        Case(name, kind.what.format(name), unit, kind.answer, kind.largest)
        for name, unit in zip(robot.pose_names, units, strict=True)
    )


def _length_factors(units: tuple[str, ...], size: float) -> Array:
    """Return factors that convert angles to lengths if there are lengths too; else one."""
    return np.array([1.0 if unit == "m" or "m" not in units else size for unit in units])
