// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#ifndef @GUARD@__FEEDFORWARD_HPP_
#define @GUARD@__FEEDFORWARD_HPP_

#include <cstdint>

#include "@PACKAGE@/model.hpp"

namespace @PACKAGE@
{
/// Joint positions, velocities and accelerations in the controller's numbers.
struct Motion
{
  Vector position{}, velocity{}, acceleration{};
};

/// Why an update is rejected.
enum Rejection : std::size_t {
  NOT_FINITE,    // the reference or its effort is NaN or infinite
  BEYOND_LIMIT,  // a position of the reference is beyond its limit
  NO_ASSEMBLY,   // the machine cannot be assembled at the reference
  SINGULAR,      // the singularity index of the reference is too low
  NO_STATE,      // a measured state that a gain needs is NaN or infinite
  REJECTIONS,    // how many there are; none
};

/// What the machine carries and the drives may give, in the controller's numbers.
struct Load
{
  Parameters parameters{};
  Vector effort{};
};

/// All in the controller's numbers.
struct Settings
{
  Vector p{}, d{};
  Vector lower{}, upper{};
  double singularity_stop = 0.01;
  double hold_time = 0.5;
};

struct Counters
{
  std::uint64_t updates = 0, saturated = 0;
  std::array<std::uint64_t, REJECTIONS> rejected{};
};

/// Efforts of a reference: inverse dynamics at the reference plus PD on the tracking error, at most
/// the effort limits. Allocates nothing; knows nothing of ROS.
///
/// Where the reference is rejected, the last good position is held: the effort that bears the
/// weight there, and PD with zero velocity. After hold_time of rejected updates in a row the
/// machine must not be trusted to this class any longer: update returns false. Without gains on
/// the position, a velocity that is not finite ends only its joint's damping.
class Feedforward
{
public:
  /// Hold the position where the machine is.
  /// Returns REJECTIONS, or why the position is rejected.
  Rejection start(const Settings & settings, const Load & load, const Vector & position);

  /// Take other settings, or another load, between two updates.
  void change(const Settings & settings);
  void change(const Load & load);

  /// Compute efforts for a reference, or to hold without one (nullptr).
  /// False: updates have been rejected for longer than hold_time.
  bool update(
    const Motion * reference, const Vector & position, const Vector & velocity, double period);

  /// What the drives are to give.
  const Vector & effort() const {return effort_;}
  /// The part of it that is inverse dynamics.
  const Vector & feedforward() const {return feedforward_;}
  /// What is followed: the reference, or the position that is held.
  const Motion & target() const {return target_;}
  const Counters & counters() const {return counters_;}
  /// Why the last update was rejected; REJECTIONS where it was not.
  Rejection verdict() const {return verdict_;}
  /// The joint that it was rejected for, or JOINTS; and its position, or the singularity index.
  std::size_t joint() const {return joint_;}
  double found() const {return found_;}

private:
  Rejection compute(const Motion & motion, Vector & effort);
  Rejection judge(const Motion & reference, Vector & effort);
  void hold();

  Settings settings_;
  Load load_;
  Counters counters_;
  Motion target_;
  Vector feedforward_{}, effort_{};
  Rejection verdict_ = REJECTIONS;
  std::size_t joint_ = JOINTS;
  double found_ = 0.0;
  bool resting_ = true;
  double rejected_for_ = 0.0;
};
}  // namespace @PACKAGE@

#endif  // @GUARD@__FEEDFORWARD_HPP_
