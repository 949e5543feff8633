# SPDX-License-Identifier: Apache-2.0
"""Efforts of motor currents, by torque constants that are given or fitted with known masses.

With the masses known, current = (load + friction) / constant is linear in one over the constant and
in the friction in amperes, and the noise is in the current alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from delta_dynamics import inverse_dynamics
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.identification.rows import Recorded, next_window
from pkm_twin.identification.samples import low_pass, tracks
from pkm_twin.machine.friction import all_keys
from pkm_twin.robot.robot import Robot

FIT: Final = "fit"
KNOWN: Final = 0.1
"""Relative standard deviation from which on a constant is not known."""


@dataclass(frozen=True, eq=False)
class TorqueConstants:
    """N m or N per ampere, at the joints, (n,), and their standard deviations, 0 where given."""

    values: Array
    deviations: Array

    def applied(self, recorded: Recorded) -> Recorded:
        """A recording whose efforts are currents, A, with efforts."""
        return replace(recorded, effort=recorded.effort * self.values)

    def lines(self, robot: Robot) -> list[str]:
        """In words, of those that were fitted."""
        rows = zip(robot.joint_names, self.values, self.deviations, robot.effort_units, strict=True)
        return [
            f"torque constant of {joint}: {value:.4g} +- {deviation:.2g} {unit}/A, from the masses "
            "of the file"
            for joint, value, deviation, unit in rows
            if deviation
        ]


def given_constants(robot: Robot, words: str) -> TorqueConstants:
    """Of one number, or one a joint with commas between.

    :raises ParameterError: other words, or a number that is zero or not finite.
    """
    n = robot.joints_count
    try:
        values = np.array([float(word) for word in words.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape not in ((1,), (n,)) or not (np.isfinite(values) & (values != 0.0)).all():
        raise ParameterError("torque-constant", words, f"{FIT}, one number, or {n} with commas")
    return TorqueConstants(np.broadcast_to(values, (n,)).copy(), np.zeros(n))


def fitted_constants(robot: Robot, recordings: Sequence[Recorded]) -> TorqueConstants:
    """By the file's masses: from recordings whose efforts are currents, A.

    Viscous, Coulomb and load-dependent friction and an offset of the current are free beside.

    :raises PkmTwinError: recordings that do not show a constant.
    """
    values, deviations, windows = _constants(robot, recordings, None)
    # What another differentiation changes is uncertain too.
    other, _, _ = _constants(robot, recordings, [next_window(window) for window in windows])
    return TorqueConstants(values, np.hypot(deviations, other - values))


def _constants(
    robot: Robot, recordings: Sequence[Recorded], windows: Sequence[int] | None
) -> tuple[Array, Array, list[int]]:
    """Constants, standard deviations, and the windows of the differentiation."""
    tables: list[list[Array]] = [[] for _ in robot.joint_names]
    currents: list[list[Array]] = [[] for _ in robot.joint_names]
    used = []
    for i, r in enumerate(recordings):
        window = None if windows is None else windows[i]
        pieces, how = tracks(r.time, r.q, r.effort, r.wrench, window=window)
        used.append(how.window)
        model = robot if r.carried is None else r.carried
        model = model.changed(friction=dict.fromkeys(all_keys(), 0.0))
        for track in pieces:
            load = inverse_dynamics(model, track.q, track.qd, track.qdd, track.wrench)
            way = np.sign(track.qd)
            columns = [load, track.qd, way, np.ones_like(load), np.abs(load) * way, track.effort]
            flat = low_pass(np.concatenate(columns, 1), track.period, how)
            parts = flat.reshape(len(flat), len(columns), -1)
            for j in range(parts.shape[2]):
                tables[j].append(parts[:, :-1, j])
                currents[j].append(parts[:, -1, j])
    found = np.zeros((2, robot.joints_count))
    for j, name in enumerate(robot.joint_names):
        if not tables[j]:
            raise PkmTwinError("the recordings are too short for a torque constant")
        table, current = np.concatenate(tables[j]), np.concatenate(currents[j])
        scale = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
        inverse = np.linalg.pinv(table / scale, rcond=1e-9) / scale[:, None]
        sizes = inverse @ current
        left = current - table @ sizes
        # Neighbouring rows are not independent: by blocks.
        blocks = np.array([inverse[0, part] @ left[part] for part in _parts(len(left))])
        deviation = float(np.sqrt(np.sum(blocks**2)))
        if not deviation < KNOWN * abs(sizes[0]):
            raise PkmTwinError(
                f"the current of {name} does not follow the load ({sizes[0]:.3g} +- "
                f"{deviation:.2g} A per unit of it): move a known payload, or give "
                "--torque-constant"
            )
        found[:, j] = 1.0 / sizes[0], deviation / sizes[0] ** 2
    return found[0], found[1], used


def _parts(count: int) -> list[slice]:
    ends = np.linspace(0, count, 31).astype(int)
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]
