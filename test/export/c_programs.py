# SPDX-License-Identifier: Apache-2.0
"""Exported C, compiled and run: a process of its own for each function of a package."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from delta_dynamics import forward_dynamics, inverse_dynamics, mass_matrix
from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from stiffness_monitor import platform_response
from test.support.robots import has

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
SANITIZED = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


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
    if has(robot, "massive"):
        result["torques"] = lambda q, qd, qdd, w: inverse_dynamics(robot, q, qd, qdd, w)
        result["torques_and_singularity"] = lambda q, *rest: np.column_stack(
            [result["torques"](q, *rest), robot.singularity(q)]
        )
        result["mass_matrix"] = lambda q: flat(mass_matrix(robot, q))
        result["accelerations"] = lambda q, qd, tau, w: forward_dynamics(robot, q, qd, tau, w)
    if has(robot, "structure"):
        none = np.zeros(6)
        result["compliance"] = lambda q: flat(platform_response(robot, q, none).compliance)
        result["strain_energy"] = lambda q, w: platform_response(robot, q, w).energies
    return result


def inputs_of(robot: Robot, motion: tuple[Array, ...]) -> dict[str, tuple[Array, ...]]:
    """Arguments of all of these by a motion: q, qd, qdd and wrenches; efforts are those of qdd."""
    q, qd, qdd, wrench = motion
    result = dict.fromkeys(functions(robot), (q,))
    if "inverse" in result:
        result["inverse"] = (robot.try_forward(q)[0],)
    if "torques" in result:
        result["torques"] = result["torques_and_singularity"] = motion
        result["accelerations"] = (q, qd, 0.1 * qdd, wrench)
    if "strain_energy" in result:
        result["strain_energy"] = (q, wrench)
    return result


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
        for takes, gives, name in re.findall(
            rf"([\w\[\], ]+) -> ([\w\[\], ]+)\. \*/ int {self.prefix}_(\w+)\(", plain
        ):
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
                    f"if (fread({n}, sizeof(double), {k}, stdin) != {k}) {{ return 8; }}"
                    for n, k in ins
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
        name = re.sub(r"\W", "_", " ".join((compiler, *flags)))
        program = self.folder / f"driver{name}"
        if not program.exists():
            sources = [f"{self.prefix}.c", "driver.c"]
            command = [compiler, "-std=c99", *flags, *sources, "-o", program.name, "-lm"]
            subprocess.run(command, cwd=self.folder, check=True)
        return program

    def run(self, program: Path, name: str, *inputs: Array) -> tuple[Array, Array]:
        """Status (count,) and outputs side by side (count, size) of rows of inputs."""
        rows = np.ascontiguousarray(np.concatenate(inputs, 1), np.float64)
        number = list(self.heads).index(name)
        command = [str(program), str(number), str(len(rows))]
        # The sanitizers' runtime has to be the first library.
        environment = {k: v for k, v in os.environ.items() if k != "LD_PRELOAD"}
        found = subprocess.run(
            command, input=rows.tobytes(), env=environment, capture_output=True, check=False
        )
        assert not found.returncode, found.stderr.decode()
        table = np.frombuffer(found.stdout).reshape(len(rows), -1)
        return table[:, 0], table[:, 1:]
