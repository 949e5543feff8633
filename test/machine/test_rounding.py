# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Files whose numbers are rounded need the efforts of the exact ones, or are rejected."""

import math
import re
import warnings

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin import robot_names
from pkm_twin.errors import MobilityError, ParameterError
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.robot_urdf import robot_description, robot_mjcf, robot_sdf, robot_urdf
from test.support.robots import load, partly_long
from tools.pages.robots import GALLERY

from .random_machines import MACHINES as OWN_MACHINES
from .random_machines import plain, variant

pytestmark = [
    pytest.mark.usefixtures("quickly_compiled"),
    pytest.mark.filterwarnings("ignore::pkm_twin.errors.RobotWarning"),
]
NUMBER = re.compile(r"(?<![\w.])(?<!version=.)[-+]?\d+\.\d+(?:e[-+]?\d+)?(?![\w.])")
WRITERS = {
    "urdf": robot_urdf,
    "xml": robot_mjcf,
    "sdf": robot_sdf,
    "yaml": lambda robot: yaml.safe_dump(robot_description(robot), sort_keys=False),
}
"""How a robot is written, by the ending of the file."""
AMPLIFIED = 3000.0
"""How far efforts may be off, of the largest and in units of the last digit, at small motions."""
STATES = 3


def wrist():
    """Three coaxial motors turn a platform about a point through bent branches.

    One branch ends in a hinge through the point, the others in balls, which stay on spheres.
    """
    centre = np.array([0.0, 0.0, 0.2])
    data = {
        "mechanism": "machine",
        "gravity": [0.0, 0.0, -9.81],
        "platform": "platform",
        "bodies": {"platform": {"mass": 1.1, "com": [0.01, 0.02, 0.23], "inertia": [2e-3, 3e-3, 2.5e-3]}},
        "joints": {},
    }
    for k in range(3):
        turn = 2.0 * math.pi * k / 3.0 + 0.35
        bent = np.array([math.cos(turn), math.sin(turn), 0.9])
        end = np.array([math.cos(turn + 1.0), math.sin(turn + 1.0), -0.3])
        bent, end = bent / np.linalg.norm(bent), end / np.linalg.norm(end)
        data["bodies"] |= {
            f"ring_{k}": {"mass": 1.2, "com": [0.01, 0.0, 0.05], "inertia": [2e-3, 2e-3, 3.6e-3]},
            f"branch_{k}": {
                "mass": 0.08,
                "com": (centre + 0.05 * (bent + end)).tolist(),
                "inertia": [1e-4, 1e-4, 1.5e-4],
            },
        }
        data["joints"] |= {
            f"motor_{k}": {
                "type": "revolute",
                "between": ["base", f"ring_{k}"],
                "actuated": True,
                "at": [0.0, 0.0, 0.05 + 0.03 * k],
                "axis": [0.0, 0.0, 1.0],
                "rotor_inertia": 5e-3,
            },
            f"bend_{k}": {
                "type": "revolute",
                "between": [f"ring_{k}", f"branch_{k}"],
                "at": (centre + 0.09 * bent).tolist(),
                "axis": bent.tolist(),
            },
            f"end_{k}": {
                "type": "spherical",
                "between": [f"branch_{k}", "platform"],
                "at": (centre + 0.12 * end).tolist(),
            }
            | ({} if k else {"type": "revolute", "axis": end.tolist()}),
        }
    return robot_of_data(data, "wrist")


MACHINES = {
    **{path.stem: lambda path=path: load(path) for path in GALLERY},
    **{name: lambda name=name: load(name) for name in robot_names()},
    **{
        path.stem: lambda path=path: robot_of_data(plain(path.stem), path.stem)
        for path in sorted(OWN_MACHINES.glob("*.yaml"))
    },
    "wrist": wrist,
}
FORMATS = {"significant": "{:.{}g}", "decimals": "{:.{}f}"}


def rounded(text, digits, how="significant"):
    """Every number of a text with fewer digits."""
    return NUMBER.sub(lambda found: FORMATS[how].format(float(found[0]), digits), text)


def read(folder, text, ending):
    """The robot of a file."""
    path = folder / f"machine_{abs(hash(text))}.{ending}"
    path.write_text(text)
    return load(path, **({} if ending == "yaml" else {"platform": "platform"}))


def efforts(robot, names, states):
    """Efforts by joint, of states whose joints have these names, shape (3, k, n)."""
    order = [names.index(name) for name in robot.joint_names]
    found = inverse_dynamics(robot, *(part[:, order] for part in states))
    return {name: found[:, k] for k, name in enumerate(robot.joint_names)}


def check_rejection(error):
    """Check that an error names what rounding took: freedoms, a closed loop or a body's inertia."""
    if isinstance(error, MobilityError):
        assert error.causes, error
    else:
        assert re.search("open by|inertia", str(error)), error


CASES = [(name, ending) for name in MACHINES for ending in WRITERS]
SAMPLE = [("agile_eye", "yaml"), ("wrist", "urdf")]
DIGITS = partly_long((5, 6, 7, 8), 6)


@pytest.mark.parametrize("how", partly_long(FORMATS, "significant"))
@pytest.mark.parametrize("digits", DIGITS)
@pytest.mark.parametrize("case", partly_long(CASES, *SAMPLE), ids="-".join)
def test_a_rounded_file_needs_the_efforts_of_the_exact_one(case, digits, how, tmp_path):
    name, ending = case
    robot = MACHINES[name]()
    try:
        text = WRITERS[ending](robot)
    except ParameterError as error:
        pytest.skip(str(error))
    exact = read(tmp_path, text, ending)
    rng = np.random.default_rng(0)
    home = exact.inverse(exact.home())
    size = min(1.0, robot.graph.size)
    q = home + rng.uniform(-0.02, 0.02, (STATES, len(home))) * size
    states = exact.project_redundant(q, *rng.normal(size=(2, *q.shape)))
    expected = efforts(exact, exact.joint_names, states)
    try:
        other = read(tmp_path, rounded(text, digits, how), ending)
    except ParameterError as error:
        check_rejection(error)
        # Five decimals leave two digits of an inertia of 4e-4 kg m2, which may be none of a body.
        assert case not in SAMPLE or "inertia" in str(error), error
        return
    assert len(other.coordinates) == len(exact.coordinates)
    found = efforts(other, exact.joint_names, states)
    largest = max(np.abs(part).max() for part in expected.values())
    for joint, wanted in expected.items():
        bound = AMPLIFIED * 10.0**-digits * largest
        np.testing.assert_allclose(found[joint], wanted, 0.0, bound)


@pytest.mark.parametrize("seed", partly_long(range(6), 0))
@pytest.mark.parametrize("case", partly_long([("five_bar", "xml"), ("hinged_platform", "sdf")], ("five_bar", "xml")))
def test_a_file_of_which_some_lines_have_fewer_digits_stands_as_drawn(case, seed, tmp_path):
    """A machine of other dimensions: each tenth line has four digits, the others eight."""
    name, ending = case
    text = WRITERS[ending](robot_of_data(variant(name, np.random.default_rng(seed)), name))
    mixed = "\n".join(rounded(line, 8 if k % 10 else 4) for k, line in enumerate(text.split("\n")))
    exact = read(tmp_path, text, ending)
    try:
        other = read(tmp_path, mixed, ending)
    except ParameterError as error:
        check_rejection(error)
        assert case != ("five_bar", "xml"), error
        return
    np.testing.assert_allclose(other.graph.origin, exact.graph.origin, 0.0, 2e-4)


@pytest.mark.parametrize("ending", partly_long(("urdf", "xml", "sdf"), "xml"))
def test_home_is_as_drawn_and_the_pose_is_what_the_platform_moves_in(ending, tmp_path):
    robot = MACHINES["agile_eye"]()
    other = read(tmp_path, rounded(WRITERS[ending](robot), 6), ending)
    assert other.home_choice.startswith("as drawn")
    assert other.pose_names == ("roll", "pitch", "yaw")
    np.testing.assert_allclose(other.passive(other.inverse(other.home())), 0.0, atol=1e-12)


@pytest.mark.parametrize("ending", partly_long(WRITERS, "xml"))
def test_what_only_turns_about_a_point_has_angles_for_a_pose(ending, tmp_path):
    """The wrist's reference point is beside its centre and moves too."""
    text = WRITERS[ending](MACHINES["wrist"]())
    for digits in (6, 15):
        other = read(tmp_path, rounded(text, digits), ending)
        assert other.pose_names == ("roll", "pitch", "yaw")
        assert np.linalg.norm(other.graph.origin - [0.0, 0.0, 0.2]) > 0.01


def test_what_rounding_moved_is_said(tmp_path):
    text = rounded(WRITERS["xml"](MACHINES["wrist"]()), 6)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        read(tmp_path, text, "xml")
    assert any("were moved by up to" in str(one.message) for one in told)


def test_axes_that_are_farther_off_than_the_files_digits_are_named(tmp_path):
    data = robot_description(MACHINES["wrist"]())
    data["joints"]["bend_1"]["at"][0] += 3e-4
    with pytest.raises(MobilityError) as error:
        robot_of_data(data, "bent")
    assert error.value.freedoms < error.value.actuated
    assert any("bend_1" in cause for cause in error.value.causes)


def test_more_motors_than_freedoms_are_said_first(tmp_path):
    robot = MACHINES["rrr4_planar"]()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        other = read(tmp_path, WRITERS["urdf"](robot), "urdf")
    about = [str(one.message) for one in told if "machine_" in str(one.filename)]
    assert about[0].startswith("4 actuated joints (ros2_control) for 3 degrees of freedom")
    assert "4 actuated joints for 3 degrees of freedom" in other.description


@pytest.mark.parametrize("character", ["\x01", "\n", "\x7f", "\ufffe", "\ud800"])
@pytest.mark.parametrize("kind", ["bodies", "joints"])
def test_a_name_of_unprintable_characters_is_rejected(kind, character):
    """XML has no place for them, and no parser takes what would be written."""
    data = plain("four_bar")
    first = next(iter(data[kind]))
    data[kind][f"a{character}b"] = data[kind].pop(first)
    with pytest.raises(ParameterError, match="printable") as error:
        robot_of_data(data, "named")
    assert error.value.field == kind
