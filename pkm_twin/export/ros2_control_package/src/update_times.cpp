// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// @ROBOT@: written by pkm-twin export ros2-control, which overwrites changes.
/// Update times of the controller: ros2 run @PACKAGE@ update_times [UPDATES] [PUBLISH_RATE]
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <new>
#include <vector>

#include "@PACKAGE@/bench.hpp"

namespace
{
thread_local bool counting = false;
thread_local unsigned long allocations = 0;
}  // namespace

void * operator new(std::size_t size)
{
  allocations += counting ? 1 : 0;
  void * memory = std::malloc(size == 0 ? 1 : size);
  if (memory == nullptr) {
    throw std::bad_alloc();
  }
  return memory;
}
void operator delete(void * memory) noexcept {std::free(memory);}
void operator delete(void * memory, std::size_t) noexcept {std::free(memory);}

int main(int argc, char ** argv)
{
  using @PACKAGE@::Bench;
  using @PACKAGE@::JOINTS;
  using Clock = std::chrono::steady_clock;
  const std::size_t updates = argc > 1 ? std::strtoul(argv[1], nullptr, 10) : 1000000;
  rclcpp::init(0, nullptr);
  int result = 0;
  {
    Bench bench({rclcpp::Parameter("state_publish_rate", argc > 2 ? std::atof(argv[2]) : 50.0)});
    bench.activate(true);
    std::vector<double> times(updates);
    unsigned long rejected = 0;
    for (std::size_t k = 0; k < updates; ++k) {
      // Around the start, at 1 kHz.
      const double t = 1e-3 * static_cast<double>(k);
      for (std::size_t i = 0; i < JOINTS; ++i) {
        const double w = 3.0 + static_cast<double>(i), size = @PACKAGE@::RANGE[i], home = @PACKAGE@::START[i];
        bench.reference(i, 0, home + size * std::sin(w * t));
        bench.reference(i, 1, size * w * std::cos(w * t));
        bench.reference(i, 2, -size * w * w * std::sin(w * t));
        bench.measure(i, home + size * std::sin(w * t), size * w * std::cos(w * t));
      }
      counting = true;
      const auto begun = Clock::now();
      const bool good = bench.update(t, 1e-3);
      const auto ended = Clock::now();
      counting = false;
      times[k] = std::chrono::duration<double, std::micro>(ended - begun).count();
      rejected += good ? 0 : 1;
    }
    std::sort(times.begin(), times.end());
    const auto share = [&](double part) {
        return times[static_cast<std::size_t>(part * static_cast<double>(updates - 1))];
      };
    std::printf(
      "updates %zu, p50 %.2f us, p99 %.2f us, p99.9 %.2f us, max %.1f us, allocations %lu, "
      "failed %lu\n",
      updates, share(0.5), share(0.99), share(0.999), times.back(), allocations, rejected);
    result = allocations == 0 && rejected == 0 ? 0 : 1;
  }
  rclcpp::shutdown();
  return result;
}
