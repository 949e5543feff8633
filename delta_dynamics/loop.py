# SPDX-License-Identifier: Apache-2.0
"""Torques in a control loop: arrays that stay where they are, and a call that fills them."""

from __future__ import annotations

from delta_dynamics.virtual_work import torques
from pkm_twin.codegen.kernels import BoundCall
from pkm_twin.robot.robot import Robot


class TorqueLoop:
    """Inverse dynamics of one robot on arrays of its own, see :meth:`Robot.torque_loop`.

    ``q``, ``qd``, ``qdd``: joint positions, rates and accelerations, shape (n,), or (samples, n)
    for more samples than one. ``wrench``: on the platform at its reference point, base axes, (6,)
    or (samples, 6). ``tau``: efforts, as q; NaN in samples that are not good. They are written and
    read in place; assigning another array changes nothing. One thread at a time.
    """

    def __init__(self, robot: Robot, samples: int = 1) -> None:
        """Compile, and lay out the arrays.

        :raises ParameterError: a robot whose file gives no masses.
        :raises ValueError: fewer samples than one.
        """
        if samples < 1:
            raise ValueError(f"samples is {samples}; at least 1 is needed")
        self._bound = BoundCall(torques(robot), robot.inertial, samples)
        self.q, self.qd, self.qdd, self.wrench = self._bound.inputs
        (self.tau,) = self._bound.outputs
        self.q[:] = robot.graph.home

    def __call__(self) -> int:
        """Compute tau: 0 all samples are good, 1 one has no assembly, 2 one is not finite."""
        return self._bound()
