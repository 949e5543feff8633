# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin recover``: the intact messages of a damaged bag."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import SALVAGED, OverwriteOption
from pkm_twin.report import Fact, Report
from pkm_twin.settings import setting


@dataclass(frozen=True, kw_only=True)
class Recover(OverwriteOption):
    """Save the intact messages of a damaged bag.

    Copies every intact message of a damaged or truncated bag into a new bag. The old bag does not
    change.

    Exit code 0: nothing was lost. 3: some messages were lost. 1: nothing could be saved.
    """

    bag: Path = setting(..., "a bag: an MCAP file or a rosbag2 folder", argument=True)
    out: Path = setting(..., "the new bag", argument=True, writes=True)


@command("Recordings")
def recover(given: Recover) -> Report:
    """Write what can be read of a bag.

    :raises PkmTwinError: nothing can.
    """
    from pkm_twin.bags.recover import recover as recover_bag

    result = recover_bag(given.bag, given.out, overwrite=given.overwrite)
    lost = f"{result.bytes_lost} bytes lost: {result.reason}"
    return Report(
        f"{given.out}: {result.messages} messages saved, {'nothing lost' if result.lossless else lost}",
        [*(Fact(k, v) for k, v in asdict(result).items()), Fact("lossless", result.lossless)],
        code=0 if result.lossless else SALVAGED,
    )
