# SPDX-License-Identifier: Apache-2.0
"""Machines in the graph form, with every type of joint, rods, and joints given backwards."""

from __future__ import annotations

import numpy as np

from pkm_twin.machine.graph import Body, Graph, Joint, Rod, array
from pkm_twin.machine.loop_tree import singles
from pkm_twin.machine.tree import Tree
from pkm_twin.robot.robot_urdf import graph_tree


def turned(angle, vector):
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vector
    return [float(c * x - s * y), float(s * x + c * y), float(z)]


def body(mass, com, size=0.01):
    moments = [mass * size, mass * size * 1.2, mass * size * 1.5]
    return {"mass": mass, "com": com, "inertia": moments}


def five_bar():
    """All in one plane, a joint given backwards, the platform's inertia with products."""
    tool = [[2e-3, 1e-4, 0.0], [1e-4, 3e-3, 2e-4], [0.0, 2e-4, 4e-3]]
    z = [0.0, 0.0, 1.0]
    return {
        "mechanism": "machine",
        "platform": "tool",
        "origin": [0.0, 0.5, 0.02],
        "pose": ["x", "y"],
        "bodies": {
            "arm_1": body(0.5, [-0.2, 0.1, 0.0]),
            "arm_2": body(0.5, [0.2, 0.1, 0.0]),
            "fore": body(0.3, [-0.15, 0.35, 0.0]),
            "tool": {"mass": 0.4, "com": [0.1, 0.4, 0.0], "inertia": tool},
        },
        "joints": {
            "left": {
                "type": "revolute",
                "between": ["base", "arm_1"],
                "at": [-0.1, 0.0, 0.0],
                "axis": z,
                "actuated": True,
                "home": 0.4,
                "limits": {"position": [-1.0, 1.5], "velocity": 20.0, "effort": 5.0},
                "friction": {"viscous": 0.02, "coulomb": 0.1},
            },
            "right": {
                "type": "revolute",
                "between": ["arm_2", "base"],
                "at": [0.1, 0.0, 0.0],
                "axis": z,
                "actuated": True,
            },
            "elbow_1": {
                "type": "revolute",
                "between": ["arm_1", "fore"],
                "at": [-0.3, 0.2, 0.0],
                "axis": z,
            },
            "elbow_2": {
                "type": "revolute",
                "between": ["tool", "arm_2"],
                "at": [0.3, 0.2, 0.0],
                "axis": z,
                "home": -0.3,
            },
            "tip": {
                "type": "revolute",
                "between": ["fore", "tool"],
                "at": [0.0, 0.5, 0.0],
                "axis": z,
            },
        },
    }


def rod_delta(carried):
    """Vertical rails; the platform carried in translation by one rod a limb, or by six rods."""
    data = {
        "platform": "platform",
        "origin": [0.0, 0.0, -0.42],
        "payload": {"mass": 0.2, "com": [0.0, 0.01, -0.03], "inertia": [1e-4, 1e-4, 2e-4]},
        "bodies": {"platform": body(0.35, [0.0, 0.0, -0.4])},
        "joints": {},
        "rods": {},
    }
    for i in range(3):
        a = 2.0 * np.pi * i / 3 + np.pi / 2
        data["bodies"][f"carriage_{i}"] = body(0.2, turned(a, [0.3, 0.0, 0.0]))
        data["joints"][f"rail_{i}"] = {
            "type": "prismatic",
            "between": ["base", f"carriage_{i}"],
            "axis": [0.0, 0.0, 1.0],
            "actuated": True,
            "home": 0.6,
            "limits": {"position": [0.2, 0.8]},
        }
        for side in (0.0,) if carried else (-0.04, 0.04):
            data["rods"][f"rod_{i}{'n' if side < 0 else 'p'}"] = {
                "between": [f"carriage_{i}", "platform"],
                "ends": [turned(a, [0.28, side, 0.0]), turned(a, [0.05, side, -0.4])],
                "mass": 0.03,
            }
    if carried:
        data["joints"]["guide"] = {"type": "translation", "between": ["platform", "base"]}
    return data


def stewart():
    """Universal, prismatic, spherical; a machine's body has the name of a link that is taken."""
    data = {
        "platform": "platform",
        "bodies": {"platform": body(3.0, [0.0, 0.01, 0.62])},
        "joints": {},
    }
    for i in range(6):
        a = 2.0 * np.pi * (i // 2) / 3
        foot = np.array(turned(a + (0.2, -0.2)[i % 2], [0.5, 0.0, 0.0]))
        head = np.array(turned(a + (0.9, -0.9)[i % 2], [0.3, 0.0, 0.6]))
        along = (head - foot) / np.linalg.norm(head - foot)
        first = np.cross(along, [0.0, 0.0, 1.0])
        tube, piston = ("base_link", f"piston_{i}") if i == 0 else (f"tube_{i}", f"piston_{i}")
        data["bodies"][tube] = body(0.8, (foot + 0.2 * along).tolist())
        data["bodies"][piston] = body(0.5, (head - 0.2 * along).tolist())
        axes = [first.tolist(), np.cross(along, first).tolist()]
        between = ["base", tube]
        if i == 1:
            axes, between = axes[::-1], between[::-1]
        data["joints"][f"u{i}"] = {
            "type": "universal",
            "between": between,
            "at": foot.tolist(),
            "axes": axes,
        }
        data["joints"][f"leg_{i}"] = {
            "type": "prismatic",
            "between": [tube, piston],
            "at": head.tolist(),
            "axis": along.tolist(),
            "actuated": True,
            "home": 0.7,
        }
        data["joints"][f"ball_{i}"] = {
            "type": "spherical",
            "between": [piston, "platform"],
            "at": head.tolist(),
        }
    return data


def slides():
    """Three driven slides, each with a cylindrical joint, across one another; a fixed part."""
    data = {
        "platform": "block",
        "origin": [0.0, 0.0, 0.0],
        "bodies": {"block": body(1.0, [0.0, 0.0, 0.0]), "tool": body(0.1, [0.0, 0.0, -0.1])},
        "joints": {
            "grip": {"type": "fixed", "between": ["block", "tool"], "at": [0.0, 0.0, -0.05]}
        },
    }
    for i, name in enumerate("xyz"):
        drive, across = np.eye(3)[i], np.eye(3)[(i + 1) % 3]
        at = (0.3 * np.eye(3)[(i + 2) % 3]).tolist()
        data["bodies"][f"cart_{name}"] = body(0.3, at)
        data["joints"][f"drive_{name}"] = {
            "type": "prismatic",
            "between": ["base", f"cart_{name}"],
            "at": at,
            "axis": drive.tolist(),
            "actuated": True,
        }
        data["bodies"][f"bush_{name}"] = body(0.1, at)
        data["joints"][f"bush_{name}"] = {
            "type": "cylindrical",
            "between": [f"cart_{name}", f"bush_{name}"],
            "at": at,
            "axis": across.tolist(),
        }
        data["joints"][f"slide_{name}"] = {
            "type": "prismatic",
            "between": [f"bush_{name}", "block"],
            "at": at,
            "axis": np.eye(3)[(i + 2) % 3].tolist(),
        }
    return data


DESCRIPTIONS = {
    "five_bar": five_bar,
    "rods_and_guide": lambda: rod_delta(True),
    "six_rods": lambda: rod_delta(False),
    "stewart": stewart,
    "slides": slides,
}


def graph_of(data):
    bodies = {}
    for name, part in data["bodies"].items():
        inertia = np.array(part["inertia"])
        inertia = np.diag(inertia) if inertia.ndim == 1 else inertia
        bodies[name] = Body(name, part["mass"], array(part["com"]), array(inertia))
    joints = {}
    for name, j in data["joints"].items():
        axes = np.reshape(j.get("axes", j.get("axis", [])), (-1, 3))
        at = j.get("at", data["bodies"].get(j["between"][1], {"com": [0.0] * 3})["com"])
        friction = j.get("friction", {})
        joints[name] = Joint(
            name,
            j["type"],
            *j["between"],
            array(at),
            array(axes),
            j.get("actuated", False),
            j.get("home", 0.0),
            friction.get("viscous", 0.0),
            friction.get("coulomb", 0.0),
        )
    rods = {
        name: Rod(name, *r["between"], array(r["ends"]), r["mass"])
        for name, r in data.get("rods", {}).items()
    }
    platform = data["platform"]
    origin = array(data.get("origin", data["bodies"][platform]["com"]))
    return Graph(bodies, joints, rods, platform, origin)


def tree_of(data):
    """The tree that is written, its single joints' names and their values at home."""
    graph = graph_of(data)
    drives = {}
    for name, j in data["joints"].items():
        if j.get("actuated"):
            drives[name] = {"limits": j.get("limits", {}), **j.get("friction", {})}
    load = data.get("payload")
    if load is not None:
        load = Body("payload", load["mass"], array(load["com"]), np.diag(load["inertia"]))
    written = graph_tree(graph, Tree(graph), "machine", drives, load)
    parts = [
        part for hung in written.hung for part in singles(*hung, set()) if part.kind != "fixed"
    ]
    return written, [part.name for part in parts], np.array([part.home for part in parts])
