# SPDX-License-Identifier: Apache-2.0
"""The fit of a calibration: damped steps of Gauss and Newton's method, robust weights, noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.identification.calibration_state import (
    FRAME,
    TARGET,
    Posed,
    Poses,
    State,
    moved,
    value_of,
)
from pkm_twin.identification.noise import Weighed, weighed
from pkm_twin.identification.transmission import by_map
from pkm_twin.machine.rotations import skew
from pkm_twin.robot.robot import Robot

KNOWN: Final = 0.5
"""A parameter whose deviation stays above this part of its prior one was not observed."""
STEPS: Final = 60
WEIGHED: Final = 12
"""Steps after which noise and weights stay: else they and the fit may go round in circles."""
POOR: Final = 0.25
GOOD: Final = 0.75
"""Parts of what a linear machine would gain: below the one steps are damped more, above less."""
SLOW: Final = 0.02
"""Or so little in each of several steps, ``IDLE``: no number moves by its deviation any more."""
IDLE: Final = 3
LIGHT: Final = 0.01
"""The least damping, in squares of prior standard deviations."""
TRIALS: Final = 8
"""Dampings of a step that are tried."""
CONVERGED: Final = 1e-3
"""Part of its deviation by which no parameter moves in the last step."""
GAINED: Final = 1e-4
"""Or by which the sum of squares over the noise falls."""


@dataclass(frozen=True)
class Parameter:
    """One number that is fitted, in its unit, with standard deviations before and after."""

    name: str
    unit: str
    before: float
    prior: float
    value: float = np.nan
    deviation: float = np.nan
    scaled: bool = False
    """Whether it hangs on a scale that was not measured."""

    @property
    def observed(self) -> bool:
        """Whether the poses tell it: they, not the prior, make its deviation."""
        return self.deviation < KNOWN * self.prior and not self.scaled


class UnsettledError(ParameterError):
    """A fit that does not settle."""


class Measured(Posed, Protocol):
    """What was measured, as a fit asks for it."""

    @property
    def whole(self) -> bool:
        """Whether every pose was measured whole: then the drives' part of the residuals shows."""

    def parts(self, state: State) -> list[Array]:
        """Residuals, measured less computed, (k, a) each."""

    def slopes(self, robot: Robot, state: State, names: Sequence[str]) -> list[Array]:
        """Derivatives of what is computed by named parameters, (k, a, p) each."""

    def weighed(
        self, parts: list[Array], slopes: list[Array], prior: Array, drives: Array | None = None
    ) -> Any:
        """Noise and weights, as :class:`pkm_twin.identification.noise.Weighed`.

        :param drives: derivatives by the drives' errors, (k, sum of a, n).
        """


class Whole(Poses):
    """Poses that were measured whole, or their positions."""

    whole = True

    def parts(self, state: State) -> list[Array]:
        """Of positions and, where measured, rotations, (k, 3) each."""
        return state.parts(self)

    def slopes(self, robot: Robot, state: State, names: Sequence[str]) -> list[Array]:
        """The same by named parameters."""
        columns = derivatives(robot, state, names)
        return [columns[:, :3], columns[:, 3:]][: 1 if self.rotation is None else 2]

    def weighed(
        self, parts: list[Array], slopes: list[Array], prior: Array, drives: Array | None = None
    ) -> Weighed:
        """One weight a pose."""
        del slopes
        return weighed(parts, len(prior), drives)


def fit(
    robot: Robot, start: State, poses: Measured, parameters: Sequence[Parameter],
    progress: Callable[[int], None],
) -> tuple[State, Array, Array, Array, Any, int]:  # fmt: skip
    """Robust least squares over all parameters, the noise found with them.

    :raises ParameterError: it does not settle.
    """
    state = start
    values = np.array([value_of(start, p.name, p.before) for p in parameters])
    centre = np.array([p.before for p in parameters])
    prior = np.array([p.prior for p in parameters])

    def right(state: State, values: Array, noise: Any) -> Array:
        return np.concatenate([noise.over(poses.parts(state)), (centre - values) / prior])

    # Errors of drives in metres are not those of drives in radians.
    alike = poses.whole and len(set(robot.joint_units)) == 1
    names = [p.name for p in parameters]
    drives = [f"joint_map.{joint}.offset" for joint in robot.joint_names if alike]
    damping, problem, settled, idle = 0.0, f"{STEPS} steps", False, 0
    # By the residuals of the instrument alone first: then the drives' part of them is known.
    for steps in range(1, STEPS + 1):
        progress(1)
        both = poses.slopes(robot, state, [*names, *drives])
        columns = [part[..., : len(parameters)] for part in both]
        if settled and drives:
            slopes = state.instrument.map.slopes(state.q)
            by_drives = np.concatenate(both, 1)[..., len(parameters) :] * slopes[:, None]
            noise = poses.weighed(poses.parts(state), columns, prior, by_drives)
            drives = []
        elif steps <= WEIGHED and (drives or not alike):
            noise = poses.weighed(poses.parts(state), columns, prior)
        last, settled = not drives, False
        table = noise.over(columns)
        left, before = np.vstack([table, np.diag(1.0 / prior)]), right(state, values, noise)
        # In units of the prior no singular value is below one.
        _, sizes, axes = np.linalg.svd(left * prior, full_matrices=False)
        spread = prior[:, None] * axes.T / sizes
        covariance = spread @ spread.T
        trial, gained = None, 0.0
        for _ in range(TRIALS):
            move = _move(left, before, np.sqrt(damping) / prior)
            small = bool(np.all(np.abs(move) < CONVERGED * np.sqrt(np.diag(covariance))))
            sums = [float(row @ row) for row in (before, before - left @ move)]
            settled = small or sums[0] - sums[1] < GAINED
            try:
                trial = _stepped(robot, state, poses, parameters, values, move)
            except PkmTwinError as error:
                # No machine has such numbers, or none of them is in these poses: a smaller step.
                trial, problem = None, str(error)
            else:
                row = right(trial, values + move, noise)
                gained = (sums[0] - float(row @ row)) / max(sums[0] - sums[1], 1e-300)
                if settled or gained > POOR:
                    break
            damping = max(10.0 * damping, LIGHT)
        if trial is None:
            break
        state, values = trial, values + move
        idle = idle + 1 if gained * (sums[0] - sums[1]) < SLOW else 0
        settled = settled or idle >= IDLE
        idle = 0 if settled else idle
        if settled and last:
            return state, values, covariance, table * prior, noise, steps
        order = np.argsort(-np.abs(move) / np.sqrt(np.diag(covariance)))[:3]
        problem = f"{steps} steps, {', '.join(names[k] for k in order)} still move"
        if gained > GOOD:
            damping = 0.1 * damping if damping > LIGHT else 0.0
    raise UnsettledError(
        "poses", problem, "poses for which the fit converges: measure more, or fit less (--only)"
    )


def _move(left: Array, right: Array, damping: Array) -> Array:
    """A step of Gauss and Newton's method, damped where that is not zero (Levenberg, Marquardt).

    Along a direction that the poses tell badly the machine may turn away from its tangent: without
    damping a step then goes beyond, and back, for ever.
    """
    rows, end = (left, right)
    if damping.any():
        rows = np.vstack([left, np.diag(damping)])
        end = np.concatenate([right, np.zeros(len(damping))])
    return np.asarray(np.linalg.lstsq(rows, end, rcond=None)[0], np.float64)


def _stepped(
    robot: Robot, state: State, poses: Measured, parameters: Sequence[Parameter], values: Array,
    move: Array,
) -> State:  # fmt: skip
    names = [p.name for p in parameters]
    by = dict(zip(names, move.tolist(), strict=True))
    turn = np.array([by.get(name, 0.0) for name in FRAME[3:]])
    new = dict(zip(names, (values + move).tolist(), strict=True))
    return moved(robot, state, poses, new, turn)


def derivatives(robot: Robot, state: State, names: Sequence[str]) -> Array:
    """Of predicted positions and rotations by named parameters, shape (k, 6, parameters)."""
    tool, machine = state.instrument, state.machine
    position, rotation = state.platform
    by_joints = machine.platform_jacobian(state.q[None])[0]
    by_name = by_map(robot, tool.map, state.q, by_joints)
    if any(name in machine.paths for name in names):
        slopes = np.moveaxis(machine.platform_slopes(state.q), -1, 0)
        by_name |= dict(zip(machine.paths, slopes, strict=True))
    turn = tool.frame.as_matrix()
    lever = rotation @ tool.target
    out = np.zeros((len(state.q), 6, len(names)))
    for k, name in enumerate(names):
        if name in FRAME:
            axis = np.eye(3)[FRAME.index(name) % 3]
            if name in FRAME[:3]:
                out[:, :3, k] = axis
            else:
                out[:, :3, k] = np.cross(axis, (position + lever) @ turn.T)
                out[:, 3:, k] = axis
        elif name in TARGET:
            out[:, :3, k] = rotation[..., TARGET.index(name)] @ turn.T
        else:
            linear, angular = by_name[name][:, :3], by_name[name][:, 3:]
            shifted = linear - (skew(lever) @ angular[..., None])[..., 0]
            out[:, :3, k], out[:, 3:, k] = shifted @ turn.T, angular @ turn.T
    return out
