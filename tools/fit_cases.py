# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Measure the answers of `fit` and `check` for recordings with a known cause.

    python -m tools.fit_cases run OUT.jsonl [PART PARTS]    append what this tree says of each case
    python -m tools.fit_cases table OUT.jsonl [OUT.jsonl]   print confusion and coverage of each

The cases: recordings of the tests' generators (sound ones, one usual error, one cause, recordings
that no machine makes, poor samples), sixty drawn conditions, and machines with errors of usual
size. Cases that the file already has are skipped.
"""

from __future__ import annotations

import json
import re
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.check import check
from pkm_twin.identification.friction_laws import fit_recordings
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.recordings import Recording
from pkm_twin.robot.robot import Robot
from test.identification.machines import (
    IMPOSSIBLE,
    WRONG,
    Drawn,
    machine,
    noisy,
    of_prior,
    shifted,
    unit_of,
)
from test.laws.test_fit import truths
from test.machine.random_machines import variant
from test.support.robots import load

KINDS: Any = ("friction", "payload")
SHIPPED: Final = ("delta", "delta_cu", "five_bar", "linear_delta", "prru", "rps3", "upr_rpu")
MACHINES: Final = (*SHIPPED, "stewart", "machines/rsur", "machines/prru3", "machines/rcuu")
SMALL_MACHINES: Final = ("delta", "five_bar", "linear_delta", "prru", "upr_rpu")
POOR_CONDITIONS: Final = ("noise of 5 %", "coarse encoder", "repeated samples", "slow motion")
ONE_CAUSE: Final = {
    "all negated": (-1.0, "all"),
    "one negated": (-1.0, "one"),
    "half": (0.5, "all"),
    "one at 0.8": (0.8, "one"),
    "all at 1.25": (1.25, "all"),
    "one doubled": (2.0, "one"),
}
Case = tuple[str, str, str]

TRUTHS: Final = {
    "efforts_negated": "sign",
    "one_effort_negated": "sign",
    "positions_negated": "positions",
    "one_position_negated": "positions",
    "one_joint_negated": "positions",
    "time_reversed": "unknown",
    "efforts_reversed": "unknown",
    "effort_columns_swapped": "exchanged",
    "effort_columns_rolled": "exchanged",
    "position_columns_swapped": "exchanged",
    "columns_taken_for_each_other": "unknown",
    "milliseconds": "time",
    "seconds_for_milliseconds": "time",
    "half_speed": "time",
    "kgf_cm": "scale",
    "newton_millimetres": "scale",
    "kilogram_force": "scale",
    "three_times": "scale",
    "a_third": "scale",
    "motor_side": "scale",
    "degrees": "positions",
    "radians_for_degrees": "positions",
    "millimetres": "positions",
    "efforts_late": "delay",
    "one_effort_late": "delay",
    "efforts_shuffled": "unknown",
    "noise_for_efforts": "unknown",
    "all negated": "sign",
    "one negated": "sign",
    "half": "scale",
    "one at 0.8": "scale",
    "all at 1.25": "scale",
    "one doubled": "scale",
    "picked payload": "payload",
    "scale and payload": "scale",
    "wrench turned": "force",
    "unknown push": "unknown",
    "late": "delay",
    "one late": "delay",
    "another machine": "unknown",
    "play": "play",
}
"""True cause of each faulty case; all other cases are sound."""
ANSWER_WORDS: Final = (
    ("play between the joint", "play"),
    ("positions of this machine", "positions"),
    ("positions and efforts of", "positions"),
    ("positions of", "positions"),
    ("positions are", "positions"),
    ("have the wrong sign", "sign"),
    ("are exchanged", "exchanged"),
    ("another order", "exchanged"),
    (" times what", "scale"),
    (" s late", "delay"),
    (" s early", "delay"),
    ("time runs backwards", "unknown"),
    ("the motion was", "time"),
    ("the time is", "time"),
    ("show no motion", "time"),
    ("wrench", "force"),
    ("payload of", "payload"),
    ("no machine like", "unknown"),
    ("something else", "force"),
    ("predict the held-out", "no gain"),
    ("held-out", "no gain"),
    ("too few samples", "too little"),
    ("too short", "too little"),
    ("no excitation", "too little"),
)
"""Phrases of an answer, and the cause that each names."""


def find_robot(name: str) -> Robot:
    """Load a robot of the shipped files, of the tests' machines, or of random dimensions."""
    kind, _, rest = name.partition(" ")
    if kind == "random":
        return robot_of_data(variant(rest, np.random.default_rng(len(rest))), rest)
    kind, _, rest = name.partition("/")
    return load(f"test/machine/machines/{rest}.yaml" if rest else kind)


@cache
def draw(name: str, seed: int, seconds: float = 12.0) -> Drawn:
    """Draw a machine with friction and payload, and its motion."""
    return machine(find_robot(name), np.random.default_rng([seed, *name.encode()]), seconds)


def slow_down(m: Drawn, factor: float) -> Drawn:
    """Return the motion with ``factor`` times the duration."""
    qd, qdd = m.qd / factor, m.qdd / factor**2
    return Drawn(m.robot, m.truth, factor * m.time, m.q, qd, qdd, inverse_dynamics(m.truth, m.q, qd, qdd))


def repeat_samples(r: Recording, every: int) -> Recording:
    """Let some samples repeat the one before, as a slow bus does."""
    some = np.arange(len(r.time))
    some[5:-5:every] -= 1
    return replace(r, q=r.q[some], effort=r.measured[some]).without_repeats


def make_single(name: str, what: str) -> tuple[Robot, Recording, Robot]:
    """Return a recording with one cause; the file has the friction, the payload is known."""
    m = machine(find_robot(name), np.random.default_rng([3, *name.encode()]), 8.0, 200.0)
    rubs = {k: getattr(m.truth.friction, k).tolist() for k in ("viscous", "coulomb")}
    robot = truth = m.robot.changed(friction=rubs)
    factor, which = ONE_CAUSE.get(what, (1.0, "all"))
    if what.startswith("payload"):
        truth = robot.changed(payload={"mass": float(what[8:]) + robot.payload.mass})
    factors = np.ones(robot.joints_count)
    factors[slice(None) if which == "all" else slice(0, 1)] = factor
    effort = factors * inverse_dynamics(truth, m.q, m.qd, m.qdd)
    return robot, noisy(m.recorded(effort=effort), np.random.default_rng(8)), truth


def make_event(name: str, what: str) -> tuple[Robot, Recording, Robot]:
    """Return a recording in which something acts for a while, or late."""
    m, rng = draw(name, 4), np.random.default_rng(7)
    light = m.truth.changed(payload={"mass": 0.0, "inertia": [0.0] * 3})
    motion, robot, wrench = (m.q, m.qd, m.qdd), m.robot, None
    bare, loaded = (inverse_dynamics(one, *motion) for one in (light, m.truth))
    picked = ((m.time > 5.0) & (m.time < 9.0))[:, None]
    effort = loaded
    if what == "picked payload":
        effort = np.where(picked, loaded, bare)
    elif what == "scale and payload":
        effort = 0.5 * loaded
    elif what in ("wrench turned", "unknown push"):
        force = np.zeros((len(m.time), 6))
        force[:, 2] = -5.0 * np.sin(2 * np.pi * 0.7 * m.time)
        effort = inverse_dynamics(m.truth, *motion, force)
        wrench = -force if what == "wrench turned" else None
    elif what == "late":
        effort = shifted(loaded, m.time, 0.08)
    else:
        effort = loaded.copy()
        effort[:, 0] = shifted(loaded, m.time, 0.08)[:, 0]
    return robot, noisy(replace(m.recorded(effort=effort), wrench=wrench), rng), m.truth


def make_drawn(name: str, what: str) -> tuple[Robot, Recording, Robot]:
    """Return a recording of a machine with usual lengths, in drawn conditions."""
    seed, _, cause = what.partition(" ")
    rng = np.random.default_rng([int(seed), 99])
    m = of_prior(find_robot(name), rng)
    m = slow_down(m, float(np.exp(rng.uniform(np.log(0.6), np.log(3.0)))))
    noise, steps = np.exp(rng.uniform(np.log([3e-3, 3e3]), np.log([0.05, 1e5])))
    made, robot = m.recorded(), m.robot
    if cause == "another machine":
        others = (find_robot(one) for one in ("linear_delta", "delta", "prru", "five_bar"))
        robot = next(one for one in others if one.joints_count == len(m.size) and one.name != robot.name)
    elif cause == "play":
        # Backlash at the encoder: the position follows one flank or the other.
        gap = 5e-3 * unit_of(robot)
        made = replace(made, q=m.q + 0.5 * gap * np.sign(m.qd))
    elif cause == "small delay":
        made = replace(made, effort=shifted(m.efforts, m.time, rng.uniform(-0.02, 0.02)))
    made = noisy(made, rng, noise, steps)
    if cause == "repeats":
        made = repeat_samples(made, 200)
    if cause in IMPOSSIBLE:
        made = IMPOSSIBLE[cause](made, rng)
    return robot, replace(made, robot=robot), m.truth


def make_usual(name: str, what: str) -> tuple[Robot, Recording, Robot]:
    """Return a recording of a machine with all errors of usual size: lengths, gains, zeros."""
    rng = np.random.default_rng([int(what), 41])
    m = of_prior(find_robot(name), rng)
    n = len(m.size)
    effort = m.efforts * (1.0 + 0.02 * rng.normal() + 0.02 * rng.normal(size=n))
    q = m.q + 2e-3 * unit_of(m.robot) * rng.normal(size=n)
    return m.robot, noisy(m.recorded(q=q, effort=effort), rng), m.truth


def make_lengths(name: str, what: str) -> tuple[Robot, Recording, Robot]:
    """Return a recording of a machine whose lengths alone are off, by what is usual."""
    rng = np.random.default_rng([int(what), 77])
    m = of_prior(find_robot(name), rng)
    return m.robot, noisy(m.recorded(), rng), m.truth


def make_tested(name: str, what: str) -> tuple[Robot, Recording, Robot]:
    """Return a recording of the tests: sound, with a usual error, or made by no machine."""
    seed = 5 if what in IMPOSSIBLE else 3
    m, rng = draw(name, seed), np.random.default_rng([seed, 17])
    made = noisy(WRONG[what](m, rng) if what in WRONG else m.recorded(), rng)
    return m.robot, IMPOSSIBLE[what](made, rng) if what in IMPOSSIBLE else made, m.truth


def make_poor(name: str, what: str) -> tuple[Robot, Recording, Robot]:
    """Return a recording with noise, a coarse encoder, repeated samples or a slow motion."""
    how, _, cause = what.partition(": ")
    m, rng = draw(name, 6), np.random.default_rng([6, 17])
    m = slow_down(m, 4.0) if how == "slow motion" else m
    made = WRONG[cause](m, rng) if cause in WRONG else m.recorded()
    made = noisy(made, rng, 0.05 if how.startswith("noise") else 0.01, 4e3 if how.startswith("coarse") else 1e5)
    made = IMPOSSIBLE[cause](made, rng) if cause in IMPOSSIBLE else made
    return m.robot, repeat_samples(made, 25) if how.startswith("repeated") else made, m.truth


MAKERS: Final[dict[str, Callable[[str, str], tuple[Robot, Recording, Robot]]]] = {
    "tests": make_tested,
    "single": make_single,
    "event": make_event,
    "poor": make_poor,
    "drawn": make_drawn,
    "lengths": make_lengths,
    "usual": make_usual,
}


def list_cases() -> Iterator[Case]:
    """Yield the group, machine and condition of each case."""
    tests = [(n, w) for n in MACHINES for w in ("sound",)]
    tests += [(n, w) for n in SMALL_MACHINES for w in (*WRONG, *IMPOSSIBLE)]
    single = [(n, w) for n in MACHINES for w in (*ONE_CAUSE, "payload 0.2", "payload 5")]
    event = [
        (n, w)
        for n in ("delta", "five_bar", "prru", "delta_cu")
        for w in ("picked payload", "scale and payload", "wrench turned", "unknown push", "late", "one late")
    ]
    poor = [
        (n, f"{q}: {w}")
        for n in ("delta", "five_bar", "linear_delta")
        for q in POOR_CONDITIONS
        for w in ("sound", "one_effort_negated", "half_speed", "three_times", "effort_columns_swapped", "gain")
    ]
    drawn = list[tuple[str, str]]()
    names = ("delta_cu", "five_bar", "linear_delta", "prru", "upr_rpu", "random five_bar")
    causes = (
        "sound",
        "slow sound",
        "small delay",
        "repeats",
        "play",
        "another machine",
        "one_effort_negated",
        "three_times",
        "effort_columns_swapped",
        "efforts_late",
    )
    drawn = [(n, f"{6 * i + k} {c}") for i, c in enumerate(causes) for k, n in enumerate(names)]
    lengths = [(n, str(s)) for s in range(4) for n in MACHINES]
    usual = [(n, str(s)) for s in range(4) for n in MACHINES]
    groups = {
        "lengths": lengths,
        "drawn": drawn,
        "tests": tests,
        "usual": usual,
        "single": single,
        "event": event,
        "poor": poor,
    }
    yield from ((group, *one) for group, cases in groups.items() for one in cases)


def say_cause(text: str) -> str:
    """Return the cause that an answer names."""
    return next((cause for words, cause in ANSWER_WORDS if words in text), "other")


def answer_case(case: Case) -> dict[str, Any]:
    """Return what `fit` and `check` say of a case, and the fitted numbers' errors."""
    group, name, what = case
    begin = time.process_time()
    try:
        robot, r, truth = MAKERS[group](name, what)
    except (PkmTwinError, ValueError, AssertionError, StopIteration) as error:
        return {"case": case, "skipped": str(error)}
    r, found = replace(r, robot=robot), dict[str, Any]()
    try:
        result, _, notes = fit_recordings(robot, [r], KINDS, ())
        true = truths(truth, KINDS) if truth.name == robot.name else {}
        found |= {
            "fit": result.verdict.answer,
            "notes": notes,
            "findings": [str(one) for one in result.verdict.findings],
            "numbers": [
                (n.name, n.before, n.after, n.deviation, true[n.name], n.status)
                for n in result.numbers
                if n.name in true
            ],
            "held out": [[one.rms(one.before).tolist(), one.rms(one.after).tolist()] for one in result.judged],
        }
    except PkmTwinError as error:
        found |= {"fit": "rejected", "notes": [str(error)]}
    middle = time.process_time()
    try:
        seen = check(r)
        found |= {"check": seen.answer, "causes": [*seen.causes, *seen.findings]}
    except PkmTwinError as error:
        found |= {"check": "error", "causes": [str(error)]}
    times = middle - begin, time.process_time() - middle
    return {"case": case, **found, "seconds": times}


def judge_case(found: dict[str, Any]) -> tuple[str, str, str, str]:
    """Return the true cause, what `fit` and what `check` name, and a verdict on `fit`."""
    _, _, what = found["case"]
    true = next((t for w, t in TRUTHS.items() if re.search(rf"(^|[ :]){w}$", what)), "sound")
    if found["case"][0] == "event" and what == "late":
        true = "delay"
    said = "sound" if found["fit"] != "rejected" else say_cause(found["notes"][0])
    if said == "sound" and true == "payload" and any("held" in n for n in found["notes"]):
        said = "payload"
    checked = "sound" if found["check"] == "good" else "not judged"
    if found["check"] == "bad":
        checked = say_cause(found["causes"][0]) if found["causes"] else "bad, no cause"
    verdict = "right" if said == true else "wrong cause"
    if said in ("no gain", "too little"):
        verdict = "fit keeps the file"
    elif said != true and said == "sound":
        verdict = "accepted" if found["fit"] == "explains" else "doubted"
    elif said != true and true == "sound":
        verdict = "false alarm"
    elif said != true and said in ("unknown", "other"):
        verdict = "rejected without its cause"
    return true, said, checked, verdict


def print_tables(paths: list[str]) -> None:
    """Print confusion and coverage of each file, of the cases that all of them have."""
    files = [
        {tuple(one["case"]): one for one in map(json.loads, Path(p).read_text().splitlines()) if "skipped" not in one}
        for p in paths
    ]
    common = sorted(set.intersection(*(set(one) for one in files)))
    judged = [{c: judge_case(one[c]) for c in common} for one in files]
    for path, one, marks in zip(paths, files, judged, strict=True):
        print(f"\n{path}: {len(common)} cases")
        totals = defaultdict[str, Counter[str]](Counter)
        for c in common:
            totals[c[0]][marks[c][3]] += 1
        for group, counter in totals.items():
            print(f"  {group:8}", dict(counter.most_common()))
        confusion = defaultdict[str, Counter[str]](Counter)
        for c in common:
            confusion[marks[c][0]][marks[c][1]] += 1
        for true, counter in sorted(confusion.items()):
            print(f"  truth {true:10}", dict(counter.most_common()))
        apart = [
            c
            for c in common
            if (found := marks[c])[1] != found[2] and not {"no gain", "too little", "not judged"} & set(found[1:3])
        ]
        print(f"  fit and check differ: {len(apart)}")
        print_coverage({c: one[c] for c in common})
        times = np.array([one[c]["seconds"] for c in common])
        print(
            f"  CPU seconds, median: fit {np.median(times[:, 0]):.2f}, "
            f"check {np.median(times[:, 1]):.2f}; sum {times.sum():.0f}"
        )
    for c in common:
        if any(marks[c][3] != "right" for marks in judged):
            print(c, *(f"| {m[c][3]}: {m[c][1]} / {m[c][2]}" for m in judged))


def print_coverage(found: dict[Any, dict[str, Any]]) -> None:
    """Print the part of the fitted numbers within 1, 2, 3 deviations of the truth."""
    for groups in (["lengths"], ["usual"], ["drawn"], ["tests", "poor"], ["lengths", "usual"]):
        z, size = list[float](), list[float]()
        for (group, *_), one in found.items():
            if group not in groups or judge_case(one)[0] != "sound":
                continue
            for _, before, after, deviation, true, status in one.get("numbers", ()):
                if status != "not excited" and np.isfinite(deviation):
                    z.append((after - true) / deviation)
                    size.append(abs(after - true) / max(abs(before - true), 1e-12))
        if z:
            inside = [f"{100 * np.mean(np.abs(z) <= k):.1f}" for k in (1, 2, 3)]
            print(
                f"  {' and '.join(groups):18} {len(z):4} numbers, within 1, 2, 3 deviations "
                f"{', '.join(inside)} %; RMS z {np.sqrt(np.mean(np.square(z))):.2f}, largest "
                f"{np.abs(z).max():.1f}; median error over the file's "
                f"{np.median(size):.3f}"
            )


def main(args: list[str]) -> None:
    """Run the cases, or print their tables."""
    if args[0] == "table":
        print_tables(args[1:])
        return
    out, part, parts = Path(args[1]), *(int(v) for v in (*args[2:4], 0, 1)[:2])
    done = set[Case]()
    if out.exists():
        done = {tuple(json.loads(line)["case"]) for line in out.read_text().splitlines()}
    with out.open("a") as file:
        for case in chain(list(list_cases())[part::parts]):
            if case not in done:
                print(json.dumps(answer_case(case)), file=file, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
