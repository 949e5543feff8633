# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
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
    told, single, batch = {}, {}, {}
    for entry in data["benchmarks"]:
        extra = entry["extra_info"]
        if "samples" not in extra:
            told.setdefault(extra["what"], []).append(extra)
            continue
        times = single if extra["samples"] == 1 else batch
        # The largest batch is the last one.
        times[extra["what"]] = entry["stats"]["median"] * 1e6 / extra["samples"]
    lines = [
        f"Made by `make bench` on {data['datetime'][:10]}: {cpu.get('brand_raw', 'unknown CPU')}, "
        f"{cpu['count']} cores shared with other work, Python "
        f"{data['machine_info']['python_version']}, one thread, medians, public Python API.",
        "",
        *ratios(single),
        "",
        "| what | one sample (µs) | in a batch of 100,000 (µs per sample) |",
        "|---|---:|---:|",
    ]
    for what, one in single.items():
        each = f"{batch[what]:.3g}" if what in batch else ""
        lines.append(f"| {what} | {one:.3g} | {each} |")
    for trip in told.get("round trip", []):
        lines += round_trip(trip)
    lines += [""]
    for minute in told.get("minute", []):
        lines.append(
            f"- A minute at 1 kHz, executor `{minute['executor']}`: "
            f"{minute['sent']} sent, {minute['sent'] - minute['answered']} not answered."
        )
    for start in told.get("first answer", []):
        lines.append(
            "- From the start of the process to the first torque, caches warm: "
            f"{statistics.median(start['seconds']):.2f} s."
        )
    lines += [design(one) for one in told.get("design", [])]
    write_section("calls", "\n".join(lines), Path(target))


def ratios(single):
    """What the times of the table are to each other."""
    lines = ["| ratio | |", "|---|---:|"]
    for robot in ("delta", "delta_cu"):
        ours = single[f"inverse_dynamics({robot})"]
        bare = single[f"Pinocchio, bare rnea of the tree ({robot})"]
        lines.append(f"| Pinocchio's bare `rnea` of the tree, over `inverse_dynamics` ({robot}) | {bare / ours:.1f} |")
    return lines


def design(one):
    """The line of a design and its rival."""
    ratio = one["others_seconds"] / one["seconds"]
    return (
        "- `pkm-twin design` finds two lengths of the Delta with the least peak effort on a "
        f"pick-and-place path: {one['best']:.5f} N m in {one['seconds']:.2f} s of processor time. "
        f"Nelder-Mead that compiles each of {one['compiled']} machines finds "
        f"{one['others_best']:.5f} N m in {one['others_seconds']:.1f} s, {ratio:.0f} times as long."
    )


def round_trip(trip):
    """The table of one."""
    priority = "at real-time priority" if trip["real_time"] else "at normal priority"
    lines = [
        "",
        "Round trip over DDS at 1 kHz, from `joint_states` to `~/joint_torques`. Ratios are to "
        "`echo`, a node that sends the message back with the same executor. Medians of "
        f"{trip['slices']} slices of each in turn, {priority}; processor time of all threads.",
        "",
        "| node | ratios of p50, p99, CPU | p50 (µs) | p99 (µs) | CPU per message (µs) |",
        "|---|---|---:|---:|---:|",
    ]
    missed = []
    for name, f in trip["figures"].items():
        beside = ", ".join(f"{x:.2f}" for x in trip["ratios"].get(name, {}).values())
        lines.append(f"| {name} | {beside} | {f['p50_us']:.0f} | {f['p99_us']:.0f} | {f['cpu_us']:.0f} |")
        bounds = dict(zip(trip["ratios"].get(name, {}), BOUNDS, strict=False))
        missed += [f"{what} of {name}" for what, most in bounds.items() if trip["ratios"][name][what] > most]
    told = "The targets of the ratios are 1.10, 1.2 and 1.2; " + (
        f"not met: {', '.join(missed)}." if missed else "all are met."
    )
    return [*lines, "", told.replace("_us", "")]


if __name__ == "__main__":
    main(*sys.argv[1:])
