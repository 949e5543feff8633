# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Times of exported C beside a Delta's ``_torques`` and closed forms of textbooks, in one process.

``python -m test.benchmarks.kinematics_c [docs/benchmarks.md] [ROBOT ...]``: needs gcc. Writes the
table of the page, or prints it; robots are names or paths, by default those of the page.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from pkm_twin import load
from pkm_twin.export.c_package import Package
from test.benchmarks.textbook import TEXTBOOK
from test.support.pages import write_section
from test.support.robots import joint_range

FLAGS = "-std=gnu99", "-O3", "-march=native", "-fPIC", "-shared"
STATES, CHUNK, ROUNDS = 2000, 100, 9
HERE = Path(__file__).parent
ROBOTS = (
    "stewart",
    "delta",
    "delta_cu",
    "prru",
    "upr_rpu",
    "five_bar",
    "rps3",
    "linear_delta",
    str(HERE / "ankle.yaml"),
    str(HERE / "skew3.yaml"),
)
CALLS = {
    "torques": ("q", "qd", "qdd", "wrench", "tau"),
    "inverse": ("pose", "tau"),
    "torques_at_pose": ("pose", "qd", "qdd", "wrench", "q_out", "v_out", "a_out", "tau"),
    "forward": ("q", "pose_out"),
    "mass_matrix": ("q", "matrix"),
    "mass_matrix_at_pose": ("pose", "matrix"),
    "accelerations": ("q", "qd", "qdd", "wrench", "tau"),
    "accelerations_at_pose": ("pose", "qd", "efforts", "wrench", "v_out", "a_out"),
}
"""Arguments of each function: a row of an input for each state, or one output."""
TABLES = "q", "qd", "qdd", "pose"
LOOP = r"""
#include <math.h>
#include <time.h>
#include "@.h"
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
"""
TIMED = r"""
double time_%s(const double *q, const double *qd, const double *qdd, const double *pose, long count)
{
    double tau[6], q_out[6], v_out[6], a_out[6], pose_out[6], matrix[36], wrench[6] = {0.0}, efforts[6] = {1.0}, begun;
    long i;
    int bad = 0;
    begun = now();
    for (i = 0; i < count; i++) {
        bad += %s;
    }
    begun = now() - begun;
    return (bad == 0) ? begun : -1.0;
}
"""


def build(robot, folder):
    """Return a library of timed loops over a robot's functions, and of a textbook's closed form."""
    prefix = f"pkm_{robot.name}"
    parts = [LOOP.replace("@", prefix)]
    calls = {name: f"{prefix}_{name}({{}})" for name in CALLS}
    arguments = dict(CALLS)
    form = TEXTBOOK.get(robot.name)
    if form is not None:
        parts.append(form(robot))
        calls["textbook"], arguments["textbook"] = "textbook({})", CALLS["inverse"]
    sizes = {"q": robot.joints_count, "qd": robot.joints_count, "qdd": robot.joints_count}
    for name, call in calls.items():
        m = len(robot.pose_names)
        own = sizes | {"pose": m} | ({"qd": m, "qdd": m} if name.endswith("at_pose") else {})
        words = [f"{a} + {own[a]} * i" if a in own else a for a in arguments[name]]
        parts.append(TIMED % (name, call.format(", ".join(words))))
    if form is not None:
        parts.append("int textbook_one(const double *pose, double *q)\n{\n    return textbook(pose, q);\n}\n")
    made = Package(robot, list(CALLS))
    (folder / f"{prefix}.h").write_text(made.header())
    (folder / f"{prefix}.c").write_text(made.source())
    (folder / "loop.c").write_text("".join(parts))
    command = ["gcc", *FLAGS, "loop.c", f"{prefix}.c", "-o", f"{prefix}.so", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / f"{prefix}.so"))
    timed = {name: getattr(library, f"time_{name}") for name in calls}
    for call in timed.values():
        call.restype = ctypes.c_double
    if form is not None:
        timed["textbook_one"] = library.textbook_one
    return timed


def draw_states(robot):
    """Return q, qd, qdd and pose of states over the whole joint range, (states, n or m) each."""
    rng = np.random.default_rng(3)
    middle, half = joint_range(robot)
    q = np.zeros((0, len(middle)))
    while len(q) < STATES:
        drawn = middle + half * rng.uniform(-1.0, 1.0, (STATES, len(middle)))
        pose, good = robot.try_forward(drawn)
        good[good] &= robot.try_inverse(pose[good])[1]
        q = np.concatenate([q, drawn[good]])[:STATES]
    qd, qdd = rng.normal(size=(2, *q.shape))
    return [np.ascontiguousarray(a) for a in (q, qd, qdd, robot.forward(q))]


def check_textbook(robot, call, states):
    """Compare a textbook's closed form with the package, whose joints may turn once more."""
    found = np.zeros(robot.joints_count)
    for pose in states[3][:200]:
        pose = np.ascontiguousarray(pose)
        assert call(*(ctypes.c_void_p(a.ctypes.data) for a in (pose, found))) == 0
        np.testing.assert_allclose(found, robot.inverse(pose), atol=1e-9)


def run(call, states, chunk):
    """Return the seconds of one call of a loop over a chunk of states."""
    part = [a[chunk] for a in states]
    seconds = call(*(ctypes.c_void_p(a.ctypes.data) for a in part), ctypes.c_long(len(part[0])))
    assert seconds >= 0.0, "a state was rejected"
    return seconds


def measure(robots, folder):
    """Return each robot's times by function, in units of a Delta's ``_torques``, and that in ns."""
    unit = load("delta")
    unit_states, unit_call = draw_states(unit), build(unit, folder)["torques"]
    chunks = [slice(k, k + CHUNK) for k in range(0, STATES, CHUNK)]
    found, nanoseconds = {}, []
    for robot in robots:
        states, timed = draw_states(robot), build(robot, folder)
        one = timed.pop("textbook_one", None)
        if one is not None:
            check_textbook(robot, one, states)
        found[robot.name] = {}
        for name, call in timed.items():
            own = units = 0.0
            for chunk in chunks:
                pairs = [(run(unit_call, unit_states, chunk), run(call, states, chunk)) for _ in range(ROUNDS)]
                least = np.min(pairs, axis=0)
                units, own = units + least[0], own + least[1]
            found[robot.name][name] = own / units
            nanoseconds.append(1e9 * units / STATES)
    return found, min(nanoseconds)


def main(arguments):
    page = Path(arguments.pop(0)) if arguments and arguments[0].endswith(".md") else None
    robots = [load(name) for name in (arguments or ROBOTS)]
    with tempfile.TemporaryDirectory() as folder:
        found, unit = measure(robots, Path(folder))
    names = ["inverse", "textbook", *(name for name in CALLS if name != "inverse")]
    lines = [
        f"Exported C, `gcc -O3 -march=native`, {STATES:,} states over the whole joint range, in "
        f"units of a Delta's `_torques` ({unit:.0f} ns) in the same process; the least of {ROUNDS} "
        f"rounds. Textbook: the closed form of the inverse kinematics, written by hand.",
        "",
        "| robot | " + " | ".join(n if n == "textbook" else f"`_{n}`" for n in names) + " |",
        "|---|" + "---:|" * len(names),
    ]
    for name, times in found.items():
        cells = (f"{times[key]:.2f}" if key in times else "" for key in names)
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    if page is None:
        print("\n".join(lines))
    else:
        write_section("kinematics in c", "\n".join(lines), page)


if __name__ == "__main__":
    main(sys.argv[1:])
