# SPDX-License-Identifier: Apache-2.0
"""What sweeps cost, written into docs/scale.md: ``python -m test.maps.scale OUT``."""

from __future__ import annotations

import datetime
import itertools
import platform
import sys
import tempfile
import time
from pathlib import Path

import llvmlite
import psutil

from pkm_twin import load
from pkm_twin.maps.kinds import KINDS
from pkm_twin.maps.sweep import map_of

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
RUNS = ((10**6, 2), (10**7, 2), (10**6, 1), (10**7, 1))
"""Poses and processes of the whole commands."""


def rate(kind: str, robot: str, points: int) -> float:
    """Samples a second of processor time, of chunks alone, kernels compiled before."""
    sweep = map_of(load(robot), KINDS[kind](), points)
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


def page() -> str:
    """docs/scale.md."""
    rates = {(kind, robot): rate(kind, robot, points) for kind, robot, points, _ in MEASURED}
    first = "\n".join(
        f"| {what} | {robot} | {power(rates[kind, robot])} |" for kind, robot, _, what in MEASURED
    )
    second = []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "a.nc"
        for points, processes in RUNS:
            seconds, peak = command(points, processes, out)
            who = f"{processes} and the parent" if processes > 1 else "1"
            size = out.stat().st_size / 1e6
            second.append(
                f"| {power(points)} | {who} | {seconds:.0f} s | {peak / 2**20:.0f} MiB | "
                f"{size:.0f} MB |"
            )
        load_1, load_5, _ = psutil.getloadavg()
    speed = rates["strain-energy", "upr_rpu"]
    core_seconds = 1e9 / speed
    gigabytes = size * 1e6 / points
    sweep = map_of(load("upr_rpu"), KINDS["strain-energy"](), 10**6)
    chunk = sweep.chunks()[0]
    # Bytes of a pose are gigabytes of a billion.
    parts = sum(v.nbytes for v in sweep.evaluate(chunk).values()) / sweep.count(chunk)
    disk = (2 * parts + gigabytes) / 0.5 / 60
    template = (Path(__file__).parent / "scale.md").read_text(encoding="utf-8")
    return template.format(
        date=datetime.date.today().isoformat(),
        python=platform.python_version(),
        llvmlite=llvmlite.__version__,
        cores=psutil.cpu_count(),
        load_1=f"{load_1:.1f}",
        load_5=f"{load_5:.1f}",
        first=first,
        second="\n".join(second),
        speed=power(speed),
        core_seconds=f"{core_seconds:.0f}",
        gigabytes=f"{gigabytes:.0f}",
        parts=f"{parts:.0f}",
        both=f"{parts + gigabytes:.0f}",
        two=f"{core_seconds / 2 / 60:.0f}",
        sixteen=f"{core_seconds / 16:.0f}",
        disk=f"{disk:.0f}",
        fast=f"{parts * 8 / 10 / 60:.0f}",
        slow=f"{parts * 8 / 60:.0f}",
    )


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
