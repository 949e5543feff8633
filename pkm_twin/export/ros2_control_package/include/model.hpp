// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#ifndef @GUARD@__MODEL_HPP_
#define @GUARD@__MODEL_HPP_

#include <cmath>
#include <cstdint>

#include "@PACKAGE@/robot.hpp"

/// The exported C in the controller's numbers:
/// position = offset + factor * model's position, effort = model's effort / factor.
/// Every function returns the status of the C function: 0 valid, 1 no assembly or a singularity,
/// 2 an input or a result is NaN or infinite. Results are NaN where it is not 0.
namespace @PACKAGE@
{
inline Vector model_positions(const Vector & q)
{
  Vector result;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    result[i] = (q[i] - DRIVES[i].offset) / DRIVES[i].factor;
  }
  return result;
}

/// Return whether a number is neither NaN nor infinite, by its bits: compilers may drop comparisons
/// with NaN.
inline bool finite(double value)
{
  union {double value; std::uint64_t bits;} volatile number;
  number.value = value;
  return (number.bits & 0x7ff0000000000000ULL) != 0x7ff0000000000000ULL;
}

/// Velocities or accelerations.
inline Vector model_rates(const Vector & rates)
{
  Vector result;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    result[i] = rates[i] / DRIVES[i].factor;
  }
  return result;
}

/// Velocities, of which those of rounding size are zero: they are no direction of dry friction.
inline Vector model_velocities(const Vector & qd)
{
  Vector result = model_rates(qd);
  for (std::size_t i = 0; i < JOINTS; ++i) {
    if (finite(qd[i]) && std::fabs(qd[i]) <= DRIVES[i].rest) {
      result[i] = 0.0;
    }
  }
  return result;
}

/// Efforts, and the singularity index: 0 in a singularity, 1 at best.
inline int efforts(
  const Parameters & parameters, const Vector & q, const Vector & qd, const Vector & qdd,
  Vector & tau, double & index)
{
  constexpr std::array<double, 6> no_wrench{};
  const Vector x = model_positions(q), v = model_velocities(qd), a = model_rates(qdd);
  const int status = @PREFIX@_torques_and_singularity_with(
    parameters.data(), x.data(), v.data(), a.data(), no_wrench.data(), tau.data(), &index);
  for (std::size_t i = 0; i < JOINTS; ++i) {
    tau[i] /= DRIVES[i].factor;
  }
  return status;
}

inline int efforts(
  const Parameters & parameters, const Vector & q, const Vector & qd, const Vector & qdd,
  Vector & tau)
{
  double index;
  return efforts(parameters, q, qd, qdd, tau, index);
}

/// Friction of the drives. Dry friction is zero at rest.
inline Vector drive_friction(const Vector & qd)
{
  const Vector rates = model_velocities(qd);
  Vector result;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    const double direction = static_cast<double>((rates[i] > 0.0) - (rates[i] < 0.0));
    result[i] = (DRIVES[i].viscous * rates[i] + DRIVES[i].coulomb * direction) / DRIVES[i].factor;
  }
  return result;
}

/// Row by row.
inline int mass_matrix(
  const Parameters & parameters, const Vector & q, std::array<double, JOINTS * JOINTS> & m)
{
  const int status =
    @PREFIX@_mass_matrix_with(parameters.data(), model_positions(q).data(), m.data());
  for (std::size_t i = 0; i < JOINTS; ++i) {
    for (std::size_t j = 0; j < JOINTS; ++j) {
      m[i * JOINTS + j] /= DRIVES[i].factor * DRIVES[j].factor;
    }
  }
  return status;
}

/// The platform's reference point in base axes, and its rotation from home, row by row.
inline int platform(
  const Vector & q, std::array<double, 3> & position, std::array<double, 9> & rotation)
{
  return @PREFIX@_platform(model_positions(q).data(), position.data(), rotation.data());
}

/// Velocity of the reference point and angular velocity, base axes, per joint rate, row by row.
inline int platform_jacobian(const Vector & q, std::array<double, 6 * JOINTS> & j)
{
  const int status = @PREFIX@_platform_jacobian(model_positions(q).data(), j.data());
  for (std::size_t k = 0; k < j.size(); ++k) {
    j[k] /= DRIVES[k % JOINTS].factor;
  }
  return status;
}

/// Efforts that move nothing, row by row: no motion of the machine has power in them.
inline int null_efforts(const Vector & q, std::array<double, (JOINTS - FREEDOMS) * JOINTS> & n)
{
@NULLEFFORTS@
}

/// Make positions, velocities and accelerations those of a motion, by the joints that lead: all,
/// unless drives share the effort.
inline int make_agree(Vector & q, Vector & qd, Vector & qdd)
{
@PROJECTION@
}

/// Parameters of another payload: mass (kg), com (m) from the reference point, inertia (kg m2)
/// about the com, row by row.
inline int payload_parameters(
  double mass, const std::array<double, 3> & com, const std::array<double, 9> & inertia,
  Parameters & parameters)
{
  return @PREFIX@_parameters(mass, com.data(), inertia.data(), parameters.data());
}
}  // namespace @PACKAGE@

#endif  // @GUARD@__MODEL_HPP_
