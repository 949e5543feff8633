// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#include "@PACKAGE@/feedforward.hpp"

#include <cmath>

#if defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ > 0)
#error "NaN and infinity are tested for: compile without -ffast-math and -ffinite-math-only"
#endif

namespace @PACKAGE@
{
Rejection Feedforward::start(const Settings & settings, const Vector & position)
{
  Vector weight;
  settings_ = settings;
  const Motion rest{position, {}, {}};
  const Rejection verdict = compute(rest, weight);
  if (verdict != REJECTIONS) {
    return verdict;
  }
  target_ = rest;
  feedforward_ = effort_ = weight;
  counters_ = {};
  verdict_ = REJECTIONS;
  resting_ = true;
  rejected_for_ = 0.0;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    effort_[i] = std::fmax(-settings_.effort[i], std::fmin(settings_.effort[i], effort_[i]));
  }
  return REJECTIONS;
}

void Feedforward::change(const Settings & settings)
{
  settings_ = settings;
  // Another payload has another weight.
  resting_ = false;
}

Rejection Feedforward::compute(const Motion & motion, Vector & effort)
{
  if (!finite(motion.position) || !finite(motion.velocity) || !finite(motion.acceleration)) {
    return NOT_FINITE;
  }
  double index;
  const int status = efforts(
    settings_.parameters, state_, motion.position, motion.velocity, motion.acceleration, effort,
    index);
  if (status != 0) {
    return status == 1 ? NO_ASSEMBLY : NOT_FINITE;
  }
  return index < settings_.singularity_stop ? SINGULAR : REJECTIONS;
}

Rejection Feedforward::judge(const Motion & reference, Vector & effort)
{
  for (std::size_t i = 0; i < JOINTS; ++i) {
    const double position = reference.position[i];
    if (position < settings_.lower[i] || position > settings_.upper[i]) {
      return std::isfinite(position) ? BEYOND_LIMIT : NOT_FINITE;
    }
  }
  return compute(reference, effort);
}

void Feedforward::hold()
{
  if (resting_) {
    return;
  }
  target_.velocity = target_.acceleration = {};
  // The position was accepted before: settings that have changed since do not reject it.
  Vector weight;
  if (efforts(settings_.parameters, target_.position, {}, {}, weight) == 0) {
    feedforward_ = weight;
  }
  resting_ = true;
}

bool Feedforward::update(
  const Motion * reference, const Vector & position, const Vector & velocity, double period)
{
  ++counters_.updates;
  Vector wanted;
  verdict_ = reference == nullptr ? REJECTIONS : judge(*reference, wanted);
  if (reference != nullptr && verdict_ == REJECTIONS) {
    target_ = *reference;
    feedforward_ = wanted;
    resting_ = false;
  } else {
    hold();
  }
  bool measured = true, saturated = false;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    measured = measured && (settings_.p[i] == 0.0 || std::isfinite(position[i])) &&
      (settings_.d[i] == 0.0 || std::isfinite(velocity[i]));
  }
  if (!measured && verdict_ == REJECTIONS) {
    verdict_ = NO_STATE;
  }
  for (std::size_t i = 0; i < JOINTS; ++i) {
    double effort = feedforward_[i];
    if (measured && settings_.p[i] != 0.0) {
      effort += settings_.p[i] * (target_.position[i] - position[i]);
    }
    if (measured && settings_.d[i] != 0.0) {
      effort += settings_.d[i] * (target_.velocity[i] - velocity[i]);
    }
    if (std::isnan(effort)) {
      effort = feedforward_[i];
    }
    const double limit = settings_.effort[i];
    effort_[i] = std::fmax(-limit, std::fmin(limit, effort));
    saturated = saturated || effort_[i] != effort;
  }
  counters_.saturated += saturated ? 1 : 0;
  if (verdict_ == REJECTIONS) {
    rejected_for_ = 0.0;
    return true;
  }
  ++counters_.rejected[verdict_];
  rejected_for_ += period > 0.0 ? period : 0.0;
  return rejected_for_ <= settings_.hold_time;
}
}  // namespace @PACKAGE@
