# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The table of docs/export_c.md: ``python -m test.export.c_table docs/export_c.md``."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from delta_dynamics.torques.virtual_work import torque_kernel
from pkm_twin import load, robot_names
from pkm_twin.export.c_package import c_package
from test.export.c_programs import Package
from test.support.robots import random_motion

SAMPLES, TURNS = 5000, 9
BUILDS = {
    "-O2": ("gcc", "-O2"),
    "native": ("gcc", "-O3", "-march=native"),
}
LOOP = r"""
#include <stdint.h>
#include <time.h>
#include "@.h"
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
double in_c(const double *q, const double *qd, const double *qdd, const double *w, long count)
{
    double tau[6], begun = now();
    long i;
    for (i = 0; i < count; i++) {
        @_torques(q + N * i, qd + N * i, qdd + N * i, w, tau);
    }
    return now() - begun;
}
double in_vectors(int64_t (*code)(int64_t *), int64_t *words, long count)
{
    double begun = now();
    long i;
    for (i = 0; i < count; i++) {
        code(words);
        words[5] += 8 * N;
        words[8] += 8 * N;
        words[11] += 8 * N;
    }
    words[5] -= 8 * N * count;
    words[8] -= 8 * N * count;
    words[11] -= 8 * N * count;
    return now() - begun;
}
"""


def address(array):
    return ctypes.c_void_p(array.ctypes.data)


def built(package, n, compiler, *flags):
    """A shared library of the robot's functions with the loops above."""
    text = LOOP.replace("@", package.prefix).replace('#include "', f'#define N {n}\n#include "')
    (package.folder / "loop.c").write_text(text)
    name = f"{compiler}{''.join(flags)}.so"
    command = [compiler, *flags, "-fPIC", "-shared", "loop.c", f"{package.prefix}.c", "-o", name]
    subprocess.run([*command, "-lm"], cwd=package.folder, check=True)
    library = ctypes.CDLL(str(package.folder / name))
    library.in_c.restype = library.in_vectors.restype = ctypes.c_double
    return library


def times(robot, package):
    """Nanoseconds of one torques call by build, and of the vector code's; in turns, medians."""
    q, qd, qdd, wrench = random_motion(robot, np.random.default_rng(0), SAMPLES)
    kernel = torque_kernel(robot)
    prepared, out = kernel.prepare(robot.inertial), np.zeros(8)
    words = [1, 1, 1, prepared.ctypes.data, 0]
    for array in (q, qd, qdd, wrench):
        words += [array.ctypes.data, 0, 0]
    words = np.array([*words, out.ctypes.data, out[6:].ctypes.data], np.int64)
    code = ctypes.cast(kernel.code._loaded[2], ctypes.c_void_p)
    count = ctypes.c_long(SAMPLES)
    libraries = {name: built(package, q.shape[1], *flags) for name, flags in BUILDS.items()}
    found = {name: [] for name in (*libraries, "vectors")}
    for _ in range(TURNS):
        for name, library in libraries.items():
            found[name].append(library.in_c(*map(address, (q, qd, qdd, wrench)), count))
        found["vectors"].append(libraries["-O2"].in_vectors(code, address(words), count))
    return {name: 1e9 / SAMPLES * float(np.median(values)) for name, values in found.items()}


def frames(package):
    """Code in kB, and the deepest stack of a call with torques and of any, bytes: gcc -O2."""
    command = ["gcc", "-std=c99", "-O2", "-fstack-usage", "-c", f"{package.prefix}.c", "-o", "o.o"]
    subprocess.run(command, cwd=package.folder, check=True)
    done = subprocess.run(["size", "o.o"], cwd=package.folder, check=True, capture_output=True)
    code = int(done.stdout.split()[6]) / 1e3
    sizes = {}
    for line in (package.folder / "o.su").read_text().splitlines():
        place, size, _ = line.split("\t")
        sizes[place.rpartition(":")[2].removeprefix(f"{package.prefix}_").partition(".")[0]] = int(size)

    def deepest(name):
        """Frames of a function, of its form with parameters, and of what that calls."""
        below = max(sizes.get(f"{name}_of", 0), sizes.get("assembly", 0))
        return sum(sizes.get(k, 0) for k in (name, f"{name}_with", "turn")) + below

    return code, deepest("torques"), max(map(deepest, package.heads))


def row(name):
    robot = load(name)
    with tempfile.TemporaryDirectory() as folder:
        package = Package(Path(folder), c_package(robot))
        code, own, most = frames(package)
        ns = times(robot, package)
    cells = [f"`{name}`", f"{code:.0f}", f"{own:,}", f"{most:,}"]
    cells += [f"{ns[k]:.0f}" for k in (*BUILDS, "vectors")]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    page = Path(sys.argv[1])
    lines = page.read_text(encoding="utf-8").splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("| robot | code")) + 2
    end = next(k for k in range(at, len(lines)) if not lines[k].startswith("| `"))
    lines[at:end] = [row(name) for name in robot_names()]
    page.write_text("\n".join([*lines, ""]), encoding="utf-8")
