# SPDX-License-Identifier: Apache-2.0
"""The commands ``play`` and ``recover``: bags as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkm_twin.apps.options import SALVAGED, BagPath, Json
from pkm_twin.console import print_json
from pkm_twin.options import OptionalFloat, file_name
from pkm_twin.ros.signals import ignore_signals


def play(
    bag: BagPath,
    rate: Annotated[float, typer.Option(help="speed factor; 1 is the recorded speed")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="restart at the end")] = False,
    clock: Annotated[
        OptionalFloat,
        typer.Option(help="publish /clock at this many Hz, for nodes with use_sim_time"),
    ] = None,
    wait: Annotated[
        float, typer.Option(help="longest wait (s) for a subscriber on every topic")
    ] = 3.0,
    topic: Annotated[list[str], typer.Option(help="play only these topics")] = [],  # noqa: B006
    remap: Annotated[
        list[str], typer.Option(help="FROM:=TO, play a topic under another name")
    ] = [],  # noqa: B006  typer copies it
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bar")] = False,
) -> None:
    """Replay a bag onto ROS topics.

    Works like `ros2 bag play`, on machines that do not have it. The whole bag is checked before
    anything is published. Messages are published in the order of their log time, byte for byte as
    recorded.

    Time stamps in a bag are old, so the nodes reject them unless you use simulated time: set
    use_sim_time on the nodes and give this command --clock 200.
    """
    from pkm_twin.ros.player import play as play_bag

    pairs = dict(_pair(text) for text in remap)
    result = play_bag(
        bag,
        rate=rate,
        loop=loop,
        clock=clock,
        wait_for_subscribers=wait,
        topics=topic or None,
        remap=pairs,
        progress=not quiet,
    )
    if result.interrupted:
        ignore_signals()


def _pair(text: str) -> tuple[str, str]:
    source, sign, target = text.partition(":=")
    if not sign or not source or not target:
        raise typer.BadParameter(f"{text!r} is not of the form FROM:=TO")
    return source, target


def recover(
    bag: BagPath,
    out: Annotated[Path, typer.Argument(help="the new bag", callback=file_name)],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the target")] = False,
    as_json: Json = False,
) -> None:
    """Save the intact messages of a damaged bag.

    Copies every intact message of a damaged or truncated bag into a new bag. The old bag does not
    change.

    Exit code 0: nothing was lost. 3: some messages were lost. 1: nothing could be saved.
    """
    from dataclasses import asdict

    from pkm_twin.bags.recover import recover as recover_bag

    result = recover_bag(bag, out, overwrite=overwrite)
    if as_json:
        print_json({**asdict(result), "lossless": result.lossless})
    else:
        lost = (
            "nothing lost"
            if result.lossless
            else f"{result.bytes_lost} bytes lost: {result.reason}"
        )
        typer.echo(f"{out}: {result.messages} messages saved, {lost}")
    if not result.lossless:
        raise typer.Exit(SALVAGED)
