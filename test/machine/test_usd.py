# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A USD file is the machine of the MJCF that it was written from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import load, transmission
from pkm_twin.errors import ParameterError

mujoco = pytest.importorskip("mujoco")
pxr = pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics  # noqa: E402

pytestmark = [
    pytest.mark.usefixtures("quickly_compiled"),
    pytest.mark.filterwarnings("ignore"),
]
HUMANOID = Path(__file__).resolve().parents[2] / "examples/humanoid.xml"
LINKAGES = {
    "ankle": {"base": "shank", "platform": "foot"},
    "knee": {"base": "thigh", "platform": "shank"},
}
KINDS = {
    "ball": UsdPhysics.SphericalJoint,
    "hinge": UsdPhysics.RevoluteJoint,
    "slide": UsdPhysics.PrismaticJoint,
    "fixed": UsdPhysics.FixedJoint,
}


def write_usd(path, *, meters=1.0, nested=False, edit=None):
    """The humanoid as USD: bodies side by side or nested, loops excluded from the articulation.

    A body on two hinges is held by a massless one between; constraints of points are ball joints.
    """
    model = mujoco.MjModel.from_xml_path(str(HUMANOID))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, meters)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdPhysics.Scene.Define(stage, "/scene")
    root = "/robot"
    UsdGeom.Xform.Define(stage, root)
    motors = {model.joint(model.actuator_trnid[i][0]).name: i for i in range(model.nu)}
    frames, paths = {}, {}

    def body(name, rotation, position, mass=0.0, com=None, quat=None, moments=None, parent=root):
        prim = UsdGeom.Xform.Define(stage, f"{parent}/{name}").GetPrim()
        outer = frames.get(parent, (np.eye(3), np.zeros(3)))
        own = outer[0].T @ rotation, outer[0].T @ (position - outer[1])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[3, :3] = own[0].T, own[1] / meters
        UsdGeom.Xformable(prim).AddTransformOp().Set(Gf.Matrix4d(matrix.tolist()))
        frames[str(prim.GetPath())] = rotation, position
        paths[name] = str(prim.GetPath())
        UsdPhysics.RigidBodyAPI.Apply(prim)
        if mass:
            api = UsdPhysics.MassAPI.Apply(prim)
            api.CreateMassAttr(mass)
            api.CreateCenterOfMassAttr(Gf.Vec3f(*(com / meters).tolist()))
            api.CreatePrincipalAxesAttr(Gf.Quatf(*quat.tolist()))
            api.CreateDiagonalInertiaAttr(Gf.Vec3f(*(moments / meters**2).tolist()))

    def joint(name, kind, ends, at, axis=None, excluded=False):
        made = KINDS[kind].Define(stage, f"{root}/joints/{name}")
        prim = made.GetPrim()
        for k, end in enumerate(ends):
            rotation, position = frames[paths[end]]
            getattr(made, f"CreateBody{k}Rel")().SetTargets([Sdf.Path(paths[end])])
            local = rotation.T @ (at - position) / meters
            getattr(made, f"CreateLocalPos{k}Attr")(Gf.Vec3f(*local.tolist()))
            if axis is not None:
                turn = Gf.Rotation(Gf.Vec3d(1, 0, 0), Gf.Vec3d(*(rotation.T @ axis).tolist()))
                getattr(made, f"CreateLocalRot{k}Attr")(Gf.Quatf(turn.GetQuat()))
        if axis is not None:
            made.CreateAxisAttr("X")
        made.CreateExcludeFromArticulationAttr(excluded)
        return prim

    for i in range(1, model.nbody):
        name, parent = model.body(i).name, model.body(model.body_parentid[i]).name
        rotation, position = data.xmat[i].reshape(3, 3), data.xpos[i]
        prim = paths.get(parent, root) if nested else root
        body(
            name,
            rotation,
            position,
            model.body_mass[i],
            model.body_ipos[i],
            model.body_iquat[i],
            model.body_inertia[i],
            prim,
        )
        count, first = model.body_jntnum[i], model.body_jntadr[i]
        for k in range(first, first + count):
            if model.jnt_type[k] == mujoco.mjtJoint.mjJNT_FREE:
                continue
            own = model.joint(k).name
            end = name if k == first + count - 1 else f"{own}_link"
            if end != name:
                body(end, rotation, position)
            made = joint(own, "hinge", (parent, end), data.xanchor[k], data.xaxis[k])
            if model.jnt_limited[k]:
                low, high = np.degrees(model.jnt_range[k]).tolist()
                UsdPhysics.RevoluteJoint(made).CreateLowerLimitAttr(low)
                UsdPhysics.RevoluteJoint(made).CreateUpperLimitAttr(high)
            made.CreateAttribute("physxJoint:armature", Sdf.ValueTypeNames.Float).Set(
                model.dof_armature[model.jnt_dofadr[k]] / meters**2
            )
            if own in motors:
                drive = UsdPhysics.DriveAPI.Apply(made, "angular")
                drive.CreateStiffnessAttr(10.0)
                drive.CreateMaxForceAttr(model.actuator_ctrlrange[motors[own]][1] / meters**2)
            parent = end
    for k in range(model.neq):
        if model.eq_type[k] == mujoco.mjtEq.mjEQ_CONNECT:
            ends = [model.body(j).name for j in (model.eq_obj1id[k], model.eq_obj2id[k])]
            at = frames[paths[ends[0]]]
            point = at[0] @ model.eq_data[k][:3] + at[1]
            joint(model.eq(k).name, "ball", ends, point, excluded=True)
    if edit is not None:
        edit(stage)
    stage.GetRootLayer().Save()
    return path


@pytest.mark.parametrize("meters", [1.0, 0.01])
@pytest.mark.parametrize("name", sorted(LINKAGES))
def test_a_linkage_is_that_of_the_mjcf(name, meters, tmp_path):
    path = write_usd(tmp_path / "humanoid.usda", meters=meters, nested=meters < 1.0)
    robot, right = (load(p, **LINKAGES[name], carry=True) for p in (path, HUMANOID))
    assert robot.joint_names == right.joint_names and robot.pose_names == right.pose_names
    np.testing.assert_allclose(robot.limits.effort, right.limits.effort, rtol=1e-6)
    np.testing.assert_allclose(robot.limits.position, right.limits.position, rtol=1e-6)
    np.testing.assert_allclose(robot.gravity, right.gravity, atol=1e-6)
    assert robot.payload.mass == pytest.approx(right.payload.mass)
    rng, n = np.random.default_rng(2), robot.joints_count
    x = rng.uniform(-0.2, 0.2, (5, n))
    t, same = transmission(robot), transmission(right)
    np.testing.assert_allclose(t.ratio(x), same.ratio(x), atol=2e-5)
    q, qd, qdd = right.inverse(x), *rng.normal(size=(2, 5, n))
    # MJCF's friction has no place in UsdPhysics.
    still = right.changed(friction={"viscous": [0.0] * n, "coulomb": [0.0] * n})
    efforts = inverse_dynamics(still, q, qd, qdd)
    found = inverse_dynamics(robot, q, qd, qdd)
    np.testing.assert_allclose(found, efforts, atol=2e-5 * np.abs(efforts).max())


def _set(path, name, value):
    return lambda stage: stage.GetPrimAtPath(path).GetAttribute(name).Set(value)


def _mirror(stage):
    UsdGeom.Xformable(stage.GetPrimAtPath("/robot/foot")).AddScaleOp().Set(Gf.Vec3f(1, 1, -1))


def _second_scene(stage):
    UsdPhysics.Scene.Define(stage, "/moon").CreateGravityMagnitudeAttr(1.62)


WRONG = {
    "two gravities": (_second_scene, "PhysicsScene.*one gravity"),
    "no inertia": (
        _set("/robot/foot", "physics:diagonalInertia", Gf.Vec3f(0)),
        "/robot/foot.*diagonalInertia",
    ),
    "open": (
        _set("/robot/joints/ankle_roll", "physics:localPos0", Gf.Vec3f(0, 0.1, 0)),
        "ankle_roll.*apart",
    ),
    "mirrored": (_mirror, "/robot/foot.*mirrored"),
    "no body": (
        lambda stage: (
            UsdPhysics.Joint(stage.GetPrimAtPath("/robot/joints/ankle_roll"))
            .GetBody1Rel()
            .SetTargets([Sdf.Path("/robot/foo")])
        ),
        "ankle_roll.physics:body1: '/robot/foo'",
    ),
    "distance": (
        lambda stage: stage.GetPrimAtPath("/robot/joints/ankle_roll").SetTypeName("PhysicsDistanceJoint"),
        "/robot/joints/ankle_roll.*DistanceJoint",
    ),
}


@pytest.mark.parametrize("case", sorted(WRONG))
def test_what_is_wrong_is_named_by_its_prim(case, tmp_path):
    edit, text = WRONG[case]
    path = write_usd(tmp_path / "humanoid.usda", edit=edit)
    with pytest.raises(ParameterError, match=text):
        load(path, **LINKAGES["ankle"])


def test_joints_that_are_free_in_one_axis_are_those_of_a_type(tmp_path):
    def general(stage):
        prim = stage.GetPrimAtPath("/robot/joints/ankle_roll")
        prim.SetTypeName("PhysicsJoint")
        for free in ("transX", "transY", "transZ", "rotY", "rotZ"):
            limit = UsdPhysics.LimitAPI.Apply(prim, free)
            limit.CreateLowAttr(1.0)
            limit.CreateHighAttr(-1.0)

    robots = [
        load(write_usd(tmp_path / f"{k}.usda", edit=edit), **LINKAGES["ankle"])
        for k, edit in enumerate((None, general))
    ]
    x = [0.1, -0.2]
    np.testing.assert_allclose(robots[0].inverse(x), robots[1].inverse(x), atol=1e-12)


def test_a_file_that_is_none_and_a_stage_without_bodies_are_rejected(tmp_path):
    path = tmp_path / "broken.usda"
    path.write_text("#usda 1.0\ndef Xform {")
    with pytest.raises(ParameterError, match=r"broken\.usda"):
        load(path, platform="foot")
    path.write_text('#usda 1.0\ndef Xform "a" {}')
    with pytest.raises(ParameterError, match="no rigid body"):
        load(path, platform="foot")
    with pytest.raises(ParameterError, match="no regular file"):
        load(tmp_path / "none.usd", platform="foot")
