# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Maps of one quantity: equal to brute force pose by pose, and the worst pose is the worst."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from delta_dynamics import energy_transfer, inverse_dynamics, max_driving_force
from pkm_twin.errors import ParameterError
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.maps import figures
from pkm_twin.maps.figures import format_value
from pkm_twin.maps.kind import evaluate_kind
from pkm_twin.maps.kinds import KINDS
from pkm_twin.maps.kinds.cutting_depth import CuttingDepth
from pkm_twin.maps.kinds.frequency import Frequency
from pkm_twin.maps.run import run
from pkm_twin.maps.search import evolve, find_worst, score_values
from pkm_twin.maps.store import open_map
from pkm_twin.maps.sweep import plan_map
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.workspace import belong_to_workspace, passive_values, reachable, try_forward
from stiffness_monitor import Milling, compliance, stable_depth, strain_energy
from stiffness_monitor.modes import natural_frequencies
from test.machine.random_machines import FILES, plain
from test.support.command import command
from test.support.pages import numbers
from test.support.robots import ELASTIC, SHIPPED, load, often, parameters_of, partly_long

DRIVEN = [name for name, robot in SHIPPED.items() if robot.limits.effort is not None]
WRENCH = (20.0, -10.0, 30.0, 0.5, -0.3, 0.2)
LEAST = 0.05
LENGTHS = {
    "geometry.arm_length": {"deviation": 1e-4},
    "geometry.base_radius": {"deviation": 2e-4},
    "geometry.forearm_length": {"relative": 1e-4},
}


def states(robot, rng, count, least=LEAST):
    """Joint states that count in a map."""
    low, high = robot.limits.position.T
    q = rng.uniform(low, high, (count, len(low)))
    pose, known = try_forward(robot, q)
    return q[belong_to_workspace(robot, q, pose, known, least, 0.0)]


def found(robot, name, q, wrench=None):
    kind = KINDS[name]()
    return evaluate_kind(kind, robot, q, [case_of(kind, robot, wrench)])[0]


def case_of(kind, robot, wrench=None, name="case"):
    """The case of a load, or the kind's own first."""
    return kind.cases(robot)[0] if wrench is None else kind.loaded(robot, name, wrench)


def directions(rng, count):
    ways = rng.normal(size=(count, 3))
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)


@pytest.mark.parametrize("name", partly_long(ELASTIC, "delta", "rps3"))
def test_elastic_maps_are_brute_force(name, rng):
    robot = load(name)
    q = states(robot, rng, 40)[:4]
    pose = robot.forward(q)
    matrix = compliance(robot, pose)[:, :3, :3]
    soft = found(robot, "compliance", q)
    np.testing.assert_allclose(soft.value, np.linalg.norm(matrix, 2, axis=(1, 2)), rtol=1e-9)
    moved = np.einsum("kij,kj->ki", matrix, soft.direction)
    np.testing.assert_allclose(moved, soft.value[:, None] * soft.direction, atol=1e-9)
    # No direction is softer.
    tried = np.einsum("di,kij,dj->kd", *[ways := directions(rng, 500)], matrix, ways)
    assert (tried <= soft.value[:, None] * (1 + 1e-12)).all()
    for k in range(len(q)):
        force = np.concatenate([soft.direction[k], np.zeros(3)])
        elements = strain_energy(robot, pose[k], force)
        assert elements.elements[soft.element[k]] == elements.dominant or elements.tie
    loaded = found(robot, "strain-energy", q, WRENCH)
    expected = strain_energy(robot, pose, WRENCH)
    np.testing.assert_allclose(loaded.value, expected.total, rtol=1e-9)
    np.testing.assert_allclose(loaded.shares, expected.factors, rtol=1e-9)
    deflected = found(robot, "compliance", q, WRENCH)
    size = np.linalg.norm(compliance(robot, pose)[:, :3] @ np.array(WRENCH), axis=1)
    np.testing.assert_allclose(deflected.value, size, rtol=1e-9)
    lowest = found(robot, "frequency", q[:1])
    np.testing.assert_allclose(lowest.value, natural_frequencies(robot, pose[:1], 1)[:, 0], 1e-9)


@pytest.mark.parametrize("name", partly_long(DRIVEN, "delta", "rps3"))
def test_what_drives_allow_is_brute_force(name, rng):
    robot = load(name)
    q = states(robot, rng, 60)[:4]
    limit, still = robot.limits.effort, np.zeros_like(q[0])

    def used(mass, k):
        loaded = robot.changed(payload={"mass": mass, "inertia": [0.0, 0.0, 0.0]})
        return (np.abs(inverse_dynamics(loaded, q[k], still, still, WRENCH)) / limit).max()

    carried = found(robot, "payload", q, WRENCH)
    for k, value in enumerate(carried.value):
        if value == 0.0:
            assert used(0.0, k) > 1.0
            continue
        most = brentq(lambda mass, k=k: used(mass, k) - 1.0, 0.0, 2.0 * value, xtol=1e-12)
        assert value == pytest.approx(most, rel=1e-9)
    names = [n for n in robot.pose_names if n in "xyz"]
    fast = found(robot, "acceleration", q)
    for k, value in enumerate(fast.value):
        ways = np.vstack([fast.direction[k], directions(rng, 200)])[:, ["xyz".index(n) for n in names]]
        # From the pose's own acceleration, one sample at a time.
        pose = np.zeros((len(ways), len(robot.pose_names)))
        pose[:, [robot.pose_names.index(n) for n in names]] = value * ways
        qdd = np.linalg.solve(robot.jacobian(q[k]), pose.T).T
        share = np.abs(inverse_dynamics(robot, np.tile(q[k], (len(ways), 1)), 0 * qdd, qdd)) / limit
        if value > 0.0:
            assert share[0].max() == pytest.approx(1.0, rel=1e-9)
            assert share[0].argmax() == fast.element[k] or share[0].max() == share[0][fast.element[k]]
            assert share.max() <= 1.0 + 1e-9
        else:
            assert share.max() >= 1.0


def test_errors_of_the_pose_follow_from_those_of_lengths(rng):
    robot = robot_of_data(parameters_of("delta") | {"uncertainty": LENGTHS}, "delta")
    q = states(robot, rng, 20)[:3]
    steps = {"arm_length": 1e-4, "base_radius": 2e-4, "forearm_length": 1e-4 * 0.390}
    total = np.zeros((len(q), 3, 3))
    for key, step in steps.items():
        ends = []
        for sign in (-1e-2, 1e-2):
            value = getattr(robot.geometry, key) + sign * step
            moved = robot.numbered({f"geometry.{key}": value})
            ends.append(moved.platform(q)[0])
        effect = (ends[1] - ends[0]) / 2e-2
        total += effect[:, :, None] * effect[:, None, :]
    error = found(robot, "pose-error", q)
    # Differences of positions of some decimetres over a step of a micrometre.
    np.testing.assert_allclose(error.value**2, np.linalg.norm(total, 2, axis=(1, 2)), rtol=1e-6)
    across = np.einsum("ki,kij,kj->k", error.direction, total, error.direction)
    np.testing.assert_allclose(across, error.value**2, rtol=1e-6)


@pytest.mark.parametrize("cause", ["joints.elbow_left.at[0]", "joints"])
def test_errors_of_places_that_parts_share_are_no_errors_of_the_pose(cause, rng):
    """Home closes whatever they are; the reference point itself is one on the platform."""
    data = parameters_of("five_bar")
    origin = {"origin[0]": {"deviation": 1e-4}, "origin[2]": {"deviation": 1e-4}}
    sure = robot_of_data(data | {"uncertainty": origin}, "origin")
    np.testing.assert_allclose(found(sure, "pose-error", states(sure, rng, 5)).value, 1e-4)
    unsure = robot_of_data(data | {"uncertainty": {**origin, cause: {"relative": 1e-3}}}, "places")
    with pytest.raises(ParameterError) as caught:
        plan_map(unsure, KINDS["pose-error"]())
    assert caught.value.field == f"uncertainty.{cause}"


MAPS = [f"{name} compliance" for name in SHIPPED]
MAPS += [f"{name} {kind}" for name in DRIVEN for kind in ("payload", "acceleration")]
WORST = ("delta compliance", "five_bar acceleration")


@pytest.mark.parametrize("count", often(3000, 100_000))
@pytest.mark.parametrize("what", partly_long(MAPS, *WORST))
def test_no_pose_is_worse_than_the_worst(what, count, rng, tmp_path):
    name, kind = what.split()
    robot = load(name)
    sweep = plan_map(robot, KINDS[kind](), 200)
    with open_map(run(sweep, tmp_path / "a.nc", workers=1)) as data:
        worst, pose = float(data.worst_value[0]), data.worst_pose.values[0]
        stored = np.concatenate([data.value.values.ravel(), data.plane_value.values.ravel()])
        for plane in data.isel(case=0).transpose("plane", ...).plane_value:
            # Every plane goes exactly through the worst pose, and has its value there.
            assert (plane.values == worst).sum() >= 1
        assert (data.through.values == data.worst_pose.values).all()
    q = robot.inverse(pose)
    assert found(robot, kind, q[None]).value[0] == pytest.approx(worst, rel=1e-9)
    assert robot.singularity(q) >= LEAST * (1 - 1e-9)
    low, high = robot.limits.position.T
    assert ((q >= low) & (q <= high)).all()
    tried = found(robot, kind, states(robot, rng, count)).value
    bad = (lambda values: values) if sweep.cases[0].largest else (lambda values: -values)
    assert bad(tried).max() <= bad(worst) + 1e-9 * abs(worst)
    assert np.nanmax(bad(stored)) <= bad(worst) + 1e-9 * abs(worst)


def test_a_stored_map_has_all_cases_and_is_nan_where_no_pose_counts(tmp_path):
    robot = load("five_bar")
    kind = KINDS["strain-energy"]()
    loads = {"push": (50.0, 0.0, 0.0, 0.0, 0.0, 0.0), "lift": (0.0, 0.0, 50.0, 0.0, 0.0, 0.0)}
    cases = [kind.loaded(robot, name, wrench) for name, wrench in loads.items()]
    sweep = plan_map(robot, kind, 400, cases=cases)
    with open_map(run(sweep, tmp_path / "a.nc", workers=1)) as data:
        grid = np.stack(np.meshgrid(data.x, data.z, indexing="ij"), -1)
        inside = reachable(robot, grid)
        inside[inside] = robot.singularity(robot.inverse(grid[inside])) >= LEAST
        assert list(data.case.values) == ["push", "lift"]
        np.testing.assert_array_equal(np.isfinite(data.value.values[..., 0]), inside)
        assert float(data.valid) == pytest.approx(inside.mean())
        mean = np.nanmean(data.factor.values[..., 0, :], (0, 1))
        most = data.element.values[mean.argmax()]
        assert f"workspace: {most} {100 * mean.max():.1f} %" in "\n".join(figures.write_lines(data))
        for k, case in enumerate(cases):
            expected = strain_energy(robot, grid[inside], case.wrench)
            np.testing.assert_allclose(data.value.values[inside, k], expected.total, rtol=1e-9)
            np.testing.assert_allclose(data.factor.values[inside, k], expected.factors, rtol=1e-9)


def test_documented_worst_values():
    page, robot, kind = "docs/maps.md", load("delta"), KINDS["compliance"]()
    (softest,) = numbers(page, r"softest: (\S+) µm/N along")
    sweep = plan_map(robot, kind)
    worst = find_worst(sweep, sweep.cases[0], np.empty((0, 3)))
    assert 1e6 * worst.found.value[0] == pytest.approx(softest, rel=0.01)
    assert worst.bounded and worst.index == pytest.approx(LEAST, rel=1e-3)
    # Also as it is printed.
    printed = numbers(page, r"softest: .*? at \((\S+), (\S+), (\S+)\) m, arm III")
    assert robot.singularity(robot.inverse(printed)) == pytest.approx(LEAST, rel=1e-3)
    pattern = r"push: moves most: (\S+) µm .*? at \((\S+), (\S+), (\S+)\) m, arm I; .*?lift: moves "
    push, x, y, z, lift = numbers(page, pattern + r"most: (\S+) µm")
    q = robot.inverse([[x, y, z]])
    for value, wrench in ((push, (30.0, 0, 0, 0, 0, 0)), (lift, (0, 0, 30.0, 0, 0, 0))):
        moved = evaluate_kind(kind, robot, q, [kind.loaded(robot, "load", wrench)])[0]
        assert 1e6 * moved.value[0] == pytest.approx(value, rel=1e-3)


@pytest.mark.parametrize(("least", "bound"), [(0.05, None), (0.3, 0.3)])
def test_an_answer_on_the_bound_of_the_singularity_index_has_it(least, bound, tmp_path):
    """The five-bar is softest at its nearest pose to a singularity, of index 0.243."""
    sweep = plan_map(load("five_bar"), KINDS["compliance"](), 400, least_singularity=least)
    with open_map(run(sweep, tmp_path / "a.nc", workers=1)) as data:
        (answer,) = figures.list_answers(data)
        (text,) = figures.write_lines(data)
    assert answer["singularity_bound"] == bound
    assert answer["singularity"] == pytest.approx(bound or 0.24345, rel=1e-4)
    assert ("worse poses lie below" in text) == (bound is not None)
    pose = [float(word) for word in text.partition("at (")[2].partition(")")[0].split(",")]
    index = sweep.robot.singularity(sweep.robot.inverse(pose))
    assert index == pytest.approx(answer["singularity"], rel=1e-4)


def test_along_a_path_and_as_numbers(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    points = "time,x,z\n" + "".join(f"{0.01 * k},{0.002 * k},0.36\n" for k in range(20))
    (tmp_path / "path.csv").write_text(points)
    words = ("map", "five_bar", "acceleration", "--along", "path.csv", "--out", "a.csv", "--json")
    done = command(capsys, *words)
    told = json.loads(done.out)
    robot = load("five_bar")
    q = robot.inverse(np.stack([0.002 * np.arange(20), np.full(20, 0.36)], -1))
    least = found(robot, "acceleration", q)
    values = least.value
    assert told["worst"][0]["value"] == pytest.approx(values.min())
    assert told["worst"][0]["time_s"] == pytest.approx(0.01 * values.argmin())
    assert told["worst"][0]["unit"] == "m/s2"
    assert (told["singularity_bound"], told["samples_that_do_not_count"]) == (0.05, 0)
    rows = (tmp_path / "a.csv").read_text().splitlines()
    assert [float(row.split(",")[4]) for row in rows[1:]] == pytest.approx(values.tolist())
    header = rows[0].split(",")
    ways = [header.index(f"direction.{axis}") for axis in "xyz"]
    assert len(set(header)) == len(header)
    table = [[float(row.split(",")[k]) for k in ways] for row in rows[1:]]
    np.testing.assert_allclose(table, least.direction)
    assert (tmp_path / "a.png").stat().st_size
    # What lies below a bound is on the path all the same.
    bound = float(np.median(robot.singularity(q)))
    more = ("--singularity", bound, "--overwrite")
    again = json.loads(command(capsys, *map(str, (*words, *more))).out)
    assert again["worst"] == told["worst"]
    assert again["samples_that_do_not_count"] == np.sum(robot.singularity(q) < bound) > 0


@pytest.mark.parametrize("kind", ["acceleration", "compliance", "strain-energy", "frequency"])
def test_along_a_path_each_sample_has_its_payload_and_wrench(kind, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot, count = load("delta_cu"), 6
    poses = robot.home() + np.linspace([0.0, 0.0, 0.0], [0.05, 0.02, 0.03], count)
    wrench = np.zeros((count, 6))
    wrench[2:, :3] = [30.0, -50.0, 20.0]
    wrench[4:, 3:] = np.random.default_rng(0).normal(size=(2, 3))
    masses = np.array([0.0, 1.5, 1.5, 1.5, 0.4, 0.4])
    table = np.column_stack([0.01 * np.arange(count), poses, wrench, masses])
    header = "time,x,y,z,fx,fy,fz,mx,my,mz,payload.mass"
    np.savetxt("path.csv", table, "%.17g", ",", header=header, comments="")
    words = ("map", "delta_cu", kind, "--along", "path.csv", "--out", "a.csv", "--no-picture")
    told = command(capsys, *words)
    assert told.code == 0, told
    with open("a.csv") as file:
        values = [float(row["value"]) for row in csv.DictReader(file)]
    own = KINDS[kind]()
    for value, pose, load_case, mass in zip(values, poses, wrench, masses, strict=True):
        (case,) = own.cases(robot)
        if own.takes_wrench:
            case = replace(own.loaded(robot, "", [1.0] * 6), wrench=tuple(load_case))
        loaded = robot.changed(payload={"mass": mass})
        expected = evaluate_kind(own, loaded, robot.inverse(pose)[None], [case])[0].value[0]
        assert value == pytest.approx(expected, rel=1e-9, abs=1e-15)
    # A wrench of the command line takes the place of the path's.
    if own.takes_wrench:
        given = (*words[:-1], "--overwrite", "--wrench", "0,0,1,0,0,0", "--no-picture")
        assert "of the path" not in command(capsys, *given).out
        assert "of the path" in told.out


def test_a_pose_in_a_sentence_is_as_commands_read_it():
    answer = {"answer": "softest", "value": 1e-5, "unit": "m/N", "pose": {"x": 0.7235, "b": 0.4552}}
    for units, text in (("mm", "m"), (("m", "rad"), "[m, rad]")):
        answer["pose_units"] = dict(zip("xb", units, strict=True))
        assert figures.write_sentence(answer).endswith(f"(0.7235, 0.4552) {text}")


def test_milling_depths_are_those_of_each_pose(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot, milling = load("upr_rpu"), Milling(2, 600e6, 0.3, 0.5, up=True, feed=np.radians(30.0))
    tool, damping = (0.0, 0.0, -0.1), (0.03, 0.02)
    poses = robot.home() + np.array([[0.0, 0.0, 0.0], [0.01, 0.05, 0.0], [0.02, 0.1, 0.05]])
    header = ",".join(["time", *robot.pose_names])
    rows = [",".join(map(repr, [0.1 * k, *pose.tolist()])) for k, pose in enumerate(poses)]
    (tmp_path / "path.csv").write_text("\n".join([header, *rows]) + "\n")
    done = command(
        capsys,
        "map",
        "upr_rpu",
        "cutting-depth",
        "--teeth",
        "2",
        "--tangential",
        "600e6",
        "--radial",
        "0.3",
        "--immersion",
        "0.5",
        "--up",
        "--feed",
        "30",
        "--tool",
        "0,0,-0.1",
        "--damping",
        "0.03,0.02",
        "--along",
        "path.csv",
        "--out",
        "a.csv",
        "--no-picture",
        "--json",
    )
    told = json.loads(done.out)["worst"][0]
    each = [stable_depth(robot, p, milling, damping=damping, tool=tool) for p in poses]
    assert told["value"] == pytest.approx(min(each)) and told["unit"] == "m"
    assert told["element"].startswith("mode ")
    # A process goes with its map, so that another does not continue it.
    maps = [plan_map(robot, CuttingDepth(each, damping, tool), 60) for each in (milling, Milling(3, 600e6, 0.3, 0.5))]
    assert maps[0].fingerprint != maps[1].fingerprint


def test_a_search_finds_what_is_best_at_the_border(rng):
    """The highest place of a ramp over a disc, also with few looks."""

    class Few(Frequency):
        population, rounds = 8, 30

    best = [
        evolve(
            lambda x: np.where((x**2).sum(1) <= 1.0, x[:, 0] + 0.2 * x[:, 1], -np.inf),
            rng.uniform(-0.7, 0.7, (8, 2)),
            np.full(2, -1.0),
            np.ones(2),
            Few(),
            rng,
            inside,
        )[1]
        for inside in (lambda x: (x**2).sum(1) <= 1.0, None)
    ]
    assert 1.04**0.5 - best[0] < 1e-3 and best[0] > best[1]


@pytest.mark.long
def test_kinds_of_one_machine_agree(rng):
    """No kind's worst pose is worse in another kind than the worst that this one found.

    A planar machine whose workspace ends in several narrow parts near singularities.
    """
    data = plain("rrr3_planar")
    for joint in data["limbs"]["joints"].values():
        if joint.get("actuated"):
            joint["limits"] = {"position": [1.0, 2.8], "velocity": 5.0, "effort": 4.0}
    robot = robot_of_data(data | {"gravity": [-4.7, 5.0, 7.0]}, "planar")
    q = rng.uniform(*robot.limits.position.T, (20_000, 3))
    index = robot.try_singularity(q)[0]
    q = q[(index > LEAST) & (index < 2.0 * LEAST)]
    found = {}
    for kind in (KINDS[name]() for name in ("payload", "acceleration", "speeds")):
        sweep = plan_map(robot, kind)
        found[kind] = sweep.cases[0], find_worst(sweep, sweep.cases[0], np.empty((0, 3)))
    tried = np.vstack([q, *(worst.q for _, worst in found.values())])
    assert len(q) > 20
    for kind, (case, worst) in found.items():
        (other,) = evaluate_kind(kind, robot, tried, [case])
        least = score_values(worst.found.value, case.largest)[0]
        assert (score_values(other.value, case.largest) <= least + 0.01 * abs(least)).all(), kind.name
    payload, acceleration = (found[kind][1].found.value[0] for kind in list(found)[:2])
    assert (payload == 0.0) == (acceleration == 0.0)


@pytest.mark.long
def test_the_lowest_frequency_is_found():
    """The Delta rings lowest where the singularity index is as low as it may be."""
    robot = load("delta")
    sweep = plan_map(robot, Frequency())
    worst = find_worst(sweep, sweep.cases[0], np.empty((0, 3)))
    assert robot.singularity(worst.q) == pytest.approx(LEAST, abs=2e-3)
    # 44.03 Hz by five times the rounds.
    assert worst.found.value[0] < 44.03 * 1.002


def test_ball_joints_swivel_so_far(rng):
    data = parameters_of("stewart")
    joints = data["limbs"]["joints"]
    for name in ("ball_a", "ball_b"):
        joints[name]["limits"] = {"swivel": 0.25}
    joints["foot_a"]["limits"] = {"swivel": 0.2, "axis": [-0.22, -0.11, 0.62]}
    robot = robot_of_data(data, "tight")
    q = states(load("stewart"), rng, 400)[:60]
    angles = passive_values(robot, q)
    names = [limit.joint for limit in robot.passive_limits]
    position, turn = robot.platform(q)
    graph = robot.graph
    for k, name in enumerate(names):
        other = name.replace("ball", "foot") if "ball" in name else name.replace("foot", "ball")
        ball, foot = (name, other) if "ball" in name else (other, name)
        foot, ball = graph.joints[foot].at, graph.joints[ball].at
        leg = position + (ball - graph.origin) @ turn.swapaxes(-1, -2) - foot
        home = np.broadcast_to(ball - foot, leg.shape)
        rest = np.einsum("kij,kj->ki", turn, home) if "ball" in name else home
        cosine = (leg * rest).sum(-1) / np.linalg.norm(leg, axis=-1) / np.linalg.norm(rest, axis=-1)
        np.testing.assert_allclose(angles[:, k], np.arccos(np.minimum(cosine, 1.0)), atol=2e-5)
    bound = np.array([limit.high for limit in robot.passive_limits])
    kept = (angles <= bound).all(-1)
    assert 0 < kept.sum() < len(kept)
    np.testing.assert_array_equal(reachable(robot, robot.forward(q)), kept)
    # And written out.
    again = robot_of_data(robot.parameter_sections(), "again")
    np.testing.assert_allclose(passive_values(again, q), angles, atol=1e-9)


def test_ranges_of_passive_hinges_slides_and_rods(tmp_path):
    data = parameters_of("rps3")
    data["limbs"]["joints"]["hinge"]["limits"] = {"position": [-0.1, 0.1]}
    robot = robot_of_data(data, "tight")
    q = robot.graph.home + np.array([[0.05, 0.0, 0.0], [0.0, -0.04, 0.03]])
    turned = robot.passive(q)[:, [robot.passive_joints.index(f"hinge_{k}") for k in (1, 2, 3)]]
    np.testing.assert_allclose(passive_values(robot, q), turned, atol=1e-12)
    data = parameters_of("linear_delta")
    data["limbs"]["rods"]["left"]["swivel"] = 0.3
    robot = robot_of_data(data, "tight")
    q = np.array([0.31, 0.27, 0.35])
    leaned = passive_values(robot, q)
    rod = robot.graph.rods["left_1"]
    now = rod.ends[1] - rod.ends[0] + robot.platform(q)[0] - robot.graph.origin - [0, 0, q[0] - 0.3]
    home = rod.ends[1] - rod.ends[0]
    angle = np.arccos(now @ home / np.linalg.norm(now) / np.linalg.norm(home))
    np.testing.assert_allclose(leaned[:2], angle, atol=1e-9)
    with pytest.raises(ParameterError, match="swivel"):
        data["limbs"]["joints"]["rail"]["limits"]["swivel"] = 0.3
        robot_of_data(data, "wrong")


@pytest.mark.parametrize(
    ("kind", "changes", "field"),
    [
        ("payload", {"limits": {"position": [-0.9, 1.3]}}, "limits.effort"),
        ("compliance", {"members": None}, "members"),
        ("pose-error", {}, "uncertainty"),
        ("pose-error", {"uncertainty": {"members.arm.density": {"relative": 0.1}}}, "uncertainty"),
    ],
)
def test_what_a_file_lacks_is_named(kind, changes, field):
    data = {k: v for k, v in (parameters_of("delta") | changes).items() if v is not None}
    with pytest.raises(ParameterError) as caught:
        plan_map(robot_of_data(data, "delta"), KINDS[kind]())
    assert caught.value.field == field


def test_tolerances_without_an_uncertainty_are_another_command_s():
    tolerances = {"bodies.arm.length": {"deviation": 1e-4}}
    robot = robot_of_data(parameters_of("delta") | {"tolerances": tolerances}, "delta")
    with pytest.raises(ParameterError, match="design --tolerance file"):
        plan_map(robot, KINDS["pose-error"]())


def test_angular_acceleration_of_a_wrist(rng):
    """A pose of angles alone: every direction of the angular acceleration, base axes."""
    data = read_yaml(FILES["rrr3_spherical"])
    data["limbs"]["joints"]["motor"]["limits"] = {"position": [-1, 1], "effort": 5.0}
    robot = robot_of_data(data, "wrist")
    q = robot.graph.home + 0.1 * rng.normal(size=(3, 3))
    fast = found(robot, "acceleration", q)
    for k, value in enumerate(fast.value):
        ways = np.vstack([fast.direction[k], directions(rng, 100)])
        qdd = np.linalg.solve(robot.platform_jacobian(q[k])[3:], value * ways.T).T
        share = np.abs(inverse_dynamics(robot, np.tile(q[k], (101, 1)), 0 * qdd, qdd))
        assert (share / robot.limits.effort).max() == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("name", partly_long(DRIVEN, "delta", "rps3"))
def test_speeds_are_brute_force(name, rng):
    """At the speed found the first drive is at its limit, in no direction before."""
    robot = load(name)
    if robot.limits.velocity is None:
        pytest.skip("no velocity limits")
    q = states(robot, rng, 60)[:4]
    places = [k for k, n in enumerate(robot.pose_names) if n in "xyz"]
    fast = found(robot, "speeds", q)
    for k, value in enumerate(fast.value):
        ways = np.vstack([fast.direction[k], directions(rng, 200)])
        rates = np.zeros((len(ways), len(robot.pose_names)))
        rates[:, places] = value * ways[:, ["xyz".index(robot.pose_names[p]) for p in places]]
        share = np.abs(np.linalg.solve(robot.jacobian(q[k]), rates.T).T) / robot.limits.velocity
        assert share[0].max() == pytest.approx(1.0, rel=1e-9)
        assert share[0][fast.element[k]] == pytest.approx(1.0, rel=1e-9)
        assert share.max() <= 1.0 + 1e-9


@pytest.mark.parametrize("name", partly_long(["prru", "delta_cu", "five_bar"], "delta_cu"))
def test_isotropy_is_that_of_directions(name, rng):
    """The extremes over directions hold all samples, and are attained in the direction found."""
    robot = load(name)
    q = states(robot, rng, 60)[:3]
    kind = KINDS["isotropy"]()
    energy, force = evaluate_kind(kind, robot, q, kind.cases(robot))
    ways = rng.normal(size=(300, len(robot.pose_names)))
    for k, pose in enumerate(robot.forward(q)):
        assert energy_transfer(robot, pose, energy.direction[k]) == pytest.approx(energy.value[k])
        assert (energy_transfer(robot, pose, ways) >= energy.value[k] * (1 - 1e-9)).all()
        assert max_driving_force(robot, pose, force.direction[k]) == pytest.approx(force.value[k])
        assert (max_driving_force(robot, pose, ways) <= force.value[k] * (1 + 1e-9)).all()


@pytest.mark.parametrize("name", partly_long(["stewart", "five_bar", "delta"], "stewart"))
def test_a_workspace_in_which_nothing_counts_names_the_cause(name):
    robot = load(name)
    sweep = plan_map(robot, KINDS["compliance"](), 60, least_singularity=0.999)
    with pytest.raises(ParameterError, match=r"no pose has a singularity index of 0\.999 or more"):
        find_worst(sweep, sweep.cases[0], np.empty((0, len(robot.pose_names))))


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (7.276, "kg", "7.276 kg"),
        (7276.0, "kg", "7.276 t"),
        (0.0123, "kg", "12.3 g"),
        (3.277e-5, "m/N", "32.77 µm/N"),
        (2.5e-4, "m", "250 µm"),
        (1234.0, "m/s2", "1234 m/s2"),
        (1.23e4, "J", "12.3 kJ"),
        (0.5, "rad", "0.5 rad"),
        (12.0, "rad/s2", "12 rad/s2"),
        (0.05, "", "0.05"),
        (4.4e4, "Hz", "44 kHz"),
        (0.0, "N m", "0 N m"),
    ],
)
def test_units_have_prefixes_that_exist(value, unit, text):
    assert format_value(value, unit) == text
