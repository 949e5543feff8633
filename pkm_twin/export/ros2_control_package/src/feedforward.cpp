// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#include "@PACKAGE@/feedforward.hpp"

#include <cmath>

#if defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ > 0)
#error "NaN and infinity are tested for: compile without -ffast-math and -ffinite-math-only"
#endif

namespace @PACKAGE@
{
Rejection Feedforward::start(
  const Settings & settings, const Load & load, const Vector & position)
{
  Vector weight;
  settings_ = settings;
  load_ = load;
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
    effort_[i] = std::fmax(-load_.effort[i], std::fmin(load_.effort[i], effort_[i]));
  }
  return REJECTIONS;
}

void Feedforward::change(const Settings & settings) {settings_ = settings;}

void Feedforward::change(const Load & load)
{
  load_ = load;
  // Another payload has another weight.
  resting_ = false;
}

Rejection Feedforward::compute(const Motion & motion, Vector & effort)
{
  joint_ = JOINTS;
  for (const Vector * row : {&motion.position, &motion.velocity, &motion.acceleration}) {
    for (std::size_t i = 0; i < JOINTS; ++i) {
      if (!finite((*row)[i])) {
        joint_ = i;
        return NOT_FINITE;
      }
    }
  }
  const int status = efforts(
    load_.parameters, motion.position, motion.velocity, motion.acceleration, effort, found_);
  if (status != 0) {
    return status == 1 ? NO_ASSEMBLY : NOT_FINITE;
  }
  return found_ < settings_.singularity_stop ? SINGULAR : REJECTIONS;
}

Rejection Feedforward::judge(const Motion & reference, Vector & effort)
{
  for (std::size_t i = 0; i < JOINTS; ++i) {
    const double position = reference.position[i];
    if (finite(position) && (position < settings_.lower[i] || position > settings_.upper[i])) {
      joint_ = i;
      found_ = position;
      return BEYOND_LIMIT;
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
  if (efforts(load_.parameters, target_.position, {}, {}, weight) == 0) {
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
  bool measured = true, controlled = false;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    controlled = controlled || settings_.p[i] != 0.0;
    if ((settings_.p[i] != 0.0 && !finite(position[i])) ||
      (settings_.d[i] != 0.0 && !finite(velocity[i])))
    {
      measured = false;
      if (verdict_ == REJECTIONS) {
        verdict_ = NO_STATE;
        joint_ = i;
      }
    }
  }
  bool saturated = false;
  for (std::size_t i = 0; i < JOINTS; ++i) {
    double effort = feedforward_[i];
    if (measured && settings_.p[i] != 0.0) {
      effort += settings_.p[i] * (target_.position[i] - position[i]);
    }
    if ((measured || (!controlled && finite(velocity[i]))) && settings_.d[i] != 0.0) {
      effort += settings_.d[i] * (target_.velocity[i] - velocity[i]);
    }
    if (!finite(effort)) {
      effort = feedforward_[i];
    }
    const double limit = load_.effort[i];
    effort_[i] = std::fmax(-limit, std::fmin(limit, effort));
    saturated = saturated || effort_[i] != effort;
  }
  counters_.saturated += saturated ? 1 : 0;
  if (verdict_ != REJECTIONS) {
    ++counters_.rejected[verdict_];
  }
  if (verdict_ == REJECTIONS || (verdict_ == NO_STATE && !controlled)) {
    rejected_for_ = 0.0;
    return true;
  }
  rejected_for_ += period > 0.0 ? period : 0.0;
  return rejected_for_ <= settings_.hold_time;
}
}  // namespace @PACKAGE@
