// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#include "controller_interface/controller_interface.hpp"
#include "pluginlib/class_list_macros.hpp"

#include "@PACKAGE@/loop.hpp"

namespace @PACKAGE@
{
constexpr Reasons REASONS{
  "the measured position is not finite",
  "the measured position is beyond a limit",
  "the machine cannot be assembled at the measured position",
  "the measured position is too close to a singularity",
  "a measured velocity is not finite",
  "carrying the weight",
};

/// Controller to fall back to: the effort that bears the weight at the measured position, and
/// damping. It follows nothing and holds no position.
class GravityController : public Loop<controller_interface::ControllerInterface>
{
public:
  GravityController()
  : Loop(Role::CARRIES, "gravity", REASONS) {}

  return_type update(const rclcpp::Time & time, const rclcpp::Duration & period) override
  {
    measure();
    const Motion here{position_, {}, {}};
    return follow(&here, time, period);
  }
};
}  // namespace @PACKAGE@

PLUGINLIB_EXPORT_CLASS(@PACKAGE@::GravityController, controller_interface::ControllerInterface)
