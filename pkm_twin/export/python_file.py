# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a robot as one plain Python file for numpy, jax or torch.

Its functions have the expressions of the exported C. They take batches, and the array library can
compile, vectorise and differentiate them: Newton's method makes a fixed number of corrections, from
the start that exported C tries first, and what it does not reach is masked.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from pkm_twin.codegen.expressions import PARAMETERS, Expression
from pkm_twin.codegen.operations import OPERATIONS
from pkm_twin.codegen.plain import write_function
from pkm_twin.codegen.program import (
    MAX_CONTRACTION,
    MAX_EXTRAPOLATED_CORRECTION,
    MAX_FIRST_CORRECTION,
    MAX_LAST_CORRECTION,
    MAX_RESIDUAL,
    MIN_DETERMINANT_RATIO,
    MIN_RELATIVE_DETERMINANT,
    STATE,
    STATE_INDEX,
    flag_certain,
    previous_input_name,
)
from pkm_twin.export.c99 import Routine, Substitution
from pkm_twin.export.c_package import Package
from pkm_twin.kinematics.programs import MAX_POSE_ROUNDING
from pkm_twin.robot.robot import Robot

FUNCTION_NAMES: Final = ("forward", "inverse", "jacobian", "torques", "joint_to_actuator", "actuator_to_joint", "gains")
MAX_CORRECTIONS: Final = 6
"""Largest number of Newton corrections in one call. Of 10,000 states each of delta_cu, prru, rps3 and
five_bar, 5 reach all that 12 reach; one more makes the derivatives exact."""
MORE_STEPS: Final = (9,)
"""Numbers of continuation steps of the further attempts, as in exported C. Of 10,000 states each of a
humanoid's ankle and of delta_cu, 9 steps reach all, 3 steps 96 % and 99.8 %, one step 91 % and 99.7 %."""
LIBRARIES: Final = {
    "numpy": "import numpy as xp",
    "jax": "import jax\nimport jax.numpy as xp",
    "torch": "import torch as xp",
}
UNSAFE_CHARACTERS: Final = re.compile(r'[^ -~]|["\\]')
"""Characters of names that are replaced in docstrings."""
OPERATION_CALLS: Final = re.compile(rf"\b({'|'.join(op.name for op in OPERATIONS if not op.infix)})\(")

FILE_HEAD: Final = '''\
# SPDX-License-Identifier: Apache-2.0
# Written by pkm-twin export python, which overwrites changes.
"""{name} for {library}. Functions take arrays (..., size) and return arrays and a mask (...).

Joints: {joints}.
Pose: {pose}.
SI units, base axes, z up. Where the mask is false, results are NaN: there is no assembly, or a
singularity, an input is not finite, or the state is farther from home than MORE_STEPS reach.
Inputs are float64 or float32 arrays of one type.
"""

{imports}

CORRECTIONS = {corrections}
"""Newton's corrections of a step."""
MORE_STEPS = {steps}
"""Steps of further attempts from home, for states that one step does not reach."""
'''
EAGER_CODE: Final = """

def _is_done(valid):
    return bool(valid.all())
"""
TRACED_CODE: Final = """

def _is_done(valid):
    # What is traced does not depend on values.
    return False
"""
LOOP_CODE: Final = """

def _repeat(step, state):
    for _ in range(CORRECTIONS):
        state = step(state)
    return state
"""
SCAN_CODE: Final = """

def jit(function):
    # For a CPU, where XLA's fusion computes shared terms again for each result.
    return jax.jit(function, compiler_options={"xla_disable_hlo_passes": "fusion"})


def _repeat(step, state):
    return jax.lax.scan(lambda s, _: (step(s), None), state, None, length=CORRECTIONS)[0]
"""
EXTRAPOLATION_STATE: Final = (
    f"({', '.join('ahead' if k == STATE_INDEX.onward else '0.0' for k in range(len(STATE_INDEX)))})"
)
RUNTIME_CODE: Final = f"""

def _like(value, x):
    return value if hasattr(value, "dtype") else xp.zeros_like(x) + value


def _select(x, y, z):
    return xp.where(x > 0.0, _like(y, x), _like(z, x))


def _less(x, y):
    return _select(y - x, 1.0, 0.0)


def _min(x, y):
    return xp.where(x < y, x, y)


def _max(x, y):
    return xp.where(x > y, x, y)


def _inv(x):
    return 1.0 / x


def _atan2(y, x):
    zero = 0.0 * (x + y)
    return xp.arctan2(y + zero, x + zero)


_sqrt, _sin, _cos, _exp, _tanh, _abs, _sign = (
    xp.sqrt, xp.sin, xp.cos, xp.exp, xp.tanh, xp.abs, xp.sign
)


def _call(inputs, equations, results, sizes):
    arrays = [row[..., k] for row in inputs.values() for k in range(row.shape[-1])]
    zero = 0.0 * sum(arrays)
    # A zero of infinity is NaN.
    valid = zero == 0.0
    given = {{
        name: [row[..., k] + zero for k in range(row.shape[-1])] for name, row in inputs.items()
    }}
    rounding = float(xp.finfo(zero.dtype).eps)
    # Rounding of two solutions of one state may be larger than the margins in double precision.
    margin = min(0.0, {MAX_POSE_ROUNDING!r} - 1e2 * rounding)
    closed, residual = max({MAX_LAST_CORRECTION!r}, rounding**0.5) ** 2, max({MAX_RESIDUAL!r}, 1e3 * rounding) ** 2
    for target, goal, unknowns, home, origin, start, onward, correct, certain in equations:
        if goal is not None:
            given[target] = goal(**given)
        if correct is None:
            continue

        def follow(steps, valid):
            # In so many steps on the straight line from home, shorter ones at the end.
            x = before = tuple(value + zero for value in home)
            size, part, way = {(MAX_FIRST_CORRECTION / MAX_CONTRACTION) ** 2!r}, 0.0, 1.0
            if steps > 1 and start is not None:
                size = {(MAX_EXTRAPOLATED_CORRECTION / MAX_CONTRACTION) ** 2!r}
            elif certain or steps > 1:
                size = 1e30
            for k in range(1, steps + 1):
                last, part = part, 1.0 - (1.0 - k / steps) ** 3
                ahead, way = (part - last) / way, part - last
                aim = dict(given)
                if k < steps:
                    aim[target] = [a + part * (b - a) for a, b in zip(origin, given[target])]

                def step(state):
                    x, size, moving, valid = state
                    *new, now, determinant = correct(**aim, **{{unknowns: x}})
                    sound = (now < {MAX_CONTRACTION**2!r} * size) & (determinant > {MIN_RELATIVE_DETERMINANT!r})
                    if steps == 1 and not certain:
                        sound = sound & ({MIN_DETERMINANT_RATIO**2!r} * now < determinant * determinant)
                    valid = valid & (sound | ~moving)
                    x = tuple(xp.where(valid, a, b) for a, b in zip(new, x))
                    return x, xp.where(moving, now, size), moving & sound & (now > closed), valid

                if k > 1:
                    x, before = onward(x, before, {EXTRAPOLATION_STATE}), x
                elif start is not None and (steps == 1 or not certain):
                    x = start(**aim)
                x = tuple(value + zero for value in x)
                x, _, moving, valid = _repeat(step, (x, zero + size, valid, valid))
                valid = valid & ~moving
            return x, valid

        x, good = follow(1, valid)
        for steps in MORE_STEPS:
            if _is_done(good | ~valid):
                break
            again, found = follow(steps, valid)
            x = tuple(xp.where(good, a, b) for a, b in zip(x, again))
            good = good | found
        valid, given[unknowns] = good, x
    values = [value + zero for value in results(**given)]
    found, judged = values[: sum(sizes)], values[sum(sizes) :]
    for value in judged[: len(equations)]:
        valid = valid & (value < residual)
    for value in judged[len(equations) :]:
        valid = valid & (value > margin)
    valid = valid & (0.0 * sum(found) == 0.0)
    rows = []
    for size in sizes:
        row, found = xp.stack(found[:size], -1), found[size:]
        rows.append(xp.where(valid[..., None], row, float("nan")))
    return (*rows, valid)


def _judge(results, judge):
    # Results whose assembly is not certain are valid where the judge's are.
    *rows, certain, valid = results
    certain = certain[..., 0] > 0.0
    if not _is_done(certain | ~valid):
        valid = valid & (certain | judge()[-1])
    return (*[xp.where(valid[..., None], row, float("nan")) for row in rows], valid)
"""


def python_file(robot: Robot, library: str) -> str:
    """Return the text of the file.

    :param library: a key of :data:`LIBRARIES`.
    """
    package = Package(robot, FUNCTION_NAMES)
    payload = {PARAMETERS: package.payload_values}
    joints, pose = (
        ", ".join(f"{name} ({unit})" for name, unit in zip(*pair, strict=True))
        for pair in ((robot.joint_names, robot.joint_units), (robot.pose_names, robot.pose_units))
    )
    head = FILE_HEAD.format(
        name=UNSAFE_CHARACTERS.sub("?", robot.name),
        library=library,
        imports=LIBRARIES[library],
        corrections=MAX_CORRECTIONS,
        steps=MORE_STEPS,
        joints=UNSAFE_CHARACTERS.sub("?", joints),
        pose=UNSAFE_CHARACTERS.sub("?", pose),
    )
    parts = [head, EAGER_CODE if library == "numpy" else TRACED_CODE]
    parts += [SCAN_CODE if library == "jax" else LOOP_CODE, RUNTIME_CODE]
    if library == "numpy":
        # Suppress warnings of numpy for samples that are masked.
        parts.append('\n\n_call = xp.errstate(all="ignore")(_call)\n')
    parts += [_write_routine(one, payload, "_") for one in package.hidden]
    parts += [_write_routine(one, payload) for one in package.routines]
    return "".join(parts)


def _write_routine(routine: Routine, payload: Mapping[str, Sequence[Any]], prefix: str = "") -> str:
    """Write a function with the functions that it calls.

    :param prefix: beginning of the name, for a function that only others call.
    """
    fold, name = Substitution(), routine.name
    known, parts, rows = dict(routine.inputs), [], []
    judged: list[Expression] = []
    branches: list[Expression] = []

    def write_part(what: str, results: Sequence[Expression], inputs: Mapping[str, int] = known) -> str:
        text = OPERATION_CALLS.sub(r"_\1(", write_function(results, inputs))
        text = text.replace("program", f"_{name}_{what}", 1)
        parts.append(f"\n\n{text}\n")
        return f"_{name}_{what}"

    for k, q in enumerate(fold.equations(q, payload) for q in routine.equations):
        goal = write_part(f"goal_{k}", q.goal) if q.goal else None
        known[q.target] = len(q.origin)
        start = onward = correct = None
        if q.home:
            start = write_part(f"start_{k}", q.start) if q.start else None
            known[q.unknowns] = len(q.home)
            correct = write_part(f"correct_{k}", q.results)
            # The unknowns of a step and of the one before, and the state of Newton's method.
            size = {q.unknowns: len(q.home), previous_input_name(q.unknowns): len(q.home), STATE: len(STATE_INDEX)}
            onward = write_part(f"onward_{k}", q.onward, size)
        home, origin = (tuple(e.value for e in row) for row in (q.home, q.origin))
        certain = q.start is not None and not q.guessed
        rows.append(
            f"({q.target!r}, {goal}, {q.unknowns!r}, {home}, {origin}, {start}, {onward}, {correct}, {certain}),"
        )
        judged.append(q.residual)
        branches += q.branch
    own = list(routine.outputs.values()) + ([] if routine.judge is None else [flag_certain(routine.equations)])
    outputs = [e for row in own for e in fold(row, payload)]
    results = write_part("results", [*outputs, *judged, *branches])
    sizes = [len(row) for row in own]
    shapes = [f"{key} (..., {size})" for key, size in routine.inputs.items()]
    gives = [f"{key} (..., {len(row)})" for key, row in routine.outputs.items()]
    inputs = ", ".join(f"{key!r}: {key}" for key in routine.inputs)
    call = f"_call({{{inputs}}}, equations, {results}, {tuple(sizes)})"
    if routine.judge is not None:
        call = f"_judge({call}, lambda: _{routine.judge.name}({', '.join(routine.judge.inputs)}))"
    parts.append(
        f"\n\ndef {prefix}{name}({', '.join(routine.inputs)}):\n"
        f'    """{routine.summary}\n\n    {", ".join(shapes)} -> {", ".join(gives)}, mask (...).\n'
        f'    """\n    equations = (\n        {f"{chr(10)}        ".join(rows)}\n    )\n'
        f"    return {call}\n"
    )
    return "".join(parts)
