// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export moveit, which overwrites changes.
#include <algorithm>
#include <array>
#include <cmath>
#include <exception>
#include <limits>
#include <string>
#include <vector>

#include "moveit/kinematics_base/kinematics_base.hpp"
#include "moveit/robot_model/robot_model.hpp"
#include "pluginlib/class_list_macros.hpp"

#include "@PREFIX@.h"

namespace @PACKAGE@
{
constexpr std::size_t JOINTS = @MACRO@_JOINTS;
using Vector = std::array<double, JOINTS>;
using Position = std::array<double, 3>;
/// Row by row.
using Rotation = std::array<double, 9>;
using geometry_msgs::msg::Pose;
using kinematics::KinematicsQueryOptions;
using moveit_msgs::msg::MoveItErrorCodes;

[[maybe_unused]] constexpr double UNLIMITED = std::numeric_limits<double>::infinity();
constexpr const char * BASE = "base_link";
constexpr const char * TIP = "platform";
/// How far the norm of a goal's quaternion may be from one.
constexpr double NORM_TOLERANCE = 1e-3;

struct Drive
{
  const char * name;
  double lower, upper;
};

constexpr std::array<Drive, JOINTS> DRIVES{{
@DRIVES@
}};

/// The pose coordinates of the exported C, of a platform at p that is turned by r from home.
std::array<double, @MACRO@_POSE> coordinates(
  [[maybe_unused]] const Position & p, [[maybe_unused]] const Rotation & r)
{
  return {@POSE@};
}

/// False for a pose that is not finite, or whose quaternion has not the norm one.
bool take(const Pose & pose, Position & p, Rotation & r)
{
  p = {pose.position.x, pose.position.y, pose.position.z};
  const auto & o = pose.orientation;
  const double norm = std::sqrt(o.w * o.w + o.x * o.x + o.y * o.y + o.z * o.z);
  if (!std::isfinite(p[0] + p[1] + p[2]) || !(std::abs(norm - 1.0) <= NORM_TOLERANCE)) {
    return false;
  }
  const double w = o.w / norm, x = o.x / norm, y = o.y / norm, z = o.z / norm;
  r = {
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
    2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
    2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)};
  return true;
}

Pose given(const Position & p, const Rotation & r)
{
  // Four times the products of the quaternion's w, x, y, z: every row is parallel to it. The one
  // with the largest diagonal is the most exact.
  const std::array<std::array<double, 4>, 4> rows{{
    {1.0 + r[0] + r[4] + r[8], r[7] - r[5], r[2] - r[6], r[3] - r[1]},
    {r[7] - r[5], 1.0 + r[0] - r[4] - r[8], r[3] + r[1], r[2] + r[6]},
    {r[2] - r[6], r[3] + r[1], 1.0 - r[0] + r[4] - r[8], r[7] + r[5]},
    {r[3] - r[1], r[2] + r[6], r[7] + r[5], 1.0 - r[0] - r[4] + r[8]}}};
  std::size_t best = 0;
  for (std::size_t i = 1; i < rows.size(); ++i) {
    best = rows[i][i] > rows[best][best] ? i : best;
  }
  const auto & q = rows[best];
  const double norm = std::copysign(
    std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), q[0]);
  Pose pose;
  pose.position.x = p[0];
  pose.position.y = p[1];
  pose.position.z = p[2];
  pose.orientation.w = q[0] / norm;
  pose.orientation.x = q[1] / norm;
  pose.orientation.y = q[2] / norm;
  pose.orientation.z = q[3] / norm;
  return pose;
}

double distance(const Position & a, const Position & b)
{
  return std::hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}

/// The angle between two rotations, rad.
double angle(const Rotation & a, const Rotation & b)
{
  double square = 0.0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    square += (a[i] - b[i]) * (a[i] - b[i]);
  }
  return 2.0 * std::asin(std::min(1.0, std::sqrt(square / 8.0)));
}

/// Inverse kinematics of the actuated joints for poses of `platform` in `base_link`.
///
/// The pose coordinates are taken from the goal and give the one solution in the assembly of the
/// machine's home. The machine's pose there must be the goal in all six directions, within the
/// tolerances. No seed, timeout, discretization or cost changes the solution.
class Kinematics : public kinematics::KinematicsBase
{
public:
  using kinematics::KinematicsBase::getPositionIK;
  using kinematics::KinematicsBase::searchPositionIK;

  Kinematics()
  {
    for (const Drive & drive : DRIVES) {
      joint_names_.push_back(drive.name);
    }
  }

  /// MoveIt names the last link of the group as the tip and the first one's parent as the base. The
  /// solver then reports its own, which MoveIt asks for before it transforms a goal. Others are
  /// rejected: their poses would be those of another link.
  bool initialize(
    const rclcpp::Node::SharedPtr & node, const moveit::core::RobotModel & robot_model,
    const std::string & group_name, const std::string & base_frame,
    const std::vector<std::string> & tip_frames, double search_discretization) override
  {
    ready_ = false;
    storeValues(robot_model, group_name, base_frame, tip_frames, search_discretization);
    const auto * group = robot_model.getJointModelGroup(group_name);
    std::string reason;
    if (!supportsGroup(group, &reason)) {
      RCLCPP_ERROR(logger_, "group '%s': %s", group_name.c_str(), reason.c_str());
      return false;
    }
    const auto & links = group->getLinkModels();
    const std::string & above = links.front()->getParentLinkModel()->getName();
    if (!robot_model.hasLinkModel(BASE) || !robot_model.hasLinkModel(TIP)) {
      RCLCPP_ERROR(logger_, "robot model: expected links '%s' and '%s'", BASE, TIP);
      return false;
    }
    if (base_frame_ != BASE && base_frame_ != above) {
      RCLCPP_ERROR(logger_, "base frame '%s': expected '%s'", base_frame_.c_str(), BASE);
      return false;
    }
    if (tip_frames_.size() != 1 ||
      (tip_frames_[0] != TIP && tip_frames_[0] != links.back()->getName()))
    {
      RCLCPP_ERROR(logger_, "tip frames: expected one, '%s'", TIP);
      return false;
    }
    base_frame_ = BASE;
    tip_frames_ = {TIP};
    const std::string space = "robot_description_kinematics." + group_name + ".";
    ready_ = read(node, space + "position_tolerance", position_tolerance_) &&
      read(node, space + "orientation_tolerance", orientation_tolerance_) &&
      read(node, space + "singularity_stop", singularity_stop_);
    return ready_;
  }

  /// A group of the actuated joints, in any order.
  bool supportsGroup(
    const moveit::core::JointModelGroup * group, std::string * error_text_out) const override
  {
    const std::vector<std::string> names =
      group == nullptr ? std::vector<std::string>{} : group->getActiveJointModelNames();
    if (names.size() == JOINTS &&
      std::is_permutation(names.begin(), names.end(), joint_names_.begin()))
    {
      return true;
    }
    if (error_text_out != nullptr) {
      *error_text_out = "expected the robot's actuated joints and no others";
    }
    return false;
  }

  bool getPositionIK(
    const Pose & pose, const std::vector<double> & seed, std::vector<double> & solution,
    MoveItErrorCodes & error_code, const KinematicsQueryOptions & options) const override
  {
    return solve(pose, seed, {}, solution, {}, error_code, options);
  }

  bool searchPositionIK(
    const Pose & pose, const std::vector<double> & seed, double, std::vector<double> & solution,
    MoveItErrorCodes & error_code, const KinematicsQueryOptions & options) const override
  {
    return solve(pose, seed, {}, solution, {}, error_code, options);
  }

  bool searchPositionIK(
    const Pose & pose, const std::vector<double> & seed, double,
    const std::vector<double> & consistency_limits, std::vector<double> & solution,
    MoveItErrorCodes & error_code, const KinematicsQueryOptions & options) const override
  {
    return solve(pose, seed, consistency_limits, solution, {}, error_code, options);
  }

  bool searchPositionIK(
    const Pose & pose, const std::vector<double> & seed, double, std::vector<double> & solution,
    const IKCallbackFn & callback, MoveItErrorCodes & error_code,
    const KinematicsQueryOptions & options) const override
  {
    return solve(pose, seed, {}, solution, callback, error_code, options);
  }

  bool searchPositionIK(
    const Pose & pose, const std::vector<double> & seed, double,
    const std::vector<double> & consistency_limits, std::vector<double> & solution,
    const IKCallbackFn & callback, MoveItErrorCodes & error_code,
    const KinematicsQueryOptions & options) const override
  {
    return solve(pose, seed, consistency_limits, solution, callback, error_code, options);
  }

  bool searchPositionIK(
    const std::vector<Pose> & poses, const std::vector<double> & seed, double,
    const std::vector<double> & consistency_limits, std::vector<double> & solution,
    const IKCallbackFn & callback, MoveItErrorCodes & error_code,
    const KinematicsQueryOptions & options, const moveit::core::RobotState *) const override
  {
    if (poses.size() != 1) {
      return reject(solution, error_code, "poses: expected one, of the platform");
    }
    return solve(poses[0], seed, consistency_limits, solution, callback, error_code, options);
  }

  bool searchPositionIK(
    const std::vector<Pose> & poses, const std::vector<double> & seed, double timeout,
    const std::vector<double> & consistency_limits, std::vector<double> & solution,
    const IKCallbackFn & callback, const IKCostFn &, MoveItErrorCodes & error_code,
    const KinematicsQueryOptions & options, const moveit::core::RobotState * state) const override
  {
    return searchPositionIK(
      poses, seed, timeout, consistency_limits, solution, callback, error_code, options, state);
  }

  /// Limits do not bound it. No poses are given where one of the links is not known.
  bool getPositionFK(
    const std::vector<std::string> & link_names, const std::vector<double> & joint_angles,
    std::vector<Pose> & poses) const override
  {
    poses.clear();
    Position p;
    Rotation r;
    if (joint_angles.size() != JOINTS ||
      @PREFIX@_platform(joint_angles.data(), p.data(), r.data()) != 0)
    {
      RCLCPP_ERROR(logger_, "joint positions: expected %zu with an assembly", JOINTS);
      return false;
    }
    std::vector<Pose> found;
    for (const std::string & link : link_names) {
      if (link != BASE && link != TIP) {
        RCLCPP_ERROR(logger_, "link '%s': expected '%s' or '%s'", link.c_str(), BASE, TIP);
        return false;
      }
      found.push_back(
        link == TIP ? given(p, r) : given({0.0, 0.0, 0.0}, {1, 0, 0, 0, 1, 0, 0, 0, 1}));
    }
    poses = found;
    return true;
  }

  const std::vector<std::string> & getJointNames() const override {return joint_names_;}

  const std::vector<std::string> & getLinkNames() const override {return link_names_;}

private:
  bool read(const rclcpp::Node::SharedPtr & node, const std::string & name, double & value) const
  {
    try {
      value = node->has_parameter(name) ? node->get_parameter(name).as_double() :
        node->declare_parameter(name, value);
    } catch (const std::exception & error) {
      RCLCPP_ERROR(logger_, "%s: %s", name.c_str(), error.what());
      return false;
    }
    if (!(value >= 0.0)) {
      RCLCPP_ERROR(logger_, "%s: expected zero or more, got %g", name.c_str(), value);
      return false;
    }
    return true;
  }

  bool reject(std::vector<double> & solution, MoveItErrorCodes & error_code, const char * why) const
  {
    RCLCPP_DEBUG(logger_, "no solution: %s", why);
    solution.clear();
    error_code.val = MoveItErrorCodes::NO_IK_SOLUTION;
    return false;
  }

  bool solve(
    const Pose & pose, const std::vector<double> & seed,
    const std::vector<double> & consistency_limits, std::vector<double> & solution,
    const IKCallbackFn & callback, MoveItErrorCodes & error_code,
    const KinematicsQueryOptions & options) const
  {
    const auto no = [&](const char * why) {return reject(solution, error_code, why);};
    if (!ready_) {
      return no("the solver is not initialized");
    }
    if (seed.size() != JOINTS ||
      !(consistency_limits.empty() || consistency_limits.size() == JOINTS))
    {
      return no("a seed or consistency limits of another size");
    }
    Position goal, p;
    Rotation turned, r;
    if (!take(pose, goal, turned)) {
      return no("a pose that is not finite or has no unit quaternion");
    }
    Vector q;
    double index;
    if (@PREFIX@_inverse(coordinates(goal, turned).data(), q.data()) != 0 ||
      @PREFIX@_platform(q.data(), p.data(), r.data()) != 0 ||
      @PREFIX@_singularity(q.data(), &index) != 0)
    {
      return no("the pose cannot be reached");
    }
    if (!(index >= singularity_stop_)) {
      return no("the pose is too near to a singularity");
    }
    if (!options.return_approximate_solution &&
      !(distance(p, goal) <= position_tolerance_ && angle(r, turned) <= orientation_tolerance_))
    {
      return no("the machine has another pose in the directions in which it cannot be moved");
    }
    for (std::size_t i = 0; i < JOINTS; ++i) {
      if (!(q[i] >= DRIVES[i].lower && q[i] <= DRIVES[i].upper)) {
        return no("a joint is outside its limits");
      }
      if (!std::isfinite(seed[i]) || (!consistency_limits.empty() &&
        !(std::abs(q[i] - seed[i]) <= consistency_limits[i])))
      {
        return no("a joint is further from the seed than the consistency limits");
      }
    }
    solution.assign(q.begin(), q.end());
    error_code.val = MoveItErrorCodes::SUCCESS;
    if (callback) {
      callback(pose, solution, error_code);
    }
    if (error_code.val != MoveItErrorCodes::SUCCESS) {
      solution.clear();
      return false;
    }
    return true;
  }

  bool ready_ = false;
  std::vector<std::string> joint_names_, link_names_{TIP};
  double position_tolerance_ = @POSITION@, orientation_tolerance_ = @ORIENTATION@;
  double singularity_stop_ = @SINGULARITY@;
  rclcpp::Logger logger_ = rclcpp::get_logger("@PACKAGE@.kinematics");
};
}  // namespace @PACKAGE@

PLUGINLIB_EXPORT_CLASS(@PACKAGE@::Kinematics, kinematics::KinematicsBase)
