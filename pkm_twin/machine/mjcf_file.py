# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read an MJCF file as links, joints and loop closures, as MuJoCo compiles it.

``connect`` and ``weld`` constraints close loops; a ``joint`` constraint on one joint alone locks it.
Only closures hold a body on a free joint. Sites are links without mass. Joints that actuators drive
are actuated.
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
from pkm_twin.errors import ParameterError, warn_of_file, write_install_command
from pkm_twin.machine import urdf_xml
from pkm_twin.machine.loop_tree import WORLD, Fault, Joint, Link, LoopTree
from pkm_twin.machine.precision import rounding_error
from pkm_twin.machine.rotations import Pose, from_quaternion
from pkm_twin.machine.urdf_control import ACTUATED_OPTION, UNCOUPLED_JOINTS, list_actuated_joints

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
"""Effects in MuJoCo that are not read: description, kind of object, and the model's arrays."""
MAX_PARTS: Final = 100_000
"""Most elements, copies or pixels along a side that a file may ask for by a number."""


def read(path: Path, top: ET.Element, actuated: Sequence[str] | None = None) -> LoopTree:
    """Read an MJCF file with its closures.

    :param actuated: the joints that have motors; default: those of the file's actuators.
    :raises ParameterError: no mujoco package, a model that it does not compile, or a part of it
        that is refused, by name.
    """
    try:
        import mujoco
    except ImportError:
        raise ParameterError(
            str(path), "an MJCF file without the mujoco package", write_install_command("mjcf")
        ) from None
    words = _require_bounded(path, top, path.parent)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        text = " ".join(str(error).split())
        try:
            # Compile the model without meshes, textures and height fields.
            spec = mujoco.MjSpec.from_file(str(path))
            derived = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
            for geom in list(spec.geoms):
                geom.material = ""
                if geom.meshname or geom.hfieldname:
                    if derived or not geom.parent.explicitinertial:
                        raise ValueError("a mesh has the mass of a body")
                    spec.delete(geom)
            for part in [*spec.meshes, *spec.hfields, *spec.materials, *spec.textures]:
                spec.delete(part)
            model = spec.compile()
        except (ValueError, AttributeError):
            raise ParameterError(str(path), ValueError(text), "a model that MuJoCo compiles") from None
        warn_of_file(path, f"read without its meshes, as its bodies have inertias: {text}")
    return _Reader(mujoco, model, path).tree(rounding_error(words), actuated)


def _require_bounded(path: Path, top: ET.Element, folder: Path, depth: int = 0) -> list[str]:
    """Check a file and the files that it includes before MuJoCo does, which reads any file and count.

    :param folder: of the model; included files are below it.
    :returns: the numbers of all positions and directions, as they are written.
    :raises ParameterError: something that is named is no regular file, or a count is too large.
    """
    if depth > 8:
        raise ParameterError(str(path), "nested includes", "a nesting of at most 8")
    names = {element.get("name") for element in top.iter()}
    folders = [path.parent]
    for compiler in top.iter("compiler"):
        folders += [path.parent / value for key, value in compiler.items() if key.endswith("dir")]
    pairs = [(element, key, text) for element in top.iter() for key, text in element.items()]
    # Angles may be in degrees and are left out.
    positions = ("pos", "quat", "axis", "xyaxes", "zaxis", "anchor", "relpose")
    words = [word for _, key, text in pairs if key in positions for word in text.split()]
    endless = re.compile(r"(?:^|\s)[-+]?(?:nan(?:\(\S*\))?|inf|infinity)(?:\s|$)", re.IGNORECASE)
    for element, key, text in pairs:
        # MuJoCo reads these words as numbers; as a name they are allowed.
        if endless.search(text) and key != "name" and text not in names:
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
                    inner = urdf_xml.parse_xml(included)
                    words += _require_bounded(included, inner, folder, depth + 1)
        repeated = key in ("count", "nrow", "ncol", "width", "height")
        if repeated and math.prod(map(_read_count, text.split())) > MAX_PARTS:
            raise ParameterError(f"{element.tag}.{key}", text, f"at most {MAX_PARTS}")
    if _count_copies(top) > MAX_PARTS:
        raise ParameterError("replicate", "nested copies", f"at most {MAX_PARTS} bodies")
    return words


def _read_count(text: str) -> int:
    try:
        return max(1, math.ceil(float(text)))
    except (ValueError, OverflowError):
        return 1  # MuJoCo rejects the text with its own error.


def _count_copies(element: ET.Element) -> int:
    """Count the parts that an element makes, including replicated ones."""
    count = _read_count(element.get("count", "1")) if element.tag == "replicate" else 1
    return count * (1 + sum(map(_count_copies, element)))


class _Reader:
    def __init__(self, mujoco: Any, model: Any, path: Path) -> None:
        self.mj, self.model, self.path = mujoco, model, path
        self.links = {WORLD: Link(WORLD)}
        self.joints: dict[str, Joint] = {}
        self.names: dict[tuple[str, int], str] = {}
        # The names of the file, and new names for parts without one.
        self.link_names = self._name_parts(SITE=model.nsite, BODY=model.nbody)
        self.joint_names = self._name_parts(JOINT=model.njnt, EQUALITY=model.neq)
        kinds = mujoco.mjtJoint
        types = {
            kinds.mjJNT_FREE: "free",
            kinds.mjJNT_BALL: "spherical",
            kinds.mjJNT_SLIDE: "prismatic",
            kinds.mjJNT_HINGE: "revolute",
        }
        self.types = [types[kinds(int(kind))] for kind in model.jnt_type]
        self.faults: list[Fault] = []
        self.locks: dict[int, float] = {}
        for name, kind, data, (joint, other), _ in self._list_equalities():
            if kind != mujoco.mjtEq.mjEQ_JOINT:
                continue
            if other >= 0 or self.types[joint] in ("free", "spherical"):
                pair = [self._get_name("JOINT", k) for k in (joint, other) if k >= 0]
                error = ParameterError(f"equality.{name}", pair[0], UNCOUPLED_JOINTS)
                self.faults.append((tuple(pair), error))
            else:
                self.locks[joint] = float(model.qpos0[model.jnt_qposadr[joint]]) + float(data[0])
        self.data = mujoco.MjData(model)
        for joint, value in self.locks.items():
            self.data.qpos[model.jnt_qposadr[joint]] = value
        mujoco.mj_kinematics(model, self.data)

    def tree(self, rounding: float, chosen: Sequence[str] | None) -> LoopTree:
        """Return the machine; ``rounding``: the largest rounding error of the file's numbers.

        :param chosen: actuated joints in place of those that the file's actuators drive.
        :raises ParameterError: loop closures that are switched off, or deformable bodies.
        """
        m = self.model
        if self._is_switched_off("CONSTRAINT", "EQUALITY") and m.neq:
            raise ParameterError("option.flag", "equality disabled", "closures that are enabled")
        if self._is_switched_off("GRAVITY"):
            warn_of_file(self.path, "gravity is switched off by <flag>")
        if getattr(m, "nflex", 0):
            raise ParameterError("flex", self._get_name("FLEX", 0), "a machine of rigid bodies")
        if getattr(m, "nplugin", 0):
            warn_of_file(self.path, "forces of plugins are ignored")
        for what, kind, arrays in IGNORED:
            values = [np.abs(array) for name in arrays if (array := getattr(m, name, None)) is not None]
            names = [
                self._get_name(kind, i)
                for i in range(len(values[0]) if values else 0)
                if any(np.any(array[i]) for array in values) and not (kind == "JOINT" and i in self.locks)
            ]
            if names:
                warn_of_file(self.path, f"{what} of {kind.lower()} {', '.join(names)} is ignored")
        gears = {self._get_name("ACTUATOR", i): float(m.actuator_gear[i][0]) for i in range(m.nu)}
        if geared := [f"{name} ({gear:g})" for name, gear in gears.items() if gear != 1.0]:
            warn_of_file(self.path, f"efforts are at the joints, not before the gear of {', '.join(geared)}")
        if m.opt.density or m.opt.viscosity:
            warn_of_file(self.path, "the fluid of density and viscosity is ignored")
        for body in range(1, m.nbody):
            self._add_body(body)
        for site in range(m.nsite):
            name = self._get_name("SITE", site)
            place = _make_pose(self.data.site_xmat[site], self.data.site_xpos[site])
            self.links[name] = Link(name).moved(place)
            label = urdf_xml.free_name(f"{name}_frame", self.joint_names)
            owner = self._get_name("BODY", m.site_bodyid[site])
            self.joints[label] = Joint.fixed(label, owner, name, place)
        types = {name: joint.kind for name, joint in self.joints.items()}
        actuated, marked = list_actuated_joints(self.path, types, self.faults, chosen, self._find_driven)
        return LoopTree(
            self.path.stem,
            WORLD,
            self.links,
            self.joints,
            tuple(self._read_closures()),
            actuated,
            [0.0, 0.0, 0.0] if self._is_switched_off("GRAVITY") else m.opt.gravity.tolist(),
            {name: self.joints[name].drawn for name in actuated},
            rounding,
            marked,
            tuple(self.faults),
        )

    def _name_parts(self, **counts: int) -> set[str]:
        """Name the parts of several kinds; MuJoCo's names are unique within one kind only.

        A name that parts share belongs to the first kind, and the world's name to the world.
        """
        parts = [(kind, i) for kind, count in counts.items() for i in range(count)]
        given = {part: name for part in parts if (name := self._find_name(*part))}
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
                warn_of_file(self.path, f"{kind.lower()} {name} is read as {other}: a {first} is {name}")
        return taken

    def _find_name(self, kind: str, index: int) -> str | None:
        name = self.mj.mj_id2name(self.model, getattr(self.mj.mjtObj, f"mjOBJ_{kind}"), index)
        return str(name) if name else None

    def _get_name(self, kind: str, index: int) -> str:
        own = self.names.get((kind, int(index))) or self._find_name(kind, index)
        return own or f"{kind.lower()}_{index}"

    def _add_body(self, body: int) -> None:
        """Add a body on its joints, one after another, each in the body's frame."""
        m, name = self.model, self._get_name("BODY", body)
        place = _make_pose(self.data.xmat[body], self.data.xpos[body])
        turn = self.data.ximat[body].reshape(3, 3)
        inertia = turn @ np.diag(m.body_inertia[body]) @ turn.T
        parent = self._get_name("BODY", m.body_parentid[body])
        count = int(m.body_jntnum[body])
        if not count:
            label = urdf_xml.free_name(f"{name}_body", self.joint_names)
            self.joints[label] = Joint.fixed(label, parent, name, place)
        for k in range(count):
            joint = int(m.body_jntadr[body]) + k
            label, link = self._get_name("JOINT", joint), name
            if k < count - 1:
                link = urdf_xml.free_name(f"{label}_link", self.link_names)
                self.links[link] = Link(link).moved(place)
            at = Pose(place.rotation, self.data.xanchor[joint].copy())
            kind, more = self.types[joint], self._read_resistance(joint)
            if joint in self.locks:
                kind, more = "fixed", {}
            elif kind in ("revolute", "prismatic"):
                axes, drawn = self.data.xaxis[joint][None].copy(), float(m.qpos0[m.jnt_qposadr[joint]])
                more |= {"axes": axes, "drawn": drawn, "limits": self._read_limits(joint)}
            self.joints[label] = Joint(label, kind, parent, link, (at, at), **more)
            parent = link
        mass, com = float(m.body_mass[body]), self.data.xipos[body].copy()
        self.links[name] = Link(name, place, mass, com, inertia)

    def _read_limits(self, joint: int) -> dict[str, Any]:
        """Return the range of a hinge or a slide, and the effort that its actuators can apply."""
        m, mj = self.model, self.mj
        limits: dict[str, Any] = {}
        if m.jnt_limited[joint]:
            limits["position"] = m.jnt_range[joint].tolist()
        most = math.inf
        if m.jnt_actfrclimited[joint]:
            most = float(np.abs(m.jnt_actfrcrange[joint]).max())
        efforts = []
        for i in self._find_drives(joint):
            force = float(np.abs(m.actuator_forcerange[i]).max()) if m.actuator_forcelimited[i] else math.inf
            motor = (
                int(m.actuator_gaintype[i]) == mj.mjtGain.mjGAIN_FIXED
                and int(m.actuator_biastype[i]) == mj.mjtBias.mjBIAS_NONE
                and int(m.actuator_dyntype[i]) == mj.mjtDyn.mjDYN_NONE
            )
            if motor and m.actuator_ctrllimited[i]:
                control = float(np.abs(m.actuator_ctrlrange[i]).max())
                force = min(force, abs(float(m.actuator_gainprm[i][0])) * control)
            efforts.append(abs(m.actuator_gear[i][0]) * force)
        most = min(most, sum(efforts)) if efforts else most
        if most < math.inf:
            limits["effort"] = most
        return limits

    def _find_drives(self, joint: int) -> list[int]:
        """Find the actuators of a joint.

        :raises ParameterError: an actuator with a gear of zero, which moves nothing.
        """
        m, kinds = self.model, self.mj.mjtTrn
        own = kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT
        found = [i for i in range(m.nu) if int(m.actuator_trntype[i]) in own and m.actuator_trnid[i][0] == joint]
        for i in found:
            if m.actuator_gear[i][0] == 0.0:
                raise ParameterError(f"actuator.{self._get_name('ACTUATOR', i)}.gear", 0, "a gear that is not zero")
        return found

    def _read_resistance(self, joint: int) -> dict[str, Any]:
        """Return the friction and rotor inertia of a joint, with those of its actuators at the joint."""
        m = self.model
        dofs = np.flatnonzero(m.dof_jntid == joint)
        damps_not = self._is_switched_off("DAMPER", "PASSIVE")
        rubs_not = self._is_switched_off("FRICTIONLOSS", "CONSTRAINT")
        found = {
            "viscous": 0.0 if damps_not else float(m.dof_damping[dofs].max()),
            "coulomb": 0.0 if rubs_not else float(m.dof_frictionloss[dofs].max()),
            "rotor_inertia": float(m.dof_armature[dofs].max()),
        }
        for key, own in (("viscous", "actuator_damping"), ("rotor_inertia", "actuator_armature")):
            values = getattr(m, own, None)
            if values is not None and not (key == "viscous" and damps_not):
                found[key] += sum(
                    float(values[i]) * float(m.actuator_gear[i][0]) ** 2 for i in self._find_drives(joint)
                )
        return found

    def _is_switched_off(self, *flags: str) -> bool:
        """Return whether the file's ``<flag>`` switches off any of these features."""
        bits = sum(int(getattr(self.mj.mjtDisableBit, f"mjDSBL_{flag}", 0)) for flag in flags)
        return bool(int(self.model.opt.disableflags) & bits)

    def _list_equalities(self) -> list[tuple[str, int, Array, tuple[int, int], bool]]:
        """Return name, type, data, objects and whether these are sites of each active constraint."""
        m = self.model
        return [
            (
                self._get_name("EQUALITY", i),
                int(m.eq_type[i]),
                m.eq_data[i],
                (int(m.eq_obj1id[i]), int(m.eq_obj2id[i])),
                int(m.eq_objtype[i]) == self.mj.mjtObj.mjOBJ_SITE,
            )
            for i in range(m.neq)
            if m.eq_active0[i]
        ]

    def _read_closures(self) -> list[Joint]:
        kinds = self.mj.mjtEq
        closures = []
        for name, kind, data, ids, sites in self._list_equalities():
            if kind == kinds.mjEQ_JOINT:
                continue
            if kind not in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
                raise ParameterError(f"equality.{name}", kind, "connect, weld or joint")
            weld = kind == kinds.mjEQ_WELD
            if weld and data[10] == 0.0:
                raise ParameterError(f"equality.{name}.torquescale", 0, "a <connect>")
            if sites:
                frames = Pose(), Pose()
            elif weld:
                # The weld's point and orientation in the first body, the point in the second.
                w, x, y, z = data[6:10].tolist()
                first = Pose(from_quaternion(x, y, z, w), data[3:6].copy())
                frames = first, Pose(position=data[:3].copy())
            else:
                frames = Pose(position=data[:3].copy()), Pose(position=data[3:6].copy())
            ends = [self._get_name("SITE" if sites else "BODY", i) for i in ids]
            joint = Joint(name, "fixed" if weld else "spherical", ends[0], ends[1], frames)
            closures.append(joint.placed(*(self.links[end].frame for end in ends)))
        return closures

    def _find_driven(self) -> tuple[list[str], str, str]:
        """Find the joints that actuators drive; actuators of other things are faults."""
        m, mj = self.model, self.mj
        names: list[str] = []
        for i in range(m.nu):
            name, index = self._get_name("ACTUATOR", i), int(m.actuator_trnid[i][0])
            if i in self._find_drives(index):
                own = self._get_name("JOINT", index)
                if index in self.locks or self.joints[own].kind not in ("revolute", "prismatic"):
                    bound = "an actuator of a hinge or slide that can move"
                    self.faults.append(((own,), ParameterError(f"actuator.{name}", own, bound)))
                elif own not in names:
                    names.append(own)
                continue
            # An actuator of a tendon, a site or a body acts on the joints of the tendon, or on all joints
            # between the world and these bodies.
            joints, bodies = list[int](), [index]
            if int(m.actuator_trntype[i]) == mj.mjtTrn.mjTRN_TENDON:
                first = int(m.tendon_adr[index])
                wraps = range(first, first + int(m.tendon_num[index]))
                kinds = {k: mj.mjtWrap(int(m.wrap_type[k])).name for k in wraps}
                joints = [int(m.wrap_objid[k]) for k in wraps if kinds[k] == "mjWRAP_JOINT"]
                bodies = [int(m.site_bodyid[m.wrap_objid[k]]) for k in wraps if kinds[k] == "mjWRAP_SITE"]
            elif int(m.actuator_trntype[i]) != mj.mjtTrn.mjTRN_BODY:
                bodies = [int(m.site_bodyid[index])]
            moved: set[int] = set()
            for body in () if joints else bodies:
                while body:
                    moved.add(body)
                    body = int(m.body_parentid[body])
            joints = joints or [k for k in range(m.njnt) if int(m.jnt_bodyid[k]) in moved]
            error = ParameterError(f"actuator.{name}", name, f"an actuator of a joint, or names with {ACTUATED_OPTION}")
            self.faults.append((tuple(self._get_name("JOINT", joint) for joint in joints), error))
        return names, "an actuator", "an <actuator> of each driven joint"


def _make_pose(rotation: Array, position: Array) -> Pose:
    return Pose(rotation.reshape(3, 3).copy(), position.copy())
