# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Drive a humanoid's ankle by roll and pitch, although two motors and rods move it.

The joint effort f = I(x) (a_wanted + 2 w (v_wanted - v) + w^2 (x_wanted - x)) becomes efforts of
the motors, which also hold the weight. The checks are those of computed_torque.py.

    pkm-twin convert humanoid.xml --base shank --platform foot --carry --out ankle.yaml
    ros2 run pkm_twin machine_sim --ros-args -p mechanism:=$PWD/ankle.yaml -p clock:=lockstep
    python3 ankle.py --robot ankle.yaml --ros-args -p use_sim_time:=true
"""

import sys

import numpy as np
from computed_torque import Controller, main

from delta_dynamics import inverse_dynamics
from pkm_twin import transmission

TRAVEL = np.array([0.2, -0.3])
"""Amplitudes of roll and pitch, rad."""


class AnkleController(Controller):
    """Command the motors' efforts for a motion of roll and pitch."""

    def __init__(self, options):
        super().__init__(options)
        self.ankle = transmission(self.robot)
        self._travel = TRAVEL
        # Compiled before the first joint state is due.
        home = self.robot.home()
        motors = self.ankle.joint_to_actuator(home, home, home)
        self.ankle.actuator_to_joint(motors.position, motors.velocity)
        self.ankle.inertia(home)

    def compute_effort(self, t, q, qd):
        """Return the motors' efforts at time ``t`` of the path for their state; None after its end."""
        # The transmission takes and returns the controller's values.
        numbers = self.controller
        positions, rates = numbers.controller_positions(q), numbers.controller_rates(qd)
        foot = self.ankle.actuator_to_joint(positions, rates)
        if t == 0.0:
            self._start = foot.position
        wanted = self.plan(t)
        if wanted is None:
            return None
        w = 2.0 * np.pi * self.options.bandwidth
        error = wanted[0] - foot.position
        self.errors.append(error)
        acceleration = wanted[2] + 2.0 * w * (wanted[1] - foot.velocity) + w**2 * error
        f = self.ankle.inertia(foot.position) @ acceleration
        motors = self.ankle.joint_to_actuator(foot.position, effort=f).effort
        return numbers.efforts(motors) + inverse_dynamics(self.robot, q, qd, 0.0 * q)


if __name__ == "__main__":
    sys.exit(main(AnkleController, __doc__, "ankle.yaml"))
