# SPDX-License-Identifier: Apache-2.0
"""Options of the frame of a bag's wrenches."""

from __future__ import annotations

from contextvars import ContextVar
from typing import Annotated, Final

import typer

from pkm_twin.options import OptionalText, shared_options
from pkm_twin.recordings.recording import USUAL, WrenchFrames
from pkm_twin.streams.wrench import WrenchSettings

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
