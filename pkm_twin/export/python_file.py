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
from pkm_twin.codegen.plain import source
from pkm_twin.codegen.program import CLOSED, CONTRACTION, FIRST, LEAST, MARGIN, RESIDUAL
from pkm_twin.export.c99 import Folding, Routine
from pkm_twin.export.c_package import Package
from pkm_twin.robot.robot import Robot

FUNCTIONS: Final = (
    "forward", "inverse", "jacobian", "torques", "joint_to_actuator", "actuator_to_joint", "gains",
)  # fmt: skip
CORRECTIONS: Final = 6
"""Corrections of a call. Of 10,000 states each of delta_cu, prru, rps3 and five_bar, 5 reach all
that 12 reach; one more makes the derivatives exact."""
LIBRARIES: Final = {
    "numpy": "import numpy as xp",
    "jax": "import jax\nimport jax.numpy as xp",
    "torch": "import torch as xp",
}
_UNSAFE: Final = re.compile(r'[^ -~]|["\\]')
"""What a name may not bring into a docstring."""
_CALLED: Final = re.compile(rf"\b({'|'.join(op.name for op in OPERATIONS if not op.infix)})\(")

_HEAD: Final = '''\
# SPDX-License-Identifier: Apache-2.0
# Written by pkm-twin export python, which overwrites changes.
"""{name} for {library}. Functions take arrays (..., size) and return arrays and a mask (...).

Joints: {joints}.
Pose: {pose}.
SI units, base axes, z up. Where the mask is false, results are NaN: there is no assembly, or a
singularity, an input is not finite, or the state is farther from home than one step of Newton's
method goes with CORRECTIONS corrections. Inputs are float64 or float32 arrays of one type.
"""

{imports}

CORRECTIONS = {corrections}
"""Newton's corrections of every call."""
'''
_LOOP: Final = """

def _repeat(step, state):
    for _ in range(CORRECTIONS):
        state = step(state)
    return state
"""
_SCAN: Final = """

def jit(function):
    # For a CPU, where XLA's fusion computes shared terms again for each result.
    return jax.jit(function, compiler_options={"xla_disable_hlo_passes": "fusion"})


def _repeat(step, state):
    return jax.lax.scan(lambda s, _: (step(s), None), state, None, length=CORRECTIONS)[0]
"""
_RUNTIME: Final = f"""

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
    closed, residual = max({CLOSED!r}, rounding**0.5) ** 2, max({RESIDUAL!r}, 1e3 * rounding) ** 2
    for target, goal, unknowns, start, correct, certain in equations:
        if goal is not None:
            given[target] = goal(**given)
        if correct is None:
            continue

        def step(state):
            x, size, moving, valid = state
            *new, now, determinant = correct(**given, **{{unknowns: x}})
            sound = (now < {CONTRACTION**2!r} * size) & (determinant > {LEAST!r})
            if not certain:
                sound = sound & ({MARGIN**2!r} * now < determinant * determinant)
            valid = valid & (sound | ~moving)
            x = tuple(xp.where(valid, a, b) for a, b in zip(new, x))
            return x, xp.where(moving, now, size), moving & sound & (now > closed), valid

        x = tuple(value + zero for value in start(**given))
        first = zero + (1e30 if certain else {(FIRST / CONTRACTION) ** 2!r})
        x, _, moving, valid = _repeat(step, (x, first, valid, valid))
        valid, given[unknowns] = valid & ~moving, x
    values = [value + zero for value in results(**given)]
    found, judged = values[: sum(sizes)], values[sum(sizes) :]
    for value in judged[: len(equations)]:
        valid = valid & (value < residual)
    for value in judged[len(equations) :]:
        valid = valid & (value > 0.0)
    valid = valid & (0.0 * sum(found) == 0.0)
    rows = []
    for size in sizes:
        row, found = xp.stack(found[:size], -1), found[size:]
        rows.append(xp.where(valid[..., None], row, float("nan")))
    return (*rows, valid)
"""


def python_file(robot: Robot, library: str) -> str:
    """Return the text of the file.

    :param library: a key of :data:`LIBRARIES`.
    """
    package = Package(robot, FUNCTIONS)
    payload = {PARAMETERS: package.payload_values}
    joints, pose = (
        ", ".join(f"{name} ({unit})" for name, unit in zip(*pair, strict=True))
        for pair in (
            (robot.joint_names, robot.joint_units), (robot.pose_names, robot.pose_units)
        )
    )  # fmt: skip
    head = _HEAD.format(
        name=_UNSAFE.sub("?", robot.name), library=library, imports=LIBRARIES[library],
        corrections=CORRECTIONS, joints=_UNSAFE.sub("?", joints), pose=_UNSAFE.sub("?", pose),
    )  # fmt: skip
    parts = [head, _SCAN if library == "jax" else _LOOP, _RUNTIME]
    if library == "numpy":
        # What is not valid is masked.
        parts.append('\n\n_call = xp.errstate(all="ignore")(_call)\n')
    parts += [_write_function(one, payload) for one in package.routines]
    return "".join(parts)


def _write_function(routine: Routine, payload: Mapping[str, Sequence[Any]]) -> str:
    """Return the text of a function and of its parts."""
    fold, name = Folding(), routine.name
    known, parts, rows = dict(routine.inputs), [], []
    judged: list[Expression] = []
    branches: list[Expression] = []

    def write(what: str, results: Sequence[Expression]) -> str:
        text = _CALLED.sub(r"_\1(", source(results, known)).replace("program", f"_{name}_{what}", 1)
        parts.append(f"\n\n{text}\n")
        return f"_{name}_{what}"

    for k, q in enumerate(fold.equations(q, payload) for q in routine.equations):
        goal = write(f"goal_{k}", q.goal) if q.goal else None
        known[q.target] = len(q.origin)
        start = correct = None
        if q.home:
            start = write(f"start_{k}", q.start or q.home)
            known[q.unknowns] = len(q.home)
            correct = write(f"correct_{k}", q.results)
        certain = q.start is not None and not q.guessed
        rows.append(f"({q.target!r}, {goal}, {q.unknowns!r}, {start}, {correct}, {certain}),")
        judged.append(q.residual)
        branches += q.branch
    outputs = [e for row in routine.outputs.values() for e in fold(row, payload)]
    results = write("results", [*outputs, *judged, *branches])
    sizes = [len(row) for row in routine.outputs.values()]
    shapes = [f"{key} (..., {size})" for key, size in routine.inputs.items()]
    gives = [f"{key} (..., {len(row)})" for key, row in routine.outputs.items()]
    inputs = ", ".join(f"{key!r}: {key}" for key in routine.inputs)
    parts.append(
        f"\n\ndef {name}({', '.join(routine.inputs)}):\n"
        f'    """{routine.summary}\n\n    {", ".join(shapes)} -> {", ".join(gives)}, mask (...).\n'
        f'    """\n    equations = (\n        {f"{chr(10)}        ".join(rows)}\n    )\n'
        f"    return _call({{{inputs}}}, equations, {results}, {tuple(sizes)})\n"
    )
    return "".join(parts)
