# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Every function of numbers takes real ones in any layout, and refuses all else by a ValueError."""

from __future__ import annotations

import dataclasses
import inspect
import json
from decimal import Decimal

import numpy as np
import pytest

import delta_dynamics as dynamics
import stiffness_monitor as elasticity
from pkm_twin.codegen.arrays import check_later, doubles
from pkm_twin.errors import ParameterError, SingularityError, UnreachableError
from pkm_twin.mechanisms.catalogue import robot_of_data
from stiffness_monitor.compliance import member_deflections
from stiffness_monitor.modes import modes, natural_frequencies
from test.support.robots import both_ways, load, massless, often, partly_long

ROBOTS = ("delta_cu", "upr_rpu")
"""With elastic members: as a frame, and in closed form."""
FAR = {"delta_cu": [-2.8, 0.8, -1.4], "upr_rpu": [0.1] * 3}
"""Joints that cannot be assembled."""
WRENCH = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])


def functions(robot):
    """Functions of a robot by name, each with arrays that it takes."""
    n = len(robot.joint_names)
    count = np.arange(1.0, n + 1)
    q, qd, qdd = robot.graph.home + 0.02 * count, 0.1 * count, -0.3 * count
    pose = robot.forward(q)
    tau = dynamics.inverse_dynamics(robot, q, qd, qdd, WRENCH)
    moved = 1e-5 * WRENCH
    response = elasticity.element_response(robot, pose)
    factors = np.linspace(1.0, 2.0, len(response.names))

    def bound(function):
        return lambda *arrays: function(robot, *arrays)

    motion = [q, qd, qdd, WRENCH]
    table = {
        name: (getattr(robot, name), [q])
        for name in (
            "forward",
            "platform",
            "placements",
            "jacobian",
            "platform_jacobian",
            "body_jacobians",
            "singularity",
            "passive",
            "try_forward",
            "try_jacobian",
            "try_singularity",
        )
    }
    table |= {name: (getattr(robot, name), [pose]) for name in ("inverse", "try_inverse")}
    table |= {
        "pose_acceleration": (robot.pose_acceleration, [q, qd, qdd]),
        "passive_rates": (robot.passive_rates, [q, qd]),
        "sphere_force": (
            lambda p, x, a: dynamics.max_driving_force(robot, p, x, 10.0, a),
            [pose, count, count],
        ),
        "forces_range": (
            lambda p, a: dynamics.max_driving_force_range(robot, p, 10.0, a),
            [pose, count],
        ),
        "spread": (dynamics.spread, [count]),
        "tilted_pose": (dynamics.tilted_pose, [count, count, count]),
        "tool": (lambda t: elasticity.setpoint_correction(robot, q, moved, tool=t), [moved[:3]]),
        "bound": (lambda b: elasticity.setpoint_correction(robot, q, moved, bound=b), [count]),
        "frequencies": (lambda p: natural_frequencies(robot, p, 2), [pose]),
        "modes": (lambda p: modes(robot, p, 2), [pose]),
        "members": (lambda p, w: member_deflections(robot, p, w), [q, WRENCH]),
        "rotation": (robot.rotation, [pose]),
        "compliance_at": (response.compliance_at, [factors]),
        "deflection": (response.deflection, [WRENCH, factors]),
    }
    for name in (
        "inverse_dynamics",
        "dynamics_terms",
        "least_norm_reactions",
        "reactions",
        "regressor",
        "torque_deviation",
    ):
        table[name] = (bound(getattr(dynamics, name)), motion)
    for name, arrays in {
        "mass_matrix": [q],
        "forward_dynamics": [q, qd, tau, WRENCH],
        "energy": [q, qd],
        "platform_wrench": [q, tau],
        "joint_motion": [pose, count, count],
        "energy_matrices": [pose],
        "energy_transfer": [pose, count],
        "energy_transfer_range": [pose],
    }.items():
        table[name] = (bound(getattr(dynamics, name)), arrays)
    for name, arrays in {
        "compliance": [pose],
        "stiffness": [pose],
        "strain_energy": [pose, WRENCH],
        "compliance_deviation": [pose],
        "clearance": [pose],
        "reachable": [pose],
        "setpoint_correction": [q, moved],
        "element_response": [pose],
        "platform_response": [q, WRENCH],
    }.items():
        table[name] = (bound(getattr(elasticity, name)), arrays)
    return table


def leaves(result):
    """All arrays of a result, texts too."""
    if dataclasses.is_dataclass(result):
        result = [getattr(result, field.name) for field in dataclasses.fields(result)]
    if isinstance(result, dict):
        result = list(result.values())
    if isinstance(result, list | tuple):
        return [leaf for part in result for leaf in leaves(part)]
    return [np.asarray(result)]


def flat(result):
    """All numbers of a result side by side."""
    found = [leaf.ravel() for leaf in leaves(result) if leaf.dtype.kind in "fiub"]
    return np.concatenate([np.zeros(0), *found])


def assert_same(found, right, name):
    """But for the last bits: another layout may be summed in another order."""
    np.testing.assert_allclose(found, right, 1e-11, 1e-13 * np.abs(right).max(), err_msg=name)


def wrong_ones(array):
    """What is no array of these numbers, by what is wrong with it."""
    n = len(array)
    text = [str(value) for value in array]
    first = np.arange(n) == 0
    return {
        "None": None if n != 6 else [None] * 6,
        "one None": [None, *array.tolist()[1:]],
        "an object that is None": np.array([None, *array.tolist()[1:]], object),
        "masked": np.ma.array(array, mask=first),
        "masked in a batch": np.ma.array([array, array], mask=[first & False, first]),
        "complex": array + 1j,
        "text": text,
        "bytes": np.array(text).astype(bytes),
        "an object that is text": np.array([text[0], *array.tolist()[1:]], object),
        "truth": first,
        "dates": np.zeros(n, "datetime64[s]"),
        "named": {"a": array},
        "ragged": [[0.1], [0.1, 0.2]],
        "nothing": np.zeros(0),
    }


ANSWERED = ("reachable", "try_forward", "try_inverse", "try_jacobian", "try_singularity")
ONE_SAMPLE = ("spread", "tilted_pose", "bound", "deflection", "compliance_at")
"""Without batches of samples, or with arguments of any shape."""
OF_ONE_POSE = ("frequency_response", "stability_lobes", "stable_depth", "tool_modes")
READ_ONLY = ("reactions", "least_norm_reactions", "modes", "strain_energy", "platform_response")
EVERYWHERE = ("an object that is None", "text", "masked")
"""Kinds that every argument of every function is given."""


@pytest.mark.parametrize("name", ROBOTS)
def test_what_is_no_real_number_is_refused(name):
    """Every kind by the function of torques, some kinds by all."""
    for function, (ask, arrays) in functions(load(name)).items():
        for k, array in enumerate(arrays):
            for what, wrong in wrong_ones(array).items():
                if function != "inverse_dynamics" and what not in EVERYWHERE:
                    continue
                given = [*arrays[:k], wrong, *arrays[k + 1 :]]
                with pytest.raises(ValueError, match=r"\w") as caught:
                    print(f"{function}, argument {k}, {what}:", ask(*given))
                assert "\n" not in str(caught.value), (function, k, what)


@pytest.mark.parametrize("name", ROBOTS)
def test_what_is_not_finite_or_of_another_length_is_refused(name):
    for function, (ask, arrays) in functions(load(name)).items():
        for k, array in enumerate(arrays):
            wrongs = []
            for place, bad in ((0, np.nan), (-1, np.inf), (0, -np.inf)):
                wrongs.append(array.copy())
                wrongs[-1][place] = bad
            if function not in ("spread", "tilted_pose"):
                wrongs += [array[:-1], np.append(array, 0.1), array[:, None]]
            for wrong in wrongs:
                given = [*arrays[:k], wrong, *arrays[k + 1 :]]
                if function.startswith("try_") and wrong.shape == array.shape:
                    assert not ask(*given)[1].any()
                    continue
                if function == "bound" and np.inf in wrong:
                    continue  # no bound
                with pytest.raises(ValueError, match=r"\w"):
                    print(f"{function}, argument {k}, {wrong}:", ask(*given))
                if wrong.shape == array.shape and function not in ONE_SAMPLE:
                    given[k] = np.stack([array, wrong])
                    with pytest.raises(ValueError, match="direction|" * (k == 1) + r"sample \(1,"):
                        print(f"{function}, argument {k}, a batch:", ask(*given))


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_results_beyond_what_a_double_holds_are_refused(name):
    """Finite or refused, however large the numbers."""
    for ask, arrays in functions(load(name)).values():
        for k, array in enumerate(arrays):
            for huge in (1e308, -1e308):
                try:
                    found = ask(*arrays[:k], np.full(len(array), huge), *arrays[k + 1 :])
                except ValueError:
                    continue
                if not isinstance(found, tuple) or found[-1] is not False:
                    shown = flat(found)
                    assert np.isfinite(shown).all() or not flat(found[1]).any()


@pytest.mark.parametrize("name", ROBOTS)
def test_real_numbers_of_any_kind_and_layout_are_those_numbers(name):
    """Also where one sample stands beside a batch: as a column of a table, backwards, of bytes."""
    for function, (ask, arrays) in functions(load(name)).items():
        right = flat(ask(*arrays))
        for k, array in enumerate(arrays):
            for other in (
                array.tolist(),
                np.ma.array(array),
                array.astype(object),
                np.array([Decimal(float(v)) for v in array]),
                array.astype(">f8"),
                np.repeat(array, 2)[::2],
                array[::-1].copy()[::-1],
                np.lib.stride_tricks.as_strided(array, array.shape, array.strides),
            ):
                given = [*arrays[:k], other, *arrays[k + 1 :]]
                assert_same(flat(ask(*given)), right, function)
        if len(arrays) < 2 or function in ("deflection", "tilted_pose"):
            continue
        for k, array in enumerate(arrays):
            batch = [np.tile(a, (3, 1)) for a in arrays]
            whole = flat(ask(*batch))
            for other in (np.repeat(array, 3)[::3], array[::-1].copy()[::-1], array[None]):
                given = [*batch[:k], other, *batch[k + 1 :]]
                assert_same(flat(ask(*given)), whole, function)


@pytest.mark.parametrize("name", ROBOTS)
def test_batches_are_their_samples_and_results_are_read_only(name, rng):
    for function, (ask, arrays) in functions(load(name)).items():
        if function in ONE_SAMPLE:
            continue
        batch = [array * (1.0 + 1e-3 * rng.normal(size=(2, 3, 1))) for array in arrays]
        whole = ask(*batch)
        if function in READ_ONLY:
            assert not any(x.flags.writeable for x in leaves(whole) if x.ndim > 2), function
        for k in np.ndindex(2, 3):
            for one, many in zip(leaves(ask(*(b[k] for b in batch))), leaves(whole), strict=True):
                right = many[k] if many.shape == (2, 3, *one.shape) else many
                np.testing.assert_array_equal(one, right, function)
        if function == "modes":
            continue  # of a pose at least
        none = leaves(ask(*(array[:0] for array in batch)))
        for empty, many in zip(none, leaves(whole), strict=True):
            assert empty.shape in ((0, *many.shape[1:]), many.shape), function


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("module", [dynamics, elasticity], ids=lambda module: module.__name__)
def test_every_public_function_answers_an_empty_batch_by_an_empty_batch(module, name):
    """All functions of the module's names that take numbers of samples, by their parameters' names."""
    robot = load(name)
    q, pose = robot.graph.home, robot.home()
    joints = dict.fromkeys(("qd", "qdd", "tau", "external", "weights"), np.ones(len(q)))
    poses = dict.fromkeys(("rate", "rates", "acceleration", "direction"), np.ones(len(pose)))
    given = joints | poses | {"q": q, "pose": pose, "wrench": WRENCH, "deflection": 1e-5 * WRENCH}
    asked = []
    for function in module.__all__:
        ask = getattr(module, function)
        names = inspect.signature(ask).parameters if inspect.isfunction(ask) else {}
        arrays = {name: given[name] for name in names if name in given}
        if "robot" not in names or not arrays or function in OF_ONE_POSE:
            continue
        asked.append(function)

        def shapes(*batch, ask=ask, arrays=arrays):
            found = ask(robot, **{name: np.tile(array, (*batch, 1)) for name, array in arrays.items()})
            return [leaf.shape for leaf in leaves(found)]

        try:
            right = shapes(2, 3)
        except ParameterError as error:
            assert error.field in ("mechanism", "pose"), function  # a mechanism of other limbs or more coordinates
            continue
        for batch in ((0,), (2, 0), (0, 3)):
            assert shapes(*batch) == [(*batch, *s[2:]) if s[:2] == (2, 3) else s for s in right], function
    assert len(asked) > 9


@pytest.mark.parametrize("name", ROBOTS)
def test_batches_of_different_sizes_are_refused(name):
    for function, (ask, arrays) in functions(load(name)).items():
        for k in range(len(arrays) if len(arrays) > 1 else 0):
            given = [np.tile(a, (2 if j == k else 3, 1)) for j, a in enumerate(arrays)]
            with pytest.raises(ValueError, match=r"batches of|of one sample"):
                print(f"{function}, argument {k}:", ask(*given))


@pytest.mark.parametrize("name", partly_long(FAR, "upr_rpu"))
def test_states_without_an_assembly_are_refused_by_their_sample(name):
    robot = load(name)
    beyond = {"q": FAR[name], "pose": [9.0 if unit == "m" else 2.0 for unit in robot.pose_units]}
    table = functions(robot)
    given = {"q": table["forward"][1][0], "pose": table["inverse"][1][0]}
    for function, (ask, (first, *others)) in table.items():
        for kind, good in given.items():
            if np.array_equal(first, good) and function not in ANSWERED:
                batch = [np.stack([good, beyond[kind]]), *(np.stack([v, v]) for v in others)]
                with pytest.raises((UnreachableError, SingularityError)) as caught:
                    print(function, kind, ask(*batch))
                assert caught.value.index[0] == 1


PROGRAM = """
import json, re, sys
from delta_dynamics import inverse_dynamics
from pkm_twin.codegen.code import compiled
from pkm_twin.errors import PkmTwinError
from test.laws.test_arguments import functions, leaves
from test.support.robots import KINDS, load
found = {"compiled": compiled()}
for name in KINDS:
    q = load(name).graph.home + 0.01
    found[name, "torques"] = [inverse_dynamics(load(name), q, 2 * q, 3 * q)]
for name, far in json.loads(sys.stdin.read()).items():
    for function, (ask, arrays) in functions(load(name)).items():
        found[name, function] = leaves(ask(*arrays))
    try:
        load(name).forward(far)
    except PkmTwinError as error:
        found[name, "refusal"] = leaves(re.sub(r"\\d+\\.\\d+", lambda m: f"{float(m[0]):.4g}", str(error)))
print(json.dumps({"compiled": found.pop("compiled")}
    | {" ".join(key): [leaf.tolist() for leaf in value] for key, value in found.items()}))
"""


@pytest.mark.parametrize("names", often((), ROBOTS))
def test_without_a_compiler_the_numbers_are_the_same(names):
    """The same formulas as plain Python, in a process of its own; by default the torques alone."""
    fast, slow = both_ways(PROGRAM, json.dumps({name: FAR[name] for name in names}))
    assert len(fast) > 40 * len(names)
    for name in fast:
        if name.endswith(("modes", "element_response")):
            continue  # these have signs and bases of their own
        for one, other in zip(fast[name], slow[name], strict=True):
            right = np.asarray(one)
            if right.dtype.kind in "US":
                assert other == one, name
            elif right.size:
                # Reactions have a residual of rounding.
                least = 1e-3 if "reactions" in name else 1e-12
                limit = 1e-11 * max(np.nanmax(np.abs(right)), least)
                np.testing.assert_allclose(other, right, rtol=0, atol=limit, err_msg=name)


def test_a_robot_without_masses_has_no_dynamics(tmp_path):
    robot = load(massless(tmp_path / "light.yaml"))
    q = robot.graph.home
    for name in ("inverse_dynamics", "dynamics_terms", "reactions", "regressor"):
        with pytest.raises(ParameterError, match="inertia"):
            getattr(dynamics, name)(robot, q, q, q)


def test_kinds_of_numbers():
    for right in ([1, 2], np.array([1, 2], np.uint8), np.float32([1, 2]), (1.0, 2)):
        found = doubles(right)
        assert found.dtype == np.float64 and found.tolist() == [1.0, 2.0]
    kept = np.array([1.0])
    assert doubles(kept) is kept
    assert doubles([10**400]).tolist() == [np.inf]
    with pytest.raises(ValueError, match="rows of different lengths"):
        doubles([[1.0], [1.0, 2.0]])
    for wrong in (True, "1", b"1", 1j, None, {1.0}, np.timedelta64(1, "s"), [np.bool_(True)]):
        with pytest.raises(ValueError, match="real numbers"):
            doubles(wrong)


class TestEstimators:
    """A sample that is refused moves nothing that a good one is judged by."""

    robot = load("delta_cu")
    q = robot.inverse(robot.home())
    motion = (q, 0.1 * q, 0.2 * q)
    effort = np.array([0.3, 0.2, 0.1])

    def pushed(self, kind, *times):
        made = getattr(dynamics, kind)(self.robot)
        for time in times:
            self.push(made, time, self.motion, self.effort)
        return made

    def push(self, made, time, motion, effort, wrench=None):
        if isinstance(made, dynamics.MomentumObserver):
            return made.push(time, *motion[:2], effort, wrench)
        if isinstance(made, dynamics.ContactMonitor):
            return made.push(time, motion, effort, wrench)
        return made.push(time, *motion, effort, wrench)

    @pytest.mark.parametrize("kind", ["MomentumObserver", "ContactMonitor", "PayloadEstimator"])
    def test_a_refused_sample_moves_nothing(self, kind):
        times = np.arange(0.0, 0.4, 0.02)
        disturbed, quiet = self.pushed(kind, *times), self.pushed(kind, *times)
        q, qd, qdd = self.motion
        nothing, far = np.full(3, np.nan), np.array([-2.8, 0.8, -1.4])
        wrongs = [
            (np.nan, self.motion, self.effort),
            (np.inf, self.motion, self.effort),
            (times[-1], self.motion, self.effort),
            (0.0, self.motion, self.effort),
            (0.5, (nothing, qd, qdd), self.effort),
            (0.5, (q, nothing, qdd), self.effort),
            (0.5, (far, qd, qdd), self.effort),
            (0.5, (q[:2], qd, qdd), self.effort),
            (0.5, (q, np.tile(qd, (2, 1)), qdd), self.effort),
            (0.5, self.motion, nothing),
            (0.5, self.motion, self.effort[:1]),
            (0.5, self.motion, np.ma.array(self.effort, mask=[1, 0, 0])),
            (0.5, self.motion, self.effort, np.full(6, np.nan)),
        ]
        if kind != "MomentumObserver":
            wrongs.append((0.5, (q, qd, nothing), self.effort))
        for wrong in wrongs:
            with pytest.raises(ValueError, match=r"\w"):
                print(kind, wrong, self.push(disturbed, *wrong))
        found = [flat(self.push(made, 0.4, self.motion, self.effort)) for made in (disturbed, quiet)]
        assert len(found[0])
        np.testing.assert_array_equal(*found)

    @pytest.mark.parametrize("kind", ["MomentumObserver", "ContactMonitor", "PayloadEstimator"])
    def test_arrays_may_be_used_again_by_the_caller(self, kind):
        """A reader of a stream fills the same arrays sample by sample."""
        rng = np.random.default_rng(1)
        rows = [tuple(self.q + 0.01 * rng.normal(size=3) for _ in range(4)) for _ in range(30)]
        fresh, used = (getattr(dynamics, kind)(self.robot) for _ in range(2))
        room = [np.zeros(3) for _ in range(4)]
        for k, row in enumerate(rows):
            for place, value in zip(room, row, strict=True):
                place[:] = value
            pair = [self.push(made, 0.02 * k, arrays[:3], arrays[3]) for made, arrays in ((fresh, row), (used, room))]
        np.testing.assert_array_equal(*map(flat, pair))

    def test_an_alarm_takes_no_sample_that_is_not_finite(self):
        alarm = elasticity.StiffnessAlarm(load("upr_rpu"))
        pose = load("upr_rpu").home()
        for wrench, deflection in (
            (np.full(6, np.nan), np.zeros(6)),
            (WRENCH, np.full(6, np.inf)),
            (WRENCH, np.zeros(3)),
        ):
            with pytest.raises(ValueError, match=r"\w"):
                alarm.push(0.0, pose, wrench, deflection)
        assert alarm.count == 0


def test_times_of_samples():
    assert check_later(1.0, None) == 1.0 and check_later(1.0, 0.5) == 1.0
    for time, last in ((np.nan, None), (np.inf, 1.0), (1.0, 1.0), (0.5, 1.0), (np.nan, 1.0)):
        with pytest.raises(ValueError, match="time of a sample"):
            check_later(time, last)


def test_a_state_that_moves_no_mass_has_no_accelerations():
    """A point mass at the end of two links: in line with both joints it has no radial motion."""
    point = {"mass": 1.0, "com": [1.0, 0.0, 0.0], "inertia": [0.0, 0.0, 0.0]}
    joint = {"type": "revolute", "axis": [0.0, 0.0, 1.0], "actuated": True}
    data = {
        "mechanism": "machine",
        "platform": "outer",
        "pose": ["x", "y"],
        "bodies": {"inner": point | {"mass": 0.0}, "outer": point},
        "joints": {
            "shoulder": joint | {"between": ["base", "inner"], "at": [0.0, 0.0, 0.0]},
            "elbow": joint | {"between": ["inner", "outer"], "at": [0.6, 0.5, 0.0]},
        },
    }
    robot = robot_of_data(data, "point")
    # The elbow turns the second link into the line of the first.
    line = robot.graph.home + np.array([0.0, np.arctan2(0.5, 0.6) - np.arctan2(-0.5, 0.4)])
    with pytest.raises(ValueError, match="finite"):
        dynamics.forward_dynamics(robot, line, [0.0, 0.0], [1.0, 2.0])
    beside = line + np.array([0.0, 0.1])
    assert np.isfinite(dynamics.forward_dynamics(robot, beside, [0.0, 0.0], [1.0, 2.0])).all()
