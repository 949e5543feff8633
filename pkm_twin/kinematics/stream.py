# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""One sample of a stream next to the last: programs that are given what the last one left."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.expressions import PARAMETERS
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.operations import absolute, both, less, maximum, minimum, select
from pkm_twin.codegen.program import LAST, Program
from pkm_twin.kinematics import pose as poses
from pkm_twin.kinematics.engine import Engine
from pkm_twin.kinematics.singularity import singularity_measure
from pkm_twin.kinematics.traced import Traced

MAX_MOVE: Final = 0.02
"""How far joints go, unit one, before the closures are solved from home again."""
MAX_EXTRAPOLATION_TIME: Final = 0.02
"""Most time between samples, s, over which motion is foreseen."""


def stream_kernel(engine: Engine) -> Kernel:
    """Compile the program of a stream's sample: q (n) and the previous sample's row to its row.

    A row begins with q (n), the pose (m) and its rates per rate of the drives that lead (m m, by
    row). Then comes what shows a jump (m): how far the pose is from where the rates lead; and the
    singularity measure. Parameters: what makes lengths of pose coordinates (m); poses and rates are
    multiplied by it.

    What the mean of both samples' rates predicts errs by the third power of the move; how much,
    the change of the rates tells, and is taken off. So is half of what is predicted, for where the
    rates turn between two samples.
    """
    return engine.kernel("stream", _write_stream_program)


def _write_stream_program(t: Traced) -> Program:
    n, m = t.drives.count, len(t.scheme.coordinates)
    scales = t.tape.inputs(PARAMETERS, m)
    before = t.tape.inputs("before", n + m + m * m + m + 1)
    t.solve()
    position, rotation = t.motion.platform()
    pose = scales * np.array(poses.values(t.scheme.coordinates, position, rotation), dtype=object)
    twists = t.twists(t.graph.platform, position, t.rate_columns())
    columns = [poses.rates(t.scheme.coordinates, rotation, v, w) for v, w in twists]
    rates = scales[:, None] * np.array(columns, dtype=object).T
    last = before[n + m : n + m + m * m].reshape(m, m)
    move = t.q - before[t.drives.leading]
    predicted = 0.5 * ((rates + last) @ move)
    bend = _absolute_values(rates - last) @ _absolute_values(move)
    error = _absolute_values(pose - before[n : n + m] - predicted)
    beyond = error - 0.5 * _absolute_values(predicted) - bend
    row = t.lift([*t.drives.variables("q"), *pose, *rates.ravel(), *beyond, singularity_measure(t)])
    return Program(t.inputs("q", before=len(before)), m, {"sample": row}, t.equations())


def start_from_last(t: Traced, program: Program) -> Program:
    """Make a program of motion start from the sample before: input and output ``last``.

    The row has 1 where the sample is valid, the joints that were solved from home last, q, qd, and
    of the unknowns the values, rates, accelerations and their change. Newton's method starts from
    the unknowns moved on by these. Results are those of ``program``.
    """
    (q,) = program.equations
    n, (places, rates) = t.joints, t.scheme.newton_unknowns
    if not q.guessed or not places:
        last, more = t.tape.inputs(LAST, 1), [1.0]
        return replace(
            program,
            inputs={**program.inputs, LAST: 1},
            outputs={**program.outputs, LAST: t.lift(more)},
        )
    k = len(rates)
    sizes = (1, n, n, n, len(places), k, k, k)
    last = t.tape.inputs(LAST, sum(sizes))
    (holds,), anchor, before, speed, x, u, du, change = np.split(last, np.cumsum(sizes)[:-1])
    qd, scales = t.drives.leading_inputs("qd"), np.array(t.drive_scales, dtype=object)
    away, move = (t.q - anchor) * scales, (t.q - before) * scales
    mean = (0.5 * (qd + speed)) * scales
    near = both(less(0.0, holds), less(away @ away, MAX_MOVE * MAX_MOVE))
    # With the mean of both speeds the error grows with the third power of the time.
    time = (move @ mean) / maximum(mean @ mean, 1e-300)
    time = minimum(maximum(time, 0.0), MAX_EXTRAPOLATION_TIME)
    foreseen = t.retract(x, time * (u + (0.5 * time) * (du + change * (1.0 / 3.0))))
    solved = (select(near, a, b) for a, b in zip(anchor, t.q, strict=True))
    changed = (select(near, a - b, 0.0) for a, b in zip(t.du[rates], du, strict=True))
    kept = [1.0, *solved, *t.q, *qd, *t.unknowns, *t.u[rates], *t.du[rates], *changed]
    equations = replace(q, near=near, foreseen=foreseen)
    return replace(
        program,
        inputs={**program.inputs, LAST: len(last)},
        outputs={**program.outputs, LAST: t.lift(kept)},
        equations=(equations,),
    )


def _absolute_values(values: Any) -> Any:
    return np.array([absolute(value) for value in values.ravel()], object).reshape(values.shape)
