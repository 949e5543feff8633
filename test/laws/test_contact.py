# SPDX-License-Identifier: Apache-2.0
"""A collision is seen, a motion is none: on recordings of another engine."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from delta_dynamics import Contact, ContactMonitor
from pkm_twin import Robot
from pkm_twin.apps.check import motion
from pkm_twin.apps.recorded import Recording, read_recording
from pkm_twin.bags.reader import open_bag
from pkm_twin.machine.catalogue import robot_of_data
from pkm_twin.machine.entries import given
from test.support.robots import load

Array = NDArray[np.float64]

BAGS = Path(__file__).resolve().parents[2] / "bags"
COLLISION = BAGS / "delta_cu_collision.mcap"
PICKS = BAGS / "delta_cu_pick_and_place.mcap"


def watched(r: Recording, robot: Robot, begin: float, end: float) -> tuple[Array, list[Contact]]:
    """What the monitor says from one time to another."""
    assert r.effort is not None
    qd, qdd, used = motion(r)
    monitor, times, found = ContactMonitor(robot), [], []
    for k in np.flatnonzero(used & (r.time > begin) & (r.time < end)):
        contact = monitor.push(float(r.time[k]), (r.q[k], qd[k], qdd[k]), r.effort[k])
        if contact is not None:
            times.append(r.time[k])
            found.append(contact)
    return np.array(times), found


def test_a_collision_is_seen_within_milliseconds_and_nothing_before() -> None:
    r = read_recording(COLLISION)
    facts = open_bag(COLLISION).report.metadata["pkm_twin"]
    begin, force = float(facts["contact_begins_s"]), float(facts["contact_force_N"])
    time, found = watched(r, r.robot, 1.2, 3.0)
    touching = np.array([contact.touching for contact in found])
    assert not touching[time < begin].any()
    assert time[touching][0] - begin < 0.010
    wrenches = np.array([contact.wrench for contact in found])
    # Against the way into the wall, about as hard as it was.
    assert abs(wrenches[:, 0].min() + force) < 0.05 * force
    assert np.abs(wrenches[:, 1:3]).max() < 0.2 * force


def test_fast_picks_are_no_contact() -> None:
    """Two seconds of picks without the payload; with it where it is told of."""
    r = read_recording(PICKS)
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
    data = {**given(robot.parameter_sections()), "mechanism": robot.mechanism}
    unsure = robot_of_data({**data, "uncertainty": {"inertia": {"relative": 0.05}}}, "unsure")
    q = robot.inverse(robot.home())
    still = np.zeros(3)
    bounds = []
    for machine in (robot, unsure):
        monitor = ContactMonitor(machine)
        effort = np.full(3, 0.4)
        for k in range(400):
            contact = monitor.push(1e-3 * k, (q, still, still), effort)
        assert contact is not None
        bounds.append(contact.bound)
    assert np.all(bounds[1] > bounds[0])


def test_what_cannot_be_a_bound_is_refused() -> None:
    with pytest.raises(ValueError, match="sigmas is 0, allowed above 0"):
        ContactMonitor(load("delta"), sigmas=0.0)
