# SPDX-License-Identifier: Apache-2.0
"""pytest-benchmark's JSON as docs/benchmarks.md: ``python -m test.benchmarks.report IN OUT``."""

import json
import sys
from pathlib import Path

TARGETS = """
Targets: one torque sample at most 2 us, 0.15 us a sample in a batch, one strain energy at most
25 us, the node's p50 within 1.25 of the echo's. Missed are the first two, and the last: checking a
message, its singularities and jumps, the fit and the torque are about 50 us of Python beside the
echo's work.
"""


def main(source, target):
    data = json.loads(Path(source).read_text())
    cpu = data["machine_info"]["cpu"]
    lines = [
        "# Benchmarks",
        "",
        f"Made by `make bench` on {data['datetime'][:10]}: {cpu.get('brand_raw', 'unknown CPU')}, "
        f"{cpu['count']} cores shared with other work, Python "
        f"{data['machine_info']['python_version']}, one thread. The median of each; machines and "
        "their load differ, so read the ratios. All through the public Python API.",
        "",
        "| what | samples a call | us a call | us a sample |",
        "|---|---:|---:|---:|",
    ]
    trip = None
    for entry in data["benchmarks"]:
        extra = entry["extra_info"]
        if extra["what"] == "round trip":
            trip = extra
            continue
        median = entry["stats"]["median"] * 1e6
        count = extra["samples"]
        lines.append(f"| {extra['what']} | {count} | {median:.3g} | {median / count:.3g} |")
    if trip is not None:
        ratios = trip["ratios"]
        lines += [
            "",
            "Round trip over DDS at 1 kHz, `joint_states` to `~/joint_torques`, beside a node that "
            f"sends the same message back: {len(ratios)} slices of either in turn, medians.",
            "",
            "| node | p50 (us) | p99 (us) |",
            "|---|---:|---:|",
        ]
        for name, p50 in trip["p50_us"].items():
            lines.append(f"| {name} | {p50:.0f} | {trip['p99_us'][name]:.0f} |")
        lines += [
            "",
            f"The node's p50 to the echo's: {ratios[len(ratios) // 2]:.2f} "
            f"({ratios[0]:.2f} to {ratios[-1]:.2f} in single slices).",
        ]
    Path(target).write_text("\n".join(lines) + "\n" + TARGETS)


if __name__ == "__main__":
    main(*sys.argv[1:])
