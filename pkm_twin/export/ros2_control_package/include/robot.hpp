// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#ifndef @GUARD@__ROBOT_HPP_
#define @GUARD@__ROBOT_HPP_

#include <array>
#include <cstddef>
#include <limits>

#include "@PREFIX@.h"

namespace @PACKAGE@
{
constexpr std::size_t JOINTS = @MACRO@_JOINTS, FREEDOMS = @MACRO@_POSE;
using Vector = std::array<double, JOINTS>;
using Parameters = std::array<double, @MACRO@_PARAMETERS>;

constexpr double UNLIMITED = std::numeric_limits<double>::infinity();

/// An actuated joint. The controller's position is offset + factor * the model's.
/// Limits are in the controller's numbers, friction is in the model's. damping, in the controller's
/// numbers, stops the drive's mass at home with a time constant of @STOP@ s. Velocities up to rest
/// are rounding.
struct Drive
{
  const char * name;
  double factor, offset;
  double lower, upper, effort;
  double viscous, coulomb;
  double damping, rest;
};

constexpr std::array<Drive, JOINTS> DRIVES{{
@DRIVES@
}};

/// Rows of the twist (x y z, then rotations about them) in which the joints move the platform.
constexpr std::array<std::size_t, FREEDOMS> POSE{@POSE@};

struct Payload
{
  double mass;
  std::array<double, 3> com;
  std::array<double, 9> inertia;
};

/// Bounds of a payload, kg and m, of its mass and the coordinates of its centre.
constexpr double MAX_MASS = @MAXMASS@, MAX_LENGTH = @MAXLENGTH@;

/// That of the robot's file.
constexpr Payload PAYLOAD@PAYLOAD@;
}  // namespace @PACKAGE@

#endif  // @GUARD@__ROBOT_HPP_
