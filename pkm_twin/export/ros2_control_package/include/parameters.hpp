// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#ifndef @GUARD@__PARAMETERS_HPP_
#define @GUARD@__PARAMETERS_HPP_

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

#include "rclcpp/rclcpp.hpp"
#include "rclcpp_lifecycle/lifecycle_node.hpp"

#include "@PACKAGE@/feedforward.hpp"

/// Parameters of the controllers. What is wrong throws, with the parameter's name and what is right.
namespace @PACKAGE@
{
using Node = rclcpp_lifecycle::LifecycleNode;

/// What a controller does, and which parameters it has.
enum class Role
{
  FOLLOWS,  // a reference
  CARRIES,  // the weight at the measured position
};

inline double number(const rclcpp::Parameter & parameter)
{
  if (parameter.get_type() == rclcpp::ParameterType::PARAMETER_INTEGER) {
    return static_cast<double>(parameter.as_int());
  }
  if (parameter.get_type() != rclcpp::ParameterType::PARAMETER_DOUBLE) {
    throw std::invalid_argument(parameter.get_name() + ": expected a number");
  }
  return parameter.as_double();
}

template<std::size_t SIZE>
std::array<double, SIZE> numbers(const rclcpp::Parameter & parameter)
{
  const std::string wrong =
    parameter.get_name() + ": expected " + std::to_string(SIZE) + " numbers, all written as 0.0";
  if (parameter.get_type() != rclcpp::ParameterType::PARAMETER_DOUBLE_ARRAY) {
    throw std::invalid_argument(wrong);
  }
  const std::vector<double> values = parameter.as_double_array();
  if (values.size() != SIZE) {
    throw std::invalid_argument(wrong);
  }
  std::array<double, SIZE> result;
  std::copy(values.begin(), values.end(), result.begin());
  return result;
}

/// Parameters by name.
using Values = std::map<std::string, rclcpp::Parameter>;

/// Whether a parameter counts for all controllers of the machine: payload and effort limits.
inline bool is_common(const std::string & name)
{
  const std::string end = ".effort";
  return name.rfind("payload.", 0) == 0 || (name.rfind("limits.", 0) == 0 &&
         name.size() > end.size() && name.compare(name.size() - end.size(), end.size(), end) == 0);
}

/// The parameter, a whole number as a float.
inline rclcpp::Parameter as_double(const rclcpp::Parameter & parameter)
{
  return parameter.get_type() == rclcpp::ParameterType::PARAMETER_INTEGER ?
         rclcpp::Parameter(parameter.get_name(), number(parameter)) : parameter;
}

constexpr double MOST = std::numeric_limits<double>::max();

inline double within(const std::string & name, double value, double least, double most)
{
  if (value >= least && value <= most) {
    return value;
  }
  std::string expected = "at least " + std::to_string(least);
  if (most < MOST) {
    expected = std::to_string(least) + " to " + std::to_string(most);
  } else if (most == MOST) {
    expected += " and finite";
  }
  throw std::invalid_argument(name + ": " + std::to_string(value) + ", expected " + expected);
}

/// Declare all with the robot's numbers; the joints' names.
inline std::vector<std::string> declare_parameters(Node & node, Role role)
{
  // Whole numbers are taken for floats.
  rcl_interfaces::msg::ParameterDescriptor any;
  any.dynamic_typing = true;
  const auto add = [&](const std::string & name, const auto & value) {
      if (!node.has_parameter(name)) {
        node.declare_parameter(name, rclcpp::ParameterValue(value), any);
      }
    };
  std::vector<std::string> own;
  for (const Drive & drive : DRIVES) {
    own.emplace_back(drive.name);
  }
  add("joints", own);
  const auto joints = node.get_parameter("joints").as_string_array();
  if (joints.size() != JOINTS) {
    throw std::invalid_argument("joints: expected " + std::to_string(JOINTS) + " names");
  }
  for (std::size_t i = 0; i < JOINTS; ++i) {
    for (std::size_t k = 0; k < JOINTS; ++k) {
      // The robot's names in another order would drive each other's motors.
      if (k != i && (joints[i] == joints[k] || joints[i] == own[k])) {
        throw std::invalid_argument(
                "joints: " + joints[i] + " in place " + std::to_string(i + 1) +
                ", expected different names in the robot's order, the first for " + own[0]);
      }
    }
  }
  const bool follows = role == Role::FOLLOWS;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    const std::string gains = "gains." + joints[i], limits = "limits." + joints[i];
    add(gains + ".d", follows ? 0.0 : DRIVES[i].damping);
    add(limits + ".effort", DRIVES[i].effort);
    if (follows) {
      add(gains + ".p", 0.0);
      add(limits + ".lower", DRIVES[i].lower);
      add(limits + ".upper", DRIVES[i].upper);
    }
  }
  add("payload.mass", PAYLOAD.mass);
  add("payload.com", std::vector<double>(PAYLOAD.com.begin(), PAYLOAD.com.end()));
  add("payload.inertia", std::vector<double>(PAYLOAD.inertia.begin(), PAYLOAD.inertia.end()));
  // Near a singularity the weight still has its effort, up to the limits.
  add("singularity_stop", follows ? Settings().singularity_stop : 0.0);
  add("hold_time", Settings().hold_time);
  add("state_publish_rate", 50.0);
  if (follows) {
    add("reference_timeout", 0.1);
  }
  return joints;
}

/// A misspelt joint would else keep its gain of zero without a word.
inline void check_names(Node & node, const std::vector<std::string> & joints)
{
  const auto & given = node.get_node_parameters_interface()->get_parameter_overrides();
  for (const auto & [name, value] : given) {
    const std::string group = name.substr(0, name.find('.'));
    const bool ours = group == "gains" || group == "limits" || group == "payload";
    if (ours && !node.has_parameter(name)) {
      throw std::invalid_argument(name + ": unknown parameter; the first joint is " + joints[0]);
    }
  }
}

/// Parameters of a payload, by the rule of the robot's file.
inline Parameters read_payload(
  double mass, const std::array<double, 3> & com, const std::array<double, 9> & inertia)
{
  Parameters result;
  if (payload_parameters(mass, {}, {}, result) != 0) {
    throw std::invalid_argument(
            "payload.mass: " + std::to_string(mass) + ", expected 0 to " +
            std::to_string(MAX_MASS) + " kg");
  }
  if (payload_parameters(mass, com, {}, result) != 0) {
    throw std::invalid_argument(
            "payload.com: expected numbers up to " + std::to_string(MAX_LENGTH) + " m");
  }
  if (payload_parameters(mass, com, inertia, result) != 0) {
    throw std::invalid_argument(
            "payload.inertia: expected a symmetric matrix whose principal moments are at least "
            "zero, each at most the sum of the others, and zeros for a mass of 0");
  }
  return result;
}

/// Payload and effort limits of the machine, by the values that its controllers have in common.
inline Load read_load(const Values & values, const std::vector<std::string> & joints)
{
  Load result;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    const std::string name = "limits." + joints[i] + ".effort";
    result.effort[i] = within(name, number(values.at(name)), 0.0, UNLIMITED);
  }
  result.parameters = read_payload(
    number(values.at("payload.mass")), numbers<3>(values.at("payload.com")),
    numbers<9>(values.at("payload.inertia")));
  return result;
}

/// A controller's own settings, with changes that are not made yet.
inline Settings read_settings(
  const Node & node, const std::vector<std::string> & joints,
  const std::vector<rclcpp::Parameter> & changes)
{
  const auto get = [&](const std::string & name) {
      for (const rclcpp::Parameter & change : changes) {
        if (change.get_name() == name) {
          return change;
        }
      }
      return node.get_parameter(name);
    };
  const auto bounded = [&](const std::string & name, double least, double most) {
      return within(name, number(get(name)), least, most);
    };
  Settings result;
  result.lower.fill(-UNLIMITED);
  result.upper.fill(UNLIMITED);
  for (std::size_t i = 0; i < JOINTS; ++i) {
    const std::string gains = "gains." + joints[i], limits = "limits." + joints[i];
    result.d[i] = bounded(gains + ".d", 0.0, MOST);
    if (node.has_parameter(gains + ".p")) {
      result.p[i] = bounded(gains + ".p", 0.0, MOST);
      result.lower[i] = bounded(limits + ".lower", -UNLIMITED, UNLIMITED);
      result.upper[i] = bounded(limits + ".upper", result.lower[i], UNLIMITED);
    }
  }
  result.singularity_stop = bounded("singularity_stop", 0.0, 1.0);
  result.hold_time = bounded("hold_time", 0.0, UNLIMITED);
  return result;
}
}  // namespace @PACKAGE@

#endif  // @GUARD@__PARAMETERS_HPP_
