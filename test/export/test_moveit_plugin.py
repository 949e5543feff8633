# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The kinematics plugin of the MoveIt package, compiled against a stand-in for MoveIt's headers.

``moveit_stand_in.hpp`` has the declarations that the plugin uses; MoveIt itself is not here.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pkm_twin.export.moveit import MAX_POSITION_ERROR, MAX_ROTATION_ERROR, moveit_package
from pkm_twin.kinematics.pose import evaluate_coordinates
from test.support.robots import load, partly_long, random_joints

from .c_programs import COMPILERS, STRICT, compile_in

pytestmark = pytest.mark.skipif(not COMPILERS or not shutil.which("g++"), reason="there is no C and C++ compiler")
SUCCESS, IN_COLLISION, NO_SOLUTION = 1.0, -12.0, -31.0
HEADERS = ("kinematics_base/kinematics_base", "robot_model/robot_model")
DRIVER = r"""
#include "src/kinematics.cpp"
#include <cstring>
#include <iostream>
using kinematics::KinematicsBase;
using moveit_msgs::msg::MoveItErrorCodes;
using Numbers = std::vector<double>;
static const moveit::core::LinkModel foot{"foot", nullptr}, bar{"bar", &foot};

static bool started(
  KinematicsBase & it, const std::vector<std::string> & joints, const char * base,
  const std::vector<std::string> & tips, const char * platform, double stop, const char * group)
{
  const moveit::core::RobotModel model{
    {{"actuated", {joints, {&bar}}}}, {"base_link", "bar", platform}};
  auto node = std::make_shared<rclcpp::Node>();
  node->values["robot_description_kinematics.actuated.singularity_stop"] = stop;
  return it.initialize(node, model, group, base, tips, 0.1) &&
    it.getBaseFrame() == "base_link" && it.getTipFrames() == std::vector<std::string>{"platform"};
}

int main(int, char ** words)
{
  const auto it = plugin();
  auto joints = it->getJointNames();
  const std::size_t n = joints.size();
  std::reverse(joints.begin(), joints.end());
  const bool good = started(*it, joints, "foot", {"bar"}, "platform",
    std::atof(words[2]), "actuated");
  if (std::strcmp(words[1], "start") == 0) {
    for (const auto & joint : it->getJointNames()) {std::cout << joint << ' ';}
    std::cout << it->getLinkNames()[0] << ' ' << good <<
      started(*it, joints, "base_link", {"platform"}, "platform", 0.0, "actuated") <<
      started(*it, joints, "world", {"bar"}, "platform", 0.0, "actuated") <<
      started(*it, joints, "base_link", {"tool"}, "platform", 0.0, "actuated") <<
      started(*it, joints, "base_link", {"bar", "bar"}, "platform", 0.0, "actuated") <<
      started(*it, joints, "base_link", {"bar"}, "plate", 0.0, "actuated") <<
      started(*it, joints, "base_link", {"bar"}, "platform", -0.5, "actuated") <<
      started(*it, joints, "base_link", {"bar"}, "platform", 1.0, "actuated") <<
      started(*it, joints, "base_link", {"bar"}, "platform", 0.0, "limb") <<
      started(*it, {n, joints[0]}, "base_link", {"bar"}, "platform", 0.0, "actuated");
    return 0;
  }
  // Overload, approximate, numbers of the seed and the limits, the limit, pose, seed.
  std::vector<double> row(12 + n);
  while (std::fread(row.data(), sizeof(double), row.size(), stdin) == row.size()) {
    geometry_msgs::msg::Pose pose;
    pose.position = {row[5], row[6], row[7]};
    pose.orientation = {row[8], row[9], row[10], row[11]};
    Numbers seed(row.begin() + 12, row.end()), q{7.0};
    seed.resize(static_cast<std::size_t>(row[2]));
    const Numbers limits(static_cast<std::size_t>(row[3]), row[4]);
    kinematics::KinematicsQueryOptions options;
    options.return_approximate_solution = row[1] != 0.0;
    MoveItErrorCodes code;
    const auto all = KinematicsBase::IKCallbackFn();
    const auto no = [](const auto &, const auto &, auto & c) {c.val = c.GOAL_IN_COLLISION;};
    const auto cost = [](const auto &, const auto &, const auto *, const auto &) {return 1.0;};
    const std::vector<geometry_msgs::msg::Pose> one{pose}, two{pose, pose};
    bool done = false;
    switch (static_cast<int>(row[0])) {
      case 0: done = it->getPositionIK(pose, seed, q, code, options); break;
      case 1: done = it->searchPositionIK(pose, seed, 0.1, q, code, options); break;
      case 2: done = it->searchPositionIK(pose, seed, 0.1, limits, q, code, options); break;
      case 3: done = it->searchPositionIK(pose, seed, 0.1, q, all, code, options); break;
      case 4: done = it->searchPositionIK(pose, seed, 0.1, limits, q, all, code, options); break;
      case 5: done = it->searchPositionIK(one, seed, 0.1, limits, q, all, code, options); break;
      case 6: done = it->searchPositionIK(one, seed, 0.1, limits, q, all, cost, code); break;
      case 7: done = it->searchPositionIK(pose, seed, 0.1, q, no, code, options); break;
      default: done = it->searchPositionIK(two, seed, 0.1, limits, q, all, code, options);
    }
    std::vector<geometry_msgs::msg::Pose> found, other;
    const bool placed = it->getPositionFK({"base_link", "platform"}, q, found);
    const bool unknown = it->getPositionFK({"platform", "tool"}, q, other) || !other.empty();
    const auto & p = found.empty() ? one[0] : found[1];
    const auto & o = p.orientation;
    q.resize(n, -9.0);
    q.insert(q.begin(), {double(done), double(code.val), double(placed), double(unknown)});
    q.insert(q.end(), {p.position.x, p.position.y, p.position.z, o.x, o.y, o.z, o.w});
    std::fwrite(q.data(), sizeof(double), q.size(), stdout);
  }
}
"""


class Plugin:
    """A robot's compiled plugin."""

    def __init__(self, robot, folder):
        self.robot, self.n, self.program = robot, robot.joints_count, folder / "driver"
        here = Path(__file__).parent / "moveit_stand_in.hpp"
        names = [*(f"moveit/{name}.hpp" for name in HEADERS), "pluginlib/class_list_macros.hpp"]
        texts = dict.fromkeys(names, f'#include "{here}"\n') | {"driver.cpp": DRIVER}
        for name, text in (moveit_package(robot) | texts).items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        source = f"c/pkm_{robot.name}.c"
        compile_in(folder, COMPILERS[0], "-std=c99", "-O0", "-c", source, "-o", "robot.o")
        compile_in(folder, "g++", *STRICT, "-I.", "-Ic", "driver.cpp", "robot.o", "-o", "driver", "-lm")

    def run(self, word, stop=0.0, data=b""):
        command = [self.program, word, str(stop)]
        return subprocess.run(command, input=data, capture_output=True, check=True).stdout

    def solve(self, goals, seeds=0.0, call=0, approximate=0, size=None, limits=0, limit=0.0, stop=0.0):
        """Codes, joint positions and their platform poses (7 numbers) of rows of goals."""
        size = self.n if size is None else size
        head = np.broadcast_to([call, approximate, size, limits, limit], (len(goals), 5))
        rows = np.hstack([head, goals, np.broadcast_to(seeds, (len(goals), self.n))])
        found = np.frombuffer(self.run("solve", stop, rows.tobytes())).reshape(len(goals), -1)
        done, code, placed, unknown = found[:, :4].T
        np.testing.assert_array_equal(done == 1.0, code == SUCCESS)
        np.testing.assert_array_equal(done, placed)
        assert not unknown.any()
        return code, found[:, 4 : 4 + self.n], found[:, 4 + self.n :]


@pytest.fixture(
    scope="module",
    params=partly_long(("delta_cu", "five_bar", "rps3", "upr_rpu", "stewart"), "five_bar"),
)
def plugin(request, tmp_path_factory):
    return Plugin(load(request.param), tmp_path_factory.mktemp("plugin"))


@pytest.fixture(scope="module")
def states(plugin):
    return random_joints(plugin.robot, np.random.default_rng(5), 40)


def goals_of(robot, q):
    """Poses of the platform, as messages have them: position and quaternion."""
    position, rotation = robot.platform(q)
    return np.hstack([position, Rotation.from_matrix(rotation).as_quat(canonical=True)])


def test_it_starts_with_what_moveit_names_and_with_nothing_else(plugin):
    *names, flags = plugin.run("start").decode().split()
    assert names == [*plugin.robot.joint_names, "platform"]
    # What MoveIt's loader names, the solver's own; then all that is wrong.
    assert flags == "11" + 8 * "0"


def test_the_platform_of_a_solution_is_the_goal(plugin, states):
    goals = goals_of(plugin.robot, states)
    right = plugin.robot.inverse(plugin.robot.forward(states))
    for call in range(7):
        code, q, poses = plugin.solve(goals * (1, 1, 1, -1, -1, -1, -1), call=call)
        assert (code == SUCCESS).all()
        np.testing.assert_allclose(q, right, rtol=0, atol=1e-12)
        np.testing.assert_allclose(poses, goals, rtol=0, atol=1e-12)


def test_a_goal_is_what_the_machine_has_in_all_directions(plugin, states):
    robot, rng = plugin.robot, np.random.default_rng(6)
    goals = np.repeat(goals_of(robot, states), 6, axis=0)
    shift = rng.uniform(-1.5, 1.5, (len(goals), 6)) * np.eye(6)[np.arange(len(goals)) % 6]
    goals[:, :3] += MAX_POSITION_ERROR * shift[:, :3]
    turned = Rotation.from_rotvec(MAX_ROTATION_ERROR * shift[:, 3:]) * Rotation.from_quat(goals[:, 3:])
    goals[:, 3:] = turned.as_quat()
    placed = zip(goals[:, :3], turned.as_matrix(), strict=True)
    q, good = robot.try_inverse([evaluate_coordinates(robot.coordinates, p, r) for p, r in placed])
    near = good.copy()
    near[good] = np.linalg.norm(goals[good, :3] - robot.platform(q[good])[0], axis=1) <= MAX_POSITION_ERROR
    relative = Rotation.from_matrix(robot.platform(q[good])[1]).inv() * turned[good]
    near[good] &= relative.magnitude() <= MAX_ROTATION_ERROR
    code, found, _ = plugin.solve(goals)
    np.testing.assert_array_equal(code == SUCCESS, near)
    assert near.any() and (near.all() if robot.joints_count == 6 else not near.all())
    np.testing.assert_allclose(found[near], q[near], rtol=0, atol=1e-12)
    # Only the pose coordinates count.
    code, found, _ = plugin.solve(goals, approximate=1)
    np.testing.assert_array_equal(code == SUCCESS, good)
    np.testing.assert_allclose(found[good], q[good], rtol=0, atol=1e-12)


def test_what_has_no_solution_has_its_code_and_no_joints(plugin, states):
    robot, n = plugin.robot, plugin.n
    goals = goals_of(robot, states)
    bad = []
    for k in range(7):
        for value in (np.nan, np.inf, 1e300):
            bad.append(goals[0].copy())
            bad[-1][k] = value
    bad += [goals[0] * ([1] * 3 + [0] * 4), goals[0] * ([1] * 3 + [1.01] * 4)]
    bad += [goals[0] + 9.0 * step for step in np.eye(7)[:3]]
    # Beyond each joint's limits, where the machine can be assembled.
    low, high = robot.limits.position.T
    middle, out = (low + high) / 2, (high - low) / 2 + 0.01
    beyond = middle + np.vstack([np.diag(out), np.diag(-out)])
    beyond = beyond[robot.try_forward(beyond)[1]]
    assert len(beyond) >= n
    index = robot.singularity(states)
    stop = float(np.median(index))
    home = robot.inverse(robot.home())
    reach = np.abs(states - home).max(1)
    limit = float(np.median(reach))
    for right, call in (
        (np.zeros(len(bad), bool), {"goals": bad}),
        (np.zeros(len(beyond), bool), {"goals": goals_of(robot, beyond)}),
        (index >= stop, {"goals": goals, "stop": stop}),
        (reach <= limit, {"seeds": home, "call": 4, "limits": n, "limit": limit}),
        (reach < 0, {"seeds": home, "call": 2, "limits": n, "limit": np.nan}),
        (reach < 0, {"call": 5, "limits": n + 1, "limit": 9.0}),
        (reach < 0, {"seeds": np.nan}),
        (reach < 0, {"size": n - 1}),
        (reach < 0, {"size": n + 1}),
        # With a parameter out of range it is not initialized.
        (reach < 0, {"stop": -0.5}),
        (reach < 0, {"call": 8}),
    ):
        code, q, _ = plugin.solve(**({"goals": goals} | call))
        np.testing.assert_array_equal(code, np.where(right, SUCCESS, NO_SOLUTION), str(call))
        assert (q[~right] == -9.0).all()
    code, q, _ = plugin.solve(goals, call=7)
    assert (code == IN_COLLISION).all() and (q == -9.0).all()
