# SPDX-License-Identifier: Apache-2.0
"""What the 3-PRRU head rejects: what is out of reach, singular, or no parameter; defaults."""

from __future__ import annotations

import math

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError, SingularityError, UnreachableError
from pkm_twin.machine import schema
from pkm_twin.mechanisms.prru import Prru
from test.laws.prru_heads import LENGTHS, MACHINES, MASSES, TIMES, Motion, machine, place, sliders


@pytest.mark.parametrize("away", [[0.5, -0.2, -0.3], [-0.4, 0.3, 0.1]])
def test_miss_is_what_the_slider_has_to_come_back(away: list[float]) -> None:
    """Back by the miss (towards the mean height) the machine can be assembled, short of it not."""
    robot = machine("paper")
    level = robot.inverse([0.7, 0.0, 0.0])
    with pytest.raises(UnreachableError) as caught:
        robot.forward(level + away)
    assert caught.value.limb == "limb I"
    edge = 1.0 - caught.value.miss / abs(away[0])
    robot.forward(level + np.array(away) * (edge - 1e-5))
    with pytest.raises(UnreachableError):
        robot.forward(level + np.array(away) * (edge + 1e-5))


def test_pose_beyond_the_limb() -> None:
    robot = machine("paper", geometry={"limb_length": 0.15})
    pose = np.array([0.7, 0.0, 1.0])
    _, _, ends = place(robot, pose[None])
    away = np.linalg.norm(ends[0, :, :2] - sliders(robot, np.zeros((1, 3)))[0, :, :2], axis=-1)
    with pytest.raises(UnreachableError) as caught:
        robot.inverse(pose)
    limb = robot.limb_names.index(caught.value.limb)
    assert caught.value.miss == pytest.approx(away[limb] - 0.15, abs=1e-13)
    assert caught.value.miss > 0.0


@pytest.mark.parametrize("pose", [[0.7, 0.0, 1.3], [0.7, -1.3, 0.0], [0.7, math.pi, 0.0]])
def test_pose_beyond_the_singularity(pose: list[float]) -> None:
    with pytest.raises(SingularityError) as caught:
        machine("paper").inverse(pose)
    assert caught.value.measure < caught.value.bound


@pytest.mark.parametrize("value", [1e9, 1e160, 1e300])
def test_huge_values_end_in_a_fault(value: float) -> None:
    robot = machine("paper")
    for q in ([0.1, 0.1, value], [0.1, -value, value]):
        with pytest.raises(ValueError, match=r"unreachable|not finite"):
            robot.forward(q)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("geometry", "azimuths", [0.0, 0.0, 2.0]),
        ("geometry", "azimuths", [0.0, 2.0, 2.0 + 2 * math.pi]),
        ("geometry", "limb_length", 0.05),
        ("geometry", "branch", "beside"),
        ("inertia", "link_com", 1.5),
        ("inertia", "slider_mass", -1.0),
        ("inertia", "upper_link_inertia", [0.1, 0.3]),
        ("inertia", "platform_inertia", [0.1, 0.1, 0.5]),
    ],
)
def test_refused_parameters(section: str, key: str, value: object) -> None:
    robot = machine("paper")
    data = {
        "mechanism": "prru",
        "geometry": LENGTHS | MACHINES["paper"],
        "inertia": dict.fromkeys(MASSES, 1.0),
    }
    assert schema.build(Prru, data).joint_names == robot.joint_names
    data[section][key] = value  # type: ignore[index]
    with pytest.raises(ParameterError) as caught:
        schema.build(Prru, data)
    assert caught.value.field.startswith(f"{section}.{key}")


def test_defaults_are_thin_rods_and_a_thin_disc() -> None:
    """Left out, the inertias are those of rods and a disc with the masses given."""
    full = machine(
        "paper",
        link_com=0.5,
        lower_link_inertia=[3.5 * 0.36 / 12, 0.0],
        upper_link_inertia=[2.5 * 0.36 / 12, 0.0],
        platform_com=[0.0, 0.0, 0.0],
        platform_inertia=[25 * 0.0625 / 4, 25 * 0.0625 / 4, 25 * 0.0625 / 2],
    )
    short = schema.build(
        Prru,
        {"mechanism": "prru", "geometry": LENGTHS | MACHINES["paper"], "inertia": MASSES},
    )
    state = Motion(short, 9)(TIMES)
    full = full.changed(payload={"mass": 0.0, "inertia": [0.0, 0.0, 0.0]})
    np.testing.assert_allclose(
        inverse_dynamics(short, *state), inverse_dynamics(full, *state), rtol=1e-12
    )
