# SPDX-License-Identifier: Apache-2.0
"""A machine's state from a recording, and an SQLite database with one row per recording."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.apps.check import compared_of, idle_of, recorded_of
from pkm_twin.errors import FileError, PkmTwinError
from pkm_twin.identification.fit import fit
from pkm_twin.recordings import ReadOptions, Recording, read
from pkm_twin.robot.plausibility import why_no_torques

Array = NDArray[np.float64]

WAIT: Final = 60.0
"""How long a writer waits for the others, s."""
SINCE: Final = 1e17
"""Stamps above this, ns, are since 1970; smaller ones are since a start."""
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
        return f"{self.machine}: {WORDS.get(self.quantity, self.quantity)} of {self.part}"


WORDS: Final = {
    "friction viscous": "viscous friction",
    "friction coulomb": "Coulomb friction",
    "payload beyond the load": "unknown payload",
}
"""Quantities whose name in a history's file is not the field's."""


def measure(recording: Recording) -> list[Measured]:
    """Residual, friction and payload by the efforts; stiffness and frequency by deflections.

    Friction and payload are those that `fit` finds, with its standard deviations. What the
    recording or the robot's file lacks, or the motion does not excite, is left out.
    """
    return [*_efforts(recording), *_elasticity(recording)]


def _efforts(r: Recording) -> list[Measured]:
    if r.effort is None or why_no_torques(r.robot):
        return []
    idle = idle_of(r)
    compared = compared_of(r, idle)
    if compared is None:
        return []
    names, units = r.robot.joint_names, r.robot.effort_units
    residuals = zip(names, compared.rms.tolist(), units, strict=True)
    found = [Measured("residual", name, rms, np.nan, unit) for name, rms, unit in residuals]
    loaded, known = r.robot, 0.0
    if r.load is not None:
        loaded, known = r.load.on(r.robot), r.load.mass
    recorded = replace(recorded_of(r, idle), carried=None)
    try:
        numbers = fit(loaded, [recorded], ("friction", "payload"), accept=True).of("fitted")
    except (PkmTwinError, ValueError, np.linalg.LinAlgError):
        return found
    for number in numbers:
        if number.key == ("payload", "mass"):
            what, part, value = "payload beyond the load", "platform", number.after - known
        elif number.key[:2] in (("friction", "viscous"), ("friction", "coulomb")):
            what, part, value = f"friction {number.key[1]}", names[int(number.key[2])], number.after
        else:
            continue
        found.append(Measured(what, part, value, number.deviation, number.unit))
    return found


def _elasticity(r: Recording) -> list[Measured]:
    from pkm_twin.apps.fit import deflected_of
    from pkm_twin.identification.deflections import fit_elements
    from stiffness_monitor.modes import has_modes, natural_frequencies

    if r.bag is None:
        return []
    try:
        deflected = read(r.source, r.robot, ReadOptions(deflected=True))
        fit = fit_elements(r.robot, [deflected_of(deflected)])
    except PkmTwinError:
        return []
    known = fit.of("fitted")
    found = [
        Measured("compliance factor", str(n.key[-1]), n.after, n.deviation, "1") for n in known
    ]
    if known and has_modes(r.robot):
        softer = {str(n.key[-1]): n.after for n in fit.numbers}
        changed = r.robot.changed(element_compliance=softer)
        first = float(natural_frequencies(changed, changed.home(), 1)[0])
        found.append(Measured("frequency at home", "first mode", first, np.nan, "Hz"))
    return found


def recorded_at(recording: Recording, path: Path) -> float:
    """When a recording began, s since 1970: by its stamps, else by the file's age."""
    first = float(recording.stamps[0])
    return first / 1e9 if first > SINCE else path.stat().st_mtime


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    try:
        with closing(sqlite3.connect(path, timeout=WAIT, isolation_level=None)) as base:
            yield base
    except sqlite3.Error as error:
        raise FileError(path, error, HISTORY) from None


def append(
    path: Path,
    machine: str,
    robot: str,
    file: Path,
    recorded: float,
    good: bool,
    numbers: Sequence[Measured],
) -> None:
    """Add one check to a history; a check of the same recording takes the place of the older one.

    One short transaction: any number of processes may write, also from other machines on a shared
    disk with locks.

    :raises ParameterError: the file is no history, or stays locked.
    """
    judged = datetime.now(UTC).isoformat(timespec="seconds")
    row = recorded, judged, machine, robot, os.fspath(file), int(good)
    with _opened(path) as base:
        base.execute("PRAGMA foreign_keys = ON")
        base.execute("BEGIN IMMEDIATE")
        for statement in _TABLES.split(";")[:-1]:
            base.execute(statement)
        base.execute(
            "DELETE FROM checks WHERE machine = ? AND recorded = ? AND file = ?",
            (machine, recorded, os.fspath(file)),
        )
        key = base.execute(
            "INSERT INTO checks (recorded, judged, machine, robot, file, good) "
            "VALUES (?, ?, ?, ?, ?, ?)",
            row,
        ).lastrowid
        base.executemany(
            "INSERT INTO numbers VALUES (?, ?, ?, ?, ?, ?)",
            [(key, n.quantity, n.part, n.value, _known(n.deviation), n.unit) for n in numbers],
        )
        base.execute("COMMIT")


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def read_history(path: Path, machine: str | None = None) -> list[Series]:
    """All series of a history, by machine, quantity and part, in the order of recording.

    :raises ParameterError: no such file, or no history.
    """
    if not path.is_file():
        raise FileError(path, FileNotFoundError(), HISTORY)
    with _opened(path) as base:
        rows = base.execute(
            "SELECT machine, quantity, part, unit, recorded, value, deviation FROM numbers "
            "JOIN checks ON checks.id = check_id ORDER BY machine, quantity, part, unit, recorded"
        ).fetchall()
    grouped: dict[tuple[str, str, str, str], list[tuple[float, float, float]]] = {}
    for name, quantity, part, unit, time, value, deviation in rows:
        if machine is None or name == machine:
            known = np.nan if deviation is None else float(deviation)
            grouped.setdefault((name, quantity, part, unit), []).append((time, value, known))
    return [Series(*key, *np.array(values).T) for key, values in grouped.items()]
