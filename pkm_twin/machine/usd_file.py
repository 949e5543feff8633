# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read a USD file as links, joints and loop closures: the prims of UsdPhysics.

Rigid bodies are links. Joints that are excluded from the articulation, and those that a spanning
tree leaves over, close loops. Actuated are joints with a drive that has a stiffness or a damping.
Names are those of the prims, or their paths where prims share a name. Lengths and masses are in the
stage's units; angles of limits are in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, warn_of_file, write_install_command
from pkm_twin.machine.loop_tree import WORLD, Fault, Joint, Link, LoopTree, hold_in_world, order_from_root, span_tree
from pkm_twin.machine.rotations import Pose, axis_rotation, from_quaternion
from pkm_twin.machine.urdf_control import UNCOUPLED_JOINTS, list_actuated_joints

SUFFIXES: Final = (".usd", ".usda", ".usdc")
FRAME_ROUNDING: Final = 1e-3
"""Largest distance of a joint's frames on its two bodies, m or rad, that is rounding: USD's numbers
have single precision, and exporters add up many."""


def read(path: Path, actuated: Sequence[str] | None = None) -> LoopTree:
    """Read a USD file.

    :param actuated: the actuated joints, in place of those with a drive.
    :raises ParameterError: no usd-core package, a file that it does not open, or a prim that is
        refused, by its path.
    """
    try:
        from pxr import Tf, Usd
    except ImportError:
        raise ParameterError(
            str(path), "a USD file without the usd-core package", write_install_command("usd")
        ) from None
    if not path.is_file():
        raise ParameterError(str(path), "no regular file", "a USD file")
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise ParameterError(str(path), ValueError(str(error)), "a USD file") from None
    return _Reader(stage, path).tree(actuated)


class _Reader:
    def __init__(self, stage: Any, path: Path) -> None:
        from pxr import Usd, UsdGeom, UsdPhysics

        self.physics, self.path = UsdPhysics, path
        self.length = float(UsdGeom.GetStageMetersPerUnit(stage))
        self.kilogram = float(UsdPhysics.GetStageKilogramsPerUnit(stage))
        self.up = str(UsdGeom.GetStageUpAxis(stage))
        self.cache = UsdGeom.XformCache()
        every = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
        self.prims = list(Usd.PrimRange.Stage(stage, every))
        self.bodies = [p for p in self.prims if p.HasAPI(UsdPhysics.RigidBodyAPI)]
        self.bodies = [p for p in self.bodies if self._read_value(p, "physics:rigidBodyEnabled", True)]
        self.names = self._name_parts()
        self.links = {WORLD: Link(WORLD)}
        self.faults: list[Fault] = []

    def tree(self, chosen: Sequence[str] | None) -> LoopTree:
        """Return the machine; ``chosen``: actuated joints in place of those with a drive."""
        for prim in self.bodies:
            self.links[self.names[prim.GetPath()]] = self._read_link(prim)
        if len(self.links) == 1:
            raise ParameterError(str(self.path), "no rigid body", "prims with PhysicsRigidBodyAPI")
        joints: dict[str, Joint] = {}
        driven, rubbing, excluded = list[str](), list[str](), set[str]()
        for prim in self.prims:
            if not prim.IsA(self.physics.Joint):
                continue
            if not self._read_value(prim, "physics:jointEnabled", True):
                warn_of_file(self.path, f"{prim.GetPath()} is switched off and left out")
                continue
            joint = self._read_joint(prim)
            if joint.inner == joint.outer:
                continue
            joints[joint.name] = joint
            if self._read_value(prim, "physics:excludeFromArticulation", False):
                excluded.add(joint.name)
            if self._read_value(prim, "physxJoint:jointFriction", 0.0):
                rubbing.append(joint.name)
            if any(
                prim.HasAPI(self.physics.DriveAPI, axis)
                and self._read_value(prim, f"drive:{axis}:physics:{gain}", 0.0) > 0.0
                for axis in ("angular", "linear")
                for gain in ("stiffness", "damping")
            ):
                driven.append(joint.name)
            if any(str(s).startswith(("PhysxMimicJointAPI", "NewtonMimicAPI")) for s in prim.GetAppliedSchemas()):
                error = ParameterError(str(prim.GetPath()), "a mimic joint", UNCOUPLED_JOINTS)
                self.faults.append(((joint.name,), error))
        if rubbing:
            warn_of_file(self.path, f"jointFriction of PhysX is ignored, of {', '.join(rubbing)}")
        hold_in_world(self.path, joints, lambda: self.links[self.names[self.bodies[0].GetPath()]])
        types = {name: joint.kind for name, joint in joints.items()}
        marked = driven, "a drive", "a drive with a stiffness or a damping"
        motors, source = list_actuated_joints(self.path, types, self.faults, chosen, lambda: marked)
        tree, left = span_tree(self.links, joints, motors, excluded)
        placed = self._place_links(tree)
        closures = [self._make_closure(joint) for joint in left]
        size = max(1.0, *(float(np.abs(link.frame.position).max()) for link in self.links.values()))
        # The scene's gravity, by default 9.81 m/s2 downwards, as PhysX.
        gravities = []
        for prim in self.prims:
            if prim.IsA(self.physics.Scene):
                way = np.array(self._read_value(prim, "physics:gravityDirection", (0.0,) * 3), float)
                way = way / np.linalg.norm(way) if way.any() else -np.eye(3)["XYZ".index(self.up)]
                stated = float(self._read_value(prim, "physics:gravityMagnitude", -math.inf))
                gravities.append(((stated * self.length if stated >= 0.0 else 9.81) * way).tolist())
        if any(gravity != gravities[0] for gravity in gravities):
            raise ParameterError(f"{self.path}: PhysicsScene", gravities, "scenes of one gravity")
        return LoopTree(
            self.path.stem,
            WORLD,
            self.links,
            placed,
            tuple(closures),
            motors,
            gravities[0] if gravities else (-9.81 * np.eye(3)["XYZ".index(self.up)]).tolist(),
            rounding=float(np.finfo(np.float32).eps) / 2.0 * size,
            marked=source,
            faults=tuple(self.faults),
        )

    def _name_parts(self) -> dict[Any, str]:
        """Name bodies and joints by their prims: the prim's name, or its path if others have it."""
        named: dict[Any, str] = {}
        for prims in (self.bodies, [p for p in self.prims if p.IsA(self.physics.Joint)]):
            own = [str(prim.GetName()) for prim in prims]
            for prim, name in zip(prims, own, strict=True):
                path = str(prim.GetPath())[1:].replace("/", "_")
                named[prim.GetPath()] = path if own.count(name) > 1 or name == WORLD else name
        return named

    def _read_value(self, prim: Any, name: str, default: Any) -> Any:
        value = prim.GetAttribute(name).Get() if prim.HasAttribute(name) else None
        return default if value is None else value

    def _find_world_frame(self, prim: Any) -> tuple[Pose, Array]:
        """Return a prim's frame, m, and the scales of its axes.

        :raises ParameterError: a frame that is mirrored or not orthogonal.
        """
        table = np.array(self.cache.GetLocalToWorldTransform(prim), np.float64)
        scales = np.linalg.norm(table[:3, :3], axis=1)
        axes = (table[:3, :3] / scales[:, None]).T
        if np.abs(axes.T @ axes - np.eye(3)).max() > FRAME_ROUNDING or np.linalg.det(axes) < 0.0:
            raise ParameterError(str(prim.GetPath()), "a skew or mirrored frame", "a rotation")
        u, _, vt = np.linalg.svd(axes)
        return Pose(u @ vt, self.length * table[3, :3]), scales

    def _read_link(self, prim: Any) -> Link:
        """Return a body with its mass.

        :raises ParameterError: a mass that would follow from shapes and densities.
        """
        where, (frame, scales) = str(prim.GetPath()), self._find_world_frame(prim)
        name = self.names[prim.GetPath()]
        if self._read_value(prim, "physics:kinematicEnabled", False):
            raise ParameterError(f"{where}.physics:kinematicEnabled", True, "a body that forces move")
        below = [p for p in self.prims if p.GetPath().HasPrefix(prim.GetPath()) and p != prim]
        shapes = [p for p in below if p.HasAPI(self.physics.CollisionAPI)]
        mass = self.kilogram * float(self._read_value(prim, "physics:mass", 0.0))
        for part in below:
            if part not in self.bodies and float(self._read_value(part, "physics:mass", 0.0)) > 0.0:
                raise ParameterError(f"{part.GetPath()}.physics:mass", "a shape's", f"one of {where}")
        if mass <= 0.0:
            if shapes:
                raise ParameterError(f"{where}.physics:mass", None, "kg, not only shapes")
            return Link(name, frame)
        moments = np.array(self._read_value(prim, "physics:diagonalInertia", (0.0, 0.0, 0.0)), float)
        center = np.array(self._read_value(prim, "physics:centerOfMass", (-math.inf,) * 3), float)
        if not moments.all() or (shapes and not np.isfinite(center).all()):
            missing = "diagonalInertia" if not moments.all() else "centerOfMass"
            raise ParameterError(f"{where}.physics:{missing}", None, "a value, not only shapes")
        center = np.where(np.isfinite(center), center, 0.0)
        turn = self._read_value(prim, "physics:principalAxes", None)
        axes = np.eye(3) if turn is None or not turn.GetReal() else _to_rotation(turn)
        inertia = axes @ np.diag(moments) @ axes.T * self.kilogram * self.length**2
        own = Link(name, Pose(), mass, self.length * scales * center, inertia)
        return own.moved(frame)

    def _read_joint(self, prim: Any) -> Joint:
        """Return a joint with its frames on both bodies, as drawn, its first axis in each."""
        where, name = str(prim.GetPath()), self.names[prim.GetPath()]
        ends, frames = [], []
        for k in (0, 1):
            targets = prim.GetRelationship(f"physics:body{k}").GetTargets()
            owner = prim.GetStage().GetPrimAtPath(targets[0]) if targets else None
            if targets and not owner:
                raise ParameterError(f"{where}.physics:body{k}", str(targets[0]), "a prim's path")
            frame, scales = (Pose(), np.ones(3)) if owner is None else self._find_world_frame(owner)
            while owner and owner not in self.bodies:
                owner = owner.GetParent()
            ends.append(self.names[owner.GetPath()] if owner else WORLD)
            at = np.array(self._read_value(prim, f"physics:localPos{k}", (0.0, 0.0, 0.0)), float)
            turn = self._read_value(prim, f"physics:localRot{k}", None)
            local = np.eye(3) if turn is None else _to_rotation(turn)
            frames.append(frame @ Pose(local, self.length * scales * at))
        kind, axis = self._read_kind(prim, where)
        more: dict[str, Any] = {}
        if kind in ("revolute", "prismatic"):
            local = np.eye(3)["XYZ".index(axis)]
            first, second = (frame.rotation @ local for frame in frames)
            more = {"axes": np.array([first, second]), **self._read_numbers(prim, kind)}
            more["drawn"] = _value_between(kind, local, *frames)
        return Joint(name, kind, ends[0], ends[1], (frames[0], frames[1]), **more)

    def _read_kind(self, prim: Any, where: str) -> tuple[str, str]:
        """Return a joint's type, and its axis if it has one.

        :raises ParameterError: a type that is not read.
        """
        types = {
            "PhysicsRevoluteJoint": "revolute",
            "PhysicsPrismaticJoint": "prismatic",
            "PhysicsSphericalJoint": "spherical",
            "PhysicsFixedJoint": "fixed",
        }
        kind = str(prim.GetTypeName())
        if kind in types:
            return types[kind], str(self._read_value(prim, "physics:axis", "X"))
        free = [
            freedom
            for freedom in ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
            if self._read_value(prim, f"limit:{freedom}:physics:low", -math.inf)
            <= self._read_value(prim, f"limit:{freedom}:physics:high", math.inf)
        ]
        if kind == "PhysicsJoint":
            if not free or free == ["rotX", "rotY", "rotZ"]:
                return ("spherical" if free else "fixed"), ""
            if len(free) == 1:
                return ("revolute" if free[0][0] == "r" else "prismatic"), free[0][-1]
            kind += f" free in {', '.join(free)}"
        raise ParameterError(where, kind, "a revolute, prismatic, spherical or fixed joint, or one that is free alike")

    def _read_numbers(self, prim: Any, kind: str) -> dict[str, Any]:
        """Return limits and the rotor of a joint of one axis."""
        turns = kind == "revolute"
        unit = math.radians(1.0) if turns else self.length
        force = self.kilogram * self.length ** (2 if turns else 1)
        limits: dict[str, Any] = {}
        ends = [
            float(self._read_value(prim, f"physics:{end}Limit", sign * math.inf)) * unit
            for end, sign in (("lower", -1), ("upper", 1))
        ]
        if np.isfinite(ends).any():
            limits["position"] = ends
        drive = f"drive:{'angular' if turns else 'linear'}:physics"
        for key, name, scale in (
            ("effort", f"{drive}:maxForce", force),
            ("velocity", "physxJoint:maxJointVelocity", unit),
        ):
            most = float(self._read_value(prim, name, math.inf)) * scale
            if 0.0 < most < 1e30:
                limits[key] = most
        rotor = float(self._read_value(prim, "physxJoint:armature", 0.0))
        scale = self.kilogram * (self.length**2 if turns else 1.0)
        return {"limits": limits, "rotor_inertia": rotor * scale}

    def _place_links(self, joints: dict[str, Joint]) -> dict[str, Joint]:
        """Place all links from the world on, so that the joints of the tree meet exactly.

        :raises ParameterError: a joint that is drawn open.
        """
        moves = {WORLD: Pose()}
        placed: dict[str, Joint] = {}
        for joint, parent, child in order_from_root(WORLD, joints.values()):
            inwards = parent == joint.inner
            first, second = joint.frames if inwards else joint.frames[::-1]
            own = joint.axes[0 if inwards else 1] if len(joint.axes) else np.zeros(3)
            meant = moves[parent] @ first
            apart = first.inverse() @ second
            if joint.kind == "spherical":
                apart = Pose(apart.rotation)
            elif joint.kind == "fixed":
                apart = Pose()
            else:
                along = first.rotation.T @ own
                value = _value_between(joint.kind, along, first, second)
                apart = Pose(axis_rotation(along, value)) if joint.kind == "revolute" else Pose(position=value * along)
            target = first @ apart
            miss = np.linalg.norm(target.position - second.position)
            turned = np.abs(target.rotation - second.rotation).max()
            if max(miss, turned) > FRAME_ROUNDING:
                found = f"frames {miss:.3g} m and {turned:.3g} rad apart"
                raise ParameterError(f"joint.{joint.name}", found, f"frames on {parent} and {child} that meet")
            moves[child] = meant @ apart @ second.inverse()
            at = Pose(meant.rotation, (meant @ apart).position if joint.kind == "prismatic" else meant.position)
            axes = np.reshape([moves[parent].rotation @ own] if len(joint.axes) else [], (-1, 3))
            placed[joint.name] = replace(joint, frames=(at, at), axes=axes)
        self.moves = moves
        self.links = {name: link.moved(moves[name]) for name, link in self.links.items()}
        return {name: placed[name] for name in joints}

    def _make_closure(self, joint: Joint) -> Joint:
        """Return a joint that closes a loop, on the placed links."""
        first, second = (self.moves[end] for end in (joint.inner, joint.outer))
        axes = [m.rotation @ a for m, a in zip((first, second), joint.axes, strict=False)]
        frames = first @ joint.frames[0], second @ joint.frames[1]
        return replace(joint, frames=frames, axes=np.reshape(axes, (-1, 3))).make_loop_closing()


def _to_rotation(quaternion: Any) -> Array:
    x, y, z = quaternion.GetImaginary()
    return from_quaternion(x, y, z, quaternion.GetReal())


def _value_between(kind: str, axis: Array, first: Pose, second: Pose) -> float:
    """Return a joint's value as drawn: the motion of its second frame against the first."""
    apart = first.inverse() @ second
    if kind == "prismatic":
        return float(axis @ apart.position)
    across = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    turned = apart.rotation @ across
    return math.atan2(float(np.cross(across, turned) @ axis), float(across @ turned))
