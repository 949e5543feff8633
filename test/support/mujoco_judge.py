# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""MuJoCo as a judge of a file's closed linkage: positions, rates and efforts."""

from __future__ import annotations

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")


class Judge:
    """MuJoCo's inverse dynamics of the open tree, projected by the Jacobian of its equalities.

    :param names: the joints that are given. ``held``: joints that stand still, as those of the base
        and of what hangs on it.
    """

    def __init__(self, path, names, held=()):
        self.model = mujoco.MjModel.from_xml_path(str(path))
        self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self.data = mujoco.MjData(self.model)
        self.names = names
        self.own = [int(self.model.joint(name).dofadr[0]) for name in names]
        still = [
            dof
            for name in held
            for dof in range(self.model.nv)
            if self.model.dof_jntid[dof] == self.model.joint(name).id
        ]
        self.rest = np.setdiff1d(np.arange(self.model.nv), [*self.own, *still])

    def rows(self):
        """What the equalities miss, and its Jacobian; no other constraint is asked."""
        mujoco.mj_forward(self.model, self.data)
        count = int(self.data.ne)
        table = np.reshape(self.data.efc_J, (-1, self.model.nv))[:count]
        return self.data.efc_pos[:count].copy(), table.copy()

    def close(self, q):
        for name, value in zip(self.names, q, strict=True):
            self.data.joint(name).qpos[0] = value
        for _ in range(50):
            miss, table = self.rows()
            step = np.zeros(self.model.nv)
            step[self.rest] = -np.linalg.lstsq(table[:, self.rest], miss, rcond=1e-9)[0]
            mujoco.mj_integratePos(self.model, self.data.qpos, step, 1.0)
        assert np.abs(self.rows()[0]).max() < 1e-10

    def motion(self):
        """Rates of all freedoms per rate of the given joints, in the placed state."""
        table, motion = self.rows()[1], np.zeros((self.model.nv, len(self.own)))
        motion[self.own] = np.eye(len(self.own))
        passive = table[:, self.rest]
        motion[self.rest] = -np.linalg.lstsq(passive, table[:, self.own], rcond=1e-9)[0]
        return motion

    def efforts(self, q, qd, qdd):
        self.close(q)
        place, motion = self.data.qpos.copy(), self.motion()
        passive, speed, step = self.rows()[1][:, self.rest], motion @ qd, 1e-4
        tables = []
        for way in (-2.0, -1.0, 1.0, 2.0):
            self.data.qpos[:] = place
            mujoco.mj_integratePos(self.model, self.data.qpos, speed, way * step)
            tables.append(self.rows()[1])
        slope = np.tensordot([1.0, -8.0, 8.0, -1.0], tables, 1) / (12.0 * step)
        drift = slope @ speed
        change = motion @ qdd
        change[self.rest] -= np.linalg.lstsq(passive, drift, rcond=1e-9)[0]
        self.data.qpos[:], self.data.qvel[:], self.data.qacc[:] = place, speed, change
        flags = self.model.opt.disableflags
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        mujoco.mj_inverse(self.model, self.data)
        self.model.opt.disableflags = flags
        self.data.qvel[:] = 0.0
        # Dry friction is a constraint in MuJoCo.
        dry = self.model.dof_frictionloss * np.sign(speed)
        return motion.T @ (self.data.qfrc_inverse + dry)
