# SPDX-License-Identifier: Apache-2.0
"""``frf`` and ``lobes`` as commands: poses that the machine cannot have are rejected."""

import json
import math

import pytest
import yaml

from test.support.command import command

MILLING = (
    "--teeth", 2, "--tangential", 600e6, "--radial", 0.3, "--speeds", "9000,10000", "--points", 2,
)  # fmt: skip


@pytest.mark.parametrize("given", [("frf",), ("lobes", *MILLING)], ids=lambda given: given[0])
def test_a_pose_beyond_the_joint_limits_is_rejected_unless_asked_for(capsys, given):
    name, *options = given
    asked = (name, "prru", "--at", "0.4,0,0", *options, "--json")
    refused = command(capsys, *asked)
    assert refused.code == 1
    assert not refused.out
    assert "slider_1" in refused.err
    answered = command(capsys, *asked, "--beyond-limits")
    assert answered.code == 0
    assert "slider_1" in answered.err
    assert json.loads(answered.out)["pose"]["z"] == 0.4


def telescope(**gimbal):
    """Three telescopic legs around a passive one whose bodies are rigid, as in a Tricept."""
    steel = {
        "youngs_modulus": 2.1e11, "shear_modulus": 8e10, "outer_diameter": 0.05,
        "inner_diameter": 0.03,
    }  # fmt: skip
    soft = {"compliance": [1e-8, 1e-8, 1e-8, math.inf, math.inf, 0.0]}
    leg = {
        "bodies": {
            "lower": {"mass": 4, "com": [0.4, 0, 0.2], "inertia": [0.1, 0.1, 0.01]},
            "upper": {
                "mass": 3, "com": [0.25, 0, 0.7], "inertia": [0.1, 0.1, 0.01],
                "member": {"from": [0.4, 0, 0], "to": [0.2, 0, 0.9], "section": steel},
            },
        },
        "joints": {
            "foot": {
                "type": "universal", "between": ["base", "lower"], "at": [0.4, 0, 0],
                "axes": [[0, 1, 0], [0.9, 0, 0.2]], **soft,
            },
            "leg": {
                "type": "prismatic", "between": ["lower", "upper"], "at": [0.4, 0, 0],
                "axis": [-0.2, 0, 0.9], "actuated": True, "home": 0.9219544,
            },
            "ball": {"type": "spherical", "between": ["upper", "head"], "at": [0.2, 0, 0.9]},
        },
        "azimuths": [0.0, 2.0943951, 4.1887902],
    }  # fmt: skip
    return {
        "mechanism": "machine", "platform": "head", "origin": [0, 0, 1.0],
        "pose": ["z", "roll", "pitch"], "modal_damping": [0.03], "limbs": leg,
        "bodies": {
            "centre": {"mass": 8, "com": [0, 0, 0.3], "inertia": [0.5, 0.5, 0.1]},
            "head": {"mass": 10, "com": [0, 0, 0.9], "inertia": [0.5, 0.5, 0.1]},
        },
        "joints": {
            "gimbal": {
                "type": "universal", "between": ["base", "centre"], "at": [0, 0, 0],
                "axes": [[1, 0, 0], [0, 1, 0]], **gimbal,
            },
            "tube": {
                "type": "prismatic", "between": ["centre", "head"], "at": [0, 0, 0.2],
                "axis": [0, 0, 1],
            },
        },
    }  # fmt: skip


@pytest.mark.parametrize("given", [("frf",), ("lobes", *MILLING)], ids=lambda given: given[0])
def test_a_platform_on_a_rigid_chain_is_rejected_with_the_joint_to_soften(capsys, tmp_path, given):
    name, *options = given
    file = tmp_path / "telescope.yaml"
    file.write_text(yaml.safe_dump(telescope()))
    refused = command(capsys, name, str(file), *options)
    assert refused.code == 1 and len(refused.err.splitlines()) == 1
    assert "joints.gimbal.compliance" in refused.err
    elastic = [1e-8, 1e-8, 1e-8, math.inf, math.inf, 1e-8]
    file.write_text(yaml.safe_dump(telescope(compliance=elastic)))
    assert command(capsys, name, str(file), *options).code == 0
