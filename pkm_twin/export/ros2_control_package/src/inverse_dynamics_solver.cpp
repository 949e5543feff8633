// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#include <stdexcept>
#include <string>

#include "pluginlib/class_list_macros.hpp"

// The header's name depends on the release.
#if __has_include("inverse_dynamics_solver/inverse_dynamics_solver.hpp")
#include "inverse_dynamics_solver/inverse_dynamics_solver.hpp"
#else
#include "inverse_dynamics_solver/inverse_dynamics_solver.h"
#endif

#include "@PACKAGE@/model.hpp"

namespace @PACKAGE@
{
/// The machine's dynamics on its actuated joints, loops closed.
///
/// Torques are inertia, Coriolis and gravity; the drives' friction is getFrictionVector, that of
/// passive joints is in the Coriolis vector. Where the machine cannot be assembled, and where
/// numbers are not finite, every function throws std::domain_error.
class InverseDynamicsSolver : public inverse_dynamics_solver::InverseDynamicsSolver
{
public:
  /// Parameters payload.mass, payload.com, payload.inertia in the namespace; by default those of
  /// the robot's file. The URDF is not read.
  void initialize(
    rclcpp::node_interfaces::NodeParametersInterface::ConstSharedPtr parameters,
    const std::string & space, const std::string &) override
  {
    Payload load = PAYLOAD;
    const std::string prefix = (space.empty() ? "" : space + ".") + "payload.";
    if (parameters != nullptr) {
      if (parameters->has_parameter(prefix + "mass")) {
        load.mass = parameters->get_parameter(prefix + "mass").as_double();
      }
      read(*parameters, prefix + "com", load.com);
      read(*parameters, prefix + "inertia", load.inertia);
    }
    if (payload_parameters(load.mass, load.com, load.inertia, parameters_) != 0) {
      throw std::invalid_argument(prefix + "*: expected the payload of a real body");
    }
    initialized_ = true;
  }

  Eigen::MatrixXd getInertiaMatrix(const Eigen::VectorXd & joint_positions) const override
  {
    std::array<double, JOINTS * JOINTS> rows;
    judge(mass_matrix(parameters_, taken(joint_positions), rows));
    return Eigen::Map<const Eigen::Matrix<double, COUNT, COUNT>>(rows.data());
  }

  Eigen::VectorXd getCoriolisVector(
    const Eigen::VectorXd & joint_positions, const Eigen::VectorXd & joint_velocities) const
  override
  {
    Vector positions = taken(joint_positions), velocities = taken(joint_velocities), change{};
    judge(make_agree(positions, velocities, change));
    const Eigen::VectorXd own = given(change);
    Eigen::VectorXd result =
      getTorques(joint_positions, joint_velocities, own) - getGravityVector(joint_positions);
    if (JOINTS > FREEDOMS) {
      result -= getInertiaMatrix(joint_positions) * own;
    }
    return result;
  }

  Eigen::VectorXd getGravityVector(const Eigen::VectorXd & joint_positions) const override
  {
    const Eigen::VectorXd rest = Eigen::VectorXd::Zero(COUNT);
    return getTorques(joint_positions, rest, rest);
  }

  Eigen::VectorXd getFrictionVector(const Eigen::VectorXd & joint_velocities) const override
  {
    return given(drive_friction(taken(joint_velocities)));
  }

  Eigen::VectorXd getTorques(
    const Eigen::VectorXd & joint_positions, const Eigen::VectorXd & joint_velocities,
    const Eigen::VectorXd & joint_accelerations) const override
  {
    Vector tau;
    const Vector velocities = taken(joint_velocities);
    judge(
      efforts(
        parameters_, taken(joint_positions), velocities, taken(joint_accelerations), tau));
    return given(tau) - given(drive_friction(velocities));
  }

private:
  static constexpr int COUNT = static_cast<int>(JOINTS);

  template<std::size_t SIZE>
  static void read(
    const rclcpp::node_interfaces::NodeParametersInterface & parameters, const std::string & name,
    std::array<double, SIZE> & values)
  {
    if (!parameters.has_parameter(name)) {
      return;
    }
    const auto found = parameters.get_parameter(name).as_double_array();
    if (found.size() != SIZE) {
      throw std::invalid_argument(name + ": expected " + std::to_string(SIZE) + " numbers");
    }
    for (std::size_t i = 0; i < SIZE; ++i) {
      values[i] = found[i];
    }
  }

  Vector taken(const Eigen::VectorXd & values) const
  {
    if (!initialized_) {
      throw std::runtime_error("the solver is not initialized");
    }
    if (values.size() != COUNT) {
      throw std::invalid_argument("expected " + std::to_string(JOINTS) + " values");
    }
    Vector result;
    for (int i = 0; i < COUNT; ++i) {
      result[static_cast<std::size_t>(i)] = values[i];
    }
    return result;
  }

  static Eigen::VectorXd given(const Vector & values)
  {
    return Eigen::Map<const Eigen::Matrix<double, COUNT, 1>>(values.data());
  }

  static void judge(int status)
  {
    if (status != 0) {
      throw std::domain_error(
              status == 1 ? "no assembly of the machine, or a singularity" : "numbers not finite");
    }
  }

  Parameters parameters_{};
  bool initialized_ = false;
};
}  // namespace @PACKAGE@

PLUGINLIB_EXPORT_CLASS(
  @PACKAGE@::InverseDynamicsSolver, inverse_dynamics_solver::InverseDynamicsSolver)
