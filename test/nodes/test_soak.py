# SPDX-License-Identifier: Apache-2.0
"""Both nodes at full rate for minutes, in all kinds of weather: nothing grows, nothing ends.

``SOAK_MINUTES`` sets how long; the first fifth is warm-up. Where ``SOAK_OUT`` names a folder, the
course and the distributions go there, as JSON and as a picture.
"""

import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from pkm_twin import load
from test.nodes.harness import REPOSITORY, SECOND, Maker, Ros, stamp_of, values_of

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

SECONDS = 60.0 * float(os.environ.get("SOAK_MINUTES", "3"))
OUT = os.environ.get("SOAK_OUT", "")

pytestmark = [pytest.mark.long, pytest.mark.timeout(180 + 2 * SECONDS)]

GROWTH = 4 * 2**20
"""Bytes by which the memory's median may differ between the first and the last part."""
MAKE = Maker(Ros())
RATES = np.array([6.0, 5.0, 4.0])
BAG = REPOSITORY / "bags" / "delta_cu_pick_and_place.mcap"
PLAYER = f"""
from pkm_twin.ros.player import play
play({str(BAG)!r}, loop=True, clock=100.0, progress=False, topics=["/joint_states"],
     remap={{"/joint_states": "/looping/states"}})
"""


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
        """Medians of the first and of the last third: a single look may see a buffer in use."""
        third = max(1, len(self.time) // 3)
        return {
            what: [float(np.median(values[:third])), float(np.median(values[-third:]))]
            for what, values in (
                ("memory, bytes", self.memory),
                ("descriptors", self.descriptors),
                ("threads", self.threads),
            )
        }


class Weather:
    """What else happens, each at its own period, s."""

    def __init__(self, peer, launch, nodes):
        self.peer, self.launch, self.nodes = peer, launch, nodes
        self.rng = np.random.default_rng(1)
        self.clients = {
            name: peer.node.create_client(SetParameters, f"/{name}/set_parameters")
            for name in nodes
        }
        self.pending = []
        self.player = launch(None, code=PLAYER)
        self.stopped = None
        self.happened = {}
        self.due = dict.fromkeys(PERIODS, 0.0)

    def pass_by(self, now):
        """Whatever is due by now, s."""
        if self.stopped is not None and now >= self.stopped[1]:
            self.stopped[0].process.send_signal(signal.SIGCONT)
            self.stopped = None
        for what, period in PERIODS.items():
            if now >= self.due[what]:
                self.due[what] = now + period
                getattr(self, what)(now)
                self.happened[what] = self.happened.get(what, 0) + 1

    def parameters(self, now):
        """A storm of good and bad ones."""
        name = str(self.rng.choice(list(self.nodes)))
        mass = float(self.rng.choice([0.0, 0.1, -1.0, np.nan]))
        changes = [
            Parameter("payload.mass", value=mass),
            Parameter("max_state_age", value=1.0),
            Parameter("nothing", value="x" * 1000),
        ]
        request = SetParameters.Request(parameters=[c.to_parameter_msg() for c in changes])
        self.pending = [f for f in self.pending if not f.done()]
        if self.clients[name].service_is_ready() and len(self.pending) < 50:
            self.pending.append(self.clients[name].call_async(request))

    def trajectory(self, now):
        count = 500
        times = np.arange(count) * 0.01
        waves = np.outer(times, RATES)
        message = MAKE.trajectory(
            load("delta_cu").joint_names,
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
            self.stopped = process, now + 0.3

    def calm(self):
        """Nothing is left standing."""
        if self.stopped is not None:
            self.stopped[0].process.send_signal(signal.SIGCONT)
            self.stopped = None


PERIODS = {"parameters": 0.1, "trajectory": 0.5, "suspend": 7.0, "kill": 20.0}


def test_nodes_do_not_grow(peer, launch):
    delta, head = load("delta_cu"), load("upr_rpu")

    def node(module, name, *parameters):
        remap = ("-r", f"__node:={name}", "-r", f"joint_states:=/{name}/states")
        return launch(module, *parameters, arguments=(*remap, "-r", f"wrench:=/{name}/wrench"))

    nodes = {
        "feeding": node("delta_dynamics.node", "feeding", "stale_after:=1.0"),
        "watching": node("stiffness_monitor.node", "watching", "max_state_age:=1.0"),
        "looping": node("delta_dynamics.node", "looping", "use_sim_time:=true"),
    }
    peer.talk(JointState, "/feeding/states")
    peer.talk(JointState, "/watching/states")
    peer.talk(WrenchStamped, "/watching/wrench")
    peer.talk(JointTrajectory, "/feeding/joint_trajectory")
    peer.hear(JointTrajectory, "/feeding/joint_trajectory_ff")
    peer.hear(String, "/watching/dominant_element")
    peer.hear(JointState, "/looping/joint_torques")
    peer.hear(DiagnosticArray, "/diagnostics")
    ages = []
    peer.node.create_subscription(
        JointState,
        "/feeding/joint_torques",
        lambda m, info: ages.append((info["source_timestamp"] - stamp_of(m)) / SECOND),
        1000,
    )
    legs = head.inverse([-0.7, 0.2, -0.15]).tolist()
    weather = Weather(peer, launch, nodes)
    begin = time.perf_counter()
    sent = 0

    def send(i):
        """1 kHz of joint states, one in a hundred of them bad; 200 Hz of wrenches."""
        t = i * 1e-3
        q = 0.2 + 0.2 * np.sin(t * RATES)
        qd = 0.2 * RATES * np.cos(t * RATES)
        if i % 100 == 50:
            q[0] = np.nan
        now = peer.now()
        peer.send("/feeding/states", MAKE.joint_state(delta.joint_names, q, qd, stamp=now))
        if i % 5 == 0:
            peer.send("/watching/states", MAKE.joint_state(head.joint_names, legs, stamp=now))
            load_now = [10.0 * np.sin(t), 5.0, -20.0, 1.0, 0.0, 0.0]
            peer.send("/watching/wrench", MAKE.wrench(load_now, now))

    def run(seconds, look=lambda now: None):
        nonlocal sent
        end = time.perf_counter() + seconds
        due = 0.0
        while (now := time.perf_counter()) < end:
            # What this side missed is left out, not caught up.
            sent = max(sent + 1, int((now - begin) * 1e3))
            send(sent)
            weather.pass_by(now - begin)
            if now >= due:
                look(now - begin)
                due = now + 0.5
            peer.spin()

    peer.until(peer.matched, 90.0)
    run(SECONDS / 5)
    answers = [
        peer.received(topic)
        for topic in (
            "/watching/dominant_element",
            "/looping/joint_torques",
            "/feeding/joint_trajectory_ff",
        )
    ]
    assert ages
    peer.clear()
    ages.clear()
    watched = {name: Watched(process) for name, process in nodes.items()}
    run(SECONDS * 4 / 5, lambda now: [w.look(now) for w in watched.values()])
    weather.calm()
    summary = {name: w.summary() for name, w in watched.items()}
    summary["minutes"] = SECONDS / 60
    summary["happened"] = weather.happened
    summary["torques"] = len(ages)
    summary["age of torques, s"] = dict(
        zip(
            ["50 %", "99 %", "99.9 %", "greatest"],
            np.percentile(ages, [50, 99, 99.9, 100]).tolist(),
            strict=True,
        )
    )
    if OUT:
        write(Path(OUT), summary, watched, ages)
    for name, process in nodes.items():
        assert process.alive(), process.output
        array = peer.diagnostics(f"/{name}")
        assert values_of(array)["exceptions"] == "0", process.output
        for what, (first, last) in summary[name].items():
            assert last - first <= (GROWTH if "memory" in what else 0), (name, what, first, last)
    assert all(answers)


def write(folder, summary, watched, ages):
    """The figures, and their picture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "soak.json").write_text(json.dumps(summary, indent=2) + "\n")
    figure, axes = pyplot.subplots(2, 2, figsize=(10, 6), layout="constrained")
    for (name, w), style in zip(watched.items(), ("-", "--", ":"), strict=True):
        minutes = np.array(w.time) / 60
        axes[0, 0].plot(minutes, np.array(w.memory) / 2**20, style, label=name)
        axes[0, 1].plot(minutes, w.descriptors, style, label=name)
        axes[1, 0].plot(minutes, w.threads, style, label=name)
    for ax, what in zip(axes.flat, ("memory (MiB)", "descriptors", "threads"), strict=False):
        ax.set_xlabel("time (min)")
        ax.set_ylabel(what)
        ax.set_ylim(0, 1.2 * ax.get_ylim()[1])
        ax.legend()
    axes[1, 1].hist(np.array(ages) * 1e3, bins=np.geomspace(0.05, 1e3, 80))
    axes[1, 1].set(
        xscale="log", yscale="log", xlabel="age of a torque when it leaves (ms)", ylabel="torques"
    )
    figure.savefig(folder / "soak.png", dpi=110)
    pyplot.close(figure)
