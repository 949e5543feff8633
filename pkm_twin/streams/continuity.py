# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Check that a stream of joint states keeps clear of singularities and moves without jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import MessageError
from pkm_twin.kinematics.stream import stream_kernel
from pkm_twin.messages.reading import JointReader, JointSample
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import describe_singularity_bound
from pkm_twin.streams.steps import find_max_move
from pkm_twin.streams.wrench import check_order


def check_jump(robot: Robot, moves: Sequence[float], velocity: Sequence[float], period: float) -> None:
    """Reject joint positions that are farther from those before than a joint can move.

    :param moves: differences of the positions, (n,), rad or m. ``velocity``: largest joint velocities, (n,).
    :param period: time between the samples' stamps, s.
    :raises MessageError: a joint jumped: the encoder is wrong, or another publisher sends on this topic.
    """
    for joint, (move, fastest) in enumerate(zip(moves, velocity, strict=True)):
        bound = find_max_move(fastest, period)
        if not abs(move) <= bound:
            controller = robot.controller
            unit = robot.joint_units[joint] if controller.is_identity else "of its units"
            moved, _, most = controller.shown(joint, "velocity", move, -bound, bound)
            text = f"moved by {moved:g} {unit} in {period:g} s, allowed {most:g}"
            raise MessageError("jump", f"{controller.names[joint]} {text}")


def check_step(reader: JointReader, sample: JointSample, last: tuple[int, Array] | None) -> None:
    """Reject a joint state that is older than the last one, or that a joint could not reach since then.

    :param last: stamp, ns, and joint positions, (n,), of the last accepted joint state.
    :raises MessageError: by :func:`check_order` or :func:`check_jump`.
    """
    if last is not None:
        check_order(sample.stamp, last[0])
        moves, period = (sample.q - last[1]).tolist(), (sample.stamp - last[0]) / SECOND
        check_jump(reader.robot, moves, reader.highest_velocity, period)


@dataclass(slots=True)
class _EvaluatedSample:
    """A sample's stamp, and the joint positions, pose and singularity index from :func:`stream_kernel`."""

    stamp: int
    numbers: Array


class Continuity:
    """Checks samples one after the other.

    The edge of the workspace is a singularity, too, so one index (see :meth:`Robot.singularity`)
    covers both. Joint positions alone do not determine the assembly mode. Modes meet at
    singularities, where the stream is stopped; a stream that skips over a singularity shows a jump
    of a joint or of the pose.

    :param warn: singularity index below which a sample is near a singularity.
    :param stop: singularity index below which a sample is rejected.
    :param velocity: largest joint velocities, one per joint, rad/s or m/s.
    """

    def __init__(self, robot: Robot, warn: float, stop: float, velocity: Sequence[float]) -> None:
        self.robot = robot
        self.warn, self.stop = warn, stop
        self._velocity = tuple(velocity)
        # A larger unpredicted move of the pose between two samples is probably another assembly.
        self._largest = 0.25 * robot.size
        self._scales = robot.pose_scales
        n, m = len(robot.joint_names), len(self._scales)
        self._state_size = n + m + m * m
        self._nothing = np.zeros(self._state_size + m + 1)
        self._call = robot.function(_make_stream_program, self._scales)
        self.reset()

    def reset(self) -> None:
        """Forget the last sample."""
        self._last: _EvaluatedSample | None = None
        self._before: _EvaluatedSample | None = None

    def retract(self) -> None:
        """Undo the newest step; possible once after a step."""
        self._last = self._before

    def step(self, stamp: int, q: Array) -> bool:
        """Check a sample, shape (n,); return whether it is near a singularity.

        :param stamp: ns.
        :raises MessageError: the sample is too close to a singularity ("singular"), or a joint or
            the pose jumped ("jump"). The next sample is then compared with the one before.
        :raises UnreachableError: the robot cannot be assembled at these joint positions.
        """
        last = self._last
        before = self._nothing if last is None else last.numbers
        result = self._call(q, before)
        state = _EvaluatedSample(stamp, result)
        *beyond, measure = result.tolist()[self._state_size :]
        if last is not None:
            joints = len(self._velocity)
            moves = (result[:joints] - last.numbers[:joints]).tolist()
            check_jump(self.robot, moves, self._velocity, (stamp - last.stamp) / SECOND)
            if not max(beyond) <= self._largest:
                name = self.robot.pose_names[beyond.index(max(beyond))]
                text = "jumped but the joints did not: the assembly mode changed"
                raise MessageError("jump", f"{name} of the platform {text}")
        if not measure >= self.stop:
            raise MessageError(
                "singular",
                f"too close to a singularity or the edge of the workspace: index {measure:.3g}, "
                f"allowed {self.stop:g} or more; "
                f"{describe_singularity_bound(measure, 'singularity_stop ')} passes",
            )
        self._before, self._last = last, state
        return bool(measure < self.warn)


def _make_stream_program(robot: Robot) -> Kernel:
    return stream_kernel(robot.engine)
