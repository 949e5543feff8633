# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Errors of parts: each is an added drive of the same machine, in maximal coordinates."""

from __future__ import annotations

import copy
import itertools

import numpy as np
import pytest

from pkm_twin import variants
from pkm_twin.certify.description import make_perpendicular_axes
from pkm_twin.certify.maximal import Maximal, rotation_of
from pkm_twin.design import drawn, tolerances
from pkm_twin.design.parts import Assembly, find_part
from pkm_twin.design.tolerance import rms_length, workspace_states
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.identification.calibration import calibrate, left_by_calibration, list_geometric_paths
from pkm_twin.identification.calibration_state import Poses
from pkm_twin.machine.uncertainty import Tolerance
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.numbers import FileNumbers
from stiffness_monitor import platform_response
from test.machine.random_machines import NAMES, variant
from test.machine.test_helical import driven, slide
from test.machine.test_planar import puck
from test.support.robots import load, parameters_of, partly_long, without

PATHS = 6
"""Errors of a machine that are tried, of all that it may have."""
CARRIER = {"mass": 0.0, "com": [0.0, 0.0, 0.0], "inertia": [0.0, 0.0, 0.0]}


def paths_of(data):
    """Every error that a part of a machine may have, by kind."""
    for name, joint in data["joints"].items():
        if "at" in joint:
            yield from (f"joints.{name}.at[{k}]" for k in range(3))
        if ("axis" in joint or "axes" in joint) and "at" in joint:
            yield from (f"joints.{name}.axis[{k}]" for k in range(2))
        if joint.get("actuated"):
            yield f"joints.{name}.offset"
    yield from (f"rods.{name}.length" for name in data["rods"])
    yield from (f"bodies.{name}.length" for name in data["bodies"])


def towards(data, body):
    """The joints of a body that are nearest to the base."""
    far = {"base": 0}
    for steps in range(len(data["bodies"])):
        for joint in data["joints"].values():
            ends = joint["between"]
            for one, other in (ends, ends[::-1]):
                if far.get(one) == steps:
                    far.setdefault(other, steps + 1)
    return [
        name
        for name, joint in data["joints"].items()
        if body in joint["between"] and min(map(far.get, joint["between"])) < far[body]
    ]


def with_drives(data, path):
    """The same machine with drives that make a part's error; they stand at zero, added last.

    None of a body without one joint that has a place towards the base, or without length.
    """
    made = copy.deepcopy(data)
    kind, name, what = path.split(".")
    entry = made[kind][name]
    count = len(made["joints"])

    def drive(body, type_, at, axis):
        """A carrier on a body, that a drive moves."""
        new = f"carrier {len(made['joints'])}"
        made["bodies"][new] = CARRIER
        made["joints"][f"error {len(made['joints']) - count}"] = {
            "type": type_,
            "between": [body, new],
            "at": list(at),
            "axis": list(axis),
            "actuated": True,
        }
        return new

    if what == "offset":
        return made
    if kind == "joints":
        inner, k = entry["between"][0], int(what[-2])
        if what.startswith("at"):
            carrier = drive(inner, "prismatic", entry["at"], np.eye(3)[k])
        else:
            first = np.array(entry["axis"] if "axis" in entry else entry["axes"][0], float)
            axis = first / np.linalg.norm(first)
            least = np.eye(3)[int(np.argmin(np.round(np.abs(axis), 9)))]
            one = np.cross(axis, least) / np.linalg.norm(np.cross(axis, least))
            carrier = drive(inner, "revolute", entry["at"], (one, np.cross(axis, one))[k])
        entry["between"] = [carrier, entry["between"][1]]
    elif kind == "rods":
        a, b = np.array(entry["ends"], float)
        del made["rods"][name]
        along = (b - a) / np.linalg.norm(b - a)
        made["bodies"]["half"] = CARRIER
        carrier = drive("half", "prismatic", a, along)
        inner, outer = entry["between"]
        made["joints"]["rod foot"] = {
            "type": "universal",
            "between": [inner, "half"],
            "at": a,
            "axes": make_perpendicular_axes(along),
        }
        made["joints"]["rod head"] = {"type": "spherical", "between": [carrier, outer], "at": b}
    else:
        start, *others = towards(data, name)
        points = [j["at"] for n, j in data["joints"].items() if name in j["between"] and n != start]
        for rod in data["rods"].values():
            points += [e for e, on in zip(rod["ends"], rod["between"], strict=True) if on == name]
        points += [data["origin"]] if data["platform"] == name else []
        line = np.mean(points, 0) - data["joints"][start].get("at", np.mean(points, 0))
        own = [joint for joint in data["joints"].values() if name in joint["between"]]
        if len(points) == len(own) - 1 and all(joint["type"] == "revolute" for joint in own):
            axes = [np.array(j["axis"], float) / np.linalg.norm(j["axis"]) for j in own]
            flat = line - axes[0] * (axes[0] @ line)
            if all(np.linalg.norm(np.cross(axis, axes[0])) < 1e-9 for axis in axes):
                # Of a planar chain the line lies in the plane.
                line = flat if np.linalg.norm(flat) > 1e-9 else line
        if others or np.linalg.norm(line) < 1e-9:
            return None
        for other, joint in list(made["joints"].items()):
            if name in joint["between"] and other != start:
                carrier = drive(name, "prismatic", joint["at"], line)
                joint["between"] = [carrier if n == name else n for n in joint["between"]]
        for rod in made["rods"].values():
            for k in range(2):
                if rod["between"][k] == name:
                    rod["between"] = list(rod["between"])
                    rod["between"][k] = drive(name, "prismatic", rod["ends"][k], line)
        if data["platform"] == name:
            made["platform"] = drive(name, "prismatic", data["origin"], line)
    return made


def judged(data, path, q):
    """A machine with drives that make an error, the state q, and which of its drives move."""
    if path.endswith("offset"):
        actuated = [name for name, joint in data["joints"].items() if joint.get("actuated")]
        return Maximal(data), q, np.array([path.split(".")[1] == name for name in actuated], float)
    judge = Maximal(with_drives(data, path))
    state = np.append(q, np.zeros(len(judge.machine.actuated) - len(q)))
    return judge, state, np.arange(len(state)) >= len(q)


def slope_of(data, path, q):
    """Twist of the platform per unit of the error; None where rigid parts do not fit."""
    judge, state, way = judged(data, path, q)
    judge.assemble(state)
    closures = judge.closures().columns
    table = np.vstack([closures, judge.drives().columns])
    goal = np.append(np.zeros(len(closures)), way)
    found = np.linalg.lstsq(table, goal, rcond=1e-9)[0]
    return judge.twist_columns() @ found if np.abs(table @ found - goal).max() < 1e-7 else None


def states_of(robot, rng, count):
    """Joint states near home."""
    units = np.array([robot.graph.size if u == "m" else 1.0 for u in robot.joint_units])
    return robot.graph.home + 0.05 * units * rng.uniform(-1.0, 1.0, (count, robot.joints_count))


@pytest.mark.parametrize("name", partly_long(NAMES, "rsur"))
def test_an_error_of_a_part_is_a_drive_that_makes_it(name, rng):
    data = variant(name, rng)
    data.setdefault("platform", "platform")
    data.setdefault("origin", data["bodies"][data["platform"]]["com"])
    for k, joint in enumerate(data["joints"].values()):
        if not joint.get("actuated") and k % 2:
            # The same joint, seen from its other body.
            joint["between"] = joint["between"][::-1]
            if "home" in joint:
                joint["home"] *= -1.0
            if "axes" in joint:
                joint["axes"] = joint["axes"][::-1]
    robot = robot_of_data(data, name)
    q, fitting = states_of(robot, rng, 2), 0
    paths = rng.permutation(list(paths_of(data))).tolist()
    lengths = [path for path in paths if path.endswith("length")]
    zeros = [path for path in paths if path.endswith("offset")]
    for path in dict.fromkeys([*paths[:PATHS], *lengths[:5], zeros[0]]):
        made = with_drives(data, path)
        expected = [None if made is None else slope_of(data, path, one) for one in q]
        if any(row is None for row in expected):
            with pytest.raises(ParameterError):
                tolerances(robot, {path: 1e-4}, q)
            continue
        fitting += 1
        found = tolerances(robot, {path: 1e-4}, q).sensitivity[path]
        scale = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * scale, err_msg=path)
        exact = Assembly(robot, q[0]).solve_displacements(
            {what: 3e-3 * vector[None] for what, vector in find_part(robot, path).effects.items()}
        )[0]
        judge, state, way = judged(data, path, q[0])
        place, turn = judge.platform(state + 3e-3 * way)
        before, from_ = judge.platform(state)
        np.testing.assert_allclose(exact[:3], place - before, atol=1e-9)
        np.testing.assert_allclose(rotation_of(exact[3:]), turn @ from_.T, atol=1e-9)
    assert fitting


@pytest.mark.parametrize("name", partly_long(["linear_delta", "stewart", "five_bar"], "stewart"))
def test_copies_of_a_limb_vary_alike(name, rng):
    """An error of all copies is the sum of their own, each in its copy's axes."""
    robot = load(name)
    q = states_of(robot, rng, 3)
    for (kind, entry), source in robot.sources.items():
        if source.path[0] != "limbs" or source.copy:
            continue
        copies = [n for (k, n), s in robot.sources.items() if s.path == source.path and k == kind]
        azimuths = [robot.sources[kind, n].azimuth for n in copies]
        shared = ".".join(map(str, source.path))
        if kind == "joints" and entry not in robot.without_point:
            alike = tolerances(robot, {f"{shared}.at[0]": 1e-4}, q).sensitivity[f"{shared}.at[0]"]
            total = np.zeros_like(alike)
            for copy_, azimuth in zip(copies, azimuths, strict=True):
                own = [f"joints.{copy_}.at[{k}]" for k in range(2)]
                found = tolerances(robot, dict.fromkeys(own, 1e-4), q).sensitivity
                total += np.cos(azimuth) * found[own[0]] + np.sin(azimuth) * found[own[1]]
        elif kind == "rods":
            own = [f"rods.{copy_}.length" for copy_ in copies]
            alike = tolerances(robot, {f"{shared}.length": 1e-4}, q).sensitivity[f"{shared}.length"]
            total = sum(tolerances(robot, dict.fromkeys(own, 1e-4), q).sensitivity.values())
        else:
            continue
        np.testing.assert_allclose(alike, total, rtol=0, atol=1e-9 * max(1.0, abs(total).max()))


def test_a_body_of_a_planar_chain_is_longer_in_its_plane():
    """Though its joints lie in several planes."""
    robot = load("examples/machines/rrr3_planar.yaml")
    q = robot.graph.home
    motor, elbow = (robot.graph.joints[f"{one}_1"].at[:2] for one in ("motor", "elbow"))
    way = (elbow - motor) / np.linalg.norm(elbow - motor)
    paths = ["bodies.crank_1.length", "limbs.bodies.crank.length"]
    paths += [f"joints.elbow_1.at[{k}]" for k in range(2)]
    own, alike, x, y = tolerances(robot, dict.fromkeys(paths, 1e-4), q).sensitivity.values()
    np.testing.assert_allclose(own, way[0] * x + way[1] * y, rtol=0, atol=1e-8)
    np.testing.assert_allclose(alike[..., [2, 3, 4]], 0.0, atol=1e-9)


def test_drawn_machines_have_the_standard_deviations():
    robot = load("linear_delta")
    sigma = {
        "rods.left_1.length": 4e-5,
        "limbs.rods.right.length": 2e-5,
        "joints.rail_2.offset": 3e-5,
        "joints.rail_3.axis[0]": 1e-4,
        "joints.rail_3.at[1]": 5e-5,
    }
    q = robot.graph.home + np.array([[0.0, 0.0, 0.0], [0.03, -0.05, 0.02]])
    found, errors = tolerances(robot, sigma, q), drawn(robot, sigma, q, 4000)
    np.testing.assert_allclose(np.sqrt((errors**2).mean(0)), found.deviation, rtol=0.05)
    np.testing.assert_allclose(sum(found.share.values()), 1.0)
    again = drawn(robot, sigma, q, 50)
    small = drawn(robot, {path: 0.1 * value for path, value in sigma.items()}, q, 50)
    # Beyond the first order there is little, and it falls with the square.
    np.testing.assert_allclose(again, 10.0 * small, atol=5e-3 * abs(again).max())


def test_drawn_machines_may_have_errors_of_parts_and_of_numbers():
    robot = load("delta")
    sigma = {
        "geometry.arm_length": 2e-6,
        "joints.arm_1.axis[0]": 1e-5,
        "geometry.base_radius": 1e-6,
        "bodies.arm II.length": 3e-6,
    }
    q = robot.graph.home + np.array([[0.0, 0.0, 0.0], [0.1, -0.2, 0.3]])
    found, rng = tolerances(robot, sigma, q), np.random.default_rng(0)
    first = sum(rng.normal(size=5)[:, None, None] * found.part(path) for path in sigma)
    np.testing.assert_allclose(drawn(robot, sigma, q, 5), first, atol=1e-3 * abs(first).max())


def pick_and_place_delta():
    """A Delta of base 0.2, arm 0.35, forearm 0.8 and platform 0.045 m, arms level at home."""
    rods = {
        side: {
            "between": ["arm", "platform"],
            "mass": 0.1,
            "ends": [[0.55, y, 0.0], [0.045, y, -((0.8**2 - 0.505**2) ** 0.5)]],
        }
        for side, y in (("left", 0.05), ("right", -0.05))
    }
    inertia = {"mass": 0.5, "inertia": [1e-3, 1e-3, 1e-3]}
    motor = {
        "type": "revolute",
        "between": ["base", "arm"],
        "at": [0.2, 0.0, 0.0],
        "axis": [0.0, 1.0, 0.0],
        "actuated": True,
        "limits": {"position": [-0.9, 1.5]},
    }
    origin = [0.0, 0.0, rods["left"]["ends"][1][2]]
    return robot_of_data(
        {
            "mechanism": "machine",
            "platform": "platform",
            "origin": origin,
            "pose": ["x", "y", "z"],
            "bodies": {"platform": {**inertia, "com": origin}},
            "limbs": {
                "azimuths": [0.0, 2.0943951, 4.1887902],
                "rods": rods,
                "joints": {"motor": motor},
                "bodies": {"arm": {**inertia, "com": [0.34, 0.0, 0.0]}},
            },
        },
        "picker",
    )


def test_one_longer_arm_and_all_arms_alike_or_by_themselves():
    """0.072 mm by one arm that is 0.1 mm longer; on a cycle 0.043 mm alike, 0.068 mm each."""
    robot = pick_and_place_delta()
    one = tolerances(robot, {"bodies.arm_1.length": 1e-4}, robot.graph.home)
    assert np.linalg.norm(one.deviation[:3]) == pytest.approx(7.2e-5, abs=5e-7)
    across = -0.1525 * np.cos(np.linspace(0.0, np.pi, 101))
    up = np.minimum(0.025, 0.1525 - np.abs(across))
    q = robot.inverse(np.stack([across, 0.0 * across, up - 0.755], -1))
    alike, each = (
        rms_length(tolerances(robot, {path: 1e-4}, q).deviation[:, :3])
        for path in ("limbs.bodies.arm.length", "bodies.arm_*.length")
    )
    assert alike == pytest.approx(4.3e-5, rel=0.02) and each == pytest.approx(6.8e-5, rel=0.02)


def test_the_farthest_platform_is_that_of_one_combination_of_signs():
    """All 64 machines of six rods, assembled exactly; a clearance has no finite number of them."""
    robot, rods = pick_and_place_delta(), {"rods.*.length": Tolerance(bound=3e-5)}
    for q in robot.graph.home + np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.4]]):
        found = tolerances(robot, rods, q)
        effects = {}
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=6)))
        for path, column in zip(found.sigma, signs.T, strict=True):
            for what, vector in find_part(robot, path).effects.items():
                effects[what] = effects.get(what, 0.0) + 3e-5 * column[:, None] * vector
        errors = Assembly(robot, q).solve_displacements(effects).reshape(64, 2, 3)
        assert found.is_exact
        assert found.farthest == pytest.approx(np.linalg.norm(errors, axis=-1).max(0), rel=2e-3)
        more = tolerances(robot, rods | {"joints.motor_3.clearance": Tolerance(bound=1e-9)}, q)
        assert not more.is_exact and (more.farthest >= found.farthest).all()
        assert (more.farthest <= 1.0001 * np.linalg.norm(found.worst.reshape(2, 3), axis=1)).all()


def test_bounds_hold_for_machines_that_are_drawn_within_them():
    """Uniform errors, a backlash and a clearance: their spread, and the worst of all signs."""
    robot = pick_and_place_delta()
    sigma = {
        "rods.*.length": Tolerance(bound=3e-5),
        "rods.left_1.length": 1e-5,
        "joints.motor_2.backlash": Tolerance(bound=2e-4),
        "joints.motor_3.clearance": Tolerance(bound=4e-5),
    }
    q = robot.graph.home + np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.4]])
    found, errors = tolerances(robot, sigma, q), drawn(robot, sigma, q, 4000)
    assert len(found.sigma) == 6 + 1 + 3 and len(found.together) == 8
    assert found.sigma["rods.left_1.length"] == 1e-5
    assert found.bounds["rods.left_1.length"] == pytest.approx(3e-5)
    np.testing.assert_allclose(np.sqrt((errors**2).mean(0)), found.deviation, rtol=0.05)
    bounded = {path: one for path, one in sigma.items() if isinstance(one, Tolerance)}
    found, errors = tolerances(robot, bounded, q), drawn(robot, bounded, q, 4000)
    assert (np.abs(errors) <= 1.001 * found.worst).all()
    assert (np.abs(errors).max(0) > 0.6 * found.worst).all()
    # The worst of x: every error at its bound, with the sign that adds to it.
    for state, worst in zip(q, found.worst, strict=True):
        there = tolerances(robot, bounded, state).sensitivity
        effects = {}
        for paths in found.together.values():
            slopes = np.array([there[path][0] for path in paths])
            size = found.bounds[paths[0]] * slopes / np.linalg.norm(slopes)
            for path, value in zip(paths, size, strict=True):
                for what, vector in find_part(robot, path).effects.items():
                    effects[what] = effects.get(what, 0.0) + value * vector[None]
        exact = Assembly(robot, state).solve_displacements(effects)[0]
        assert exact[0] == pytest.approx(worst[0], rel=2e-3)
    # A play is the whole of it: parts stand half of it away at most.
    for play, part in (("backlash", "offset"), ("clearance[1]", "at[1]")):
        one, other = (f"joints.motor_1.{name}" for name in (play, part))
        each = tolerances(robot, {one: Tolerance(bound=1e-4), other: 1e-5}, q)
        np.testing.assert_allclose(each.sensitivity[one], each.sensitivity[other], atol=1e-12)
        assert each.bounds[one] == 5e-5 and each.sigma[one] == pytest.approx(1e-4 * 12**-0.5)
    for path, size in (
        ("joints.motor_1.backlash", 1e-4),
        ("joints.motor_1.clearance", 1e-4),
        ("joints.none*.offset", Tolerance(bound=1e-4)),
    ):
        with pytest.raises(ParameterError):
            tolerances(robot, {path: size}, q)


def test_what_a_calibration_leaves_is_what_it_leaves():
    """Poses of a machine with one longer arm, whose file has one length for all of them."""
    robot, path, error = load("delta"), "bodies.arm I.length", 1e-4
    q = workspace_states(robot, 60)
    effects = find_part(robot, path).effects
    moved = Assembly(robot, q).solve_displacements({k: error * v[None] for k, v in effects.items()})[0]
    place, turn = robot.platform(q)
    found = calibrate(robot, Poses(q, place + moved[:, :3], turn), list_geometric_paths(robot, q))
    there, _ = found.robot.platform(found.joint_map.positions(q))
    left = left_by_calibration(
        robot,
        lambda s: error * tolerances(robot, {path: error}, s).sensitivity[path][..., None],
        q,
        q,
    )
    assert rms_length(left[:, :3, 0]) == pytest.approx(rms_length(place + moved[:, :3] - there), rel=0.03)
    assert rms_length(left[:, :3, 0]) < 0.9 * rms_length(moved[:, :3])


def test_numbers_of_a_file_without_parts_vary_as_the_file_says():
    robot = load("delta_cu")
    sigma = {
        "geometry.arm_length": 2e-5,
        "geometry.base_radius": 1e-5,
        "geometry.platform_radius": 3e-5,
    }
    q = workspace_states(robot, 20)
    found, errors = tolerances(robot, sigma, q), drawn(robot, sigma, q, 4000)
    np.testing.assert_allclose(np.sqrt((errors[..., :3] ** 2).mean(0)), found.deviation[:, :3], rtol=0.06)
    arms = [f"bodies.arm {n}.length" for n in ("I", "II", "III")]
    each = tolerances(robot, dict.fromkeys(arms, 2e-5), q).sensitivity
    np.testing.assert_allclose(sum(each.values()), found.sensitivity["geometry.arm_length"], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("five_bar", "joints.elbow_left.at[1]"),
        ("five_bar", "joints.tip.axis[0]"),
        ("five_bar", "joints.elbow_left.offset"),
        ("five_bar", "joints.elbow_left.at[3]"),
        ("five_bar", "joints.elbow.at[0]"),
        ("five_bar", "bodies.forearm_left.mass"),
        ("five_bar", "bodies.base.length"),
        ("stewart", "bodies.platform.length"),
        ("stewart", "joints.ball_a_1.axis[0]"),
        ("stewart", "payload.mass"),
        ("delta", "joints.translation.at[0]"),
        ("delta", "inertia.arm_mass"),
        ("delta", "geometry.arm"),
    ],
)
def test_what_is_no_part_or_does_not_fit_is_rejected(name, path):
    robot = load(name)
    with pytest.raises(ParameterError, match=path.split(".")[0]):
        tolerances(robot, {path: 1e-4}, robot.graph.home)
    with pytest.raises(ParameterError):
        tolerances(robot, {"joints.left.offset": -1e-4}, robot.graph.home)


@pytest.mark.parametrize("sigma", ["a", None, True, [1e-4], np.nan, -1e-4, 0.1, 1e300])
@pytest.mark.parametrize("path", ["joints.left.offset", "bodies.arm_left.length"])
def test_a_size_that_no_part_s_error_has_is_rejected(path, sigma):
    robot = load("five_bar")
    with pytest.raises(ParameterError) as caught:
        tolerances(robot, {path: sigma}, robot.graph.home)
    assert path in caught.value.field
    if sigma == 0.1:
        assert str(caught.value).endswith("rad" if "offset" in path else "m")
    assert tolerances(robot, {path: 1e-4}, np.zeros((0, 2))).deviation.shape == (0, 6)


def test_the_first_wrong_word_of_a_path_is_named():
    robot = load("linear_delta")
    for path, word, near in (
        ("rods.left_1.lenght", "lenght", "length"),
        ("rods.leftt_1.length", "leftt_1", "left_1"),
        ("limbs.joints.rial.at[0]", "rial", "rail"),
        ("limbs[0].rods.left.length", 0, None),
        ("joints.rail_1.at[3]", 3, None),
    ):
        with pytest.raises(UnknownNameError) as caught:
            tolerances(robot, {path: 1e-4}, robot.graph.home)
        assert (caught.value.value, caught.value.closest) == (word, near)
    for path in ("", 5, "joints.rail_1.at", "rods.left_1.length[0]"):
        with pytest.raises(ParameterError):
            tolerances(robot, {path: 1e-4}, robot.graph.home)


def test_a_path_s_end_alone_names_the_whole_paths():
    for name, path, near in (
        ("linear_delta", "left_1", "rods.left_1.length"),
        ("linear_delta", "left_1.length", "rods.left_1.length"),
        ("delta", "arm_length", "geometry.arm_length"),
    ):
        with pytest.raises(ParameterError, match=f"mean '{near}'"):
            tolerances(load(name), {path: 1e-4}, np.zeros((0, 3)))


def test_a_wrench_adds_the_deflection_of_the_machine_itself():
    robot, load_on = load("delta"), [0.0, 0.0, -100.0, 0.0, 0.0, 0.0]
    q = robot.graph.home
    found = tolerances(robot, {"joints.arm_1.offset": 1e-5}, q, load_on)
    expected = platform_response(robot, q, load_on).deflection
    np.testing.assert_array_equal(found.deflection, expected)
    assert tolerances(robot, {"joints.arm_1.offset": 1e-5}, q).deflection is None


def test_parallelograms_are_their_two_rods():
    """A tilted arm turns the platform, which the file's machine itself cannot."""
    robot = load("delta")
    graph = robot.graph
    data = {
        "mechanism": "machine",
        "platform": graph.platform,
        "origin": graph.origin.tolist(),
        "pose": ["x", "y", "z"],
        "bodies": {n: CARRIER | {"mass": 1.0, "inertia": [0.01] * 3} for n in graph.bodies},
        "joints": {
            name: {
                "type": joint.kind,
                "between": [joint.inner, joint.outer],
                "at": joint.at.tolist(),
                "axis": joint.axes[0].tolist(),
                "actuated": True,
                "home": joint.home,
            }
            for name, joint in graph.joints.items()
            if joint.actuated
        },
        "rods": {
            f"{name} {side}": {
                "between": [rod.inner, rod.outer],
                "mass": 0.1,
                "ends": (rod.ends + side * 0.5 * rod.width * rod.pair).tolist(),
            }
            for name, rod in graph.rods.items()
            for side in (-1, 1)
        },
    }
    other = robot_of_data(data, "rods")
    q = graph.home + np.array([0.1, -0.2, 0.05])
    same = [f"joints.arm_2.{what}" for what in ("at[0]", "at[1]", "axis[0]", "axis[1]", "offset")]
    one = tolerances(robot, dict.fromkeys([*same, "rods.forearm I.length"], 1e-4), q).sensitivity
    pair = ["rods.forearm I -1.length", "rods.forearm I 1.length"]
    two = tolerances(other, dict.fromkeys([*same, *pair], 1e-4), q).sensitivity
    for path in same:
        np.testing.assert_allclose(one[path], two[path], rtol=0, atol=1e-9)
    np.testing.assert_allclose(one["rods.forearm I.length"], two[pair[0]] + two[pair[1]], rtol=0, atol=1e-9)
    assert np.abs(one["joints.arm_2.axis[1]"][3:]).max() > 0.1


def test_a_zero_moves_the_platform_as_the_drive_does():
    """Of screws over several turns too, and of a table."""
    for robot, turns in ((slide(0.008), 7.0), (driven(-0.005, [0.0, 0.1, 0.0]), 3.0), (puck(1), 0)):
        q = robot.graph.home + 0.05 + 2.0 * np.pi * turns
        columns = robot.platform_jacobian(q)
        for k, name in enumerate(robot.joint_names):
            path = f"joints.{name}.offset"
            found = tolerances(robot, {path: 1e-4}, q).sensitivity[path]
            np.testing.assert_allclose(found, columns[:, k], rtol=0, atol=1e-9)
            exact = drawn(robot, {path: 1e-4}, q, 3)[:, 0]
            assert np.abs(exact).max() > 0.0
            np.testing.assert_allclose(
                exact / exact[:, [np.abs(exact).max(0).argmax()]],
                np.tile(found / found[np.abs(exact).max(0).argmax()], (3, 1)),
                atol=1e-3,
            )


def test_a_platform_that_only_turns_has_shares_of_its_rotation():
    robot = load("examples/machines/agile_eye.yaml")
    sigma = {f"joints.motor_{k}.offset": k * 1e-4 for k in (1, 2, 3)}
    found = tolerances(robot, sigma, robot.inverse([[0.1, -0.2, 0.0], [0.0, 0.1, 0.3]]))
    own = {path: (found.part(path)[:, 3:] ** 2).sum() for path in sigma}
    assert found.only_turns
    for path, share in found.variance.items():
        assert share == pytest.approx(own[path] / sum(own.values()), rel=1e-9)


@pytest.mark.parametrize("name", ["delta", "delta_cu", "prru", "upr_rpu", "linear_delta"])
def test_every_number_of_a_file_with_a_drive_is_a_variable(name):
    """The drive has the rotor: the number in its place is none that errors are taken of."""
    data = without(parameters_of(name), "rotor_inertia", "drive")
    slides = load(name).joint_units[0] == "m"
    drive = {"inertia": 5e-6, **({"lead": 0.01} if slides else {"ratio": 7.0})}
    if data["mechanism"] == "machine":
        joints = {**data.get("joints", {}), **data["limbs"]["joints"]}
        for joint in joints.values():
            joint |= {"drive": drive} if joint.get("actuated") else {}
    else:
        data["drive"] = drive
    robot = robot_of_data(data, name)
    paths = list(robot.file_numbers())
    assert "inertia.rotor_inertia" not in paths
    assert np.isfinite(FileNumbers(robot, paths, lambda made: made.graph.numbers).slopes).all()
    if "drive" in data:
        with pytest.raises(ParameterError, match=r"inertia\.rotor_inertia") as error:
            variants(robot, {"inertia.rotor_inertia": np.array([0.1, 0.2])})
        assert isinstance(error.value.value, float)
    part = f"joints.{robot.joint_names[0]}.offset"
    assert tolerances(robot, {part: 1e-5}, robot.graph.home).deviation.any()
