# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Exported C, compiled and run: a process of its own for each function of a package."""

from __future__ import annotations

import dataclasses
import hashlib
import operator
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from delta_dynamics import (
    forward_dynamics,
    forward_dynamics_at_pose,
    inverse_dynamics,
    inverse_dynamics_at_pose,
    mass_matrix,
    mass_matrix_at_pose,
)
from pkm_twin import Robot, transmission
from pkm_twin.codegen import cache
from pkm_twin.codegen.arrays import Array
from stiffness_monitor import platform_response
from test.support.robots import has

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
STRICT = ("-std=c++17", "-O0", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
"""Of C++."""
CLOSE = {"compliance": 1e-11, "strain_energy": 1e-11}
"""Of the largest value; by default 1e-12. The frame's stiffness has a condition of 1e4 to 1e6."""
PLAIN = ("-O0",)
"""What compiles in a moment."""
ARM64 = ("aarch64-linux-gnu-gcc", "qemu-aarch64")
"""Compiler and emulator."""
REALTIME = next((name for k in range(29, 19, -1) if shutil.which(name := f"clang-{k}")), "")
"""A compiler with RealtimeSanitizer."""
blocking = pytest.mark.parametrize(
    "watcher",
    [
        pytest.param("", marks=pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the hook is of glibc")),
        pytest.param(
            REALTIME,
            id="RealtimeSanitizer",
            marks=[pytest.mark.long, pytest.mark.skipif(not REALTIME, reason="there is no clang 20")],
        ),
    ],
)
"""What watches calls: a hook of our own, or the compiler with RealtimeSanitizer."""
SOURCES = (".c", ".cpp", ".h", ".hpp", ".o")
"""Files that a compiler reads."""
SANITIZED = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def compile_in(folder: Path, *words: str | Path) -> None:
    """Run a compiler in a folder, or take the file that it made of the same sources before.

    The file is kept beside the package's own compiled programs. It is that of the same words, compiler
    and sources: all in the folder, in folders named by ``-I``, and the stand-ins of this folder.

    :raises AssertionError: with what the compiler says.
    """
    said = [str(word) for word in words]
    compiler = Path(shutil.which(said[0]) or said[0]).resolve()
    found = sorted(Path(__file__).parent.glob("*.hpp"))
    for place in (folder, *(Path(word[2:]) for word in said if word.startswith("-I/"))):
        found += sorted(file for file in place.rglob("*") if file.suffix in SOURCES)
    found += [Path(word) for word in said if word.startswith("/") and Path(word).suffix in SOURCES]
    out = folder / said[said.index("-o") + 1] if "-o" in said else None
    contents = [f"{file.name} {hashlib.sha256(file.read_bytes()).hexdigest()}" for file in found if file != out]
    plain = [re.sub(r"^(-I)?/.*/", "", word) for word in said]
    name = cache.digest(str(compiler), str(compiler.stat().st_mtime_ns), *platform.libc_ver(), *plain, *contents)
    kept = cache.read(name)
    if kept is None:
        done = subprocess.run(said, cwd=folder, capture_output=True, text=True, check=False)
        assert not done.returncode, done.stderr
        cache.write(name, {}, out.read_bytes() if out and out.is_file() else b"")
    elif out and out != Path(os.devnull):
        out.write_bytes(kept[1])
        out.chmod(0o755)


def functions(robot: Robot) -> dict[str, Callable[..., Any]]:
    """The Python functions behind those of C, by name, of batches; results (count, size)."""

    def flat(values: Array) -> Array:
        return values.reshape(len(values), -1)

    def placed(q: Array) -> Array:
        position, rotation = robot.platform(q)
        return np.concatenate([position, flat(rotation)], 1)

    result: dict[str, Callable[..., Any]] = {
        "forward": robot.forward,
        "inverse": robot.inverse,
        "platform": placed,
        "jacobian": lambda q: flat(robot.jacobian(q)),
        "platform_jacobian": lambda q: flat(robot.platform_jacobian(q)),
        "singularity": lambda q: robot.singularity(q)[:, None],
    }
    result |= _transmission(robot)
    if has(robot, "massive"):
        result["torques"] = lambda q, qd, qdd, w: inverse_dynamics(robot, q, qd, qdd, w)
        result["torques_moving"] = lambda *given: inverse_dynamics(robot, *given)
        result["torques_and_singularity"] = lambda q, *rest: np.column_stack(
            [result["torques"](q, *rest), robot.singularity(q)]
        )
        result["torques_at_pose"] = lambda pose, *rest: np.column_stack(
            dataclasses.astuple(inverse_dynamics_at_pose(robot, pose, *rest))[:4]
        )
        result["mass_matrix_at_pose"] = lambda pose: flat(mass_matrix_at_pose(robot, pose))
        result["accelerations_at_pose"] = lambda *given: np.column_stack(
            operator.attrgetter("acceleration", "qdd")(forward_dynamics_at_pose(robot, *given))
        )
        result["mass_matrix"] = lambda q: flat(mass_matrix(robot, q))
        result["accelerations"] = lambda q, qd, tau, w: forward_dynamics(robot, q, qd, tau, w)
    if has(robot, "structure"):
        none = np.zeros(6)
        result["compliance"] = lambda q: flat(platform_response(robot, q, none).compliance)
        result["strain_energy"] = lambda q, w: platform_response(robot, q, w).energies
    return result


def _transmission(robot: Robot) -> dict[str, Callable[..., Any]]:
    m = len(robot.pose_names)
    t = transmission(robot.changed(joint_map={}))

    def both(*parts: Array) -> Array:
        return np.concatenate([part.reshape(len(parts[0]), -1) for part in parts], 1)

    def gains(pose: Array, stiffness: Array, damping: Array, tau: Array) -> Array:
        return both(*t.gains(pose, *(a.reshape(-1, m, m) for a in (stiffness, damping)), tau))

    return {
        "joint_to_actuator": lambda *given: both(*dataclasses.astuple(t.joint_to_actuator(*given))),
        "actuator_to_joint": lambda *given: both(*dataclasses.astuple(t.actuator_to_joint(*given))),
        "gains": gains,
    }


def inputs_of(robot: Robot, motion: tuple[Array, ...]) -> dict[str, tuple[Array, ...]]:
    """Arguments of all of these by a motion: q, qd, qdd and wrenches; efforts are those of qdd."""
    q, qd, qdd, wrench = motion
    result = dict.fromkeys(functions(robot), (q,))
    if "inverse" in result:
        result["inverse"] = (robot.try_forward(q)[0],)
    m, pose = len(robot.pose_names), robot.try_forward(q)[0]
    square = np.resize(np.cos(np.arange(997.0)), (len(q), m * m))
    result["joint_to_actuator"] = pose, qd[:, :m], qdd[:, :m]
    result["actuator_to_joint"] = q, qd, qdd
    result["gains"] = pose, square, 0.1 * square, qdd
    if "torques" in result:
        result["torques"] = result["torques_and_singularity"] = motion
        base = np.resize(np.sin(np.arange(101.0)) * 10.0, (len(q), 9))
        result["torques_moving"] = (*motion, base)
        result["accelerations"] = (q, qd, 0.1 * qdd, wrench)
        result["torques_at_pose"] = (pose, qd[:, :m], qdd[:, :m], wrench)
        result["mass_matrix_at_pose"] = (pose,)
        result["accelerations_at_pose"] = (pose, qd[:, :m], 0.1 * qdd, wrench)
    if "strain_energy" in result:
        result["strain_energy"] = (q, wrench)
    return result


HOOK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
extern void *__libc_malloc(size_t);
extern void *__libc_calloc(size_t, size_t);
extern void *__libc_realloc(void *, size_t);
extern void __libc_free(void *);
static int watching;
static long calls, seen;
static int (*own_lock)(pthread_mutex_t *);
void watch(int on) { watching = on; calls += on; }
void *malloc(size_t n) { seen += watching; return __libc_malloc(n); }
void *calloc(size_t k, size_t n) { seen += watching; return __libc_calloc(k, n); }
void *realloc(void *p, size_t n) { seen += watching; return __libc_realloc(p, n); }
void free(void *p) { seen += watching; __libc_free(p); }
int pthread_mutex_lock(pthread_mutex_t *m)
{
    seen += watching;
    if (!own_lock) { *(void **)&own_lock = dlsym(RTLD_NEXT, "pthread_mutex_lock"); }
    return own_lock(m);
}
__attribute__((destructor)) static void report(void) { fprintf(stderr, "%ld %ld", calls, seen); }
"""
"""Counts watched calls, and what they allocate, free and lock."""
SANITIZER = r"""
#include <stdio.h>
void __rtsan_realtime_enter(void);
void __rtsan_realtime_exit(void);
static long calls;
void watch(int on)
{
    calls += on;
    if (on) { __rtsan_realtime_enter(); } else { __rtsan_realtime_exit(); }
}
__attribute__((destructor)) static void report(void) { fprintf(stderr, "%ld 0", calls); }
"""
"""Counts watched calls: the first one that may wait ends the program."""


def hooked(folder: Path, call: str, program: str, *sources: str | Path, watcher: str = "") -> Path:
    """A driver, in which ``call`` is watched: it writes its counts to the standard error.

    :param call: regular expression of an expression in ``program``, a file of C or C++.
    :param watcher: compiler with RealtimeSanitizer; empty, the hook of this file watches.
    """
    linkage = '"C" ' if program.endswith("pp") else ""
    text = (folder / program).read_text()
    watched, count = re.subn(rf"({call});", r"watch(1); \1; watch(0);", text)
    assert count
    changed = f"hooked_{program}"
    (folder / changed).write_text(f"extern {linkage}void watch(int);\n{watched}")
    (folder / "hook.c").write_text(SANITIZER if watcher else HOOK)
    c, cpp = (watcher, watcher.replace("clang", "clang++")) if watcher else (COMPILERS[0], "g++")
    compile_in(folder, c, "-c", "hook.c", "-o", "hook.o")
    compiler = [cpp, "-std=c++17"] if linkage else [c, "-std=c99"]
    compiler += ["-fsanitize=realtime"] * bool(watcher)
    made = folder / "hooked"
    compile_in(folder, *compiler, "-O0", changed, *sources, "hook.o", "-o", "hooked", "-lm", "-ldl")
    return made


def watched(program: Path, rows: Array, *words: str) -> tuple[int, int]:
    """Watched calls, and what they allocated, freed and locked."""
    done = subprocess.run([program, *words], input=rows.tobytes(), capture_output=True, check=True)
    calls, seen = done.stderr.split()
    return int(calls), int(seen)


DRIVER = r"""
#include <stdio.h>
#include <stdlib.h>
#include "@.h"
int main(int count, char **words)
{
    const long rows = atol(words[2]);
    long row;
    (void)count;
    switch (atoi(words[1])) {
CASES
    default: return 9;
    }
    return 0;
}
"""
CASE = r"""
    case NUMBER:
        for (row = 0; row < rows; row++) {
            double DECLARED, status;
            READS
            status = (double)@_NAME(CALL);
            fwrite(&status, sizeof status, 1, stdout);
            WRITES
        }
        break;
"""


class Package:
    """An exported package in a folder, and its compiled programs."""

    def __init__(self, folder: Path, files: Mapping[str, str]) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text)
        (header,) = folder.glob("*.h")
        self.prefix, self.header = header.stem, header.read_text()
        # Of every function its inputs and outputs, by name with sizes, as the header lists them.
        self.heads: dict[str, tuple[list[tuple[str, int]], list[tuple[str, int]]]] = {}
        plain = re.sub(r"\s+", " ", self.header)
        for takes, gives, name in re.findall(rf"([\w\[\], ]+) -> ([\w\[\], ]+)\. \*/ int {self.prefix}_(\w+)\(", plain):
            pair = [re.findall(r"(\w+)\[(\d+)\]", part) for part in (takes, gives)]
            ins, outs = ([(word, int(size)) for word, size in part] for part in pair)
            self.heads[name] = ins, outs
        self._write_driver()

    def _write_driver(self) -> None:
        cases = ""
        for number, (name, (ins, outs)) in enumerate(self.heads.items()):
            words = {
                "NUMBER": str(number),
                "DECLARED": ", ".join(f"{n}[{k}]" for n, k in [*ins, *outs]),
                "READS": " ".join(
                    f"if (fread({n}, sizeof(double), {k}, stdin) != {k}) {{ return 8; }}" for n, k in ins
                ),
                "CALL": ", ".join(n for n, _ in [*ins, *outs]),
                "WRITES": " ".join(f"fwrite({n}, sizeof(double), {k}, stdout);" for n, k in outs),
                "NAME": name,
            }
            case = CASE
            for key, text in words.items():
                case = case.replace(key, text)
            cases += case
        text = DRIVER.replace("CASES", cases).replace("@", self.prefix)
        (self.folder / "driver.c").write_text(text)

    def build(self, *flags: str, compiler: str = "") -> Path:
        """The driver's program with these flags; the same file for the same flags."""
        compiler = compiler or COMPILERS[0]
        if compiler in ARM64:
            flags = *flags, "-static"
        name = re.sub(r"\W", "_", " ".join((compiler, *flags)))
        program = self.folder / f"driver{name}"
        if not program.exists():
            sources = [f"{self.prefix}.c", "driver.c"]
            compile_in(self.folder, compiler, "-std=c99", *flags, *sources, "-o", program.name, "-lm")
        return program

    def run(self, program: Path, name: str, *inputs: Array) -> tuple[Array, Array]:
        """Status (count,) and outputs side by side (count, size) of rows of inputs."""
        rows = np.ascontiguousarray(np.concatenate(inputs, 1), np.float64)
        number = list(self.heads).index(name)
        emulator = ARM64[1:] if ARM64[0] in program.name.replace("_", "-") else ()
        command = [*emulator, str(program), str(number), str(len(rows))]
        # The sanitizers' runtime has to be the first library.
        environment = {k: v for k, v in os.environ.items() if k != "LD_PRELOAD"}
        found = subprocess.run(command, input=rows.tobytes(), env=environment, capture_output=True, check=False)
        assert not found.returncode, found.stderr.decode()
        table = np.frombuffer(found.stdout).reshape(len(rows), -1)
        return table[:, 0], table[:, 1:]
