// SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "control_msgs/msg/joint_trajectory_controller_state.hpp"
#include "controller_interface/chainable_controller_interface.hpp"
#include "diagnostic_msgs/msg/diagnostic_array.hpp"
#include "hardware_interface/types/hardware_interface_type_values.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/rclcpp.hpp"
#include "realtime_tools/realtime_buffer.hpp"
#include "realtime_tools/realtime_publisher.hpp"
#include "trajectory_msgs/msg/joint_trajectory_point.hpp"

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

constexpr std::array<const char *, REJECTIONS + 1> REASONS{
  "the reference is not finite",
  "the reference is beyond a position limit",
  "the machine cannot be assembled at the reference",
  "the reference is too close to a singularity",
  "a measured state is not finite",
  "following",
};
constexpr std::array<const char *, 3> KINDS{
  hardware_interface::HW_IF_POSITION, hardware_interface::HW_IF_VELOCITY,
  hardware_interface::HW_IF_ACCELERATION};

/// Settings as the control loop takes them, with a number that changes with them.
struct Revision
{
  Settings settings;
  std::uint64_t number = 0;
};

/// A reference from the topic.
struct Received
{
  Motion motion;
  std::uint64_t number = 0;
};

/// Chainable controller: inverse dynamics at the reference plus PD.
class FeedforwardController : public controller_interface::ChainableControllerInterface
{
public:
  CallbackReturn on_init() override;
  CallbackReturn on_configure(const rclcpp_lifecycle::State &) override;
  CallbackReturn on_activate(const rclcpp_lifecycle::State &) override;
  CallbackReturn on_deactivate(const rclcpp_lifecycle::State &) override;

  InterfaceConfiguration command_interface_configuration() const override
  {
    return {interface_configuration_type::INDIVIDUAL, names({hardware_interface::HW_IF_EFFORT})};
  }

  InterfaceConfiguration state_interface_configuration() const override
  {
    return {interface_configuration_type::INDIVIDUAL, names({KINDS[0], KINDS[1]})};
  }

protected:
  std::vector<hardware_interface::CommandInterface::SharedPtr> on_export_reference_interfaces_list()
  override;
  return_type update_reference_from_subscribers(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;
  return_type update_and_write_commands(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;

private:
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
  void measure();
  void read_reference();
  bool command();
  void publish_state(const rclcpp::Time & time);
  void publish_counters(const rclcpp::Time & time);

  std::vector<std::string> joints_;
  double reference_timeout_ = 0.1, state_period_ = 0.02;
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr on_set_;
  realtime_tools::RealtimeBuffer<Revision> settings_;
  std::uint64_t revision_ = 0;
  realtime_tools::RealtimeBuffer<Received> received_;
  std::uint64_t taken_ = 0;
  rclcpp::Subscription<PointMessage>::SharedPtr subscription_;
  std::unique_ptr<realtime_tools::RealtimePublisher<StateMessage>> state_publisher_;
  std::unique_ptr<realtime_tools::RealtimePublisher<DiagnosticArray>> counters_publisher_;

  Feedforward feedforward_;
  Motion reference_;
  Vector position_{}, velocity_{};
  bool following_ = false;
  double reference_age_ = 0.0, state_age_ = 0.0, counters_age_ = 0.0;
  std::uint64_t timeouts_ = 0, unwritten_ = 0, last_bad_ = 0;
};

namespace
{
void fill(Motion & motion, double value)
{
  motion.position.fill(value);
  motion.velocity.fill(value);
  motion.acceleration.fill(value);
}
}  // namespace

CallbackReturn FeedforwardController::on_init()
{
  try {
    joints_ = declare_parameters(*get_node());
  } catch (const std::exception & error) {
    RCLCPP_ERROR(get_node()->get_logger(), "%s", error.what());
    return CallbackReturn::ERROR;
  }
  return CallbackReturn::SUCCESS;
}

CallbackReturn FeedforwardController::on_configure(const rclcpp_lifecycle::State &)
{
  const auto node = get_node();
  Revision first;
  try {
    joints_ = declare_parameters(*node);
    check_names(*node, joints_);
    first.settings = read_settings(*node, joints_, {});
    reference_timeout_ = within(
      "reference_timeout", number(node->get_parameter("reference_timeout")), 0.0, UNLIMITED);
    state_period_ = 1.0 / within(
      "state_publish_rate", number(node->get_parameter("state_publish_rate")), 0.0, UNLIMITED);
  } catch (const std::exception & error) {
    RCLCPP_ERROR(node->get_logger(), "%s", error.what());
    return CallbackReturn::FAILURE;
  }
  first.number = settings_.readFromNonRT()->number + 1;
  settings_.writeFromNonRT(first);
  for (std::size_t i = 0; i < JOINTS; ++i) {
    if (first.settings.p[i] == 0.0) {
      RCLCPP_WARN(
        node->get_logger(), "gains.%s.p is 0: the joint's weight is carried, its position is not held",
        joints_[i].c_str());
    }
  }
  on_set_ = node->add_on_set_parameters_callback(
    [this](const std::vector<rclcpp::Parameter> & changes) {
      rcl_interfaces::msg::SetParametersResult result;
      result.successful = true;
      try {
        for (const rclcpp::Parameter & change : changes) {
          const std::string & name = change.get_name();
          if (name == "joints" || name == "reference_timeout" || name == "state_publish_rate") {
            throw std::invalid_argument(name + ": cannot change after the configuration");
          }
        }
        Revision next{
          read_settings(*get_node(), joints_, changes), settings_.readFromNonRT()->number + 1};
        settings_.writeFromNonRT(next);
      } catch (const std::exception & error) {
        result.successful = false;
        result.reason = error.what();
      }
      return result;
    });

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
      Received received;
      received.number = received_.readFromNonRT()->number + 1;
      std::copy(m.positions.begin(), m.positions.end(), received.motion.position.begin());
      std::copy(m.velocities.begin(), m.velocities.end(), received.motion.velocity.begin());
      std::copy(
        m.accelerations.begin(), m.accelerations.end(), received.motion.acceleration.begin());
      received_.writeFromNonRT(received);
    });

  // Messages in their full size, so that the control loop allocates nothing.
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
  status.name = std::string(node->get_fully_qualified_name()) + ": feedforward";
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

CallbackReturn FeedforwardController::on_activate(const rclcpp_lifecycle::State &)
{
  const auto logger = get_node()->get_logger();
  const auto states = names({KINDS[0], KINDS[1]});
  const auto commands = names({hardware_interface::HW_IF_EFFORT});
  bool complete = state_interfaces_.size() == states.size() &&
    command_interfaces_.size() == commands.size();
  for (std::size_t i = 0; complete && i < states.size(); ++i) {
    complete = state_interfaces_[i].get_name() == states[i] &&
      (i >= JOINTS || command_interfaces_[i].get_name() == commands[i]);
  }
  if (!complete) {
    RCLCPP_ERROR(logger, "expected an effort command, a position and a velocity of each joint");
    return CallbackReturn::ERROR;
  }
  const Revision & revision = *settings_.readFromNonRT();
  revision_ = revision.number;
  taken_ = received_.readFromNonRT()->number;
  following_ = false;
  timeouts_ = unwritten_ = last_bad_ = 0;
  reference_age_ = state_age_ = counters_age_ = 0.0;
  fill(reference_, std::numeric_limits<double>::quiet_NaN());
  for (const auto & interface : ordered_exported_reference_interfaces_) {
    (void)interface->set_value(std::numeric_limits<double>::quiet_NaN());
  }
  measure();
  const Rejection verdict = feedforward_.start(revision.settings, position_);
  if (verdict != REJECTIONS) {
    RCLCPP_ERROR(
      logger, "not activated: %s, where the reference is the measured position", REASONS[verdict]);
    return CallbackReturn::ERROR;
  }
  // From here on the machine is carried: the brakes may open before the first update.
  return command() ? CallbackReturn::SUCCESS : CallbackReturn::ERROR;
}

CallbackReturn FeedforwardController::on_deactivate(const rclcpp_lifecycle::State &)
{
  for (auto & interface : command_interfaces_) {
    (void)interface.set_value(0.0);
  }
  return CallbackReturn::SUCCESS;
}

void FeedforwardController::measure()
{
  constexpr double UNKNOWN = std::numeric_limits<double>::quiet_NaN();
  for (std::size_t i = 0; i < JOINTS; ++i) {
    position_[i] = state_interfaces_[i].get_optional().value_or(UNKNOWN);
    velocity_[i] = state_interfaces_[JOINTS + i].get_optional().value_or(UNKNOWN);
  }
}

bool FeedforwardController::command()
{
  bool written = true;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    written = command_interfaces_[i].set_value(feedforward_.effort()[i]) && written;
  }
  return written;
}

return_type FeedforwardController::update_reference_from_subscribers(
  const rclcpp::Time &, const rclcpp::Duration & period)
{
  const Received & received = *received_.readFromRT();
  if (received.number != taken_) {
    taken_ = received.number;
    reference_ = received.motion;
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
  const Revision & revision = *settings_.readFromRT();
  if (revision.number != revision_) {
    revision_ = revision.number;
    feedforward_.change(revision.settings);
  }
  if (is_in_chained_mode()) {
    read_reference();
  }
  measure();
  const bool sound = feedforward_.update(
    following_ ? &reference_ : nullptr, position_, velocity_, period.seconds());
  if (!command()) {
    ++unwritten_;
  }
  state_age_ += period.seconds();
  if (state_age_ >= state_period_) {
    publish_state(time);
  }
  counters_age_ += period.seconds();
  if (counters_age_ >= 1.0 || !sound) {
    publish_counters(time);
  }
  return sound ? return_type::OK : return_type::ERROR;
}

void FeedforwardController::publish_state(const rclcpp::Time & time)
{
  if (!state_publisher_->trylock()) {
    return;
  }
  state_age_ = 0.0;
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
}

void FeedforwardController::publish_counters(const rclcpp::Time & time)
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
  status.message.assign(following_ || verdict != REJECTIONS ? REASONS[verdict] : "holding");
  status.level = verdict != REJECTIONS ? DiagnosticStatus::ERROR :
    bad != last_bad_ ? DiagnosticStatus::WARN : DiagnosticStatus::OK;
  last_bad_ = bad;
  counters_publisher_->unlockAndPublish();
}
}  // namespace @PACKAGE@

PLUGINLIB_EXPORT_CLASS(
  @PACKAGE@::FeedforwardController, controller_interface::ChainableControllerInterface)
