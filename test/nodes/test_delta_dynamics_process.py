# SPDX-License-Identifier: Apache-2.0
"""The process of the node delta_dynamics: signals, exceptions, a missing clock, its imports."""

import itertools
import signal
import subprocess
import sys
import threading

import pytest

from test.nodes.harness import counts_of, renamed, stamp_of, text_of, values_of

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray

from test.nodes.twin import MODULE, WINDOW, launched, state
from test.support.robots import partly_long

CALLBACKS = "_on_joint_state", "_publish_diagnostics"


class TestProcess:
    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_a_signal_in_the_middle_of_a_stream_ends_the_node(self, peer, launch, number):
        name = f"ending_{number}"
        twin = launched(peer, launch, name, fresh=True).ready()
        enough = threading.Event()

        def stream():
            # At some kHz, so that the signal comes while a callback publishes.
            while not enough.wait(0.0002):
                twin.send_state(state(peer.now(), effort=(1.0, 2.0, 3.0)))

        thread = threading.Thread(target=stream)
        thread.start()
        try:
            twin.peer.until(lambda: len(twin.received("joint_torques")) > 50)
            # A terminal and a launcher both send one.
            code = twin.process.stop(number, times=3)
        finally:
            enough.set()
            thread.join()
        assert code == 0
        assert "Traceback" not in twin.process.output

    @pytest.mark.parametrize(
        "interrupt",
        partly_long(
            itertools.product((signal.SIGINT, signal.SIGTERM), CALLBACKS),
            (signal.SIGINT, CALLBACKS[0]),
            (signal.SIGTERM, CALLBACKS[1]),
        ),
    )
    def test_a_signal_in_the_middle_of_a_callback_ends_the_node(self, peer, launch, interrupt):
        number, callback = interrupt
        code = f"""
import os, time
import numpy as np
import delta_dynamics.node as node
original = node.DeltaDynamics.{callback}
def interrupted(self, *arguments):
    os.kill(os.getpid(), {int(number)})
    time.sleep(0.05)
    # The topics are there until the callback is over, and for the node's last words.
    self._torques.publish(0, np.zeros(3))
node.DeltaDynamics.{callback} = interrupted
raise SystemExit(node.run(node.NODE))
"""
        name = f"interrupted_{number}{callback}"
        twin = launched(peer, launch, name, code=code)
        process = twin.process
        twin.peer.until(
            lambda: not process.alive(), repeat=lambda: twin.send_state(state(twin.stamp()))
        )
        assert process.wait() == 0, process.output
        assert "Traceback" not in process.output

    def test_an_exception_in_a_callback_stops_the_stream_and_not_the_node(self, peer, launch):
        code = """
import delta_dynamics.node as node
solve = node.Feedforward._joint_state
def broken(self, message, now):
    if message.position[0] == 0.125:
        raise ZeroDivisionError("made for the test")
    return solve(self, message, now)
node.Feedforward._joint_state = broken
raise SystemExit(node.run(node.NODE))
"""
        twin = launched(peer, launch, "broken", "stale_after:=5.0", code=code).ready()
        twin.stream(3, position=(0.125, 0.2, 0.3))
        array = twin.diagnostics(lambda a: values_of(a)["exceptions"] == "3")
        assert array.status[0].level == b"\x02"
        assert counts_of(array, "stopped") == {"exception": 1}
        assert twin.process.output.count("Traceback") == 1
        stamps = twin.stream(WINDOW + 3)
        assert [stamp_of(m) for m in twin.since(stamps)] == stamps[WINDOW:]
        assert twin.process.alive()

    def test_a_clock_that_never_comes_is_told(self, peer, launch):
        peer.hear(DiagnosticArray, "/diagnostics")
        process = launch(MODULE, "use_sim_time:=true", arguments=renamed("waiting"))
        array = peer.diagnostics("/waiting")
        assert "use_sim_time is set and no /clock arrives" in text_of(array)
        assert array.status[0].level == b"\x01"
        assert process.stop() == 0


class TestLayers:
    """The core knows nothing of ROS."""

    core = (
        "pkm_twin",
        "pkm_twin.bags.reader",
        "pkm_twin.errors",
        "pkm_twin.streams.monitor",
        "pkm_twin.codegen.kernels",
        "pkm_twin.robot.catalogue",
        "pkm_twin.messages.reading",
        "pkm_twin.machine.schema",
        "delta_dynamics",
        "pkm_twin.streams.differentiator",
        "pkm_twin.messages.intake",
        "delta_dynamics.feedforward",
        "delta_dynamics.gate",
        "stiffness_monitor",
        "stiffness_monitor.monitor",
    )

    def test_the_core_imports_no_rclpy(self, domain):
        code = f"import sys, {', '.join(self.core)}; sys.exit('rclpy' in sys.modules)"
        result = subprocess.run([sys.executable, "-c", code], env=domain.environment(), check=False)
        assert result.returncode == 0
