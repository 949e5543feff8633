# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Closed-loop machines as URDFs in four dialects, with link frames and joint zeros of any kind.

Of two of them a YAML file tells the closures; ``spheres`` has a small sphere on a hinge at both
sides of each, as drawing programs export them: one of the two hinges is one too many.

They share no code with the package: each is a list of links, joints and closures in base axes at a
closed assembly, from which the URDF is written in each link's own, randomly turned frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

Z = np.array([0.0, 0.0, 1.0])
X = np.array([1.0, 0.0, 0.0])


SPHERE = (
    '<inertial><mass value="6e-6"/><inertia ixx="1e-11" ixy="0" ixz="0" iyy="1e-11" iyz="0" izz="1e-11"/></inertial>'
)


@dataclass
class Sketch:
    """``joints``: name, type, parent, child, point, axis, and the value at the closed assembly."""

    links: dict = field(default_factory=dict)
    joints: list = field(default_factory=list)
    closures: list = field(default_factory=list)
    actuated: list = field(default_factory=list)
    seed: int = 0

    def link(self, name, mass, com, size=0.05):
        rng = np.random.default_rng(len(self.links) + 10 * self.seed)
        a = rng.normal(size=(3, 3)) * size
        self.links[name] = (
            mass,
            np.array(com, float),
            mass * (np.trace(a @ a.T) * np.eye(3) - a @ a.T),
        )

    def joint(self, name, kind, parent, child, point, axis=Z, value=0.0, actuated=False):
        axis = np.array(axis, float) / np.linalg.norm(axis)
        self.joints.append((name, kind, parent, child, np.array(point, float), axis, value))
        if actuated:
            self.actuated.append(name)

    def loop(self, name, kind, a, b, point, axis=Z):
        self.closures.append((name, kind, a, b, np.array(point, float), np.array(axis, float)))

    def universal(self, name, parent, child, point, first, second, values=(0.0, 0.0)):
        self.link(f"{name}_cross", 0.0, point)
        self.joint(f"{name}_1", "revolute", parent, f"{name}_cross", point, first, values[0])
        self.joint(f"{name}_2", "revolute", f"{name}_cross", child, point, second, values[1])

    def frames(self):
        """Each link's frame at the closed assembly, in the root."""
        rng = np.random.default_rng(self.seed)
        found = {"ground": pin.SE3.Identity()}
        for _, _, _, child, point, _, _ in self.joints:
            found[child] = pin.SE3(pin.SE3.Random().rotation, point)
            q = rng.normal(size=4)
            found[child].rotation = pin.Quaternion(q / np.linalg.norm(q)).toRotationMatrix()
        return found

    def urdf(self, dialect="constraint"):
        frames = self.frames()
        out = ['<robot name="sketch">', '<link name="ground"/>']
        for name, (mass, com, inertia) in self.links.items():
            at = frames[name]
            c, i = at.actInv(com), at.rotation.T @ inertia @ at.rotation
            moments = (
                " ".join(f'i{"xyz"[j]}{"xyz"[k]}="{i[j, k]!r}"' for j in range(3) for k in range(j, 3))
                .replace("np.float64(", "")
                .replace(")", "")
            )
            out.append(
                f'<link name="{name}"><inertial><origin xyz="{text(c)}"/><mass value="{mass}"/>'
                f"<inertia {moments}/></inertial></link>"
            )
        for name, kind, parent, child, _, axis, value in self.joints:
            local = frames[child].rotation.T @ axis
            move = pin.SE3.Identity()
            if kind == "revolute":
                move.rotation = pin.AngleAxis(value, local).toRotationMatrix()
            else:
                move.translation = local * value
            origin = frames[parent].actInv(frames[child]) * move.inverse()
            out.append(
                f'<joint name="{name}" type="{kind}"><parent link="{parent}"/>'
                f'<child link="{child}"/>{pose("origin", origin)}<axis xyz="{text(2 * local)}"/>'
                '<limit lower="-9" upper="9" velocity="7" effort="50"/>'
                '<dynamics damping="0.1" friction="0.2"/></joint>'
            )
        pairs = []
        # Pinocchio has two numbers for a joint without limits.
        hinge, limit = "continuous", ""
        if dialect == "spheres":
            hinge, limit = "revolute", '<limit lower="-9" upper="9" velocity="7" effort="50"/>'
        for name, kind, a, b, point, axis in self.closures:
            # The two frames differ in orientation but by what the dialect lets open.
            frame = pin.SE3(frames[a].rotation, point)
            ends = [frames[link].actInv(frame) for link in (a, b)]
            local = text(frame.rotation.T @ axis)
            if dialect == "constraint":
                out.append(
                    f'<constraint name="{name}" type="{kind}_joint"><parent link="{a}"/>'
                    f'{pose("parent_origin", ends[0])}<parent_axis xyz="{local}"/>'
                    f'<child link="{b}"/>{pose("child_origin", ends[1])}</constraint>'
                )
            elif dialect == "loop":
                out.append(
                    f'<loop name="{name}" type="{kind}"><predecessor link="{a}">'
                    f'{pose("origin", ends[0])}</predecessor><successor link="{b}">'
                    f'{pose("origin", ends[1])}</successor><axis xyz="{local}"/></loop>'
                )
            else:
                for end, link, side in zip(ends, (a, b), "AB", strict=True):
                    turns = kind == "revolute" and (side == "A" or dialect == "spheres")
                    out.append(
                        f'<link name="{name}_{side}">{SPHERE if dialect == "spheres" else ""}'
                        f'</link><joint name="{name}_{side}_frame" '
                        f'type="{hinge if turns else "fixed"}"><parent link="{link}"/>{limit}'
                        f'<child link="{name}_{side}"/>{pose("origin", end)}'
                        f'<axis xyz="{local}"/></joint>'
                    )
                pairs.append(([f"{name}_A", f"{name}_B"], "6d" if kind == "revolute" else "3D"))
        if dialect not in ("yaml", "spheres"):
            commands = "".join(
                f'<joint name="{name}"><command_interface name="effort"/></joint>' for name in self.actuated
            )
            out.append(f'<ros2_control name="s" type="system">{commands}</ros2_control>')
        out.append("</robot>")
        beside = {
            "closed_loop": [pair for pair, _ in pairs],
            "type": [kind for _, kind in pairs],
            "name_mot": self.actuated,
        }
        return "\n".join(out), (beside if dialect in ("yaml", "spheres") else None)

    def save(self, folder, dialect="constraint"):
        content, beside = self.urdf(dialect)
        path = folder / f"{dialect}.urdf"
        path.write_text(content)
        if beside is not None:
            path.with_suffix(".yaml").write_text("\n".join(f"{key}: {value}" for key, value in beside.items()))
        return path

    def model(self):
        """The tree in Pinocchio, its data, and the closures as frames (link a, link b)."""
        model = pin.buildModelFromXML(self.urdf()[0])
        frames = self.frames()
        ends = []
        for name, kind, a, b, point, axis in self.closures:
            frame = pin.SE3(frames[a].rotation, point)
            pair = []
            for link in (a, b):
                body = model.frames[model.getFrameId(link)]
                place = body.placement * frames[link].actInv(frame)
                pair.append(
                    model.addFrame(pin.Frame(f"{name}_{link}", body.parentJoint, place, pin.FrameType.OP_FRAME))
                )
            ends.append((kind, *pair, frame.rotation.T @ axis))
        return model, model.createData(), ends


def text(values):
    return " ".join(repr(float(v)) for v in values)


def pose(tag, at):
    rpy = pin.rpy.matrixToRpy(at.rotation)
    return f'<{tag} xyz="{text(at.translation)}" rpy="{text(rpy)}"/>'


def closure_rows(model, data, ends, q):
    """The closures' residual and Jacobian, in Pinocchio's joint rates."""
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    values, rows = [], []
    for kind, a, b, axis in ends:
        ja, jb = (pin.getFrameJacobian(model, data, f, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED) for f in (a, b))
        values.append(data.oMf[b].translation - data.oMf[a].translation)
        rows.append(jb[:3] - ja[:3])
        if kind == "fixed":
            values.append(pin.log3(data.oMf[b].rotation @ data.oMf[a].rotation.T))
            rows.append(jb[3:] - ja[3:])
        elif kind == "revolute":
            u, v = (data.oMf[f].rotation @ axis for f in (a, b))
            side = np.eye(3) - np.outer(u, u)
            values.append(np.cross(u, v))
            rows.append(side @ (jb[3:] - ja[3:]))
    return np.concatenate(values), np.vstack(rows)


class Tree:
    """A tree in Pinocchio with closures as ``closure_rows`` has them, and its actuated joints."""

    def __init__(self, model, ends, actuated):
        self.model, self.data, self.ends = model, model.createData(), ends
        self.driven = [model.joints[model.getJointId(name)].idx_v for name in actuated]
        self.loose = [i for i in range(model.nv) if i not in self.driven]

    def rows(self, q):
        """How far the closures are open, and their rates."""
        return closure_rows(self.model, self.data, self.ends, q)

    def _follow(self, rates, known, bias):
        full = np.zeros(self.model.nv)
        full[self.driven] = known
        rest = -bias - rates[:, self.driven] @ known
        full[self.loose] = np.linalg.lstsq(rates[:, self.loose], rest, rcond=1e-6)[0]
        return full

    def torques(self, q, qd, qdd):
        """Efforts of the motors, all other joints rubbing."""
        _, rates = self.rows(q)
        v = self._follow(rates, qd, np.zeros(len(rates)))
        step = 1e-5
        before, after = (self.rows(q + s * step * v)[1] for s in (-1, 1))
        a = self._follow(rates, qdd, (after - before) @ v / (2 * step))
        damping, friction = self.model.damping, self.model.friction
        efforts = pin.rnea(self.model, self.data, q, v, a) + damping * v + friction * np.sign(v)
        select = np.eye(self.model.nv)[:, self.driven]
        _, rates = self.rows(q)
        solved = np.linalg.lstsq(np.hstack([select, rates.T]), efforts, rcond=1e-6)[0]
        return solved[: len(self.driven)]


def four_bar():
    s = Sketch(seed=1)
    a, b, c, d = [0, 0, 0], [0.1, 0, 0.3], [0.6, 0, 0.4], [0.5, 0, 0]
    y = [0, 1, 0]
    s.link("crank", 1.0, [0.05, 0, 0.15])
    s.link("coupler", 0.7, [0.3, 0.01, 0.4])
    s.link("platform", 0.9, [0.55, 0, 0.2])
    s.joint("motor", "revolute", "ground", "crank", a, y, 0.3, actuated=True)
    s.joint("elbow", "revolute", "crank", "coupler", b, y, -0.2)
    s.joint("rocker", "revolute", "ground", "platform", d, y, 0.25)
    s.loop("pin", "revolute", "coupler", "platform", c, y)
    return s


def five_bar():
    s = Sketch(seed=2)
    s.link("arm_1", 0.5, [-0.2, 0.1, 0])
    s.link("fore_1", 0.3, [-0.15, 0.35, 0])
    s.link("arm_2", 0.5, [0.2, 0.1, 0])
    s.link("platform", 0.3, [0.15, 0.35, 0])
    s.joint("m2", "revolute", "ground", "arm_2", [0.1, 0, 0], Z, -0.2, actuated=True)
    s.joint("m1", "revolute", "ground", "arm_1", [-0.1, 0, 0], -Z, 0.15, actuated=True)
    s.joint("e1", "revolute", "arm_1", "fore_1", [-0.3, 0.2, 0], Z, 0.1)
    s.joint("e2", "revolute", "arm_2", "platform", [0.3, 0.2, 0], Z, 0.3)
    s.loop("tip", "revolute", "fore_1", "platform", [0, 0.5, 0])
    return s


def rrr3():
    s = Sketch(seed=3)
    s.link("platform", 1.0, [0.01, 0.02, 0.0])
    for i in range(3):
        angle = 2.0 * np.pi * i / 3
        turn = pin.AngleAxis(angle, Z).toRotationMatrix()
        base, elbow, tip = (turn @ p for p in ([0.5, 0, 0], [0.4, 0.3, 0], [0.15, 0.05, 0]))
        s.link(f"arm_{i}", 0.4, (base + elbow) / 2)
        s.link(f"fore_{i}", 0.3, (elbow + tip) / 2)
        s.joint(f"m{i}", "revolute", "ground", f"arm_{i}", base, Z, 0.1 * i, actuated=True)
        s.joint(f"e{i}", "revolute", f"arm_{i}", f"fore_{i}", elbow, Z, -0.1)
        if i == 0:
            s.joint("tip0", "revolute", "fore_0", "platform", tip, Z, 0.2)
        else:
            s.loop(f"tip{i}", "revolute", f"fore_{i}", "platform", tip)
    return s


def delta():
    """Six bars between ball joints; the platform hangs on the first."""
    s = Sketch(seed=4)
    s.link("platform", 0.4, [0.0, 0.01, -0.5])
    for i in range(3):
        turn = pin.AngleAxis(2.0 * np.pi * i / 3, Z).toRotationMatrix()
        y = turn @ [0, 1, 0]
        hip, elbow, tip = (turn @ p for p in ([0.2, 0, 0], [0.4, 0, -0.1], [0.08, 0, -0.5]))
        s.link(f"arm_{i}", 0.5, (hip + elbow) / 2)
        s.joint(f"m{i}", "revolute", "ground", f"arm_{i}", hip, y, 0.1 - 0.1 * i, actuated=True)
        for side in (-1, 1):
            bar, off = f"bar_{i}{'_ab'[side]}", 0.05 * side * y
            along = (tip - elbow) / np.linalg.norm(tip - elbow)
            s.link(bar, 0.05, (elbow + tip) / 2 + off, size=0.01)
            s.universal(f"u_{bar}", f"arm_{i}", bar, elbow + off, y, np.cross(along, y), (0.05, 0.1))
            if i == 0 and side == -1:
                for k, axis in enumerate((X, [0, 1, 0], Z)):
                    child = "platform" if k == 2 else f"socket_{k}"
                    if k < 2:
                        s.link(child, 0.0, tip + off)
                    parent = bar if k == 0 else f"socket_{k - 1}"
                    s.joint(f"ball_{k}", "revolute", parent, child, tip + off, axis, 0.05 * k)
            else:
                s.loop(f"end_{bar}", "spherical", bar, "platform", tip + off)
    return s


def stewart():
    s = Sketch(seed=5)
    s.link("platform", 3.0, [0.0, 0.01, 0.62])
    for i in range(6):
        a, b = (
            np.pi / 3 * (i // 2) * 2 + (0.2, -0.2)[i % 2],
            np.pi / 3 * (i // 2) * 2 + (0.9, -0.9)[i % 2],
        )
        foot = np.array([0.5 * np.cos(a), 0.5 * np.sin(a), 0.0])
        head = np.array([0.3 * np.cos(b), 0.3 * np.sin(b), 0.6])
        along = (head - foot) / np.linalg.norm(head - foot)
        first = np.cross(along, Z) / np.linalg.norm(np.cross(along, Z))
        s.link(f"tube_{i}", 0.8, foot + 0.2 * along)
        s.link(f"piston_{i}", 0.5, head - 0.2 * along)
        s.universal(f"u{i}", "ground", f"tube_{i}", foot, first, np.cross(along, first), (0.1, -0.05))
        s.joint(
            f"m{i}",
            "prismatic",
            f"tube_{i}",
            f"piston_{i}",
            head,
            along,
            0.02 * i - 0.05,
            actuated=True,
        )
        if i == 0:
            for k, axis in enumerate((X, [0, 1, 0], Z)):
                child = "platform" if k == 2 else f"socket_{k}"
                if k < 2:
                    s.link(child, 0.0, head)
                parent = "piston_0" if k == 0 else f"socket_{k - 1}"
                s.joint(f"ball_{k}", "revolute", parent, child, head, axis, 0.1 - 0.1 * k)
        else:
            s.loop(f"head_{i}", "spherical", f"piston_{i}", "platform", head)
    return s


def palletizer():
    """Two motors move the platform in a plane; two parallelograms keep it from turning.

    At the closed assembly both motors are at zero and no other joint is.
    """
    s = Sketch(seed=6)
    y, drive = [0, 1, 0], np.array([-0.02, 0, 0])
    far, elbow_1, elbow_2 = (np.array(p) for p in ([0.02, 0, 0], [-0.09, 0, -0.05], [0.1, 0, -0.04]))
    tip, side = np.array([0.01, 0, -0.14]), np.array([0.02, 0, 0.03])
    foot, lift = far + np.array([0.03, 0, 0.01]), np.array([0.03, 0, 0.01])
    s.link("arm_1", 0.05, (drive + elbow_1) / 2, size=0.02)
    s.link("fore_1", 0.04, (elbow_1 + tip) / 2, size=0.02)
    s.link("platform", 0.06, tip + np.array([0.005, 0.002, 0]), size=0.02)
    s.link("arm_2", 0.05, (far + elbow_2) / 2, size=0.02)
    s.link("fore_2", 0.04, (elbow_2 + tip) / 2, size=0.02)
    s.link("guide_1", 0.02, (foot + elbow_2 + lift) / 2, size=0.02)
    s.link("corner", 0.02, elbow_2 + lift / 2, size=0.02)
    s.link("guide_2", 0.02, (elbow_2 + side + tip + side) / 2, size=0.02)
    s.joint("m1", "revolute", "ground", "arm_1", drive, y, 0.0, actuated=True)
    s.joint("e1", "revolute", "arm_1", "fore_1", elbow_1, y, 0.7)
    s.joint("t1", "revolute", "fore_1", "platform", tip, y, -0.9)
    s.joint("m2", "revolute", "ground", "arm_2", far, y, 0.0, actuated=True)
    s.joint("e2", "revolute", "arm_2", "fore_2", elbow_2, y, 0.5)
    s.joint("g1", "revolute", "ground", "guide_1", foot, y, -0.6)
    s.joint("g2", "revolute", "guide_1", "corner", elbow_2 + lift, y, 1.1)
    s.joint("g3", "revolute", "corner", "guide_2", elbow_2 + side, y, -0.4)
    s.loop("tip", "revolute", "fore_2", "platform", tip, y)
    s.loop("elbow", "revolute", "corner", "fore_2", elbow_2, y)
    s.loop("side", "revolute", "guide_2", "platform", tip + side, y)
    return s


SKETCHES = {f.__name__: f for f in (four_bar, five_bar, rrr3, delta, stewart)}
