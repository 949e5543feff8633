# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What sweeps cost, in docs/benchmarks.md: ``python -m test.maps.scale PAGE``."""

from __future__ import annotations

import datetime
import itertools
import platform
import sys
import time
from pathlib import Path

import llvmlite
import psutil

from pkm_twin import load
from pkm_twin.maps.kinds import KINDS
from pkm_twin.maps.sweep import plan_map
from test.support.pages import write_section

MEASURED = (
    ("strain-energy", "upr_rpu", 10**6, "strain energy (total, nine shares, direction)"),
    ("compliance", "delta_cu", 10**6, "compliance and its direction"),
    ("payload", "delta_cu", 10**6, "payload"),
    ("isotropy", "delta_cu", 10**5, "isotropy (eta_KE and F_max in the worst directions)"),
    ("workspace", "delta_cu", 10**6, "workspace (singularity, clearance)"),
    ("workspace", "stewart", 10**6, "workspace (singularity, clearance)"),
    ("frequency", "delta_cu", 10**4, "first frequency"),
)
SECONDS = 4.0
"""Processor time that a rate is measured over."""


def rate(kind: str, robot: str, points: int) -> float:
    """Samples a second of processor time, of chunks alone, kernels compiled before."""
    sweep = plan_map(load(robot), KINDS[kind](), points)
    chunks = [chunk for chunk in sweep.chunks() if chunk.plane is None]
    sweep.evaluate(chunks[0])
    done, begin = 0, time.process_time()
    for chunk in itertools.cycle(chunks):
        sweep.evaluate(chunk)
        done += sweep.count(chunk)
        spent = time.process_time() - begin
        if spent > SECONDS:
            return done / spent
    raise AssertionError


def command(points: int, processes: int, out: Path) -> tuple[float, int]:
    """Seconds from start to the closed file, and the peak memory (bytes) of all its processes.

    Memory is the sum of proportional set sizes: pages that processes share count once.
    """
    words = ["map", "upr_rpu", "strain-energy", "--points", str(points), "--no-picture"]
    words += ["--out", str(out), "--jobs", str(processes), "--overwrite"]
    begin = time.monotonic()
    process = psutil.Popen([sys.executable, "-m", "pkm_twin.apps.cli", *words])
    peak = 0
    while process.poll() is None:
        total = 0
        try:
            for member in (process, *process.children(recursive=True)):
                total += member.memory_full_info().pss
        except psutil.Error:  # It ended while it was looked at.
            pass
        peak = max(peak, total)
        time.sleep(0.05)
    assert process.returncode == 0
    return time.monotonic() - begin, peak


def power(value: float) -> str:
    """Two digits: 1.4e6."""
    digits, _, exponent = f"{value:.1e}".partition("e")
    return f"{digits}e{int(exponent)}"


def section() -> str:
    """Rates and runs."""
    lines = [
        f"On {datetime.date.today().isoformat()}: {psutil.cpu_count()} cores of a shared machine, "
        f"Python {platform.python_version()}, llvmlite {llvmlite.__version__}, kernels already "
        "compiled. The rates count the processor time of the chunks alone.",
        "",
        "| map | robot | samples per second and core |",
        "|---|---|---|",
    ]
    for kind, robot, points, what in MEASURED:
        lines.append(f"| {what} | {robot} | {power(rate(kind, robot, points))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    write_section("scale", section(), Path(sys.argv[1]))
