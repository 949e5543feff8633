# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Variants, derivatives and design from Python: which arm is best for a pick-and-place cycle.

Run it without ROS: python examples/design_a_delta.py
"""

from __future__ import annotations

import numpy as np

from delta_dynamics import inverse_dynamics, torque_derivatives
from pkm_twin import load, variants
from pkm_twin.design import PosePath, design, tolerances
from pkm_twin.paths import cycle, timed

ARM, FOREARM = "geometry.arm_length", "geometry.forearm_length"


def main() -> None:
    """Run the steps and print their results."""
    robot = load("delta")
    motion = timed(robot, cycle(robot, 0.025, 0.2, 0.025), duration=0.5).uniform(100.0)

    # Many machines at once, on the same joint motion.
    lengths = np.linspace(0.17, 0.21, 5)
    many = variants(robot, {ARM: lengths})
    efforts = many.inverse_dynamics(motion.q, motion.qd, motion.qdd)
    for length, effort in zip(lengths, np.abs(efforts).max((1, 2)), strict=True):
        print(f"arm {length:.3f} m: peak effort {effort:.3f} N m on the same joint motion")

    # Derivatives of the efforts of one sample with respect to the arm length.
    k = int(np.abs(inverse_dynamics(robot, motion.q, motion.qd, motion.qdd)).max(1).argmax())
    slopes = torque_derivatives(robot, motion.q[k], motion.qd[k], motion.qdd[k], by=[ARM])
    print(f"efforts per metre of arm at {motion.time[k]:.3f} s: {slopes.by[ARM]} N m/m")

    # The platform's path stays; the joints follow it.
    path = PosePath.of_joints(robot, motion.time, motion.q, motion.qd, motion.qdd)
    box = {ARM: (0.12, 0.3), FOREARM: (0.3, 0.6)}
    found = design(robot, box, path, "peak-effort", ["singularity>=0.2"], starts=16)
    for name, value in found.best.quantities.items():
        print(f"{name}: {found.before.quantities[name]:.4g} before, {value:.4g} after")
    print({name: round(value, 4) for name, value in found.best.numbers.items()})

    # Position error of the platform for 0.1 mm of one arm.
    errors = tolerances(found.robot, {"bodies.arm I.length": 1e-4}, found.robot.inverse(path.pose))
    largest = np.linalg.norm(errors.deviation[:, :3], axis=-1).max()
    print(f"position error on the path: {1e3 * largest:.3f} mm at most (1 sigma)")


if __name__ == "__main__":
    main()
