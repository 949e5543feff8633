# SPDX-License-Identifier: Apache-2.0
"""The assembly of a tree with loop closures that is nearest to the zeros of its joints.

Every joint is a row of single steps, along or about one axis each; a closure compares two frames.
Only numbers, once a file: speed is no concern here.

May import: numpy, the URDF file's parts.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.machine.rotations import about
from pkm_twin.machine.urdf_file import Joint, Urdf
from pkm_twin.machine.urdf_loops import Closure
from pkm_twin.machine.urdf_xml import Pose

Array = NDArray[np.float64]

ROUNDS: Final = 200
"""Corrections of one closing, and steps towards the zeros."""
SLOW: Final = 10
"""Corrections in a row that gain less than 2 %: a minimum that is not zero."""
STEP: Final = 0.5
"""Largest change of a joint in one correction, rad or m."""
RANK: Final = 1e-8
"""Singular values below this share of the greatest are none."""
EXACT: Final = 1e-9
"""Loops that miss by less are closed for all purposes, m or rad."""
CLOSED: Final = 1e-5
"""A loop that misses by more is open, m or rad; exporters write six digits."""
NEARBY: Final = 0.02
"""How far away from home what is free in general is told from what is free there alone, rad, m."""

SPIN: Final = 0.05
"""A part whose centre of mass moves less than this share of the machine a radian only spins."""


class Assembly:
    """The tree of a URDF, placed by its joint values, with its closures' residuals.

    ``steps``: the joint of each single step, in the order of the values.
    """

    def __init__(self, urdf: Urdf) -> None:
        self.urdf = urdf
        self.order = _order(urdf)
        self.steps: list[str] = []
        self._kinds: list[str] = []
        self._axes: list[Array] = []
        self._first: dict[str, int] = {}
        self._moved: dict[str, list[int]] = {urdf.root: []}
        for joint in self.order:
            self._first[joint.name] = len(self.steps)
            for kind, axis in _steps(joint):
                self.steps.append(joint.name)
                self._kinds.append(kind)
                self._axes.append(axis)
            own = list(range(self._first[joint.name], len(self.steps)))
            self._moved[joint.child] = self._moved[joint.parent] + own
        self.links: dict[str, Pose] = {}
        self.axes: list[Array] = []
        """The steps' axes at the placed values, root axes, a unit vector (3,) each."""
        self._points: list[Array] = []

    def place(self, values: Array) -> None:
        """Set ``links`` (poses in the root) and ``axes`` for the steps' values, shape (count,)."""
        self.links = {self.urdf.root: Pose()}
        self.axes, self._points = [], []
        for joint in self.order:
            pose = self.links[joint.parent] @ joint.origin
            start = self._first[joint.name]
            for i in range(start, start + len(_steps(joint))):
                axis = self._axes[i]
                self.axes.append(pose.rotation @ axis)
                self._points.append(pose.position)
                if self._kinds[i] == "R":
                    pose = pose @ Pose(rotation=about(axis, values[i]))
                else:
                    pose = pose @ Pose(position=axis * values[i])
            self.links[joint.child] = pose

    def frame(self, closure: Closure, end: int) -> Pose:
        """A closure's frame on one of its links, in the root."""
        return self.links[closure.links[end]] @ closure.frames[end]

    def twist(self, link: str, point: Array) -> tuple[Array, Array]:
        """Velocity of a link's point and its angular velocity per step's rate, (3, count) each."""
        linear, angular = np.zeros((2, 3, len(self.steps)))
        for i in self._moved[link]:
            if self._kinds[i] == "R":
                linear[:, i] = np.cross(self.axes[i], point - self._points[i])
                angular[:, i] = self.axes[i]
            else:
                linear[:, i] = self.axes[i]
        return linear, angular

    def residual(self, closure: Closure) -> tuple[Array, Array]:
        """How far a closure is open, shape (rows,), m and rad, and its rates, (rows, count)."""
        a, b = self.frame(closure, 0), self.frame(closure, 1)
        (va, wa), (vb, wb) = (
            self.twist(link, pose.position)
            for link, pose in zip(closure.links, (a, b), strict=True)
        )
        apart, slip, turn = b.position - a.position, vb - va, wb - wa
        across = np.eye(3)
        if closure.axes is not None:
            first, second = a.rotation @ closure.axes[0], b.rotation @ closure.axes[1]
            across = np.eye(3) - np.outer(first, first)
        rows: list[tuple[Array, Array]] = []
        if closure.type in ("prismatic", "cylindrical"):
            # The line turns with the first link.
            arm = np.cross(wa.T, apart).T
            rows.append((across @ apart, across @ (slip - arm)))
        elif closure.type != "translation":
            rows.append((apart, slip))
        if closure.type in ("fixed", "prismatic", "translation"):
            rows.append((_angle(a.rotation.T, b.rotation), turn))
        elif closure.type in ("revolute", "cylindrical"):
            rows.append((_between(first, second), across @ turn))
        elif closure.type == "universal":
            normal = np.cross(second, first)
            rows.append((np.array([first @ second]), (normal @ turn)[None]))
        return np.concatenate([r for r, _ in rows]), np.vstack([j for _, j in rows])

    def residuals(self) -> tuple[Array, Array]:
        """All closures' rows."""
        rows = [self.residual(closure) for closure in self.urdf.closures]
        if not rows:
            return np.zeros(0), np.zeros((0, len(self.steps)))
        return np.concatenate([r for r, _ in rows]), np.vstack([j for _, j in rows])

    def close(self, values: Array) -> tuple[Array, float]:
        """Values that close the loops by least steps of least norm, and the greatest miss left."""
        self.place(values)
        residual, rates = self.residuals()
        slow = 0
        for _ in range(ROUNDS):
            miss = float(np.linalg.norm(residual))
            if miss < 1e-15 or slow > SLOW:
                break
            step = -np.linalg.lstsq(rates, residual, rcond=RANK)[0]
            step *= min(1.0, STEP / max(float(np.abs(step).max()), 1e-300))
            for _ in range(12):
                self.place(values + step)
                residual, rates = self.residuals()
                less = float(np.linalg.norm(residual))
                if less < miss:
                    break
                step /= 2
            else:
                break
            values = values + step
            slow = slow + 1 if less > 0.98 * miss else 0
        self.place(values)
        residual, _ = self.residuals()
        return values, float(np.abs(residual).max(initial=0.0))

    def nearest(self) -> tuple[Array, float]:
        """The closed values nearest to zero, shape (count,), and how far they still miss.

        :raises ParameterError: a loop that does not close, by how much.
        """
        values = np.zeros(len(self.steps))
        self.place(values)
        miss = float(np.abs(self.residuals()[0]).max(initial=0.0))
        if miss <= EXACT:
            # The file's own numbers, not what a correction of rounding makes of them.
            return values, miss
        values, miss = self.close(values)
        rng = np.random.default_rng(0)
        for spread in (0.05, 0.1, 0.2, 0.4, 0.8) * 2:
            if miss <= CLOSED:
                break
            # Zero may be a place from which no small step helps.
            start = rng.uniform(-spread, spread, len(self.steps))
            other, less = self.close(start)
            if less < miss:
                values, miss = other, less
        self.place(values)
        if miss > CLOSED:
            misses = {c.name: float(np.abs(self.residual(c)[0]).max()) for c in self.urdf.closures}
            worst = max(misses, key=lambda name: misses[name])
            raise ParameterError(
                worst,
                f"open by {misses[worst]:.3g} (m or rad)",
                f"loops that close within {CLOSED:g} from the zeros of the joints",
            )
        for _ in range(ROUNDS):
            _, rates = self.residuals()
            slope = values - np.linalg.lstsq(rates, rates @ values, rcond=RANK)[0]
            if float(np.abs(slope).max(initial=0.0)) < 1e-12:
                break
            size = float(values @ values)
            for share in (1.0, 0.5, 0.25, 0.1, 0.01):
                other, less = self.close(values - share * slope)
                if less <= max(miss, 1e-12) and float(other @ other) < size * (1.0 - 1e-14):
                    values = other
                    break
            else:
                break
            self.place(values)
        self.place(values)
        residual, _ = self.residuals()
        return values, float(np.abs(residual).max(initial=0.0))

    def spins(self, values: Array, held: set[str], platform: str) -> list[str]:
        """Joints that only let a part spin about itself: held, nothing else moves otherwise.

        With the joints ``held`` at rest such a spin moves no platform and hardly a centre of
        mass: a bar between two ball joints, a pin between two hinges of one axis.

        :param values: a closed assembly, shape (count,).
        :returns: as many joints as there are such spins.
        """
        rng = np.random.default_rng(1)
        _, miss = self.close(values + rng.uniform(-NEARBY, NEARBY, len(self.steps)))
        _, rates = self.residuals()
        # What is in no loop hangs loose and is left to be found so.
        loose = [i for i, name in enumerate(self.steps) if name not in held and rates[:, i].any()]
        found: list[str] = []
        if miss <= CLOSED and loose:
            free = _null(rates[:, loose], RANK)
            tool = self.links[platform].position
            turned = np.vstack(self.twist(platform, tool))[:, loose]
            free = free @ _null(turned @ free, RANK, absolute=True)
            size = float(np.linalg.norm(np.ptp([p.position for p in self.links.values()], axis=0)))
            swung = []
            for link in self.urdf.links.values():
                if link.mass > 0.0:
                    pose = self.links[link.name]
                    centre = pose.rotation @ link.com + pose.position
                    swung.append(self.twist(link.name, centre)[0][:, loose])
            spins = free
            if swung:
                spins = free @ _null(np.vstack(swung) @ free, SPIN * size, absolute=True)
            while spins.shape[1]:
                single = [
                    float(np.linalg.norm(row)) if self.steps.count(self.steps[i]) == 1 else 0.0
                    for i, row in zip(loose, spins, strict=True)
                ]
                at = int(np.argmax(np.round(single, 6)))
                if not single[at] > 0.0:
                    break
                found.append(self.steps[loose[at]])
                spins = spins @ _null(spins[at][None], RANK)
        self.place(values)
        return found


def _order(urdf: Urdf) -> list[Joint]:
    """The joints from the root outwards, each level in the file's order."""
    hanging: dict[str, list[Joint]] = {}
    for joint in urdf.joints.values():
        hanging.setdefault(joint.parent, []).append(joint)
    order: list[Joint] = []
    level = [urdf.root]
    while level:
        found = [joint for link in level for joint in hanging.get(link, [])]
        order += found
        level = [joint.child for joint in found]
    return order


def _steps(joint: Joint) -> list[tuple[str, Array]]:
    if joint.type == "spherical":
        return [("R", axis) for axis in np.eye(3)]
    if joint.type == "free":
        return [(kind, axis) for kind in "PR" for axis in np.eye(3)]
    kind = "P" if joint.type == "prismatic" else "R"
    return [(kind, axis) for axis in joint.axes]


def _between(first: Array, second: Array) -> Array:
    """The rotation vector that turns one line into the other; a hinge's axis has no sign."""
    side = float(first @ second)
    normal: Array = np.cross(first, second if side >= 0.0 else -second)
    size = float(np.linalg.norm(normal))
    angle = math.atan2(size, abs(side))
    if size > 1e-12:
        scaled: Array = normal * (angle / size)
        return scaled
    return normal


def _angle(inverse: Array, rotation: Array) -> Array:
    """The rotation vector from one frame to the other, in the axes both are given in."""
    turn = rotation @ inverse
    normal = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    size = float(np.linalg.norm(normal))
    angle = math.atan2(size, float(np.trace(turn)) - 1.0)
    if size > 1e-12:
        scaled: Array = normal * (angle / size)
        return scaled
    if angle < 1.0:
        half: Array = normal / 2
        return half
    # Half a turn: the axis is an eigenvector.
    axis = np.linalg.eigh(turn + turn.T)[1][:, -1]
    turned: Array = axis * angle
    return turned


def _null(matrix: Array, bound: float, absolute: bool = False) -> Array:
    """Columns that span what the matrix maps to (nearly) zero, shape (count, free)."""
    if not matrix.size:
        return np.eye(matrix.shape[1])
    _, values, rows = np.linalg.svd(matrix)
    least = bound if absolute else bound * float(values.max(initial=0.0))
    rank = int(np.count_nonzero(values > max(least, 1e-300)))
    free: Array = rows[rank:].T
    return free
