# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Play every shipped bag by `ros2 bag play --clock` into its nodes; print the answered fraction.

    python3 tools/cell_trial/bags.py [--rate 1.0] [-p NAME:=VALUE] [BAG ...]

Prints the table of the page on bags. Needs a sourced Jazzy workspace with pkm_twin and rosbag2.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from pathlib import Path

from cell import Peer, Process, closing, node, peer
from diagnostic_msgs.msg import DiagnosticArray

from pkm_twin.bags import reader

STATES, WRENCHES = "/joint_states", "/wrench"
NODES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "delta_dynamics": (STATES, "joint states answered", ()),
    "stiffness_monitor": (WRENCHES, "wrenches answered", ()),
    "machine_state": (STATES, "joint states answered", ("rate:=0.0",)),
}
"""A node's answers, the count in its diagnostics, and its parameters."""
ROBOTS = {
    "delta_cu": ("delta_dynamics", "stiffness_monitor", "machine_state"),
    "prru": ("delta_dynamics", "stiffness_monitor", "machine_state"),
    "upr_rpu": ("stiffness_monitor", "machine_state"),
}
"""Nodes whose input topics are all in a robot's bags."""


def folder() -> Path:
    """Find the folder of bags: installed, or next to this folder."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if (path := Path(prefix, "share/pkm_twin/bags")).is_dir():
            return path
    return Path(__file__).resolve().parents[2] / "bags"


def play_bag(other: Peer, bag: Path, robot: str, name: str, rate: float, given: list[str]) -> dict[str, str]:
    """Play a bag to a node, and return the values of its diagnostics."""
    told: dict[str, str] = {}

    def diagnosed(array: DiagnosticArray) -> None:
        for status in array.status:
            if status.name == f"/{name}":
                told.update({pair.key: pair.value for pair in status.values})

    heard = other.node.create_subscription(DiagnosticArray, "/diagnostics", diagnosed, 100)
    parameters = (f"mechanism:={robot}", "use_sim_time:=true", *NODES[name][2], *given)
    twin = node(name, parameters=parameters)
    with closing(twin):
        other.until(lambda: told, lambda: f"{name}'s diagnostics\n{twin.output}")
        player = Process(
            "ros2",
            "bag",
            "play",
            str(bag),
            "--clock",
            "200",
            "--rate",
            str(rate),
            "--delay",
            "3",
            "--disable-keyboard-controls",
        )
        with closing(player):
            other.until(lambda: not player.alive(), "the player's end", 600.0)
        other.spin(3.0)
    other.node.destroy_subscription(heard)
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("bags", nargs="*", help="names; default: all")
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("-p", "--parameter", action="append", default=[], help="of the nodes")
    given = parser.parse_args()
    print("| bag | node | messages in the bag | answered | rejected | lost |")
    print("|---|---|---|---|---|---|")
    with peer() as other:
        for bag in sorted(folder().glob("*.mcap")):
            if given.bags and bag.stem not in given.bags:
                continue
            inside = Counter(m.topic for m in reader.read_messages(bag))
            robot = next(r for r in sorted(ROBOTS, key=len, reverse=True) if bag.stem.startswith(r))
            for name in ROBOTS[robot]:
                source, answered, _ = NODES[name]
                if not inside[source]:
                    continue
                told = play_bag(other, bag, robot, name, given.rate, given.parameter)
                rejects = [
                    f"{value} {key.partition(': ')[2]}"
                    for key, value in told.items()
                    if " rejected: " in key and value != "0"
                ]
                share = f"{100 * int(told[answered]) / inside[source]:.2f} %"
                print(
                    f"| {bag.stem} | {name} | {inside[source]} | {told[answered]}, {share} | "
                    f"{', '.join(rejects) or 'none'} | {told[f'lost: {source[1:]}']} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
