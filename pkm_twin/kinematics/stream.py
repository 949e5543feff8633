# SPDX-License-Identifier: Apache-2.0
"""One sample of a stream next to the last: pose, rates, unexplained motion, singularity."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkm_twin.codegen.expressions import PARAMETERS
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.operations import absolute
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics import pose as poses
from pkm_twin.kinematics.engine import Engine
from pkm_twin.kinematics.singularity import singularity_measure
from pkm_twin.kinematics.traced import Traced


def stream_kernel(engine: Engine) -> Kernel:
    """Program of a sample: q (n) and the row of the sample before, to its own row.

    A row begins with q (n), the pose (m) and its rates per joint rate (m n, by row). Then comes
    what a jump is told by (m): how far the pose is from where the rates lead; and the singularity
    measure. Parameters: what makes lengths of pose coordinates (m); poses and rates are multiplied
    by it.

    What the mean of both samples' rates predicts errs by the third power of the move; how much,
    the change of the rates tells, and is taken off. So is half of what is predicted, for where the
    rates turn between two samples.
    """
    return engine.kernel("stream", _stream)


def _stream(t: Traced) -> Program:
    n, m = t.joints, len(t.scheme.coordinates)
    scales = t.tape.inputs(PARAMETERS, m)
    before = t.tape.inputs("before", n + m + m * n + m + 1)
    t.solve()
    position, rotation = t.motion.platform()
    pose = scales * np.array(poses.values(t.scheme.coordinates, position, rotation), dtype=object)
    columns = [poses.rates(t.scheme.coordinates, rotation, v, w) for v, w in t.twists()]
    rates = scales[:, None] * np.array(columns, dtype=object).T
    last = before[n + m : n + m + m * n].reshape(m, n)
    move = t.q - before[:n]
    predicted = 0.5 * ((rates + last) @ move)
    bend = _sizes(rates - last) @ _sizes(move)
    error = _sizes(pose - before[n : n + m] - predicted)
    beyond = error - 0.5 * _sizes(predicted) - bend
    row = t.lift([*t.q, *pose, *rates.ravel(), *beyond, singularity_measure(t)])
    return Program({"q": n, "before": len(before)}, m, {"sample": row}, t.equations())


def _sizes(values: Any) -> Any:
    return np.array([absolute(value) for value in values.ravel()], object).reshape(values.shape)
