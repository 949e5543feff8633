# SPDX-License-Identifier: Apache-2.0
"""The verdict on a fit of efforts: its residual against noise and against common errors.

May import: numpy, scipy, pkm_twin's core and identification, this package, the standard library.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.file_parameters import FileParameters, file_parameters
from delta_dynamics.fit_rows import Recorded, Rows, calm_table, efforts_of
from delta_dynamics.fit_signals import (
    ELASTIC,
    GEOMETRY,
    OFFSET,
    STEP,
    columns_of,
    suspects_of,
)
from delta_dynamics.fit_solved import Solved
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.judge import Evidence, judge
from pkm_twin.identification.verdict import Finding, Suspect, Verdict
from pkm_twin.machine.entries import entries, with_entries
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

OF_THE_FILE: Final = {
    "friction": "friction other than the file's",
    "rotor": "rotor inertia other than the file's",
    "payload": "payload other than the file's",
    "inertia": "mass or inertia other than the file's",
}
"""Suspects that were not fitted, by the kind of the file's numbers."""
LIKE_GEOMETRY: Final = (GEOMETRY, OFFSET, ELASTIC, OF_THE_FILE["inertia"], OF_THE_FILE["rotor"])
"""Suspects in whose place a number of the geometry may stand."""
LENGTHS: Final = 12
"""Most numbers of the geometry that are looked at, as each is another robot."""


def verdict_of(
    robot: Robot, recordings: Sequence[Recorded], everything: FileParameters,
    chosen: NDArray[np.bool_], rows: Sequence[Rows], solved: Solved,
) -> Verdict:  # fmt: skip
    """Whether the fitted model explains its recordings.

    :param everything: all parameters of the file; ``chosen``: which of them were fitted.
    :param rows: of each recording, with all parameters.
    """
    values = everything.values.copy()
    values[chosen] = solved.estimate.values
    made = [
        _Recording.of(robot, everything, recording, made, delay, values)
        for recording, made, delay in zip(recordings, rows, solved.delays, strict=True)
    ]
    court = _Court(robot, everything, chosen, values, solved, made)
    verdict = court.judged(chosen, {})
    masses = np.array([group.kind == "inertia" for group in everything.groups for _ in group.names])
    frozen = court.judged(chosen & ~masses, {}) if (chosen & masses).any() else None
    if any(one.suspect.kind in LIKE_GEOMETRY for one in _found(verdict, frozen)):
        lengths = court.lengths()
        verdict = court.judged(chosen, lengths)
        frozen = frozen and court.judged(chosen & ~masses, lengths)
    return verdict if frozen is None else _simpler(verdict, frozen)


def _found(*verdicts: Verdict | None) -> list[Finding]:
    return [one for verdict in verdicts if verdict is not None for one in verdict.findings]


def _simpler(verdict: Verdict, frozen: Verdict) -> Verdict:
    """Other masses, or the file's and one error? What explains as much with less is a finding too.

    :param frozen: with the file's masses.
    """
    kinds = {one.suspect.kind for one in frozen.findings}
    if verdict.findings or not kinds or OF_THE_FILE["inertia"] in kinds or len(kinds) > 1:
        return verdict
    if frozen.answer != "explains partly" or any(c.left_ratio > 1.0 for c in frozen.channels):
        return verdict
    other = Suspect("the masses that were fitted", "all of them")
    findings = tuple(replace(one, others=(*one.others, other)) for one in frozen.findings)
    return replace(
        verdict, answer="explains partly", findings=findings,
        shifts=np.concatenate([verdict.shifts, frozen.shifts]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Recording:
    """A recording at its rows: (k, n, ...) each, and its efforts function."""

    recorded: Recorded
    rows: Rows
    delay: float
    columns: Array
    missed: Array
    calm: Array
    """All parameters' columns, without noise."""

    @classmethod
    def of(
        cls, robot: Robot, everything: FileParameters, recorded: Recorded, rows: Rows,
        delay: float, values: Array,
    ) -> _Recording:  # fmt: skip
        """With the signals of the errors that every robot may have."""
        smooth = _smooth(everything, values)
        efforts = efforts_of(robot, everything, recorded.carried, smooth, rows.signals)
        columns, missed = columns_of(robot, rows.signals, efforts)
        calm = calm_table(robot, everything, recorded.carried, rows.signals)
        return cls(recorded, rows, delay, columns, missed, calm)


@dataclass(frozen=True, eq=False)
class _Court:
    """All recordings of a fit, to be judged by several sets of parameters and suspects."""

    robot: Robot
    everything: FileParameters
    chosen: NDArray[np.bool_]
    values: Array
    solved: Solved
    recordings: Sequence[_Recording]

    def judged(
        self, free: NDArray[np.bool_], lengths: Mapping[str, tuple[str, Sequence[Array]]]
    ) -> Verdict:
        """With some parameters free to explain the residual, the others as the file has them.

        :param lengths: numbers of the geometry, their units, and their columns by recording.
        """
        kinds = np.array([g.kind for g in self.everything.groups for _ in g.names])
        file = self.everything
        values = np.where(free, self.values, file.values)
        general = suspects_of(self.robot)
        kept = [k for k, one in enumerate(general) if not lengths or one.kind != GEOMETRY]
        suspects = [general[k] for k in kept]
        suspects += [Suspect(GEOMETRY, path, unit) for path, (unit, _) in lengths.items()]
        suspects += [
            Suspect(OF_THE_FILE[kinds[k]], file.names[k], file.units[k])
            for k in np.flatnonzero(~free)
        ]
        cases = []
        for i, one in enumerate(self.recordings):
            rows, effort = one.rows, one.rows.effort
            # The sign of a rate is filtered as the efforts are.
            others = np.where(kinds == "friction", rows.table, one.calm)[..., ~free]
            named = [columns[i][..., None] for _, columns in lengths.values()]
            cases.append(
                Evidence(
                    effort - rows.rest - rows.table @ values + one.delay * rows.change,
                    rows.table[..., free],
                    np.concatenate([rows.change[..., None], one.missed], -1),
                    np.sqrt(np.sum(np.mean(one.missed**2, 0), -1)),
                    np.concatenate([one.columns[..., kept], *named, others], -1),
                    rows.signals.noise, rows.signals.band, rows.counts, self.solved.counts[i],
                    np.sqrt(np.mean(effort**2, 0)), np.std(effort, 0),
                )
            )  # fmt: skip
        e = self.solved.estimate
        prior = (
            (values - file.values)[free], e.prior[free[self.chosen]],
            np.sqrt(np.diag(e.covariance)),
        )  # fmt: skip
        return judge(self.robot.joint_names, suspects, cases, prior, self.solved.response)

    def lengths(self) -> dict[str, tuple[str, list[Array]]]:
        """Derivatives of the measured efforts by numbers of the file's geometry."""
        found = {}
        known = entries(self.robot)
        for path in [path for path in known if path.startswith("geometry.")][:LENGTHS]:
            value, unit = known[path]
            step = STEP * (self.robot.size if unit == "m" else 1.0)
            try:
                pair = [with_entries(self.robot, {path: value + h}) for h in (-step, step)]
                found[path] = (
                    unit,
                    [self._apart(pair, one) / (2.0 * step) for one in self.recordings],
                )
            except (PkmTwinError, ValueError):
                continue  # a number that cannot change alone
        return found

    def _apart(self, pair: Sequence[Robot], one: _Recording) -> Array:
        """Efforts of the second robot less those of the first, shape (k, n)."""
        told = []
        for robot in pair:
            parameters = file_parameters(robot)
            values = _smooth(parameters, self.values)
            efforts = efforts_of(robot, parameters, one.recorded.carried, values, one.rows.signals)
            told.append(efforts(*one.rows.signals.motion))
        return told[1] - told[0]


def _smooth(everything: FileParameters, values: Array) -> Array:
    """Without Coulomb friction: its sign has no derivative, and turns where a rate is near zero."""
    return np.where([name.endswith(".coulomb") for name in everything.names], 0.0, values)
