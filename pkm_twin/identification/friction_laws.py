# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Which friction law the drives have, by what the recordings' held-out parts say.

A law is tried where the fit without it leaves something unexplained. What efforts are not linear in
(a Stribeck speed, a cogging's period) is searched for, joint by joint, in the fitted parts'
residual; then everything is fitted again. A law is taken if the held-out residual without it has
what it predicts there, beyond what noise does, and is smaller with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.errors import BagError, ParameterError, PkmTwinError, SingularityError, UnknownNameError, UnreachableError
from pkm_twin.identification.compare import cut_recording, find_idle, missing_samples
from pkm_twin.identification.drives import FIT, fit_constants, parse_constants
from pkm_twin.identification.fit import Fit, correct_delays, fit, refuse_faults, solve_and_judge
from pkm_twin.identification.friction_search import LawSearch, Searched
from pkm_twin.identification.hypotheses import Explanation, explain_recording
from pkm_twin.identification.identifiable import KINDS, PAYLOAD, Kind, list_drive_parameters
from pkm_twin.identification.judge import SIGMAS
from pkm_twin.identification.parameters import Number, file_parameters
from pkm_twin.identification.rows import Problem
from pkm_twin.identification.samples import MIN_RELATIVE_NOISE
from pkm_twin.identification.verdict import LINE, Verdict, write_unreachable
from pkm_twin.machine.friction import BASIC, LAWS, Dahl, select_compiled_laws
from pkm_twin.recordings import Recording
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.steps import find_sampling

AUTO: Final = "auto"
MAX_RESIDUAL_RATIO: Final = 1.02
"""Largest ratio of a joint's held-out residual with a law to that without at which it is taken."""


@dataclass(frozen=True)
class Choice:
    """A law that was tried beside those before: residuals of what was held out, over the noise.

    ``sigmas``: how clearly the residual without the law has what the law predicts there, standard
    deviations of the noise. ``asked``: by the user.
    """

    law: str
    taken: bool
    before: float
    after: float
    sigmas: float
    asked: bool = False

    def __str__(self) -> str:
        evidence = (
            f"held-out residual {self.before:.3g} times the noise without, {self.after:.3g} with "
            f"it, {self.sigmas:.3g} sigma"
        )
        if self.asked:
            return f"friction law {self.law}, as asked: {evidence}"
        if self.taken:
            return f"friction law {self.law} taken, the law without it is rejected: {evidence}"
        return f"friction law {self.law} not taken: {evidence}"


def parse_laws(words: str) -> tuple[str, ...] | None:
    """Parse the names of friction laws, separated by commas; None: the recordings decide.

    :raises UnknownNameError: another word.
    """
    names = [word.strip() for word in words.split(",")]
    for name in names:
        if name not in (AUTO, BASIC.name, *LAWS):
            raise UnknownNameError("--friction", name, (AUTO, BASIC.name, *LAWS))
    return None if AUTO in names else tuple(name for name in LAWS if name in names)


def fit_with_laws(
    robot: Robot,
    recordings: Sequence[Recording],
    what: Sequence[Kind] = KINDS,
    laws: Sequence[str] | None = None,
    **options: Any,
) -> tuple[Fit, tuple[Choice, ...]]:
    """Fit with the friction laws that the recordings show beside the file's.

    :param laws: names; None: those that the held-out parts say.
    :param options: and errors as of :func:`~pkm_twin.identification.fit.fit`.
    """
    if "friction" not in what:
        return fit(robot, recordings, what, **options), ()
    choices: list[Choice] = []
    more: list[Number] = []
    wider: dict[tuple[str | int, ...], float] = {}
    asked = [name for name in laws or () if name not in robot.laws or LAWS[name].memory]
    if Dahl.name in asked:
        # Without memory slow reversals would be another machine's: faults are looked for with it.
        asked.remove(Dahl.name)
        best = fit(_add_hysteresis(robot, recordings, what), recordings, what, **options)
        before = Problem.from_recordings(robot, [made.recording for made in best.problem.whole], what)
        choice = _compare_fits(Dahl.name, best.verdict, before, best.problem)
        choices.append(replace(choice, taken=True, asked=True))
    else:
        best = fit(robot, recordings, what, **options)
    recordings = [made.recording for made in best.problem.whole]
    while asked if laws is not None else _may_lack_law(best):
        names = asked[:1] or [one for one in select_compiled_laws(tuple(LAWS)) if one not in best.robot.laws]
        tried = []
        for name in names:
            try:
                found = LawSearch(best.problem, name).find()
                opened = _set_values(best.robot, found) if found else best.robot
                opened = replace(opened, open_laws=(*best.robot.open_laws, name))
                one = Problem.from_recordings(opened, recordings, what, passes=1)
                one.check_count()
            except PkmTwinError:
                if asked:
                    raise
                continue
            tried.append((_compare_fits(name, best.verdict, best.problem, one), found, opened))
        if not tried:
            break
        choice, found, opened = max(tried, key=lambda one: (one[0].taken, -one[0].after))
        if asked:
            choice = replace(choice, taken=True, asked=True)
            asked = asked[1:]
        choices.append(choice)
        if not choice.taken:
            break
        problem = Problem.from_recordings(opened, recordings, what)
        problem.check_count()
        result = solve_and_judge(problem, best.accepted)
        more += _list_numbers(best.robot, result, choice.law, found)
        # The uncertainty of the nonlinear parameters adds to that of the linear ones.
        for searched in found.values():
            for word, values in searched.others.items():
                own_keys = [n.key for n in result.numbers if word in n.key]
                wider |= {key: float(values[_find_joint(result.robot, key)]) for key in own_keys}
        own = (replace(n, deviation=float(np.hypot(n.deviation, wider.get(n.key, 0.0)))) for n in result.numbers)
        best = replace(result, numbers=(*own, *more))
    file = {
        robot.friction_key(joint, "presliding"): float(value)
        for joint, value in zip(robot.joint_names, robot.friction.presliding, strict=True)
    }
    numbers = tuple(replace(n, before=file.get(n.key, n.before)) for n in best.numbers)
    return replace(best, numbers=numbers), tuple(choices)


def fit_recordings(
    robot: Robot,
    recordings: Sequence[Recording],
    what: Sequence[Kind] = KINDS,
    laws: Sequence[str] | None = None,
    *,
    constant: str | None = None,
    accept: bool = False,
    progress: Callable[[int], None] | None = None,
) -> tuple[Fit, tuple[Choice, ...], list[str]]:
    """Fit recordings as they are read, as ``check`` takes them.

    Where a payload is fitted, that of the recordings is the one to start from, and says when it is
    held. Without one, that which explains the efforts is it.

    :param constant: of recordings of motor currents: N m or N per ampere, one number or one a joint
        with commas, or ``fit``, by the file's masses. ``laws``, ``accept``, ``progress`` and errors
        as of :func:`fit_with_laws`.
    :returns: also notes: faults that were accepted, torque constants that were fitted.
    """
    for r in recordings:
        if r.measured is not None and r.topics.wrench is not None and r.wrench is None:
            text = f"no wrench on {r.topics.wrench} is accepted: {r.first_reject}"
            raise BagError(text, path=Path(r.source), reason="frames")
    file = robot
    faults = [f"{r.name}: {_describe_positions(r)}" for r in recordings if r.jump_description]
    refuse_faults(faults, accept)
    notes = [f"accepted by --accept: {fault}" for fault in faults]
    for r in recordings:
        if find_sampling(r.time).missing:
            gaps = missing_samples(r.time)
            notes.append(f"{r.name}: {gaps.text} {gaps.value}, {gaps.bound}: {gaps.verdict}")
    found: list[Explanation] = []
    if constant is None:
        seen = robot
        if "friction" in what and Dahl.name in (laws or ()):
            # Friction hysteresis changes the efforts after reversals, which would look like a payload.
            seen = _add_hysteresis(robot, [cut_recording(r) for r in recordings], what)
        found = [explain_recording(seen, r) for r in recordings]
    rows = [one.rows for one in found if one.rows is not None]
    made = [one.recording for one in rows] or [cut_recording(r) for r in recordings]
    explained = list(found)
    for k, one in enumerate(found):
        if one.steps and not one.fault:
            notes.append(f"{made[k].name}: {one.steps}")
        if not one.text or (one.fault and one.load is None):
            continue
        note, load = one.text, one.load
        # Of several recordings each has another estimate.
        if "payload" in what and len(made) == 1 and load is not None:
            made[k] = replace(made[k], load=load)
            spans = ", ".join(f"from {a:.2f} to {b:.2f} s" for a, b in load.times)
            note = f"the payload is held {spans or 'throughout'}"
            explained[k] = Explanation("")
        notes.append(f"{made[k].name}: {note}")
    if "payload" in what:
        loads = [r.load for r in made if r.load is not None]
        # Two payloads are not one section of a file.
        if len({(load.mass, load.com) for load in loads}) > 1:
            masses = ", ".join(f"{load.mass:g}" for load in loads)
            raise PkmTwinError(f"recordings with payloads of {masses} kg: fit one at a time")
        robot = loads[0].apply_to(robot) if loads else robot
        made = [r if r.load is None else replace(r, load=replace(r.load, sought=True)) for r in made]
    if constant is not None:
        if constant != FIT:
            constants = parse_constants(robot, constant)
        elif {"payload", "inertia"} & set(what):
            right = "--what friction,rotor: the masses of the file are its scale"
            raise ParameterError("--torque-constant", FIT, right)
        else:
            constants = fit_constants(robot, made)
        made, notes = [constants.convert(r) for r in made], constants.lines(robot) + notes
    options = {"accept": accept, "progress": progress, "explained": explained, "known": rows}
    result, choices = fit_with_laws(robot, made, what, laws, **options)
    result = replace(result, explained=tuple(found))
    return result if robot is file else _compare_with_file(file, result), choices, notes


def _describe_positions(r: Recording) -> str:
    """Say why positions that step are no motion of the machine: it cannot take them, or they jump."""
    if not r.backlash_description and not r.steps.publishers and r.effort is not None:
        try:
            find_idle(r)
        except (UnreachableError, SingularityError) as error:
            return write_unreachable(error)
    return f"position steps that are no motion: {r.backlash_description or r.jump_description}"


def _compare_with_file(file: Robot, result: Fit) -> Fit:
    """Convert a fit that started from a recording's payload to one from the file's payload."""
    problem = result.problem
    own = file_parameters(replace(problem.robot, payload=file.payload), problem.what)
    change = own.values - problem.parameters.values
    each = zip(result.judged, problem.held_out, strict=True)
    judged = tuple(replace(one, before=one.before + end.table @ change) for one, end in each)
    numbers = list[Number]()
    for n in result.numbers:
        if n.key[0] == PAYLOAD and n.before != file.number(n.name):
            # Numbers that are not excited keep the start's values, which the file receives as well.
            status = "combination" if n.status == "not excited" else n.status
            n = replace(n, before=file.number(n.name), status=status)
        numbers.append(n)
    return replace(result, numbers=tuple(numbers), judged=judged)


def _may_lack_law(result: Fit) -> bool:
    """Return whether another friction law may explain the rest; False after accepted faults."""
    v = result.verdict
    left = {one.suspect.kind for one in v.findings} - {LINE} or any(one.left_ratio > 1.0 for one in v.channels)
    return bool(left) and not result.accepted


def _compare_fits(name: str, verdict: Verdict, before: Problem, after: Problem) -> Choice:
    """Compare the held-out residuals of two fits, over the noise of a verdict."""
    band = np.array([max(channel.noise, 1e-300) for channel in verdict.channels])
    parts = []
    for end, other in zip(before.held_out, after.held_out, strict=True):
        noise = np.maximum(end.signals.noise, MIN_RELATIVE_NOISE * np.sqrt(np.mean(end.effort**2, 0)))
        old, new = (
            rows.target - rows.table @ problem.estimate.values for rows, problem in ((end, before), (other, after))
        )
        change = old - new
        each = (old / band) ** 2, (new / band) ** 2
        parts.append((*each, old * change / noise**2, (change / noise) ** 2))
    sums = np.array([np.concatenate(each).sum(0) for each in zip(*parts, strict=True)])
    count = sum(one.size for one, *_ in parts)
    before_rms, after_rms = np.sqrt(sums[:2].sum(-1) / count)
    sigmas = sums[2].sum() / np.sqrt(max(sums[3].sum(), 1e-300))
    no_joint_worse = (sums[1] <= MAX_RESIDUAL_RATIO**2 * sums[0]).all()
    good = sigmas > SIGMAS and after_rms < before_rms and no_joint_worse
    return Choice(name, bool(good), float(before_rms), float(after_rms), float(sigmas))


def _add_hysteresis(robot: Robot, recordings: Sequence[Recording], what: Sequence[Kind]) -> Robot:
    """Return the robot with Dahl's law, near what the recordings show of its distance.

    :raises PkmTwinError: their motion does not show it.
    """
    static = correct_delays(Problem.from_recordings(robot, recordings, what))
    recordings = [rows.recording for rows in static.whole]
    rough = _set_values(robot, LawSearch(static, Dahl.name).find())
    # Without hysteresis efforts near reversals count as outliers and noise, so search again with it.
    again = Problem.from_recordings(rough, recordings, static.what)
    found = _set_values(robot, LawSearch(again, Dahl.name).find(judged=True))
    return replace(found, open_laws=(*robot.open_laws, Dahl.name))


def _set_values(robot: Robot, found: dict[str, Searched]) -> Robot:
    """Return the robot with the values found."""
    return robot.changed(friction={key: one.value.tolist() for key, one in found.items()})


def _list_numbers(robot: Robot, result: Fit, name: str, found: dict[str, Searched]) -> list[Number]:
    """Return a law's nonlinear parameters as numbers of the file.

    :param robot: before.
    """
    law, more = LAWS[name], []
    (first, *_) = (key for key, parameter in law.parameters.items() if parameter.linear)
    for key, one in found.items():
        value, deviation = one.value, one.deviation
        for number in (n for n in result.numbers if first in n.key):
            path = tuple(key if part == first else part for part in number.key)
            k = _find_joint(result.robot, number.key)
            unit = law.parameters[key].unit_of_drive(slides=robot.joint_units[k] == "m")
            old = float(np.asarray(getattr(robot.friction, key))[k])
            if result.verdict.deviations == "withheld":
                deviation = np.full(len(value), np.nan)
            more.append(Number(path, unit, old, float(value[k]), float(deviation[k]), "fitted"))
    return more


def _find_joint(robot: Robot, key: tuple[str | int, ...]) -> int:
    """Return the actuated joint of a number of friction: by its group, in order."""
    groups = [g for g in list_drive_parameters(robot) if g.kind == "friction"]
    for group in groups:
        if key in group.keys(group.values):
            joint = group.names[0].rpartition(".")[0]
            return robot.joint_names.index(joint)
    raise KeyError(key)
