// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// What the exported controllers' parameters use of rclcpp, for a test without ROS.
#pragma once
#include <map>
#include <string>
#include <variant>
#include <vector>

namespace rcl_interfaces::msg
{
struct ParameterDescriptor {bool dynamic_typing = false;};
}
namespace rclcpp
{
enum class ParameterType {PARAMETER_INTEGER, PARAMETER_DOUBLE, PARAMETER_DOUBLE_ARRAY, PARAMETER_STRING_ARRAY};
using ParameterValue =
  std::variant<int, double, std::vector<double>, std::vector<std::string>>;
class Parameter
{
public:
  Parameter() = default;
  Parameter(const std::string & name, const ParameterValue & value) : name_(name), value_(value) {}
  const std::string & get_name() const {return name_;}
  ParameterType get_type() const {return static_cast<ParameterType>(value_.index());}
  int as_int() const {return std::get<int>(value_);}
  double as_double() const {return std::get<double>(value_);}
  std::vector<double> as_double_array() const {return std::get<2>(value_);}
  std::vector<std::string> as_string_array() const {return std::get<3>(value_);}
  std::string value_to_string() const {return std::to_string(as_double());}
  bool operator==(const Parameter & other) const {return value_ == other.value_;}
  bool operator!=(const Parameter & other) const {return !(*this == other);}

private:
  std::string name_;
  ParameterValue value_;
};
}  // namespace rclcpp
namespace rclcpp_lifecycle
{
class LifecycleNode
{
public:
  bool has_parameter(const std::string & name) const {return values.count(name) > 0;}
  void declare_parameter(
    const std::string & name, const rclcpp::ParameterValue & value,
    const rcl_interfaces::msg::ParameterDescriptor &) {values[name] = {name, value};}
  rclcpp::Parameter get_parameter(const std::string & name) const {return values.at(name);}
  LifecycleNode * get_node_parameters_interface() {return this;}
  const std::map<std::string, rclcpp::Parameter> & get_parameter_overrides() const {return values;}
  std::map<std::string, rclcpp::Parameter> values;
};
}  // namespace rclcpp_lifecycle
