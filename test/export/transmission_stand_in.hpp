// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// The declarations of ros2_control that an exported transmission uses.
#pragma once
#include <cstddef>
#include <exception>
#include <string>
#include <vector>

namespace hardware_interface
{
constexpr char HW_IF_POSITION[] = "position";
constexpr char HW_IF_VELOCITY[] = "velocity";
constexpr char HW_IF_EFFORT[] = "effort";
}  // namespace hardware_interface

namespace transmission_interface
{
class Exception : public std::exception
{
public:
  explicit Exception(const std::string & text) : text_(text) {}
  const char * what() const noexcept override {return text_.c_str();}

private:
  std::string text_;
};

class Handle
{
public:
  Handle(const std::string & prefix, const std::string & interface, double * value = nullptr)
  : prefix_(prefix), interface_(interface), value_(value) {}
  operator bool() const {return value_ != nullptr;}
  const std::string & get_interface_name() const {return interface_;}
  const std::string & get_prefix_name() const {return prefix_;}
  double get_value() const {return *value_;}
  void set_value(double value) {*value_ = value;}

private:
  std::string prefix_, interface_;
  double * value_;
};
class ActuatorHandle : public Handle {using Handle::Handle;};
class JointHandle : public Handle {using Handle::Handle;};

class Transmission
{
public:
  virtual ~Transmission() = default;
  virtual void configure(
    const std::vector<JointHandle> &, const std::vector<ActuatorHandle> &) = 0;
  virtual std::vector<std::string> get_supported_joint_interfaces() const = 0;
  virtual std::vector<std::string> get_supported_actuator_interfaces() const = 0;
  virtual void actuator_to_joint() = 0;
  virtual void joint_to_actuator() = 0;
  virtual std::size_t num_actuators() const = 0;
  virtual std::size_t num_joints() const = 0;
};
}  // namespace transmission_interface
