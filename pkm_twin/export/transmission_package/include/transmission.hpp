// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export transmission, which overwrites changes.
#ifndef @GUARD@__TRANSMISSION_HPP_
#define @GUARD@__TRANSMISSION_HPP_

#include <array>
#include <cstddef>
#include <string>
#include <vector>

#include "transmission_interface/transmission.hpp"

namespace @PACKAGE@
{
constexpr std::size_t JOINTS = @JOINTS@;
constexpr std::size_t ACTUATORS = @ACTUATORS@;

/// A pose coordinate on the joint side has its name as the role in the URDF.
constexpr std::array<const char *, JOINTS> ROLES = {@ROLES@};

/// An actuator: its name, and its position is offset + factor * the model's.
struct Actuator
{
  const char * name;
  double factor;
  double offset;
};
constexpr std::array<Actuator, ACTUATORS> DRIVES = {{
@DRIVES@
}};

constexpr auto ABSOLUTE_POSITION = "absolute_position";
/// Joint interface that receives the status of the last call, as a number.
constexpr auto STATUS = "transmission_status";

enum class Status
{
  GOOD = 0,
  HELD = 1,  ///< No valid result for the first time: the last valid one is given again.
  OUT_OF_REACH = 2,  ///< No assembly, or a singularity: all results are NaN.
  NOT_FINITE = 3,  ///< An input is missing, NaN or infinite: all results are NaN.
};

/// The linkage between the pose coordinates (joints) and the actuators. Calls allocate nothing.
class LinkageTransmission : public transmission_interface::Transmission
{
public:
  /// Names in the URDF, in the order of ROLES and DRIVES.
  LinkageTransmission(
    const std::array<std::string, JOINTS> & joints,
    const std::array<std::string, ACTUATORS> & actuators);

  void configure(
    const std::vector<transmission_interface::JointHandle> & joint_handles,
    const std::vector<transmission_interface::ActuatorHandle> & actuator_handles) override;
  void actuator_to_joint() override;
  void joint_to_actuator() override;
  std::size_t num_actuators() const override {return ACTUATORS;}
  std::size_t num_joints() const override {return JOINTS;}
  std::vector<std::string> get_supported_joint_interfaces() const override;
  std::vector<std::string> get_supported_actuator_interfaces() const override;

  /// Status of the last call, in either direction.
  Status status() const {return status_;}

private:
  template<std::size_t SIZE> struct State
  {
    std::array<double, SIZE> position, velocity, effort;
  };
  /// What one direction has given: the last valid result, and how many calls since had none.
  template<std::size_t SIZE> struct Last
  {
    State<SIZE> result;
    bool known = false;
    std::size_t misses = 0;
  };
  template<typename HANDLE> struct Handles
  {
    std::vector<HANDLE> position, velocity, effort, absolute;
  };
  template<std::size_t SIZE>
  const State<SIZE> & judge(int code, const State<SIZE> & found, Last<SIZE> & last);
  void report();

  std::array<std::string, JOINTS> joint_names_;
  std::array<std::string, ACTUATORS> actuator_names_;
  Handles<transmission_interface::JointHandle> joints_;
  Handles<transmission_interface::ActuatorHandle> actuators_;
  std::vector<transmission_interface::JointHandle> reports_;
  Last<JOINTS> joint_;
  Last<ACTUATORS> actuator_;
  Last<JOINTS> absolute_;
  Status status_ = Status::NOT_FINITE;
};

}  // namespace @PACKAGE@

#endif  // @GUARD@__TRANSMISSION_HPP_
