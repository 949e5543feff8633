# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find why poses and joint states are rejected, and raise the typed error of the first one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.codegen.code import NOT_FINITE
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import ParameterError, SingularityError, UnreachableError
from pkm_twin.kinematics.drives import TOLERANCE_TIME
from pkm_twin.kinematics.engine import Engine
from pkm_twin.kinematics.programs import projection_program
from pkm_twin.robot.mechanism import Mechanism

SINGULARITY_BOUND: Final = 1e-9
"""Smallest singularity index (0 singular, 1 best) at which a Jacobian is inverted."""


def try_program(kernel: Kernel, given: ArrayLike) -> tuple[Array, Mask]:
    """Return the first output of a program, NaN for rejected samples, and which are valid, (...)."""
    (result, *_), status = kernel(np.zeros(0), given)
    good = np.ones(result.shape[:-1], bool) if status is None else status[..., 0] == 0.0
    return result, np.asarray(good)


def reject_poses(
    robot: Mechanism, engine: Engine, status: Array, pose: ArrayLike, try_inverse: Callable[[Array], tuple[Array, Mask]]
) -> None:
    """Raise the error of the first rejected pose, if there is one.

    :param status: of the inverse kinematics, shape (..., 2). ``pose``: shape (..., m).
    :param try_inverse: returns joint positions of poses, and which poses are valid.
    """
    index = _find_first(status[..., 0])
    if index is None:
        return
    code, reached = status[index].tolist()
    poses = np.asarray(pose, float)
    one = np.broadcast_to(poses, (*status.shape[:-1], poses.shape[-1]))[index]
    if code == NOT_FINITE or not np.isfinite(one).all():
        raise _make_finite_error("pose", index)
    part, miss, met = engine.find_pose_gap(one)
    question = _ask_for_unit(robot, one, engine.home_pose)
    if met and reached < 1.0:
        raise SingularityError("pose", index, 0.0, SINGULARITY_BOUND, reached, question=question)
    if met:
        raise SingularityError("pose", index, 0.0, SINGULARITY_BOUND, None, True, question)
    # Find the reached fraction of the straight line from home, in three refinements by 64.
    home, low, high = engine.home_pose, 0.0, 1.0
    for _ in range(3):
        fractions = np.linspace(low, high, 65)
        good = try_inverse(home + fractions[:, None] * (one - home))[1]
        first = int(np.argmin(good)) or 1
        low, high = fractions[first - 1], fractions[first]
    raise UnreachableError("pose", robot.name_limb(part), index, miss, float(low), question)


def _ask_for_unit(robot: Mechanism, pose: Array, home: Array) -> str:
    """Name the coordinate of a pose (m,) that is far outside, and ask for its unit; else empty."""
    far = np.abs(pose - home)
    # A coordinate beyond ten sizes of the machine was probably given in mm.
    for unit, most, other, word in (("m", 10.0 * robot.graph.size, "mm", "mm"), ("rad", 2.0 * np.pi, "deg", "degrees")):
        own = np.where([one == unit for one in robot.pose_units], far, 0.0)
        k = int(own.argmax())
        if own[k] > most:
            name = robot.pose_names[k]
            header = f"A table's header is then `{name} [{other}]`"
            return f": {name} {pose[k]:.6g} {unit} cannot be reached. Did you give {word}? {header}"
    return ""


def reject_joints(
    robot: Mechanism, engine: Engine, status: Array, q: ArrayLike, inputs: Mapping[str, ArrayLike] | None = None
) -> None:
    """Raise the error of the first rejected joint state, if there is one.

    :param status: of a kernel, shape (..., 2).
    :param inputs: all other inputs of the kernel, by name.
    """
    index = _find_first(status[..., 0])
    if index is None:
        return
    batch = status.shape[:-1]
    given: dict[str, Array] = {}
    for name, value in {"q": q, **(inputs or {})}.items():
        array = np.asarray(value, float)
        given[name] = np.broadcast_to(array, (*batch, array.shape[-1]))[index]
        if not np.isfinite(given[name]).all():
            if name in ("q", "qd", "qdd"):
                raise _make_finite_error("joint state", index)
            raise ParameterError(f"{name}{_write_sample(index)}", given[name].tolist(), "finite numbers")
    code, reached = status[index].tolist()
    if code == NOT_FINITE:
        raise _make_finite_error("joint state", index)
    sample, question = given["q"], ""
    if robot.redundant:
        _reject_contradiction(robot, engine, given, index)
        sample = sample[robot.graph.leading]
        leads = ", ".join(robot.graph.leads)
        question = f"; it is one of {leads} alone, others may lead (redundancy.leads)"
    gap = None if engine.start is None else engine.start.find_gap(engine.tree, sample)
    if gap is not None:
        raise UnreachableError("joint state", robot.name_limb(gap[0]), index, gap[1])
    if reached == 1.0 and try_program(engine.forward, given["q"])[1]:
        raise make_pivot_error("joint state", index, engine.follow_line(sample)[2])
    drive, change = _find_correction(robot, engine, sample)
    if change < np.inf and robot.graph.joints[drive].slides:
        raise UnreachableError("joint state", robot.name_limb(drive), index, change)
    part, miss, measure = engine.explain_missing_assembly(sample, reached)
    if measure is not None:
        raise SingularityError("joint state", index, measure, SINGULARITY_BOUND, reached, question=question)
    limb = robot.name_limb(drive if change < np.inf else part)
    raise UnreachableError("joint state", limb, index, miss, reached)


def make_pivot_error(what: str, index: tuple[int, ...], measure: float) -> SingularityError:
    """Return the error for a state at which the elimination of the loop closures loses a pivot.

    The loss is found by :meth:`.SparseLU.find_growth`.


    :param measure: reciprocal condition of the closures, dimensionless.
    """
    text = f": a pivot of the compiled equations vanishes at reciprocal condition {measure:.3g}"
    return SingularityError(what, index, measure, SINGULARITY_BOUND, question=f"{text}; a state 1e-6 away has results")


def _find_correction(robot: Mechanism, engine: Engine, q: Array) -> tuple[str, float]:
    """Return the drive that alone restores the assembly by the smallest change, and the change.

    The change is infinite if there is no such drive, or if the limbs have no names.
    """
    if robot.limb_names == robot.joint_names:
        return "", np.inf
    size = robot.joints_count
    span = 2.0 * float(np.abs(q - robot.graph.home).max())
    low, high = np.zeros(2 * size), np.full(2 * size, span)
    directions = np.concatenate([np.eye(size), -np.eye(size)])
    for _ in range(4):
        changes = low + np.linspace(0.0, 1.0, 129)[:, None] * (high - low)
        good = try_program(engine.forward, q + changes[..., None] * directions)[1]
        first, found = np.maximum(good.argmax(0), 1)[None], np.asarray(good.any(0))
        high = np.where(found, np.take_along_axis(changes, first, 0)[0], span)
        low = np.where(found, np.take_along_axis(changes, first - 1, 0)[0], span)
    best = int(np.argmin(high))
    return robot.joint_names[best % size], float(high[best]) if found[best] else np.inf


def _reject_contradiction(robot: Mechanism, engine: Engine, given: Mapping[str, Array], index: tuple[int, ...]) -> None:
    """Raise the error of a drive that contradicts the leading ones, by position, velocity or acceleration."""
    graph, leads = robot.graph, ", ".join(robot.graph.leads)
    still = np.zeros(robot.joints_count)
    state = [given.get(name, still) for name in ("q", "qd", "qdd")]
    scales = np.where(np.array(robot.joint_units) == "m", engine.tree.size, 1.0)
    words = (
        ("is", "where {} put it", ""),
        ("has a velocity of {:.4g} {}, ", "what {} make it", "/s"),
        ("has an acceleration of {:.4g} {}, ", "what {} make it", "/s2"),
    )
    found = engine.kernel("project_redundant", projection_program)(np.zeros(0), *state)[0]
    for k, (own, follows, (has, whence, per)) in enumerate(zip(state, found, words, strict=True)):
        apart = np.abs(own - follows)
        worst = int(np.argmax(apart / scales))
        bound = float(graph.sharing[0] * scales[worst]) / TOLERANCE_TIME**k
        if not apart[worst] > bound:
            continue
        unit = robot.joint_units[worst] + per
        how = f"{has.format(own[worst], unit).strip()} {apart[worst]:.3g} {unit} from "
        how += f"{whence.format(leads)}, allowed {bound:.3g} (redundancy.tolerance)"
        if k == 0:
            how += "; or these alone are past a singularity, where others may lead (redundancy.leads)"
        raise UnreachableError("joint state", robot.joint_names[worst], index, 0.0, how=how)


def _find_first(codes: Array) -> tuple[int, ...] | None:
    """Return the index of the first sample whose code is not zero; () for a single sample."""
    bad = np.argwhere(codes != 0.0)
    return tuple(int(i) for i in bad[0]) if len(bad) else None


def _make_finite_error(what: str, index: tuple[int, ...]) -> ValueError:
    return ValueError(f"{what}{_write_sample(index)} is not finite, or leads to a result that is not")


def _write_sample(index: tuple[int, ...]) -> str:
    return f" at sample {index}" if index else ""
