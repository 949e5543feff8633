// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "controller_interface/chainable_controller_interface.hpp"
#include "controller_interface/controller_interface.hpp"
#include "pluginlib/class_list_macros.hpp"

#include "@PACKAGE@/loop.hpp"

namespace @PACKAGE@
{
constexpr Reasons FOLLOWING{
  "the reference is not finite",
  "the reference is beyond a position limit",
  "the machine cannot be assembled at the reference",
  "the reference is too close to a singularity",
  "a measured state is not finite",
  "following",
};

/// Chainable controller: inverse dynamics at the reference plus PD.
class FeedforwardController : public Loop<controller_interface::ChainableControllerInterface>
{
public:
  FeedforwardController()
  : Loop(Role::FOLLOWS, "feedforward", FOLLOWING) {}

  CallbackReturn on_configure(const rclcpp_lifecycle::State &) override;
  CallbackReturn on_activate(const rclcpp_lifecycle::State &) override;

protected:
  std::vector<hardware_interface::CommandInterface::SharedPtr> on_export_reference_interfaces_list()
  override;
  return_type update_reference_from_subscribers(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;
  return_type update_and_write_commands(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;

private:
  void read_reference();

  double reference_timeout_ = 0.1;
  Mailbox<Motion> received_;
  std::uint64_t taken_ = 0;
  rclcpp::Subscription<PointMessage>::SharedPtr subscription_;

  Motion reference_;
  bool following_ = false;
  double reference_age_ = 0.0;
};

CallbackReturn FeedforwardController::on_configure(const rclcpp_lifecycle::State & state)
{
  const auto node = get_node();
  const CallbackReturn result = Loop::on_configure(state);
  if (result != CallbackReturn::SUCCESS) {
    return result;
  }
  try {
    reference_timeout_ = within(
      "reference_timeout", number(node->get_parameter("reference_timeout")), 0.0, UNLIMITED);
  } catch (const std::exception & error) {
    RCLCPP_ERROR(node->get_logger(), "%s", error.what());
    return CallbackReturn::FAILURE;
  }
  for (const std::string & joint : joints_) {
    if (number(node->get_parameter("gains." + joint + ".p")) == 0.0) {
      RCLCPP_WARN(
        node->get_logger(), "gains.%s.p is 0: the joint's weight is carried, its position is not held",
        joint.c_str());
    }
  }
  subscription_ = node->create_subscription<PointMessage>(
    "~/joint_references", rclcpp::SystemDefaultsQoS(),
    [this](const PointMessage::SharedPtr message) {
      const auto & m = *message;
      if (m.positions.size() != JOINTS || m.velocities.size() != JOINTS ||
      m.accelerations.size() != JOINTS)
      {
        RCLCPP_ERROR_THROTTLE(
          get_node()->get_logger(), *get_node()->get_clock(), 1000,
          "joint_references: expected %zu positions, velocities and accelerations", JOINTS);
        return;
      }
      Motion received;
      std::copy(m.positions.begin(), m.positions.end(), received.position.begin());
      std::copy(m.velocities.begin(), m.velocities.end(), received.velocity.begin());
      std::copy(m.accelerations.begin(), m.accelerations.end(), received.acceleration.begin());
      received_.write(received);
    });
  return CallbackReturn::SUCCESS;
}

std::vector<hardware_interface::CommandInterface::SharedPtr>
FeedforwardController::on_export_reference_interfaces_list()
{
  std::vector<hardware_interface::CommandInterface::SharedPtr> result;
  for (const char * kind : KINDS) {
    for (const std::string & joint : joints_) {
      result.push_back(
        std::make_shared<hardware_interface::CommandInterface>(
          std::string(get_node()->get_name()) + "/" + joint, kind));
    }
  }
  return result;
}

CallbackReturn FeedforwardController::on_activate(const rclcpp_lifecycle::State & state)
{
  constexpr double UNKNOWN = std::numeric_limits<double>::quiet_NaN();
  // A reference of before the activation is not followed.
  (void)received_.read(taken_);
  following_ = false;
  timeouts_ = 0;
  reference_age_ = 0.0;
  for (Vector * values : {&reference_.position, &reference_.velocity, &reference_.acceleration}) {
    values->fill(UNKNOWN);
  }
  for (const auto & interface : ordered_exported_reference_interfaces_) {
    (void)interface->set_value(UNKNOWN);
  }
  return Loop::on_activate(state);
}

return_type FeedforwardController::update_reference_from_subscribers(
  const rclcpp::Time &, const rclcpp::Duration & period)
{
  if (received_.take(reference_, taken_)) {
    reference_age_ = 0.0;
    following_ = true;
    return return_type::OK;
  }
  reference_age_ += period.seconds();
  if (following_ && reference_age_ > reference_timeout_) {
    following_ = false;
    ++timeouts_;
  }
  return return_type::OK;
}

void FeedforwardController::read_reference()
{
  bool some = false;
  const auto take = [&](std::size_t kind, Vector & values) {
      for (std::size_t i = 0; i < JOINTS; ++i) {
        const auto value =
          ordered_exported_reference_interfaces_[kind * JOINTS + i]->get_optional();
        values[i] = value.value_or(std::numeric_limits<double>::quiet_NaN());
        some = some || !std::isnan(values[i]);
      }
    };
  take(0, reference_.position);
  take(1, reference_.velocity);
  take(2, reference_.acceleration);
  // The controller in front may write nothing at first.
  following_ = following_ || some;
}

return_type FeedforwardController::update_and_write_commands(
  const rclcpp::Time & time, const rclcpp::Duration & period)
{
  if (is_in_chained_mode()) {
    read_reference();
  }
  measure();
  return follow(following_ ? &reference_ : nullptr, time, period);
}

/// Controller to fall back to: the effort that bears the weight at the measured position, and
/// damping. It follows nothing and holds no position.
class GravityController : public Loop<controller_interface::ControllerInterface>
{
public:
  GravityController()
  : Loop(Role::CARRIES, "gravity", MEASURED) {}

  return_type update(const rclcpp::Time & time, const rclcpp::Duration & period) override
  {
    measure();
    const Motion here{position_, {}, {}};
    return follow(&here, time, period);
  }
};
}  // namespace @PACKAGE@

PLUGINLIB_EXPORT_CLASS(
  @PACKAGE@::FeedforwardController, controller_interface::ChainableControllerInterface)
PLUGINLIB_EXPORT_CLASS(@PACKAGE@::GravityController, controller_interface::ControllerInterface)
