# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Programs for streams of samples, which take the state that the last sample left."""

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
"""Largest dimensionless motion of the joints until the closures are solved from home again."""
MAX_EXTRAPOLATION_TIME: Final = 0.02
"""Longest time between samples over which the unknowns are extrapolated, s."""


def stream_kernel(engine: Engine) -> Kernel:
    """Compile the program from q (n) and the previous sample's row to the present sample's row.

    A row has q (n), the pose (m), the pose rates per rate of the leading drives (m m, by row), the
    jump of each pose coordinate (m), and the singularity measure. The parameters are factors (m)
    that make pose coordinates lengths; poses and rates are multiplied by them.

    A jump is the motion that the mean of both samples' rates does not predict. The prediction's error
    is of third order in the motion; a bound from the change of the rates is subtracted from the jump,
    and half of the prediction for rates that change their sign between the samples.
    """
    return engine.kernel("stream", _write_stream_program)


def _write_stream_program(t: Traced) -> Program:
    n, m = t.drives.count, len(t.scheme.coordinates)
    scales = t.tape.inputs(PARAMETERS, m)
    before = t.tape.inputs("before", n + m + m * m + m + 1)
    t.solve()
    position, rotation = t.motion.platform()
    pose = scales * np.array(poses.evaluate_coordinates(t.scheme.coordinates, position, rotation), dtype=object)
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
    """Make a program start from the previous sample, with the input and output ``last``.

    ``last`` has 1 for a valid sample, the joint positions of the last solution from home, q, qd, and
    values, rates, accelerations and change of acceleration of the unknowns. Newton's method starts
    from the unknowns extrapolated by these. The results are those of ``program``.
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
    # With the mean of both velocities the error is of third order in the time.
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
