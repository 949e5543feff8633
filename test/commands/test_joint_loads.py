# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint loads: rainflow by the standard's example, life by hand, open reactions by elasticity."""

import re

import numpy as np
import pytest

from delta_dynamics import elastic_reactions, least_norm_reactions, reactions
from delta_dynamics.torques.elastic_reactions import energy_forms
from delta_dynamics.torques.reactions import balance
from pkm_twin.errors import ParameterError, RobotWarning
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.paths.joint_loads import (
    Reversals,
    Summary,
    compute_bearing_life,
    compute_joint_loads,
    count_rainflow_cycles,
    find_reversals,
    joints_by_label,
    read_bearings,
)
from pkm_twin.recordings import ReadOptions, Recording, read
from stiffness_monitor import platform_response
from test.machine.random_machines import plain
from test.machine.test_helical import slide
from test.support.robots import SHIPPED, load, partly_long, random_joints, rigid
from test.support.tables import joined, of_joints, read_columns, write_columns

ASTM = [-2, 1, -3, 5, -1, 3, -4, 4, -2]
"""Load of ASTM E1049-85, figure 6."""


def test_rainflow_is_the_standards_example():
    """ASTM E1049-85, 5.4.4: half cycles of 3, 4, 8, 9, 8, 6 and a whole one of 4."""
    found = count_rainflow_cycles(ASTM)
    counted = sorted(zip(found.ranges.tolist(), found.counts.tolist(), strict=True))
    expected = [(3, 0.5), (4, 0.5), (4, 1.0), (6, 0.5), (8, 0.5), (8, 0.5), (9, 0.5)]
    assert counted == expected
    whole = found.means[found.counts == 1.0]
    assert whole.tolist() == [1.0]
    # More samples between the reversals, and rests, change nothing.
    fine = np.interp(np.linspace(0, 8, 801), np.arange(9), ASTM)
    again = count_rainflow_cycles(np.repeat(fine, 2))
    assert again.ranges.tolist() == pytest.approx(found.ranges.tolist())
    assert again.counts.tolist() == found.counts.tolist()


def test_cycles_hold_all_reversals(rng):
    for _ in range(50):
        load_ = rng.normal(size=60)
        points = find_reversals(load_)
        found = count_rainflow_cycles(load_)
        # Each reversal to the next is half a cycle.
        assert found.counts.sum() == pytest.approx((len(points) - 1) / 2)
        assert found.ranges.max() == pytest.approx(np.ptp(load_))
        ends, counts = found.spectrum(16)
        assert counts.sum() == pytest.approx(found.counts.sum())
        assert ends[-1] == pytest.approx(np.ptp(load_))
    for flat in ([], [1.0], [2.0, 2.0, 2.0]):
        assert count_rainflow_cycles(flat).equivalent_range(5.0) == 0.0


def test_reversals_of_blocks_are_those_of_the_whole(rng):
    for values in (rng.normal(size=200), rng.integers(0, 3, 200), np.zeros(30), np.arange(9.0)):
        found = Reversals()
        for part in np.split(values, np.sort(rng.integers(0, len(values), 12))):
            found.add(part)
        np.testing.assert_array_equal(found.values, find_reversals(values))


def test_loads_in_blocks_are_those_of_the_whole(twin, tmp_path, monkeypatch):
    """Peaks, spectra, turning, life and the table do not depend on where blocks begin."""
    robot = load("five_bar")
    (tmp_path / "bearings.yaml").write_text("bearings: {elbow_right: {C: 5000, Y: 1.5}}")
    results = []
    for block in (512, 7):
        monkeypatch.setattr("pkm_twin.paths.joint_loads.SAMPLES_PER_BLOCK", block)
        out = tmp_path / f"{block}.csv"
        data = twin.told(
            "loads",
            "five_bar",
            path(robot, tmp_path),
            "--bearings",
            tmp_path / "bearings.yaml",
            "--out",
            out,
            "--payload",
            "0.2",
            "--load-times",
            "0.2,0.5",
        )
        results.append((data["joints"], out.read_text()))
    (whole, table), (parts, again) = results
    assert table == again
    for name, entry in whole.items():
        for key, value in entry.items():
            assert parts[name][key] == pytest.approx(value, rel=1e-9), (name, key)


def test_life_of_a_bearing_by_hand():
    """Half the turning at 1 kN, half at 2 kN; C = 10 kN, balls; 100 turns a minute."""
    load_, turned = np.repeat([1000.0, 2000.0], 50), np.full(100, 2 * np.pi)
    life = compute_bearing_life(load_, turned, 60.0, 10_000.0)
    mean = ((1000.0**3 + 2000.0**3) / 2) ** (1 / 3)
    assert life.load == pytest.approx(mean)
    assert life.life == pytest.approx(1e6 * (10_000.0 / mean) ** 3)
    assert life.hours == pytest.approx(life.life / 100 / 60)
    # What bears a load and does not move has no life that follows from motion.
    assert np.isnan(compute_bearing_life(load_, 0 * turned, 60.0, 10_000.0).hours)
    assert compute_bearing_life(0 * load_, turned, 60.0, 10_000.0).hours == np.inf


@pytest.mark.parametrize("name", ["linear_delta", "prru", "upr_rpu"])
def test_life_of_a_sliding_joint_is_that_of_its_travel(name, twin, tmp_path):
    """C for 100 km; the force along it is the drive's."""
    robot = load(name)
    joint = next(joint for joint in robot.graph.joints.values() if joint.slides)
    label, source = joint.label or joint.name, path(robot, tmp_path)
    given = tmp_path / "bearings.yaml"
    given.write_text(f"bearings: {{'{label}': {{C: 8000}}}}")
    told = twin.told("loads", name, source, "--bearings", given)["joints"][label]
    motion = read(source, robot, ReadOptions(planned=True)).with_rates()
    load_ = next(one for one in next(compute_joint_loads(motion)) if one.name == label)
    steps = np.abs(np.diff(joined(read_columns(source), robot, "position")[:, 0]))
    across = np.linalg.norm(np.cross(load_.own[:, :3], joint.axes[0]), axis=1)
    mean = np.average(((across[1:] + across[:-1]) / 2) ** 3, weights=steps) ** (1 / 3)
    assert 0.0 < mean < told["force_peak_N"]
    borne = across.max() if joint.actuated else told["force_peak_N"]
    assert told["bearing_force_peak_N"] == pytest.approx(borne)
    life = told["life"]
    assert life["equivalent_load_N"] == pytest.approx(mean)
    assert life["travel_m"] == pytest.approx(steps.sum())
    assert life["L10_hours"] == pytest.approx(1e5 * (8000 / mean) ** 3 / steps.sum() / 3600)
    given.write_text(f"bearings: {{'{label}': {{C: 8000, Y: 1}}}}")
    assert f"bearings.{label}.Y" in twin.refused("loads", name, source, "--bearings", given)


@pytest.mark.parametrize("name", ["five_bar", "upr_rpu"])
def test_open_reactions_are_those_of_the_elastic_frame(name, rng):
    """Their energies, element by element, are the finite elements'."""
    robot = load(name).changed(gravity=[0.0, 0.0, 0.0])
    q = random_joints(robot, rng, 3)
    still, wrench = np.zeros_like(q), rng.normal(size=(3, 6)) * [50, 50, 50, 5, 5, 5]
    found = elastic_reactions(robot, q, still, still, wrench)
    assert not found.indeterminate
    assert found.residual.max() < 1e-9
    forms = energy_forms(robot, q, balance(robot, q, still, still, wrench))

    def energies_of(value):
        return {name: np.einsum("...k,...kl,...l->...", value, form, value) / 2.0 for name, form in forms.items()}

    energies = energies_of(found.values)
    response = platform_response(robot, q, wrench)
    for k, element in enumerate(response.elements):
        np.testing.assert_allclose(energies[element], response.energies[:, k], rtol=1e-6)
    # What statics determines is untouched, and another solution stores more.
    known = reactions(robot, q, still, still, wrench)
    mask = known.determinate
    np.testing.assert_allclose(found.wrenches[mask], known.wrenches[mask], atol=1e-7)
    other = least_norm_reactions(robot, q, still, still, wrench)
    assert (sum(energies_of(other.values).values()) > sum(energies.values())).all()


def path(robot, folder):
    time = np.linspace(0.0, 1.0, 41)
    low, high = robot.limits.position.T
    wave = np.sin(2 * np.pi * np.outer(time, np.arange(1, len(low) + 1)))
    q = robot.graph.home + 0.05 * (high - low) * wave
    columns = {"time": time} | of_joints(robot, "position", q)
    return write_columns(folder / "path.csv", columns)


@pytest.mark.parametrize("name", partly_long(list(SHIPPED), "five_bar"))
def test_loads_of_a_path(name, twin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot = load(name)
    joint = reactions(robot, robot.graph.home, *np.zeros((2, robot.joints_count))).names[-1]
    (tmp_path / "bearings.yaml").write_text(f"bearings: {{'{joint}': {{C: 5000}}}}")
    data = twin.told(
        "loads",
        name,
        path(robot, tmp_path),
        "--bearings",
        "bearings.yaml",
        "--out",
        "a.csv",
        "--spectrum",
        "s.csv",
        "--picture",
        "a.png",
    )
    told, table = data["joints"], read_columns(tmp_path / "a.csv")
    force = np.stack([table[f"{joint}.f{axis}"] for axis in "xyz"], -1)
    peak = np.linalg.norm(force, axis=1).max()
    assert told[joint]["force_peak_N"] == pytest.approx(peak)
    assert told[joint]["life"]["L10_hours"] > 0.0
    assert not any(entry["undetermined"] for entry in told.values())
    assert (tmp_path / "a.png").stat().st_size
    counted = [line.split(",") for line in (tmp_path / "s.csv").read_text().splitlines()[1:]]
    assert {line[0] for line in counted} <= set(told)


def test_what_nothing_decides_is_named(twin, tmp_path):
    """The same machine without members: out of its plane statics is open."""
    robot = load(rigid("five_bar", tmp_path / "rigid.yaml"))
    told = twin.told("loads", tmp_path / "rigid.yaml", path(robot, tmp_path))["joints"]
    assert "fy" in told["tip"]["undetermined"]
    assert "fx" not in told["tip"]["undetermined"]
    assert told["tip"]["force_peak_N"] is None
    # In the plane it is that of the machine with members.
    motion = path(robot, tmp_path)
    twin.good("loads", "five_bar", motion, "--out", tmp_path / "a.csv")
    table = read_columns(tmp_path / "a.csv")
    for name, entry in told.items():
        force = np.hypot(table[f"{name}.fx"], table[f"{name}.fz"]).max()
        assert entry["force_determined_peak_N"] == pytest.approx(force, rel=1e-3)
    shown = twin.good("loads", tmp_path / "rigid.yaml", motion, "--picture", tmp_path / "b.png")
    assert re.search(r"most of what is determined, a force of at least \d", shown.out)


def test_turning_of_a_hinge_and_of_a_rod(rng):
    robot = load("five_bar")
    time = np.linspace(0.0, 1.0, 50)
    q = robot.graph.home + 0.1 * np.outer(np.sin(7 * time), [1.0, -0.6])
    zero = np.zeros_like(q)
    found = {j.name: j for j in next(compute_joint_loads(Recording(robot, time, q, zero, zero)))}
    borne = Summary(robot, "left", None)
    borne.add(found["left"])
    # The drive alone bears the moment about its axis.
    across = np.cross(found["left"].own[:, 3:], robot.graph.joints["left"].axes[0])
    assert 10.0 * borne.peaks[3] < borne.peaks[1]
    assert borne.peaks[3] == pytest.approx(np.linalg.norm(across, axis=1).max())
    np.testing.assert_allclose(found["left"].turned, np.abs(np.diff(q[:, 0])), atol=1e-12)
    elbow = robot.passive(q)[:, robot.passive_joints.index("elbow_right")]
    np.testing.assert_allclose(found["elbow_right"].turned, np.abs(np.diff(elbow)), atol=1e-12)
    robot = load("linear_delta")
    q = 0.3 + 0.03 * np.outer(np.sin(7 * time), [1.0, -0.6, 0.3])
    zero = np.zeros_like(q)
    loads = next(compute_joint_loads(Recording(robot, time, q, zero, zero)))
    rod = robot.graph.rods["left_1"]
    way = rod.ends[1] - rod.ends[0] + robot.platform(q)[0] - robot.graph.origin
    way = way - np.outer(q[:, 0] - 0.3, [0, 0, 1])
    way = way / np.linalg.norm(way, axis=1, keepdims=True)
    angle = np.arccos(np.minimum((way[1:] * way[:-1]).sum(1), 1.0))
    own = next(j for j in loads if j.name == rod.joint_names[0])
    np.testing.assert_allclose(own.turned, angle, rtol=1e-2, atol=1e-6)


def test_a_slide_that_closes_a_loop_travels_by_the_screw_s_lead():
    q = np.linspace(0.0, 6.0 * np.pi, 7)[:, None]
    motion = Recording(slide(0.02), np.arange(7.0), q, 0 * q, 0 * q)
    rail = {load.name: load for load in next(compute_joint_loads(motion))}["rail"]
    np.testing.assert_allclose(rail.travelled, 0.01, atol=1e-12)


def test_a_star_skips_joints_that_the_bearing_does_not_fit(tmp_path):
    """A cylindrical joint takes no bearing; the warning names it."""
    robot = robot_of_data(plain("rccc"), "rccc")
    names = tuple(joints_by_label(robot))
    lines = "bearings: {'*': {C: 1000.0, p: 3}}"
    (tmp_path / "b.yaml").write_text(lines)
    left = [n for n, j in joints_by_label(robot).items() if j.kind == "cylindrical"]
    with pytest.warns(RobotWarning, match=", ".join(left)):
        found = read_bearings(tmp_path / "b.yaml", names, robot)
    assert set(found) == set(names) - set(left) and found
    (tmp_path / "b.yaml").write_text(lines.replace("*", left[0]))
    with pytest.raises(ParameterError, match="slides"):
        read_bearings(tmp_path / "b.yaml", names, robot)
