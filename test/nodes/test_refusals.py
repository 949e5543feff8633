# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Nodes that refuse their parameters: one line each, and exit code 1."""

import json
import subprocess
import sys
from importlib.util import find_spec

import pytest
import yaml

from pkm_twin.apps.nodes import MODULES
from test.support.robots import parameters_of

pytest.importorskip("rclpy", exc_type=ImportError)

CASES = {
    "delta_dynamics": [
        ("payload.masss:=0.1", "did you mean 'payload.mass'"),
        ("stale_afer:=0.1 trip_cont:=3", "did you mean 'stale_after'?", "mean 'trip_count'?"),
        ("mechanism:=delta_uc", "did you mean 'delta_cu'"),
        ("mechanism:=/nonexistent/robot.yaml", "/nonexistent/robot.yaml"),
        ("payload.mass:=.nan", "payload.mass: nan"),
        ("payload.mass:=heavy", "payload.mass: 'heavy'"),
        ("gravity:=[0.0,0.0,.nan]", "gravity[2]: nan"),
        ("stale_after:=.nan", "stale_after: nan"),
        ("singularity_warn:=.nan", "singularity_warn: nan"),
        ("singularity_stop:=0.2", "at least singularity_stop, 0.2"),
        ("limit_policy:=clip", "did you mean 'clamp'"),
        ("acceleration:=guess", "acceleration: 'guess'"),
        ("publish_commands:=true", "on_stop: missing"),
        ("use_sim_time:=maybe", "use_sim_time"),
        ("executor:=many", "events, single"),
        ("queue_depth:=0", "queue_depth: 0; expected 1 to 100000"),
        ("qos_overrides./joint_states.subscription.reliability:=best", "`reliability`"),
        (
            "qos_overrides./delta_dynamics/joint_torques.publisher.lifespan:=0",
            "joint_torques.publisher.lifespan: 0; expected 1 ns or more",
        ),
        (
            "qos_overrides./delta_dynamics/joint_torques.publisher.deadline:=-5",
            "joint_torques.publisher.deadline: -5",
        ),
    ],
    "command_gate": [
        ("on_stop:=nothing", "on_stop: 'nothing'"),
        ("on_stop:=gravty", "did you mean 'gravity'"),
        ("deadline:=0.0", "deadline: 0.0"),
        ("deadline:=.nan", "deadline: nan"),
        ("mechanism:=delta_uc", "did you mean 'delta_cu'"),
        ("effort_limits:=[1.0,.nan,1.0]", "effort[1]: nan"),
        ("deadlin:=0.2", "did you mean 'deadline'"),
    ],
    "stiffness_monitor": [
        ("wrench_fram:=tool0", "did you mean 'wrench_frame'"),
        ("max_state_age:=.nan", "max_state_age: nan"),
        ("wrench_frame:=''", "wrench_frame: ''"),
        ("accept_empty_frame:=1", "accept_empty_frame: 1"),
        ("frequencies_rate:=-1.0", "frequencies_rate"),
        ("mechanism:=RIGID", "members"),
    ],
    "machine_state": [
        ("mechanism:=five_bar publish_tf:=some", "publish_tf"),
        *([] if find_spec("tf2_ros") else [("use_tf:=true", "use_tf")]),
    ],
    "machine_sim": [
        ("start:=[0.0,2.0,0.0]", "start, arm_2: 2.0; expected -0.9 to 1.3"),
        ("use_sim_time:=true", "use_sim_time: True; expected false"),
        ("payload.masses:=[1.0,2.0]", "payload.masses"),
        ("bandwidth:=10.0 period:=0.01", "bandwidth: 10.0; expected at most 3.5 Hz"),
    ],
}
"""By node: its parameters, and what its lines name."""
ALL = [(node, *case) for node, cases in CASES.items() for case in cases]
PROGRAM = """
import contextlib, faulthandler, importlib, json, sys, tempfile
import rclpy
from pkm_twin.ros.run import run
told = []
for module, arguments in json.load(sys.stdin):
    with tempfile.TemporaryFile("w+") as said, contextlib.redirect_stderr(said):
        code = run(importlib.import_module(module).NODE, arguments=["node", *arguments])
        faulthandler.cancel_dump_traceback_later()
        said.seek(0)
        told.append([code, said.read()])
    rclpy.utilities.g_default_context = None
json.dump(told, sys.stdout)
"""
"""Each as a process would run it, one after the other in this one."""


@pytest.fixture(scope="module")
def told(domain, tmp_path_factory):
    """Exit code and lines of every case."""
    data = parameters_of("delta_cu")
    del data["members"]
    rigid = tmp_path_factory.mktemp("refused") / "rigid.yaml"
    rigid.write_text(yaml.safe_dump(data))
    asked = []
    for node, parameters, *_ in ALL:
        words = [word.replace("RIGID", str(rigid)) for word in parameters.split()]
        pairs = [word for parameter in words for word in ("-p", parameter)]
        asked.append([MODULES[node], ["--ros-args", *pairs]])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        input=json.dumps(asked),
        env=domain.environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return dict(zip(((node, given) for node, given, *_ in ALL), json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("case", ALL, ids=lambda case: f"{case[0]}-{case[1]}")
def test_a_bad_configuration_is_refused_in_a_line_each(told, case):
    node, parameters, *named = case
    code, text = told[node, parameters]
    lines = text.strip().splitlines()
    assert code == 1 and len(lines) == len(named), text
    for line, word in zip(lines, named, strict=True):
        assert line.startswith("cannot start: ")
        assert word in line
