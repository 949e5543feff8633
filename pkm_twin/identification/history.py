# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A machine's state from a recording, and an SQLite database with one row per recording."""

from __future__ import annotations

import math
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import FileError, ParameterError, PkmTwinError, one_line
from pkm_twin.identification.compare import compare_part, find_idle
from pkm_twin.identification.friction_laws import fit_recordings
from pkm_twin.recordings import ReadOptions, Recording, read
from pkm_twin.robot.plausibility import why_no_torques

MAX_NUMBER: Final = 1e9
"""Largest size of a number: N, N m, kg, Hz or a factor."""
APPLICATION_ID: Final = 0x706B6D74
"""SQLite's application_id of a history: "pkmt"."""
MIN_RECORDINGS: Final = 6
"""Smallest number of recordings of a series that is judged."""
HISTORY: Final = "a history that `pkm-twin check --history` wrote"
_TABLES: Final = """
CREATE TABLE IF NOT EXISTS checks (
    id INTEGER PRIMARY KEY, recorded REAL NOT NULL, judged TEXT NOT NULL, machine TEXT NOT NULL,
    robot TEXT NOT NULL, file TEXT NOT NULL, good INTEGER NOT NULL,
    UNIQUE (machine, recorded, file));
CREATE TABLE IF NOT EXISTS numbers (
    check_id INTEGER NOT NULL REFERENCES checks (id) ON DELETE CASCADE, quantity TEXT NOT NULL,
    part TEXT NOT NULL, value REAL NOT NULL, deviation REAL, unit TEXT NOT NULL,
    PRIMARY KEY (check_id, quantity, part));
"""


@dataclass(frozen=True)
class Measured:
    """One number of a recording, of a joint or an element; ``deviation`` NaN: not known."""

    quantity: str
    part: str
    value: float
    deviation: float
    unit: str


@dataclass(frozen=True, eq=False)
class Series:
    """One number of one machine over its recordings, shape (k,) each; ``time``: s since 1970."""

    machine: str
    quantity: str
    part: str
    unit: str
    time: Array
    value: Array
    deviation: Array

    @property
    def label(self) -> str:
        """Machine, quantity and part in words."""
        return f"{self.machine}: {QUANTITY_NAMES.get(self.quantity, self.quantity)} of {self.part}"

    @property
    def days(self) -> list[datetime]:
        """Times of the recordings."""
        return [datetime.fromtimestamp(time, UTC) for time in self.time]


UNKNOWN_PAYLOAD: Final = "payload beyond the load"
QUANTITY_NAMES: Final = {
    "friction viscous": "viscous friction",
    "friction coulomb": "Coulomb friction",
    UNKNOWN_PAYLOAD: "unknown payload",
}
"""Names in reports of quantities that a history's file names otherwise."""


def measure(recording: Recording) -> list[Measured]:
    """Measure residual, friction and payload by the efforts, stiffness and frequency by deflections.

    Friction and payload are those that `fit` finds, with its standard deviations. What the
    recording or the robot's file lacks, or the motion does not excite, is left out.
    """
    from pkm_twin.identification.deflections import fit_elements
    from stiffness_monitor.modes import has_modes, natural_frequencies

    r, found, compared = recording, list[Measured](), None
    if r.effort is not None and not why_no_torques(r.robot):
        compared = compare_part(r, find_idle(r))
    if compared is not None:
        residuals = zip(r.robot.joint_names, compared.rms.tolist(), r.robot.effort_units, strict=True)
        found = [Measured("residual", name, rms, np.nan, unit) for name, rms, unit in residuals]
        known = 0.0 if r.load is None else r.load.mass
        with suppress(PkmTwinError, ValueError, np.linalg.LinAlgError):
            result, *_ = fit_recordings(r.robot, [r], ("friction", "payload"), (), accept=True)
            owners = {key: g.names[0] for g in result.problem.parameters.groups for key in g.keys(g.values)}
            for one in result.list_numbers("fitted"):
                part, _, law = owners[one.key].rpartition(".")
                if part in r.robot.joint_names and law in ("viscous", "coulomb"):
                    found.append(Measured(f"friction {law}", part, one.after, one.deviation, one.unit))
                elif one.key == ("payload", "mass"):
                    beyond = one.after - known
                    found.append(Measured(UNKNOWN_PAYLOAD, "platform", beyond, one.deviation, one.unit))
    if r.bag is None:
        return found
    try:
        elastic = fit_elements(r.robot, [read(r.source, r.robot, ReadOptions(deflected=True))])
    except PkmTwinError:
        return found
    factors = elastic.list_numbers("fitted")
    found += [Measured("compliance factor", str(n.key[-1]), n.after, n.deviation, "1") for n in factors]
    if factors and has_modes(r.robot):
        changed = r.robot.changed(element_compliance={str(n.key[-1]): n.after for n in elastic.numbers})
        first = float(natural_frequencies(changed, changed.home(), 1)[0])
        found.append(Measured("frequency at home", "first mode", first, np.nan, "Hz"))
    return found


@contextmanager
def _open_database(path: Path) -> Iterator[sqlite3.Connection]:
    try:
        with closing(sqlite3.connect(path, timeout=60.0, isolation_level=None)) as database:
            yield database
    except sqlite3.Error as error:
        raise FileError(path, error, HISTORY) from None


def _check_schema(path: Path, database: sqlite3.Connection, new: bool) -> None:
    """Reject a database that is not a history.

    The application id, or without one exactly the two tables, must match.

    :param new: whether an empty database is good, too.
    :raises ParameterError: by its tables.
    """
    own = database.execute("PRAGMA application_id").fetchone()[0]
    rows = database.execute("SELECT name FROM sqlite_master WHERE type IN ('table', 'view')").fetchall()
    tables = {str(name) for (name,) in rows}
    if own == APPLICATION_ID or (own == 0 and tables in [{"checks", "numbers"}, *([set()] * new)]):
        return
    found = f"a database with {len(tables)} tables: {', '.join(sorted(tables))}"
    raise ParameterError(str(path), one_line(found, 100), HISTORY)


def check_file(path: Path) -> None:
    """Reject a file that exists and is no history, before anything is computed for it.

    :raises ParameterError: by the file.
    """
    if path.exists():
        with _open_database(path) as database:
            _check_schema(path, database, new=True)


def _check_row(where: str, time: Any, value: Any, deviation: Any) -> None:
    """Reject numbers that no recording gives.

    :param deviation: None or NaN where it is not known.
    :raises ParameterError: by the number.
    """
    known = None if deviation is None or deviation != deviation else deviation
    for what, number, low, high in (
        ("time", time, 0.0, 253_402_300_799.0),
        ("value", value, -MAX_NUMBER, MAX_NUMBER),
        ("deviation", 0.0 if known is None else known, 0.0, MAX_NUMBER),
    ):
        if not isinstance(number, (int, float)) or not low <= number <= high:
            shown = one_line(str(number), 40)
            raise ParameterError(f"{where}: {what}", shown, f"a number, {low:g} to {high:g}")


def append(
    path: Path, machine: str, robot: str, file: Path, recorded: float, good: bool, numbers: Sequence[Measured]
) -> None:
    """Add one check to a history; a check of the same recording takes the place of the older one.

    One short transaction: any number of processes may write, also from other machines on a shared
    disk with locks.

    :raises ParameterError: the file is no history, or stays locked; a number that is none.
    """
    when = datetime.now(UTC).isoformat(timespec="seconds")
    row = recorded, when, machine, robot, os.fspath(file), int(good)
    for one in numbers:
        _check_row(f"{one.quantity} of {one.part}", recorded, one.value, one.deviation)
    with _open_database(path) as database:
        database.execute("PRAGMA foreign_keys = ON")
        database.execute("BEGIN IMMEDIATE")
        _check_schema(path, database, new=True)
        database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        for statement in _TABLES.split(";")[:-1]:
            database.execute(statement)
        key = database.execute(
            "INSERT OR REPLACE INTO checks (recorded, judged, machine, robot, file, good) VALUES (?, ?, ?, ?, ?, ?)",
            row,
        ).lastrowid
        # SQLite stores NaN as NULL.
        database.executemany(
            "INSERT INTO numbers VALUES (?, ?, ?, ?, ?, ?)",
            [(key, n.quantity, n.part, n.value, n.deviation, n.unit) for n in numbers],
        )
        database.execute("COMMIT")


def append_recording(path: Path, recording: Recording, file: Path, good: bool, machine: str | None = None) -> None:
    """Measure a recording and add it to a history; errors as of :func:`append`.

    :param machine: its name in the history; default: the robot's.
    """
    robot, first = recording.robot.name, float(recording.stamps[0])
    # By the stamps, ns since 1970; smaller ones are since a start, and the file's age stands for them.
    began = first / 1e9 if first > 1e17 else file.stat().st_mtime
    append(path, machine or robot, robot, file, began, good, measure(recording))


def read_history(path: Path, machine: str | None = None) -> list[Series]:
    """Read all series of a history, by machine, quantity and part, in the order of recording.

    :raises ParameterError: no such file, no history, or a number that is none.
    """
    if not path.is_file():
        raise FileError(path, FileNotFoundError(), HISTORY)
    with _open_database(path) as database:
        _check_schema(path, database, new=False)
        rows = database.execute(
            "SELECT machine, quantity, part, unit, recorded, value, deviation FROM numbers "
            "JOIN checks ON checks.id = check_id ORDER BY machine, quantity, part, unit, recorded"
        ).fetchall()
    grouped: dict[tuple[str, str, str, str], list[tuple[float, float, float]]] = {}
    for name, quantity, part, unit, time, value, deviation in rows:
        where = one_line(f"{path}: {quantity} of {part}, {name}", 100)
        if not all(isinstance(word, str) for word in (name, quantity, part, unit)):
            raise ParameterError(where, "no text", "names and units as text")
        _check_row(where, time, value, deviation)
        if machine is None or name == machine:
            known = np.nan if deviation is None else float(deviation)
            grouped.setdefault((name, quantity, part, unit), []).append((time, value, known))
    return [Series(*key, *np.array(values).T) for key, values in grouped.items()]


@dataclass(frozen=True, eq=False)
class Judged:
    """A series with its control limits.

    ``centre``, ``low``, ``high``: of the first ``baseline`` recordings, NaN where these are too
    few. ``beyond``: which recordings are outside, (k,). ``change``: index of the first recording
    after the most likely change of the mean, or None; ``chance`` that there is such a one without
    any; ``before`` and ``after``: means on its sides.
    """

    series: Series
    baseline: int
    centre: float
    low: float
    high: float
    beyond: NDArray[np.bool_]
    change: int | None
    chance: float
    before: float
    after: float

    @property
    def known(self) -> bool:
        """True if the series has enough recordings to be judged."""
        return len(self.series.value) >= MIN_RECORDINGS

    @property
    def drifts(self) -> bool:
        """The mean has changed, or the last recording is outside the limits."""
        return self.change is not None or bool(self.beyond[-1])

    @property
    def change_time(self) -> str | None:
        """Time at which the mean changed, as text; None if it did not."""
        return None if self.change is None else self.series.days[self.change].isoformat(timespec="minutes")

    @property
    def line(self) -> str:
        """One line of text on the series."""
        s = self.series
        text = f"{s.label}: {s.value[-1]:.4g} {s.unit}"
        if not self.known:
            return f"{text}, not judged"
        text += f", control limits {self.low:.4g} to {self.high:.4g}"
        if self.change is not None:
            move = f"from {self.before:.4g} to {self.after:.4g} {s.unit}"
            return f"{text}; DRIFT: {move} on {self.change_time}"
        return text + "; DRIFT: the last recording is outside the control limits" * self.drifts

    def as_json(self) -> dict[str, Any]:
        """Plain data for a script; NaN is not known."""
        s = self.series
        return {
            "machine": s.machine,
            "quantity": s.quantity,
            "part": s.part,
            "unit": s.unit,
            "recordings": len(s.value),
            "last": s.value[-1],
            "centre": self.centre,
            "low": self.low,
            "high": self.high,
            "beyond": int(self.beyond.sum()),
            "last_beyond": bool(self.beyond[-1]),
            "changed": self.change_time,
            "chance": self.chance,
            "before": self.before,
            "after": self.after,
            "drifts": self.drifts,
        }


def judge_history(path: Path, machine: str | None, baseline: int, false_alarm: float) -> list[Judged]:
    """Judge every series of a history, or of one machine in it, as :func:`judge_series`.

    :param false_alarm: chance of a false alarm in any series, shared evenly (Bonferroni).
    :raises ParameterError: no history, or one without numbers of this machine.
    """
    found = read_history(path, machine)
    if not found:
        wanted = f" of a machine {machine!r}" if machine else ""
        raise ParameterError(str(path), "no numbers", f"recordings with efforts{wanted}")
    return [judge_series(one, baseline, false_alarm / len(found)) for one in found]


def judge_series(series: Series, baseline: int, alarm: float) -> Judged:
    """Find the control limits and a change of the mean of one series.

    Limits: where a single further recording lies but for the chance ``alarm``, by mean and standard
    deviation of the first ``baseline`` recordings (Student's t). The change: of all splits with two
    recordings or more on each side the one with the greatest Student's t of the means; the chance
    is that of any split (Bonferroni), for errors that are normal and independent.

    :param alarm: chance of a false alarm of this series.
    """
    from scipy import stats  # type: ignore[import-untyped]

    y, k = series.value, len(series.value)
    if k < MIN_RECORDINGS:
        none = math.nan
        return Judged(series, 0, none, none, none, np.zeros(k, bool), None, none, none, none)
    first = min(baseline, k)
    mean, spread = float(y[:first].mean()), float(y[:first].std(ddof=1))
    reach = stats.t.ppf(1.0 - alarm / 2.0, first - 1) * spread * math.sqrt(1.0 + 1.0 / first)
    beyond = np.abs(y - mean) > reach
    beyond[:first] = False
    splits = np.arange(2, k - 1)
    sums, squares = np.cumsum(y - mean), np.cumsum((y - mean) ** 2)
    left = sums[splits - 1] / splits
    right = (sums[-1] - sums[splits - 1]) / (k - splits)
    within = squares[-1] - splits * left**2 - (k - splits) * right**2
    # The variation of a constant by rounding is not noise.
    least = (1e-12 * (abs(mean) + float(np.abs(y).max()))) ** 2
    noise = np.sqrt(np.maximum(within, k * least) / (k - 2))
    apart = np.abs(right - left) / np.sqrt(1.0 / splits + 1.0 / (k - splits))
    scores = np.divide(apart, noise, out=np.zeros(len(splits)), where=noise > 0.0)
    best = int(scores.argmax())
    chance = min(1.0, 2.0 * float(stats.t.sf(scores[best], k - 2)) * len(splits))
    change = int(splits[best]) if chance < alarm else None
    return Judged(
        series,
        first,
        mean,
        mean - reach,
        mean + reach,
        beyond,
        change,
        chance,
        float(mean + left[best]),
        float(mean + right[best]),
    )
