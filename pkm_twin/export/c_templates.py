# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Texts of the exported C, and the files next to it: example, CMakeLists.txt and README."""

from __future__ import annotations

import textwrap
from typing import Final

import numpy as np

from delta_dynamics.torques.virtual_work import inverse_dynamics
from pkm_twin.codegen.program import MAX_ITERATIONS
from pkm_twin.export.c99 import MAX_NEWTON_CORRECTIONS, STEPS_PER_ATTEMPT, write_table
from pkm_twin.robot.robot import Robot

HEADER_TEXT: Final = """\
Joints q: {joints}. Pose: {pose}. SI units, base axes, z up. wrench: force (N) and moment (N m)
that the surroundings apply to the platform at its reference point. Every function returns 0:
valid; 1: no assembly, or a singularity; 2: an input or a result is NaN or infinite. If it is not
0, all outputs are NaN. The forms _with take parameters for another payload.
"""
STATELESS_TEXT: Final = "Friction has no state here: coulomb sign(rate), without presliding (dahl)."
STREAM_TEXT: Final = """, found from the assembly of the sample before instead of from home.
state[{size}] is the caller's, one of each stream. Fill it with zeros before the first sample;
each call writes it. A sample that does not follow the one before is solved from home.
"""
OPERATIONS_TEXT: Final = "At most {:,} operations, {:,} with PKM_ATTEMPTS=1."
PARAMETERS_TEXT: Final = """\
The parameters, out[{size}], for another payload: mass (kg), com[3] (m) from the platform's
reference point and inertia[9] (kg m2) about the com, in axes fixed to the platform that are the
base's at home. Status 2, too, for a payload that a robot file may not have: a mass below zero or
above {mass:g} kg, a com beyond {reach:g} m, an inertia that is not symmetric, has a negative
principal moment, one above the sum of the others, or more than the mass can have.
"""
MASSLESS_TEXT: Final = """
The robot's file gives no masses, so there are no functions of dynamics.
"""
PAYLOAD_TEXT: Final = """
## Another payload

    double parameters[{macro}_PARAMETERS];
    const double com[3] = {{0.0, 0.0, -0.02}}, inertia[9] = {{1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-4}};
    {name}_parameters(0.3, com, inertia, parameters);
    {name}_torques_with(parameters, q, qd, qdd, wrench, tau);
"""
CMAKE: Final = """\
# SPDX-License-Identifier: Apache-2.0
cmake_minimum_required(VERSION 3.10)
project({name} C)

if(NOT CMAKE_BUILD_TYPE AND NOT CMAKE_CONFIGURATION_TYPES)
  set(CMAKE_BUILD_TYPE Release)
endif()
option(PKM_NATIVE "use all instructions of this machine's processor (fused products)" OFF)

add_library({name} STATIC {name}.c)
set_target_properties({name} PROPERTIES
  C_STANDARD 99 C_EXTENSIONS OFF POSITION_INDEPENDENT_CODE ON)
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
if(PKM_NATIVE)
  target_compile_options({name} PRIVATE -march=native)
endif()
if(UNIX)
  target_link_libraries({name} PUBLIC m)
endif()

add_executable({name}_example example.c)
set_target_properties({name}_example PROPERTIES C_STANDARD 99 C_EXTENSIONS OFF)
target_link_libraries({name}_example PRIVATE {name})

enable_testing()
add_test(NAME {name}_example COMMAND {name}_example)
"""
EXAMPLE: Final = """\
/* SPDX-License-Identifier: Apache-2.0 */
/* {title} */
/* The machine at home, compared with the Python functions; exits with 0 if they agree. */
#include <math.h>
#include <stdio.h>

#include "{name}.h"

static int differs(
    const char *what, int status, const double *found, const double *right, int count)
{{
    int i, result = (status == 0) ? 0 : 1;
    printf("%-8s status %d:", what, status);
    for (i = 0; i < count; i++) {{
        printf(" %.9g", found[i]);
        if (!(fabs(found[i] - right[i]) <= (1e-7 * (1.0 + fabs(right[i]))))) {{
            result = 1;
        }}
    }}
    printf("\\n");
    return result;
}}

int main(void)
{{
{declared}
    int bad = 0;
{calls}
    return bad;
}}
"""
README: Final = """\
# {robot} in C

Kinematics and dynamics of the robot `{robot}` in C99, written by `pkm-twin export c`. The code
needs only `math.h`. It allocates no memory, has no variables at file scope except constants, no
recursion, and bounded loops. All functions are reentrant. It also compiles as C++17.

    cmake -B build && cmake --build build && ctest --test-dir build

Without CMake: `cc -std=c99 -O2 -c {name}.c`. With `-mfma`, `-march=native` or the CMake option
`PKM_NATIVE` it runs faster. `-ffast-math` and `-ffinite-math-only` are compile errors.

Joints, in order: {joints}. Joint values are the model's; the robot file's `joint_map` is not
applied. Units, arguments and sizes are in `{name}.h`. Every function returns a status:

- 0: the outputs are valid;
- 1: no assembly exists, or a singularity is on the way to it from the home pose;
- 2: an input or a result is NaN or infinite.

If the status is not 0, every output is NaN. Check the status before you send a command to a
drive.
{dynamics}{payload}
## Accuracy

The code evaluates the same formulas as the Python functions of pkm_twin, in double precision.
Results agree to 1e-12 of the largest value, those of elasticity to 1e-11, where the singularity
index is above 0.2. The error grows as the index falls.

## Worst case

A call usually finds the passive joints with 2 to 4 corrections of Newton's method. If that
fails, up to five more attempts approach the state in steps from the home pose. One call makes
at most {corrections} corrections and computes the rest at most {attempts} times, whatever the
input. `{name}.h` states for each function how many operations that is: additions, multiplications,
divisions and functions of `math.h`; a sine and cosine are about 30 operations.

The last attempts are the long ones. Compile with `-DPKM_ATTEMPTS=1` to make only the first one: at
most {turns} corrections, but valid states far from home may be rejected with status 1.

Stack: at most about {stack} kB without optimisation, less with it.
"""


def write_example(robot: Robot, prefix: str, title: str) -> str:
    """Write the example: functions at home, compared with the results of Python."""
    home = robot.graph.home
    rates, changes = robot.project_redundant(home, *np.full((2, robot.joints_count), 0.1))[1:]
    tests = {
        "pose": ("forward(q, pose)", robot.forward(home)),
        "joints": ("inverse(pose, joints)", home),
    }
    given = {"q": home}
    if robot.has_masses:
        tau = inverse_dynamics(robot, home, rates, changes)
        tests["tau"] = "torques(q, rates, changes, wrench, tau)", tau
        given |= {"rates": rates, "changes": changes, "wrench": np.zeros(6)}
    for name, (_, values) in tests.items():
        given[f"right_{name}"] = np.round(values, 9) + 0.0
    rows = [write_table(name, values.tolist()).removeprefix("static ") for name, values in given.items()]
    sizes = ", ".join(f"{name}[{len(values)}]" for name, (_, values) in tests.items())
    calls = [
        f'bad |= differs("{name}", @_{call}, {name}, right_{name}, {len(values)});\n'
        for name, (call, values) in tests.items()
    ]
    declared = textwrap.indent("".join(rows) + f"double {sizes};", "    ")
    return EXAMPLE.format(
        title=title,
        name=prefix,
        declared=declared,
        calls=textwrap.indent("".join(calls), "    ").rstrip().replace("@", prefix),
    )


def write_readme(robot: Robot, prefix: str, doubles: int) -> str:
    """Write the README: the functions, their largest stack (``doubles`` numbers) and number of corrections."""
    return README.format(
        name=prefix,
        robot=prefix.removeprefix("pkm_"),
        joints=", ".join(robot.joint_names),
        corrections=f"{MAX_NEWTON_CORRECTIONS:,}",
        attempts=len(STEPS_PER_ATTEMPT),
        turns=MAX_ITERATIONS,
        stack=doubles * 8 // 1000 + 3,
        dynamics="" if robot.has_masses else MASSLESS_TEXT,
        payload=PAYLOAD_TEXT.format(name=prefix, macro=prefix.upper()) if robot.has_masses else "",
    )
