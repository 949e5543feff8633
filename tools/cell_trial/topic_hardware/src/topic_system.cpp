// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
/// Hardware over topics: efforts to machine_sim, its joint states back. For trials: not real-time.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "hardware_interface/system_interface.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/rclcpp.hpp"
#include "sensor_msgs/msg/joint_state.hpp"
#include "std_msgs/msg/float64_multi_array.hpp"

namespace pkm_topic_hardware
{
using hardware_interface::CallbackReturn;
using hardware_interface::return_type;
using sensor_msgs::msg::JointState;
using std_msgs::msg::Float64MultiArray;
using Clock = std::chrono::steady_clock;

/// A joint state that is older than this, s, ends the hardware: the machine may be anywhere.
constexpr std::chrono::duration<double> LARGEST_AGE{1.0};

class TopicSystem : public hardware_interface::SystemInterface
{
public:
  ~TopicSystem() override
  {
    executor_.cancel();
    if (thread_.joinable()) {
      thread_.join();
    }
  }

  CallbackReturn on_configure(const rclcpp_lifecycle::State &) override
  {
    node_ = std::make_shared<rclcpp::Node>("topic_system");
    // What the trial makes NaN at the first joint: position or velocity.
    node_->declare_parameter("lost", "");
    commands_ = node_->create_publisher<Float64MultiArray>("/machine_sim/commands", 10);
    states_ = node_->create_subscription<JointState>(
      "/machine_sim/joint_states", 10, [this](const JointState::SharedPtr message) {
        const std::lock_guard<std::mutex> guard(mutex_);
        last_ = message;
        received_ = Clock::now();
      });
    executor_.add_node(node_);
    thread_ = std::thread([this] {executor_.spin();});
    return CallbackReturn::SUCCESS;
  }

  /// A machine without states is none.
  CallbackReturn on_activate(const rclcpp_lifecycle::State &) override
  {
    for (int k = 0; k < 600 && !taken(); ++k) {
      std::this_thread::sleep_for(std::chrono::milliseconds(100));
    }
    return taken() ? CallbackReturn::SUCCESS : CallbackReturn::ERROR;
  }

  return_type read(const rclcpp::Time &, const rclcpp::Duration &) override
  {
    const auto message = taken();
    if (!message) {
      return return_type::OK;
    }
    const std::chrono::duration<double> age = Clock::now() - received();
    if (age > LARGEST_AGE) {
      RCLCPP_ERROR(node_->get_logger(), "the last joint state is %.3f s old", age.count());
      return return_type::ERROR;
    }
    for (const auto & joint : info_.joints) {
      const auto found = std::find(message->name.begin(), message->name.end(), joint.name);
      if (found == message->name.end()) {
        return return_type::ERROR;
      }
      const auto k = static_cast<std::size_t>(found - message->name.begin());
      set_state(joint.name + "/position", message->position.at(k));
      set_state(joint.name + "/velocity", message->velocity.at(k));
      set_state(joint.name + "/effort", message->effort.at(k));
    }
    const std::string lost = node_->get_parameter("lost").as_string();
    if (!lost.empty()) {
      set_state(info_.joints[0].name + "/" + lost, std::numeric_limits<double>::quiet_NaN());
    }
    return return_type::OK;
  }

  return_type write(const rclcpp::Time &, const rclcpp::Duration &) override
  {
    Float64MultiArray message;
    for (const auto & joint : info_.joints) {
      message.data.push_back(get_command(joint.name + "/effort"));
    }
    // Before a controller commands, there is nothing to send.
    if (std::none_of(
        message.data.begin(), message.data.end(), [](double x) {return std::isnan(x);}))
    {
      commands_->publish(message);
    }
    return return_type::OK;
  }

private:
  JointState::SharedPtr taken()
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    return last_;
  }

  Clock::time_point received()
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    return received_;
  }

  rclcpp::Node::SharedPtr node_;
  rclcpp::executors::SingleThreadedExecutor executor_;
  std::thread thread_;
  rclcpp::Publisher<Float64MultiArray>::SharedPtr commands_;
  rclcpp::Subscription<JointState>::SharedPtr states_;
  std::mutex mutex_;
  JointState::SharedPtr last_;
  Clock::time_point received_;
};
}  // namespace pkm_topic_hardware

PLUGINLIB_EXPORT_CLASS(pkm_topic_hardware::TopicSystem, hardware_interface::SystemInterface)
