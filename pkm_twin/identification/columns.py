# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Columns of the numbers of a robot's file and of usual errors, at the rows of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.identification.evidence import Signals, Spectra
from pkm_twin.identification.judge import ALL_JOINTS
from pkm_twin.identification.rows import Rows
from pkm_twin.identification.samples import Motion
from pkm_twin.identification.suspects import DELAY_DEVIATION, GAIN, GAIN_DEVIATION, Lengths, list_errors
from pkm_twin.identification.words import USUAL_SCALE
from pkm_twin.machine.friction import list_reversal_keys

MASS_ERROR: Final = 0.3
"""Prior deviation of a mass or a rotor, as a part of it."""
OFFSET_SHARE: Final = 0.1
"""Prior deviation of a current sensor's offset, as a part of the joint's efforts."""
ERROR_SHARE: Final = 0.03
"""Prior deviation of an error without a usual size, as a part of the efforts."""


@dataclass(frozen=True, eq=False)
class Columns:
    """The model of a recording around the file: k rows, n joints, c columns.

    ``certain``: efforts by the file's values, (k, n); ``columns``: derivatives, (k, n, c).
    ``fast``, ``fast_certain``: their parts that grow with the square of the rate of time.
    ``deviation``: of the prior; ``low``, ``high``: least and greatest value, less the file's;
    ``kinds``: friction, masses, payload, offset or error, (c,) each.
    """

    rows: Rows
    certain: Array
    columns: Array
    fast_certain: Array
    fast: Array
    deviation: Array
    low: Array
    high: Array
    kinds: tuple[str, ...]
    turning: Mask
    """Friction, whose sign is that of the velocity, (c,)."""
    gains: int = 0
    """Number of gain columns, which stand last: one for each joint, and one for all joints."""

    @classmethod
    def from_rows(cls, rows: Rows) -> Columns:
        """Return the model of the recorded motion, with the usual errors."""
        numbers = _differentiate(rows, rows.table, rows.rest, rows.signals.motion)
        size = np.maximum(np.sqrt(np.mean(rows.effort**2, 0)), 1e-300)
        values = rows.model.parameters.values
        errors, _ = list_errors(rows, values)
        lengths = Lengths.from_robot(rows.model.robot)
        tables = [
            -rows.change[..., None],
            np.broadcast_to(np.eye(len(size)), (*rows.effort.shape, len(size))),
        ]
        deviation, kinds = [DELAY_DEVIATION, *(OFFSET_SHARE * size)], ["error", *["offset"] * len(size)]
        gains = [(one, column) for one, column in errors if one.kind == GAIN]
        errors = [(one, column) for one, column in errors if one.kind != GAIN]
        for one, column in errors:
            rms = np.sqrt(np.mean(column**2, 0))
            j = int(rms.argmax())
            if rms[j] > 0.0 and one.where != ALL_JOINTS:
                tables.append(column[..., None])
                deviation.append(one.usual or ERROR_SHARE * size[j] / rms[j])
                kinds.append("error")
        tables.append(lengths.columns(rows, values))
        deviation += [float(one.usual or 0.0) for one in lengths.suspects]
        tables.append(np.stack([column for _, column in gains], -1))
        deviation += [GAIN_DEVIATION] * len(gains)
        kinds += ["error"] * (len(lengths.suspects) + len(gains))
        more = np.concatenate(tables, -1)
        count = more.shape[-1]
        scales = np.arange(count) >= count - len(gains)
        return replace(
            numbers,
            columns=np.concatenate([numbers.columns, more], -1),
            fast=np.concatenate([numbers.fast, 0.0 * more], -1),
            deviation=np.concatenate([numbers.deviation, deviation]),
            low=np.concatenate([numbers.low, np.where(scales, 1.0 - USUAL_SCALE, -np.inf)]),
            high=np.concatenate([numbers.high, np.where(scales, 1.0 - 1.0 / USUAL_SCALE, np.inf)]),
            kinds=(*numbers.kinds, *kinds),
            turning=np.concatenate([numbers.turning, np.zeros(count, np.bool_)]),
            gains=len(gains),
        )

    def with_motion(self, motion: Motion, turned: Array, order: Sequence[int] | None) -> Columns:
        """Return the model of another motion with the same errors.

        :param turned: 1 or -1 where the joint's velocity has the other sign, (n,). ``order``: the
            joint whose friction each joint has.
        :raises PkmTwinError: a motion that the machine cannot make.
        """
        table, rest = self.rows.model.columns(motion)
        rubs = np.array([g.kind == "friction" for g in self.rows.model.parameters.groups for _ in g.names])
        # The sign of a velocity is filtered as the efforts are.
        own = self.rows.table[..., rubs] * turned[:, None]
        table[..., rubs] = own if order is None else own[:, list(order)]
        made = _differentiate(self.rows, table, rest, motion)
        count = made.columns.shape[-1]
        return replace(
            self,
            certain=made.certain,
            fast_certain=made.fast_certain,
            columns=np.concatenate([made.columns, self.columns[..., count:]], -1),
        )

    @property
    def payload(self) -> Mask:
        """Columns of the payload, (c,); the first is its mass."""
        return np.array([kind == "payload" for kind in self.kinds])

    def spectra(
        self,
        effort: Array | None = None,
        inner: slice = slice(None),
        rate: float = 1.0,
        order: Sequence[int] | None = None,
    ) -> Spectra:
        """Return the statistics of some rows, with other efforts, or time at another rate."""
        r, s, more = self.rows, self.rows.signals, rate**2 - 1.0
        joints = slice(None) if order is None else list(order)
        return Spectra.from_signals(
            Signals(
                (self.certain + more * self.fast_certain)[inner],
                (self.columns + more * self.fast)[inner],
                (r.effort if effort is None else effort)[inner][:, joints],
                r.counts[inner],
                s.noise[joints],
                s.band,
            )
        )


def _differentiate(rows: Rows, table: Array, rest: Array, motion: Motion) -> Columns:
    """Return the columns of the file's numbers, of a motion."""
    p, robot = rows.model.parameters, rows.model.robot
    standing, rest_standing = rows.model.columns(replace(motion, qd=0 * motion.qd, qdd=0 * motion.qdd))
    rubs = np.array([g.kind == "friction" for g in p.groups for _ in g.names])
    quick = np.where(rubs, 0.0, table - standing)
    told = np.maximum(np.sqrt(np.mean((rows.rest + rows.table @ p.values) ** 2, 0)), 1e-300)
    columns, fast, deviation, low = [], [], list[float](), list[float]()
    kinds, turning = list[str](), list[bool]()
    for where, group in zip(p.slices, p.groups, strict=True):
        own, inertial, values = table[..., where], quick[..., where], group.values
        count, word = len(values), group.names[0].rpartition(".")[2]
        kind: str = group.kind
        least = np.full(count, -np.inf)
        if kind == "inertia":
            # All numbers of a body together: its mass.
            own, inertial = ((one @ values)[..., None] for one in (own, inertial))
            count, kind, spread, least = 1, "masses", np.array([MASS_ERROR]), np.array([-1.0])
        elif kind == "payload":
            # A payload's centre is within 40 % of the machine's size.
            reach, most = 0.4 * robot.size, max(float(p.scales[where][0]), 1e-9)
            spread = most * np.array([1.0, *[reach] * 3, *[reach**2] * 6])
            least[0] = -values[0]
        elif kind == "rotor":
            kind, least = "masses", -values
            spread = np.where(values > 0.0, MASS_ERROR * values, p.scales[where])
        else:
            shown = np.sqrt(np.mean(rows.table[..., where] ** 2, 0))
            j = int(shown.max(1).argmax())
            share = OFFSET_SHARE if word.endswith("offset") else 0.3
            spread = share * told[j] / np.maximum(shown[j], 1e-12 * told[j] + 1e-300)
            least = least if word.endswith("offset") else -values
        columns.append(own)
        fast.append(inertial)
        deviation += spread.tolist()
        low += least.tolist()
        kinds += [kind] * count
        turning += [kind == "friction" and word in {*list_reversal_keys(), "viscous"}] * count
    quick_rest = (rest - rest_standing) + quick @ p.values
    return Columns(
        rows,
        rest + table @ p.values,
        np.concatenate(columns, -1),
        quick_rest,
        np.concatenate(fast, -1),
        np.array(deviation),
        np.array(low),
        np.full(len(low), np.inf),
        tuple(kinds),
        np.array(turning),
    )
