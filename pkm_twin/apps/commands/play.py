# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin play``: a bag on ROS topics."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import click

from pkm_twin.apps.frame import command
from pkm_twin.report import Fact, Report
from pkm_twin.ros.signals import ignore_signals
from pkm_twin.settings import setting


@dataclass(frozen=True, kw_only=True)
class Play:
    """Replay a bag onto ROS topics.

    Works like `ros2 bag play`, on machines that do not have it. The whole bag is checked before
    anything is published. Messages are published in the order of their log time, byte for byte as
    recorded.

    Time stamps in a bag are old, so the nodes reject them unless you use simulated time: set
    use_sim_time on the nodes and give this command --clock 200.
    """

    bag: Path = setting(..., "a bag: an MCAP file or a rosbag2 folder", argument=True)
    speed: float = setting(1.0, "speed factor; 1 is the recorded speed", low=1e-6, high=1e6, older=("--rate",))
    loop: bool = setting(False, "restart at the end")
    clock: float | None = setting(None, "publish /clock, Hz, for nodes with use_sim_time")
    wait: float = setting(3.0, "longest wait (s) for a subscriber on every topic")
    topic: tuple[str, ...] = setting((), "play only these topics")
    remap: tuple[str, ...] = setting((), "FROM:=TO, play a topic under another name")
    quiet: bool = setting(False, "no progress bar")


@command("Recordings")
def play(given: Play) -> Report:
    """Publish the messages of a bag."""
    from pkm_twin.ros.player import play as play_bag

    pairs = {}
    for text in given.remap:
        source, sign, target = text.partition(":=")
        if not (sign and source and target):
            raise click.UsageError(f"{text!r} is not of the form FROM:=TO")
        pairs[source] = target
    result = play_bag(
        given.bag,
        rate=given.speed,
        loop=given.loop,
        clock=given.clock,
        wait_for_subscribers=given.wait,
        topics=list(given.topic) or None,
        remap=pairs,
        progress=not given.quiet,
    )
    if result.interrupted:
        ignore_signals()
    facts = [Fact(name, value) for name, value in asdict(result).items()]
    return Report(f"{given.bag}: {result.messages} messages published", facts)
