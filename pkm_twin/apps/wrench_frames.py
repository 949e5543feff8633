# SPDX-License-Identifier: Apache-2.0
"""The frame of a bag's wrenches, by one rule with the nodes."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Annotated, Any, Final

import typer

from pkm_twin.errors import MessageError
from pkm_twin.messages.stamps import StampRules
from pkm_twin.messages.wrenches import WrenchSample, read_wrench
from pkm_twin.options import OptionalText, shared_options
from pkm_twin.streams.wrench import PLATFORM, WrenchSettings


@dataclass(frozen=True)
class WrenchFrames:
    """Wrenches of one frame are accepted, as a node accepts them.

    ``wrench_frame``: as the node's parameter; None is the platform's or the base frame, whichever
    comes first. ``base_frame``: has base axes; every other frame turns with the platform.
    """

    wrench_frame: str | None = None
    base_frame: str = WrenchSettings.base_frame

    def reader(self) -> Callable[[Any, int], WrenchSample]:
        """A function that reads a bag's geometry_msgs/WrenchStamped and its log time, ns.

        It raises MessageError for a message that is rejected.
        """
        rules, accepted = StampRules(future_tolerance=2**62), self.wrench_frame

        def read(message: Any, now: int) -> WrenchSample:
            nonlocal accepted
            given = message.header.frame_id
            if accepted is None and given in (PLATFORM, self.base_frame):
                accepted = given
            try:
                return read_wrench(message, now, rules, accepted or PLATFORM, accept_empty=False)
            except MessageError as error:
                if error.reason != "frame" or not given:
                    raise
                raise MessageError(
                    "frame", f"{error}; --wrench-frame accepts a frame that turns with the "
                    "platform, --base-frame one with base axes"
                ) from None  # fmt: skip

        return read


USUAL: Final = WrenchFrames()
FRAMES: Final = ContextVar("frames", default=USUAL)
"""The frames of the command that runs."""


def _options(
    wrench_frame: Annotated[
        OptionalText,
        typer.Option(
            help="accepted frame of a bag's wrenches, which turns with the platform; default: "
            "platform or --base-frame, whichever comes first"
        ),
    ] = None,
    base_frame: Annotated[
        str, typer.Option(help="frame of a bag's wrenches with base axes")
    ] = WrenchSettings.base_frame,
) -> None:
    del wrench_frame, base_frame


wrench_frames = shared_options(_options, FRAMES, WrenchFrames)
"""Gives a command that reads bags the options of their wrenches' frames."""
