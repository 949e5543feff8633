# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write programs of gradients: with respect to inputs, and to the machine's geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pkm_twin.codegen.expressions import Numbers
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics import pose as poses
from pkm_twin.kinematics.engine import Engine
from pkm_twin.kinematics.programs import forward_program, pose_accelerations
from pkm_twin.kinematics.traced import Traced


def gradient_program(t: Traced, program: Program, by: Mapping[str, Numbers]) -> Program:
    """Write the gradient of the sum of a program's outputs times the new input ``weights``.

    :param by: for each output of the gradient, the inputs to differentiate by.
    """
    results = [e for row in program.outputs.values() for e in row]
    weights = t.tape.inputs("weights", len(results))
    wanted = [e for row in by.values() for e in row]
    found = iter(t.lift(t.gradient(list(zip(results, weights, strict=True)), wanted)))
    outputs = {name: [next(found) for _ in row] for name, row in by.items()}
    inputs = {**program.inputs, "weights": len(results)}
    return Program(inputs, program.parameters, outputs, program.equations, quick=True)


def platform_gradient(engine: Engine) -> Kernel:
    """Compile the gradient, by the geometry, of a weighted sum of pose, position and rotation.

    Inputs: q, and weights (m + 12).
    """
    return engine.kernel(
        "platform gradient", lambda t: gradient_program(t, forward_program(t), {"geometry": t.geometry}), free=True
    )


def pose_motion_gradient(engine: Engine) -> Kernel:
    """Compile the gradient of a weighted sum of pose, pose rates and pose accelerations.

    Inputs: q, qd, qdd and weights (3 m). Outputs: derivatives by q (n), qd (n) and the geometry.
    """

    def write(t: Traced) -> Program:
        t.solve()
        qd, qdd = t.drives.leading_inputs("qd"), t.drives.leading_inputs("qdd")
        t.set_rates(qd)
        t.set_accelerations(qdd)
        motion, coordinates = t.motion, t.scheme.coordinates
        position, rotation = motion.platform()
        velocity = motion.velocity(t.graph.platform, t.graph.origin)
        outputs = {
            "pose": t.lift(poses.evaluate_coordinates(coordinates, position, rotation)),
            "rates": t.lift(poses.rates(coordinates, rotation, velocity, motion.omega[t.graph.platform])),
            "accelerations": t.lift(pose_accelerations(t)),
        }
        program = Program(t.inputs("q", "qd", "qdd"), 0, outputs, t.equations())
        by = {name: t.drives.variables(name) for name in ("q", "qd")}
        return gradient_program(t, program, {**by, "geometry": t.geometry})

    return engine.kernel("pose motion gradient", write, free=True)


def free_forward(engine: Engine) -> Kernel:
    """Compile :attr:`Engine.forward` with every number of the geometry as an input."""
    return engine.kernel("free forward", lambda t: replace(forward_program(t), quick=True), free=True)
