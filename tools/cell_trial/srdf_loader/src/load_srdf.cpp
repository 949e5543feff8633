// Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
// Loads URDF and SRDF as MoveIt does: urdf::Model and srdf::Model. Ends with 1 if either reports
// a warning or an error.
#include <console_bridge/console.h>
#include <srdfdom/model.h>
#include <urdf/model.h>

#include <iostream>
#include <string>

namespace
{
class Counter : public console_bridge::OutputHandler
{
public:
  void log(const std::string & text, console_bridge::LogLevel level, const char *, int) override
  {
    if (level < console_bridge::CONSOLE_BRIDGE_LOG_WARN) {
      return;
    }
    ++count;
    std::cout << "  " << text << "\n";
  }
  int count = 0;
};
}  // namespace

int main(int count, char ** words)
{
  if (count != 3) {
    std::cerr << "usage: load_srdf ROBOT.urdf ROBOT.srdf\n";
    return 2;
  }
  Counter counter;
  console_bridge::useOutputHandler(&counter);
  urdf::Model robot;
  srdf::Model semantics;
  if (!robot.initFile(words[1]) || !semantics.initFile(robot, words[2])) {
    std::cout << "not loaded\n";
    return 1;
  }
  std::cout << semantics.getName() << ": " << robot.links_.size() << " links, "
            << semantics.getPassiveJoints().size() << " passive joints, "
            << semantics.getVirtualJoints().size() << " virtual, "
            << semantics.getDisabledCollisionPairs().size() << " pairs without collisions, "
            << semantics.getGroupStates().size() << " states; groups";
  for (const auto & group : semantics.getGroups()) {
    std::cout << " " << group.name_ << " (" << group.joints_.size() << " joints, "
              << group.chains_.size() << " chains)";
  }
  std::cout << "; " << counter.count << " warnings\n";
  return counter.count ? 1 : 0;
}
