# SPDX-License-Identifier: Apache-2.0
"""pytest-benchmark's JSON in docs/benchmarks.md: ``python -m test.benchmarks.report IN PAGE``."""

import json
import statistics
import sys
from pathlib import Path

from test.support.pages import write_section

BOUNDS = (1.10, 1.2, 1.2)
"""Most that p50, p99 and processor time may be of the echo's."""


def main(source, target):
    data = json.loads(Path(source).read_text())
    cpu = data["machine_info"]["cpu"]
    lines = [
        f"Made by `make bench` on {data['datetime'][:10]}: {cpu.get('brand_raw', 'unknown CPU')}, "
        f"{cpu['count']} cores shared with other work, Python "
        f"{data['machine_info']['python_version']}, one thread. Times are medians; they depend on "
        "the computer and its load, so compare the ratios. All calls use the public Python API.",
        "",
        "| what | samples per call | us per call | us per sample |",
        "|---|---:|---:|---:|",
    ]
    told = {}
    for entry in data["benchmarks"]:
        extra = entry["extra_info"]
        if "samples" not in extra:
            told.setdefault(extra["what"], []).append(extra)
            continue
        median = entry["stats"]["median"] * 1e6
        count = extra["samples"]
        lines.append(f"| {extra['what']} | {count} | {median:.3g} | {median / count:.3g} |")
    for trip in told.get("round trip", []):
        lines += round_trip(trip)
    lines += [""]
    for minute in told.get("minute", []):
        lines.append(
            f"- A minute at 1 kHz, executor `{minute['executor']}`, queue depth as by default: "
            f"{minute['sent']} sent, {minute['sent'] - minute['answered']} not answered."
        )
    for start in told.get("first answer", []):
        seconds = start["seconds"]
        lines.append(
            "- From the start of the process to the first torque of a running stream, caches "
            "warm: "
            f"{statistics.median(seconds):.2f} s (median of {len(seconds)}, worst "
            f"{max(seconds):.2f})."
        )
    lines += [design(one) for one in told.get("design", [])]
    write_section("calls", "\n".join(lines), Path(target))


def design(one):
    """The line of a design and its rival."""
    ratio = one["others_seconds"] / one["seconds"]
    return (
        "- `pkm-twin design` of the Delta's two lengths for a pick-and-place path, least peak "
        "effort with a singularity index of at least 0.1: "
        f"{one['best']:.5f} N m in {one['seconds']:.2f} s of processor time. "
        "Nelder-Mead that compiles each machine: "
        f"{one['others_best']:.5f} N m in {one['others_seconds']:.1f} s "
        f"({one['compiled']} machines), {ratio:.0f} times as long."
    )


def round_trip(trip):
    """The table of one."""
    priority = "at real-time priority" if trip["real_time"] else "at normal priority"
    lines = [
        "",
        "Round trip over DDS at 1 kHz, `joint_states` to `~/joint_torques`, compared with a node "
        f"that sends the same message back (echo): {trip['slices']} slices of each in turn, "
        f"medians, {priority}. Processor time is that of all threads of the process. Ratios are "
        "relative to the echo with the same executor, slice by slice.",
        "",
        "| node | p50 (us) | p99 (us) | CPU per message (us) | p50, p99, CPU over the echo's |",
        "|---|---:|---:|---:|---|",
    ]
    missed = []
    for name, f in trip["figures"].items():
        beside = ", ".join(f"{x:.2f}" for x in trip["ratios"].get(name, {}).values())
        lines.append(
            f"| {name} | {f['p50_us']:.0f} | {f['p99_us']:.0f} | {f['cpu_us']:.0f} | {beside} |"
        )
        bounds = dict(zip(trip["ratios"].get(name, {}), BOUNDS, strict=False))
        missed += [
            f"{what} of {name}"
            for what, most in bounds.items()
            if trip["ratios"][name][what] > most
        ]
    told = f"Above their targets: {', '.join(missed)}." if missed else "All within their targets."
    return [*lines, "", told.replace("_us", "")]


if __name__ == "__main__":
    main(*sys.argv[1:])
