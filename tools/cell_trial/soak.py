# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A cell for a while: two machines with all nodes and a recorder; one machine at 1 kHz; Ctrl-C.

    python3 tools/cell_trial/soak.py [--minutes 10] [--stops 20] [--part cell|kilohertz|stops|one]
        [--composed] [--priority 50]

cell: cell.launch.py with all nodes and gates of two machines, a machine_sim for each at 250 Hz, and
`ros2 bag record`. kilohertz: one machine's delta_dynamics, command_gate and machine_sim. stops: how
often Ctrl-C, twice, ends a running cell cleanly, with zeros as each gate's last command; one: as
stops, with twin.launch.py and one machine. Needs a sourced Jazzy workspace with pkm_twin and
rosbag2; the figures mean something on an idle machine.
"""

from __future__ import annotations

import argparse
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml
from cell import Peer, Process, node, peer
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Float64MultiArray

from pkm_twin.bags.reader import inspect
from pkm_twin.mechanisms.catalogue import robot_path

MACHINES = {"picker": ("delta_cu", 0.1, 0.5), "head": ("prru", 300.0, 80.0)}
"""Robot of each namespace, with the viscous and dry friction of the nodes' model."""
SIMULATED_FRICTION_RATIO = 4.0
"""Ratio of simulated to modelled friction: the machines hold themselves and come to rest. With a
ratio of 1, compensated friction would keep them moving."""
WARM_UP_TIME = 15.0
PARTS = ("cell", "kilohertz", "stops", "one")
FAULTS = ("lost: ", " rejected: ", "stopped: ", "closed: ", "exceptions", "times behind")


class Watch:
    """Collect diagnostics and gate commands of all nodes."""

    def __init__(self, other: Peer) -> None:
        self.other = other
        self.values: dict[str, dict[str, str]] = {}
        self.messages: dict[str, str] = {}
        self.commands: dict[str, list[float]] = {}
        other.node.create_subscription(DiagnosticArray, "/diagnostics", self._take_diagnostics, 1000)

    def _take_diagnostics(self, array: DiagnosticArray) -> None:
        for status in array.status:
            self.values[status.name] = {pair.key: pair.value for pair in status.values}
            self.messages[status.name] = status.message

    def gate(self, topic: str) -> None:
        """Keep the last command of a gate."""

        def take(message: Float64MultiArray) -> None:
            self.commands[topic] = list(message.data)

        self.other.node.create_subscription(Float64MultiArray, topic, take, 5000)

    def faults(self) -> dict[str, Counter[str]]:
        """Return the counts of each node that should be zero, by key."""
        found: dict[str, Counter[str]] = {}
        for name, values in self.values.items():
            found[name] = Counter(
                {
                    key: int(value)
                    for key, value in values.items()
                    if value.isdigit() and any(word in key for word in FAULTS)
                }
            )
        return found


def write_robots(folder: Path, factor: float = 1.0) -> dict[str, Path]:
    """Write a robot file for each namespace, with friction multiplied by a factor."""
    files = {}
    for space, (robot, viscous, dry) in MACHINES.items():
        files[space] = folder / f"{robot}_{factor:g}.yaml"
        friction = f"friction: {{viscous: {factor * viscous}, coulomb: {factor * dry}}}"
        files[space].write_text(f"{robot_path(robot).read_text()}\n{friction}\n")
    return files


def start_simulators(spaces: Iterable[str], folder: Path, period: float, priority: int = 0) -> list[Process]:
    """Start a machine_sim for each namespace, driven by the efforts of its gate."""
    files = write_robots(folder, SIMULATED_FRICTION_RATIO)
    return [
        node(
            "machine_sim",
            parameters=(
                f"mechanism:={files[space]}",
                f"period:={period}",
                f"thread_priority:={priority}",
            ),
            remap=(f"__ns:=/{space}", f"~/commands:=/{space}/command_gate/commands"),
        )
        for space in spaces
    ]


def launch_cell(files: dict[str, Path], *extra: str) -> Process:
    """Launch cell.launch.py with all nodes."""
    machines = ",".join(f"{space}={robot}" for space, robot in files.items())
    return Process(
        "ros2",
        "launch",
        "pkm_twin",
        "cell.launch.py",
        f"machines:={machines}",
        "command_gate:=true",
        "machine_state:=true",
        *extra,
    )


def launch_machine(files: dict[str, Path], *extra: str) -> Process:
    """Launch twin.launch.py of the only machine, with all nodes."""
    ((space, robot),) = files.items()
    return Process(
        "ros2",
        "launch",
        "pkm_twin",
        "twin.launch.py",
        f"robot:={robot}",
        f"namespace:={space}",
        "command_gate:=true",
        "machine_state:=true",
        *extra,
    )


RELAXED_PARAMETERS: dict[str, dict[str, float]] = {
    "delta_dynamics": {"stale_after": 1.0},
    "command_gate": {"deadline": 1.0},
}
"""Parameters with which torques also flow on a busy machine."""


def write_parameters(spaces: Iterable[str], folder: Path, given: dict[str, dict[str, Any]]) -> str:
    """Write a parameter file for all namespaces, and return the launch argument."""
    file = folder / "parameters.yaml"
    file.write_text(
        yaml.safe_dump(
            {
                f"/{space}/{name}": {"ros__parameters": dict(values)}
                for space in spaces
                for name, values in given.items()
            }
        )
    )
    return f"params_file:={file}"


def watch_faults(watch: Watch, processes: dict[str, int], seconds: float) -> bool:
    """Watch faults and memory for a time after warming up; return whether all is well."""
    other = watch.other
    other.spin(WARM_UP_TIME)
    before, memory = watch.faults(), {name: _resident_memory(pid) for name, pid in processes.items()}
    used = {name: _processor_time(pid) for name, pid in processes.items()}
    began = time.monotonic()
    other.spin(seconds)
    took = time.monotonic() - began
    good = True
    for name, faults in sorted(watch.faults().items()):
        new = faults - before.get(name, Counter())
        print(f"  {name}: {'; '.join(f'{n} {key}' for key, n in new.items()) or 'nothing'}")
        good &= not new
    for name, pid in processes.items():
        growth = _resident_memory(pid) - memory[name]
        share = 100 * (_processor_time(pid) - used[name]) / took
        print(f"  {name}: {share:.1f} % of a core, {_resident_memory(pid):.0f} MB, {growth:+.2f} MB")
    return good


def _resident_memory(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 1e6


def _processor_time(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / 100


def _find_nodes(process: Process) -> dict[str, int]:
    """Return the nodes that a launch has started, by executable and order."""
    found = {}
    for line in process.output.splitlines():
        if "process started with pid [" in line:
            name = line.split("[INFO] [", 1)[1].split("]", 1)[0]
            found[name] = int(line.rsplit("[", 1)[1].rstrip("]"))
    return found


def run_cell(other: Peer, seconds: float, extra: tuple[str, ...], priority: int) -> bool:
    """Run two machines at 250 Hz and a recorder; nodes in the torque path have the priority."""
    watch = Watch(other)
    folder = Path(tempfile.mkdtemp())
    bag = folder / "bag"
    files = write_robots(folder)
    sims = start_simulators(files, folder, 0.004, priority)
    path = ("delta_dynamics", "command_gate")
    given = {name: {"thread_priority": priority} for name in path}
    cell_ = launch_cell(files, write_parameters(files, folder, given), *extra)
    topics = [f"/{s}/{t}" for s in MACHINES for t in ("joint_states", "wrench")]
    recorder = Process("ros2", "bag", "record", "--storage", "mcap", "-o", str(bag), *topics)
    try:
        names = [f"/{s}/{n}" for s in MACHINES for n in path]
        other.until(
            lambda: all(name in watch.values for name in names),
            lambda: f"nodes\n{cell_.output}",
            needs=(*sims, cell_),
        )
        processes = _find_nodes(cell_) | {
            f"machine_sim {space}": sim.process.pid for space, sim in zip(MACHINES, sims, strict=True)
        }
        processes["recorder"] = recorder.process.pid
        print(f"two machines, all nodes, recorder, {seconds:.0f} s:")
        good = watch_faults(watch, processes, seconds)
        recorder.signal(signal.SIGINT, group=True)
        recorder.process.wait(60.0)
        report = inspect(bag)
        counts = {topic: info.count for topic, info in report.topics.items()}
        print(f"  recorded: {counts}")
        return good
    finally:
        for process in (recorder, cell_, *sims):
            process.close()
        shutil.rmtree(folder, ignore_errors=True)


def run_kilohertz(other: Peer, seconds: float, priority: int) -> bool:
    """Run delta_dynamics, gate and machine_sim of one machine at 1 kHz."""
    watch = Watch(other)
    folder = Path(tempfile.mkdtemp())
    space, file = next(iter(write_robots(folder).items()))
    given = (f"mechanism:={file}", f"thread_priority:={priority}")
    nodes = {"machine_sim": start_simulators([space], folder, 0.001, priority)[0]} | {
        name: node(name, parameters=given, remap=(f"__ns:=/{space}",)) for name in ("delta_dynamics", "command_gate")
    }
    try:
        other.until(lambda: len(watch.values) >= 3, "diagnostics of three nodes", needs=nodes.values())
        print(f"one machine at 1 kHz, {seconds:.0f} s:")
        return watch_faults(watch, {name: p.process.pid for name, p in nodes.items()}, seconds)
    finally:
        for process in nodes.values():
            process.close()
        shutil.rmtree(folder, ignore_errors=True)


def run_stops(other: Peer, times: int, *, one: bool) -> bool:
    """Send Ctrl-C twice to a running cell or machine, repeatedly."""
    watch = Watch(other)
    folder = Path(tempfile.mkdtemp())
    files = dict(list(write_robots(folder).items())[: 1 if one else None])
    topics = {space: f"/{space}/command_gate/commands" for space in files}
    for topic in topics.values():
        watch.gate(topic)
    extra = write_parameters(files, folder, RELAXED_PARAMETERS)
    launch_of = launch_machine if one else launch_cell
    running = [*start_simulators(files, folder, 0.004)]
    ends: Counter[str] = Counter()
    try:
        for _ in range(times):
            watch.commands.clear()
            watch.messages.clear()
            running.append(launch := launch_of(files, extra))
            other.until(
                lambda: len(watch.commands) == len(topics) and all(any(command) for command in watch.commands.values()),
                lambda: (
                    f"torques through the gates; commands {watch.commands}, nodes "
                    f"{watch.messages}\n{launch.output[-2000:]}"
                ),
                needs=running,
            )
            other.spin(random.uniform(0.5, 1.5))
            count = len(_find_nodes(launch))
            # A terminal signals the whole group; launch then signals its processes once more.
            launch.signal(signal.SIGINT, group=True)
            time.sleep(10.0 ** random.uniform(-5, -0.7))
            launch.signal(signal.SIGINT, group=True)
            other.until(lambda p=launch: not p.alive(), "the launch's end")
            other.spin(1.0)
            said = launch.output
            verdict = ["clean" if said.count("finished cleanly") == count else "NOT CLEAN"]
            verdict += ["traceback"] if "Traceback" in said else []
            zeros = all(not any(command) for command in watch.commands.values())
            verdict += ["zeros" if zeros else "A TORQUE IS THE LAST COMMAND"]
            ends[", ".join(verdict)] += 1
            if "NOT CLEAN" in verdict or not zeros:
                print(said[-3000:])
            running.pop().close()
    finally:
        for process in reversed(running):
            process.close()
        shutil.rmtree(folder, ignore_errors=True)
    what = "one machine" if one else "a cell"
    print(f"Ctrl-C of {what}: " + "; ".join(f"{n} {end}" for end, n in ends.items()))
    return set(ends) == {"clean, zeros"}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--stops", type=int, default=20)
    parser.add_argument("--composed", action="store_true", help="cell: with composed:=true")
    parser.add_argument("--priority", type=int, default=0, help="cell, kilohertz: thread_priority")
    parser.add_argument("--part", choices=PARTS, action="append")
    given = parser.parse_args()
    parts: Any = given.part or PARTS
    good = True
    extra = ("composed:=true",) if given.composed else ()
    for part in parts:
        with peer() as other:
            if part == "cell":
                good &= run_cell(other, 60.0 * given.minutes, extra, given.priority)
            elif part == "kilohertz":
                good &= run_kilohertz(other, 60.0 * given.minutes, given.priority)
            else:
                good &= run_stops(other, given.stops, one=part == "one")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
