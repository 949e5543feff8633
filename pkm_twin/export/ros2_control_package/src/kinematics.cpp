// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#include <cmath>
#include <memory>
#include <string>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <Eigen/LU>

#include "kinematics_interface/kinematics_interface.hpp"
#include "pluginlib/class_list_macros.hpp"

#include "@PACKAGE@/model.hpp"

namespace @PACKAGE@
{
constexpr int COUNT = static_cast<int>(JOINTS), MOBILE = static_cast<int>(FREEDOMS);
constexpr double LEAST_PIVOT = 1e-9;

/// The platform as the end effector of the actuated joints.
///
/// Twists are those of the platform's reference point in base axes. A machine of m
/// freedoms moves in m directions: those that its pose names. Cartesian differences in other directions follow from
/// these and are ignored by the inverse.
class Kinematics : public kinematics_interface::KinematicsInterface
{
public:
  bool initialize(
    const std::string &,
    std::shared_ptr<rclcpp::node_interfaces::NodeParametersInterface> parameters,
    const std::string & space) override
  {
    read(parameters, space, "base", base_);
    read(parameters, space, "tip", tip_);
    return true;
  }

  bool convert_cartesian_deltas_to_joint_deltas(
    const Eigen::VectorXd & joint_pos, const Eigen::Matrix<double, 6, 1> & delta_x,
    const std::string & link_name, Eigen::VectorXd & delta_theta) override
  {
    Inverse inverse;
    if (!invert(joint_pos, link_name, inverse)) {
      return false;
    }
    delta_theta = inverse * delta_x;
    return true;
  }

  bool convert_joint_deltas_to_cartesian_deltas(
    const Eigen::VectorXd & joint_pos, const Eigen::VectorXd & delta_theta,
    const std::string & link_name, Eigen::Matrix<double, 6, 1> & delta_x) override
  {
    Jacobian jacobian;
    if (delta_theta.size() != COUNT || !differentiate(joint_pos, link_name, jacobian)) {
      return false;
    }
    delta_x = jacobian * delta_theta;
    return true;
  }

  bool calculate_link_transform(
    const Eigen::VectorXd & joint_pos, const std::string & link_name,
    Eigen::Isometry3d & transform) override
  {
    Vector q;
    if (!known(link_name) || !take(joint_pos, q)) {
      return false;
    }
    transform.setIdentity();
    if (link_name == base_) {
      return true;
    }
    std::array<double, 3> position;
    std::array<double, 9> rotation;
    if (platform(q, position, rotation) != 0) {
      return false;
    }
    transform.translation() = Eigen::Map<const Eigen::Vector3d>(position.data());
    transform.linear() =
      Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(rotation.data());
    return true;
  }

  bool calculate_jacobian(
    const Eigen::VectorXd & joint_pos, const std::string & link_name,
    Eigen::Matrix<double, 6, Eigen::Dynamic> & jacobian) override
  {
    Jacobian found;
    if (!differentiate(joint_pos, link_name, found)) {
      return false;
    }
    jacobian = found;
    return true;
  }

  bool calculate_jacobian_inverse(
    const Eigen::VectorXd & joint_pos, const std::string & link_name,
    Eigen::Matrix<double, Eigen::Dynamic, 6> & jacobian_inverse) override
  {
    Inverse inverse;
    if (!invert(joint_pos, link_name, inverse)) {
      return false;
    }
    jacobian_inverse = inverse;
    return true;
  }

private:
  using Jacobian = Eigen::Matrix<double, 6, COUNT>;
  using Inverse = Eigen::Matrix<double, COUNT, 6>;

  static void read(
    const std::shared_ptr<rclcpp::node_interfaces::NodeParametersInterface> & parameters,
    const std::string & space, const std::string & name, std::string & value)
  {
    const std::string full = space.empty() ? name : space + "." + name;
    if (parameters != nullptr && parameters->has_parameter(full)) {
      const std::string given = parameters->get_parameter(full).as_string();
      value = given.empty() ? value : given;
    }
  }

  bool known(const std::string & link_name) const
  {
    if (link_name == base_ || link_name == tip_) {
      return true;
    }
    RCLCPP_ERROR(
      logger_, "link '%s': expected '%s' or '%s'", link_name.c_str(), base_.c_str(), tip_.c_str());
    return false;
  }

  bool take(const Eigen::VectorXd & joint_pos, Vector & q) const
  {
    if (joint_pos.size() != COUNT) {
      RCLCPP_ERROR(
        logger_, "joint positions: expected %d, got %d", COUNT, static_cast<int>(joint_pos.size()));
      return false;
    }
    for (int i = 0; i < COUNT; ++i) {
      q[static_cast<std::size_t>(i)] = joint_pos[i];
    }
    return true;
  }

  bool differentiate(
    const Eigen::VectorXd & joint_pos, const std::string & link_name, Jacobian & jacobian) const
  {
    Vector q;
    if (!known(link_name) || !take(joint_pos, q)) {
      return false;
    }
    jacobian.setZero();
    if (link_name == base_) {
      return true;
    }
    std::array<double, 6 * JOINTS> rows;
    if (platform_jacobian(q, rows) != 0) {
      return false;
    }
    for (int i = 0; i < 6; ++i) {
      for (int j = 0; j < COUNT; ++j) {
        jacobian(i, j) = rows[static_cast<std::size_t>(i * COUNT + j)];
      }
    }
    return true;
  }

  bool invert(
    const Eigen::VectorXd & joint_pos, const std::string & link_name, Inverse & inverse) const
  {
    Jacobian jacobian;
    Vector q;
    std::array<double, (JOINTS - FREEDOMS) * JOINTS> idle;
    if (link_name != tip_ || !differentiate(joint_pos, link_name, jacobian) ||
      !take(joint_pos, q) || null_efforts(q, idle) != 0)
    {
      return false;
    }
    // Equilibrated: metres and radians, motors and joints have sizes of their own.
    Eigen::Matrix<double, COUNT, COUNT> square;
    Eigen::Matrix<double, COUNT, 1> columns;
    for (int j = 0; j < COUNT; ++j) {
      for (int i = 0; i < COUNT; ++i) {
        // Of drives that share the effort, velocities that belong to a motion.
        square(i, j) = i < MOBILE ?
          jacobian(static_cast<int>(POSE[static_cast<std::size_t>(i)]), j) :
          idle[static_cast<std::size_t>((i - MOBILE) * COUNT + j)];
      }
      columns[j] = square.col(j).norm();
    }
    if (!(columns.minCoeff() > 0.0)) {
      return false;
    }
    square = square * columns.cwiseInverse().asDiagonal();
    const Eigen::Matrix<double, COUNT, 1> rows = square.rowwise().norm();
    if (!(rows.minCoeff() > 0.0)) {
      return false;
    }
    square = rows.cwiseInverse().asDiagonal() * square;
    const Eigen::FullPivLU<Eigen::Matrix<double, COUNT, COUNT>> lu(square);
    const auto pivots = lu.matrixLU().diagonal().cwiseAbs();
    if (!(pivots.minCoeff() > LEAST_PIVOT * pivots.maxCoeff())) {
      return false;
    }
    const Eigen::Matrix<double, COUNT, COUNT> found = columns.cwiseInverse().asDiagonal() *
      lu.inverse() * rows.cwiseInverse().asDiagonal();
    inverse.setZero();
    for (int i = 0; i < MOBILE; ++i) {
      inverse.col(static_cast<int>(POSE[static_cast<std::size_t>(i)])) = found.col(i);
    }
    return true;
  }

  std::string base_ = "base_link", tip_ = "platform";
  rclcpp::Logger logger_ = rclcpp::get_logger("@PACKAGE@.kinematics");
};
}  // namespace @PACKAGE@

PLUGINLIB_EXPORT_CLASS(@PACKAGE@::Kinematics, kinematics_interface::KinematicsInterface)
