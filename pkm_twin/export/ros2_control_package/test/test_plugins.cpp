// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#include <gtest/gtest.h>

#include <chrono>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#ifdef HAS_KINEMATICS_INTERFACE
#include "kinematics_interface/kinematics_interface.hpp"
#endif
#ifdef HAS_INVERSE_DYNAMICS_SOLVER
#if __has_include("inverse_dynamics_solver/inverse_dynamics_solver.hpp")
#include "inverse_dynamics_solver/inverse_dynamics_solver.hpp"
#else
#include "inverse_dynamics_solver/inverse_dynamics_solver.h"
#endif
#endif

#include "trajectory_msgs/msg/joint_trajectory_point.hpp"

#include "@PACKAGE@/bench.hpp"
#include "@PACKAGE@/feedforward.hpp"

using namespace @PACKAGE@;  // NOLINT

namespace
{
constexpr double NaN = std::numeric_limits<double>::quiet_NaN();
constexpr double CLOSE = 1e-9;

/// Motions around the start.
Motion motion(int sample)
{
  Motion result;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    const double phase = 0.7 * sample + static_cast<double>(i);
    result.position[i] = START[i] + RANGE[i] * std::sin(phase);
    result.velocity[i] = 3.0 * RANGE[i] * std::cos(phase);
    result.acceleration[i] = -9.0 * RANGE[i] * std::sin(2.0 * phase);
  }
  EXPECT_EQ(make_agree(result.position, result.velocity, result.acceleration), 0);
  return result;
}

Parameters own_parameters()
{
  Parameters result;
  EXPECT_EQ(payload_parameters(PAYLOAD.mass, PAYLOAD.com, PAYLOAD.inertia, result), 0);
  return result;
}

Vector efforts_of(const Motion & m)
{
  Vector tau;
  EXPECT_EQ(efforts(own_parameters(), m.position, m.velocity, m.acceleration, tau), 0);
  return tau;
}

Vector weight_at(const Vector & q) {return efforts_of({q, {}, {}});}

double largest(const Vector & values)
{
  double result = 0.0;
  for (const double value : values) {
    result = std::fmax(result, std::fabs(value));
  }
  return result;
}

void give(Bench & bench, const Motion & m)
{
  for (std::size_t i = 0; i < JOINTS; ++i) {
    bench.reference(i, 0, m.position[i]);
    bench.reference(i, 1, m.velocity[i]);
    bench.reference(i, 2, m.acceleration[i]);
  }
}

void expect_effort(const Bench & bench, const Vector & wanted, double scale)
{
  for (std::size_t i = 0; i < JOINTS; ++i) {
    const double limit = DRIVES[i].effort;
    EXPECT_NEAR(
      bench.effort(i), std::fmax(-limit, std::fmin(limit, wanted[i])), CLOSE * (1e-3 + scale));
  }
}

class Plugins : public ::testing::Test
{
protected:
  static void SetUpTestSuite() {rclcpp::init(0, nullptr);}
  static void TearDownTestSuite() {rclcpp::shutdown();}
};
}  // namespace

TEST_F(Plugins, effort_is_inverse_dynamics_at_the_reference)
{
  Bench bench;
  ASSERT_TRUE(bench.activate(true));
  expect_effort(bench, weight_at(START), largest(weight_at(START)));
  for (int k = 0; k < 20; ++k) {
    give(bench, motion(k));
    ASSERT_TRUE(bench.update(1e-3 * k, 1e-3));
    const Vector wanted = efforts_of(motion(k));
    expect_effort(bench, wanted, largest(wanted));
  }
}

TEST_F(Plugins, without_a_reference_the_start_is_held)
{
  Bench bench;
  ASSERT_TRUE(bench.activate(true));
  for (int k = 0; k < 2000; ++k) {
    ASSERT_TRUE(bench.update(1e-3 * k, 1e-3));
  }
  expect_effort(bench, weight_at(START), largest(weight_at(START)));
}

TEST_F(Plugins, gains_act_on_the_error)
{
  // Whole numbers are numbers.
  const int p = 2;
  const double d = 0.5, size = 1e-3;
  std::vector<rclcpp::Parameter> gains;
  for (const Drive & drive : DRIVES) {
    const std::string name = std::string("gains.") + drive.name;
    gains.emplace_back(name + ".p", p);
    gains.emplace_back(name + ".d", d);
  }
  Bench bench(gains);
  ASSERT_TRUE(bench.activate(true));
  const Motion m = motion(1);
  give(bench, m);
  Vector wanted = efforts_of(m);
  for (std::size_t i = 0; i < JOINTS; ++i) {
    const double miss = size * static_cast<double>(1 + i);
    bench.measure(i, m.position[i] - miss, m.velocity[i] + 2.0 * miss);
    wanted[i] += p * miss - d * 2.0 * miss;
  }
  ASSERT_TRUE(bench.update(0.0, 1e-3));
  expect_effort(bench, wanted, largest(wanted));
  // A state that is not known leaves the feedforward.
  bench.measure(0, NaN, 0.0);
  ASSERT_TRUE(bench.update(0.0, 1e-3));
  expect_effort(bench, efforts_of(m), largest(wanted));
}

TEST_F(Plugins, a_rejected_reference_is_bridged_by_holding_and_then_fails)
{
  Bench bench({rclcpp::Parameter("hold_time", 0.1)});
  for (const double bad : {NaN, std::numeric_limits<double>::infinity()}) {
    ASSERT_TRUE(bench.activate(true));
    const Motion m = motion(3);
    give(bench, m);
    ASSERT_TRUE(bench.update(0.0, 1e-3));
    for (std::size_t kind = 0; kind < 3; ++kind) {
      give(bench, m);
      bench.reference(0, kind, bad);
      int good = 0;
      while (good < 200 && bench.update(0.0, 1e-3)) {
        ++good;
        expect_effort(bench, weight_at(m.position), largest(weight_at(m.position)));
      }
      EXPECT_NEAR(good, 100, 1);
      give(bench, m);
      ASSERT_TRUE(bench.update(0.0, 1e-3));
    }
    bench.deactivate();
    for (std::size_t i = 0; i < JOINTS; ++i) {
      EXPECT_EQ(bench.effort(i), 0.0);
    }
  }
}

TEST_F(Plugins, parameters_change_while_it_runs_or_are_rejected)
{
  Bench bench;
  ASSERT_TRUE(bench.activate(true));
  give(bench, motion(2));
  ASSERT_TRUE(bench.update(0.0, 1e-3));
  const auto before = bench.effort(0);
  EXPECT_FALSE(bench.node()->set_parameter({"payload.mass", -1.0}).successful);
  EXPECT_FALSE(bench.node()->set_parameter({"payload.mass", NaN}).successful);
  EXPECT_FALSE(bench.node()->set_parameter({"payload.mass", "heavy"}).successful);
  EXPECT_FALSE(bench.node()->set_parameter({"singularity_stop", 1.5}).successful);
  EXPECT_TRUE(bench.node()->set_parameter({"payload.mass", PAYLOAD.mass + 1.0}).successful);
  ASSERT_TRUE(bench.update(0.0, 1e-3));
  Parameters parameters;
  ASSERT_EQ(payload_parameters(PAYLOAD.mass + 1.0, PAYLOAD.com, PAYLOAD.inertia, parameters), 0);
  Vector wanted;
  const Motion m = motion(2);
  ASSERT_EQ(efforts(parameters, m.position, m.velocity, m.acceleration, wanted), 0);
  expect_effort(bench, wanted, largest(wanted));
  EXPECT_TRUE(bench.node()->set_parameter({"payload.mass", PAYLOAD.mass}).successful);
  ASSERT_TRUE(bench.update(0.0, 1e-3));
  EXPECT_NEAR(bench.effort(0), before, CLOSE * (1e-3 + std::fabs(before)));
}

TEST_F(Plugins, a_payload_that_no_body_has_is_rejected)
{
  Bench bench;
  const auto rejects = [&](const char * name, const auto & value) {
      return !bench.node()->set_parameter({name, value}).successful;
    };
  EXPECT_TRUE(rejects("payload.mass", 1e300));
  EXPECT_TRUE(rejects("payload.com", std::vector<double>{0.0, 1e300, 0.0}));
  for (const double moment : {-1.0, 1e300, NaN}) {
    EXPECT_TRUE(
      rejects("payload.inertia", std::vector<double>{moment, 0, 0, 0, moment, 0, 0, 0, moment}));
  }
  EXPECT_TRUE(rejects("payload.inertia", std::vector<double>{1, 0, 0, 0, 1, 0, 0, 0, 3}));
  EXPECT_TRUE(rejects("payload.inertia", std::vector<double>{1, 0, 0, 0.1, 1, 0, 0, 0, 1}));
  EXPECT_FALSE(rejects("payload.inertia", std::vector<double>{1, 0, 0, 0, 1, 0, 0, 0, 2}));
}

TEST_F(Plugins, a_set_that_another_callback_rejects_has_no_effect)
{
  // Callbacks are asked from the last one added to the first one.
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr kept;
  Bench bench(
    {}, "FeedforwardController", [&](rclcpp_lifecycle::LifecycleNode & node) {
      kept = node.add_on_set_parameters_callback(
        [](const std::vector<rclcpp::Parameter> &) {
          rcl_interfaces::msg::SetParametersResult result;
          result.successful = false;
          return result;
        });
    });
  ASSERT_TRUE(bench.activate(true));
  give(bench, motion(2));
  EXPECT_FALSE(bench.node()->set_parameter({"payload.mass", PAYLOAD.mass + 1.0}).successful);
  ASSERT_TRUE(bench.update(0.0, 1e-3));
  const Vector wanted = efforts_of(motion(2));
  expect_effort(bench, wanted, largest(wanted));
}

TEST_F(Plugins, gravity_is_that_of_the_measured_position_with_damping)
{
  for (const bool damped : {false, true}) {
    const double d = 0.25;
    std::vector<rclcpp::Parameter> gains{{"hold_time", 0.1}};
    for (const Drive & drive : DRIVES) {
      gains.emplace_back(std::string("gains.") + drive.name + ".d", damped ? d : 0.0);
    }
    Bench bench(gains, "GravityController");
    ASSERT_TRUE(bench.activate(false));
    expect_effort(bench, weight_at(START), largest(weight_at(START)));
    Vector wanted;
    for (int k = 0; k < 20; ++k) {
      const Motion m = motion(k);
      const Vector weight = weight_at(m.position);
      for (std::size_t i = 0; i < JOINTS; ++i) {
        bench.measure(i, m.position[i], m.velocity[i]);
        wanted[i] = weight[i] - (damped ? d * m.velocity[i] : 0.0);
      }
      ASSERT_TRUE(bench.update(1e-3 * k, 1e-3));
      expect_effort(bench, wanted, largest(wanted));
    }
    // Without a state the last weight is given for a while.
    for (std::size_t i = 0; i < JOINTS; ++i) {
      bench.measure(i, NaN, NaN);
    }
    const Vector last = weight_at(motion(19).position);
    int good = 0;
    while (good < 200 && bench.update(0.0, 1e-3)) {
      ++good;
      expect_effort(bench, last, largest(last));
    }
    EXPECT_NEAR(good, 100, 1);
    bench.deactivate();
    for (std::size_t i = 0; i < JOINTS; ++i) {
      EXPECT_EQ(bench.effort(i), 0.0);
    }
  }
}

TEST_F(Plugins, payload_and_effort_limits_count_for_both_controllers)
{
  Bench feedforward, gravity({}, "GravityController");
  ASSERT_TRUE(feedforward.activate(true));
  ASSERT_TRUE(gravity.activate(false));
  double mass = PAYLOAD.mass;
  for (Bench * one : {&feedforward, &gravity}) {
    mass += 1.0;
    const double limit = 0.5 * mass * largest(weight_at(START));
    const std::string name = std::string("limits.") + DRIVES[0].name + ".effort";
    ASSERT_TRUE(one->node()->set_parameter({"payload.mass", mass}).successful);
    ASSERT_TRUE(one->node()->set_parameter({name, limit}).successful);
    Parameters parameters;
    ASSERT_EQ(payload_parameters(mass, PAYLOAD.com, PAYLOAD.inertia, parameters), 0);
    Vector wanted;
    ASSERT_EQ(efforts(parameters, START, {}, {}, wanted), 0);
    wanted[0] = std::fmax(-limit, std::fmin(limit, wanted[0]));
    for (Bench * bench : {&feedforward, &gravity}) {
      ASSERT_TRUE(bench->update(0.0, 1e-3));
      expect_effort(*bench, wanted, largest(wanted));
    }
    // The nodes show the same numbers after a while.
    rclcpp::executors::SingleThreadedExecutor executor;
    Bench & other = one == &feedforward ? gravity : feedforward;
    executor.add_node(other.node()->get_node_base_interface());
    for (int k = 0; k < 500 && other.node()->get_parameter("payload.mass").as_double() != mass; ++k) {
      executor.spin_once(std::chrono::milliseconds(20));
    }
    EXPECT_EQ(other.node()->get_parameter("payload.mass").as_double(), mass);
    EXPECT_EQ(other.node()->get_parameter(name).as_double(), limit);
  }
  const rclcpp::Parameter heavy("payload.mass", PAYLOAD.mass + 9.0);
  Bench given({heavy});
  EXPECT_THROW(
    Bench({rclcpp::Parameter("payload.mass", PAYLOAD.mass + 8.0)}, "GravityController"),
    std::runtime_error);
}

TEST_F(Plugins, a_lost_position_is_bridged_from_controller_to_controller)
{
  std::vector<rclcpp::Parameter> parameters{{"hold_time", 0.1}};
  for (const Drive & drive : DRIVES) {
    parameters.emplace_back(std::string("gains.") + drive.name + ".p", 1e-3);
  }
  Bench feedforward(parameters), gravity({{"hold_time", 0.1}}, "GravityController");
  gravity.measure(0, NaN, 0.0);
  // There is nothing to take over from.
  EXPECT_FALSE(gravity.activate(false));
  ASSERT_TRUE(feedforward.activate(true));
  ASSERT_TRUE(feedforward.node()->set_parameter({"payload.mass", PAYLOAD.mass + 1.0}).successful);
  const Vector position = motion(2).position;
  Parameters loaded;
  ASSERT_EQ(payload_parameters(PAYLOAD.mass + 1.0, PAYLOAD.com, PAYLOAD.inertia, loaded), 0);
  Vector wanted;
  ASSERT_EQ(efforts(loaded, position, {}, {}, wanted), 0);
  give(feedforward, {position, {}, {}});
  for (std::size_t i = 0; i < JOINTS; ++i) {
    feedforward.measure(i, position[i], 0.0);
  }
  ASSERT_TRUE(feedforward.update(0.0, 1e-3));
  feedforward.measure(0, NaN, 0.0);
  int bridged = 0;
  while (bridged < 200 && feedforward.update(0.0, 1e-3)) {
    ++bridged;
    expect_effort(feedforward, wanted, largest(wanted));
  }
  EXPECT_NEAR(bridged, 100, 1);
  feedforward.deactivate();
  ASSERT_TRUE(gravity.activate(false));
  expect_effort(gravity, wanted, largest(wanted));
  int carried = 0;
  while (carried < 200 && gravity.update(0.0, 1e-3)) {
    ++carried;
    expect_effort(gravity, wanted, largest(wanted));
  }
  EXPECT_NEAR(carried, 100, 1);
  gravity.deactivate();
  EXPECT_EQ(gravity.effort(0), 0.0);
  // Both are inactive, and active again when the position is.
  for (Bench * bench : {&feedforward, &gravity}) {
    bench->measure(0, position[0], 0.0);
    EXPECT_TRUE(bench->activate(true));
  }
}

TEST_F(Plugins, the_weight_needs_no_velocity)
{
  Bench bench({{"hold_time", 0.01}}, "GravityController");
  ASSERT_TRUE(bench.activate(false));
  bench.measure(0, START[0], NaN);
  for (int k = 0; k < 100; ++k) {
    ASSERT_TRUE(bench.update(0.0, 1e-3));
    expect_effort(bench, weight_at(START), largest(weight_at(START)));
  }
}

TEST_F(Plugins, gravity_is_damped_without_settings)
{
  Bench bench({}, "GravityController");
  ASSERT_TRUE(bench.activate(false));
  const Vector weight = weight_at(START);
  Vector wanted;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    bench.measure(i, START[i], RANGE[i]);
    wanted[i] = weight[i] - DRIVES[i].damping * RANGE[i];
    EXPECT_GT(DRIVES[i].damping, 0.0);
  }
  ASSERT_TRUE(bench.update(0.0, 1e-3));
  expect_effort(bench, wanted, largest(wanted));
}

TEST_F(Plugins, what_cannot_be_assembled_is_not_activated)
{
  Bench bench;
  bench.measure(0, NaN, 0.0);
  EXPECT_FALSE(bench.activate(true));
  bench.measure(0, START[0], 0.0);
  EXPECT_TRUE(bench.activate(true));
}

TEST_F(Plugins, references_from_the_topic_are_held_after_the_timeout)
{
  Bench bench({rclcpp::Parameter("reference_timeout", 0.05)});
  ASSERT_TRUE(bench.activate(false));
  const auto sender = rclcpp::Node::make_shared("sender");
  const auto publisher = sender->create_publisher<trajectory_msgs::msg::JointTrajectoryPoint>(
    "/feedforward_controller/joint_references", 1);
  rclcpp::executors::SingleThreadedExecutor executor;
  executor.add_node(bench.node()->get_node_base_interface());
  const Motion m = motion(4);
  trajectory_msgs::msg::JointTrajectoryPoint point;
  point.positions.assign(m.position.begin(), m.position.end());
  point.velocities.assign(m.velocity.begin(), m.velocity.end());
  point.accelerations.assign(m.acceleration.begin(), m.acceleration.end());
  const Vector wanted = efforts_of(m), weight = weight_at(m.position);
  bool taken = false;
  for (int k = 0; k < 1000 && !taken; ++k) {
    publisher->publish(point);
    executor.spin_once(std::chrono::milliseconds(20));
    ASSERT_TRUE(bench.update(0.0, 1e-6));
    taken = std::fabs(bench.effort(0) - wanted[0]) <= CLOSE * (1e-3 + largest(wanted));
  }
  ASSERT_TRUE(taken);
  expect_effort(bench, wanted, largest(wanted));
  for (int k = 0; k < 100; ++k) {
    ASSERT_TRUE(bench.update(0.0, 1e-3));
  }
  expect_effort(bench, weight, largest(weight));
}

TEST_F(Plugins, a_misspelt_joint_is_rejected)
{
  EXPECT_THROW(Bench({rclcpp::Parameter("gains.no_such_joint.p", 1.0)}), std::runtime_error);
}

#ifdef HAS_KINEMATICS_INTERFACE
TEST_F(Plugins, kinematics_differences_there_and_back)
{
  pluginlib::ClassLoader<kinematics_interface::KinematicsInterface> loader(
    "kinematics_interface", "kinematics_interface::KinematicsInterface");
  const auto plugin = loader.createSharedInstance("@PACKAGE@/Kinematics");
  ASSERT_TRUE(plugin->initialize("", nullptr, ""));
  const auto count = static_cast<Eigen::Index>(JOINTS);
  for (int k = 0; k < 10; ++k) {
    const Motion m = motion(k);
    const Eigen::VectorXd q = Eigen::Map<const Eigen::VectorXd>(m.position.data(), count);
    const Eigen::VectorXd v = Eigen::Map<const Eigen::VectorXd>(m.velocity.data(), count);
    Eigen::Matrix<double, 6, 1> twist;
    Eigen::VectorXd back(count);
    ASSERT_TRUE(plugin->convert_joint_deltas_to_cartesian_deltas(q, v, "platform", twist));
    ASSERT_TRUE(plugin->convert_cartesian_deltas_to_joint_deltas(q, twist, "platform", back));
    EXPECT_LT((back - v).cwiseAbs().maxCoeff(), CLOSE * v.cwiseAbs().maxCoeff());

    // The transform's change is the twist.
    const double step = 1e-6;
    Eigen::Isometry3d ahead, behind, here, base;
    ASSERT_TRUE(plugin->calculate_link_transform(q + step * v, "platform", ahead));
    ASSERT_TRUE(plugin->calculate_link_transform(q - step * v, "platform", behind));
    ASSERT_TRUE(plugin->calculate_link_transform(q, "platform", here));
    const Eigen::Vector3d speed = (ahead.translation() - behind.translation()) / (2.0 * step);
    const Eigen::Matrix3d spin =
      (ahead.linear() - behind.linear()) / (2.0 * step) * here.linear().transpose();
    const Eigen::Vector3d turn(spin(2, 1), spin(0, 2), spin(1, 0));
    const double scale = 1e-6 * (1.0 + twist.cwiseAbs().maxCoeff());
    EXPECT_LT((speed - twist.head<3>()).cwiseAbs().maxCoeff(), scale);
    EXPECT_LT((turn - twist.tail<3>()).cwiseAbs().maxCoeff(), scale);

    ASSERT_TRUE(plugin->calculate_link_transform(q, "base_link", base));
    EXPECT_TRUE(base.isApprox(Eigen::Isometry3d::Identity()));
    EXPECT_FALSE(plugin->calculate_link_transform(q, "elbow", base));
    EXPECT_FALSE(plugin->calculate_link_transform(NaN * q, "platform", base));
  }
}
#endif

#ifdef HAS_INVERSE_DYNAMICS_SOLVER
TEST_F(Plugins, the_solver_s_parts_sum_to_the_effort)
{
  pluginlib::ClassLoader<inverse_dynamics_solver::InverseDynamicsSolver> loader(
    "inverse_dynamics_solver", "inverse_dynamics_solver::InverseDynamicsSolver");
  const auto plugin = loader.createSharedInstance("@PACKAGE@/InverseDynamicsSolver");
  const auto count = static_cast<Eigen::Index>(JOINTS);
  const Eigen::VectorXd zero = Eigen::VectorXd::Zero(count);
  EXPECT_ANY_THROW(plugin->getGravityVector(zero));
  plugin->initialize(nullptr, "", "");
  for (int k = 0; k < 10; ++k) {
    const Motion m = motion(k);
    const Eigen::VectorXd q = Eigen::Map<const Eigen::VectorXd>(m.position.data(), count);
    const Eigen::VectorXd v = Eigen::Map<const Eigen::VectorXd>(m.velocity.data(), count);
    const Eigen::VectorXd a = Eigen::Map<const Eigen::VectorXd>(m.acceleration.data(), count);
    const Vector tau = efforts_of(m);
    const Eigen::VectorXd wanted = Eigen::Map<const Eigen::VectorXd>(tau.data(), count);
    const Eigen::VectorXd parts = plugin->getInertiaMatrix(q) * a +
      plugin->getCoriolisVector(q, v) + plugin->getGravityVector(q) + plugin->getFrictionVector(v);
    const double scale = CLOSE * (1e-3 + wanted.cwiseAbs().maxCoeff());
    EXPECT_LT((parts - wanted).cwiseAbs().maxCoeff(), scale);
    const Eigen::VectorXd whole = plugin->getTorques(q, v, a) + plugin->getFrictionVector(v);
    EXPECT_LT((whole - wanted).cwiseAbs().maxCoeff(), scale);
  }
  EXPECT_ANY_THROW(plugin->getGravityVector(NaN * zero));
  EXPECT_ANY_THROW(plugin->getGravityVector(Eigen::VectorXd::Zero(count + 1)));
}
#endif
