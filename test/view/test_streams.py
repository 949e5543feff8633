# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A recording as a time line, and the messages of running nodes."""

import numpy as np
import pytest

from pkm_twin.paths.along import compute_model_efforts
from pkm_twin.recordings import read
from pkm_twin.view import texts
from pkm_twin.view.live import TRACE_SECONDS, Live
from pkm_twin.view.timeline import MAX_CURVE_POINTS, Timeline
from stiffness_monitor import strain_energy
from test.commands.conftest import DELTA, MILLING, rewrite
from test.nodes.harness import SECOND, Maker, Plain
from test.support.robots import load

MAKE = Maker(Plain())
PLAIN = Plain()


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "sample.mcap"
    return read(rewrite(DELTA, path, seconds=1.5))


@pytest.fixture(scope="module")
def milling(tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "milling.mcap"
    return read(rewrite(MILLING, path, seconds=0.4))


def test_the_time_line_has_a_node_s_residual(recording):
    line = Timeline.from_recording(recording)
    motion = recording.with_rates()
    used = np.isin(recording.time, motion.time)
    residual = np.full_like(recording.q, np.nan)
    residual[used] = motion.effort - compute_model_efforts(motion)
    assert line.end == recording.time[-1]
    for k in np.flatnonzero(used)[:: len(used) // 7]:
        at = line.sample_at(line.time[k] + 1e-5)
        assert at.index == k
        np.testing.assert_array_equal(at.q, recording.q[k])
        np.testing.assert_array_equal(at.residual, residual[k])
        np.testing.assert_allclose(at.measured - at.twin, at.residual, rtol=0, atol=1e-15)
    assert line.sample_at(-5.0).index == 0
    assert line.sample_at(1e9).index == len(line.time) - 1
    assert line.sample_at(0.0).twin is None  # the window is not full there
    assert "&ndash;" in texts.describe_instant(recording.robot, line, line.sample_at(0.0))


def test_curves_are_finite_and_few(recording):
    line = Timeline.from_recording(recording)
    time, twin, measured = line.sample_curves()
    assert len(time) == len(twin) == len(measured) <= MAX_CURVE_POINTS
    assert np.isfinite(twin).all()
    assert np.isfinite(measured).all()
    assert (np.diff(time) > 0).all()


def test_a_recorded_wrench_comes_in_base_axes(milling):
    line = Timeline.from_recording(milling)
    assert line.sample_at(0.2).wrench is not None
    np.testing.assert_array_equal(line.sample_at(0.2).wrench, milling.wrench[line.sample_at(0.2).index])


def status_message(names, shares, dominant, total=1.0, pose=(0.1, 0.2, 0.3)):
    pairs = [*zip(names, shares, strict=True), ("total_energy", total), ("tie", "false")]
    pairs += zip("zab", pose, strict=True)
    values = [PLAIN(key=key, value=str(value)) for key, value in pairs]
    header = MAKE.header(SECOND)
    return PLAIN(header=header, status=[PLAIN(message=dominant, values=values)])


def transform(move, turn):
    x, y, z, w = turn
    rotation = PLAIN(x=x, y=y, z=z, w=w)
    inner = PLAIN(translation=PLAIN(x=move[0], y=move[1], z=move[2]), rotation=rotation)
    return PLAIN(header=MAKE.header(SECOND), transform=inner)


def test_messages_become_numbers():
    robot = load("delta_cu")
    live = Live(robot)
    names = robot.joint_names
    live.take("state", MAKE.joint_state(names[::-1], (0.3, 0.2, 0.1), stamp=SECOND))
    for k in range(40):
        effort = (1.0 + k, 2.0, 3.0)
        message = MAKE.joint_state(names, (), effort=effort, stamp=SECOND + k * SECOND)
        live.take("torque", message)
    live.take("energy", status_message(("arm I", "forearm I"), (0.75, 0.25), "arm I"))
    angle = 1e-3
    turned = (np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2))
    live.take("deflection", transform((1e-4, 0, 0), turned))
    heard = live.read_latest()
    np.testing.assert_array_equal(heard.q, (0.1, 0.2, 0.3))
    times, values = heard.traces["torque"]
    assert times[-1] == 0.0
    assert times[0] == -TRACE_SECONDS
    np.testing.assert_array_equal(values[-1], (40.0, 2.0, 3.0))
    assert heard.shares == {"arm I": 0.75, "forearm I": 0.25}
    assert heard.dominant == "arm I"
    np.testing.assert_allclose(heard.deflection, (1e-4, 0, 0, angle, 0, 0), atol=1e-12)
    assert heard.counts == {"state": 1, "torque": 40, "energy": 1, "deflection": 1}
    html = texts.describe_live_values(robot, heard, "delta_dynamics/torque_residual")
    assert 'id="live_torque_0"' in html
    assert "waiting for delta_dynamics/torque_residual" in html


def test_a_message_that_makes_no_sense_leaves_nothing_behind():
    robot = load("delta_cu")
    live = Live(robot)
    live.take("state", MAKE.joint_state(robot.joint_names, (0.1, 0.2, 0.3), stamp=SECOND))
    before = live.read_latest()
    nan = float("nan")
    for name, message in (
        ("state", MAKE.joint_state(robot.joint_names, (0.1, nan, 0.3), stamp=SECOND)),
        ("state", MAKE.joint_state(("other",), (0.1,), stamp=SECOND)),
        ("torque", MAKE.joint_state(robot.joint_names, (), effort=(1.0, 2.0), stamp=SECOND)),
        ("energy", PLAIN(header=MAKE.header(SECOND), status=[])),
        ("energy", status_message(("arm I",), ("nan",), "arm I")),
        ("deflection", transform((nan, 0, 0), (0, 0, 0, 1))),
        ("deflection", transform((0, 0, 0), (0, 0, 0, 0))),
    ):
        live.take(name, message)
    after = live.read_latest()
    assert after.rejected == 7
    assert after.reason.startswith("stiffness_monitor/deflection: ")
    np.testing.assert_array_equal(after.q, before.q)
    assert after.traces == {}
    assert after.shares == {}
    assert after.deflection is None


def test_a_bag_that_begins_anew_begins_a_new_trace():
    robot = load("delta_cu")
    live = Live(robot)
    for stamp in (5, 6, 1):
        effort = (float(stamp), 0.0, 0.0)
        live.take(
            "torque",
            MAKE.joint_state(robot.joint_names, (), effort=effort, stamp=stamp * SECOND),
        )
    assert live.read_latest().traces["torque"][1].tolist() == [[1.0, 0.0, 0.0]]


def test_the_monitors_own_status_is_understood():
    """Of a real answer: the factors come back as they were."""
    robot = load("upr_rpu")
    energy = strain_energy(robot, robot.home(), [30, -50, -40, 10, -20, 50])
    live = Live(robot)
    live.take("energy", status_message(energy.elements, energy.factors, energy.dominant))
    assert live.read_latest().shares == pytest.approx(dict(zip(energy.elements, energy.factors.tolist(), strict=True)))
