// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export transmission, which overwrites changes.
#include <array>
#include <memory>
#include <stdexcept>
#include <string>

#include "hardware_interface/hardware_info.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/logging.hpp"
#include "transmission_interface/transmission_loader.hpp"

#include "@PACKAGE@/transmission.hpp"

namespace @PACKAGE@
{
namespace
{
/// The name in the URDF whose role this is; its reduction and offset belong in the robot's file.
template<typename INFO>
std::string named(const std::vector<INFO> & entries, const std::string & role)
{
  for (const auto & entry : entries) {
    if (entry.role == role) {
      if (entry.mechanical_reduction != 1.0 || entry.offset != 0.0) {
        throw std::invalid_argument(
                entry.name + ": mechanical_reduction must be 1 and offset 0; write them as "
                "joint_map into the robot's file and export it again");
      }
      return entry.name;
    }
  }
  throw std::invalid_argument("no joint or actuator has the role '" + role + "'");
}
}  // namespace

/// Loads the transmission of @ROBOT@ from the <transmission> element of a URDF.
class LinkageTransmissionLoader : public transmission_interface::TransmissionLoader
{
public:
  std::shared_ptr<transmission_interface::Transmission> load(
    const hardware_interface::TransmissionInfo & info) override
  {
    try {
      if (info.joints.size() != JOINTS || info.actuators.size() != ACTUATORS) {
        throw std::invalid_argument(
                "expected @JOINTS@ joints and @ACTUATORS@ actuators, found " +
                std::to_string(info.joints.size()) + " and " +
                std::to_string(info.actuators.size()));
      }
      std::array<std::string, JOINTS> joints;
      std::array<std::string, ACTUATORS> actuators;
      for (std::size_t k = 0; k < JOINTS; ++k) {
        joints[k] = named(info.joints, ROLES[k]);
      }
      for (std::size_t k = 0; k < ACTUATORS; ++k) {
        actuators[k] = named(info.actuators, DRIVES[k].name);
      }
      return std::make_shared<LinkageTransmission>(joints, actuators);
    } catch (const std::exception & error) {
      RCLCPP_ERROR(
        rclcpp::get_logger("@PACKAGE@"), "transmission '%s': %s", info.name.c_str(), error.what());
      return nullptr;
    }
  }
};
}  // namespace @PACKAGE@

PLUGINLIB_EXPORT_CLASS(
  @PACKAGE@::LinkageTransmissionLoader, transmission_interface::TransmissionLoader)
