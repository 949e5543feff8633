# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Live nodes that send efforts: no reason of a stop lets out one beyond the limits or of an old state."""

import math
import signal
import time
from itertools import cycle, product

import numpy as np
import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from test.nodes.efforts import PLACES, ROBOT, Judge
from test.nodes.harness import SECOND, counts_of, renamed, stamp_of
from test.nodes.twin import MAKE, NAMES, launched

STALE = 0.5
"""Of the node, and the gates' deadline, s."""
SENDING = 0.05
"""Longest time between a node's look at the clock and the middleware's stamp, s: less than the
period of the nodes' timers, which would send an effort that is a little too old."""
POLICIES, ON_STOP = ("warn", "reject", "clamp"), ("gravity", "zeros", "nothing")
MAGIC = {"raises": 19_001, "infinite": 19_002, "slow": 19_003}
"""Index in PLACES of the positions at which the node's model fails, and how."""
CODE = f"""
import time
import numpy as np
from delta_dynamics import feedforward
from delta_dynamics.nodes import twin
solve = feedforward.inverse_dynamics
def failing(robot, q, *rest, **more):
    if q.ndim == 1:
        if q[0] == {PLACES[MAGIC["raises"], 0]!r}:
            raise RuntimeError("on purpose")
        if q[0] == {PLACES[MAGIC["infinite"], 0]!r}:
            return np.full(3, np.inf)
        if q[0] == {PLACES[MAGIC["slow"], 0]!r}:
            time.sleep({1.2 * STALE})
    return solve(robot, q, *rest, **more)
feedforward.inverse_dynamics = failing
raise SystemExit(twin.run(twin.NODE))
""".replace("np.float64", "")


class Chain:
    """A running node, two gates behind it, and the law for all that leaves them."""

    def __init__(self, peer, launch):
        self.peer, self.law = peer, Judge()
        settings = (f"stale_after:={STALE}", "trip_count:=2", "on_stop:=gravity")
        self.twin = launched(peer, launch, "chain", *settings, code=CODE)
        self.gates = []
        for name in ("gravity", "zeros"):
            own = (f"deadline:={STALE}", "recovery_count:=2", f"on_stop:={name}")
            words = renamed(f"gate_{name}")
            for topic, other in (("joint_states", "states"), ("delta_dynamics/joint_torques", "joint_torques")):
                words += ["-r", f"{topic}:=/chain/{other}"]
            self.gates.append(launch("delta_dynamics.nodes.gate", *own, arguments=words))
            self._take(JointState, f"/gate_{name}/commands_stamped", self._note_gate)
            self._take(Float64MultiArray, f"/gate_{name}/commands", self._note_gate)
        self._take(JointState, "/chain/joint_torques", self._judge_torques)
        self._take(Float64MultiArray, "/chain/commands", self._judge_commands)
        self._take(JointTrajectory, "/chain/joint_trajectory_ff", self._judge_points)
        peer.talk(Clock, "/clock")
        self.place, self.offset, self.simulated = 0, 0, False
        self.policies = [[0.0, math.inf, "warn"]]
        self.on_stop, self.heavy, self.stamps, self.answers, self.torques = "gravity", False, set(), 0, set()
        self.stops = self.points = self.forwarded = 0
        self.passed = []
        """Efforts of the gates, and when they left."""

    def _take(self, kind, topic, judge):
        def take(message, info):
            judge(message, info["source_timestamp"] / SECOND)

        self.peer.node.create_subscription(kind, topic, take, 1000)

    def policy(self, left):
        """The policy when a message left; while it changes, the one that allows more."""
        allowed = {policy for begin, end, policy in self.policies if begin <= left <= end}
        return next(policy for policy in ("warn", "clamp", "reject") if policy in allowed)

    def _judge_torques(self, message, left):
        answer = stamp_of(message) in self.stamps
        self.answers += answer
        self.stops += not answer
        self.torques.add(tuple(message.effort))
        self.law.judge(message.effort, left, STALE + SENDING, self.policy(left) if answer else "zeros")

    def _judge_commands(self, message, left):
        self.law.judge(message.data, left, STALE + SENDING, self.policy(left))

    def _judge_points(self, message, left):
        self.points += 1
        for point in message.points:
            self.law.judge(point.effort, left, math.inf, self.policy(left))

    def _note_gate(self, message, left):
        self.passed.append((tuple(message.effort if hasattr(message, "effort") else message.data), left))

    def judge_gates(self):
        """Judge what the gates have sent, the torques that they forward having come here too."""
        for effort, left in self.passed:
            forwarded = any(effort) and effort in self.torques
            self.forwarded += forwarded
            # A stop's torque is old by as much as its state was, and by its way to the gate.
            age = STALE + SENDING + forwarded * STALE
            self.law.judge(effort, left, age, "clamp" if forwarded else "zeros")
        self.passed.clear()

    def send(self, place=None, **fields):
        """A state of the machine in its next place, or in this one."""
        self.place += 1
        place = place or self.place
        now = self.peer.now()
        self.law.state(place, now / SECOND)
        if self.simulated:
            self.peer.send("/clock", Clock(clock=MAKE.header(now + self.offset).stamp))
        given = {"position": PLACES[place], "velocity": (0.0, 0.0, 0.0), "stamp": now + self.offset}
        self.stamps.add(given["stamp"])
        self.twin.send_state(MAKE.joint_state(**({"names": NAMES} | given | fields)))

    def wait(self, seconds, repeat=None):
        end = time.monotonic() + seconds
        self.peer.until(lambda: time.monotonic() > end, repeat=repeat, every=0.01)

    def until_answered(self, more=5):
        before = self.answers
        self.peer.until(lambda: self.answers >= before + more, repeat=self.send, every=0.003)

    def until_open(self):
        """Both gates forward the stream."""
        self.peer.until(
            lambda: sum(any(effort) and effort in self.torques for effort, _ in self.passed) > 10,
            repeat=self.send,
            every=0.003,
        )

    def until_stopped(self, repeat=None):
        before, told = self.stops, self.peer.received("/diagnostics")
        told.clear()

        def stopped():
            """Without a command only the diagnostics say so."""
            own = (array.status[0] for array in told) if self.on_stop == "nothing" else ()
            return self.stops > before or any(s.name == "/chain" and s.message.startswith("stopped") for s in own)

        self.peer.until(stopped, repeat=repeat, every=0.01)

    def bad(self, **fields):
        self.until_stopped(lambda: self.send(**fields))

    def set(self, **values):
        begin = time.time()
        assert self.twin.set(**values).successful
        if "limit_policy" in values:
            self.policies[-1][1] = time.time()
            self.policies.append([begin, math.inf, values["limit_policy"]])

    def set_payload(self, heavy):
        self.heavy = heavy
        self.set(payload__mass=60.0 if heavy else ROBOT.payload.mass, payload__com=[0.0, 0.0, 0.0])

    def ask(self, **changes):
        rest = np.zeros((3, 3))
        for k in range(3):
            self.law.state(k, self.peer.now() / SECOND)
        points = {"names": NAMES, "times": [0, SECOND, 2 * SECOND], "positions": PLACES[:3]}
        fields = points | {"velocities": rest, "accelerations": rest} | changes
        self.twin.send("joint_trajectory", MAKE.trajectory(**fields))

    def suspend(self, *processes, feed):
        """Processes stand still for longer than any state is good, the machine moves meanwhile."""
        # A process finishes what it has begun: stopped just before it sends, it would send that late.
        self.wait(0.1)
        for process in processes:
            process.process.send_signal(signal.SIGSTOP)
        self.place += 1500
        self.wait(2.5 * STALE, self.send if feed else None)
        for process in processes:
            process.process.send_signal(signal.SIGCONT)


def jump(chain):
    def leap():
        chain.send()
        chain.place += 500
        chain.send()

    chain.until_stopped(leap)


def singular(chain):
    chain.set(singularity_warn=1.0, singularity_stop=0.99)
    chain.bad()
    chain.set(singularity_stop=0.01, singularity_warn=0.05)


def effort_limit(chain):
    heavy, policy = chain.heavy, chain.policies[-1][2]
    chain.set_payload(True)
    chain.set(limit_policy="reject")
    chain.twin.call(Trigger, "reset")
    chain.bad()
    chain.set(limit_policy=policy)
    chain.set_payload(heavy)


def late_answer(chain):
    """The next state would be too old itself."""
    chain.set(trip_count=1)
    chain.bad(place=MAGIC["slow"])
    chain.set(trip_count=2)


def inactive(chain):
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
        assert chain.twin.call(ChangeState, "change_state", transition=Transition(id=transition)).success
        chain.wait(0.05, chain.send)


def clock_jump(chain):
    """The clock becomes a simulated one, which leaps, goes back, and is the system's again."""
    chain.simulated, chain.offset = True, 20 * SECOND
    chain.set(use_sim_time=True)
    chain.wait(0.1, chain.send)
    for offset in (30, 5):
        chain.twin.call(Trigger, "reset")
        chain.wait(0.1, chain.send)
        chain.offset = offset * SECOND
        chain.wait(0.1, chain.send)
    chain.simulated, chain.offset = False, 0
    chain.set(use_sim_time=False)


def suspend_twin(chain):
    chain.suspend(chain.twin.process, feed=False)
    chain.until_stopped()


REASONS = {
    "not finite": lambda chain: chain.bad(position=(math.nan, 0.2, 0.3)),
    "not finite, rate": lambda chain: chain.bad(velocity=(0.0, math.inf, 0.0)),
    "missing joint": lambda chain: chain.bad(names=("a", "b", "c")),
    "limit": lambda chain: chain.bad(position=(3.0, 0.2, 0.3)),
    "no velocities": lambda chain: chain.bad(velocity=()),
    "zero stamp": lambda chain: chain.bad(stamp=0),
    "future stamp": lambda chain: chain.bad(stamp=chain.peer.now() + SECOND),
    "stale stamp": lambda chain: chain.bad(stamp=chain.peer.now() - SECOND),
    "stamp order": lambda chain: chain.bad(stamp=chain.peer.now() - round(0.4 * STALE * SECOND)),
    "jump": jump,
    "singular": singular,
    "effort limit": effort_limit,
    "inactive": inactive,
    "exception": lambda chain: chain.bad(place=MAGIC["raises"]),
    "non-finite result": lambda chain: chain.bad(place=MAGIC["infinite"]),
    "late answer": late_answer,
    "clock jump": clock_jump,
    "stale input": Chain.until_stopped,
    "stale input, suspended": suspend_twin,
}
"""Every reason of a stop that messages, requests and signals bring about; the counter's words come
first. A sleeping machine that has no wrench, or no motion of its base, is tried on the core."""
SUSPENSIONS = {
    "twin": lambda chain: chain.suspend(chain.twin.process, feed=True),
    "gates": lambda chain: chain.suspend(*chain.gates, feed=True),
    "gates, silent": lambda chain: chain.suspend(*chain.gates, feed=False),
    "all": lambda chain: chain.suspend(chain.twin.process, *chain.gates, feed=True),
}
WAYS = REASONS | SUSPENSIONS


@pytest.fixture(scope="module")
def chain(peer, launch):
    chain = Chain(peer, launch)
    chain.until_answered()
    chain.until_open()
    return chain


def stop(chain, way, on_stop, policy, heavy):
    """Stop the running stream in this way; what left meanwhile is judged."""
    if chain.place > len(PLACES) - 5000:
        chain.place = 10
        chain.wait(2.5 * STALE)
    chain.on_stop = on_stop
    chain.set(on_stop=on_stop, limit_policy=policy)
    chain.set_payload(heavy)
    chain.ask()
    chain.ask(positions=np.full((3, 3), math.nan))
    chain.twin.call(Trigger, "reset")
    if heavy and policy == "reject":
        # No answer leaves: the stream runs for an effort that is within the limits.
        chain.set_payload(False)
    chain.until_answered()
    chain.set_payload(heavy)
    WAYS[way](chain)
    chain.judge_gates()


def run(chain, cases):
    """Stop the chain in each way, with each on_stop, policy and payload."""
    for case in cases:
        stop(chain, *case)
    missing = {way.split(",")[0] for way in REASONS}
    # A loaded machine may stop the stream for want of states before it is stopped in its way.
    for _ in range(4):
        missing -= counts_of(chain.twin.diagnostics(), "stopped").keys()
        for case in cases:
            if case[0].split(",")[0] in missing:
                stop(chain, *case)
    assert not missing
    for process in (chain.twin.process, *chain.gates):
        assert process.alive(), process.output
    # At least one of each kind was judged, and answers that are not zero.
    assert min(chain.answers, chain.stops, chain.points, chain.forwarded) > 0
    assert chain.law.judged > 100


def test_no_effort_leaves_a_live_node_beyond_its_limits_or_of_an_old_state(chain):
    ways = zip(WAYS, cycle(ON_STOP), cycle(p for p in POLICIES for _ in range(3)), cycle((False, True)), strict=False)
    run(chain, list(ways))


@pytest.mark.long
def test_no_effort_leaves_by_any_reason_any_on_stop_and_any_policy(chain):
    cases = product(WAYS, ON_STOP, POLICIES)
    run(chain, [(*case, heavy) for case, heavy in zip(cases, cycle((False, True)), strict=False)])
