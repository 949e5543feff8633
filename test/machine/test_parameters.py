# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Files with parameters: the machine with the numbers written out, in all that varies it."""

import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics, torque_derivatives
from pkm_twin import load, variants
from pkm_twin.apps.commands.calibrate import Calibrate, calibrate
from pkm_twin.design import tolerances
from pkm_twin.design.variables import Variables, parse_vary
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine.strict_yaml import parse_yaml
from pkm_twin.mechanisms.catalogue import config_folder, robot_of_data
from pkm_twin.mechanisms.entries import Chosen, edit_robot_text, write_edited
from pkm_twin.paths.sizing import read_motors

from .random_machines import written_out

SOURCE = """\
mechanism: machine
parameters:
  arm: 0.2  # pivot to elbow
  forearm: arm * 2 + 0.05
  base: 0.1
  plate: base**1.5 * arm**-0.5 / arm**(2*base) / 2
  drop: sqrt(forearm**2 - (base + arm - plate)**2)
  m: 0.3
origin: [0, 0, -drop]
uncertainty: {parameters.arm: {deviation: 0.0001}}
bodies:
  platform: {mass: m + 0.05, com: [0, 0, -drop], inertia: [4e-4, 4e-4, 7e-4]}
joints:
  slide: {type: translation, between: [base, platform]}
limbs:
  azimuths: [pi/2, pi/2 + 2*pi/3, pi/2 - 2*pi/3]
  bodies:
    arm: {mass: m, com: [base + arm/2, 0, 0], inertia: [1e-5, m*arm**2/12, m*arm**2/12]}
  joints:
    motor:
      type: revolute
      between: [base, arm]
      at: [base, 0, 0]
      axis: [0, cos(0), -sin(0)]
      actuated: true
      friction: {viscous: [0.01, 0.02, tan(pi/8)**1.5]}
  rods:
    rod: {between: [arm, platform], ends: [[base + arm, 0, 0], [plate, 0, -drop]], mass: 0.05}
"""
Q, RATE, SECOND = np.array([0.1, 0.2, 0.3]), np.array([1.0, -0.5, 0.3]), np.array([4.0, 2.0, -3.0])
NAMES = ("arm", "base", "m", "forearm", "drop")


def data_with(**values):
    data = yaml.safe_load(SOURCE)
    data["parameters"] |= values
    return data


def robot_with(**values):
    return robot_of_data(data_with(**values), "own")


def torques(robot):
    return inverse_dynamics(robot, Q, RATE, SECOND)


def test_a_file_with_expressions_is_the_file_with_their_numbers_to_the_last_bit():
    robot, plain = robot_with(), robot_of_data(written_out(data_with()), "own")
    assert robot.graph.key == plain.graph.key
    assert (robot.inertial == plain.inertial).all()
    assert (torques(robot) == torques(plain)).all()
    assert (torques(pickle.loads(pickle.dumps(robot))) == torques(plain)).all()


@pytest.mark.parametrize("name", NAMES)
def test_variants_over_a_parameter_are_the_files_one_by_one(name):
    robot = robot_with()
    value = robot.number(f"parameters.{name}")
    values = value * np.array([0.97, 1.0, 1.02])
    many = variants(robot, {f"parameters.{name}": values})
    assert many.valid.all()
    for k, found in enumerate(many.inverse_dynamics(Q, RATE, SECOND)):
        own = robot_with(**{name: float(values[k])})
        assert found == pytest.approx(torques(own), abs=1e-13)
        assert torques(many[k]) == pytest.approx(found, abs=1e-13)


def test_variants_far_from_the_file_are_the_files_one_by_one():
    data = data_with()
    data["parameters"] |= {"far": 1.0, "m": "0.1 * far**0.3"}
    robot, values = robot_of_data(data, "own"), 10.0 ** np.arange(-6, 10, 3.0)
    many = variants(robot, {"parameters.far": values})
    assert many.valid.all()
    for value, found in zip(values, many.inverse_dynamics(Q, RATE, SECOND), strict=True):
        data["parameters"]["far"] = float(value)
        assert found == pytest.approx(torques(robot_of_data(data, "own")), rel=1e-12)


def test_a_variant_that_a_file_may_not_be_is_not_valid_between_those_that_it_may_be():
    data = data_with()
    data["parameters"] |= {"far": 0.5, "m": "(far - 1) * (far - 3)"}
    many = variants(robot_of_data(data, "own"), {"parameters.far": [0.5, 2.0, 4.0]})
    assert many.valid.tolist() == [True, False, True]
    assert np.isnan(many.inverse_dynamics(Q, RATE, SECOND)[1]).all()


@pytest.mark.parametrize("name", NAMES)
def test_a_derivative_by_a_parameter_is_that_of_differences(name):
    robot, path, step = robot_with(), f"parameters.{name}", 1e-5
    slope = torque_derivatives(robot, Q, RATE, SECOND, by=[path]).by[path]
    ends = [torques(robot.with_file_values({path: robot.number(path) + s})) for s in (-step, step)]
    assert slope == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-7, abs=1e-8)


def test_a_parameter_of_tolerances_and_doubt():
    robot, path = robot_with(), "parameters.arm"
    moved = tolerances(robot, {path: 1e-4}, Q).sensitivity[path]
    step = 1e-6
    places = [robot.with_file_values({path: 0.2 + s}).platform(Q)[0] for s in (-step, step)]
    assert moved[:3] == pytest.approx((places[1] - places[0]) / (2 * step), abs=1e-7)
    assert robot.uncertainty_changes[path] == {path: 1e-4}


def test_units_follow_from_where_a_parameter_stands():
    units = {path: unit for path, (_, unit) in robot_with().file_numbers().items()}
    assert {name: units[f"parameters.{name}"] for name in (*NAMES, "plate")} == {
        "arm": "m",
        "base": "m",
        "m": "kg",
        "forearm": "m",
        "drop": "m",
        "plate": "m",
    }


def test_a_new_value_is_written_where_the_parameter_stands(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text(SOURCE)
    robot, new = load(path), {"parameters.arm": Chosen(0.21, "longer")}
    text = edit_robot_text(robot, str(path), new)
    old = SOURCE.splitlines()
    assert [line for line in text.splitlines() if line not in old] == [
        "  # parameters.arm: longer",
        "  arm: 0.21  # pivot to elbow",
    ]
    # A copy's own number needs the file written out, with the parameter's new value.
    text = edit_robot_text(robot, str(path), new | {"joints.motor_1.at[0]": Chosen(0.1, "moved")})
    path.write_text(text)
    numbers = {"parameters.arm": 0.21, "joints.motor_1.at[0]": 0.1}
    assert torques(load(path)) == pytest.approx(torques(robot.numbered(numbers)), abs=1e-12)


def test_what_an_edited_file_loses_of_its_expressions_is_told(tmp_path):
    path, out = tmp_path / "own.yaml", tmp_path / "out.yaml"
    path.write_text(SOURCE)
    robot, new = load(path), {"bodies.platform.mass": Chosen(0.4, "fitted")}
    (told,) = write_edited(out, [], edit_robot_text(robot, str(path), new), robot)
    assert told.endswith("expressions: bodies.platform.mass was m + 0.05")
    assert f"# {told}\n" in out.read_text() and load(out).book.values == robot.book.values
    new = {f"limbs.bodies.arm.{end}": Chosen(0.4, "") for end in ("mass", "inertia[1]")}
    new |= {"limbs.bodies.arm.inertia[2]": Chosen(0.4, ""), "bodies.platform.mass": Chosen(1.0, "")}
    _, dead = write_edited(out, [], edit_robot_text(robot, str(path), new), robot)
    assert dead == "nothing depends on m any more"
    # Written out, the file has none of them.
    new = {"joints.motor_1.at[0]": Chosen(0.1, "moved")}
    texts, dead = write_edited(out, [], edit_robot_text(robot, str(path), new), robot)
    assert texts.count(" was ") == len(robot.book.formulas)
    assert all(name in dead for name in robot.book.values)
    poses, rng = tmp_path / "poses.csv", np.random.default_rng(3)
    q = 0.3 * rng.normal(size=(40, 3))
    names = [*(f"{name}.position" for name in robot.joint_names), "x", "y", "z"]
    seen = np.hstack([q, robot_with(arm=0.203).platform(q)[0]])
    np.savetxt(poses, seen, "%.17g", ",", header=",".join(names), comments="")
    given = Calibrate(robot=str(path), poses=poses, out=tmp_path / "mine.yaml", only=("parameters",))
    found = calibrate.run(given).data["parameters"]
    assert found["parameters.arm"]["value"] == pytest.approx(0.203, abs=1e-5)
    assert all(name.startswith("parameters.") for name in found)
    assert load(tmp_path / "mine.yaml").book.formulas.keys() == robot.book.formulas.keys()


def test_a_parameter_that_nothing_depends_on_is_named_and_not_varied():
    robot = robot_with(idle=1.0)
    assert robot.book.unused == ["idle"] and robot_with().book.unused == []
    with pytest.raises(ParameterError, match="depends on"):
        Variables.of(robot, {"parameters.arm": (0.1, 0.3), "parameters.idle": (0.0, 2.0)})


def test_the_expression_that_a_number_was_is_told():
    book = robot_with().book
    assert book.text("parameters.forearm") == "arm * 2 + 0.05"
    assert book.text("bodies.platform.mass") == "m + 0.05"
    assert book.text("parameters.m") == book.text("forearm") == ""


def test_a_parameter_without_its_section_is_suggested():
    with pytest.raises(ParameterError, match=r"'parameters\.arm'"):
        robot_with().number("arm")


@pytest.mark.parametrize("text", ["0.26 m", "5 deg", "-1e-3mm"])
def test_a_number_with_a_unit_is_rejected_by_the_units_that_files_have(text):
    with pytest.raises(ParameterError, match="rad and m"):
        robot_with(m=text)


@pytest.mark.parametrize(
    ("old", "new", "bound"),
    [
        ("axis: [0, cos(0), -sin(0)]", "axis: [atan2(arm, 1), 1, 0]", "quote"),
        ("actuated: true", "actuated: true\n      limits: {position: 0.15}", "[min, max]"),
        ("origin:", "pose: [x, y, yaw]\norigin:", "as x, y, z"),
    ],
)
def test_a_slip_is_answered_by_what_is_right(old, new, bound):
    with pytest.raises(ParameterError) as caught:
        robot_of_data(parse_yaml(SOURCE.replace(old, new), "slip"), "slip")
    assert bound in caught.value.bound


def test_names_near_a_file_or_a_word_are_suggested(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gantry.yaml").write_text(SOURCE)
    for ask, name, near in (
        (load, "gantry", "gantry.yaml"),
        (lambda name: read_motors(Path(name)), "shiped", "shipped"),
    ):
        with pytest.raises(UnknownNameError) as caught:
            ask(name)
        assert caught.value.closest == near
    with pytest.raises(ParameterError, match="repeat --vary"):
        parse_vary(["parameters.arm=0.1:0.2,parameters.base=0.1:0.2"])


def test_changed_parameters_stay_parameters():
    robot = robot_with().changed(parameters={"arm": 0.21})
    assert robot.number("parameters.forearm") == pytest.approx(0.47)
    assert torques(robot) == pytest.approx(torques(robot_with(arm=0.21)), abs=1e-15)


@pytest.mark.parametrize(
    "sections",
    [{"payload": {"mass": 0.7}}, {"friction": {"viscous": 0.4}}, {"gravity": [1.0, 0.0, -3.0]}],
)
def test_what_is_changed_stays_when_a_parameter_moves(sections):
    robot, new = robot_with().changed(**sections), {"parameters.arm": 0.21}
    expected = torques(robot_with(arm=0.21).changed(**sections))
    assert torques(robot.with_file_values(new)) == pytest.approx(expected, abs=1e-13)
    assert torques(robot.numbered(new)) == pytest.approx(expected, abs=1e-13)


def test_numbers_that_are_set_one_after_another_are_those_set_at_once():
    first = {"payload.mass": 0.7, "limbs.azimuths[0]": 1.6, "parameters.base": 0.11}
    second = {"limbs.joints.motor.axis[2]": 0.01, "parameters.m": 0.2}
    expected = torques(robot_with().numbered(first | second))
    assert torques(robot_with().numbered(first).numbered(second)) == pytest.approx(expected)
    assert torques(robot_with().numbered(first).with_file_values({})) == pytest.approx(
        torques(robot_with().numbered(first))
    )


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "arithmetic"),
        ("arm +", "invalid syntax"),
        ("(arm", "never closed"),
        ("armm", "did you mean 'arm'"),
        ("arm arm", "invalid syntax"),
        ("1 if arm else 2", "not '1 if arm else 2'"),
        ("arm // 2", "not 'arm // 2'"),
        ("arm % 2", "'%'"),
        ("arm < 2", "'<'"),
        ("__import__('os').getcwd()", "is no part of it"),
        ("arm.real", "not 'arm.real'"),
        ("(lambda: 1)()", "':'"),
        ("exp(arm)", "'exp' is none"),
        ("sin(arm, arm)", "sin of 1 number"),
        ("atan2(arm)", "atan2 of 2 numbers"),
        ("sin", "sin( )"),
        ("1_000", "decimal numbers"),
        ("0x10", "decimal numbers"),
        ("1j", "decimal numbers"),
        ("1/0", "division by zero"),
        ("arm / (base - base)", "division by zero"),
        ("sqrt(-arm)", "finite real number"),
        ("(-arm)**0.5", "finite real number"),
        ("9**9**9**9", "finite real number"),
        ("1e300*1e300", "finite real number"),
        ("1e400", "finite real number"),
        ("(" * 230 + "1" + ")" * 230, "nested"),
        ("-" * 200 + "1", "nesting of at most"),
        ("1+" * 300 + "1", "at most 500 characters"),
        ("arm\n+ 1", "'\\n'"),
        ("arm, base", "not 'arm, base'"),
        ("nan", "expected a finite number"),
        ("1e-400", "at least 2.2e-308"),
        ("1e-200 * 1e-200", "at least 2.2e-308"),
        ("1e-200**2 + arm", "at least 2.2e-308"),
        ("tan(pi/2)", "tan(pi/2) = 1.63312e+16"),
        ("\u0430rm", "'\u0430'"),
    ],
)
def test_what_is_no_arithmetic_is_refused_with_its_place(text, reason):
    data = data_with()
    data["limbs"]["rods"]["rod"]["ends"][1][2] = text
    with pytest.raises(ParameterError) as caught:
        robot_of_data(data, "own")
    message = str(caught.value)
    assert caught.value.field == "limbs.rods.rod.ends[1][2]"
    assert reason in message
    assert "\n" not in message
    assert text.split("\n")[0].split("'")[0] in message or len(text) > 100


@pytest.mark.parametrize(
    ("values", "field", "reason"),
    [
        ({"arm": "forearm"}, "parameters.", "no circle: "),
        ({"arm": "arm"}, "parameters.arm", "no circle: arm, arm"),
        ({"arm": "base", "base": "plate"}, "parameters.", "base, plate"),
        ({"arm": "sqrt(0 - 1)"}, "parameters.arm", "real"),
        ({"arm": "other"}, "parameters.arm", "'other' is none"),
        ({"arm": math.nan}, "parameters.arm", "finite"),
        ({"arm": True}, "parameters.arm", "a number"),
        ({"arm": [1]}, "parameters.arm", "a number"),
        ({"pi": 3}, "parameters.pi", "not in use"),
        ({"sin": 3}, "parameters.sin", "not in use"),
        ({"a b": 3}, "parameters.a b", "letters"),
        ({"lambda": 3}, "parameters.lambda", "letters"),
        (parse_yaml("arm: 1e-400", ""), "parameters.arm", "1e-400"),
        ({"m": "-0.1"}, "bodies", "0 to 100000"),
        ({"m": "-0.1"}, "", "m + 0.05 = -0.05"),
    ],
)
def test_a_parameter_that_is_none_is_refused(values, field, reason):
    with pytest.raises(ParameterError) as caught:
        robot_with(**values)
    assert caught.value.field.startswith(field)
    assert reason in str(caught.value)


def test_expressions_are_no_part_of_named_mechanisms():
    data = yaml.safe_load((config_folder() / "delta.yaml").read_text())
    data["geometry"]["arm_length"] = "0.1 + 0.1"
    with pytest.raises(ParameterError, match=r"geometry\.arm_length"):
        robot_of_data(data, "own")
