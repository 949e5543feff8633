// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#ifndef @GUARD@__BENCH_HPP_
#define @GUARD@__BENCH_HPP_

#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "controller_interface/chainable_controller_interface.hpp"
#include "controller_interface/controller_interface.hpp"
#include "hardware_interface/loaned_command_interface.hpp"
#include "hardware_interface/loaned_state_interface.hpp"
#include "lifecycle_msgs/msg/state.hpp"
#include "pluginlib/class_loader.hpp"
#include "rclcpp/rclcpp.hpp"

#include "@PACKAGE@/robot.hpp"

namespace @PACKAGE@
{
/// A position where the machine stands well, and how far it may go from there.
constexpr Vector START{@START@};
constexpr Vector RANGE{@RANGE@};

/// A controller plugin between joints and references that the caller sets: what a controller
/// manager does, without one.
///
/// prepare: called before the configuration.
class Bench
{
public:
  using Prepare = std::function<void(rclcpp_lifecycle::LifecycleNode &)>;

  explicit Bench(
    std::vector<rclcpp::Parameter> parameters = {},
    const std::string & name = "FeedforwardController", const Prepare & prepare = {})
  {
    using hardware_interface::CommandInterface;
    using hardware_interface::StateInterface;
    const std::string plugin = "@PACKAGE@/" + name;
    if (chained_.isClassAvailable(plugin)) {
      controller_ = chained_.createSharedInstance(plugin);
    } else {
      controller_ = single_.createSharedInstance(plugin);
    }
    controller_interface::ControllerInterfaceParams params;
    params.controller_name = chained_.isClassAvailable(plugin) ?
      "feedforward_controller" : "gravity_controller";
    params.update_rate = params.controller_manager_update_rate = 1000;
    params.node_options = controller_->define_custom_node_options();
    params.node_options.parameter_overrides() = std::move(parameters);
    if (controller_->init(params) != controller_interface::return_type::OK) {
      throw std::runtime_error("init");
    }
    if (prepare) {
      prepare(*node());
    }
    using State = lifecycle_msgs::msg::State;
    if (controller_->configure().id() != State::PRIMARY_STATE_INACTIVE) {
      throw std::runtime_error("configure");
    }
    if (controller_->is_chainable()) {
      references_ = controller_->export_reference_interfaces();
    }
    std::vector<hardware_interface::LoanedCommandInterface> commands;
    std::vector<hardware_interface::LoanedStateInterface> states;
    for (const char * kind : {"position", "velocity"}) {
      for (const Drive & drive : DRIVES) {
        states_.push_back(std::make_shared<StateInterface>(drive.name, kind));
      }
    }
    for (const Drive & drive : DRIVES) {
      commands_.push_back(std::make_shared<CommandInterface>(drive.name, "effort"));
    }
    for (const auto & state : states_) {
      states.emplace_back(std::const_pointer_cast<const StateInterface>(state));
    }
    for (const auto & command : commands_) {
      commands.emplace_back(command, nullptr);
    }
    for (std::size_t i = 0; i < JOINTS; ++i) {
      measure(i, START[i], 0.0);
    }
    controller_->assign_interfaces(std::move(commands), std::move(states));
  }

  /// True where the controller became active.
  bool activate(bool chained)
  {
    using State = lifecycle_msgs::msg::State;
    return (!controller_->is_chainable() || controller_->set_chained_mode(chained)) &&
           controller_->get_node()->activate().id() == State::PRIMARY_STATE_ACTIVE;
  }
  void deactivate() {controller_->get_node()->deactivate();}

  /// One period; false where the controller reports an error.
  bool update(double time, double period)
  {
    return controller_->update(
      rclcpp::Time(static_cast<int64_t>(1e9 * time), RCL_ROS_TIME),
      rclcpp::Duration::from_seconds(period)) == controller_interface::return_type::OK;
  }

  /// kind: 0 position, 1 velocity, 2 acceleration.
  void reference(std::size_t joint, std::size_t kind, double value)
  {
    (void)references_[kind * JOINTS + joint]->set_value(value);
  }
  void measure(std::size_t joint, double position, double velocity)
  {
    (void)states_[joint]->set_value(position);
    (void)states_[JOINTS + joint]->set_value(velocity);
  }
  double effort(std::size_t joint) const {return commands_[joint]->get_optional().value();}

  rclcpp_lifecycle::LifecycleNode::SharedPtr node() const {return controller_->get_node();}

private:
  pluginlib::ClassLoader<controller_interface::ChainableControllerInterface> chained_{
    "controller_interface", "controller_interface::ChainableControllerInterface"};
  pluginlib::ClassLoader<controller_interface::ControllerInterface> single_{
    "controller_interface", "controller_interface::ControllerInterface"};
  std::shared_ptr<controller_interface::ControllerInterfaceBase> controller_;
  std::vector<hardware_interface::CommandInterface::SharedPtr> references_, commands_;
  std::vector<std::shared_ptr<hardware_interface::StateInterface>> states_;
};
}  // namespace @PACKAGE@

#endif  // @GUARD@__BENCH_HPP_
