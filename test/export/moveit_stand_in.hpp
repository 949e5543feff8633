// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// A stand-in for the headers of MoveIt 2 (Jazzy), rclcpp and pluginlib: the declarations that the
// exported plugin uses, with MoveIt's signatures, so that it is compiled and run without ROS.
#pragma once

#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#define RCLCPP_ERROR(logger, ...) (void)(logger), std::fprintf(stderr, __VA_ARGS__)
#define RCLCPP_DEBUG(logger, ...) RCLCPP_ERROR(logger, __VA_ARGS__)
#define PLUGINLIB_EXPORT_CLASS(name, base) \
  std::unique_ptr<base> plugin() {return std::make_unique<name>();}

namespace rclcpp
{
struct Logger {};
inline Logger get_logger(const std::string &) {return {};}

struct Parameter
{
  double value;
  double as_double() const
  {
    if (value == 1.0) {throw std::runtime_error("expected [double] got [integer]");}
    return value;
  }
};

struct Node
{
  using SharedPtr = std::shared_ptr<Node>;
  std::map<std::string, double> values;
  bool has_parameter(const std::string & name) const {return values.count(name) != 0;}
  Parameter get_parameter(const std::string & name) const {return {values.at(name)};}
  double declare_parameter(const std::string & name, double value) {return values[name] = value;}
};
}  // namespace rclcpp

namespace geometry_msgs::msg
{
struct Pose
{
  struct {double x = 0.0, y = 0.0, z = 0.0;} position;
  struct {double x = 0.0, y = 0.0, z = 0.0, w = 1.0;} orientation;
};
}  // namespace geometry_msgs::msg

namespace moveit_msgs::msg
{
struct MoveItErrorCodes
{
  static constexpr int SUCCESS = 1, GOAL_IN_COLLISION = -12, NO_IK_SOLUTION = -31;
  int val = 0;
};
}  // namespace moveit_msgs::msg

namespace moveit::core
{
struct RobotState;

struct LinkModel
{
  std::string name;
  const LinkModel * parent;
  const std::string & getName() const {return name;}
  const LinkModel * getParentLinkModel() const {return parent;}
};

struct JointModelGroup
{
  std::vector<std::string> joints;
  std::vector<const LinkModel *> links;
  const std::vector<std::string> & getActiveJointModelNames() const {return joints;}
  const std::vector<const LinkModel *> & getLinkModels() const {return links;}
};

struct RobotModel
{
  std::map<std::string, JointModelGroup> groups;
  std::vector<std::string> links;
  const JointModelGroup * getJointModelGroup(const std::string & name) const
  {
    return groups.count(name) ? &groups.at(name) : nullptr;
  }
  bool hasLinkModel(const std::string & name) const
  {
    for (const auto & link : links) {
      if (link == name) {return true;}
    }
    return false;
  }
};
}  // namespace moveit::core

namespace kinematics
{
struct KinematicsQueryOptions
{
  bool return_approximate_solution = false;
};
struct KinematicsResult {};

class KinematicsBase
{
public:
  using Pose = geometry_msgs::msg::Pose;
  using Codes = moveit_msgs::msg::MoveItErrorCodes;
  using Options = KinematicsQueryOptions;
  using Numbers = std::vector<double>;
  using IKCallbackFn = std::function<void(const Pose &, const Numbers &, Codes &)>;
  using IKCostFn = std::function<double(const Pose &, const moveit::core::RobotState &,
      const moveit::core::JointModelGroup *, const Numbers &)>;

  virtual ~KinematicsBase() = default;
  virtual bool getPositionIK(
    const Pose &, const Numbers &, Numbers &, Codes &, const Options & = {}) const = 0;
  virtual bool getPositionIK(
    const std::vector<Pose> &, const Numbers &, std::vector<Numbers> &, KinematicsResult &,
    const Options &) const {return false;}
  virtual bool searchPositionIK(
    const Pose &, const Numbers &, double, Numbers &, Codes &, const Options & = {}) const = 0;
  virtual bool searchPositionIK(
    const Pose &, const Numbers &, double, const Numbers &, Numbers &, Codes &,
    const Options & = {}) const = 0;
  virtual bool searchPositionIK(
    const Pose &, const Numbers &, double, Numbers &, const IKCallbackFn &, Codes &,
    const Options & = {}) const = 0;
  virtual bool searchPositionIK(
    const Pose &, const Numbers &, double, const Numbers &, Numbers &, const IKCallbackFn &,
    Codes &, const Options & = {}) const = 0;
  virtual bool searchPositionIK(
    const std::vector<Pose> &, const Numbers &, double, const Numbers &, Numbers &,
    const IKCallbackFn &, Codes &, const Options & = {},
    const moveit::core::RobotState * = nullptr) const {return false;}
  virtual bool searchPositionIK(
    const std::vector<Pose> &, const Numbers &, double, const Numbers &, Numbers &,
    const IKCallbackFn &, const IKCostFn &, Codes &, const Options & = {},
    const moveit::core::RobotState * = nullptr) const {return false;}
  virtual bool getPositionFK(
    const std::vector<std::string> &, const Numbers &, std::vector<Pose> &) const = 0;
  virtual bool initialize(
    const rclcpp::Node::SharedPtr &, const moveit::core::RobotModel &, const std::string &,
    const std::string &, const std::vector<std::string> &, double) = 0;
  virtual const std::string & getBaseFrame() const {return base_frame_;}
  virtual const std::vector<std::string> & getTipFrames() const {return tip_frames_;}
  virtual const std::vector<std::string> & getJointNames() const = 0;
  virtual const std::vector<std::string> & getLinkNames() const = 0;
  virtual bool supportsGroup(
    const moveit::core::JointModelGroup *, std::string * = nullptr) const = 0;

protected:
  void storeValues(
    const moveit::core::RobotModel &, const std::string &, const std::string & base,
    const std::vector<std::string> & tips, double)
  {
    base_frame_ = base;
    tip_frames_ = tips;
  }
  std::string base_frame_;
  std::vector<std::string> tip_frames_;
};
}  // namespace kinematics
