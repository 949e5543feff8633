# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A collision is seen, a motion is none: on recordings of another engine."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import Contact, ContactMonitor, inverse_dynamics
from pkm_twin import Robot
from pkm_twin.bags.reader import open_bag
from pkm_twin.codegen.arrays import Array
from pkm_twin.recordings import Recording, read
from pkm_twin.recordings.recording import differentiate_motion
from test.laws.contacts import OFF, RATE, REST, Stream, measured, moves, pushed, seen_after
from test.support.robots import load, massive, partly_long, unsure

BAGS = Path(__file__).resolve().parents[2] / "bags"
COLLISION = BAGS / "delta_cu_collision.mcap"
PICKS = BAGS / "delta_cu_pick_and_place.mcap"


def watched(r: Recording, robot: Robot, begin: float, end: float) -> tuple[Array, list[Contact]]:
    """What the monitor says from one time to another."""
    assert r.effort is not None
    qd, qdd, used = differentiate_motion(r)
    monitor, times, found = ContactMonitor(robot), [], []
    for k in np.flatnonzero(used & (r.time > begin) & (r.time < end)):
        contact = monitor.push(float(r.time[k]), (r.q[k], qd[k], qdd[k]), r.effort[k])
        if contact is not None:
            times.append(r.time[k])
            found.append(contact)
    return np.array(times), found


def test_a_collision_is_seen_within_milliseconds_and_nothing_before() -> None:
    r = read(COLLISION)
    facts = open_bag(COLLISION).report.metadata["pkm_twin"]
    begin, force = float(facts["contact_begins_s"]), float(facts["contact_force_N"])
    time, found = watched(r, r.robot, 1.2, 3.0)
    touching = np.array([contact.touching for contact in found])
    assert not touching[time < begin].any()
    assert time[touching][0] - begin < 0.010
    # All the while the force grows to twenty times what it is at first.
    places = [contact.place for contact in found if contact.place is not None]
    assert len(places) > 300
    assert np.mean([place.where == "platform" for place in places]) > 0.95
    wrenches = np.array([contact.wrench for contact in found])
    # Against the way into the wall, about as hard as it was.
    assert abs(wrenches[:, 0].max() - force) < 0.05 * force
    assert np.abs(wrenches[:, 1:3]).max() < 0.2 * force


def test_fast_picks_are_no_contact() -> None:
    """Two seconds of picks without the payload; with it where it is told of."""
    r = read(PICKS)
    assert r.load is not None
    laden = r.robot.changed(payload={"mass": r.load.mass})
    for robot, begin in ((r.robot, 2.0), (laden, 9.0)):
        _, found = watched(r, robot, begin, begin + 1.5)
        assert not any(contact.touching for contact in found)
    # What is not told of pushes.
    time, found = watched(r, r.robot, 7.5, 8.35)
    touching = np.array([contact.touching for contact in found])
    assert not touching[time < 8.275].any()
    assert touching[-1]
    assert found[-1].wrench[2] == pytest.approx(-r.load.mass * 9.81, rel=0.15)


def test_a_model_that_is_less_sure_lets_more_pass() -> None:
    robot = load("delta_cu")
    q = robot.inverse(robot.home())
    still = np.zeros(3)
    bounds = []
    for machine in (robot, unsure(robot, {"inertia": {"relative": 0.05}})):
        monitor = ContactMonitor(machine)
        effort = np.full(3, 0.4)
        for k in range(400):
            contact = monitor.push(1e-3 * k, (q, still, still), effort)
        assert contact is not None
        bounds.append(contact.bound)
    assert np.all(bounds[1] > bounds[0])


def test_what_cannot_be_a_bound_is_refused() -> None:
    with pytest.raises(ValueError, match="sigmas is 0"):
        ContactMonitor(load("delta"), sigmas=0.0)


WATCHED = partly_long(["delta_cu", "linear_delta", "rps3", "stewart", "prru", "upr_rpu", "five_bar"], "linear_delta")


@pytest.mark.parametrize("seed", partly_long(range(3), 0))
@pytest.mark.parametrize("name", WATCHED)
class TestDepartures:
    """Machines that depart from their models by a few percent, after two seconds of rest."""

    @pytest.mark.parametrize(
        "what",
        partly_long([what for what in OFF if "10 %" not in what], "both, 3 % each"),
    )
    def test_they_touch_nothing(self, name: str, seed: int, what: str) -> None:
        robot, rng = load(name), np.random.default_rng(seed)
        stream = measured(robot, rng, moves(robot, rng, 5, 0.7), **OFF[what])
        assert not stream.watched(robot).any()

    def test_a_push_is_seen_all_the_same(self, name: str, seed: int) -> None:
        """Of a third of the peak effort, in motion."""
        robot, rng = load(name), np.random.default_rng(seed)
        motion = moves(robot, rng, 5, 0.7)
        begin = rng.uniform(REST + 0.15, REST + 1.0)
        wrench = pushed(robot, rng, motion, 0.35, begin)
        stream = measured(robot, rng, motion, wrench=wrench, masses=0.03, friction=0.03)
        assert seen_after(stream, robot, begin) < 0.06

    def test_friction_that_is_left_out_is_learnt(self, name: str, seed: int) -> None:
        """A tenth of the peak effort: whatever it looked like before, it is no contact then."""
        robot, rng = load(name), np.random.default_rng(seed)
        stream = measured(robot, rng, moves(robot, rng, 14, 0.7), friction=0.1)
        touching = stream.watched(robot)
        assert not touching[len(touching) // 2 :].any()


@pytest.mark.parametrize(
    "case",
    partly_long(
        [(what, rest) for what in ("as the model", "both, 3 % each") for rest in (0.0, 0.5)],
        ("both, 3 % each", 0.0),
    ),
)
@massive
def test_free_motion_touches_nothing_from_the_first_sample_on(name: str, case: tuple[str, float]) -> None:
    """Also where the friction is large beside the efforts so far: the fastest moves come later."""
    what, rest = case
    robot, rng = load(name), np.random.default_rng([30, *name.encode()])
    stream = measured(robot, rng, moves(robot, rng, 40, 0.7, rest), **OFF[what])
    first = Stream(*(part[: round((rest + 2.0) * RATE)] for part in vars(stream).values()))
    assert not first.watched(robot).any()


@pytest.mark.parametrize("name", partly_long(["stewart", "upr_rpu"], "upr_rpu"))
def test_a_push_as_a_machine_begins_to_move_is_seen(name: str) -> None:
    """Before a joint has moved both ways, and though it opposes the motion."""
    robot, rng = load(name), np.random.default_rng(6)
    motion = moves(robot, rng, 3, 0.7, 0.5)
    begin = 0.7
    wrench = pushed(robot, rng, motion, 0.5, begin)
    for way in (1.0, -1.0):
        stream = measured(robot, rng, motion, wrench=way * wrench, friction=0.03)
        assert seen_after(stream, robot, begin) < 0.06


def test_a_push_that_lasts_is_no_friction() -> None:
    """Both ways, for seconds: it pushes one way only."""
    robot, rng = load("delta_cu"), np.random.default_rng(1)
    motion = moves(robot, rng, 14, 0.7)
    wrench = pushed(robot, rng, motion, 0.6, REST + 0.5)
    touching = measured(robot, rng, motion, wrench=wrench).watched(robot)
    assert touching[motion[0] > REST + 1.0].mean() > 0.9


def test_a_push_at_rest_is_seen() -> None:
    """Also against joints that stick, beyond what their friction bears."""
    for name, share in (("delta_cu", 0.15), ("linear_delta", 0.5)):
        robot, rng = load(name), np.random.default_rng(2)
        motion = moves(robot, rng, 1, 0.7)
        wrench = pushed(robot, rng, motion, share, 1.0)
        stream = measured(robot, rng, motion, wrench=wrench)
        assert seen_after(stream, robot, 1.0) < 0.06


def test_joints_that_stick_are_no_contact() -> None:
    """At rest friction is anything up to its size, and stays so."""
    robot, rng = load("linear_delta"), np.random.default_rng(3)
    home, still = robot.inverse(robot.home()), np.zeros(3)
    held = inverse_dynamics(robot, home, still, still)
    monitor = ContactMonitor(robot)
    for k in range(1500):
        stuck = robot.friction.coulomb * np.array([0.95, -0.95, 0.95]) * (k > 500)
        qd = 1e-4 * rng.normal(size=3)
        found = monitor.push(2e-3 * k, (home, qd, still), held + stuck + 0.01 * rng.normal(size=3))
        assert found is None or not found.touching


@pytest.mark.parametrize("braked", partly_long([0.0, 0.3], 0.3))
def test_drives_that_are_off_or_braked_are_no_contact(braked: float) -> None:
    """Off from the first sample on; then on; then off at once."""
    robot, rng = load("delta_cu"), np.random.default_rng(4)
    home, still = robot.inverse(robot.home()), np.zeros(3)
    held = inverse_dynamics(robot, home, still, still)
    monitor, idle = ContactMonitor(robot), []
    for k in range(3000):
        live = k // 1000 == 1
        effort = held + 2e-3 * rng.normal(size=3) if live else braked * held
        found = monitor.push(1e-3 * k, (home, 1e-5 * rng.normal(size=3), still), effort)
        idle.append(monitor.drives.idle)
        # A jump to another effort looks like a push until it has lasted.
        assert found is None or not found.touching or (braked and 0 <= k - 2000 < 120)
    idle_parts = np.array(idle).reshape(3, 1000)[:, 600:].mean(1)
    np.testing.assert_array_equal(idle_parts, [1.0, 0.0, 1.0])


def test_the_default_is_used_where_the_file_says_nothing_of_efforts() -> None:
    robot = load("delta_cu")
    assert ContactMonitor(unsure(robot, {"inertia": {"relative": 0.02}})).stated
    # The second one is unsure of its elastic parts alone.
    assert not ContactMonitor(robot).stated and not ContactMonitor(load("upr_rpu")).stated


def test_friction_that_grows_with_a_contact_is_no_part_of_it() -> None:
    """In motion, where the share of the gears is known; without accelerations."""
    robot = load("delta_cu").changed(friction={"coulomb": 0.05, "load_dependent": 0.2})
    rng = np.random.default_rng(5)
    begin = 0.5
    time, q, qd, qdd = moves(robot, rng, 2, 0.5, 0.3)
    wrench = pushed(robot, rng, (time, q, qd, qdd), 0.8, begin)
    effort = inverse_dynamics(robot, q, qd, qdd, wrench)
    monitor, off = ContactMonitor(robot), []
    for k, t in enumerate(time.tolist()):
        found = monitor.push(t, (q[k], qd[k], qdd[k]), effort[k])
        assert found is None or t >= begin or not found.touching
        # At rest friction holds a part; the estimate lags by 17 ms.
        if found is not None and t > begin + 0.12 and np.abs(qd[k]).min() > 0.3:
            true = robot.platform_jacobian(q[k]).T @ wrench[k]
            off.append(np.linalg.norm(found.external - true) / np.linalg.norm(true))
    assert len(off) > 20
    assert np.median(off) < 0.05
