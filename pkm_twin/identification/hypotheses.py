# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find what is most probably wrong with a recording: hypotheses by their posterior odds.

Every hypothesis is the Gaussian model of :mod:`pkm_twin.identification.evidence` around the robot's
file, with another gain, sign, order or time of the efforts, or other positions, rates or wrenches.
All have the same columns: the numbers of the file, a delay, and the usual errors. What differs from
the file is averaged over a few classes: nothing, friction, a payload, masses. Without them, priors
wide enough for a heavy payload would prefer a wrong scale to a sound recording (Lindley, 1957).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.columns import CURRENT_OFFSET, GAIN, PRIOR_DEVIATIONS, Columns
from pkm_twin.identification.compare import cut_recording
from pkm_twin.identification.evidence import Model, Spectra
from pkm_twin.identification.friction_search import LawSearch
from pkm_twin.identification.identifiable import KINDS
from pkm_twin.identification.judge import ALTERNATIVE_LOG_ODDS, FOUND_LOG_ODDS, SIGMAS
from pkm_twin.identification.parameters import file_parameters
from pkm_twin.identification.rows import MAX_EFFORT, Problem, Rows, make_rows
from pkm_twin.identification.samples import Motion, find_held_payload
from pkm_twin.identification.verdict import EFFORT_UNITS, MAX_DELAY, is_usual_scale, join_names, write_late, write_scale
from pkm_twin.machine.friction import LAWS, select_compiled_laws
from pkm_twin.messages.reading import rotate_to_base
from pkm_twin.recordings import Load, Recording
from pkm_twin.robot.robot import Robot

HEAVY_RATIOS: Final = {"payload": 30.0, "friction": 3.0}
"""Prior deviations of heavy ones, over those of usual ones; heavy friction may be all of the efforts."""
CLASSES: Final = {
    "": 0.0,
    "payload": 2.0,
    "friction": 2.0,
    "friction masses payload": 3.0,
    "heavy payload": 4.0,
    "friction heavy payload": 5.0,
    "heavy friction": 4.0,
}
"""Kinds of numbers that differ from the file, and the log prior odds against it."""
MAX_LISTED_CAUSES: Final = 6
"""Largest number of causes that are listed with their probabilities."""
DISCREPANCY_RATIOS: Final = np.geomspace(0.01, 1.0, 7)
"""Candidate ratios of the model error to the measured efforts, both RMS; no model is better than 1 %."""
UNIT_LOG_ODDS: Final = 5.0
"""Log prior odds against another unit, scale or rate: one recording in 150."""
OTHER_LOG_ODDS: Final = 8.0
"""Log prior odds against any other cause: one recording in 3,000."""
MAX_NAMED_DISCREPANCY: Final = 0.12
"""Largest ratio of the model error to the measured efforts with which a cause is named."""
MAX_SOUND_DISCREPANCY: Final = 0.3
"""Largest ratio of the model error to the measured efforts of a machine that may be the file's."""
MAX_SEARCHED_DELAY: Final = 1.5
"""Longest delay of efforts that is searched for, s."""
TIME_RATES: Final = (2.0, 0.5, 3.0, 1 / 3, 4.0, 0.25, 5.0, 0.2, 10.0, 0.1, 1e3, 1e-3)
"""Candidate ratios of the true speed to the recorded one: wrong periods, and ms for s."""
POSITION_FACTORS: Final = {
    "positions are in degrees": np.pi / 180.0,
    "positions are in rad, and were taken for degrees": 180.0 / np.pi,
    "positions are in mm": 1e-3,
}


@dataclass(frozen=True)
class Hypothesis:
    """A cause in words: its log posterior odds, the discrepancy that it leaves, its class.

    No words: the recording is sound. ``classes``: probability of each. ``load``: the payload that
    explains the efforts. ``late``: the delay of the efforts of all joints, s; ``scale``: theirs.
    ``law``: of friction, that the file lacks.
    """

    text: str
    log: float
    discrepancy_ratio: float
    kinds: str = ""
    load: Load | None = None
    late: float = 0.0
    classes: tuple[float, ...] = ()
    scale: float = 1.0
    law: str = ""


@dataclass(frozen=True)
class Explanation:
    """Name the cause of a recording's deviations; empty if the file or several numbers explain them.

    ``fault``: this machine cannot have made the recording, or not with the payload that is given.
    ``load``: the payload that explains the efforts. ``steps``: positions that step without a motion.
    ``considered``: the most probable causes with their probabilities. ``rows``: those that were
    explained.
    """

    text: str
    fault: bool = False
    load: Load | None = None
    steps: str = ""
    considered: tuple[tuple[str, float], ...] = ()
    rows: Rows | None = field(default=None, compare=False, repr=False)

    @property
    def cause(self) -> str:
        """Sentence with the steps of the positions and the cause of the efforts; empty without both."""
        return "; ".join(text for text in (self.steps, self.text) if text)


class HypothesisSearch:
    """Evaluate the hypotheses that may explain how one recording differs from the model.

    :param rows: filtered rows whose regressor has columns for all parameters of the file.
    """

    def __init__(self, rows: Rows) -> None:
        self.rows, self.columns = rows, Columns.from_rows(rows)
        self.joints = rows.model.robot.joint_names
        self.delay_column = self.columns.kinds.index("error")
        self.spectra = self.columns.spectra()
        self.first_log: float | None = None
        self.sound = self.evaluate("", 0.0, self.spectra)

    def evaluate(
        self,
        text: str,
        penalty: float,
        spectra: Spectra,
        classes: Sequence[str] = tuple(CLASSES),
        ratios: Array = DISCREPANCY_RATIOS,
        *,
        gains: Array | None = None,
        order: Sequence[int] | None = None,
        factors: Array | None = None,
        bounded: bool = True,
        screened: bool = True,
    ) -> Hypothesis:
        """Return a hypothesis with its log posterior odds, over all classes of machines.

        :param penalty: log prior odds against it. ``gains``, ``order``: of the efforts. ``factors``:
            on the prior's deviations, (c,). ``screened``: whether few classes are compared first.
        """
        c = self.columns
        base = c.deviation if factors is None else c.deviation * factors
        kinds = np.array(c.kinds)
        of_file = np.isin(kinds, ("friction", "masses", "payload"))
        if gains is not None and gains.any():
            # A gain scales the model alone; the errors keep their size in the measured efforts.
            power = np.einsum("jbcc->jc", spectra.grams)[:, 1 : len(base) + 1]
            more = np.sqrt((gains[:, None] ** 2 * power).sum(0) / np.maximum(power.sum(0), 1e-300))
            base = np.where(of_file | (more == 0.0), base, base / np.where(more > 0.0, more, 1.0))
        places = [np.arange(len(base))]
        if screened and len(classes) > len(SEARCH_CLASSES):
            # Improbable hypotheses are discarded by two classes and one ratio of the discrepancy.
            few = Model.from_spectra([spectra], places, base, DISCREPANCY_RATIOS[1:2], gains, order)
            log = max(self._find_logs(few, name, False)[0] for name in SEARCH_CLASSES)
            self.first_log = log if self.first_log is None else self.first_log
            if log < self.first_log - 40.0:
                return Hypothesis(text, log - penalty, 1.0)
        model = Model.from_spectra([spectra], places, base, ratios, gains, order)
        logs, found = [], []
        for name in classes:
            own = self._find_logs(model, name, bounded)
            logs.append(own.max() + np.log(np.mean(np.exp(own - own.max()))) - CLASSES[name])
            found.append(float(ratios[int(own.argmax())]))
        best = int(np.argmax(logs))
        log = float(np.logaddexp.reduce(logs))
        odds = tuple(np.exp(np.array(logs) - log).tolist())
        return Hypothesis(text, log - penalty, found[best], classes[best], classes=odds)

    def _find_logs(self, model: Model, name: str, bounded: bool) -> Array:
        """Return a class's log evidence at each ratio of the discrepancy, less what possible numbers cost."""
        kinds = np.array(self.columns.kinds)
        free = ~np.isin(kinds, ("friction", "masses", "payload")) | np.isin(kinds, name.split())
        # Numbers that agree with the file do so within a tenth of the prior deviations.
        widths = np.where(free, 1.0, 0.1)
        for kind, ratio in HEAVY_RATIOS.items():
            widths = np.where((kinds == kind) & (f"heavy {kind}" in name), ratio, widths)
        model = model.widened(widths)
        used = np.ones(len(model.deviation), np.bool_)
        logs = model.logs(used)
        low, high = self.columns.low, self.columns.high
        bound = (np.isfinite(low) | np.isfinite(high)) & (model.deviation > 0.0)
        if not bounded or not bound.any():
            return logs
        free = np.ones(len(logs), np.bool_)
        # A bound may reduce the best ratio's evidence so that other ratios count, with their bounds.
        while (near := free & (logs > logs.max() - 2.0 * FOUND_LOG_ODDS)).any():
            k = int(np.argmax(np.where(near, logs, -np.inf)))
            free[k] = False
            mean, inner = model.posterior_at(k, used)
            mean = mean[bound] * model.deviation[bound]
            if (mean >= low[bound]).all() and (mean <= high[bound]).all():
                continue
            inner = inner[np.ix_(bound, bound)] * np.outer(model.deviation[bound], model.deviation[bound])
            size = np.maximum(np.sqrt(np.diag(inner)), 1e-150)
            root = np.linalg.cholesky(inner / np.outer(size, size) + 1e-9 * np.eye(len(size)))
            back = scipy.linalg.solve_triangular(root, np.eye(len(size)), lower=True)
            limits = low[bound] / size, high[bound] / size
            logs[k] -= scipy.optimize.lsq_linear(back, back @ (mean / size), limits, method="bvls").cost
        return logs

    @cached_property
    def all(self) -> list[Hypothesis]:
        """The hypotheses, the most probable first."""
        if self.sound.discrepancy_ratio <= DISCREPANCY_RATIOS[1] and not self.sound.kinds:
            # The residual is too small for any cause to outweigh its prior odds.
            return [self.sound]
        found = [self.sound, *self._evaluate_efforts(), *self._evaluate_delays(), *self._evaluate_loads()]
        best, *others = sorted(found, key=lambda one: -one.log)
        pushed = self.rows.recording.wrench is not None and self.rows.recording.wrench.any()
        clearly_sound = (
            best is self.sound
            and best.discrepancy_ratio <= DISCREPANCY_RATIOS[0]
            and others[0].log < best.log - FOUND_LOG_ODDS
        )
        if pushed or not clearly_sound:
            found += self._evaluate_positions()
        best = max(found, key=lambda one: one.log)
        if best.text or best.discrepancy_ratio > MAX_NAMED_DISCREPANCY:
            found += self._evaluate_friction_laws()
        return sorted(found, key=lambda one: -one.log)

    def _evaluate_efforts(self) -> Iterator[Hypothesis]:
        """Evaluate other signs, scales and orders of the efforts, no relation to the motion, and other times."""
        n, eye, sp = len(self.joints), np.eye(len(self.joints)), self.spectra
        offset = np.array([kind == "offset" for kind in self.columns.kinds])
        none = np.where(offset, 1.0 / PRIOR_DEVIATIONS[CURRENT_OFFSET], 0.0)
        yield self.evaluate(NO_MACHINE, OTHER_LOG_ODDS, sp, ("",), gains=np.zeros(n), factors=none)
        whole = [np.ones(n), *eye] if n > 1 else [np.ones(1)]
        signs = [1.0 - 2.0 * one for one in whole]
        if n > 2:
            each = np.array([self.evaluate("", 0.0, sp, SEARCH_CLASSES, gains=s).log for s in signs[1:]])
            signs += [1.0 - 2.0 * (eye[np.argsort(each)[-k:]].sum(0)) for k in range(2, n)]
        for sign in signs:
            turned = [self.joints[j] for j in np.flatnonzero(sign < 0.0)]
            text = f"efforts of {join_names(turned, n)} have the wrong sign"
            penalty = OTHER_LOG_ODDS + 2.0 * (len(turned) - 1 if len(turned) < n else 0)
            yield self.evaluate(text, penalty, sp, gains=sign)
        for which in whole:
            names = join_names([self.joints[j] for j in np.flatnonzero(which)], n)
            for way in (1.0, -1.0):
                yield from self._evaluate_scales(names, which, way)
        for i, k in combinations(range(n), 2):
            order = np.arange(n)
            order[[i, k]] = k, i
            text = f"efforts of {self.joints[i]} and {self.joints[k]} are exchanged"
            yield self._evaluate_order(text, self.columns, order, order)
        for order in [np.roll(range(n), 1), np.roll(range(n), -1)] if n > 2 else []:
            yield self._evaluate_order("columns of the efforts are in another order", self.columns, order, order)
        back = np.where(self.columns.turning, -1.0, 1.0)
        p, rubs = self.rows.model.parameters, self.rows.model.parameters.kinds == "friction"
        certain = self.columns.certain - 2.0 * (self.rows.table[..., rubs] @ p.values[rubs])
        backwards = replace(self.columns, columns=self.columns.columns * back, certain=certain)
        yield self.evaluate("time runs backwards", OTHER_LOG_ODDS, backwards.spectra())
        for rate in TIME_RATES:
            why = "ms for s?" if rate >= 1e3 or rate <= 1e-3 else "time steps?"
            text = f"the motion was {rate:.3g} times as fast as its time stamps are ({why})"
            yield self.evaluate(text, UNIT_LOG_ODDS, self.columns.spectra(rate=rate))

    def _evaluate_order(self, text: str, c: Columns, order: Indices, efforts: Indices | None = None) -> Hypothesis:
        """Evaluate another order of joints, by the samples at which the friction of both orders is known.

        :param order: of the joints whose motion or efforts are exchanged; ``efforts``: of the efforts.
        """
        counts = self.rows.counts * self.rows.counts[:, order]
        common = replace(self.rows, counts=counts)
        alike = bool((counts == self.rows.counts).all())
        one = self.evaluate(text, OTHER_LOG_ODDS, replace(c, rows=common).spectra(order=efforts), screened=alike)
        if alike:
            return one
        before = self.evaluate("", 0.0, replace(self.columns, rows=common).spectra(), screened=False)
        return replace(one, log=self.sound.log + one.log - before.log)

    def _evaluate_scales(self, names: str, which: Array, way: float) -> Iterator[Hypothesis]:
        """Evaluate the most probable scale of some drives' efforts."""

        def gains(scale: float) -> Array:
            return np.where(which > 0.0, scale, 1.0)

        def log(x: float) -> float:
            some = gains(way * float(np.exp(x)))
            return self.evaluate("", 0.0, self.spectra, classes, DISCREPANCY_RATIOS[2:3], gains=some, bounded=False).log

        # Heavier masses would be in the place of a scale.
        classes = ("", "friction") if which.all() and way > 0.0 else SEARCH_CLASSES
        grid = np.log(2.0) * np.arange(-12.0, 12.5)
        logs = [log(x) for x in grid]
        k = int(np.argmax(logs))
        ends = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
        best = scipy.optimize.minimize_scalar(
            lambda x: -log(x), bounds=ends, method="bounded", options={"xatol": 0.005}
        )
        scale = way * float(np.exp(best.x))
        if way < 0.0 or not is_usual_scale(scale):
            # A scale that is that of a known unit has better prior odds.
            units = [u for u in EFFORT_UNITS.values() if way > 0.0 and 0.5 < u / scale < 2.0]
            for size, penalty in (
                (scale, UNIT_LOG_ODDS + (OTHER_LOG_ODDS if way < 0.0 else 0.0)),
                *((u, UNIT_LOG_ODDS - 2.0) for u in units),
            ):
                one = self.evaluate("", penalty, self.spectra, gains=gains(size))
                if one.kinds in ("", "friction", "heavy friction") and size == scale:
                    own = float(np.mean(self._find_gains(gains(size), one.kinds)[0][which > 0.0]))
                    size /= 1.0 - size * own
                yield replace(one, text=write_scale(names, size), scale=size if which.all() else 1.0)

    def _find_gains(self, gains: Array | None = None, kinds: str = "", usual: float = 1.0) -> tuple[Array, Array]:
        """Return each joint's gain, a part of its efforts, beside a delay; its deviation.

        :param gains: factors that multiply the model's efforts. ``kinds``: numbers estimated too.
            ``usual``: prior deviation of a gain.
        """
        c, n = self.columns, len(self.joints)
        used = np.arange(len(c.kinds)) >= len(c.kinds) - c.gains
        deviation = np.where(used, usual, c.deviation)
        used |= np.isin(c.kinds, kinds.split())
        used[self.delay_column] = True
        model = Model.from_spectra([self.spectra], [np.arange(len(used))], deviation, DISCREPANCY_RATIOS, gains)
        found = model.posterior(used)
        some = slice(len(used) - c.gains, None)
        each = found.mean[some]
        # A joint's gain is the sum of its own and the common one.
        tie = np.concatenate([np.eye(n), np.ones((n, c.gains - n))], 1)
        deviations = np.sqrt(np.diag(tie @ found.covariance[some, some] @ tie.T))
        return np.asarray(tie @ each, np.float64), np.asarray(deviations, np.float64)

    def _evaluate_delays(self) -> Iterator[Hypothesis]:
        """Evaluate the hypotheses that the efforts of all joints, or of one, belong to another time."""
        r, c = self.rows, self.columns
        n, k, period = len(self.joints), len(r.time), float(np.median(np.diff(r.time)))
        most = min(int(MAX_SEARCHED_DELAY / period), k // 4)
        if most * period < MAX_DELAY:
            return
        inner = slice(most, k - most)
        own = np.array([kind not in ("offset", "error") for kind in c.kinds])
        left = np.empty((2 * most + 1, n))
        for j in range(n):
            table = np.concatenate([c.columns[inner, j][:, own], c.certain[inner, j, None]], 1)
            table = table[:, np.abs(table).max(0) > 0.0]
            basis = np.linalg.qr(table / np.linalg.norm(table, axis=0))[0]
            moved = np.stack([r.effort[s : k - 2 * most + s, j] for s in range(2 * most + 1)])
            left[:, j] = np.sum(moved**2, 1) - np.sum((moved @ basis) ** 2, 1)
        left /= np.maximum(np.var(r.effort, 0), 1e-300)
        choices: list[tuple[list[int], int]] = [([*range(n)], int(left.sum(1).argmin()))]
        choices += [([j], int(left[:, j].argmin())) for j in range(n)] if n > 1 else []
        choices = [(which, place) for which, place in choices if abs(place - most) * period >= 0.03]
        before = self.evaluate("", 0.0, c.spectra(inner=inner), screened=False) if choices else self.sound
        for which, place in choices:
            effort = r.effort.copy()
            effort[inner, which] = r.effort[place : k - 2 * most + place, which]
            spectra = c.spectra(effort, inner)
            one = self.evaluate("", 0.0, spectra, screened=False)
            late = float((place - most) * period) + self._find_mean(spectra, one.kinds)[self.delay_column]
            text = write_late(join_names([self.joints[j] for j in which], n), late)
            one = replace(one, text=text, late=late if len(which) == n else 0.0)
            # Scale the evidence of the compared rows to all rows.
            gain = (one.log - before.log) * k / (k - 2 * most)
            yield replace(one, log=self.sound.log + gain - OTHER_LOG_ODDS)

    def _find_mean(self, spectra: Spectra, kinds: str | None = None, more: int = 0) -> Array:
        """Return the posterior mean of the columns, (c,).

        :param kinds: which numbers differ from the file; beside them only a delay, offsets, and the
            column ``more``; default all columns.
        """
        c = self.columns
        used = np.ones(len(c.kinds), np.bool_)
        if kinds is not None:
            used = np.isin(c.kinds, ["offset", *kinds.split()])
            used[[self.delay_column, more or self.delay_column]] = True
        deviation = c.deviation * np.where(c.payload, HEAVY_RATIOS["payload"], 1.0)
        return Model.from_spectra([spectra], [np.arange(len(used))], deviation, DISCREPANCY_RATIOS).posterior(used).mean

    def _evaluate_loads(self) -> Iterator[Hypothesis]:
        """Evaluate the hypothesis that a payload is carried for a part of the time only."""
        r, c, payload = self.rows, self.columns, self.columns.payload
        if not payload.any() or r.recording.load is not None:
            return
        left = r.effort - c.certain - c.columns @ np.where(payload, 0.0, self._find_mean(self.spectra))
        weight = r.counts / np.maximum(np.var(r.effort, 0), 1e-300)
        kilogram = c.columns[..., int(payload.argmax())]
        _, spans, held = find_held_payload(r.time, kilogram, left, weight)
        if spans and not held.all():
            part = replace(c, columns=np.where(payload, held[:, None, None], 1.0) * c.columns)
            yield self._evaluate_payload_mass(part.spectra(), UNIT_LOG_ODDS + 3.0 * len(spans), *spans)

    def _evaluate_friction_laws(self) -> Iterator[Hypothesis]:
        """Evaluate friction laws that the file lacks, with the nonlinear parameter that explains most."""
        r, c, model = self.rows, self.columns, self.rows.model
        problem = Problem.from_recordings(model.robot, [r.recording], KINDS, known=[r])
        n = len(self.joints)
        for name in select_compiled_laws(tuple(LAWS)):
            search = LawSearch(problem, name)
            if name in model.robot.laws or not search.key:
                continue
            try:
                (found,) = search.find().values()
            except PkmTwinError:
                continue
            other, units = copy(self), search.columns(found.value)
            other.columns = c.with_friction(units)
            text = f"{name} friction of the drives, which the file lacks, explains the efforts: --friction {name}"
            penalty = UNIT_LOG_ODDS + n * float(np.log(len(search.list_candidates())))
            one = other.evaluate(text, penalty, other.columns.spectra(), screened=False)
            yield replace(one, law=name)

    def _evaluate_payload_mass(self, spectra: Spectra, penalty: float, *spans: tuple[float, float]) -> Hypothesis:
        """Evaluate the hypothesis of another payload mass, at the file's centre of mass."""
        one, robot = self.evaluate("", penalty, spectra), self.rows.model.robot
        first = self.columns.kinds.index("payload")
        beside = one.kinds.replace("payload", "")
        mass = robot.payload.mass + float(self._find_mean(spectra, beside, first)[first])
        load = Load(float(f"{max(mass, 0.0):.3g}"), None, spans)
        com = robot.payload.com
        at = ", ".join(f"{v:g}" for v in com) + " m" if np.any(com) else "the reference point"
        text = f"a payload of {load.mass:.3g} kg with its centre at {at} explains the efforts: "
        text += f"use --payload {load.mass:g}"
        if spans:
            text += " --load-times " + ",".join(f"{edge:.2f}" for pair in spans for edge in pair)
        return replace(one, text=text, load=load)

    def explain(self) -> Explanation:
        """Return what explains the recording most probably."""
        best, sound = self.all[0], self.sound
        unknown = (
            f"{NO_MACHINE}: {100 * sound.discrepancy_ratio:.2g} % of their variation is left (another "
            "machine, another motion, an unknown load, or noise?)"
        )
        scaled = next((one for one in self.all if one.scale > 0.0 and one.scale != 1.0), best)
        if (
            scaled.scale != 1.0
            and scaled.discrepancy_ratio <= MAX_NAMED_DISCREPANCY
            and abs(scaled.log - sound.log) <= FOUND_LOG_ODDS >= best.log - scaled.log
        ):
            text, _ = self._tell_scale(scaled.scale, scaled.kinds)
            if text:
                return Explanation(text, not is_usual_scale(scaled.scale))
            best = next(one for one in self.all if one is not scaled)
        if best.text and best.log - sound.log > FOUND_LOG_ODDS:
            if best.text == NO_MACHINE or best.discrepancy_ratio > MAX_NAMED_DISCREPANCY:
                return Explanation(unknown, fault=True)
            if 0.0 < abs(best.late) < MAX_DELAY and not self.rows.recording.late:
                r = self.rows.recording.compensate_effort_delay(best.late)
                return explain(make_rows(self.rows.model.robot, self.rows.model.parameters, r))
            return Explanation(best.text, fault=not best.law, load=best.load)
        if sound.discrepancy_ratio > MAX_SOUND_DISCREPANCY:
            return Explanation(unknown, fault=True)
        gains, deviations = self._find_gains()
        j, mean = int(np.abs(gains).argmax()), float(gains.mean())
        # A gain of 10 %, two usual deviations, is named.
        if not sound.kinds and abs(gains[j]) > 2.0 * PRIOR_DEVIATIONS[GAIN] + SIGMAS * deviations[j]:
            if (np.abs(gains - mean) >= 0.5 * abs(mean)).any():
                scale = 1.0 / (1.0 - float(gains[j]))
                return Explanation(write_scale(self.joints[j], scale), not is_usual_scale(scale))
            # In slow motions payload and friction that the file lacks look like a gain.
            beside, _ = self._find_gains(kinds="friction payload", usual=PRIOR_DEVIATIONS[GAIN])
            scale = 1.0 / (1.0 - mean)
            text, clear = self._tell_scale(scale)
            if clear or abs(beside[j]) > 2.0 * PRIOR_DEVIATIONS[GAIN]:
                return Explanation(text, clear and not is_usual_scale(scale))
        if sound.kinds in ("payload", "heavy payload") and self.rows.recording.load is None:
            loaded = self._evaluate_payload_mass(self.spectra, 0.0)
            return Explanation(loaded.text, load=loaded.load)
        return Explanation("")

    def list_causes(self) -> tuple[tuple[str, float], ...]:
        """Return the most probable causes with their probabilities; other numbers by their kinds."""
        found = [(one.text, one.log) for one in self.all if one.text]
        for kinds, part in zip(CLASSES, self.sound.classes, strict=True):
            text = f"other numbers in the file: {kinds}" if kinds else "the file as it is"
            found.append((text, self.sound.log + float(np.log(max(part, 1e-300)))))
        parts = scipy.special.softmax([log for _, log in found])
        order = np.argsort(-parts)[:MAX_LISTED_CAUSES].tolist()
        return tuple((found[k][0], float(parts[k])) for k in order if parts[k] > 1e-6)

    def _tell_scale(self, scale: float, kinds: str = "") -> tuple[str, bool]:
        """Say that all efforts are scaled, nothing where heavier masses explain them better, and whether it is clear.

        A heavier machine has the friction of its file, efforts of another scale have not. Where friction
        is not the file's (``kinds``: numbers that differ from it), both are as likely.
        """
        c, p, rows = self.columns, self.rows.model.parameters, self.rows
        rubs = p.kinds == "friction"
        smooth = c.certain - rows.table[..., rubs] @ p.values[rubs]
        beside = np.flatnonzero([kind == "offset" or k == self.delay_column for k, kind in enumerate(c.kinds)])
        table = np.concatenate([c.columns[..., beside], c.certain[..., None], smooth[..., None]], -1)
        spectra = replace(c, columns=table, fast=0.0 * table).spectra()
        places, deviation = np.arange(len(beside) + 2), np.append(c.deviation[beside], [1.0, 1.0])
        model = Model.from_spectra([spectra], [places], deviation)
        masses, efforts = (model.log_evidence(places != len(beside) + k) for k in (0, 1))
        if "friction" not in kinds and masses > efforts + ALTERNATIVE_LOG_ODDS:
            return "", False
        # The file's friction tells them apart only where nothing else is left of the efforts.
        left = model.posterior(places != len(beside) + 1).discrepancy_ratio
        clear = "friction" not in kinds and efforts > masses + ALTERNATIVE_LOG_ODDS and left <= DISCREPANCY_RATIOS[0]
        others = [] if clear else [f"all masses are {scale:.3g} times the file's"]
        names = join_names([*self.joints], len(self.joints))
        return write_scale(names, scale, *others), clear

    def _evaluate_positions(self) -> Iterator[Hypothesis]:
        """Evaluate other positions, with the efforts as they are or with the same signs changed, and other wrenches."""
        r, robot, motion = self.rows, self.rows.model.robot, self.rows.signals.motion
        n, names, eye = len(self.joints), self.joints, np.eye(len(self.joints))
        ones, q = np.ones(n), motion.q
        if r.recording.wrench is not None and r.recording.wrench.any():
            rotation, axes = robot.rotation(robot.forward(q)), "platform"
            if r.recording.topics.turns:
                rotation, axes = rotation.swapaxes(-1, -2), "base"
            opposite = "the wrench has the opposite sign: it is what the platform applies to its surroundings"
            for text, wrench in {
                f"the wrench has {axes} axes": rotate_to_base(motion.wrench, rotation),
                opposite: -motion.wrench,
                "without the wrench the efforts agree: it does not act on the platform": 0.0 * motion.wrench,
            }.items():
                yield from self._evaluate_motion(text, replace(motion, wrench=wrench), ones)
        for text, scale in POSITION_FACTORS.items():
            other = replace(motion, q=scale * q, qd=scale * motion.qd, qdd=scale * motion.qdd)
            yield from self._evaluate_motion(text, other, ones)
        if n > 1:
            other = replace(motion, q=-q, qd=-motion.qd, qdd=-motion.qdd)
            yield from self._evaluate_motion("positions of all joints have the wrong sign", other, -ones)
        for name, e in zip(names, eye, strict=True):
            t, text = 1.0 - 2.0 * e, f"of {name} have the wrong sign (joint_map?)"
            # A drive that counts the wrong way is mirrored at zero, at home, or anywhere.
            for middle in (0.0 * robot.graph.home, robot.graph.home, q.mean(0)):
                other = replace(motion, q=middle + t * (q - middle), qd=t * motion.qd, qdd=t * motion.qdd)
                both = f"positions and efforts {text}"
                yield from self._evaluate_motion(f"positions {text}", other, t, both)
        for i, k in combinations(range(n), 2):
            order = np.arange(n)
            order[[i, k]] = k, i
            other = replace(motion, q=q[:, order], qd=motion.qd[:, order], qdd=motion.qdd[:, order])
            text = f"{names[i]} and {names[k]} are exchanged"
            yield from self._evaluate_motion(f"positions of {text}", other, ones, text, order)

    def _evaluate_motion(
        self, text: str, motion: Motion, turned: Array, both: str = "", order: Indices | None = None
    ) -> Iterator[Hypothesis]:
        """Evaluate another motion; if ``both`` is given, also with the efforts' signs or order changed alike."""
        # Skip unreachable motions first: composing their error takes as long as evaluating the hypothesis.
        if not self.rows.model.robot.try_forward(motion.q)[1].all():
            return
        try:
            made = self.columns.with_motion(motion, turned, order)
        except (PkmTwinError, ValueError, np.linalg.LinAlgError):
            return
        if not np.isfinite(made.columns).all() or not np.abs(made.certain).max() < MAX_EFFORT:
            return
        if order is not None:
            yield self._evaluate_order(text, made, order)
            yield self._evaluate_order(both, made, order, order)
            return
        spectra = made.spectra()
        yield self.evaluate(text, OTHER_LOG_ODDS, spectra)
        if both:
            yield self.evaluate(both, OTHER_LOG_ODDS, spectra, gains=turned)


SEARCH_CLASSES: Final = ("", "friction masses payload")
"""Classes of machines with which scales and signs are searched."""
NO_MACHINE: Final = "no machine like the file's explains the efforts, and no single mistake does"


def explain(rows: Rows) -> Explanation:
    """Return what explains a recording most probably: the file, one number, or a fault.

    :param rows: with all parameters of the file.
    """
    period = float(np.median(np.diff(rows.recording.time)))
    if period > 1.0:
        text = f"samples {period:.3g} s apart show no motion (is the time in ms?)"
        return Explanation(text, fault=True)
    search = HypothesisSearch(rows)
    found = search.explain()
    return found if found.considered else replace(found, considered=search.list_causes())


def explain_recording(robot: Robot, r: Recording) -> Explanation:
    """Return what explains a recording most probably: the cause that `check` names, and `fit` notes or rejects.

    A payload is the cause if nothing contradicts it.

    :raises PkmTwinError: a recording whose efforts cannot be compared with the robot's.
    """
    rows = make_rows(robot, file_parameters(robot), cut_recording(r))
    found = explain(rows)
    if found.load is not None:
        loaded = explain(make_rows(robot, rows.model.parameters, replace(rows.recording, load=found.load)))
        found = loaded if loaded.fault else found
    return replace(found, steps="" if r.jump_description else r.backlash_description, rows=rows)
