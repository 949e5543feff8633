# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Pinocchio in C++ and the exported C on the same machine, in one program, into docs/export_c.md.

``python -m test.benchmarks.pinocchio_c docs/export_c.md``: needs g++, Eigen's headers and the wheel
of Pinocchio, whose headers are compiled with the same flags as the exported C. A number of states
in place of a page compares Python, the exported C and Pinocchio at so many, and times none.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pinocchio

from delta_dynamics import inverse_dynamics
from pkm_twin import load
from pkm_twin.export.c_package import c_package
from pkm_twin.machine.joints import perpendicular_axes
from pkm_twin.machine.mjcf_write import list_bodies
from pkm_twin.machine.tree import axes_with_z
from pkm_twin.machine.urdf_write import GROUND
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.robot_urdf import robot_description, robot_tree
from test.support.robots import joint_range

ROBOTS = "delta", "delta_cu", "linear_delta", "prru", "rps3", "stewart"
SAMPLES, ROUNDS = 1000, 15
BOUND = 1e-9
"""Of differences, relative to a robot's largest torque."""
RATES = np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0, 13.0])
"""Of the joints, Hz: no two have a common multiple, so a long motion fills its box."""
FLAGS = "-O3", "-march=native", "-DNDEBUG", "-w"
DEFINED = (
    "-DBOOST_MPL_LIMIT_LIST_SIZE=30",
    "-DBOOST_MPL_LIMIT_VECTOR_SIZE=30",
    "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
    "-DBOOST_FUSION_INVOKE_MAX_ARITY=12",
)
"""As Pinocchio's own build has it."""
HERE = Path(__file__).parent
HEAD = "| robot | joints of the tree |"


def frame(turned, at):
    return np.block([[turned, np.reshape(at, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


def flat(*parts):
    return " ".join(repr(float(x)) for part in parts for x in np.ravel(part))


def description(robot):
    """The tree in numbers, as the program reads it; lines."""
    tree = robot_tree(robot)
    places = {GROUND: (0, np.eye(4))}
    joints, inertias, numbers, home = [], [], {}, []
    for parent, child, row in list_bodies(tree):
        index, above = places[parent]
        for part in row:
            here = frame(axes_with_z(part.axis, perpendicular_axes(part.axis)[0]), part.joint.at)
            zero = here.copy()
            c, s = np.cos(part.home), np.sin(part.home)
            if part.kind == "revolute":
                zero[:3, :3] = here[:3, :3] @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
            else:
                zero[:3, 3] -= part.home * part.axis
            at = np.linalg.inv(above) @ zero
            kind = "R" if part.kind == "revolute" else "P"
            joints.append(f"{index} {kind} {flat(at[:3, :3], at[:3, 3])}")
            index, above = len(joints), here
            numbers[part.name] = index - 1
            home.append(part.home)
        places[child] = index, above
        link = tree.links[child]
        if link.mass and index:
            turned = above[:3, :3]
            com = turned.T @ (link.com - above[:3, 3])
            about = turned.T @ link.inertia @ turned
            inertias.append(f"{index} {flat([link.mass], com, about)}")
    points, angles = [], []
    for closure in tree.closures:
        ends = [places[closure.inner], places[closure.outer]]
        local = [(np.linalg.inv(above) @ [*closure.at, 1.0])[:3] for _, above in ends]
        points += [f"{index} {flat(at)}" for (index, _), at in zip(ends, local, strict=True)]
        pairs = []
        if closure.kind == "universal":
            pairs = [closure.axes]
        elif closure.kind == "revolute":
            pairs = [(e, closure.axes[0]) for e in perpendicular_axes(closure.axes[0])]
        elif closure.kind != "spherical":
            raise ValueError(closure.kind)
        for first, second in pairs:
            sides = [
                f"{index} {flat(above[:3, :3].T @ axis)}"
                for (index, above), axis in zip(ends, (first, second), strict=True)
            ]
            angles.append(f"{' '.join(sides)} {float(first @ second)!r}")
    lines = [str(len(joints)), *joints, str(len(inertias)), *inertias, flat(robot.gravity)]
    lines += [str(len(points) // 2), *points, str(len(angles)), *angles]
    lines += [str(robot.joints_count), *(str(numbers[name]) for name in tree.actuated)]
    return [*lines, flat(home)]


def path(robot, count, part):
    """A smooth motion through the middle part of the joints' ranges, a sample a millisecond."""
    middle, half = joint_range(robot)
    rate = 2.0 * np.pi * RATES[: len(middle)]
    angle = rate * (1e-3 * np.arange(count)[:, None]) + np.arange(len(middle))
    reach = part * half
    return (
        middle + reach * np.sin(angle),
        reach * rate * np.cos(angle),
        -reach * rate**2 * np.sin(angle),
    )


def smooth(name):
    """A robot without friction, which Pinocchio's rnea leaves out."""
    robot = load(name)
    if robot.mechanism == "machine":
        data = robot_description(robot)
        for joint in data["joints"].values():
            joint.pop("friction", None)
        return robot_of_data(data, name)
    n = robot.joints_count
    return robot.changed(friction={"viscous": [0.0] * n, "coulomb": [0.0] * n, "offset": [0.0] * n})


def measured(name, folder, program, count=SAMPLES, part=0.3, rounds=ROUNDS):
    """Of one robot what the program prints, as numbers."""
    robot = smooth(name)
    rows = description(robot)
    q, qd, qdd = path(robot, count, part)
    tau = inverse_dynamics(robot, q, qd, qdd)
    rotors = [robot.graph.joints[joint].rotor_inertia for joint in robot.graph.actuated]
    rows.append(str(count))
    for sample in zip(q, qd, qdd, tau - rotors * qdd, tau, strict=True):
        rows.append(flat(*sample))
    (folder / "machine.txt").write_text("\n".join(rows))
    for file, text in c_package(robot).items():
        (folder / file).write_text(text)
    prefix = f"pkm_{name}"
    command = ["gcc", "-std=c99", *FLAGS, "-fPIC", "-shared", f"{prefix}.c", "-o", "pkm.so", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    done = subprocess.run(
        [str(program), "machine.txt", "./pkm.so", prefix, str(rounds)],
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
    )
    return [float(word) for word in done.stdout.split()]


def compiled(folder):
    """The program, with Pinocchio's headers alone: its library is built without these flags."""
    include = Path(pinocchio.__file__).parents[4] / "include"
    program = folder / "compare"
    command = [
        "g++",
        "-std=c++17",
        *FLAGS,
        *DEFINED,
        f"-I{include}",
        "-I/usr/include/eigen3",
        str(HERE / "pinocchio.cpp"),
        "-o",
        str(program),
        "-ldl",
    ]
    subprocess.run(command, check=True)
    return program


def row(name, folder, program):
    nv, *misses, closed, bare, torques, accelerations, constrained, _ = measured(name, folder, program)
    assert max(misses) < BOUND, (name, misses)
    cells = [f"`{name}`", f"{nv:.0f}", *(f"{ns:,.0f}" for ns in (closed, bare, torques, accelerations))]
    # Its contacts are points: a closure by a universal or revolute joint is none.
    cells.append(f"{constrained:,.0f}" if constrained > 1.0 else "")
    return "| " + " | ".join(cells) + " |"


def compare(states, folder, program):
    """Print the worst differences at so many states of all robots together."""
    count = -(-states // len(ROBOTS))
    for name in ROBOTS:
        _, miss, other, change, *_ = measured(name, folder, program, count, part=0.9, rounds=0)
        print(f"{name}: {count:,} states, Pinocchio {miss:.1e}, {change:.1e}, exported C {other:.1e}", flush=True)
        assert max(miss, other, change) < BOUND, name


def write(page, folder, program):
    """Put the times into the table of a page."""
    lines = page.read_text(encoding="utf-8").splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith(HEAD)) + 2
    end = at
    while end < len(lines) and lines[end].startswith("| `"):
        end += 1
    lines[at:end] = [row(name, folder, program) for name in ROBOTS]
    page.write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        there = Path(made)
        built = compiled(there)
        if sys.argv[1].isdecimal():
            compare(int(sys.argv[1]), there, built)
        else:
            write(Path(sys.argv[1]), there, built)
