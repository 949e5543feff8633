# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin check``: recordings against the twin, one or a folder of them."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from pkm_twin.apps.options import (
    REFUSED,
    SALVAGED,
    BagTopics,
    Json,
    LoadTimes,
    OptionalRobot,
    Payload,
    Platform,
    read_options,
)
from pkm_twin.console import print_json, progress, table_console, tell
from pkm_twin.errors import ParameterError, PkmTwinError, one_line
from pkm_twin.options import OptionalPath, OptionalText
from pkm_twin.threads import one_blas_thread_for_children

if TYPE_CHECKING:
    from pkm_twin.apps.check import Checked
    from pkm_twin.recordings import ReadOptions

METADATA: Final = "metadata.yaml"
"""What makes a folder a rosbag2 bag."""


@dataclass(frozen=True)
class Request:
    """What is judged beside the recording itself, and where it is kept."""

    robot: str | None
    residual: float
    how: ReadOptions
    history: Path | None
    machine: str | None
    platform: str | None = None


def bags_of(folder: Path) -> list[Path]:
    """Recordings in a folder and below: MCAP files and rosbag2 folders, by name."""
    whole = {path.parent for path in folder.rglob(METADATA)}
    files = [p for p in folder.rglob("*.mcap") if not whole & set(p.parents)]
    return sorted([*whole, *files])


def is_collection(path: Path) -> bool:
    """Whether a path is a folder of recordings, not a rosbag2 bag itself."""
    if not path.is_dir() or (path / METADATA).exists():
        return False
    # A bag whose metadata is lost has its files side by side.
    return bool(bags_of(path)) and not any(path.glob("*.db3"))


def check_one(path: Path, request: Request, update: Any = None, thorough: bool = True) -> Checked:
    """Judge a recording, and append it to the history; errors as of ``recordings.read``."""
    from pkm_twin import load
    from pkm_twin.apps.check import Bounds
    from pkm_twin.apps.check_causes import judged
    from pkm_twin.recordings import read

    robot: Any = request.robot
    if request.platform is not None:
        if robot is None:
            raise ParameterError("--robot", None, "a file, for the platform that --platform names")
        robot = load(robot, platform=request.platform)
    recording = read(path, robot, request.how, update)
    report = judged(recording, Bounds(residual=request.residual), thorough)
    if request.history is not None:
        from pkm_twin.apps.history import append, measure, recorded_at

        name = recording.robot.name
        when = recorded_at(recording, path)
        machine = request.machine or name
        append(
            request.history, machine, name, path, when, report.answer == "good", measure(recording)
        )
    return report


def _plain(report: Checked) -> dict[str, Any]:
    r = report.recording
    return {
        "bag": str(r.source), "robot": r.robot.name, "topics": asdict(r.topics),
        "payload": None if r.load is None else r.load.as_json(),
        "items": [asdict(item) for item in report.items], "uncertainty": report.bands or None,
        "answer": report.answer, "not_judged": report.unjudged or None,
        "causes": list(report.causes), "findings": list(report.findings),
        "good": report.answer == "good",
    }  # fmt: skip


def _facts(path: Path, request: Request) -> dict[str, Any]:
    """One recording of many, as plain data; a damaged one too."""
    try:
        return _plain(check_one(path, request, thorough=False))
    except (PkmTwinError, OSError) as error:
        return {"bag": str(path), "good": False, "error": one_line(str(error))}


def _judged_all(
    paths: Sequence[Path], request: Request, jobs: int
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Verdicts as they come."""
    if jobs == 1:
        yield from ((path, _facts(path, request)) for path in paths)
        return
    context = multiprocessing.get_context("spawn")
    with one_blas_thread_for_children(), ProcessPoolExecutor(jobs, mp_context=context) as pool:
        flying = {pool.submit(_facts, path, request): path for path in paths}
        for future in as_completed(flying):
            yield flying[future], future.result()


def _check_folder(folder: Path, request: Request, jobs: int, as_json: bool) -> bool:
    """Judge all recordings of a folder on so many processes; whether all are good."""
    paths = bags_of(folder)
    found: dict[Path, dict[str, Any]] = {}
    with progress("checking", len(paths)) as update:
        for path, facts in _judged_all(paths, request, min(jobs, len(paths))):
            found[path] = facts
            update(len(found))
    results = [found[path] for path in paths]
    good = all(result["good"] for result in results)
    if as_json:
        print_json({"folder": str(folder), "good": good, "recordings": results})
        return good
    for result in results:
        bad = [item["what"] for item in result.get("items", ()) if item["verdict"] == "bad"]
        because = ", ".join(bad) or result.get("not_judged")
        why = result.get("error") or f"{result['answer']}{f': {because}' if because else ''}"
        typer.echo(f"{result['bag']}: {why}")
    count = sum(not result["good"] for result in results)
    open_ = sum(result.get("answer") == "not judged" for result in results)
    counts = f", {count - open_} bad" + (f", {open_} not judged" if open_ else "")
    typer.echo(f"{len(results)} recordings{counts}" if count else f"{len(results)} good")
    return good


def check(
    bag: Annotated[
        Path,
        typer.Argument(help="a bag: an MCAP file or a rosbag2 folder; a CSV; or a folder of bags"),
    ],
    robot: OptionalRobot = None,
    residual: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            help="largest RMS torque residual that is good, as a fraction of the peak: 0.05 is 5 %",
        ),
    ] = 0.05,
    topic: BagTopics = [],  # noqa: B006  typer copies it
    payload: Payload = None,
    load_times: LoadTimes = None,
    history: Annotated[
        OptionalPath,
        typer.Option(
            help="also append residual, friction, payload and stiffness to this file, for "
            "`pkm-twin trend`"
        ),
    ] = None,
    machine: Annotated[
        OptionalText, typer.Option(help="name in the history; default: the robot's")
    ] = None,
    platform: Platform = None,
    jobs: Annotated[int, typer.Option(help="processes for a folder of bags", min=1)] = 1,
    as_json: Json = False,
) -> None:
    """Compare a recording, or a folder of them, with the model.

    Checks that the file is complete, that a node would accept every joint state and wrench, that
    no samples are missing, that positions and velocities belong to one moving machine, that joints
    stay inside their limits and away from singularities, and that the measured efforts agree with
    the model. If they do not, an explanation is named only if it makes them agree. An item without
    data (no CRCs, no efforts, a robot without masses) is unknown, which is neither good nor bad.
    The first lines report which topics and which payload were used.

    Exit code 0: good. 1: an item is bad, too few efforts can be compared for a verdict, or the file
    is no recording. 3: the file is damaged, but `pkm-twin recover` can save part of it.
    """
    from pkm_twin.apps.verdict import Verdict, items_table
    from pkm_twin.bags.reader import DamagedBagError

    how = read_options(topic, payload, load_times, limited=True)
    request = Request(robot, residual, how, history, machine, platform)
    if is_collection(bag):
        if not _check_folder(bag, request, jobs, as_json):
            raise typer.Exit(REFUSED)
        return
    try:
        with progress("reading", None) as update:
            report = check_one(bag, request, update)
            r = report.recording
    except PkmTwinError as error:
        salvageable = error.salvageable if isinstance(error, DamagedBagError) else 0
        if as_json:
            facts = {"bag": str(bag), "good": False, "error": str(error)}
            print_json({**facts, "salvageable": salvageable})
        tell(str(error))
        raise typer.Exit(SALVAGED if salvageable else REFUSED) from None
    if as_json:
        print_json(_plain(report))
    else:
        typer.echo(f"{r.topics}")
        typer.echo(f"payload: {r.load or 'as in the robot file'}")
        if not r.robot.uncertainty:
            typer.echo("uncertainty: none in the robot file, so the model has no uncertainty band")
        table_console().print(items_table(f"{r.source}: {r.robot.name}", "limit", report.items))
        for cause in report.causes:
            typer.echo(f"explanation: {cause}")
        for finding in report.findings:
            typer.echo(f"no explanation; `fit` finds: {finding}")
        bad, unknown = report.named(Verdict.BAD), report.named(Verdict.UNKNOWN)
        text = f"{report.answer}: {', '.join(bad) or report.unjudged}".removesuffix(": ")
        typer.echo(text + (f"; not judged: {', '.join(unknown)}" if unknown else ""))
    if report.answer != "good":
        raise typer.Exit(REFUSED)
