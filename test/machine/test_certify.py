# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What is judged by other engines, and that they stay other engines."""

import ast
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import pkm_twin.certify as judges
from delta_dynamics import forward_dynamics, inverse_dynamics, mass_matrix
from pkm_twin import load
from pkm_twin.certify import certificate as certification
from pkm_twin.certify.certificate import ENGINES, Certificate, certify, certify_variants, draw_variant
from pkm_twin.codegen.code import Code
from pkm_twin.errors import PkmTwinError, SingularityError
from pkm_twin.kinematics import engine
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.report import Fact, Report
from test.machine.random_machines import FILES, plain
from test.support.robots import partly_long


def test_judges_import_nothing_of_the_twin_but_what_joints_are():
    allowed = {"numpy", "scipy", "pinocchio", "mujoco", *sys.stdlib_module_names}
    for path in Path(judges.__file__).parent.glob("*.py"):
        if path.name == "certificate.py":  # which compares them with the twin
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module]
            for name in names:
                own = name.startswith("pkm_twin.certify.")
                own |= name == "pkm_twin.machine.joints"
                assert own or name.split(".")[0] in allowed, f"{path.name} imports {name}"


class Echo:
    """A twin that answers what a judge does, with an error of its own if it is told one."""

    name = "echo"

    def __init__(self, description, **errors):
        from pkm_twin.certify.maximal import Maximal

        self.judge, self.errors = Maximal(description), errors
        self.description_data = description

    def each(self, what, *batches):
        answers = [getattr(self.judge, what)(*sample) for sample in zip(*batches, strict=True)]
        return np.array(answers) * (1.0 + self.errors.get(what, 0.0))

    def forward(self, q):
        return q

    def inverse(self, pose):
        return pose + self.errors.get("inverse", 0.0)

    def platform(self, q):
        places = [self.judge.platform(one) for one in q]
        position = np.array([place for place, _ in places]) + self.errors.get("platform", 0.0)
        return position, np.array([rotation for _, rotation in places])

    def platform_jacobian(self, q):
        return self.each("jacobian", q)


@pytest.fixture
def echoes(monkeypatch):
    """The twin's dynamics, answered by an Echo."""

    def torques(robot, *state):
        if np.ndim(state[0]) == 1:
            return torques(robot, *(x[None] for x in state))[0]
        return robot.each("inverse_dynamics", *state)

    monkeypatch.setattr(certification, "inverse_dynamics", torques)
    monkeypatch.setattr(certification, "mass_matrix", lambda robot, q: robot.each("mass_matrix", q))
    return lambda **errors: Echo(plain("rps3"), **errors)


def judged(twin) -> Certificate:
    return certify(twin, twin.description_data, states=2, engines=["maximal"])


def test_what_is_right_is_certified(echoes):
    result = judged(echoes())
    assert result.good
    assert (result.mobility, result.rows - result.rank) == (3, 0)
    assert {item.what for item in result.items} == set(certification.BOUNDS)
    assert result.data["good"] is True


@pytest.mark.parametrize(
    ("error", "what"),
    [
        ({"inverse_dynamics": 1e-8}, "torques"),
        pytest.param({"platform": 1e-8}, "platform", marks=pytest.mark.long),
        pytest.param({"jacobian": 1e-8}, "jacobian", marks=pytest.mark.long),
        pytest.param({"mass_matrix": 1e-8}, "mass_matrix", marks=pytest.mark.long),
        ({"inverse": 1e-8}, "round_trip"),
        ({"inverse_dynamics": np.nan}, "torques"),
    ],
)
def test_what_is_wrong_is_named(echoes, error, what):
    result = judged(echoes(**error))
    assert not result.good
    assert what in {item.what for item in result.items if not item.good}
    json.dumps(Report(facts=[Fact("all", result.data)]).data, allow_nan=False)


def test_progress_counts_states(echoes):
    seen, twin = [], echoes()
    certify(twin, twin.description_data, states=3, engines=["maximal"], progress=seen.append)
    assert seen == [1, 2, 3]


def test_an_engine_that_is_not_installed_is_told(echoes, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, ENGINES["mujoco"][0].split(":")[0], raising=False)
    twin = echoes()
    result = certify(twin, twin.description_data, states=1, engines=["maximal", "mujoco"])
    assert list(result.missing) == ["mujoco"]
    assert "mujoco is not installed; pip install '.[certificate]'" in result.missing["mujoco"]
    assert result.good


def test_a_machine_that_no_judge_can_take(echoes):
    twin = echoes()
    twin.description_data["joints"] = {"odd": {"type": "screw", "between": ["base", "platform"]}}
    with pytest.raises(PkmTwinError, match="screw"):
        judged(twin)


def test_a_file_that_is_not_the_machine_fails():
    data = plain("five_bar")
    data["bodies"]["arm_left"]["mass"] *= 1.0 + 1e-6
    heavier = robot_of_data(data, "heavier")
    result = certify(heavier, plain("five_bar"), states=3, engines=["maximal"])
    assert "torques" in {item.what for item in result.items if not item.good}


@pytest.mark.parametrize("name", partly_long(["slider_crank", "rps3", "stewart"], "slider_crank"))
def test_drawn_machines_share_their_programs(name, monkeypatch):
    """Geometry is an input; the order in which a linear system is eliminated belongs to the program.

    It is chosen by the sizes of the pivots: a drawn machine may have another order, and nothing else.
    """
    made = []
    monkeypatch.setattr(engine, "Code", lambda *given: made.append(given) or Code(*given))
    robots, orders = [], set()
    for seed in range(4):
        robot = draw_variant(load(FILES[name]), seed)
        made.clear()
        q = robot.inverse(robot.home())
        zero = np.zeros_like(q)
        found = inverse_dynamics(robot, q, zero, forward_dynamics(robot, q, zero, zero))
        np.testing.assert_allclose(found, 0.0, atol=1e-9)
        mass_matrix(robot, q), robot.platform_jacobian(q)
        own = robot.engine
        order = repr((own.pivots, own.order, own.newton_pivots, own.platform_pivots))
        assert not made or order not in orders
        orders.add(order)
        robots.append(robot)
    assert len(orders) < len(robots)
    assert len({str(robot.own_inertial) for robot in robots}) == len(robots)


def test_variants_are_certified_with_the_robot():
    seen, robot = [], load(FILES["five_bar"])
    result = certify_variants(robot, 3, seed=1, states=2, engines=["maximal"], progress=seen.append)
    assert result.good and result.variants == 3 and seen == list(range(1, 9))
    assert result.drawn >= 8


def test_a_state_that_the_twin_does_not_reach_is_skipped_and_counted(echoes, monkeypatch):
    robot = Echo(plain("rps3"))
    reached, real = [], robot.forward

    def forward(q):
        if np.ndim(q) == 1:
            reached.append(q)
            if len(reached) % 2:
                raise SingularityError("joint state", (), 0.0, 1e-6)
        return real(q)

    robot.forward = forward
    result = certify(robot, robot.description_data, states=4, engines=("maximal",))
    assert result.skipped == 4 and result.drawn >= 8 and result.good
    assert result.data["skipped"] == 4
