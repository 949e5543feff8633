# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The struck body by the direction of efforts: Jacobians by differences, classes by frequency."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from delta_dynamics import ContactMonitor, inverse_dynamics
from delta_dynamics.estimates.isolation import (
    CLAMPING,
    PLATFORM,
    UNKNOWN,
    CandidatePositions,
    ContactLocator,
    map_limbs,
)
from test.laws.contacts import place_and_jacobian, spot
from test.support.robots import load, often, partly_long, random_joints

NAMES = ["delta_cu", "linear_delta", "rps3", "stewart", "prru", "upr_rpu", "five_bar"]


@pytest.mark.parametrize("name", partly_long(NAMES, "delta_cu", "five_bar"))
def test_jacobians_are_derivatives_of_the_places(name: str, rng: np.random.Generator) -> None:
    robot = load(name)
    places, n = CandidatePositions(robot), robot.joints_count
    assert places.prior.sum() == pytest.approx(0.8)
    for q in random_joints(robot, rng, 2):
        _, jacobian, _ = places.evaluate(q)
        step = 1e-6
        columns = [(places.evaluate(q + step * e)[0] - places.evaluate(q - step * e)[0]) for e in np.eye(n)]
        slope = np.stack(columns, 1) / (2 * step)
        np.testing.assert_allclose(jacobian, slope, atol=1e-6 * max(1.0, np.abs(slope).max()))


def test_limbs_are_what_hangs_together_without_base_and_platform() -> None:
    limbs = map_limbs(load("linear_delta"))
    assert limbs["carriage_1"] == limbs["left_1"] == limbs["right_1"] == "rail_1"
    assert limbs["platform"] == PLATFORM
    five = map_limbs(load("five_bar"))
    assert set(five.values()) == {"left", "right", PLATFORM}


SIZES = [0.0, 1e-200, 1.0, 1e200, 1.7e308]
DEVIATIONS = [0.0, 1e-300, 0.1, 1e200]


@pytest.mark.parametrize("name", partly_long(NAMES, "stewart", "five_bar"))
def test_a_place_is_finite_or_none_and_usual_samples_bring_one(name: str, rng: np.random.Generator) -> None:
    robot = load(name)
    locator, n = ContactLocator(robot), robot.joints_count
    q, still = random_joints(robot, rng, 1)[0], np.zeros(n)
    for size, deviation in product(SIZES, DEVIATIONS):
        for external in (size * np.eye(n)[0], size * rng.choice([-1.0, 1.0], n)):
            for step in (0.0, 1e-3, 1e3):
                locator.push(step, q, still, external, np.full(n, deviation))
                place = locator.place()
                if place is not None:
                    numbers = [*place.point, place.deviation, *place.classes.values()]
                    assert np.isfinite(numbers).all()
                    assert sum(place.classes.values()) == pytest.approx(1.0)
        locator.reset()
        locator.push(1e-3, q, still, np.ones(n), np.full(n, 0.1))
        assert locator.place() is not None


def drawn(name: str, rng: np.random.Generator, count: int) -> list[tuple[str, ContactLocator]]:
    """Forces on platform and limbs, as often as expected before, with 2 % of noise."""
    robot = load(name)
    locator, limbs = ContactLocator(robot), map_limbs(robot)
    owners = sorted({*limbs.values()} - {PLATFORM})
    found = []
    for q in random_joints(robot, rng, count):
        limb = PLATFORM if rng.uniform() < 0.5 else owners[int(rng.integers(len(owners)))]
        _, where, thin = spot(robot, rng, [p for p, own in limbs.items() if own == limb])
        _, jacobian = place_and_jacobian(robot, q[None], where)
        force = rng.normal(size=3)
        if thin:
            ends = [place_and_jacobian(robot, q[None], (*where[:2], s))[0][0] for s in (0.0, 1.0)]
            way = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
            force -= way * (way @ force)
        external = jacobian[0].T @ force
        noise = 0.02 * np.linalg.norm(external) * np.ones(len(q))
        locator.reset()
        locator.push(0.02, q, 0.0 * q, external + noise * rng.normal(size=len(q)), noise)
        place = locator.place()
        assert place is not None
        assert sum(place.classes.values()) == pytest.approx(1.0)
        assert place.confidence == max(place.classes.values())
        found.append((limb, place))
    return found


@pytest.mark.parametrize("count", often(40, 400))
@pytest.mark.parametrize("name", partly_long(NAMES, "delta_cu", "rps3"))
def test_classes_are_right_as_often_as_their_confidence_says(name: str, count: int, rng: np.random.Generator) -> None:
    found = drawn(name, rng, count)
    right = [max(p.classes, key=lambda one: p.classes[one]) == limb for limb, p in found]
    sure = np.array([place.confidence for _, place in found])
    # Forces here are drawn a little differently from what the evidence expects.
    assert abs(np.mean(right) - sure.mean()) < 0.12 + 2.0 * np.sqrt(0.25 / count)
    assert all((p.where == UNKNOWN) == (p.confidence < 0.5 or p.classes[UNKNOWN] == p.confidence) for _, p in found)


def test_six_joint_efforts_show_the_body(rng: np.random.Generator) -> None:
    found = drawn("stewart", rng, 40)
    assert np.mean([place.where == limb for limb, place in found]) > 0.8


def test_what_one_joint_alone_feels_is_its_arm() -> None:
    """Of a Delta: a force on the platform would have to have one direction of all."""
    robot = load("delta_cu")
    locator, q = ContactLocator(robot), robot.inverse(robot.home())
    locator.push(0.02, q, 0.0 * q, np.array([0.0, 3.0, 0.0]), np.full(3, 0.02))
    place = locator.place()
    assert place is not None
    assert place.where == "limb II" and place.confidence > 0.9
    # How far along it is not determined: one effort has one number.
    assert place.body == "arm II"
    assert place.deviation > 0.2 * np.linalg.norm(
        np.ptp(locator.places.evaluate(q)[0][[p == "arm II" for p in locator.places.parts]], axis=0)
    )


@pytest.mark.parametrize("count", often(10, 60))
def test_what_two_limbs_clamp_is_told_from_a_collision(count: int, rng: np.random.Generator) -> None:
    """Opposite forces on two limbs that approach each other, and a force on one of them."""
    assert not len(CandidatePositions(load("delta_cu")).pairs[0])
    robot = load("stewart")
    locator, places = ContactLocator(robot), CandidatePositions(robot)
    a, b = places.pairs
    named: dict[str, list[str]] = {"both": [], "one": []}
    for q in random_joints(robot, rng, count):
        at, jacobian, _ = places.evaluate(q)
        apart = at[a] - at[b]
        far = np.linalg.norm(apart, axis=1)
        k = int(rng.choice(np.flatnonzero(far < 0.35 * robot.graph.size)))
        squeeze = (jacobian[a[k]] - jacobian[b[k]]) @ apart[k] / far[k]
        single = jacobian[a[k]] @ rng.normal(size=3)
        qd = -squeeze / np.linalg.norm(squeeze)
        for what, external in (("both", squeeze), ("one", single)):
            noise = np.full(len(q), 0.02 * np.linalg.norm(external))
            locator.reset()
            locator.push(0.02, q, qd, external + noise * rng.normal(size=len(q)), noise)
            place = locator.place()
            assert place is not None
            named[what].append(place.where.split()[0])
    assert np.mean([one == CLAMPING for one in named["both"]]) >= 0.6
    assert np.mean([one == CLAMPING for one in named["one"]]) <= 0.2


def test_a_contact_is_located_some_times_and_free_motion_never(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At 1 kHz no more than every fourth sample, each detected; the first one at once."""
    robot = load("stewart")
    located: list[float] = []
    push = ContactLocator.push
    monkeypatch.setattr(
        ContactLocator,
        "push",
        lambda self, step, *rest: (located.append(step), push(self, step, *rest))[1],
    )
    monitor, still = ContactMonitor(robot), np.zeros(6)
    monitor.prepare()
    located.clear()
    q = robot.inverse(robot.home())
    held = inverse_dynamics(robot, q, still, still)
    rng, touched = np.random.default_rng(0), 0
    for k in range(700):
        effort = held + 1e-3 * np.abs(held).max() * rng.normal(size=6)
        effort[0] += 9.0 * np.abs(held).max() * (k >= 400)
        found = monitor.push(1e-3 * k, (q, still, still), effort)
        touching = found is not None and found.touching
        touched += touching
        assert touching or not located
        assert not touching or (found is not None and found.place is not None)
    assert touched > 250
    assert 0.08 * touched < len(located) <= 0.25 * touched
    # Each one stands for the time since the one before.
    assert sum(located[1:]) == pytest.approx(1e-3 * touched, abs=0.02)
