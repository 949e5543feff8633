// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export transmission, which overwrites changes.
#include "@PACKAGE@/transmission.hpp"

#include <cmath>
#include <limits>

#include "hardware_interface/types/hardware_interface_type_values.hpp"
#include "transmission_interface/exception.hpp"

#include "@PREFIX@.h"

namespace @PACKAGE@
{
namespace
{
constexpr double NOTHING = std::numeric_limits<double>::quiet_NaN();

/// The handles of one interface in the order of the names; none, or one for each name.
template<typename HANDLE, std::size_t SIZE>
std::vector<HANDLE> find(
  const std::vector<HANDLE> & handles, const std::array<std::string, SIZE> & names,
  const std::string & interface)
{
  std::vector<HANDLE> result;
  for (const auto & name : names) {
    for (const auto & handle : handles) {
      if (handle.get_prefix_name() == name && handle.get_interface_name() == interface && handle) {
        result.push_back(handle);
      }
    }
  }
  if (!result.empty() && result.size() != SIZE) {
    throw transmission_interface::Exception(
            "interface '" + interface + "': " + std::to_string(result.size()) + " handles for " +
            std::to_string(SIZE) + " names of the transmission of @ROBOT@");
  }
  return result;
}

/// Values of an interface. Zeros, and false, where it is absent or nobody commands it (all NaN).
template<typename HANDLE, std::size_t SIZE>
bool read(const std::vector<HANDLE> & handles, std::array<double, SIZE> & values)
{
  std::size_t given = 0;
  for (std::size_t k = 0; k < handles.size(); ++k) {
    values[k] = handles[k].get_value();
    given += std::isnan(values[k]) ? 0 : 1;
  }
  if (given == 0) {
    values.fill(0.0);
  }
  return given > 0;
}

template<typename HANDLE, std::size_t SIZE>
void write(std::vector<HANDLE> & handles, const std::array<double, SIZE> & values, bool given)
{
  for (std::size_t k = 0; k < handles.size(); ++k) {
    handles[k].set_value(given ? values[k] : NOTHING);
  }
}
}  // namespace

LinkageTransmission::LinkageTransmission(
  const std::array<std::string, JOINTS> & joints,
  const std::array<std::string, ACTUATORS> & actuators)
: joint_names_(joints), actuator_names_(actuators)
{
}

std::vector<std::string> LinkageTransmission::get_supported_joint_interfaces() const
{
  return {
    hardware_interface::HW_IF_POSITION, hardware_interface::HW_IF_VELOCITY,
    hardware_interface::HW_IF_EFFORT, ABSOLUTE_POSITION, STATUS};
}

std::vector<std::string> LinkageTransmission::get_supported_actuator_interfaces() const
{
  return {
    hardware_interface::HW_IF_POSITION, hardware_interface::HW_IF_VELOCITY,
    hardware_interface::HW_IF_EFFORT, ABSOLUTE_POSITION};
}

void LinkageTransmission::configure(
  const std::vector<transmission_interface::JointHandle> & joint_handles,
  const std::vector<transmission_interface::ActuatorHandle> & actuator_handles)
{
  const auto take = [](auto & into, const auto & handles, const auto & names) {
      into.position = find(handles, names, hardware_interface::HW_IF_POSITION);
      into.velocity = find(handles, names, hardware_interface::HW_IF_VELOCITY);
      into.effort = find(handles, names, hardware_interface::HW_IF_EFFORT);
      into.absolute = find(handles, names, ABSOLUTE_POSITION);
    };
  take(joints_, joint_handles, joint_names_);
  take(actuators_, actuator_handles, actuator_names_);
  reports_.clear();
  for (const auto & handle : joint_handles) {
    if (handle.get_interface_name() == STATUS && handle) {
      reports_.push_back(handle);
    }
  }
  if (actuators_.position.empty() && actuators_.absolute.empty()) {
    throw transmission_interface::Exception(
            "the transmission of @ROBOT@ needs the actuators' position or absolute_position");
  }
  joint_ = absolute_ = {};
  actuator_ = {};
  status_ = Status::NOT_FINITE;
}

template<std::size_t SIZE>
const LinkageTransmission::State<SIZE> & LinkageTransmission::judge(
  int code, const State<SIZE> & found, Last<SIZE> & last)
{
  static constexpr auto nothing = [] {
      State<SIZE> state{};
      for (std::size_t k = 0; k < SIZE; ++k) {
        state.position[k] = state.velocity[k] = state.effort[k] = NOTHING;
      }
      return state;
    }();
  if (code == 0) {
    last.result = found;
    last.known = true;
    last.misses = 0;
    status_ = Status::GOOD;
    return last.result;
  }
  ++last.misses;
  if (last.known && last.misses == 1) {
    status_ = Status::HELD;
    return last.result;
  }
  last.known = false;
  status_ = code == 1 ? Status::OUT_OF_REACH : Status::NOT_FINITE;
  return nothing;
}

void LinkageTransmission::report()
{
  for (auto & handle : reports_) {
    handle.set_value(static_cast<double>(status_));
  }
}

void LinkageTransmission::actuator_to_joint()
{
  State<ACTUATORS> in;
  State<JOINTS> out;
  const auto convert = [&](const auto & handles, bool moving, Last<JOINTS> & last) {
      const bool placed = read(handles, in.position);
      const bool rates = moving && read(actuators_.velocity, in.velocity);
      const bool efforts = moving && read(actuators_.effort, in.effort);
      for (std::size_t i = 0; i < ACTUATORS; ++i) {
        in.position[i] = (in.position[i] - DRIVES[i].offset) / DRIVES[i].factor;
        in.velocity[i] = rates ? in.velocity[i] / DRIVES[i].factor : 0.0;
        in.effort[i] = efforts ? in.effort[i] * DRIVES[i].factor : 0.0;
      }
      const int code = !placed ? 2 : @PREFIX@_actuator_to_joint(
        in.position.data(), in.velocity.data(), in.effort.data(),
        out.position.data(), out.velocity.data(), out.effort.data());
      const auto & result = judge(code, out, last);
      if (moving) {
        write(joints_.position, result.position, true);
        write(joints_.velocity, result.velocity, rates);
        write(joints_.effort, result.effort, efforts);
      } else {
        write(joints_.absolute, result.position, true);
      }
    };
  if (!actuators_.absolute.empty()) {
    convert(actuators_.absolute, false, absolute_);
  }
  if (!actuators_.position.empty()) {
    convert(actuators_.position, true, joint_);
  }
  report();
}

void LinkageTransmission::joint_to_actuator()
{
  State<JOINTS> in;
  State<ACTUATORS> out;
  bool placed = read(joints_.position, in.position);
  const bool commanded = placed;
  const bool rates = read(joints_.velocity, in.velocity);
  const bool efforts = read(joints_.effort, in.effort);
  if (!placed && joint_.known) {
    // Velocities and efforts alone are converted at the measured position.
    in.position = joint_.result.position;
    placed = true;
  }
  const int code = !placed || !(commanded || rates || efforts) ? 2 : @PREFIX@_joint_to_actuator(
    in.position.data(), in.velocity.data(), in.effort.data(),
    out.position.data(), out.velocity.data(), out.effort.data());
  for (std::size_t i = 0; i < ACTUATORS; ++i) {
    out.position[i] = DRIVES[i].offset + DRIVES[i].factor * out.position[i];
    out.velocity[i] *= DRIVES[i].factor;
    out.effort[i] /= DRIVES[i].factor;
  }
  const auto & result = judge(code, out, actuator_);
  write(actuators_.position, result.position, commanded);
  write(actuators_.velocity, result.velocity, rates);
  write(actuators_.effort, result.effort, efforts);
  report();
}

}  // namespace @PACKAGE@
