# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A robot as a ROS package of plugins for ros2_control, on its exported C.

The sources stand in ``ros2_control_package`` as they are written; words between two ``@`` stand for
the robot's names and numbers, most of them in ``include/robot.hpp``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from importlib.resources import files
from importlib.resources.abc import Traversable
from itertools import combinations
from typing import Any, Final
from xml.sax.saxutils import escape

import numpy as np
import yaml

from delta_dynamics.simulation.machine import tune_position_control
from pkm_twin.codegen.arrays import ROUNDING_NOISE, Array
from pkm_twin.errors import check_limit
from pkm_twin.export.c_package import c_identifier, c_package
from pkm_twin.machine.graph import POSE
from pkm_twin.machine.sections import MAX_LENGTH, MAX_MASS
from pkm_twin.robot.robot import Robot

CONTROLLER: Final = "feedforward_controller"
GRAVITY_CONTROLLER: Final = "gravity_controller"
TRAJECTORY_CONTROLLER: Final = "joint_trajectory_controller"
DAMPING_TIME: Final = 0.1
"""Time constant, s, of the damping of the gravity controller, by the masses at home."""
REDUNDANCY_FUNCTIONS: Final = {
    "none idle": "  (void)q;\n  (void)n;\n  return 0;",
    "idle": """\
  const int status = pkm_{}_null_efforts(model_positions(q).data(), n.data());
  for (std::size_t k = 0; k < n.size(); ++k) {{
    n[k] /= DRIVES[k % JOINTS].factor;
  }}
  return status;""",
    "independent": "  (void)q;\n  (void)qd;\n  (void)qdd;\n  return 0;",
    "project_redundant": """\
  const Vector x = model_positions(q), v = model_rates(qd), a = model_rates(qdd);
  const int status = pkm_{}_project_redundant(
    x.data(), v.data(), a.data(), q.data(), qd.data(), qdd.data());
  for (std::size_t i = 0; i < JOINTS; ++i) {{
    q[i] = DRIVES[i].offset + DRIVES[i].factor * q[i];
    qd[i] *= DRIVES[i].factor;
    qdd[i] *= DRIVES[i].factor;
  }}
  return status;""",
}
"""Bodies of C++ functions: for machines with more drives than degrees of freedom, and for others."""


def package_name(robot: Robot, kind: str = "ros2_control") -> str:
    """Return the name of a robot's ROS package: lower case, digits and single underscores (REP 144)."""
    name = re.sub(r"_+", "_", c_identifier(robot.name or robot.mechanism).lower()).strip("_")
    return f"{name if name[:1].isalpha() else f'robot_{name}'.rstrip('_')}_{kind}"


def ros2_control_package(robot: Robot, bandwidth: float = 0.0) -> dict[str, str]:
    """Write the package: the text of each file by its path.

    :param bandwidth: of the controller's gains by the masses at home, Hz; zero: no gains.
    :raises ParameterError: a robot whose file gives no masses, or an invalid bandwidth.
    """
    if bandwidth != 0.0:
        check_limit("bandwidth", bandwidth, "Hz")
    robot.massive()
    package = package_name(robot)
    words = _template_words(robot, package)
    result = {f"c/{name}": text for name, text in c_package(robot).items()}
    result["config/controllers.yaml"] = _write_controllers(robot, package, bandwidth)
    for path, text in fill_templates("ros2_control_package", words).items():
        # Headers are included by PACKAGE/NAME.hpp.
        result[path.replace("include/", f"include/{package}/")] = text
    return dict(sorted(result.items()))


def fill_templates(folder: str, words: Mapping[str, str]) -> dict[str, str]:
    """Return a folder's templates by path, with the words between two ``@`` replaced."""
    templates = _iterate_templates(files("pkm_twin.export") / folder)
    return {p: re.sub(r"@([A-Z]+)@", lambda word: words[word[1]], text) for p, text in templates}


def printable_name(robot: Robot) -> str:
    """Return the robot's name without characters that comments, tables or literals reject."""
    return re.sub(r"[^\w .:+-]", "_", robot.name or robot.mechanism)


def _iterate_templates(folder: Traversable, above: str = "") -> Iterable[tuple[str, str]]:
    for item in sorted(folder.iterdir(), key=lambda item: item.name):
        if item.is_dir():
            yield from _iterate_templates(item, f"{above}{item.name}/")
        else:
            yield f"{above}{item.name}", item.read_text(encoding="utf-8")


def _template_words(robot: Robot, package: str) -> dict[str, str]:
    """Return the texts that replace the words between two ``@`` in the templates."""
    own = c_identifier(robot.name)
    shown = printable_name(robot)
    load, controller = robot.payload, robot.controller
    home = _start_position(robot)
    directions = _choose_twist_components(robot)
    # Find a range about home in which all joints may move at once in any directions, shape (n,).
    units = np.array([1.0 if unit == "rad" else robot.graph.size for unit in robot.joint_units])
    if robot.redundant:
        # Redundant drives cannot move independently.
        ranges = np.asarray(robot.graph.sharing[0] / 4.0 * units, np.float64)
    else:
        if robot.limits.position is not None:
            room = np.abs(robot.limits.position - home[:, None]).min(1)
            units = np.where(room > 0.0, np.minimum(units, room), units)
        signs = np.array(np.meshgrid(*[(-1.0, 0.0, 1.0)] * len(home))).reshape(len(home), -1).T
        size = 0.2
        for _ in range(20):
            index, good = robot.try_singularity(home + size * units * signs)
            # The package's own test moves in this range: keep it away from singularities.
            if good.all() and (index > 0.05).all():
                break
            size /= 2.0
        ranges = np.asarray(size * units, np.float64)
    steps = np.abs(controller.factors) * ranges
    # Write one line per actuated joint, with limits in the controller's values.
    controller, limits, friction = robot.controller, robot.limits, robot.friction
    n = robot.joints_count
    position = np.array([[-np.inf, np.inf]] * n) if limits.position is None else limits.position
    # A negative factor swaps the limits; infinite ones stay infinite.
    ends = np.sort(controller.offsets[:, None] + controller.factors[:, None] * position, axis=1)
    effort = np.full(n, np.inf) if limits.effort is None else np.asarray(limits.effort)
    # Bound the velocity errors that rounding of positions causes, in the controller's units, (n,).
    controller = robot.controller
    units = np.array([1.0 if unit == "rad" else robot.graph.size for unit in robot.joint_units])
    largest = np.abs(controller.offsets) + np.abs(controller.factors) * units
    # The period is that of a fast control loop, 1 ms.
    columns = (
        controller.factors,
        controller.offsets,
        ends[:, 0],
        ends[:, 1],
        effort / np.abs(controller.factors),
        friction.viscous,
        friction.coulomb,
        _find_gravity_damping(robot),
        np.asarray(ROUNDING_NOISE * largest / 1e-3, np.float64),
    )
    lines = [
        f"  {{{write_cpp_string(name)}, {', '.join(write_cpp_number(column[k]) for column in columns)}}},"
        for k, name in enumerate(controller.names)
    ]
    return {
        "ROBOT": shown,
        "XMLROBOT": escape(shown),
        "PACKAGE": package,
        "GUARD": package.upper(),
        "PREFIX": f"pkm_{own}",
        "MACRO": f"PKM_{own}".upper(),
        "JOINTNAMES": ", ".join(f"`{name}`" for name in controller.names),
        "POSENAMES": ", ".join(POSE[k] for k in directions),
        "POSE": _write_row(directions),
        "PAYLOAD": "{"
        + ", ".join([write_cpp_number(load.mass), _write_row(load.com), _write_row(np.ravel(load.inertia))])
        + "}",
        "DRIVES": "\n".join(lines),
        "STOP": f"{DAMPING_TIME:g}",
        "MAXMASS": write_cpp_number(MAX_MASS),
        "MAXLENGTH": write_cpp_number(MAX_LENGTH),
        "START": _write_row(controller.controller_positions(home)),
        "RANGE": _write_row(steps),
        "NULLEFFORTS": REDUNDANCY_FUNCTIONS["idle" if robot.redundant else "none idle"].format(own),
        "PROJECTION": REDUNDANCY_FUNCTIONS["project_redundant" if robot.redundant else "independent"].format(own),
    }


def _choose_twist_components(robot: Robot) -> list[int]:
    """Return the indices of the twist's components that belong to the pose's coordinates.

    If the pose has other coordinates, choose the components with the largest volume of the Jacobian at
    home.
    """
    names = robot.pose_names
    if set(names) <= set(POSE):
        return [POSE.index(name) for name in names]
    twist = robot.platform_jacobian(robot.graph.home)
    twist[:3] /= robot.graph.size
    twist /= np.linalg.norm(twist, axis=0)
    choices = list(combinations(range(len(POSE)), len(names)))
    # Round the volumes, so that the first of equal ones is chosen independently of rounding.
    sizes = [round(float(np.prod(np.linalg.svd(twist[list(rows)], compute_uv=False))), 6) for rows in choices]
    return list(choices[int(np.argmax(sizes))])


def _find_gravity_damping(robot: Robot) -> Array:
    """Return the gravity controller's damping in the controller's joint units, shape (n,)."""
    # Critical damping of a bandwidth f is 4 pi f times the mass.
    _, damping = tune_position_control(robot, 1.0 / (4.0 * np.pi * DAMPING_TIME))
    # Round to digits that do not depend on the processor's arithmetic.
    return np.array([float(f"{d:.6g}") for d in damping / robot.controller.factors**2])


def _start_position(robot: Robot) -> Array:
    """Return home, or the middle of the limits where they exclude home, shape (n,)."""
    home, limits = robot.graph.home, robot.limits.position
    if limits is None or ((limits[:, 0] <= home) & (home <= limits[:, 1])).all():
        return home
    middle = np.where(np.isfinite(limits).all(1), limits.mean(1), home)
    return middle if robot.try_forward(middle)[1] else home


def _write_controllers(robot: Robot, package: str, bandwidth: float) -> str:
    controller = robot.controller
    joints = list(controller.names)
    # Convert the gains to the controller's efforts and positions.
    gains = [values / controller.factors**2 for values in tune_position_control(robot, bandwidth)]
    own: dict[str, Any] = {
        "gains": {
            # Round to digits that do not depend on the processor's arithmetic.
            name: {"p": float(f"{p:.6g}"), "d": float(f"{d:.6g}")}
            for name, p, d in zip(joints, *gains, strict=True)
        },
        "hold_time": 0.5,
    }
    settings = {
        "controller_manager": {
            "update_rate": 500,
            "joint_state_broadcaster": {"type": "joint_state_broadcaster/JointStateBroadcaster"},
            CONTROLLER: {"type": f"{package}/FeedforwardController", "fallback_controllers": [GRAVITY_CONTROLLER]},
            GRAVITY_CONTROLLER: {"type": f"{package}/GravityController"},
            TRAJECTORY_CONTROLLER: {"type": "joint_trajectory_controller/JointTrajectoryController"},
        },
        CONTROLLER: own,
        GRAVITY_CONTROLLER: {
            "gains": {name: {"d": float(d)} for name, d in zip(joints, _find_gravity_damping(robot), strict=True)}
        },
        TRAJECTORY_CONTROLLER: {
            "joints": joints,
            "command_joints": [f"{CONTROLLER}/{joint}" for joint in joints],
            "command_interfaces": ["position", "velocity", "acceleration"],
            "state_interfaces": ["position", "velocity"],
            "allow_nonzero_velocity_at_trajectory_end": False,
        },
    }
    # Apply the sections in every namespace.
    sections = {f"/**/{name}": {"ros__parameters": part} for name, part in settings.items()}
    head = "# Written by pkm-twin export ros2-control. Effort per controller's unit and its rate.\n"
    return head + yaml.safe_dump(sections, sort_keys=False)


def write_cpp_number(value: float) -> str:
    """Write a double exactly, for C++."""
    value = float(value)
    if math.isinf(value):
        return "UNLIMITED" if value > 0.0 else "-UNLIMITED"
    return repr(value)


def _write_row(values: Iterable[Any]) -> str:
    items = [str(v) if isinstance(v, int) else write_cpp_number(v) for v in values]
    return "{" + ", ".join(items) + "}"


def write_cpp_string(text: str) -> str:
    """Write a C++ string literal; special characters are octal."""
    plain = re.compile(rb"[A-Za-z0-9 _./:+-]")
    return '"' + "".join(chr(byte) if plain.match(bytes([byte])) else f"\\{byte:03o}" for byte in text.encode()) + '"'
