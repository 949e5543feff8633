# SPDX-License-Identifier: Apache-2.0
"""Recordings of a robot as one linear least-squares problem in the parameters of its file.

Efforts may be late against positions, by some samples and alike in all joints: a drive that holds
its torque for a period would else look like friction. How late is fitted too, for each recording.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import PkmTwinError, SingularityError, UnreachableError
from pkm_twin.identification.estimation import Estimate, estimate
from pkm_twin.identification.identifiable import Kind
from pkm_twin.identification.noise import EXACT
from pkm_twin.identification.parameters import FileParameters, file_parameters
from pkm_twin.identification.plausible import recording_fault
from pkm_twin.identification.rows import LATE, Rows, prior_scales, rows_of
from pkm_twin.machine.friction import LAWS, FrictionLaw
from pkm_twin.recordings import Recording
from pkm_twin.robot.robot import Robot

LOADED: Final = frozenset(name for name, law in LAWS.items() if law.share is not FrictionLaw.share)
"""Laws that grow with the load."""
LOAD_PASSES: Final = 2
FEW: Final = 5.0
"""Independent measured values for each fitted number, below which there are too few."""
WORSE: Final = 1.2
"""Held-out residual of a joint over that of the file's values that a machine like the file's does
not leave."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Recordings as one least-squares problem in some of the parameters of a robot's file.

    ``everything``: all parameters, ``whole``: rows with all of them, by recording. ``what``: the
    kinds that are fitted.
    """

    robot: Robot
    what: tuple[Kind, ...]
    everything: FileParameters
    whole: tuple[Rows, ...]

    @classmethod
    def of(
        cls, robot: Robot, recordings: Sequence[Recording], what: Sequence[Kind],
        passes: int = LOAD_PASSES, progress: Callable[[int], None] | None = None,
    ) -> Problem:  # fmt: skip
        """Filter recordings.

        :param passes: in which friction that grows with the load is taken by the load of the
            fitted machine, not of the file's.
        :param progress: called with the number of recordings that are done.
        """
        everything, whole = file_parameters(robot), []
        for i, recording in enumerate(recordings):
            try:
                whole.append(rows_of(robot, everything, recording))
            except (UnreachableError, SingularityError) as error:
                raise PkmTwinError(
                    f"{recording.name}: {error} (positions of this machine, in rad and m?)"
                ) from None
            if progress is not None:
                progress(i + 1)
        problem = cls(robot, tuple(what), everything, tuple(whole))
        for _ in range(passes if set(robot.laws) & LOADED else 0):
            problem = replace(problem, everything=replace(everything, loads=problem.values))
            problem = problem.again([made.how.window for made in problem.whole])
        return problem

    def again(
        self, windows: Sequence[int], progress: Callable[[int], None] | None = None
    ) -> Problem:
        """The same recordings, differentiated with other windows."""
        whole = []
        for i, (made, window) in enumerate(zip(self.whole, windows, strict=True)):
            whole.append(made.again(self.everything, window))
            if progress is not None:
                progress(len(self.whole) + i + 1)
        return replace(self, whole=tuple(whole))

    @cached_property
    def parameters(self) -> FileParameters:
        """Those that are fitted."""
        return file_parameters(self.robot, self.what)

    @cached_property
    def chosen(self) -> Mask:
        """Which of all parameters they are."""
        groups = self.everything.groups
        return np.array([group.kind in self.what for group in groups for _ in group.names])

    @cached_property
    def rows(self) -> tuple[Rows, ...]:
        """With these parameters alone."""
        return tuple(made.only(self.chosen, self.everything.values) for made in self.whole)

    @cached_property
    def columns(self) -> Array:
        """Of parameters and delays, (samples, n, both): the fitted rows one after the other."""
        used = [made.fitted for made in self.rows]
        # Late by a delay is less the delay times the change.
        late = [
            np.concatenate([-made.change * (i == j) for j, made in enumerate(used)])
            for i in range(len(used))
        ]
        table = np.concatenate([made.table for made in used])
        return np.concatenate([table, np.stack(late, -1)], -1)

    @cached_property
    def both(self) -> Estimate:
        """The parameters by least squares, then how late the efforts of each recording are, s."""
        used, count = [made.fitted for made in self.rows], len(self.rows)
        target, effort, counts = (
            np.concatenate([getattr(made, name) for made in used])
            for name in ("target", "effort", "counts")
        )
        p, table = self.parameters, self.columns
        scales = prior_scales(p, table[..., :-count], effort)
        return estimate(
            table, target, np.append(p.values, np.zeros(count)),
            np.append(scales, [LATE * made.period for made in used]), p.cones, counts,
        )  # fmt: skip

    @cached_property
    def estimate(self) -> Estimate:
        """Of the parameters alone."""
        e, k = self.both, slice(0, -len(self.rows))
        return replace(
            e, values=e.values[k], covariance=e.covariance[k, k], prior=e.prior[k],
            inverse=e.inverse[k, k],
        )  # fmt: skip

    @property
    def delays(self) -> tuple[float, ...]:
        """How late the efforts of each recording are, s."""
        return tuple(self.both.values[-len(self.rows) :].tolist())

    def response(self, signals: Sequence[Array]) -> Array:
        """What signals (k, n, m) added to the efforts change in the parameters, (p, m)."""
        used = [one[: made.held_from] for one, made in zip(signals, self.rows, strict=True)]
        return self.both.response(self.columns, np.concatenate(used))[: -len(self.rows)]

    @property
    def values(self) -> Array:
        """All parameters, those that are fitted as they were found."""
        values = self.everything.values.copy()
        values[self.chosen] = self.estimate.values
        return values

    def check_count(self) -> None:
        """Reject fewer independent values than the numbers need.

        :raises PkmTwinError: with how many there are.
        """
        directions = self.both.directions
        used = ((made.fitted.counts.sum(), made.signals.band) for made in self.rows)
        values = sum(float(count) * band for count, band in used)
        if values < FEW * directions:
            raise PkmTwinError(
                f"too few samples: {values:.0f} independent efforts for {directions} numbers of "
                f"{', '.join(self.what)}, {FEW * directions:.0f} or more are needed; record a "
                "motion with more changes of speed (`pkm-twin excite`), or fit less with --what"
            )

    def faults(self) -> list[str]:
        """Recordings that this machine cannot have made, in words."""
        found = ((made.recording.name, recording_fault(made)) for made in self.whole)
        return [f"{name}: {fault}" for name, fault in found if fault is not None]

    def worse(self) -> list[str]:
        """Recordings whose held-out part the fitted values predict worse than the file's."""
        robot, told = self.robot, []
        for made in self.rows:
            end, after = made.held_out, self.estimate.values
            old, new = (
                np.sqrt(np.mean(end.counts * (end.target - end.table @ v) ** 2, 0))
                for v in (self.parameters.values, after)
            )
            j = int(np.argmax(new / np.maximum(old, 1e-300)))
            if new[j] > WORSE * old[j] and new[j] > EXACT * np.std(end.effort[:, j]):
                told.append(
                    f"{made.recording.name}: the fitted values leave {new[j]:.3g} "
                    f"{robot.effort_units[j]} of the held-out efforts of {robot.joint_names[j]}, "
                    f"the file's {old[j]:.3g} (another machine, or a motion that is too short or "
                    "changes?)"
                )
        return told
