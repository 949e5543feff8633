# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The model behind the page: states from slider positions, their quantities, and reasons for rejection."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, Literal
from urllib.parse import parse_qs, urlencode

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Settings
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, PkmTwinError, one_line
from pkm_twin.robot.clearance import has_clearance, joint_clearance
from pkm_twin.robot.limits import beyond_limits
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import has_passive_joint_limits, passive_values
from pkm_twin.view.scene import Deflection
from stiffness_monitor import PlatformResponse, platform_response
from stiffness_monitor.compliance import member_deflections

Grade = Literal["good", "warn", "bad"]

MAX_SHOWN_DEFLECTION: Final = 0.3
"""Largest drawn deflection, as a fraction of the machine's size."""


@dataclass(frozen=True)
class Range:
    """The range of a slider, in steps that are round numbers."""

    name: str
    unit: str
    low: float
    high: float
    step: float


@dataclass(frozen=True, eq=False)
class State:
    """The shown state: q (n,), pose (m,), wrench (6,) on the platform, base axes, N and N m.

    ``rejection``: why the last request was rejected; empty if it was not.
    """

    q: Array
    pose: Array
    wrench: Array = field(default_factory=lambda: np.zeros(6))
    rejection: str = ""


@dataclass(frozen=True, eq=False)
class StateQuantities:
    """The quantities that are shown for a state; ``None`` if unknown, with the reason in ``why``.

    ``singularity``: 1 best, 0 singular; ``clearance``: of limbs, m; ``effort``: to hold the weight
    and the wrench at rest, shape (n,), N m or N; ``energy``: the response
    to the wrench, with its strain energy.
    """

    position: Array
    rotation: Array
    singularity: float
    singularity_grade: Grade
    clearance: float | None
    clearance_grade: Grade
    effort: Array | None
    beyond_effort: tuple[str, ...]
    energy: PlatformResponse | None
    why: dict[str, str]


class Model:
    """Compute a robot's state, limits and quantities from the positions of the page's sliders."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self._settings = Settings()
        self._angles = has_passive_joint_limits(robot)
        self._why: dict[str, str] = {}
        home = robot.home()
        self.start = State(robot.inverse(home), home)
        state = self.start
        if not has_clearance(robot):
            self._why["clearance"] = "the robot's file tells no diameters of members"
        rest = np.zeros(robot.joints_count)
        for name, call in (
            ("effort", lambda: inverse_dynamics(robot, state.q, rest, rest)),
            ("energy", lambda: platform_response(robot, state.q, np.zeros(6))),
        ):
            try:
                call()
            except ParameterError as error:
                self._why[name] = f"the robot's file would need {error.bound}"

    @cached_property
    def joint_ranges(self) -> tuple[Range, ...]:
        """Ranges of q: the limits, or without limits a turn or the machine's size about home."""
        robot, graph = self.robot, self.robot.graph
        free = {"rad": 3.15, "m": _round_up(graph.size) / 2}
        rows = []
        for k, (name, unit) in enumerate(zip(robot.joint_names, robot.joint_units, strict=True)):
            middle = round(float(graph.home[k]), 1)
            low, high = middle - free[unit], middle + free[unit]
            if robot.limits.position is not None:
                limits = robot.limits.position[k]
                low, high = (
                    float(limit) if math.isfinite(limit) else other
                    for limit, other in zip(limits, (low, high), strict=True)
                )
            rows.append(Range(name, unit, float(low), float(high), _choose_step(high - low)))
        return tuple(rows)

    @cached_property
    def pose_ranges(self) -> tuple[Range, ...]:
        """Ranges of the poses of sampled joint positions within their ranges, rounded outwards."""
        robot = self.robot
        lows, highs = (np.array([getattr(r, end) for r in self.joint_ranges]) for end in ("low", "high"))
        random = np.random.default_rng(0).random((1000, robot.joints_count))
        corners = np.array(list(itertools.product((0.0, 1.0), repeat=robot.joints_count)))
        parts = np.concatenate([corners, random])
        states = robot.try_project_redundant(lows + (highs - lows) * parts)
        poses, good = robot.try_forward(states)
        rows = states[good]
        kept = [pose for q, pose in zip(rows, poses[good], strict=True) if not self._describe_beyond_passive(q, pose)]
        found = np.array([*kept, self.start.pose])
        ranges = []
        for k, (name, unit) in enumerate(zip(robot.pose_names, robot.pose_units, strict=True)):
            least, most = float(found[:, k].min()), float(found[:, k].max())
            step = _choose_step(most - least)
            low, high = (round(end * step, 12) for end in (least // step, -(-most // step)))
            ranges.append(Range(name, unit, low, high, step))
        return tuple(ranges)

    @cached_property
    def wrench_ranges(self) -> tuple[Range, ...]:
        """Ranges of forces and moments: what the drives hold at the start, rounded up; else 100 N."""
        robot, force = self.robot, 100.0
        if robot.limits.effort is not None and np.isfinite(robot.limits.effort).any():
            speeds = np.linalg.norm(robot.platform_jacobian(self.start.q)[:3], axis=0)
            held = robot.limits.effort / np.maximum(speeds, 1e-9)
            force = float(np.median(held[np.isfinite(held)]))
        force, moment = _round_up(force), _round_up(force * robot.size)
        tops = [("N", force)] * 3 + [("N m", moment)] * 3
        return tuple(
            Range(name, unit, -top, top, _choose_step(2 * top))
            for name, (unit, top) in zip(("fx", "fy", "fz", "mx", "my", "mz"), tops, strict=True)
        )

    @cached_property
    def enlargement(self) -> Range:
        """Range of the factor on drawn deflections; the largest makes them MAX_SHOWN_DEFLECTION."""
        if "energy" in self._why:
            return Range("deflection enlarged", "times", 0.0, 1.0, 0.01)
        full = np.diag([r.high for r in self.wrench_ranges])[:3]
        moved = platform_response(self.robot, self.start.q, full).deflection
        scale = np.repeat([1.0, self.robot.size], 3)
        largest = float(np.abs(moved * scale).max())
        top = _round_up(MAX_SHOWN_DEFLECTION * self.robot.graph.size / largest)
        return Range("deflection enlarged", "times", 0.0, top, _choose_step(top))

    def to_joints(self, state: State, q: ArrayLike) -> State:
        """Return the state at joint positions, (n,), or the old state with a rejection."""
        return self._try_move(state, np.asarray(q, np.float64), None)

    def to_pose(self, state: State, pose: ArrayLike) -> State:
        """Return the state at a pose, shape (m,), or the old state with a rejection."""
        asked = np.asarray(pose, np.float64)
        try:
            q = self.robot.inverse(asked)
        except ValueError as error:
            return _reject(state, str(error))
        return self._try_move(state, q, asked)

    def to_platform(self, state: State, position: Array, rotation: Array) -> State:
        """Return the state whose platform is nearest to a position (3,), m, and a rotation (3, 3).

        Minimise the squared distance, angles times the platform's size, by Gauss-Newton steps; motions
        that the machine does not have remain as distance. Refusals as in :meth:`to_pose`.
        """
        robot, q = self.robot, state.q
        weights = np.repeat([1.0, robot.size], 3)
        try:
            for _ in range(6):
                at, turn = robot.platform(q)
                turned = Rotation.from_matrix(rotation @ turn.T).as_rotvec()
                missing = weights * np.concatenate([position - at, turned])
                twists = weights[:, None] * robot.platform_jacobian(q)
                q = robot.project_redundant(q + np.linalg.lstsq(twists, missing, rcond=1e-9)[0])[0]
        except ValueError as error:
            return _reject(state, str(error))
        return self._try_move(state, q, None)

    def _try_move(self, state: State, q: Array, asked: Array | None) -> State:
        try:
            q = self.robot.project_redundant(q)[0]
        except ValueError as error:
            return _reject(state, str(error))
        _, found = beyond_limits(self.robot, q)
        if found:
            more = f" ({len(found) - 1} more)" if len(found) > 1 else ""
            return _reject(state, f"{found[0]}{more}")
        try:
            pose = self.robot.forward(q)
        except ValueError as error:
            return _reject(state, str(error))
        if asked is not None:
            # Tolerance of inverse and forward kinematics, m and rad.
            if (np.abs(pose - asked) > 1e-6 * (1.0 + np.abs(asked))).any():
                return _reject(state, "the pose is in another assembly mode than home")
            pose = asked
        beyond = self._describe_beyond_passive(q, pose)
        return _reject(state, beyond) if beyond else replace(state, q=q, pose=pose, rejection="")

    def _describe_beyond_passive(self, q: Array, pose: Array) -> str:
        """Describe which passive joint is beyond its limits; empty if none is."""
        robot, graph = self.robot, self.robot.graph
        bound = getattr(robot.limits, "joint_angle", None)
        angles = robot.limit_angles(pose) if self._angles else None
        if bound is not None and angles is not None and angles.max() > bound:
            # limit_angles has the passive joints in the order of the graph.
            names = [joint.name for joint in graph.joints.values() if not joint.actuated]
            worst = int(angles.argmax())
            return f"{names[worst]} is at {angles[worst]:.6g} rad, limit {float(bound):g}"
        if robot.passive_limits:
            for limit, value in zip(robot.passive_limits, passive_values(robot, q), strict=True):
                if not limit.low <= value <= limit.high:
                    unit = "m" if limit.kind == "slide" else "rad"
                    limits = f"limits {limit.low:g} to {limit.high:g}"
                    return f"{limit.joint} is at {value:.6g} {unit}, {limits}"
        return ""

    def apply_wrench(self, state: State, wrench: ArrayLike) -> State:
        """Return the state under a wrench, (6,), N and N m; the old state with a rejection if it is not finite."""
        values = np.array(wrench, np.float64)
        if not np.isfinite(values).all():
            return _reject(state, "the wrench is not finite")
        return replace(state, wrench=values, rejection="")

    def write_url(self, state: State) -> str:
        """Write robot, pose and wrench as the query of a URL."""
        parts = {"robot": self.robot.name, "pose": _write_numbers(state.pose)}
        if state.wrench.any():
            parts["load"] = _write_numbers(state.wrench)
        return f"?{urlencode(parts, safe=',')}"

    def read_url(self, state: State, link: str) -> State:
        """Return the state that a page's URL (of :meth:`write_url`) encodes, or the old state with a rejection."""
        parts = {name: given[-1] for name, given in parse_qs(link.rpartition("?")[2]).items()}
        if parts.get("robot") != self.robot.name:
            return _reject(state, f"the link is not of the robot {self.robot.name}")
        rows = []
        for name, count in (("pose", len(state.pose)), ("load", 6)):
            try:
                row = [float(v) for v in parts.get(name, ",".join("0" * count)).split(",")]
            except ValueError:
                row = []
            if len(row) != count or not np.isfinite(row).all() or "pose" not in parts:
                return _reject(state, f"the link's {name} has not {count} numbers")
            rows.append(row)
        moved = self.to_pose(state, rows[0])
        return moved if moved.rejection else self.apply_wrench(moved, rows[1])

    def find_softest_pose(self, wrench: Array, tell: Callable[[float], object] = abs) -> tuple[Array, str]:
        """Find the joint positions of the softest pose, or of the one that a wrench (6,) moves most.

        Return the positions and the answer in words, with its units. The search is that of
        ``pkm-twin map``; ``tell`` is called with the progress, 0 to 1.

        :raises PkmTwinError: no elasticity in the robot's file, or no pose that counts.
        """
        from pkm_twin.maps.kinds.compliance import Compliance
        from pkm_twin.maps.search import find_worst
        from pkm_twin.maps.sweep import plan_map

        robot, kind = self.robot, Compliance()
        cases = [kind.loaded(robot, "load", wrench.tolist())] if wrench.any() else ()
        space = plan_map(robot, kind, cases=cases)
        worst = find_worst(space, space.cases[0], self.start.pose[None], tell)
        what = "largest deflection {:.4g} µm" if cases else "softest: {:.4g} µm/N"
        direction = np.zeros(3) if worst.found.direction is None else worst.found.direction
        along = ", ".join(f"{part:.2f}" for part in np.round(direction.reshape(-1), 2) + 0.0)
        told = what.format(1e6 * worst.found.value.item())
        return worst.q, f"{told} along ({along})"

    def compute_numbers(self, state: State) -> StateQuantities:
        """Compute the quantities of a state; the reasons of failures are in ``why``."""
        robot, why = self.robot, dict(self._why)
        measure = float(robot.singularity(state.q))
        stop, warn = self._settings.singularity_stop, self._settings.singularity_warn
        gap = None if "clearance" in why else float(joint_clearance(robot, state.q))
        effort, energy = None, None
        rest = np.zeros(robot.joints_count)
        try:
            if "effort" not in why:
                effort = inverse_dynamics(robot, state.q, rest, rest, state.wrench)
        except (PkmTwinError, ValueError) as error:
            why["effort"] = one_line(str(error))
        try:
            if "energy" not in why:
                energy = platform_response(robot, state.q, state.wrench)
        except (PkmTwinError, ValueError) as error:
            why["energy"] = one_line(str(error))
        position, rotation = robot.platform(state.q)
        over = np.zeros(robot.joints_count, np.bool_)
        if effort is not None and robot.limits.effort is not None:
            over = np.abs(effort) > robot.limits.effort
        # A clearance below 5 mm is marked as low.
        return StateQuantities(
            position,
            rotation,
            measure,
            _grade(measure, stop, warn),
            gap,
            "good" if gap is None else _grade(gap, 0.0, 0.005),
            effort,
            tuple(name for name, beyond in zip(robot.joint_names, over, strict=True) if beyond),
            energy,
            why,
        )

    def compute_deflection(self, state: State, deflection: Array) -> Deflection:
        """Return the members' displacements for the platform's, (6,), m and rad, base axes."""
        robot, q = self.robot, state.q
        wrench = np.linalg.solve(platform_response(robot, q, np.zeros(6)).compliance, deflection)
        return Deflection(np.array(deflection), member_deflections(robot, q, wrench))


def _write_numbers(values: Array) -> str:
    return ",".join(f"{value:.9g}" for value in np.round(values, 12) + 0.0)


def _reject(state: State, reason: str) -> State:
    return replace(state, rejection=one_line(reason))


def _grade(value: float, bad: float, warn: float) -> Grade:
    return "bad" if value <= bad else "warn" if value < warn else "good"


def _choose_step(span: float) -> float:
    """Return the power of ten that divides the span into 400 to 4000 steps."""
    return float(10.0 ** math.floor(math.log10(max(span, 1e-9) / 400)))


def _round_up(value: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    decade = 10.0 ** math.floor(math.log10(max(value, 1e-9)))
    return float(next(k * decade for k in (1.0, 2.0, 5.0, 10.0) if k * decade >= 0.999 * value))
