# SPDX-License-Identifier: Apache-2.0
"""The assembly of a tree with loop closures that is nearest to the drawing.

Every joint is a row of single steps, along or about one axis each, whose values count from the
drawing; a closure compares two frames. Only numbers, once a file: speed is no concern here.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import ParameterError
from pkm_twin.machine.loop_tree import Joint, LoopTree
from pkm_twin.machine.rotations import Pose, skew

ROUNDS: Final = 100
"""Corrections of one closing, and steps towards the zeros."""
SLOW: Final = 10
"""Corrections in a row that gain less than 2 %: a minimum that is not zero."""
STEP: Final = 0.5
"""Largest change of a joint in one correction, rad or m."""
RANKS: Final = (1e-4, 1e-6, 1e-8)
"""Singular values below this share of the greatest are none; where that does not close, less."""
FAR: Final = 1e-2
"""A miss that no choice of directions makes good, m or rad."""
EXACT: Final = 1e-9
"""Loops that miss by less are closed for all purposes, m or rad."""
CLOSED: Final = (1e-5, 1e-4)
"""A loop that misses by more is open, m or rad: at least the one, at most the other."""
ROUNDED: Final = 20.0
"""In between, so many times the file's last digit: a loop is a chain of rounded places."""


class Assembly:
    """The tree of a file, placed by its joint values, with its closures' residuals.

    ``steps``: the joint of each single step, in the order of the values; ``turns``: whether it is a
    turn. ``size``: of the drawing, m.
    """

    def __init__(self, tree: LoopTree) -> None:
        self.tree = tree
        least, most = CLOSED
        self.closed = min(most, max(least, ROUNDED * tree.accuracy))
        """A loop that misses by more is open, m or rad."""
        self._rows = [(hung, hung.joint.freedoms(hung.parent)) for hung in tree.hung]
        self.steps = [hung.joint.name for hung, freedoms in self._rows for _ in freedoms]
        every = [freedom for _, freedoms in self._rows for freedom in freedoms]
        self.turns = np.array([freedom.turns for freedom in every], bool)
        self._slides = np.array([freedom.slide for freedom in every])
        # Rodrigues: 1 + sin K + (1 - cos) K K.
        self._turning = [(k, k @ k) for k in (skew(freedom.axis) for freedom in every)]
        self._moved: dict[str, list[int]] = {tree.root: []}
        count = 0
        for (_, parent, child), freedoms in self._rows:
            before, own = self._moved[parent], list(range(count, count + len(freedoms)))
            self._moved[child] = before + own if own else before
            count += len(own)
        self.moves: dict[str, Pose] = {}
        """Of each link since it was drawn, in the root's axes."""
        self.place(np.zeros(count))
        extent = float(np.ptp(self.places(), axis=0).max(initial=0.0))
        self.size = extent if extent > 1e-6 else 1.0

    def place(self, values: Array) -> None:
        """Set ``values`` of the steps, shape (count,), and ``moves``."""
        self.values = values
        self.moves = {self.tree.root: Pose()}
        sines, lacks = np.sin(values).tolist(), (1.0 - np.cos(values)).tolist()
        axes: list[Array] = []
        points: list[Array] = []
        for (joint, parent, child), freedoms in self._rows:
            pose = self.moves[parent]
            for freedom in freedoms:
                k = len(axes)
                axes.append(pose.rotation @ freedom.axis)
                points.append(pose.point(joint.at))
                turned, at = pose.rotation, points[-1]
                if freedom.slide:
                    at = at + axes[-1] * (values[k] * freedom.slide)
                if freedom.turns:
                    first, second = self._turning[k]
                    turned = turned + turned @ (sines[k] * first + lacks[k] * second)
                pose = Pose(turned, at - turned @ joint.at)
            self.moves[child] = pose
        self._axes, self._points = np.reshape(axes, (-1, 3)), np.reshape(points, (-1, 3))

    def places(self) -> Array:
        """Where the links are, shape (links, 3), m."""
        links = self.tree.links
        return np.array([move.point(links[n].frame.position) for n, move in self.moves.items()])

    def frame(self, joint: Joint, end: int) -> Pose:
        """A joint's frame on one of its links."""
        return self.moves[(joint.inner, joint.outer)[end]] @ joint.frames[end]

    def axes(self, joint: Joint) -> Array:
        """A joint's axes: the first turns with the inner link, the last with the outer one."""
        ends = (self.moves[end].rotation for end in (joint.inner, joint.outer))
        return np.reshape([r @ a for r, a in zip(ends, joint.axes, strict=False)], (-1, 3))

    def twist(self, link: str, point: Array) -> tuple[Array, Array]:
        """Velocity of a link's point and its angular velocity per step's rate, (3, count) each."""
        linear, angular = np.zeros((2, 3, len(self.steps)))
        moved = self._moved[link]
        axes, turns = self._axes[moved].T, self.turns[moved]
        arms = np.cross(self._axes[moved], point - self._points[moved]).T
        linear[:, moved] = np.where(turns, arms, 0.0) + axes * self._slides[moved]
        angular[:, moved] = np.where(turns, axes, 0.0)
        return linear, angular

    def residual(self, closure: Joint, rates: bool = True) -> tuple[Array, Array]:
        """How far a closure is open, shape (rows,), m and rad, and its rates, (rows, count).

        :param rates: without them their count is zero.
        """
        a, b = self.frame(closure, 0), self.frame(closure, 1)
        (va, wa), (vb, wb) = (
            self.twist(link, pose.position) if rates else np.zeros((2, 3, 0))
            for link, pose in ((closure.inner, a), (closure.outer, b))
        )
        apart, slip, turn = b.position - a.position, vb - va, wb - wa
        across = np.eye(3)
        if len(closure.axes):
            first = self.moves[closure.inner].rotation @ closure.axes[0]
            second = self.moves[closure.outer].rotation @ closure.axes[-1]
            across = np.eye(3) - np.outer(first, first)
        rows: list[tuple[Array, Array]] = []
        for held in closure.type.holds:
            if held == "point":
                rows.append((apart, slip))
            elif held in ("line", "flat"):
                # It turns with the first link.
                kept = across if held == "line" else first[None]
                rows.append((kept @ apart, kept @ (slip - np.cross(wa.T, apart).T)))
            elif held == "turns":
                rows.append((_angle(a.rotation.T, b.rotation), turn))
            elif held == "direction":
                rows.append((_between(first, second), across @ turn))
            elif held == "crossing":
                normal = np.cross(second, first)
                rows.append((np.array([first @ second - closure.cosine]), (normal @ turn)[None]))
            else:
                raise NotImplementedError(f"a closure that holds {held!r}")
        return np.concatenate([r for r, _ in rows]), np.vstack([j for _, j in rows])

    def residuals(self, rates: bool = True) -> tuple[Array, Array]:
        """All closures' rows."""
        rows = [self.residual(closure, rates) for closure in self.tree.closures]
        if not rows:
            return np.zeros(0), np.zeros((0, len(self.steps) if rates else 0))
        return np.concatenate([r for r, _ in rows]), np.vstack([j for _, j in rows])

    def close(self, values: Array, held: Mask | None = None) -> tuple[Array, float]:
        """Values that close the loops by least steps, and the greatest miss left.

        Redundant closures of a rounded file contradict each other by that rounding: directions that
        only they have are left alone at first, as steps along them lead anywhere.

        :param held: steps that keep their values, shape (count,); by default none does.
        """
        best, miss = values, math.inf
        for rank in RANKS:
            new, left = self._close(best, rank, held)
            if left < 0.5 * miss:
                best, miss = new, left
            if miss < 1e-14 or miss > FAR:
                break
        self.place(best)
        return best, miss

    def _close(self, values: Array, rank: float, held: Mask | None) -> tuple[Array, float]:
        self.place(values)
        residual, _ = self.residuals(rates=False)
        slow = 0
        for _ in range(ROUNDS):
            miss = float(np.linalg.norm(residual))
            if miss < 1e-15 or slow > SLOW:
                break
            rates = self.residuals()[1]
            if held is not None:
                rates = np.where(held, 0.0, rates)
            step = -np.linalg.lstsq(rates, residual, rcond=rank)[0]
            if held is not None:
                step[held] = 0.0
            step *= min(1.0, STEP / max(float(np.abs(step).max(initial=0.0)), 1e-300))
            for _ in range(12):
                self.place(values + step)
                residual, _ = self.residuals(rates=False)
                less = float(np.linalg.norm(residual))
                if less < miss:
                    break
                step /= 2
            else:
                break
            values = values + step
            slow = slow + 1 if less > 0.98 * miss else 0
        self.place(values)
        return values, self.miss()

    def miss(self) -> float:
        """How far the loops are open at the placed values, m or rad."""
        return float(np.abs(self.residuals(rates=False)[0]).max(initial=0.0))

    def anywhere(self) -> tuple[Array, float]:
        """Values that close the loops, the nearest to the drawing found at once, and their miss.

        :raises ParameterError: a loop that does not close, by how much.
        """
        values, miss = self.close(np.zeros(len(self.steps)))
        rng = np.random.default_rng(0)
        for spread in (0.05, 0.1, 0.2, 0.4, 0.8) * 2:
            if miss <= self.closed:
                break
            # The drawing may be a place from which no small step helps.
            start = rng.uniform(-spread, spread, len(self.steps))
            other, less = self.close(start)
            if less < miss:
                values, miss = other, less
        self.place(values)
        if miss > self.closed:
            raise self._open()
        return values, miss

    def relaxed(self, values: Array, held: Mask | None = None) -> Array:
        """The values nearest to the drawing that closed loops can move to from these; place them.

        :param held: steps that keep their values, shape (count,); by default none does.
        """
        free = np.ones(len(self.steps), bool) if held is None else ~held
        self.place(values)
        miss = max(self.miss(), 1e-12)
        for _ in range(ROUNDS):
            rates, own = self.residuals()[1] * free, values * free
            slope = own - np.linalg.lstsq(rates, rates @ own, rcond=RANKS[0])[0]
            if float(np.abs(slope).max(initial=0.0)) < 1e-12:
                break
            size = float(values @ values)
            for share in (1.0, 0.5, 0.25, 0.1, 0.01):
                other, less = self.close(values - share * slope, held)
                if less <= miss and float(other @ other) < size * (1.0 - 1e-14):
                    values = other
                    break
            else:
                break
            self.place(values)
        self.place(values)
        return values

    def _open(self) -> ParameterError:
        """The error of loops that do not close, with the one that misses the most."""
        misses = {c.name: self.residual(c)[0] for c in self.tree.closures}
        worst = max(misses, key=lambda name: float(np.abs(misses[name]).max()))
        closure = next(c for c in self.tree.closures if c.name == worst)
        a, b = (self.frame(closure, end) for end in (0, 1))
        apart = 1e3 * float(np.linalg.norm(b.position - a.position))
        turned = float(np.linalg.norm(_angle(a.rotation.T, b.rotation)))
        what = f"{apart:.3g} mm"
        if closure.kind == "fixed":
            what += f" and {turned:.3g} rad"
        return ParameterError(
            worst, f"open by {what} between {closure.inner} and {closure.outer}",
            f"loops that close within {self.closed:g} (m or rad)",
        )  # fmt: skip


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
