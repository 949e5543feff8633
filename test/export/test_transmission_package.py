# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The transmission for ros2_control, compiled against a stand-in for the headers that it uses."""

from __future__ import annotations

import shutil
import subprocess
from xml.etree import ElementTree

import numpy as np
import pytest

from pkm_twin import transmission
from pkm_twin.errors import ParameterError
from pkm_twin.export.transmission import transmission_package
from test.export.c_programs import COMPILERS, STRICT, compile_in, hooked, watched
from test.machine.random_machines import FILES, MACHINES
from test.support.robots import load, partly_long

pytestmark = pytest.mark.skipif(not COMPILERS or not shutil.which("g++"), reason="there is no C and C++ compiler")
GOOD, CONSTRAINTS, OUT_OF_REACH, NOT_FINITE = range(4)
REDUNDANT = MACHINES.parents[2] / "examples/machines/rrr4_planar.yaml"
HEADERS = (
    "transmission_interface/transmission",
    "transmission_interface/exception",
    "hardware_interface/types/hardware_interface_type_values",
)
DRIVER = r"""
#include <cstdio>
#include <memory>
#include "@/transmission.hpp"
using namespace @;
/* Handles of all interfaces in a row: position, velocity, effort, absolute position. */
template<typename HANDLE, typename NAMES>
std::vector<HANDLE> handles(const NAMES & names, std::vector<double> & values)
{
  std::vector<HANDLE> result;
  values.assign(4 * names.size(), 0.0);
  std::size_t k = 0;
  for (const char * kind : {"position", "velocity", "effort", "absolute_position"}) {
    /* In another order than the names. */
    for (std::size_t i = names.size(); i-- > 0; ++k) {
      result.emplace_back(names[i], kind, &values[k - k % names.size() + i]);
    }
  }
  return result;
}
int main()
{
  std::array<std::string, JOINTS> joints;
  std::array<std::string, ACTUATORS> motors;
  for (std::size_t k = 0; k < JOINTS; ++k) {joints[k] = "joint " + std::to_string(k);}
  for (std::size_t k = 0; k < ACTUATORS; ++k) {motors[k] = "motor " + std::to_string(k);}
  std::vector<double> x, a;
  double status = -1.0, way = 0.0;
  auto x_handles = handles<transmission_interface::JointHandle>(joints, x);
  auto a_handles = handles<transmission_interface::ActuatorHandle>(motors, a);
  x_handles.emplace_back(joints[0], STATUS, &status);
  const auto it = std::make_unique<LinkageTransmission>(joints, motors);
  if (it->num_joints() != JOINTS || it->num_actuators() != ACTUATORS) {return 7;}
  try {
    auto half = a_handles;
    half.pop_back();
    it->configure(x_handles, half);
    return 6;
  } catch (const transmission_interface::Exception &) {
  }
  it->configure(x_handles, a_handles);
  while (std::fread(&way, sizeof way, 1, stdin) == 1) {
    auto & from = way > 0.0 ? x : a;
    auto & to = way > 0.0 ? a : x;
    if (std::fread(from.data(), sizeof(double), from.size(), stdin) != from.size()) {return 8;}
    if (way > 0.0) {
      it->joint_to_actuator();
    } else {
      it->actuator_to_joint();
    }
    if (static_cast<double>(it->status()) != status) {return 9;}
    std::fwrite(&status, sizeof status, 1, stdout);
    std::fwrite(to.data(), sizeof(double), to.size(), stdout);
  }
  return 0;
}
"""


class Compiled:
    """An exported transmission, compiled, with a controller of other signs, ratios and zeros."""

    def __init__(self, name, folder):
        robot = load(FILES.get(name, name))
        rng, self.folder = np.random.default_rng(3), folder
        entries = {
            joint: {"sign": float(rng.choice([-1, 1])), "ratio": rng.uniform(0.2, 9.0), "offset": rng.normal()}
            for joint in robot.joint_names
        }
        self.robot = robot.changed(joint_map=entries)
        self.right = transmission(self.robot)
        self.n, self.m = self.robot.joints_count, len(self.robot.pose_names)
        self.files = transmission_package(self.robot)
        for path, text in self.files.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text)
        stand_in = MACHINES.parents[1] / "export/transmission_stand_in.hpp"
        for header in HEADERS:
            (folder / f"{header}.hpp").parent.mkdir(parents=True, exist_ok=True)
            (folder / f"{header}.hpp").write_text(f'#include "{stand_in}"\n')
        (package,) = (folder / "include").iterdir()
        (folder / "driver.cpp").write_text(DRIVER.replace("@", package.name))
        (c_file,) = folder.glob("c/pkm_*.c")
        compile_in(folder, COMPILERS[0], "-std=c99", "-O0", "-c", c_file, "-o", "robot.o")
        self.flags = ("-Iinclude", "-Ic", "-I.")
        parts = ("src/transmission.cpp", "-c", "-o", "transmission.o")
        compile_in(folder, "g++", *STRICT, *self.flags, *parts)
        self.program = folder / "driver"
        objects = ("transmission.o", "robot.o")
        compile_in(folder, "g++", *STRICT, *self.flags, "driver.cpp", *objects, "-o", "driver", "-lm")

    def rows(self, way, *parts):
        """Calls in one direction: position, velocity, effort, absolute position; None is NaN."""
        size = self.m if way > 0.0 else self.n
        parts = [np.full(size, np.nan) if part is None else part for part in parts]
        return np.concatenate([[way], *parts])

    def run(self, *rows):
        """Status and results, in fours, of each call."""
        done = subprocess.run(
            [self.program], input=b"".join(r.tobytes() for r in rows), capture_output=True, check=True
        )
        values, found = np.frombuffer(done.stdout), []
        for row in rows:
            size = self.n if row[0] > 0.0 else self.m
            found.append((int(values[0]), values[1 : 1 + 4 * size].reshape(4, size)))
            values = values[1 + 4 * size :]
        return found


@pytest.fixture(
    scope="module",
    params=partly_long(["five_bar", "rps3", "prru", str(REDUNDANT)], "five_bar", str(REDUNDANT)),
)
def compiled(request, tmp_path_factory):
    return Compiled(request.param, tmp_path_factory.mktemp("transmission"))


def poses(compiled, count=20):
    rng, home = np.random.default_rng(4), compiled.robot.home()
    return home + rng.uniform(-0.01, 0.01, (count, compiled.m)), rng.normal(size=(2, count, compiled.m))


def test_states_and_commands_are_those_of_python(compiled):
    x, (v, f) = poses(compiled)
    there = compiled.right.joint_to_actuator(x, v, f)
    none = np.zeros(compiled.m)
    found = compiled.run(*(compiled.rows(1.0, *row, none) for row in zip(x, v, f, strict=True)))
    assert [status for status, _ in found] == [GOOD] * len(x)
    given = there.position, there.velocity, there.effort
    for k, values in enumerate(given):
        np.testing.assert_allclose([row[k] for _, row in found], values, rtol=0, atol=1e-12 * 10)
    back = compiled.run(*(compiled.rows(-1.0, *row, row[0]) for row in zip(*given, strict=True)))
    for k, values in enumerate((x, v, f, x)):
        np.testing.assert_allclose([row[k] for _, row in back], values, rtol=0, atol=1e-12 * 10)


def test_what_nobody_commands_stays_so_and_a_velocity_is_at_the_measured_position(compiled):
    x, (v, _) = (rows[0] if rows.ndim == 2 else rows[:, 0] for rows in poses(compiled))
    there = compiled.right.joint_to_actuator(x, v)
    first, velocity, nothing = compiled.run(
        compiled.rows(-1.0, there.position, there.velocity, None, there.position),
        compiled.rows(1.0, None, v, None, None),
        compiled.rows(1.0, None, None, None, None),
    )
    assert first[0] == GOOD and np.isnan(first[1][2]).all()
    assert velocity[0] == GOOD and np.isnan(velocity[1][[0, 2]]).all()
    np.testing.assert_allclose(velocity[1][1], there.velocity, atol=1e-11)
    assert nothing[0] == CONSTRAINTS


def test_out_of_reach_holds_the_last_result_for_one_call(compiled):
    home, far = compiled.robot.home(), compiled.robot.home() + 2.0  # rad and m
    still = np.zeros(compiled.m)
    at_home = compiled.rows(1.0, home, still, still, still)
    beyond = compiled.rows(1.0, far, still, still, still)
    broken = compiled.rows(1.0, np.append(home[:-1], np.inf), still, still, still)
    good, held, lost, bad, again = compiled.run(at_home, beyond, beyond, broken, at_home)
    assert [row[0] for row in (good, held, lost, bad, again)] == [GOOD, CONSTRAINTS, OUT_OF_REACH, NOT_FINITE, GOOD]
    np.testing.assert_array_equal(held[1][:3], good[1][:3])
    assert np.isnan(lost[1][:3]).all() and np.isnan(bad[1][:3]).all()
    np.testing.assert_array_equal(again[1], good[1])
    never = compiled.run(beyond)
    assert never[0][0] == OUT_OF_REACH


def test_no_call_allocates(compiled):
    x, (v, f) = poses(compiled)
    rows = [compiled.rows(1.0, *row, row[0]) for row in zip(x, v, f, strict=True)]
    program = hooked(
        compiled.folder,
        r"it->\w+_to_\w+\(\)",
        "driver.cpp",
        *compiled.flags,
        "transmission.o",
        "robot.o",
    )
    assert watched(program, np.concatenate(rows)) == (len(rows), 0)


def test_the_snippet_names_the_roles_and_a_changing_ratio_is_rejected(compiled):
    element = ElementTree.fromstring(compiled.files["config/transmission.urdf.xml"])
    joints, actuators = ([e.get("role") for e in element.iter(k)] for k in ("joint", "actuator"))
    assert joints == list(compiled.robot.pose_names)
    assert actuators == list(compiled.robot.controller.names)
    joint = compiled.robot.joint_names[0]
    with pytest.raises(ParameterError, match="ratio_change"):
        transmission_package(compiled.robot.changed(joint_map={joint: {"ratio_change": 0.1}}))
