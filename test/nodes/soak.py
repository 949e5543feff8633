# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a long run of the nodes is made of: pace, weather, watching, and what is said of it.

``python -m test.nodes.soak FOLDER`` writes the figures of the last run there into the docs.
"""

import json
import os
import shutil
import signal
import sys
import time
from array import array
from pathlib import Path

import numpy as np

from pkm_twin import load
from test.nodes.harness import REPOSITORY, SECOND, Maker, Ros
from test.support.pages import FAULTS, write_section

MAKE = Maker(Ros())
RATES = np.array([6.0, 5.0, 4.0])
STALE = 0.2
"""Of both nodes of the stream, s; a suspension is longer."""
SUSPENSION = 0.3
BAG = REPOSITORY / "bags" / "delta_cu_pick_and_place.mcap"
PLAYER = f"""
from pkm_twin.ros.player import play
play({str(BAG)!r}, loop=True, clock=100.0, progress=False, topics=["/joint_states"],
     remap={{"/joint_states": "/looping/states"}})
"""
PERIODS = {"parameters": 0.1, "trajectory": 0.5, "suspend": 7.0, "kill": 20.0}
"""Of what else happens, s."""
SHOWN = ("50 %", "99 %", "greatest")
QUANTILES = {"50 %": 50, "90 %": 90, "99 %": 99, "99.9 %": 99.9, "greatest": 100}


class Watched:
    """A process's memory (bytes), open descriptors and threads over time (s)."""

    def __init__(self, process):
        self.folder = Path(f"/proc/{process.process.pid}")
        self.time, self.memory, self.descriptors, self.threads = [], [], [], []

    def look(self, now):
        pages = int((self.folder / "statm").read_text().split()[1])
        self.time.append(now)
        self.memory.append(pages * os.sysconf("SC_PAGE_SIZE"))
        self.descriptors.append(len(list((self.folder / "fd").iterdir())))
        self.threads.append(len(list((self.folder / "task").iterdir())))

    def summary(self):
        """Medians of the first and of the last third: a single look may see a buffer in use.

        And the slope of a straight line through all looks, per hour.
        """
        third = max(1, len(self.time) // 3)
        return {
            what: {
                "first": float(np.median(values[:third])),
                "last": float(np.median(values[-third:])),
                "per hour": 3600.0 * float(np.polyfit(self.time, values, 1)[0]),
            }
            for what, values in (
                ("memory, bytes", self.memory),
                ("descriptors", self.descriptors),
                ("threads", self.threads),
            )
        }


class Ears:
    """Subscriptions that are emptied without an executor, which costs more than the messages."""

    def __init__(self, peer):
        self.node = peer.node
        self._subscriptions = []

    def hear(self, kind, topic, take):
        """``take(message, info)`` gets every message."""
        made = self.node.create_subscription(kind, topic, lambda message: None, 1000)
        self._subscriptions.append((made, take))

    def listen(self):
        for subscription, take in self._subscriptions:
            with subscription.handle:
                while got := subscription.handle.take_message(subscription.msg_type, False):
                    take(*got)


class Weather:
    """What else happens, each at its own period."""

    def __init__(self, peer, launch, nodes):
        from rcl_interfaces.srv import SetParameters

        self.peer, self.launch, self.nodes = peer, launch, nodes
        self.rng = np.random.default_rng(1)
        self.clients = {name: peer.node.create_client(SetParameters, f"/{name}/set_parameters") for name in nodes}
        self.pending = []
        self.player = launch(None, code=PLAYER)
        self.stopped = None
        self.happened = {}
        self.due = dict.fromkeys(PERIODS, 0.0)
        self.names = load("delta_cu").joint_names

    def pass_by(self, now):
        """Whatever is due by now, s."""
        if self.stopped is not None and now >= self.stopped[1]:
            self.calm()
        for what, period in PERIODS.items():
            if now >= self.due[what]:
                self.due[what] = now + period
                getattr(self, what)(now)
                self.happened[what] = self.happened.get(what, 0) + 1

    def parameters(self, now):
        """A storm of good and bad ones."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        name = str(self.rng.choice(list(self.nodes)))
        nan = float("nan")
        changes = {
            "payload.mass": float(self.rng.choice([0.0, 0.1, -1.0, nan])),
            "max_state_age": 1.0,
            "effort_limits": [100.0, 100.0, float(self.rng.choice([100.0, 50.0, nan]))],
            "nothing": "x" * 1000,
        }
        request = SetParameters.Request(
            parameters=[Parameter(n, value=v).to_parameter_msg() for n, v in changes.items()]
        )
        self.pending = [f for f in self.pending if not f.done()]
        if self.clients[name].service_is_ready() and len(self.pending) < 50:
            self.pending.append(self.clients[name].call_async(request))

    def trajectory(self, now):
        times = np.arange(500) * 0.01
        waves = np.outer(times, RATES)
        message = MAKE.trajectory(
            self.names,
            [round(t * SECOND) for t in times],
            0.2 + 0.2 * np.sin(waves),
            0.2 * RATES * np.cos(waves),
            -0.2 * RATES**2 * np.sin(waves),
        )
        self.peer.send("/feeding/joint_trajectory", message)

    def kill(self, now):
        """The publisher of the looping bag, without a word."""
        self.player.process.kill()
        self.player.wait()
        self.player.close()
        self.player = self.launch(None, code=PLAYER)

    def suspend(self, now):
        if self.stopped is None:
            process = self.nodes[str(self.rng.choice(list(self.nodes)))]
            process.process.send_signal(signal.SIGSTOP)
            self.stopped = process, now + SUSPENSION

    def calm(self):
        """Nothing is left standing."""
        if self.stopped is not None:
            self.stopped[0].process.send_signal(signal.SIGCONT)
            self.stopped = None


class Sender:
    """1 kHz of joint states, one in a hundred of them bad; 200 Hz of wrenches."""

    def __init__(self, peer):
        head = load("upr_rpu")
        self.peer = peer
        self.names, self.head = load("delta_cu").joint_names, head.joint_names
        self.legs = head.inverse([-0.7, 0.2, -0.15]).tolist()
        self.sent = 0

    def send(self, i):
        t = i * 1e-3
        q = 0.2 + 0.2 * np.sin(t * RATES)
        qd = 0.2 * RATES * np.cos(t * RATES)
        if i % 100 == 50:
            q[0] = np.nan
        now = self.peer.now()
        self.peer.send("/feeding/states", MAKE.joint_state(self.names, q, qd, stamp=now))
        self.sent += 1
        if i % 5 == 0:
            self.peer.send("/watching/states", MAKE.joint_state(self.head, self.legs, stamp=now))
            load_now = [10.0 * np.sin(t), 5.0, -20.0, 1.0, 0.0, 0.0]
            self.peer.send("/watching/wrench", MAKE.wrench(load_now, now))

    def run(self, seconds, turn, look=lambda now: None):
        """At pace for so long; what this side missed is left out, not caught up.

        :param turn: called after every message, with the time since the beginning, s.
        :param look: the same, twice a second.
        """
        begin = time.perf_counter()
        due, index = 0.0, -1
        while (now := time.perf_counter() - begin) < seconds:
            if int(now * 1e3) == index:
                time.sleep(max(0.0, (index + 1) * 1e-3 - now))
                continue
            index = int(now * 1e3)
            self.send(index)
            turn(now)
            if now >= due:
                look(now)
                due = now + 0.5


class Ages:
    """From a state's stamp to the answer's publication, s: latency and age in one."""

    def __init__(self):
        self.all = {"torques": array("d"), "commands": array("d"), "deflections": array("d")}
        self._stamps = {}

    def torque(self, message, info):
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        self.all["torques"].append((info["source_timestamp"] - stamp) / SECOND)
        # A command has no stamp: it is told by its numbers.
        self._stamps[tuple(message.effort)] = stamp
        if len(self._stamps) > 5000:
            del self._stamps[next(iter(self._stamps))]

    def command(self, message, info):
        stamp = self._stamps.get(tuple(message.data))
        if stamp is not None:
            self.all["commands"].append((info["source_timestamp"] - stamp) / SECOND)

    def deflection(self, message, info):
        stamp = message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        self.all["deflections"].append((info["source_timestamp"] - stamp) / SECOND)

    def clear(self):
        for ages in self.all.values():
            del ages[:]

    def summary(self):
        return {
            what: {
                "count": len(ages),
                "older than stale_after": int((np.array(ages) > STALE).sum()),
            }
            | dict(zip(QUANTILES, np.percentile(ages, list(QUANTILES.values())).tolist(), strict=True))
            for what, ages in self.all.items()
            if len(ages)
        }


def write(folder, summary, watched, ages):
    """The figures, and their picture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "soak.json").write_text(json.dumps(summary, indent=2) + "\n")
    figure, axes = pyplot.subplots(2, 2, figsize=(10, 6), layout="constrained")
    for (name, w), style in zip(watched.items(), ("-", "--", ":", "-."), strict=True):
        minutes = np.array(w.time) / 60
        axes[0, 0].plot(minutes, np.array(w.memory) / 2**20, style, label=name)
        axes[0, 1].plot(minutes, w.descriptors, style, label=name)
        axes[1, 0].plot(minutes, w.threads, style, label=name)
    titles = ("resident memory of each node", "open file descriptors", "threads")
    for ax, title, what in zip(axes.flat, titles, ("memory (MiB)", "number", "number"), strict=False):
        ax.set(title=title, xlabel="time (min)", ylabel=what, ylim=(0, 1.2 * ax.get_ylim()[1]))
        ax.legend(ncols=2)
    last = axes[1, 1]
    for what, values in ages.all.items():
        last.hist(np.array(values) * 1e3, bins=np.geomspace(0.05, 1e3, 80), histtype="step", label=what)
    last.axvline(1e3 * STALE, color="grey", linewidth=0.8, label="stale_after")
    last.set(xscale="log", yscale="log", xlabel="age at publication (ms)", ylabel="messages")
    last.set_title("age of the published messages")
    last.legend()
    memory, others = growth(summary)
    figure.suptitle(f"Growth under load: memory {memory:+.1f} MiB, descriptors and threads {others:+g}")
    figure.savefig(folder / "soak.png", dpi=110)
    pyplot.close(figure)


TEXT = """## Long run

Printed by `make soak MINUTES={minutes:g}`: two `delta_dynamics` (one from a looping bag),
`stiffness_monitor` and `command_gate`; {sent:,} joint states, one in a hundred invalid;
{parameters:,} requests for parameters, {trajectory:,} trajectories of 500 points, {suspend:,}
suspensions of a node, {kill:,} kills of the player. Memory grew by {grown:.1f} MiB at most from the
first to the last third of the time, descriptors and threads by {more:g}.

![Memory, descriptors, threads and ages of a long run](gallery/soak.png)

Ages of answers at their publication, on two cores that did much other work (`stale_after` and
`deadline` {stale:g} s): {ages}. The computer delayed the older ones after the node's last check;
the topic's deadline reports them.
"""


def growth(summary):
    """Of memory, MiB, and of descriptors or threads, the greatest of all nodes."""
    memory, *others = (
        max(node[what]["last"] - node[what]["first"] for node in summary["nodes"].values())
        for what in ("memory, bytes", "descriptors", "threads")
    )
    return memory / 2**20, max(others)


def section(summary):
    """The figures as a part of the page on errors."""
    grown, more = growth(summary)
    ages = "; ".join(
        f"{what}: {', '.join(f'{q} {1e3 * found[q]:.2f} ms' for q in SHOWN)}, "
        f"{found['older than stale_after']} of {found['count']:,} older"
        for what, found in summary["ages, s"].items()
    )
    return TEXT.format(
        minutes=summary["minutes"],
        sent=summary["joint states sent"],
        stale=STALE,
        grown=grown,
        more=more,
        ages=ages,
        **summary["happened"],
    )


def main():
    """Copy the picture of a run into the docs and its figures into the page on errors."""
    folder = Path(sys.argv[1])
    summary = json.loads((folder / "soak.json").read_text())
    shutil.copy(folder / "soak.png", FAULTS.with_name("gallery") / "soak.png")
    write_section("soak", section(summary), FAULTS)


if __name__ == "__main__":
    main()
