# SPDX-License-Identifier: Apache-2.0
"""pytest-benchmark's JSON as docs/benchmarks.md: ``python -m test.benchmarks.report IN OUT``."""

import json
import sys
from pathlib import Path

TARGETS = """
Targets: one torque sample at most 2 us, 0.15 us a sample in a batch, one strain energy at most
25 us, the node's p50 within 1.25 of the echo's. Missed are the first two, and the last: checking a
message, its singularities and jumps, the fit and the torque are work that the echo has not.
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
        lines += [
            "",
            "Round trip over DDS at 1 kHz, `joint_states` to `~/joint_torques`, beside a node that "
            f"sends the same message back: {trip['slices']} slices of each in turn, medians. "
            "Ratios are to the echo with the same executor. Not answered are also the samples that "
            "fill the node's window.",
            "",
            "| node | p50 (us) | p99 (us) | CPU a message (us) | not answered | to the echo |",
            "|---|---:|---:|---:|---:|---|",
        ]
        for name, f in trip["figures"].items():
            beside = ", ".join(f"{x:.2f}" for x in trip["ratios"].get(name, {}).values())
            lines.append(
                f"| {name} | {f['p50_us']:.0f} | {f['p99_us']:.0f} | {f['cpu_us']:.0f} "
                f"| {f['lost']:.0f} | {beside} |"
            )
    Path(target).write_text("\n".join(lines) + "\n" + TARGETS)


if __name__ == "__main__":
    main(*sys.argv[1:])
