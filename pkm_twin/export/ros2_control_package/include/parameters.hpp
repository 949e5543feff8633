// SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#ifndef @GUARD@__PARAMETERS_HPP_
#define @GUARD@__PARAMETERS_HPP_

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "rclcpp/rclcpp.hpp"
#include "rclcpp_lifecycle/lifecycle_node.hpp"

#include "@PACKAGE@/feedforward.hpp"

/// Parameters of the controller. What is wrong throws, with the parameter's name and what is right.
namespace @PACKAGE@
{
using Node = rclcpp_lifecycle::LifecycleNode;

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
inline std::vector<std::string> declare_parameters(Node & node)
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
    add("gains." + joints[i] + ".p", 0.0);
    add("gains." + joints[i] + ".d", 0.0);
    add("limits." + joints[i] + ".lower", DRIVES[i].lower);
    add("limits." + joints[i] + ".upper", DRIVES[i].upper);
    add("limits." + joints[i] + ".effort", DRIVES[i].effort);
  }
  add("payload.mass", PAYLOAD.mass);
  add("payload.com", std::vector<double>(PAYLOAD.com.begin(), PAYLOAD.com.end()));
  add("payload.inertia", std::vector<double>(PAYLOAD.inertia.begin(), PAYLOAD.inertia.end()));
  add("singularity_stop", Settings().singularity_stop);
  add("hold_time", Settings().hold_time);
  add("reference_timeout", 0.1);
  add("state_publish_rate", 50.0);
  return joints;
}

/// A misspelt joint would else keep its gain of zero without a word.
inline void check_names(Node & node, const std::vector<std::string> & joints)
{
  std::set<std::string> known{"payload.mass", "payload.com", "payload.inertia"};
  for (const std::string & joint : joints) {
    for (const char * leaf : {"p", "d"}) {
      known.insert("gains." + joint + "." + leaf);
    }
    for (const char * leaf : {"lower", "upper", "effort"}) {
      known.insert("limits." + joint + "." + leaf);
    }
  }
  const auto & given = node.get_node_parameters_interface()->get_parameter_overrides();
  for (const auto & [name, value] : given) {
    const std::string group = name.substr(0, name.find('.'));
    const bool ours = group == "gains" || group == "limits" || group == "payload";
    if (ours && known.count(name) == 0) {
      throw std::invalid_argument(name + ": unknown parameter; the first joint is " + joints[0]);
    }
  }
}

/// The settings, with changes that are not made yet.
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
  for (std::size_t i = 0; i < JOINTS; ++i) {
    result.p[i] = bounded("gains." + joints[i] + ".p", 0.0, MOST);
    result.d[i] = bounded("gains." + joints[i] + ".d", 0.0, MOST);
    const std::string limits = "limits." + joints[i];
    result.lower[i] = bounded(limits + ".lower", -UNLIMITED, UNLIMITED);
    result.upper[i] = bounded(limits + ".upper", result.lower[i], UNLIMITED);
    result.effort[i] = bounded(limits + ".effort", 0.0, UNLIMITED);
  }
  result.singularity_stop = bounded("singularity_stop", 0.0, 1.0);
  result.hold_time = bounded("hold_time", 0.0, UNLIMITED);
  const double mass = bounded("payload.mass", 0.0, MOST);
  const auto com = numbers<3>(get("payload.com"));
  const auto inertia = numbers<9>(get("payload.inertia"));
  if (payload_parameters(mass, com, inertia, result.parameters) != 0) {
    throw std::invalid_argument("payload: expected finite numbers");
  }
  return result;
}
}  // namespace @PACKAGE@

#endif  // @GUARD@__PARAMETERS_HPP_
