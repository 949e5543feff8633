// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
#ifndef @GUARD@__CARRIED_HPP_
#define @GUARD@__CARRIED_HPP_

#include <chrono>
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "rclcpp/rclcpp.hpp"

#include "@PACKAGE@/feedforward.hpp"
#include "@PACKAGE@/parameters.hpp"

namespace @PACKAGE@
{
/// Hold a value that one thread writes and others copy. A control loop never waits for it.
template<class T>
class Mailbox
{
public:
  void write(const T & value)
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    value_ = value;
    ++number_;
  }

  /// Write unless another thread is at the value.
  void offer(const T & value)
  {
    const std::unique_lock<std::mutex> lock(mutex_, std::try_to_lock);
    if (lock) {
      value_ = value;
      ++number_;
    }
  }

  /// Copy a value that is newer than the last one, unless another thread is at it.
  /// number: that of the last one; becomes that of the copy.
  bool take(T & value, std::uint64_t & number) const
  {
    const std::unique_lock<std::mutex> lock(mutex_, std::try_to_lock);
    if (!lock || number == number_) {
      return false;
    }
    value = value_;
    number = number_;
    return true;
  }

  T read(std::uint64_t & number) const
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    number = number_;
    return value_;
  }

private:
  mutable std::mutex mutex_;
  T value_{};
  std::uint64_t number_ = 0;
};

/// A position that a controller has computed efforts for, and when it commanded them.
struct Held
{
  Vector position{};
  std::chrono::steady_clock::time_point time{};
};

/// Hold what the controllers of one machine have in common: payload and effort limits, which count
/// for all of them wherever they are set, and the last position that carried the machine.
class Carried
{
public:
  explicit Carried(const std::vector<std::string> & joints)
  : joints_(joints) {}

  /// Find what belongs to a machine: the controllers of one namespace with the same joints.
  static std::shared_ptr<Carried> find(
    const std::string & space, const std::vector<std::string> & joints)
  {
    static std::mutex mutex;
    static std::map<std::pair<std::string, std::vector<std::string>>, std::weak_ptr<Carried>> all;
    const std::lock_guard<std::mutex> guard(mutex);
    std::weak_ptr<Carried> & known = all[{space, joints}];
    std::shared_ptr<Carried> found = known.lock();
    if (!found) {
      found = std::make_shared<Carried>(joints);
      known = found;
    }
    return found;
  }

  /// Add a controller. Values that its parameter file gives count for all controllers.
  /// Throws where another controller was given another value.
  void join(const std::string & controller, const Values & own, const Values & given)
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    Values values = values_;
    values.insert(own.begin(), own.end());
    for (const auto & [name, value] : given) {
      const auto giver = givers_.find(name);
      if (giver != givers_.end() && giver->second != controller && values.at(name) != value) {
        throw std::invalid_argument(
                name + ": " + value.value_to_string() + ", but " + giver->second + " has " +
                values.at(name).value_to_string() + "; expected one value for both");
      }
      values.at(name) = value;
    }
    load_.write(read_load(values, joints_));
    values_ = std::move(values);
    for (const auto & [name, value] : given) {
      givers_[name] = controller;
    }
  }

  /// The common values, with changes that are not made yet.
  Values values(const std::vector<rclcpp::Parameter> & changes = {}) const
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    Values result = values_;
    for (const rclcpp::Parameter & change : changes) {
      const auto found = result.find(change.get_name());
      if (found != result.end()) {
        found->second = as_double(change);
      }
    }
    return result;
  }

  /// Make changes of common values.
  void set(const std::vector<rclcpp::Parameter> & changes)
  {
    Values changed = values(changes);
    const std::lock_guard<std::mutex> guard(mutex_);
    if (changed != values_) {
      load_.write(read_load(changed, joints_));
      values_ = std::move(changed);
    }
  }

  const Mailbox<Load> & load() const {return load_;}
  Mailbox<Held> & held() {return held_;}

private:
  const std::vector<std::string> joints_;
  mutable std::mutex mutex_;
  Values values_;
  std::map<std::string, std::string> givers_;
  Mailbox<Load> load_;
  Mailbox<Held> held_;
};
}  // namespace @PACKAGE@

#endif  // @GUARD@__CARRIED_HPP_
