// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#ifndef @GUARD@__LOOP_HPP_
#define @GUARD@__LOOP_HPP_

#include <algorithm>
#include <array>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "control_msgs/msg/joint_trajectory_controller_state.hpp"
#include "controller_interface/controller_interface_base.hpp"
#include "diagnostic_msgs/msg/diagnostic_array.hpp"
#include "hardware_interface/types/hardware_interface_type_values.hpp"
#include "rclcpp/rclcpp.hpp"
#include "realtime_tools/realtime_publisher.hpp"
#include "trajectory_msgs/msg/joint_trajectory_point.hpp"

#include "@PACKAGE@/carried.hpp"
#include "@PACKAGE@/feedforward.hpp"
#include "@PACKAGE@/parameters.hpp"

namespace @PACKAGE@
{
using controller_interface::CallbackReturn;
using controller_interface::InterfaceConfiguration;
using controller_interface::interface_configuration_type;
using controller_interface::return_type;
using diagnostic_msgs::msg::DiagnosticArray;
using diagnostic_msgs::msg::DiagnosticStatus;
using StateMessage = control_msgs::msg::JointTrajectoryControllerState;
using PointMessage = trajectory_msgs::msg::JointTrajectoryPoint;

/// For people: why an update is rejected, in the order of Rejection; then what a good one does.
using Reasons = std::array<const char *, REJECTIONS + 1>;

/// Of the measured position, at the start of each controller and in the gravity controller.
constexpr Reasons MEASURED{
  "the measured position is not finite",
  "the measured position is beyond a limit",
  "the machine cannot be assembled at the measured position",
  "the measured position is too close to a singularity",
  "a measured velocity is not finite, so the joint is not damped",
  "carrying the weight",
};

constexpr std::array<const char *, 3> KINDS{
  hardware_interface::HW_IF_POSITION, hardware_interface::HW_IF_VELOCITY,
  hardware_interface::HW_IF_ACCELERATION};

/// Longest pause, s, between the commands of two controllers of which one takes over from the other:
/// a manager does that within one update, of 10 Hz or more.
constexpr double LONGEST_TAKEOVER = 0.1;

/// How often, s, parameters that are common to the controllers of a machine are brought up to date.
constexpr double COMMON_PERIOD = 0.2;

/// What the controllers of the package share: parameters, interfaces, state and diagnostics.
/// Base: controller_interface::ControllerInterface or its chainable form.
template<class Base>
class Loop : public Base
{
public:
  InterfaceConfiguration command_interface_configuration() const override
  {
    return {interface_configuration_type::INDIVIDUAL, names({hardware_interface::HW_IF_EFFORT})};
  }

  InterfaceConfiguration state_interface_configuration() const override
  {
    return {interface_configuration_type::INDIVIDUAL, names({KINDS[0], KINDS[1]})};
  }

  CallbackReturn on_init() override
  {
    const std::shared_ptr<Node> node = this->get_node();
    try {
      joints_ = declare_parameters(*node, role_);
      check_names(*node, joints_);
      join_others();
      settings_.write(read_settings(*node, joints_, {}));
    } catch (const std::exception & error) {
      RCLCPP_ERROR(node->get_logger(), "%s", error.what());
      return CallbackReturn::ERROR;
    }
    follow_parameters();
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_configure(const rclcpp_lifecycle::State &) override
  {
    const std::shared_ptr<Node> node = this->get_node();
    try {
      state_period_ = 1.0 / within(
        "state_publish_rate", number(node->get_parameter("state_publish_rate")), 0.0, UNLIMITED);
    } catch (const std::exception & error) {
      RCLCPP_ERROR(node->get_logger(), "%s", error.what());
      return CallbackReturn::FAILURE;
    }
    make_publishers();
    return CallbackReturn::SUCCESS;
  }

  /// Where there is nothing to start from, the controller stays inactive, to be activated later.
  CallbackReturn on_activate(const rclcpp_lifecycle::State &) override
  {
    const auto logger = this->get_node()->get_logger();
    const auto states = names({KINDS[0], KINDS[1]});
    const auto commands = names({hardware_interface::HW_IF_EFFORT});
    bool complete = this->state_interfaces_.size() == states.size() &&
      this->command_interfaces_.size() == commands.size();
    for (std::size_t i = 0; complete && i < states.size(); ++i) {
      complete = this->state_interfaces_[i].get_name() == states[i] &&
        (i >= JOINTS || this->command_interfaces_[i].get_name() == commands[i]);
    }
    if (!complete) {
      RCLCPP_ERROR(logger, "expected an effort command, a position and a velocity of each joint");
      return CallbackReturn::ERROR;
    }
    const Settings settings = settings_.read(settings_number_);
    const Load load = carried_->load().read(load_number_);
    unwritten_ = last_bad_ = 0;
    state_age_ = counters_age_ = 0.0;
    measure();
    const Rejection verdict = feedforward_.start(settings, load, position_);
    if (verdict != REJECTIONS) {
      const std::string reason = explain(verdict, MEASURED);
      std::uint64_t number = 0;
      const Held held = carried_->held().read(number);
      const std::chrono::duration<double> pause = std::chrono::steady_clock::now() - held.time;
      if (role_ != Role::CARRIES || number == 0 || pause.count() > LONGEST_TAKEOVER ||
        feedforward_.start(settings, load, held.position) != REJECTIONS)
      {
        RCLCPP_ERROR(logger, "not activated: %s", reason.c_str());
        return CallbackReturn::FAILURE;
      }
      RCLCPP_ERROR(logger, "%s: the last valid position counts for hold_time", reason.c_str());
    }
    if (role_ == Role::CARRIES) {
      RCLCPP_WARN(
        logger, "carrying the machine with a payload of %s kg",
        carried_->values().at("payload.mass").value_to_string().c_str());
    }
    // From here on the machine is carried: the brakes may open before the first update.
    return command() ? CallbackReturn::SUCCESS : CallbackReturn::ERROR;
  }

  CallbackReturn on_deactivate(const rclcpp_lifecycle::State &) override
  {
    for (auto & interface : this->command_interfaces_) {
      (void)interface.set_value(0.0);
    }
    return CallbackReturn::SUCCESS;
  }

protected:
  Loop(Role role, const char * name, const Reasons & reasons)
  : role_(role), name_(name), reasons_(reasons) {}

  /// Full names of interfaces, all joints of the first kind first.
  std::vector<std::string> names(const std::vector<std::string> & kinds) const
  {
    std::vector<std::string> result;
    for (const std::string & kind : kinds) {
      for (const std::string & joint : joints_) {
        result.push_back(joint + "/" + kind);
      }
    }
    return result;
  }

  // In the control loop: nothing below allocates.

  /// One period: efforts for a reference, or to hold without one. The state is measured before.
  return_type follow(
    const Motion * reference, const rclcpp::Time & time, const rclcpp::Duration & period)
  {
    Settings settings;
    if (settings_.take(settings, settings_number_)) {
      feedforward_.change(settings);
    }
    Load load;
    if (carried_->load().take(load, load_number_)) {
      feedforward_.change(load);
    }
    const bool sound = feedforward_.update(reference, position_, velocity_, period.seconds());
    if (!command()) {
      ++unwritten_;
    }
    carried_->held().offer({feedforward_.target().position, std::chrono::steady_clock::now()});
    const double elapsed = period.seconds();
    state_age_ += elapsed;
    // The nearest update: periods of the loop vary, and a rate may be that of the loop.
    if (state_age_ >= state_period_ - 0.5 * elapsed && publish_state(time)) {
      state_age_ = std::fmin(state_age_ - state_period_, 0.5 * elapsed);
    }
    counters_age_ += elapsed;
    if (counters_age_ >= 1.0 || !sound) {
      publish_counters(time, reference != nullptr);
    }
    if (!sound) {
      RCLCPP_ERROR(
        this->get_node()->get_logger(), "rejected for longer than hold_time: %s",
        explain(feedforward_.verdict(), reasons_).c_str());
    }
    return sound ? return_type::OK : return_type::ERROR;
  }

  void measure()
  {
    constexpr double UNKNOWN = std::numeric_limits<double>::quiet_NaN();
    for (std::size_t i = 0; i < JOINTS; ++i) {
      position_[i] = this->state_interfaces_[i].get_optional().value_or(UNKNOWN);
      velocity_[i] = this->state_interfaces_[JOINTS + i].get_optional().value_or(UNKNOWN);
    }
  }

  std::vector<std::string> joints_;
  Vector position_{}, velocity_{};
  std::uint64_t timeouts_ = 0;

private:
  bool command()
  {
    bool written = true;
    for (std::size_t i = 0; i < JOINTS; ++i) {
      written = this->command_interfaces_[i].set_value(feedforward_.effort()[i]) && written;
    }
    return written;
  }

  bool publish_state(const rclcpp::Time & time)
  {
    if (!state_publisher_->trylock()) {
      return false;
    }
    StateMessage & state = state_publisher_->msg_;
    const Motion & target = feedforward_.target();
    state.header.stamp = time;
    for (std::size_t i = 0; i < JOINTS; ++i) {
      state.reference.positions[i] = target.position[i];
      state.reference.velocities[i] = target.velocity[i];
      state.reference.accelerations[i] = target.acceleration[i];
      state.reference.effort[i] = feedforward_.feedforward()[i];
      state.feedback.positions[i] = position_[i];
      state.feedback.velocities[i] = velocity_[i];
      state.error.positions[i] = target.position[i] - position_[i];
      state.error.velocities[i] = target.velocity[i] - velocity_[i];
      state.output.effort[i] = feedforward_.effort()[i];
    }
    state_publisher_->unlockAndPublish();
    return true;
  }

  void publish_counters(const rclcpp::Time & time, bool following)
  {
    if (!counters_publisher_->trylock()) {
      return;
    }
    counters_age_ = 0.0;
    const Counters & counters = feedforward_.counters();
    DiagnosticArray & array = counters_publisher_->msg_;
    array.header.stamp = time;
    DiagnosticStatus & status = array.status[0];
    std::size_t at = 0;
    std::uint64_t bad = timeouts_ + unwritten_ + counters.saturated;
    const auto put = [&](std::uint64_t value) {
        std::array<char, 24> text;
        const auto end = std::to_chars(text.data(), text.data() + text.size(), value);
        status.values[at++].value.assign(text.data(), end.ptr);
      };
    put(counters.updates);
    for (const std::uint64_t value : counters.rejected) {
      put(value);
      bad += value;
    }
    put(counters.saturated);
    put(timeouts_);
    put(unwritten_);
    const Rejection verdict = feedforward_.verdict();
    status.message.assign(following || verdict != REJECTIONS ? reasons_[verdict] : "holding");
    status.level = verdict != REJECTIONS ? DiagnosticStatus::ERROR :
      bad != last_bad_ ? DiagnosticStatus::WARN : DiagnosticStatus::OK;
    last_bad_ = bad;
    counters_publisher_->unlockAndPublish();
  }

  // Outside of it.

  /// Why an update or the start is rejected, with the joint and its value.
  std::string explain(Rejection verdict, const Reasons & reasons) const
  {
    const std::size_t i = feedforward_.joint();
    std::string text = (i < JOINTS ? joints_[i] + ": " : "") + reasons[verdict];
    if (verdict == BEYOND_LIMIT) {
      const auto limit = [&](const char * end) {
          return this->get_node()->get_parameter("limits." + joints_[i] + end).value_to_string();
        };
      text += " (" + std::to_string(feedforward_.found()) + ", limits " + limit(".lower") + " to " +
        limit(".upper") + ")";
    } else if (verdict == SINGULAR) {
      text += " (index " + std::to_string(feedforward_.found()) + ")";
    }
    return text;
  }

  /// Take part in what the controllers of the machine have in common.
  void join_others()
  {
    const std::shared_ptr<Node> node = this->get_node();
    const auto & overrides = node->get_node_parameters_interface()->get_parameter_overrides();
    Values own, given;
    for (const std::string & name : node->list_parameters({"payload", "limits"}, 0).names) {
      if (is_common(name)) {
        own[name] = as_double(node->get_parameter(name));
        if (overrides.count(name) > 0) {
          given[name] = own[name];
        }
      }
    }
    carried_ = Carried::find(node->get_namespace(), joints_);
    carried_->join(node->get_name(), own, given);
    timer_ = node->create_wall_timer(
      std::chrono::duration<double>(COMMON_PERIOD), [this] {copy_common_values();});
  }

  /// Show common values that another controller was given as this node's parameters.
  void copy_common_values()
  {
    std::vector<rclcpp::Parameter> changes;
    for (const auto & [name, value] : carried_->values()) {
      if (as_double(this->get_node()->get_parameter(name)) != value) {
        changes.push_back(value);
      }
    }
    if (!changes.empty()) {
      copying_ = true;
      this->get_node()->set_parameters_atomically(changes);
      copying_ = false;
    }
  }

  /// All callbacks for a set of parameters judge it before it takes effect.
  void follow_parameters()
  {
    const std::shared_ptr<Node> node = this->get_node();
    on_set_ = node->add_on_set_parameters_callback(
      [this](const std::vector<rclcpp::Parameter> & changes) {
        rcl_interfaces::msg::SetParametersResult result;
        result.successful = true;
        try {
          for (const rclcpp::Parameter & change : changes) {
            const std::string & name = change.get_name();
            if (name == "joints" || name == "reference_timeout" || name == "state_publish_rate") {
              throw std::invalid_argument(name + ": cannot change after the controller is loaded");
            }
          }
          read_settings(*this->get_node(), joints_, changes);
          read_load(carried_->values(changes), joints_);
        } catch (const std::exception & error) {
          result.successful = false;
          result.reason = error.what();
        }
        return result;
      });
    after_set_ = node->add_post_set_parameters_callback(
      [this](const std::vector<rclcpp::Parameter> & changes) {
        try {
          settings_.write(read_settings(*this->get_node(), joints_, {}));
          if (!copying_) {
            carried_->set(changes);
          }
        } catch (const std::exception & error) {
          RCLCPP_ERROR(this->get_node()->get_logger(), "settings kept: %s", error.what());
        }
      });
  }

  /// Messages in their full size, so that the control loop allocates nothing.
  void make_publishers()
  {
    const std::shared_ptr<Node> node = this->get_node();
    state_publisher_ = std::make_unique<realtime_tools::RealtimePublisher<StateMessage>>(
      node->create_publisher<StateMessage>("~/controller_state", rclcpp::SystemDefaultsQoS()));
    StateMessage & state = state_publisher_->msg_;
    state.joint_names = joints_;
    for (PointMessage * point : {&state.reference, &state.feedback, &state.error, &state.output}) {
      point->positions.resize(JOINTS);
      point->velocities.resize(JOINTS);
    }
    state.output.positions.clear();
    state.output.velocities.clear();
    state.reference.accelerations.resize(JOINTS);
    state.reference.effort.resize(JOINTS);
    state.output.effort.resize(JOINTS);

    counters_publisher_ = std::make_unique<realtime_tools::RealtimePublisher<DiagnosticArray>>(
      node->create_publisher<DiagnosticArray>("/diagnostics", rclcpp::SystemDefaultsQoS()));
    DiagnosticStatus status;
    status.name = std::string(node->get_fully_qualified_name()) + ": " + name_;
    status.hardware_id = "@ROBOT@";
    status.message.reserve(64);
    for (const char * key :
      {"updates", "rejected: not finite", "rejected: beyond a limit", "rejected: no assembly",
        "rejected: singular", "rejected: no state", "saturated", "reference timeouts",
        "commands not written"})
    {
      diagnostic_msgs::msg::KeyValue value;
      value.key = key;
      value.value.reserve(24);
      status.values.push_back(value);
    }
    counters_publisher_->msg_.status.push_back(std::move(status));
  }

  const Role role_;
  const std::string name_;
  const Reasons & reasons_;
  double state_period_ = 0.02;
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr on_set_;
  rclcpp::node_interfaces::PostSetParametersCallbackHandle::SharedPtr after_set_;
  rclcpp::TimerBase::SharedPtr timer_;
  std::shared_ptr<Carried> carried_;
  bool copying_ = false;
  Mailbox<Settings> settings_;
  std::uint64_t settings_number_ = 0, load_number_ = 0;
  std::unique_ptr<realtime_tools::RealtimePublisher<StateMessage>> state_publisher_;
  std::unique_ptr<realtime_tools::RealtimePublisher<DiagnosticArray>> counters_publisher_;

  Feedforward feedforward_;
  double state_age_ = 0.0, counters_age_ = 0.0;
  std::uint64_t unwritten_ = 0, last_bad_ = 0;
};
}  // namespace @PACKAGE@

#endif  // @GUARD@__LOOP_HPP_
