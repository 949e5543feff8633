# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Machines of the folder ``machines``, and shipped ones, of other dimensions and masses.

What may move without costing a machine its mobility differs: a planar machine's joints may move
anywhere (their axes stay parallel), a spherical one's axes may turn anywhere through the centre, a
parallelogram's rods move in pairs. FREE says it for each.
"""

import copy
import math
from pathlib import Path

import numpy as np

from pkm_twin.certify.description import expand, tensor
from pkm_twin.certify.maximal import Maximal, rotation_of
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.mechanisms.catalogue import config_folder

MACHINES = Path(__file__).resolve().parent / "machines"
SHIPPED = ("five_bar", "linear_delta", "rps3", "stewart")
"""Machines that stand with the shipped robots."""
FILES = {path.stem: path for path in MACHINES.glob("*.yaml")}
FILES |= {name: config_folder() / f"{name}.yaml" for name in SHIPPED}
GALLERY = MACHINES.parents[2] / "examples/machines"
FILES["rrr3_planar"] = GALLERY / "rrr3_planar.yaml"
NAMES = sorted(FILES)

ANY, X, XZ, YZ = (1, 1, 1), (1, 0, 0), (1, 0, 1), (0, 1, 1)
SHIFT = 0.012
"""Greatest shift of a point, m."""
TURN = 0.12
"""Greatest change of an axis, part of its length."""


def at(*joints, mask=ANY):
    return [([f"joints.{name}.at"], SHIFT, mask) for name in joints]


def axis(*joints, mask=ANY):
    return [([f"joints.{name}.axis"], TURN, mask) for name in joints]


def axes(*joints):
    return [([f"joints.{name}.axes.{k}"], TURN, ANY) for name in joints for k in (0, 1)]


def ends(*rods, mask=ANY):
    """Both ends of each group of rods; the rods of a group keep their places to each other."""
    return [([f"rods.{name}.ends.{k}" for name in group.split()], SHIFT, mask) for group in rods for k in (0, 1)]


def each(count, make):
    return [entry for n in range(1, count + 1) for entry in make(n)]


FREE = {
    "arm_2r": at("shoulder", "elbow"),
    "bolted": at("motor", "crank_pin", "rocker_foot", "rocker_pin", "bolt_low"),
    "delta_rcu": [
        *ends("left_1", "right_1", "left_2", "right_2"),
        *at("drive_1", "drive_2", "rcu_drive_1", "elbow_1", "wrist_1"),
        *axis("drive_1", "drive_2", "rcu_drive_1", "elbow_1"),
        *axes("wrist_1"),
    ],
    "delta_translation": each(3, lambda n: ends(f"forearm_{n}") + at(f"drive_{n}") + axis(f"drive_{n}")),
    "elbow_motors": each(3, lambda n: at(f"foot_{n}", f"motor_{n}", f"wrist_{n}")),
    "five_bar": at("left", "right", "elbow_left", "elbow_right", "tip"),
    "four_bar": at("motor", "crank_pin", "rocker_foot", "rocker_pin"),
    "gantry": axis("long", "cross", "lift"),
    "hinged_platform": [
        *ends("rod_1_left rod_1_right", "rod_2", "rod_3", "rod_4"),
        *at("hinge", "drive_1", "drive_2", "drive_3", "drive_4"),
        # The first arm's axis stays along its rods' distance, or they part as it turns.
        *axis("hinge", "drive_2", "drive_3", "drive_4"),
    ],
    "linear_delta": each(3, lambda n: ends(f"left_{n} right_{n}") + axis(f"rail_{n}")),
    "platform_motor": at("left", "right", "turn", "elbow_left", "elbow_right", "tip"),
    "prru3": each(
        3,
        lambda n: [
            *at(f"swing_{n}", f"twist_{n}", f"head_{n}"),
            *axis(f"slide_{n}", f"swing_{n}", f"twist_{n}"),
            *axes(f"head_{n}"),
        ],
    ),
    "rccc": at("motor", "first", "second", "third") + axis("motor", "first", "second", "third"),
    "rcuu": [
        *at("motor", "sleeve", "cross", "foot"),
        *axis("motor", "sleeve"),
        *axes("cross", "foot"),
    ],
    "rps3": each(3, lambda n: at(f"hinge_{n}", f"ball_{n}") + axis(f"hinge_{n}") + axis(f"leg_{n}")),
    "rrr3_planar": each(3, lambda n: at(f"motor_{n}", f"elbow_{n}", f"wrist_{n}")),
    "rrr3_spherical": each(3, lambda n: axis(f"motor_{n}", f"middle_{n}", f"crown_{n}")),
    "rsur": at("motor", "ball", "cross", "pivot") + axis("motor", "pivot") + axes("cross"),
    "slider_crank": at("motor", "big_end", "small_end") + axis("slide", mask=XZ),
    "stewart": each(
        3,
        lambda n: (
            [
                entry
                for leg in (f"a_{n}", f"b_{n}")
                for entry in (*at(f"foot_{leg}", f"ball_{leg}"), *axes(f"foot_{leg}"))
            ]
            + axis(f"leg_a_{n}", f"leg_b_{n}")
        ),
    ),
    "upr_rpu": [
        *at("foot_1", "foot_2", mask=X),
        *at("head_1", "head_2", "foot_3", "head_3"),
        *axis("limb_1", "limb_2", mask=XZ),
        *axis("limb_3", mask=YZ),
    ],
}


def plain(name):
    """The mapping of a machine's file, with numbers for expressions."""
    return written_out(read_yaml(FILES[name]))


def written_out(data):
    """A file's data with the numbers of its expressions, by Python itself."""
    known, left = vars(math).copy(), dict(data.get("parameters", {}))
    while left:
        name = next(iter(left))
        value = left.pop(name)
        try:
            known[name] = eval(str(value), {}, known)
        except NameError:
            left[name] = value

    def walk(value, key=""):
        if isinstance(value, dict):
            return {k: walk(v, k) for k, v in value.items()}
        if isinstance(value, list) and key not in ("between", "pose"):
            return [walk(v) for v in value]
        text = isinstance(value, str) and key not in ("mechanism", "type", "platform")
        return eval(value, {}, known) if text else value

    return {k: walk(v, k) for k, v in data.items() if k not in ("parameters", "uncertainty")}


def variant(name, rng):
    """A machine of other dimensions, masses and surroundings, limbs written out.

    Its condition at home is no worse than a third of the machine's own.
    """
    own = Maximal(plain(name)).home
    while True:
        data = changed(name, rng)
        home = Maximal(data).home
        if home.condition > own.condition / 3:
            # What FREE lets move must keep mobility and redundancy.
            assert (home.mobility, home.rank) == (own.mobility, own.rank), name
            return data


def changed(name, rng):
    data = copy.deepcopy(expand(plain(name)))
    for paths, amount, mask in FREE[name]:
        shift = rng.uniform(-amount, amount, 3) * mask
        for path in paths:
            *way, last = path.split(".")
            holder = data
            for key in way:
                holder = holder[int(key) if isinstance(holder, list) else key]
            last = int(last) if isinstance(holder, list) else last
            size = np.linalg.norm(holder[last]) if amount == TURN else 1.0
            holder[last] = (np.array(holder[last]) + size * shift).tolist()
    weigh(data, rng)
    place(data, rng)
    return data


def weigh(data, rng):
    """Other masses, friction, payload and gravity."""
    for body in data["bodies"].values():
        if body.get("mass"):
            body["mass"] *= rng.uniform(0.5, 2.0)
            body["com"] = (np.array(body["com"]) + rng.uniform(-0.02, 0.02, 3)).tolist()
            body["inertia"] = inertia(np.trace(tensor(body["inertia"])), rng)
    for rod in data["rods"].values():
        rod["mass"] *= rng.uniform(0.5, 2.0)
    for joint in data["joints"].values():
        if joint["type"] in ("revolute", "prismatic"):
            joint["friction"] = {"viscous": rng.uniform(0.0, 0.1), "coulomb": rng.uniform(0.0, 0.1)}
            if joint.get("actuated"):
                joint["rotor_inertia"] = rng.uniform(0.0, 0.01)
    data["payload"] = {
        "mass": rng.uniform(0.1, 2.0),
        "com": rng.uniform(-0.05, 0.05, 3).tolist(),
        "inertia": inertia(rng.uniform(1e-4, 1e-2), rng),
    }
    data["gravity"] = (rng.normal(size=3) * 6.0).tolist()


def inertia(size, rng):
    """A full inertia matrix of some mass distribution, of about this trace."""
    second = rng.normal(size=(3, 3))
    second = second @ second.T
    moments = np.trace(second) * np.eye(3) - second
    moments = (moments + moments.T) / 2
    return (moments * size / np.trace(moments)).tolist()


def place(data, rng):
    """Another size, another place on the base, and joints that count from elsewhere."""
    scale, turn = rng.uniform(0.6, 1.8), rotation_of(rng.uniform(-0.25, 0.25, 3))
    shift = rng.uniform(-0.3, 0.3, 3)

    def point(v):
        return (scale * turn @ np.array(v) + shift).tolist()

    def direction(v):
        return (turn @ np.array(v)).tolist()

    platform = data["bodies"][data["platform"]]
    data["origin"] = point(data.get("origin", platform["com"]))
    for body in data["bodies"].values():
        if "com" in body:
            body["com"] = point(body["com"])
            body["inertia"] = (turn @ tensor(body["inertia"]) @ turn.T).tolist()
    for joint in data["joints"].values():
        if "at" in joint:
            joint["at"] = point(joint["at"])
        if "axis" in joint:
            joint["axis"] = direction(joint["axis"])
        if "axes" in joint:
            joint["axes"] = [direction(v) for v in joint["axes"]]
        if joint.get("actuated"):
            home = joint.get("home", 0.0)
            grown = scale if joint["type"] == "prismatic" else 1.0
            joint["home"] = float(rng.uniform(-1.0, 1.0))
            limits = [joint["home"] + grown * (v - home) for v in joint["limits"]["position"]]
            joint["limits"] = {"position": limits}
    for rod in data["rods"].values():
        rod["ends"] = [point(end) for end in rod["ends"]]
