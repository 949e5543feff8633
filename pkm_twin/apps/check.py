# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin check``: compare a recording with the model of its machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.apps.check_causes import Causes, causes_of
from pkm_twin.apps.check_efforts import ModelBand, judged_efforts
from pkm_twin.apps.check_motion import OF_MOTION, Bounds, motion_items
from pkm_twin.apps.limits import ranges
from pkm_twin.apps.loads import Load
from pkm_twin.apps.recorded import Recording
from pkm_twin.apps.topics import Topics
from pkm_twin.apps.verdict import Item, Verdict, judged_item
from pkm_twin.errors import SingularityError, UnreachableError

Array = NDArray[np.float64]
# Samples computed at a time, so that memory stays flat.
_BLOCK = 4096
# Of the differentiator: degree of the velocity's polynomial, samples.
_ORDER, _WINDOW = 3, 9
DEVIATIONS: Final = (1, 2, 3)
"""Of the model, inside which residuals are counted."""


@dataclass(frozen=True)
class CheckReport:
    """All items; the whole is good where none is bad.

    ``bands``: by joint; empty where the robot's file has no ``uncertainty``, or torques were not
    judged.
    """

    bag: str
    robot: str
    items: tuple[Item, ...]
    topics: Topics
    load: Load | None
    unsure: bool
    """Whether the robot's file has an ``uncertainty``."""
    bands: Mapping[str, ModelBand]
    unjudged: str = ""
    """Why there is no verdict; empty where there is one."""
    causes: tuple[str, ...] = ()
    """What explains efforts that contradict the model: with it they agree."""
    findings: tuple[str, ...] = ()
    """What `fit` says of them, where nothing explains them."""

    @property
    def answer(self) -> str:
        """``bad`` where an item is, ``not judged`` where too few efforts were compared."""
        if self.named(Verdict.BAD):
            return "bad"
        return "not judged" if self.unjudged else "good"

    @property
    def good(self) -> bool:
        """The recording was judged, and no item is bad."""
        return self.answer == "good"

    def named(self, verdict: Verdict) -> list[str]:
        """What got this verdict."""
        return [item.what for item in self.items if item.verdict is verdict]

    def as_json(self) -> dict[str, Any]:
        """Plain data for a script."""
        return {
            "bag": self.bag,
            "robot": self.robot,
            "topics": asdict(self.topics),
            "payload": None if self.load is None else self.load.as_json(),
            "items": [asdict(item) for item in self.items],
            "uncertainty": {
                joint: {
                    "effort_deviation_rms": band.deviation_rms,
                    "effort_unit": band.unit,
                    "share_within_deviations": {str(k): v for k, v in band.share_within.items()},
                }
                for joint, band in self.bands.items()
            }
            or None,
            "answer": self.answer,
            "not_judged": self.unjudged or None,
            "causes": list(self.causes),
            "findings": list(self.findings),
            "good": self.good,
        }


def judged(
    recording: Recording, bounds: Bounds | None = None, thorough: bool = True
) -> CheckReport:
    """Compare a recording with the model.

    :param thorough: look longer for the cause of efforts that contradict the model.
    """
    bounds = bounds or Bounds()
    path = recording.source
    items = [*_file(recording, bounds), *motion_items(recording, bounds), *_limits(recording)]
    items.append(_singularity(recording, bounds))
    moved = all(item.verdict is not Verdict.BAD or item.what not in OF_MOTION for item in items)
    efforts = judged_efforts(recording, bounds)
    items += efforts.items
    r = recording
    # Of positions that are none the efforts say nothing.
    causes = causes_of(r, efforts, bounds.residual, thorough) if moved else Causes()
    return CheckReport(
        str(path), r.robot.name, tuple(items), r.topics, r.load, bool(r.robot.uncertainty),
        efforts.bands, efforts.unjudged, causes.explained, causes.findings,
    )  # fmt: skip


def _file(r: Recording, bounds: Bounds) -> list[Item]:
    if r.bag is None:
        found = f"a table of {len(r.time)} rows, all numbers finite"
        return [Item("file", found, "finite numbers", Verdict.GOOD)]
    report = r.bag.report
    items = [
        Item(
            "file",
            "; ".join(report.warnings) or "complete; checksums and counts agree",
            "complete and consistent",
            Verdict.BAD
            if report.miscounts
            else Verdict.UNKNOWN
            if report.warnings
            else Verdict.GOOD,
        )
    ]
    refused = sum(r.rejected.values())
    total = r.message_count
    reasons = ", ".join(f"{k}: {v}" for k, v in r.rejected.items())
    value = f"{refused} of {total}" + (f" ({reasons}; first: {r.first_reject})" if refused else "")
    items.append(
        judged_item(
            "messages that a node rejects",
            value,
            f"at most {100 * bounds.rejected:g} %",
            refused <= bounds.rejected * total,
        )
    )
    return items


def _limits(r: Recording) -> list[Item]:
    """Effort limits; position and velocity limits are already a node's reason to refuse."""
    effort = r.robot.limits.effort
    bounds = list(ranges(r.robot))
    if effort is not None:
        bounds.append(("effort", -effort, effort, list(r.robot.effort_units)))
    recorded = {"position": r.q, "velocity": r.qd, "effort": r.effort}
    items = []
    for what, low, high, units in bounds:
        values = recorded[what]
        if values is None:
            continue
        used = np.maximum((values - high).max(0), (low - values).max(0))
        # Joints that turn and joints that slide have no common margin.
        worst = {u: max(x for x, v in zip(used, units, strict=True) if v == u) for u in units}
        margins = ", ".join(f"{-most:.4g} {unit}" for unit, most in worst.items())
        good = bool((used <= 0).all())
        items.append(judged_item(f"{what} limits", f"least margin {margins}", "0 or more", good))
    return items


def _singularity(r: Recording, bounds: Bounds) -> Item:
    what = "singularity index"
    bound = f"{bounds.singularity:g} or more"
    try:
        measure = r.robot.singularity(r.q)
    except (UnreachableError, SingularityError) as error:
        return Item(what, str(error), bound, Verdict.BAD)
    worst = int(measure.argmin())
    value = f"{measure[worst]:.4f} at {r.time[worst]:.3f} s"
    return judged_item(what, value, bound, bool(measure[worst] >= bounds.singularity))
