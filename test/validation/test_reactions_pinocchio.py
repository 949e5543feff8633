# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint reactions against Pinocchio: a recursive sweep over a tree, loops as external loads.

The twin writes every body's balance and solves for all joints at once; Pinocchio finds the loops'
multipliers, hangs them on the tree, and its recursive Newton-Euler sweep hands every load down
from body to body. The gyroscopic couples that do no work in any motion are in both.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from delta_dynamics import reactions
from test.support.pages import numbers
from test.support.robots import partly_long
from tools.certificate.machines import random_case

pytest.importorskip("pinocchio")

import pinocchio as pin

from bags.recording.pinocchio_delta import DeltaEngine
from bags.recording.pinocchio_loops import LoopEngine, PerpendicularLoop, PointLoop
from bags.recording.pinocchio_prru import PrruEngine

MACHINES, STATES = partly_long([2, 12], 2), 8
WIDTH = 0.07
LIMBS = ("I", "II", "III")


class TwoRods(LoopEngine):
    """A Delta whose parallelograms have both rods, on ball joints, and whose platform is free.

    Nothing but the rods and the R-C-U holds the platform's rotation, so couples come out too.
    """

    def _build(self) -> None:
        g, m = self.params["geometry"], self.params["inertia"]
        joint = 0
        for name, kind in (
            ("x", pin.JointModelPX()),
            ("y", pin.JointModelPY()),
            ("z", pin.JointModelPZ()),
            ("rx", pin.JointModelRX()),
            ("ry", pin.JointModelRY()),
            ("rz", pin.JointModelRZ()),
        ):
            joint = self.model.addJoint(joint, kind, pin.SE3.Identity(), f"platform_{name}")
            if name in "xyz":
                self._pose_joints.append(joint)
        self._platform_joint = joint
        self._body(joint, m["platform_mass"], np.zeros(3), np.zeros((3, 3)))
        self._payload(joint)
        arm_length, length = g["arm_length"], g["forearm_length"]
        mass = m["forearm_mass"]
        for limb, azimuth, closure in zip(LIMBS, g["azimuths"], g["closures"], strict=True):
            turn = pin.utils.rpyToMatrix(0.0, 0.0, azimuth)
            base = pin.SE3(turn, turn @ np.array([g["base_radius"], 0.0, 0.0]))
            arm = self.model.addJoint(0, pin.JointModelRY(), base, f"arm {limb}")
            self._actuated_joints.append(arm)
            self._set_armature(arm, m["rotor_inertia"])
            across = m["arm_inertia"]
            com = (m["arm_com"] * arm_length, 0.0, 0.0)
            self._body(arm, m["arm_mass"], com, np.diag((0.0, across, across)))
            rods = [("", 0.0)] if closure == "rcu" else [(" a", -WIDTH / 2), (" b", WIDTH / 2)]
            for rod, side in rods:
                elbow = pin.SE3(np.eye(3), np.array([arm_length, side, 0.0]))
                kinds = (
                    (pin.JointModelPY(), pin.JointModelRY())
                    if closure == "rcu"
                    else (pin.JointModelRY(), pin.JointModelRX())
                )
                first = self.model.addJoint(arm, kinds[0], elbow, f"first {limb}{rod}")
                forearm = self.model.addJoint(first, kinds[1], pin.SE3.Identity(), f"forearm {limb}{rod}")
                inertia = mass / len(rods) * length**2 / 12
                centre = (0.0, 0.0, -length / 2)
                self._body(forearm, mass / len(rods), centre, np.diag((inertia, inertia, 0.0)))
                end = self._frame(f"end {limb}{rod}", forearm, (0.0, 0.0, -length))
                hold = turn @ np.array([g["platform_radius"], side, 0.0])
                corner = self._frame(f"corner {limb}{rod}", self._platform_joint, hold)
                self._points.append(PointLoop(end, corner))
                if closure == "rcu":
                    # The forearm turns about t, the platform about r: t and r stay square.
                    self._perpendiculars.append(PerpendicularLoop(end, np.array([0.0, 1.0, 0.0]), corner, turn[:, 0]))

    def _guess(self, q):
        """The assembly of the engine with one rod for two and a platform that cannot turn."""
        single = DeltaEngine(self.params)
        found = single.assemble(q)
        configuration = pin.neutral(self.model)
        configuration[:3] = found[:3]
        for limb, arm in enumerate(single.actuated.tolist()):
            place = self.actuated[limb]
            rods = 1 if self.params["geometry"]["closures"][limb] == "rcu" else 2
            for k in range(rods):
                at = place + 1 + 2 * k
                configuration[at : at + 2] = found[arm + 1 : arm + 3]
        return configuration


def at_point(wrench, lever):
    """A wrench about another point: ``lever`` from there to its own point."""
    return np.concatenate((wrench[:3], wrench[3:] + np.cross(lever, wrench[:3])))


def delta_reactions(data, q, qd, qdd, wrench):
    """Pinocchio's wrench at every joint of the twin, by name, and the joint's point."""
    engine = TwoRods(data)
    tree = engine.state(q, qd, qdd)
    found, loops = engine.transmitted(tree, wrench)
    placements = {n: engine.data.oMi[k] for k, n in enumerate(engine.model.names)}
    result = {}
    row = 0
    for limb, closure in zip(LIMBS, data["geometry"]["closures"], strict=True):
        arm = placements[f"arm {limb}"]
        # The rotor's inertia stays in the drive, as Pinocchio's is beside the tree.
        result[f"base joint {limb}"] = found[f"arm {limb}"], arm.translation
        rods = [""] if closure == "rcu" else [" a", " b"]
        places = [placements[f"forearm {limb}{rod}"].translation for rod in rods]
        elbow = np.mean(places, 0)
        inner = [
            at_point(found[f"forearm {limb}{rod}"], place - elbow) for rod, place in zip(rods, places, strict=True)
        ]
        result[f"elbow {limb}"] = np.sum(inner, 0), elbow
        ends = []
        for rod in rods:
            frame = engine.model.getFrameId(f"end {limb}{rod}")
            ends.append((-loops[row], engine.data.oMf[frame].translation.copy()))
            row += 1
        corner = np.mean([place for _, place in ends], 0)
        outer = [at_point(load, place - corner) for load, place in ends]
        result[f"platform joint {limb}"] = np.sum(outer, 0), corner
    return result


def prru_reactions(data, q, qd, qdd, wrench):
    """The same of the 3-PRRU."""
    engine = PrruEngine(data)
    tree = engine.state(q, qd, qdd)
    found, loops = engine.transmitted(tree, wrench)
    placements = {n: engine.data.oMi[k] for k, n in enumerate(engine.model.names)}
    result = {}
    for k, limb in enumerate(LIMBS, start=1):
        for joint, body in (
            ("guide", "slider"),
            ("slider joint", "lower_link"),
            ("link joint", "upper_link"),
        ):
            name = f"{body}_{k}"
            result[f"{joint} {limb}"] = found[name], placements[name].translation
        frame = engine.model.getFrameId(f"limb_{k}_end")
        result[f"platform joint {limb}"] = -loops[k - 1], engine.data.oMf[frame].translation
    return result


@pytest.mark.parametrize("machines", MACHINES)
@pytest.mark.parametrize("name", ["delta", "delta_cu", "prru"])
def test_every_joint_of_random_machines(name, machines, rng):
    worst = 0.0
    for _ in range(machines):
        case = random_case(name, rng, STATES)
        case.data["friction"] = {"viscous": [0.0] * 3, "coulomb": [0.0] * 3}
        for q, qd, qdd, wrench in zip(case.q, case.qd, case.qdd, case.wrench, strict=True):
            ours = reactions(case.robot, q, qd, qdd, wrench)
            theirs = (prru_reactions if name == "prru" else delta_reactions)(case.data, q, qd, qdd, wrench)
            assert set(theirs) == set(ours.names)
            size = math.sqrt(float(np.mean(np.sum((ours.points - ours.points.mean(0)) ** 2, 1))))
            unit = np.array([1.0, 1.0, 1.0, size, size, size])
            expected = np.array([theirs[joint][0] for joint in ours.names])
            scale = np.abs(expected / unit).max()
            points = np.array([theirs[joint][1] for joint in ours.names])
            assert ours.points == pytest.approx(points, abs=1e-9)
            assert ours.determinate.all()
            error = np.abs((ours.wrenches - expected) / unit).max() / scale
            worst = max(worst, float(error))
    assert worst < numbers("docs/validation.md", r"within (\S+) of a machine's greatest load")[0]
