# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The package for ros2_control: its files, and its controller's core compiled without ROS.

Its plugins are tested by the package's own test, where ros2_control is installed.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from delta_dynamics import dynamics_terms, inverse_dynamics, mass_matrix
from pkm_twin import robot_names
from pkm_twin.errors import ParameterError
from pkm_twin.export.c_package import c_package
from pkm_twin.export.ros2_control import package_name, ros2_control_package
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.derivatives import joint_rates
from test.support.mapped import sides
from test.support.robots import (
    load,
    loaded,
    loaded_like,
    massless,
    often,
    partly_long,
    random_motion,
)

from .c_programs import COMPILERS, STRICT, blocking, compile_in, hooked, watched

ROS = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
needs_ros2_control = pytest.mark.skipif(
    not shutil.which("colcon") or not any(Path(p, "share/controller_interface").is_dir() for p in ROS),
    reason="ros2_control is not installed in a sourced workspace with colcon",
)
needs_compiler = pytest.mark.skipif(not COMPILERS or not shutil.which("g++"), reason="there is no C and C++ compiler")
NAMES = ["NOT_FINITE", "BEYOND_LIMIT", "NO_ASSEMBLY", "SINGULAR", "NO_STATE", "NONE"]
DRIVER = r"""
#include <cstdio>
#include "@/feedforward.hpp"
using namespace @;
template<std::size_t SIZE> bool take(std::array<double, SIZE> & row)
{
  return std::fread(row.data(), sizeof(double), SIZE, stdin) == SIZE;
}
int main()
{
  Settings s;
  Load load;
  Feedforward core;
  Vector position, velocity;
  std::array<double, 3> stops;
  if (!take(s.p) || !take(s.d) || !take(stops) || !take(position)) { return 8; }
  s.singularity_stop = stops[0];
  s.hold_time = stops[1];
  for (std::size_t i = 0; i < JOINTS; ++i) {
    s.lower[i] = stops[2] > 0.0 ? DRIVES[i].lower : -UNLIMITED;
    s.upper[i] = stops[2] > 0.0 ? DRIVES[i].upper : UNLIMITED;
    load.effort[i] = DRIVES[i].effort;
  }
  if (payload_parameters(PAYLOAD.mass, PAYLOAD.com, PAYLOAD.inertia, load.parameters) != 0) {
    return 7;
  }
  if (core.start(s, load, position) != REJECTIONS) { return 6; }
  Motion m;
  while (take(m.position) && take(m.velocity) && take(m.acceleration) && take(position) &&
    take(velocity))
  {
    const bool sound = core.update(&m, position, velocity, 1e-3);
    const double verdict[2] = {sound ? 1.0 : 0.0, static_cast<double>(core.verdict())};
    std::fwrite(verdict, sizeof(double), 2, stdout);
    std::fwrite(core.effort().data(), sizeof(double), JOINTS, stdout);
    std::fwrite(core.feedforward().data(), sizeof(double), JOINTS, stdout);
  }
  return 0;
}
"""


class Core:
    """The controller's core of a robot, compiled; all in the controller's numbers."""

    def __init__(self, robot, folder):
        self.robot, self.n = robot, robot.joints_count
        self.package = package_name(robot)
        for name, text in ros2_control_package(robot).items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        (folder / "driver.cpp").write_text(DRIVER.replace("@", self.package))
        self.program = folder / "driver"
        (c_file,) = folder.glob("c/pkm_*.c")
        compile_in(folder, COMPILERS[0], "-std=c99", "-O0", "-c", c_file, "-o", "robot.o")
        sources = "driver.cpp", "src/feedforward.cpp", "robot.o"
        compile_in(folder, "g++", *STRICT, "-Iinclude", "-Ic", *sources, "-o", "driver", "-lm")

    def run(self, rows, start, p=0.0, d=0.0, stop=0.0, hold=0.5, *, bounded=True):
        """Sound, verdict, effort and feedforward of updates: rows of 5 n numbers."""
        head = np.concatenate([np.full(self.n, p), np.full(self.n, d), [stop, hold, bounded], start])
        done = subprocess.run(
            [self.program],
            input=head.tobytes() + np.ascontiguousarray(rows).tobytes(),
            capture_output=True,
            check=False,
        )
        assert not done.returncode, done.returncode
        table = np.frombuffer(done.stdout).reshape(len(rows), 2 + 2 * self.n)
        names = [NAMES[int(k)] for k in table[:, 1]]
        return table[:, 0] == 1.0, names, table[:, 2 : 2 + self.n], table[:, 2 + self.n :]


@pytest.fixture(scope="module", params=partly_long(robot_names(), "five_bar"))
def mapped(request, tmp_path_factory):
    """A robot with friction, payload and a joint map, and its compiled core."""
    both = sides(request.param)
    core = Core(loaded_like(both.mapped), tmp_path_factory.mktemp("core"))
    return both, core


def clipped(core, efforts):
    """At most the limits, in the controller's numbers."""
    robot = core.robot
    if robot.limits.effort is None:
        return efforts
    limit = robot.limits.effort / np.abs(robot.controller.factors)
    return np.clip(efforts, -limit, limit)


@needs_compiler
class TestCore:
    @pytest.mark.parametrize("count", often(50, 5000))
    def test_efforts_are_those_of_python_in_the_controller_s_numbers(self, mapped, count):
        both, core = mapped
        model = loaded(both.plain.name)
        rng = np.random.default_rng(2)
        q, qd, qdd, _ = random_motion(model, rng, count)
        miss = rng.normal(0.0, 1e-2, (2, *q.shape))
        motion = [both.positions(q), both.rates(qd), both.rates(qdd)]
        measured = [both.positions(q - miss[0]), both.rates(qd - miss[1])]
        p, d = 0.3, 0.07
        sound, names, effort, forward = core.run(np.hstack([*motion, *measured]), both.positions(q[0]), p, d)
        right = both.efforts(inverse_dynamics(model, q, qd, qdd))
        assert sound.all() and set(names) == {"NONE"}
        np.testing.assert_allclose(forward, right, 0.0, 1e-11 * np.abs(right).max())
        right = right + p * both.rates(miss[0]) + d * both.rates(miss[1])
        right = clipped(core, right)
        np.testing.assert_allclose(effort, right, 0.0, 1e-9 * np.abs(right).max())

    def test_a_rejected_reference_is_held_for_a_while_and_then_fails(self, mapped):
        both, core = mapped
        model = loaded(both.plain.name)
        q, qd, qdd, _ = random_motion(model, np.random.default_rng(3), 1)
        good = np.hstack([both.positions(q), both.rates(qd), both.rates(qdd), both.positions(q), both.rates(qd)])
        bad = np.repeat(good, 3, 0)
        bad[[0, 1, 2], [0, core.n, 3 * core.n - 1]] = np.nan, np.inf, -np.inf
        rows = np.concatenate([good, *[bad] * 10, good, bad[:1]])
        weight = both.efforts(inverse_dynamics(model, q, 0.0 * qd, 0.0 * qdd))[0]
        sound, names, effort, forward = core.run(rows, good[0, : core.n], p=0.3, d=1e-3, hold=0.0205)
        assert names == ["NONE", *["NOT_FINITE"] * 30, "NONE", "NOT_FINITE"]
        np.testing.assert_array_equal(sound, [True] * 21 + [False] * 10 + [True] * 2)
        scale = 1e-11 * np.abs(weight).max()
        np.testing.assert_allclose(forward[1:-2], np.tile(weight, (30, 1)), 0.0, scale)
        np.testing.assert_allclose(forward[[-2]], forward[[0]], 0.0, scale)
        # It brakes, towards the place that it holds.
        brake = clipped(core, weight - 1e-3 * both.rates(qd[0]))
        np.testing.assert_allclose(effort[1:-2], np.tile(brake, (30, 1)), 0.0, 10 * scale)

    def test_at_rest_where_it_is_measured_the_machine_is_carried_and_damped(self, mapped):
        """As the gravity controller asks; without a position the last weight is given."""
        both, core = mapped
        model = loaded(both.plain.name)
        q, qd, _, _ = random_motion(model, np.random.default_rng(4), 30)
        still = np.zeros_like(q)
        rows = np.hstack([both.positions(q), still, still, both.positions(q), both.rates(qd)])
        lost = np.array(rows[-1:])
        lost[:, : core.n] = lost[:, 3 * core.n :] = np.nan
        d = 0.07
        sound, names, effort, _ = core.run(
            np.concatenate([rows, lost]), both.positions(q[0]), d=d, hold=0.5, bounded=False
        )
        weight = both.efforts(inverse_dynamics(model, q, still, still))
        right = np.concatenate([weight - d * both.rates(qd), weight[-1:]])
        scale = 1e-9 * np.abs(right).max()
        np.testing.assert_allclose(effort, clipped(core, right), 0.0, scale)
        assert sound.all() and names == ["NONE"] * 30 + ["NOT_FINITE"]

    def test_the_weight_is_carried_without_a_velocity_and_no_position_is_controlled_without(self, mapped):
        both, core = mapped
        model = loaded(both.plain.name)
        q, qd, _, _ = random_motion(model, np.random.default_rng(5), 1)
        still = np.zeros_like(q)
        row = np.hstack([both.positions(q), still, still, both.positions(q), both.rates(qd)])
        rows = np.repeat(row, 40, 0)
        rows[1:, -core.n] = np.nan
        d = 0.07
        weight = both.efforts(inverse_dynamics(model, q, still, still))[0]
        damped = weight - d * both.rates(qd[0])
        undamped = np.where(np.arange(core.n) == 0, weight, damped)
        for p, sound_until, lost in ((0.0, 40, undamped), (0.3, 21, weight)):
            sound, names, effort, _ = core.run(rows, rows[0, : core.n], p, d, hold=0.0205)
            assert names == ["NONE"] + ["NO_STATE"] * 39
            np.testing.assert_array_equal(sound, np.arange(40) < sound_until)
            right = clipped(core, np.array([damped, *[lost] * 39]))
            np.testing.assert_allclose(effort, right, 0.0, 1e-9 * np.abs(right).max())

    def test_rates_of_rounding_size_have_no_dry_friction(self, mapped):
        both, core = mapped
        model = loaded(both.plain.name)
        assert model.friction.coulomb.any()
        q, _, _, _ = random_motion(model, np.random.default_rng(6), 4)
        sides = np.array([[1.0], [-1.0], [1.0], [-1.0]])
        # What a spline leaves at its end, and a motion that takes a year for a turn.
        rates = sides * np.array([[6e-15], [6e-15], [1e-7], [1e-7]]) * np.ones(core.n)
        still = np.zeros_like(q)
        factors = core.robot.controller.factors
        motion = [both.positions(q), factors * rates, still]
        _, names, _, forward = core.run(np.hstack([*motion, *motion[:2]]), both.positions(q[0]))
        assert set(names) == {"NONE"}
        rates[:2] = 0.0
        right = both.efforts(inverse_dynamics(model, q, rates, still))
        np.testing.assert_allclose(forward, right, 0.0, 1e-9 * np.abs(right).max())

    @blocking
    def test_no_update_allocates_or_locks(self, mapped, watcher, rng):
        """Of 200,000, of which many are rejected."""
        _, core = mapped
        n, folder = core.n, core.program.parent
        sources = ("src/feedforward.cpp", "robot.o", "-Iinclude", "-Ic")
        program = hooked(folder, r"const bool sound = [^;]*", "driver.cpp", *sources, watcher=watcher)
        start = core.robot.controller.controller_positions(core.robot.graph.home)
        head = np.concatenate([np.full(2 * n, 0.1), [0.1, np.inf, 1.0], start])
        rows = np.tile(start, 5) + rng.normal(0.0, 0.2, (200_000, 5 * n))
        rows[::7, 0] = np.nan
        assert watched(program, np.concatenate([head, rows.ravel()])) == (len(rows), 0)

    def test_each_reason_to_reject(self, mapped):
        both, core = mapped
        home = core.robot.graph.home
        rest = np.zeros((1, 4 * core.n))
        rest[:, 2 * core.n : 3 * core.n] = both.positions(home)

        def asked(q, **settings):
            row = np.hstack([both.positions(q)[None], rest])
            return core.run(row, both.positions(home), **settings)[1][0]

        assert asked(home) == "NONE"
        index = core.robot.singularity(home)
        assert asked(home, stop=float(index) / 2) == "NONE"
        # Activation needs a place that is clear, too.
        limits = core.robot.limits.position
        if limits is not None:
            beyond = np.array(home)
            beyond[0] = limits[0, 1] + 1e-6
            assert asked(beyond) == "BEYOND_LIMIT"
        row = np.hstack([both.positions(home)[None], rest])
        row[0, -1] = np.nan
        assert core.run(row, both.positions(home))[1] == ["NONE"]
        _, names, effort, _ = core.run(row, both.positions(home), d=1.0)
        assert names == ["NO_STATE"] and np.isfinite(effort).all()


COMMON = r"""
#include <cstdio>
#include "@/carried.hpp"
using namespace @;
int main()
{
  Node nodes[2];
  std::vector<std::string> joints;
  Values own[2];
  for (int k = 0; k < 2; ++k) {
    joints = declare_parameters(nodes[k], k ? Role::CARRIES : Role::FOLLOWS);
    for (const auto & [name, value] : nodes[k].values) {
      if (is_common(name)) { own[k][name] = value; }
    }
  }
  // Names of the robot in another order, or one twice, would drive the wrong motors.
  for (const bool twice : {false, true}) {
    auto wrong = joints;
    std::swap(wrong[0], wrong[JOINTS - 1]);
    wrong[0] = twice ? wrong[JOINTS - 1] : wrong[0];
    Node node;
    node.values.emplace("joints", rclcpp::Parameter("joints", wrong));
    try {
      declare_parameters(node, Role::FOLLOWS);
      return 5;
    } catch (const std::invalid_argument &) {
    }
  }
  const auto carried = Carried::find("/cell", joints);
  if (carried != Carried::find("/cell", joints) || carried == Carried::find("/other", joints)) {
    return 9;
  }
  const std::string mass = "payload.mass", limit = "limits." + joints[0] + ".effort";
  carried->join("first", own[0], {{mass, {mass, 2.0}}});
  carried->join("second", own[1], {});
  try {
    carried->join("second", own[1], {{mass, {mass, 3.0}}});
    return 8;
  } catch (const std::invalid_argument &) {
  }
  const auto show = [&] {
      std::uint64_t number = 0;
      const Load load = carried->load().read(number);
      std::fwrite(load.parameters.data(), sizeof(double), load.parameters.size(), stdout);
      std::fwrite(load.effort.data(), sizeof(double), JOINTS, stdout);
    };
  show();
  carried->set({{mass, 5}, {limit, 0.25}, {"hold_time", 1.0}});
  show();
  try {
    carried->set({{mass, -1.0}});
    return 7;
  } catch (const std::invalid_argument &) {
  }
  show();
  std::uint64_t number = 0;
  Load load;
  // Once to each reader, and not again.
  return carried->load().take(load, number) && !carried->load().take(load, number) ? 0 : 6;
}
"""


@needs_compiler
def test_payload_and_effort_limits_are_one_set_for_all_controllers(mapped):
    _, core = mapped
    folder = core.program.parent
    stand_in = (Path(__file__).parent / "rclcpp_stand_in.hpp").read_text()
    for name in ("rclcpp/rclcpp.hpp", "rclcpp_lifecycle/lifecycle_node.hpp"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(stand_in)
    (folder / "common.cpp").write_text(COMMON.replace("@", core.package))
    flags = "-std=c++17", "-O0", "-Wall", "-Wextra", "-Werror", "-I.", "-Iinclude", "-Ic"
    compile_in(folder, "g++", *flags, "common.cpp", "robot.o", "-o", "common", "-lm")
    done = subprocess.run([folder / "common"], capture_output=True, check=False)
    assert not done.returncode, done.returncode
    first, second, third = np.frombuffer(done.stdout).reshape(3, -1)
    np.testing.assert_array_equal(second, third)
    assert (first[: -core.n] != second[: -core.n]).any()
    assert second[-core.n] == 0.25
    np.testing.assert_array_equal(first[1 - core.n :], second[1 - core.n :])


SHARED = r"""
#include <cstdio>
#include "@/model.hpp"
using namespace @;
int main()
{
  Vector q, qd, change{};
  std::array<double, (JOINTS - FREEDOMS) * JOINTS> idle;
  std::array<double, 6 * JOINTS> twist;
  while (std::fread(q.data(), sizeof(double), JOINTS, stdin) == JOINTS &&
    std::fread(qd.data(), sizeof(double), JOINTS, stdin) == JOINTS)
  {
    change = {};
    if (null_efforts(q, idle) || platform_jacobian(q, twist)) { return 9; }
    if (make_agree(q, qd, change)) { return 8; }
    std::fwrite(idle.data(), sizeof(double), idle.size(), stdout);
    std::fwrite(change.data(), sizeof(double), JOINTS, stdout);
    std::fwrite(twist.data(), sizeof(double), twist.size(), stdout);
  }
  return 0;
}
"""


@needs_compiler
def test_drives_share_the_effort_in_the_controller_s_numbers(tmp_path):
    """Four motors of three freedoms: efforts, and what the plugins compute velocities with."""
    path = "examples/machines/rrr4_planar.yaml"
    model, data = load(path), load(path).parameter_sections()
    data["joint_map"] = {
        f"motor_{k}": {"name": f"drive {k}", "sign": (-1) ** k, "offset": 0.1 * k, "ratio": 1.0 + k}
        for k in (1, 2, 3, 4)
    }
    robot = robot_of_data(data, "four")
    core, factors = Core(robot, tmp_path), robot.controller.factors
    rng = np.random.default_rng(4)
    q = model.inverse(rng.uniform(-0.03, 0.03, (40, 3)))
    qd, qdd = joint_rates(model, q, *rng.uniform(-2, 2, (2, 40, 3)))
    place = robot.controller.controller_positions(q)
    motion = [place, factors * qd, factors * qdd]
    sound, names, _, forward = core.run(np.hstack([*motion, *motion[:2]]), place[0])
    right = inverse_dynamics(model, q, qd, qdd)
    assert sound.all() and set(names) == {"NONE"}
    np.testing.assert_allclose(forward * factors, right, 0.0, 1e-12 * np.abs(right).max())
    # One motor contradicts the others: the last good position is held.
    torn = np.hstack([*motion, *motion[:2]])[:2]
    torn[1, 3] += factors[3] * 2e-3
    assert core.run(torn, place[0])[1] == ["NONE", "NO_ASSEMBLY"]
    (tmp_path / "shared.cpp").write_text(SHARED.replace("@", core.package))
    compile_in(tmp_path, "g++", *STRICT, "-Iinclude", "-Ic", "shared.cpp", "robot.o", "-o", "shared", "-lm")
    given = np.hstack(motion[:2]).tobytes()
    done = subprocess.run([tmp_path / "shared"], input=given, capture_output=True, check=True)
    idle, change, twist = np.split(np.frombuffer(done.stdout).reshape(40, 32), [4, 8], 1)
    square = np.concatenate([twist.reshape(40, 6, 4)[:, [0, 1, 5]], idle[:, None]], 1)
    back = np.linalg.inv(square)[..., :3] / factors[:, None]
    np.testing.assert_allclose(back, model.inverse_jacobian(q), atol=1e-9)
    still = model.project_redundant(q, qd)[2]
    np.testing.assert_allclose(change / factors, still, atol=1e-9)
    # As the solver splits efforts: what is left of a motion without accelerations of the leads.
    split = dynamics_terms(model, q, qd, still).velocity
    rest = inverse_dynamics(model, q, 0.0 * qd, 0.0 * qd)
    moving = inverse_dynamics(model, q, qd, still) - dynamics_terms(model, q, qd, still).friction
    inertia = np.einsum("kij,kj->ki", mass_matrix(model, q), still)
    np.testing.assert_allclose(moving - rest - inertia, split, atol=1e-10)


@needs_compiler
def test_places_that_cannot_be_reached_or_are_singular(tmp_path):
    """A five-bar whose arms stretch: the way there is singular, beyond it there is no assembly."""
    robot = load("five_bar")
    core = Core(robot, tmp_path)
    home = robot.graph.home
    side = np.array([-1.0, 1.0])
    far = home + np.linspace(0.0, 3.0, 400)[:, None] * side
    index, good = robot.try_singularity(far)
    assert not good.all()
    stop = 0.3 * float(index[0])
    rows = np.hstack([far, np.zeros((len(far), 4 * core.n))])
    _, names, _, _ = core.run(rows, home, stop=stop, hold=np.inf, bounded=False)
    right = np.where(good, np.where(index < stop, "SINGULAR", "NONE"), "NO_ASSEMBLY")
    assert names == right.tolist()
    assert set(names) == {"NONE", "SINGULAR", "NO_ASSEMBLY"}


@pytest.fixture(scope="module")
def files():
    return ros2_control_package(load("five_bar"), 5.0)


def test_files_are_complete_and_well_formed(files, tmp_path):
    package = package_name(load("five_bar"))
    for name, text in files.items():
        assert not re.search(r"@[A-Z]+@", text), name
        if name.endswith(".xml"):
            ElementTree.fromstring(text)
    cmake = files["CMakeLists.txt"]
    for name in files:
        if name.startswith("src/"):
            plugin = rf"add_plugin\({Path(name).stem}\s"
            assert name in cmake or re.search(plugin, cmake), name
    for name, base in (
        ("controllers", "controller_interface"),
        ("kinematics", "kinematics_interface"),
        ("inverse_dynamics_solver", "inverse_dynamics_solver"),
    ):
        library = ElementTree.fromstring(files[f"{name}.xml"])
        assert library.get("path") == f"{package}_{name}"
        assert f"pluginlib_export_plugin_description_file({base} {name}.xml)" in cmake
        for plugin in library:
            kind, parent = plugin.get("type"), plugin.get("base_class_type")
            exported = rf"PLUGINLIB_EXPORT_CLASS\(\s*{kind}, {parent}\)"
            assert re.search(exported, files[f"src/{name}.cpp"])
            assert parent.startswith(f"{base}::")
    for name, text in c_package(load("five_bar")).items():
        assert files[f"c/{name}"] == text


def test_the_package_file_is_valid(files, tmp_path):
    catkin = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is not installed")
    (tmp_path / "package.xml").write_text(files["package.xml"])
    found = catkin.parse_package(tmp_path / "package.xml", warnings=(warnings := []))
    found.validate(warnings=warnings)
    assert not warnings
    wanted = set(re.findall(r"find_package\((\w+)", files["CMakeLists.txt"])) - {"Eigen3"}
    depends = (found.buildtool_depends, found.build_depends, found.test_depends)
    assert wanted <= {d.name for kind in depends for d in kind}


def test_settings_name_the_joints_and_have_the_gains_of_the_masses(files):
    robot = load("five_bar")
    sections = {
        name.removeprefix("/**/"): section["ros__parameters"]
        for name, section in yaml.safe_load(files["config/controllers.yaml"]).items()
    }
    manager = sections["controller_manager"]
    assert manager["feedforward_controller"]["type"] in files["controllers.xml"]
    trajectories = sections["joint_trajectory_controller"]
    assert trajectories["joints"] == list(robot.joint_names)
    assert trajectories["command_joints"] == [f"feedforward_controller/{name}" for name in robot.joint_names]
    (fallback,) = manager["feedforward_controller"]["fallback_controllers"]
    assert manager[fallback]["type"] in files["controllers.xml"]
    inertia = np.diag(mass_matrix(robot, robot.graph.home))
    damping = [sections[fallback]["gains"][name]["d"] for name in robot.joint_names]
    np.testing.assert_allclose(damping, inertia / 0.1, 1e-5)
    turn = 2 * np.pi * 5.0
    gains = sections["feedforward_controller"]["gains"]
    found = [[gains[name][k] for name in robot.joint_names] for k in "pd"]
    np.testing.assert_allclose(found, [inertia * turn**2, 2 * inertia * turn], 1e-5)


@pytest.mark.parametrize(
    ("name", "package"),
    [
        ("delta_cu", "delta_cu"),
        ("My Delta-2", "my_delta_2"),
        ("3rps", "robot_3rps"),
        ("größe", "gru00f6u00dfe"),
        ("__", "robot"),
        ("a//b", "a_b"),
    ],
)
def test_names_of_packages(name, package):
    robot = robot_of_data(sides("five_bar").data, name)
    assert package_name(robot) == f"{package}_ros2_control"


def test_what_a_robot_lacks_is_reported(tmp_path, capsys):
    with pytest.raises(ParameterError):
        ros2_control_package(load(massless(tmp_path / "hollow.yaml")))
    for bandwidth in (-1.0, np.nan, np.inf):
        with pytest.raises(ParameterError):
            ros2_control_package(load("five_bar"), bandwidth)


@needs_ros2_control
@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["five_bar", "delta_cu", "rps3", "stewart", Path("examples/machines/rrr4_planar.yaml")]
)
def test_the_package_builds_and_its_own_test_passes(name, tmp_path):
    robot = loaded_like(sides(name).mapped)
    for path, text in ros2_control_package(robot).items():
        (tmp_path / "src" / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "src" / path).write_text(text)
    for command in ("build", "test", "test-result"):
        done = subprocess.run(["colcon", command], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert not done.returncode, done.stdout + done.stderr
