# SPDX-License-Identifier: Apache-2.0
"""Settings of the node ``delta_dynamics`` that may change while it runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pkm_twin.errors import ParameterError
from pkm_twin.messages.reading import ExtraJoints
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.settings import COUNT, FUTURE, LATE, SECONDS, SHARE, ZERO_STAMP, setting

LimitPolicy = Literal["warn", "reject", "clamp"]
OnStop = Literal["nothing", "zeros", "gravity"]


@dataclass(frozen=True)
class Settings:
    """How the node answers; the robot's own values are in the robot."""

    differentiate: bool = setting(
        False, "for messages without velocities or accelerations: trajectory rejects them, "
        "differentiate computes them",
        name="acceleration", choices={"trajectory": False, "differentiate": True},
    )  # fmt: skip
    order: int = setting(
        2, "polynomial degree of the velocity", name="differentiator.order", low=1, high=4
    )
    window: int = setting(
        25,
        "samples in the window; a slow stream has fewer: those of 24 ms, or of as many ms as "
        "there are samples, and at least 5",
        name="differentiator.window",
        low=3,
        high=1000,
    )
    limit_policy: LimitPolicy = setting(
        "warn", "efforts beyond effort_limits: warn publishes, reject rejects, clamp limits them",
        choices=("warn", "reject", "clamp"),
    )  # fmt: skip
    stale_after: float = setting(
        0.1,
        "largest age of a joint state, and longest gap before the stream stops; also lifespan "
        "and deadline of the published torques, so at most deadline of command_gate",
        **LATE,
    )
    future_tolerance: float = setting(0.1, FUTURE, **SECONDS)
    accept_zero_stamp: bool = setting(False, ZERO_STAMP)
    trip_count: int = setting(5, "rejected joint states in a row that stop the stream", **COUNT)
    recovery_count: int = setting(5, "accepted joint states in a row that restart it", **COUNT)
    extra_joints: ExtraJoints = setting(
        "refuse", "joints of a trajectory that the model does not have: reject the trajectory, or "
        "give them zero effort",
        choices=("refuse", "zero"),
    )  # fmt: skip
    on_stop: OnStop = setting(
        "nothing",
        "command sent once when the stream stops; must be set with publish_commands",
        choices=("nothing", "zeros", "gravity"),
    )
    singularity_warn: float = setting(0.05, "warn below this singularity index", **SHARE)
    singularity_stop: float = setting(0.01, "stop below this singularity index", **SHARE)

    def __post_init__(self) -> None:
        if not self.singularity_stop <= self.singularity_warn:
            raise ParameterError(
                "singularity_warn",
                self.singularity_warn,
                f"at least singularity_stop, {self.singularity_stop:g}",
            )
        if not self.order + 2 <= self.window:
            raise ParameterError(
                "differentiator.window", self.window, f"at least order + 2, {self.order + 2}"
            )

    @property
    def window_time(self) -> float:
        """Longest window, s."""
        return 1e-3 * max(self.window - 1, 24)

    @property
    def stamp_rules(self) -> StampRules:
        """What the stamp of a joint state has to keep to."""
        return StampRules(
            accept_zero=self.accept_zero_stamp,
            future_tolerance=round(self.future_tolerance * SECOND),
            max_age=round(self.stale_after * SECOND),
        )
