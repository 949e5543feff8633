# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Several nodes in one process and one executor."""

import signal
import subprocess
import sys

import numpy as np
import pytest

from test.nodes.harness import Command

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState

from test.nodes.twin import ROBOT, state
from test.support.robots import partly_long

COMPOSED = "from pkm_twin.apps.nodes import composed; composed()"


def program(*words):
    return [sys.executable, "-c", COMPOSED, *words]


@pytest.mark.parametrize("executor", partly_long(["single", "events"], "events"))
def test_nodes_of_one_process_answer_with_their_own_parameters_and_end_together(domain, peer, executor):
    space = f"of_{executor}"
    words = ["-r", f"__ns:=/{space}", "-p", "mechanism:=delta_cu", "-p", f"executor:={executor}"]
    for word in ("stale_after:=30.0", "acceleration:=differentiate"):
        words += ["-p", f"delta_dynamics:{word}"]
    process = Command(domain, program("delta_dynamics", "machine_state", "--ros-args", *words))
    try:
        peer.hear(JointState, f"/{space}/delta_dynamics/joint_torques")
        peer.hear(PoseStamped, f"/{space}/machine_state/pose")
        peer.hear(DiagnosticArray, "/diagnostics")
        peer.talk(JointState, f"/{space}/joint_states")

        def answered():
            assert process.alive(), process.output
            return all(
                peer.received(f"/{space}/{topic}") for topic in ("delta_dynamics/joint_torques", "machine_state/pose")
            )

        peer.until(answered, repeat=lambda: peer.send(f"/{space}/joint_states", state(peer.now())))
        torques = peer.received(f"/{space}/delta_dynamics/joint_torques")[-1]
        assert tuple(torques.name) == tuple(ROBOT.joint_names)
        assert np.isfinite(torques.effort).all()
        # A stream of an unknown parameter's node would not have started.
        for name in ("delta_dynamics", "machine_state"):
            peer.diagnostics(f"/{space}/{name}")
        assert process.stop(signal.SIGINT, times=2) == 0, process.output
        assert "Traceback" not in process.output
    finally:
        process.close()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "delta_dynamics"),
        (("command_gate",), "command_gate"),
        (("machine_state", "machine_state"), "each once"),
        (("machine_stat",), "composed machine_stat"),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_line(domain, words, said):
    done = subprocess.run(program(*words), env=domain.environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert said in line
