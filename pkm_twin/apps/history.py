# SPDX-License-Identifier: Apache-2.0
"""A machine's state from a recording, and an SQLite database with one row per recording."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin.apps.check_efforts import compared_of, idle_of
from pkm_twin.apps.describe import why_no_torques
from pkm_twin.apps.recorded import Recording
from pkm_twin.errors import FileError, PkmTwinError
from pkm_twin.identification.compare import by_held
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]

WAIT: Final = 60.0
"""How long a writer waits for the others, s."""
BLOCKS: Final = 20
"""Stretches of a recording whose errors are taken as independent of each other."""
DISTINCT: Final = 1e-4
"""Least singular value, of unit columns, of numbers that a motion tells apart."""
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

    What the recording or the robot's file lacks is left out. Friction and payload come from one
    least squares of the residual on the velocity, its sign, an offset and a mass at the platform;
    their deviations from how stretches of the recording differ, so that errors may be correlated.
    """
    return [*_efforts(recording), *_elasticity(recording)]


def _one_kilogram(robot: Robot, q: Array, qd: Array, qdd: Array, wrench: Array) -> Array:
    load = robot.payload
    more = robot.changed(payload={"mass": load.mass + 1.0})
    return inverse_dynamics(more, q, qd, qdd, wrench) - inverse_dynamics(robot, q, qd, qdd, wrench)


def _efforts(r: Recording) -> list[Measured]:
    if r.effort is None or why_no_torques(r.robot):
        return []
    c = compared_of(r, idle_of(r))
    n, units = len(r.robot.joint_names), r.robot.effort_units
    if c is None:
        return []
    carried = None if r.load is None else r.load.on(r.robot)
    moves = [track.moves(c.how) for track in c.tracks]
    columns = [
        np.concatenate(
            [track.qd * moving, np.sign(track.qd) * moving, moving,
             by_held(r.robot, carried, track, _one_kilogram)], 1,
        )
        for track, moving in zip(c.tracks, moves, strict=True)
    ]  # fmt: skip
    rate, sign, moving, mass = np.split(c.filtered(columns), 4, 1)
    # Where standing still is in the filter's reach, friction's sign is not known.
    rows = moving > 0.8
    if rows.sum() < 20 * (3 * n + 2):
        return []
    # How late the efforts are is fitted with the others.
    residual = c.residual - c.late * c.change
    table = np.zeros((*residual.shape, 3 * n + 2))
    for k in range(n):
        table[:, k, 3 * k] = rate[:, k]
        table[:, k, 3 * k + 1] = sign[:, k]
        table[:, k, 3 * k + 2] = 1.0
    table[..., -2], table[..., -1] = mass, c.change
    count = len(residual)
    block = np.broadcast_to(np.arange(count)[:, None] * BLOCKS // count, rows.shape)
    values, deviations = _fitted(table[rows], residual[rows], block[rows])
    found = []
    for k, name in enumerate(r.robot.joint_names):
        own = c.residual[rows[:, k], k]
        rms = float(np.sqrt(np.mean(own**2))) if len(own) else np.nan
        found.append(Measured("residual", name, rms, np.nan, units[k]))
        viscous = f"{units[k]} s/{r.robot.joint_units[k]}"
        for j, (what, unit) in enumerate((("viscous", viscous), ("coulomb", units[k]))):
            value = values[3 * k + j] + float(getattr(r.robot.friction, what)[k])
            found.append(Measured(f"friction {what}", name, value, deviations[3 * k + j], unit))
    payload = values[-2] + r.robot.payload.mass * (r.load is None)
    found.append(Measured("payload beyond the load", "platform", payload, deviations[-2], "kg"))
    return [number for number in found if np.isfinite(number.value)]


def _fitted(table: Array, target: Array, block: NDArray[np.int64]) -> tuple[Array, Array]:
    """Least squares, and deviations that allow errors to be correlated within a block.

    NaN for columns that the rows do not tell apart from others.
    """
    size = np.linalg.norm(table, axis=0)
    unit = table / np.where(size > 0.0, size, 1.0)
    _, scale, ways = np.linalg.svd(unit, full_matrices=False)
    # A column with a part in a direction that nothing is known of is not known.
    unknown = (np.abs(ways[scale < DISTINCT]) > 1e-2).any(0) | (size == 0.0)
    kept = np.flatnonzero(~unknown)
    values, deviations = np.full((2, len(size)), np.nan)
    if not len(kept):
        return values, deviations
    part = unit[:, kept]
    found, *_ = np.linalg.lstsq(part, target, rcond=None)
    pull = part * (target - part @ found)[:, None]
    sums = np.array([pull[block == b].sum(0) for b in np.unique(block)])
    inverse = np.linalg.inv(part.T @ part)
    spread = inverse @ (sums.T @ sums) @ inverse * len(sums) / max(len(sums) - 1, 1)
    values[kept] = found / size[kept]
    deviations[kept] = np.sqrt(np.diag(spread)) / size[kept]
    return values, deviations


def _elasticity(r: Recording) -> list[Measured]:
    from pkm_twin.apps.elastic_recordings import read_deflected
    from pkm_twin.identification.deflections import fit_elements
    from stiffness_monitor.modes import has_modes, natural_frequencies

    if r.bag is None:
        return []
    try:
        fit = fit_elements(r.robot, [read_deflected(r.bag.report.path, r.robot)])
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
