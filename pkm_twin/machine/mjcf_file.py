# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""An MJCF file as links, joints and loop closures, as MuJoCo compiles it.

``connect`` and ``weld`` constraints close loops, a ``joint`` constraint on one joint alone locks
it; a body on a free joint is held by closures only. Sites are links without mass. Actuated are the
joints that actuators drive.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, install, warn
from pkm_twin.machine import urdf_xml
from pkm_twin.machine.loop_tree import Fault, Joint, Link, LoopTree
from pkm_twin.machine.precision import rounding_error
from pkm_twin.machine.rotations import Pose, from_quaternion
from pkm_twin.machine.urdf_control import CHOOSE, UNCOUPLED, require_single

_ENDLESS: Final = re.compile(r"(?:^|\s)[-+]?(?:nan(?:\(\S*\))?|inf|infinity)(?:\s|$)", re.IGNORECASE)
WORLD: Final = "world"
"""The root's name."""
MAX_INCLUDES: Final = 8
"""How deep files may include others."""
IGNORED: Final = (
    ("the spring (stiffness, springref)", "JOINT", ("jnt_stiffness", "jnt_stiffnesspoly")),
    ("damping that is not linear", "DOF", ("dof_dampingpoly",)),
    ("gravity compensation (gravcomp)", "BODY", ("body_gravcomp",)),
    ("the spring (stiffness)", "TENDON", ("tendon_stiffness", "tendon_stiffnesspoly")),
    ("damping", "TENDON", ("tendon_damping", "tendon_dampingpoly")),
    ("frictionloss", "TENDON", ("tendon_frictionloss",)),
    ("armature", "TENDON", ("tendon_armature",)),
    ("the limit", "TENDON", ("tendon_limited",)),
    ("damping that is not linear", "ACTUATOR", ("actuator_dampingpoly",)),
)
"""What is read of no part but acts in MuJoCo: in words, of what, and the model's arrays."""
PLACES: Final = ("pos", "quat", "axis", "xyaxes", "zaxis", "anchor", "relpose")
"""Attributes with places and directions; angles may be in degrees and are left out."""
REPEATED: Final = ("count", "nrow", "ncol", "width", "height")
MAX_PARTS: Final = 100_000
"""Most of anything that a file asks for by a number: elements, copies, pixels along a side."""


def read(path: Path, top: ET.Element, actuated: Sequence[str] | None = None) -> LoopTree:
    """Read an MJCF file with its closures.

    :param actuated: the joints that have motors; default: those of the file's actuators.
    :raises ParameterError: no mujoco package, a model that it does not compile, or a part of it
        that is refused, by name.
    """
    try:
        import mujoco
    except ImportError:
        raise ParameterError(str(path), "an MJCF file without the mujoco package", install("mjcf")) from None
    words = _require_bounded(path, top, path.parent)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        text = " ".join(str(error).split())
        model = _without_meshes(mujoco, path)
        if model is None:
            raise ParameterError(str(path), ValueError(text), "a model that MuJoCo compiles") from None
        warn(path, f"read without its meshes, as its bodies have inertias: {text}")
    return _Reader(mujoco, model, path).tree(rounding_error(words), actuated)


def _without_meshes(mujoco: Any, path: Path) -> Any:
    """Load the model without meshes, textures and height fields; None where they are needed."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        derived = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        for geom in list(spec.geoms):
            geom.material = ""
            if geom.meshname or geom.hfieldname:
                if derived or not geom.parent.explicitinertial:
                    return None
                spec.delete(geom)
        for part in [*spec.meshes, *spec.hfields, *spec.materials, *spec.textures]:
            spec.delete(part)
        return spec.compile()
    except (ValueError, AttributeError):
        return None


def _require_bounded(path: Path, top: ET.Element, folder: Path, depth: int = 0) -> list[str]:
    """Look at a file, and at what it includes, before MuJoCo does, which waits and counts for ever.

    :param folder: of the model; what is included is below it.
    :returns: the numbers of all places and directions, as they are written.
    :raises ParameterError: something is named that is no regular file, or asked for too often.
    """
    if depth > MAX_INCLUDES:
        raise ParameterError(str(path), "nested includes", f"a nesting of at most {MAX_INCLUDES}")
    names = {element.get("name") for element in top.iter()}
    folders = [path.parent]
    for compiler in top.iter("compiler"):
        folders += [path.parent / value for key, value in compiler.items() if key.endswith("dir")]
    pairs = [(element, key, text) for element in top.iter() for key, text in element.items()]
    words = [word for _, key, text in pairs if key in PLACES for word in text.split()]
    for element, key, text in pairs:
        # MuJoCo takes these for numbers; a part may be called so.
        if _ENDLESS.search(text) and key != "name" and text not in names:
            where = ".".join(filter(None, (element.tag, element.get("name"), key)))
            raise ParameterError(where, text, "finite numbers")
        places = [folder / text for folder in folders] if key.startswith("file") else []
        for place in places:
            if place.exists() and not place.is_file():
                raise ParameterError(f"{element.tag}.{key}", text, "a regular file")
        if element.tag == "include" and key == "file":
            # MuJoCo looks beside the model, then beside the file that includes.
            for included in dict.fromkeys((folder / text, path.parent / text)):
                if not included.resolve().is_relative_to(folder.resolve()):
                    raise ParameterError("include.file", text, f"a file below {folder}")
                if included.exists():
                    inner = urdf_xml.elements(included)
                    words += _require_bounded(included, inner, folder, depth + 1)
        if key in REPEATED and math.prod(map(_whole, text.split())) > MAX_PARTS:
            raise ParameterError(f"{element.tag}.{key}", text, f"at most {MAX_PARTS}")
    if _copies(top) > MAX_PARTS:
        raise ParameterError("replicate", "nested copies", f"at most {MAX_PARTS} bodies")
    return words


def _whole(text: str) -> int:
    try:
        return max(1, math.ceil(float(text)))
    except (ValueError, OverflowError):
        return 1  # Which MuJoCo refuses.


def _copies(element: ET.Element) -> int:
    """How many parts an element stands for, with all that is replicated in it."""
    count = _whole(element.get("count", "1")) if element.tag == "replicate" else 1
    return count * (1 + sum(map(_copies, element)))


class _Reader:
    def __init__(self, mujoco: Any, model: Any, path: Path) -> None:
        self.mj, self.model, self.path = mujoco, model, path
        self.links = {WORLD: Link(WORLD)}
        self.joints: dict[str, Joint] = {}
        self.names: dict[tuple[str, int], str] = {}
        # The names of the file, and those that are made up beside them.
        self.link_names = self._named(SITE=model.nsite, BODY=model.nbody)
        self.joint_names = self._named(JOINT=model.njnt, EQUALITY=model.neq)
        kinds = mujoco.mjtJoint
        self.types = {
            int(kinds.mjJNT_FREE): "free",
            int(kinds.mjJNT_BALL): "spherical",
            int(kinds.mjJNT_SLIDE): "prismatic",
            int(kinds.mjJNT_HINGE): "revolute",
        }
        self.faults: list[Fault] = []
        self.locks = self._locks()
        self.data = mujoco.MjData(model)
        for joint, value in self.locks.items():
            self.data.qpos[model.jnt_qposadr[joint]] = value
        mujoco.mj_kinematics(model, self.data)

    def tree(self, rounding: float, chosen: Sequence[str] | None) -> LoopTree:
        """Return the machine; ``rounding``: the largest rounding error of the file's numbers.

        :param chosen: actuated joints in place of those that the file's actuators drive.
        """
        self._warn()
        for body in range(1, self.model.nbody):
            self._body(body)
        for site in range(self.model.nsite):
            name = self._name("SITE", site)
            place = _pose(self.data.site_xmat[site], self.data.site_xpos[site])
            self.links[name] = Link(name).moved(place)
            label = urdf_xml.free_name(f"{name}_frame", self.joint_names)
            owner = self._name("BODY", self.model.site_bodyid[site])
            self.joints[label] = Joint(label, "fixed", owner, name, (place, place))
        types = {name: joint.kind for name, joint in self.joints.items()}
        actuated = self._actuated() if chosen is None else require_single(chosen, types)
        return LoopTree(
            self.path.stem,
            WORLD,
            self.links,
            self.joints,
            tuple(self._closures()),
            actuated,
            [0.0, 0.0, 0.0] if self._disables("GRAVITY") else self.model.opt.gravity.tolist(),
            {name: self.joints[name].drawn for name in actuated},
            rounding,
            "an actuator" if chosen is None else "actuated",
            tuple(self.faults),
        )

    def _named(self, **counts: int) -> set[str]:
        """Name the parts of several kinds; MuJoCo's names are unique within one kind only.

        A name that parts share is the first kind's, and the world's before all others.
        """
        parts = [(kind, i) for kind, count in counts.items() for i in range(count)]
        given = {part: name for part in parts if (name := self._given(*part))}
        owners = {name: part for part, name in reversed(given.items())}
        if "BODY" in counts:
            owners[WORLD] = "BODY", 0
        taken = set(owners)
        for kind, i in parts:
            name = given.get((kind, i))
            if name is None:
                self.names[kind, i] = urdf_xml.free_name(f"{kind.lower()}_{i}", taken)
            elif owners[name] == (kind, i):
                self.names[kind, i] = name
            else:
                other = self.names[kind, i] = urdf_xml.free_name(f"{name}_{kind.lower()}", taken)
                first = owners[name][0].lower()
                warn(self.path, f"{kind.lower()} {name} is read as {other}: a {first} is {name}")
        return taken

    def _given(self, kind: str, index: int) -> str | None:
        name = self.mj.mj_id2name(self.model, getattr(self.mj.mjtObj, f"mjOBJ_{kind}"), index)
        return str(name) if name else None

    def _name(self, kind: str, index: int) -> str:
        own = self.names.get((kind, int(index))) or self._given(kind, index)
        return own or f"{kind.lower()}_{index}"

    def _body(self, body: int) -> None:
        """Add a body on its joints, one after another, each in the body's frame."""
        m, name = self.model, self._name("BODY", body)
        place = _pose(self.data.xmat[body], self.data.xpos[body])
        turn = self.data.ximat[body].reshape(3, 3)
        inertia = turn @ np.diag(m.body_inertia[body]) @ turn.T
        parent = self._name("BODY", m.body_parentid[body])
        count = int(m.body_jntnum[body])
        if not count:
            label = urdf_xml.free_name(f"{name}_body", self.joint_names)
            self.joints[label] = Joint(label, "fixed", parent, name, (place, place))
        for k in range(count):
            joint = int(m.body_jntadr[body]) + k
            label, link = self._name("JOINT", joint), name
            if k < count - 1:
                link = urdf_xml.free_name(f"{label}_link", self.link_names)
                self.links[link] = Link(link).moved(place)
            kind = self.types[int(m.jnt_type[joint])]
            at = Pose(place.rotation, self.data.xanchor[joint].copy())
            more: dict[str, Any] = self._resistance(joint)
            if joint in self.locks:
                kind, more = "fixed", {}
            elif kind in ("revolute", "prismatic"):
                axes, start = self.data.xaxis[joint][None].copy(), self._start(joint)
                more |= {"axes": axes, "drawn": start, "limits": self._limits(joint)}
            self.joints[label] = Joint(label, kind, parent, link, (at, at), **more)
            parent = link
        mass, com = float(m.body_mass[body]), self.data.xipos[body].copy()
        self.links[name] = Link(name, place, mass, com, inertia)

    def _limits(self, joint: int) -> dict[str, Any]:
        """Of a hinge or a slide: its range, and the effort that its actuators can apply."""
        m = self.model
        limits: dict[str, Any] = {}
        if m.jnt_limited[joint]:
            limits["position"] = m.jnt_range[joint].tolist()
        most = math.inf
        if m.jnt_actfrclimited[joint]:
            most = float(np.abs(m.jnt_actfrcrange[joint]).max())
        drives = self._drives(joint)
        if drives:
            most = min(most, sum(abs(m.actuator_gear[i][0]) * self._strength(i) for i in drives))
        if most < math.inf:
            limits["effort"] = most
        return limits

    def _drives(self, joint: int) -> list[int]:
        """Find the actuators of a joint."""
        m, kinds = self.model, self.mj.mjtTrn
        own = int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)
        return [i for i in range(m.nu) if int(m.actuator_trntype[i]) in own and m.actuator_trnid[i][0] == joint]

    def _acted(self, i: int) -> tuple[str, ...]:
        """Find the joints on which an actuator of a tendon, a site or a body acts."""
        m, index = self.model, int(self.model.actuator_trnid[i][0])
        bodies = [index]
        if int(m.actuator_trntype[i]) == int(self.mj.mjtTrn.mjTRN_TENDON):
            first = int(m.tendon_adr[index])
            wraps = range(first, first + int(m.tendon_num[index]))
            kinds = {k: self.mj.mjtWrap(int(m.wrap_type[k])).name for k in wraps}
            joints = [int(m.wrap_objid[k]) for k in wraps if kinds[k] == "mjWRAP_JOINT"]
            if joints:
                return tuple(self._name("JOINT", joint) for joint in joints)
            bodies = [int(m.site_bodyid[m.wrap_objid[k]]) for k in wraps if kinds[k] == "mjWRAP_SITE"]
        elif int(m.actuator_trntype[i]) != int(self.mj.mjtTrn.mjTRN_BODY):
            bodies = [int(m.site_bodyid[index])]
        moved: set[int] = set()
        for body in bodies:
            while body:
                moved.add(body)
                body = int(m.body_parentid[body])
        return tuple(self._name("JOINT", k) for k in range(m.njnt) if int(m.jnt_bodyid[k]) in moved)

    def _strength(self, i: int) -> float:
        """Return the greatest force of an actuator; infinite without limits."""
        m, mj = self.model, self.mj
        most = math.inf
        if m.actuator_forcelimited[i]:
            most = float(np.abs(m.actuator_forcerange[i]).max())
        motor = (
            int(m.actuator_gaintype[i]) == int(mj.mjtGain.mjGAIN_FIXED)
            and int(m.actuator_biastype[i]) == int(mj.mjtBias.mjBIAS_NONE)
            and int(m.actuator_dyntype[i]) == int(mj.mjtDyn.mjDYN_NONE)
        )
        if motor and m.actuator_ctrllimited[i]:
            control = float(np.abs(m.actuator_ctrlrange[i]).max())
            most = min(most, abs(float(m.actuator_gainprm[i][0])) * control)
        return most

    def _resistance(self, joint: int) -> dict[str, Any]:
        """Friction and rotor of a joint, with its actuators' as the joint has them."""
        m = self.model
        dof = m.jnt_dofadr[joint]
        dofs = slice(dof, dof + (6, 3, 1, 1)[int(m.jnt_type[joint])])
        damps_not = self._disables("DAMPER", "PASSIVE")
        rubs_not = self._disables("FRICTIONLOSS", "CONSTRAINT")
        found = {
            "viscous": 0.0 if damps_not else float(m.dof_damping[dofs].max()),
            "coulomb": 0.0 if rubs_not else float(m.dof_frictionloss[dofs].max()),
            "rotor_inertia": float(m.dof_armature[dofs].max()),
        }
        for key, own in (("viscous", "actuator_damping"), ("rotor_inertia", "actuator_armature")):
            values = getattr(m, own, None)
            if values is not None and not (key == "viscous" and damps_not):
                gears = {i: float(m.actuator_gear[i][0]) for i in self._drives(joint)}
                found[key] += sum(float(values[i]) * gear**2 for i, gear in gears.items())
        return found

    def _disables(self, *flags: str) -> bool:
        """Return whether the file's ``<flag>`` switches off what any of these bits stand for."""
        bits = sum(int(getattr(self.mj.mjtDisableBit, f"mjDSBL_{flag}", 0)) for flag in flags)
        return bool(int(self.model.opt.disableflags) & bits)

    def _warn(self) -> None:
        """Warn of what acts in MuJoCo and not here, and reject what makes another machine.

        :raises ParameterError: loop closures that are switched off, or deformable bodies.
        """
        if self._disables("CONSTRAINT", "EQUALITY") and self.model.neq:
            raise ParameterError("option.flag", "equality disabled", "closures that are enabled")
        if self._disables("GRAVITY"):
            warn(self.path, "gravity is switched off by <flag>")
        if getattr(self.model, "nflex", 0):
            raise ParameterError("flex", self._name("FLEX", 0), "a machine of rigid bodies")
        if getattr(self.model, "nplugin", 0):
            warn(self.path, "forces of plugins are ignored")
        held = {("JOINT", joint) for joint in self.locks}
        for what, kind, arrays in IGNORED:
            values = [np.abs(array) for name in arrays if (array := getattr(self.model, name, None)) is not None]
            names = [
                self._name(kind, i)
                for i in range(len(values[0]) if values else 0)
                if any(np.any(array[i]) for array in values) and (kind, i) not in held
            ]
            if names:
                warn(self.path, f"{what} of {kind.lower()} {', '.join(names)} is ignored")
        geared = [
            f"{self._name('ACTUATOR', i)} ({self.model.actuator_gear[i][0]:g})"
            for i in range(self.model.nu)
            if self.model.actuator_gear[i][0] != 1.0
        ]
        if geared:
            warn(self.path, f"efforts are at the joints, not before the gear of {', '.join(geared)}")
        option = self.model.opt
        if option.density or option.viscosity:
            warn(self.path, "the fluid of density and viscosity is ignored")

    def _start(self, joint: int) -> float:
        """Value of a hinge or a slide as the file draws it."""
        return float(self.model.qpos0[self.model.jnt_qposadr[joint]])

    def _equalities(self) -> list[tuple[str, int, Array, tuple[int, int], bool]]:
        m = self.model
        sites = int(self.mj.mjtObj.mjOBJ_SITE)
        return [
            (
                self._name("EQUALITY", i),
                int(m.eq_type[i]),
                m.eq_data[i],
                (int(m.eq_obj1id[i]), int(m.eq_obj2id[i])),
                int(m.eq_objtype[i]) == sites,
            )
            for i in range(m.neq)
            if m.eq_active0[i]
        ]

    def _locks(self) -> dict[int, float]:
        """Joints that a constraint holds at a value."""
        locks = {}
        for name, kind, data, (joint, other), _ in self._equalities():
            if kind != int(self.mj.mjtEq.mjEQ_JOINT):
                continue
            if other >= 0 or self.types[int(self.model.jnt_type[joint])] in ("free", "spherical"):
                pair = [self._name("JOINT", k) for k in (joint, other) if k >= 0]
                error = ParameterError(f"equality.{name}", pair[0], UNCOUPLED)
                self.faults.append((tuple(pair), error))
                continue
            locks[joint] = self._start(joint) + float(data[0])
        return locks

    def _closures(self) -> list[Joint]:
        kinds = self.mj.mjtEq
        weld = int(kinds.mjEQ_WELD)
        closures = []
        for name, kind, data, ids, sites in self._equalities():
            if kind == int(kinds.mjEQ_JOINT):
                continue
            if kind not in (int(kinds.mjEQ_CONNECT), weld):
                raise ParameterError(f"equality.{name}", kind, "connect, weld or joint")
            if kind == weld and data[10] == 0.0:
                raise ParameterError(f"equality.{name}.torquescale", 0, "a <connect>")
            closure = "fixed" if kind == weld else "spherical"
            if sites:
                frames = Pose(), Pose()
            elif kind == weld:
                # The weld's point and orientation in the first body, the point in the second.
                first = Pose(_rotation(data[6:10]), data[3:6].copy())
                frames = first, Pose(position=data[:3].copy())
            else:
                frames = Pose(position=data[:3].copy()), Pose(position=data[3:6].copy())
            ends = [self._name("SITE" if sites else "BODY", i) for i in ids]
            joint = Joint(name, closure, ends[0], ends[1], frames)
            closures.append(joint.placed(*(self.links[end].frame for end in ends)))
        return closures

    def _actuated(self) -> tuple[str, ...]:
        names: list[str] = []
        for i in range(self.model.nu):
            name = self._name("ACTUATOR", i)
            joint = int(self.model.actuator_trnid[i][0])
            if i not in self._drives(joint):
                error = ParameterError(f"actuator.{name}", name, f"an actuator of a joint, or names with {CHOOSE}")
                self.faults.append((self._acted(i), error))
                continue
            own = self._name("JOINT", joint)
            if joint in self.locks or self.joints[own].kind not in ("revolute", "prismatic"):
                bound = "an actuator of a hinge or slide that can move"
                self.faults.append(((own,), ParameterError(f"actuator.{name}", own, bound)))
                continue
            if own not in names:
                names.append(own)
        if not names:
            way = f"an <actuator> of each driven joint, or names with {CHOOSE}"
            self.faults.append(((), ParameterError(str(self.path), "no actuator", way)))
        return tuple(names)


def _pose(rotation: Array, position: Array) -> Pose:
    """Convert a frame of MuJoCo's."""
    return Pose(rotation.reshape(3, 3).copy(), position.copy())


def _rotation(quaternion: Array) -> Array:
    """Return the rotation of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion.tolist()
    return from_quaternion(x, y, z, w)
