# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin check``: recordings against the model, one or a folder of them."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import NOT_JUDGED, REFUSED, SALVAGED, RecordingOptions, TimedPayloadOptions, payload_fact
from pkm_twin.console import draw_progress
from pkm_twin.errors import ParameterError, PkmTwinError, one_line
from pkm_twin.report import Fact, Report, Verdict
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, kw_only=True)
class Check(TimedPayloadOptions, RecordingOptions):
    """Compare a recording, or a folder of them, with the model.

    Checks that the file is complete, that a node would accept every joint state and wrench, that
    no samples are missing, that positions and velocities belong to one moving machine, that joints
    stay inside their limits and away from singularities, and that the measured efforts agree with
    the model. If they do not, an explanation is named only if it makes them agree. An item without
    data, as of a bag without CRCs, is not judged, which is neither good nor bad. The recording is
    not judged if its efforts have no verdict: there are none, they are NaN, too few can be
    compared, the robot has no masses, or the model computed them, as in a table of `torques`.

    Exit code 0: good. 1: bad, or no recording. 3: the file is damaged, but `pkm-twin recover` can
    save part of it. 4: not judged. Of a folder: 1 if a recording is bad, else 4 if one is not
    judged.
    """

    bag: Path = setting(..., "a bag: an MCAP file or a rosbag2 folder; a table; or a folder of bags", argument=True)
    robot: str | None = setting(  # type: ignore[assignment]  # an argument of other commands
        None, "a robot's name or file; default: the robot that the recording names"
    )
    residual: float = setting(
        0.05, "largest good RMS residual of the efforts, as a fraction of the peak", low=0.0, high=1.0
    )
    history: Path | None = setting(None, "also append the results to this file, for `pkm-twin trend`")
    machine_name: str | None = setting(None, "name in the history; default: the robot's", name="machine")
    jobs: int = setting(1, "processes for a folder of bags", low=1, high=10**4)


@command("Recordings")
def check(given: Check) -> Report:
    """Judge a recording, or all of a folder."""
    from pkm_twin.recordings.bags import is_collection

    if is_collection(given.bag):
        return _check_folder(given)
    try:
        with draw_progress("reading", None) as update:
            return check_one(given, given.bag, update)
    except PkmTwinError as error:
        if isinstance(error, ParameterError) and error.field.startswith("--") and error.value:
            raise  # the option's value is wrong, not the recording
        facts = [Fact("bag", str(given.bag)), Fact("good", False), Fact("salvageable", error.salvageable)]
        return Report(facts=facts, code=SALVAGED if error.salvageable else REFUSED, error=str(error))


def check_one(given: Check, path: Path, update: Callable[[int], None] | None = None, thorough: bool = True) -> Report:
    """Judge a recording, and append it to the history; errors as of ``recordings.read``."""
    from pkm_twin import load
    from pkm_twin.apps.fit_report import tabulate_causes
    from pkm_twin.identification.check import check as judge_recording

    if given.history is not None:
        from pkm_twin.identification.history import append_recording, check_file

        check_file(given.history)
    robot: str | Robot | None = given.robot
    if any(given.part.values()):
        if given.robot is None:
            raise ParameterError("--robot", None, "a file, for --platform, --base and the like")
        robot = load(given.robot, **given.part)
    r = given.read(path, robot, update, limited=True, trajectory=True)
    found = judge_recording(r, given.residual, thorough)
    good = found.answer == "good"
    if given.history is not None:
        append_recording(given.history, r, path, good, given.machine_name)
    why, findings = "; ".join(found.causes), "; ".join(found.findings)
    verdict = {"good": Verdict.GOOD, "bad": Verdict.BAD}.get(found.answer, Verdict.UNKNOWN)
    none = "uncertainty: none in the robot file, so the model has no uncertainty band"
    return Report(
        found.summary,
        [
            Fact("causes", found.causes, text="explanation" if why else None, shown=why),
            Fact("findings", found.findings, shown=findings, text="`fit` finds" if findings else None),
            Fact("hint", found.hint or None, text="hint" if found.hint else None, shown=found.hint),
            Fact("bag", str(r.source)),
            Fact("robot", r.robot.name, text="robot"),
            Fact("topics", asdict(r.topics), text="topics", shown=str(r.topics)),
            payload_fact(r.load),
            *found.items,
            Fact("uncertainty", found.bands or None),
            Fact("answer", found.answer),
            Fact("not_judged", found.unjudged or None),
            Fact("good", good),
            Fact("residuals", found.residuals),
            Fact("samples", len(r.time)),
            Fact("duration_s", float(r.time[-1]), "s"),
            Fact("delay_s", None if found.compared is None else found.compared.late, "s"),
        ],
        tabulate_causes([found.explanation] if found.explanation else [], [r.name]),
        notes=[] if r.robot.uncertainty else [none],
        verdict=verdict,
        code={Verdict.GOOD: 0, Verdict.BAD: REFUSED}.get(verdict, NOT_JUDGED),
    )


def _check_safely(given: Check, path: Path) -> dict[str, Any]:
    """Judge a recording of a folder; return plain data, of a damaged file its error."""
    try:
        return check_one(given, path, thorough=False).data
    except (PkmTwinError, OSError) as error:
        return {"bag": str(path), "good": False, "error": one_line(str(error))}


def _check_folder(given: Check) -> Report:
    """Judge all recordings of a folder."""
    from pkm_twin.recordings.bags import list_bags

    paths, results = list_bags(given.bag), list[dict[str, Any]]()
    each, jobs = partial(_check_safely, given), min(given.jobs, len(paths))
    with draw_progress("checking", len(paths)) as update, ExitStack() as stack:
        run: Callable[..., Iterable[dict[str, Any]]] = map
        if jobs > 1:
            pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))
            run = stack.enter_context(pool).map
        for result in run(each, paths):
            results.append(result)
            update(len(results))
    notes = []
    for result in results:
        bad = [item["what"] for item in result.get("items", ()) if item["verdict"] == "bad"]
        because = ", ".join(bad) or result.get("not_judged")
        why = result.get("error") or f"{result['answer']}{f': {because}' if because else ''}"
        notes.append(f"{result['bag']}: {why}")
    count = sum(not result["good"] for result in results)
    unjudged = sum(result.get("answer") == "not judged" for result in results)
    answer = f"{len(results)} recordings, {count - unjudged} bad"
    answer += f", {unjudged} not judged" if unjudged else ""
    return Report(
        answer if count else f"{len(results)} good",
        [Fact("folder", str(given.bag)), Fact("good", not count), Fact("recordings", results)],
        notes=notes,
        verdict=Verdict.BAD if count > unjudged else Verdict.UNKNOWN if count else Verdict.GOOD,
        code=NOT_JUDGED if count and count == unjudged else 0,
    )
