# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes' own reading and writing of CDR beside the middleware's."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rclpy", exc_type=ImportError)

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from pkm_twin.bags.definitions import message_definition
from pkm_twin.errors import MessageError
from pkm_twin.messages.fast_decoder import DoublesTemplate, JointStateDecoder, RawTrajectory
from pkm_twin.messages.reading import COLUMNS, TrajectoryFields
from test.nodes.harness import Maker, Ros

MAKE = Maker(Ros())
JOINT_STATE = message_definition("sensor_msgs/msg/JointState")
NUMBERS = st.floats(allow_nan=False)
NAMES = st.lists(st.text(max_size=9).filter(lambda s: "\0" not in s), max_size=7)


def arrays(count):
    return st.lists(NUMBERS, min_size=count, max_size=count)


@st.composite
def joint_states(draw):
    count = st.integers(0, 7)
    return MAKE.joint_state(
        draw(NAMES),
        draw(arrays(draw(count))),
        draw(arrays(draw(count))),
        draw(arrays(draw(count))),
        draw(st.integers(0, 2**31 * 10**9 - 1)),
    )


@st.composite
def trajectories(draw):
    joints, points = draw(st.integers(0, 6)), draw(st.integers(0, 9))
    present = [draw(st.booleans()) for _ in range(4)]
    times = draw(st.lists(st.integers(-(2**62), 2**62), min_size=points, max_size=points))
    message = MAKE.trajectory(draw(NAMES), [t % 10**18 - 10**17 for t in times], [draw(arrays(joints))] * points)
    for point in message.points:
        for what, here in zip(COLUMNS, present, strict=True):
            setattr(point, what, draw(arrays(joints)) if here else [])
    message.header.frame_id = draw(st.sampled_from(["", "base", "longer name"]))
    return message


@settings(max_examples=60, deadline=None)
@given(st.lists(joint_states(), min_size=1, max_size=4))
def test_joint_states_come_as_the_middleware_gives_them(messages):
    decode = JointStateDecoder(JOINT_STATE)
    for message in (m for m in messages for _ in range(2)):
        view = decode(bytes(serialize_message(message)))
        for what in ("position", "velocity", "effort"):
            assert list(getattr(view, what)) == list(getattr(message, what))
        assert list(view.name) == list(message.name)
        assert view.header.frame_id == message.header.frame_id
        assert view.header.stamp.sec == message.header.stamp.sec
        assert view.header.stamp.nanosec == message.header.stamp.nanosec


@settings(max_examples=60, deadline=None)
@given(trajectories())
def test_trajectories_come_as_the_middleware_gives_them(message):
    raw = RawTrajectory.decode(bytes(serialize_message(message)))
    expected = TrajectoryFields.from_message(message)
    assert raw.fields.names == expected.names
    assert (raw.fields.times == expected.times.reshape(2, -1)).all()
    for what in COLUMNS:
        rows = [list(getattr(point, what)) for point in message.points]
        given = raw.fields.columns[what]
        assert (given is None) == (not any(rows))
        if given is not None:
            assert given.tolist() == rows


@settings(max_examples=60, deadline=None)
@given(message=trajectories(), seed=st.integers(0, 2**31))
def test_efforts_are_put_in_and_nothing_else_is_changed(message, seed):
    points = len(message.points)
    efforts = np.random.default_rng(seed).normal(size=(points, len(message.joint_names) or 1))
    raw = RawTrajectory.decode(bytes(serialize_message(message)))
    if not points:
        return
    answer = deserialize_message(raw.with_effort(efforts), JointTrajectory)
    for point, effort in zip(message.points, efforts, strict=True):
        point.effort = effort.tolist()
    assert answer == message


def test_points_of_several_lengths_are_named():
    rows = [(1.0, 2.0, 3.0)] * 5
    for what in ("positions", "velocities", "accelerations"):
        message = MAKE.trajectory("abc", range(5), rows, rows, rows)
        setattr(message.points[3], what, [1.0])
        with pytest.raises(MessageError, match=f"point 3: 1 {what}, the first point has 3"):
            RawTrajectory.decode(bytes(serialize_message(message)))


@pytest.mark.parametrize("number", [10**6, 2**32 - 1])
def test_a_count_that_no_message_holds_costs_nothing(number):
    raw = bytearray(serialize_message(MAKE.trajectory("abc", [1], [(1.0, 2.0, 3.0)])))
    at = raw.index(struct.pack("<I", 1), 30)
    raw[at : at + 4] = struct.pack("<I", number)
    with pytest.raises(MessageError):
        RawTrajectory.decode(bytes(raw))


def test_masses_of_names_are_refused_unread():
    names = ["x"] * 10**6
    for read, message, bound in (
        (JointStateDecoder(JOINT_STATE), MAKE.joint_state(names, []), "bytes, at most"),
        (RawTrajectory.decode, MAKE.trajectory(names, [1], [()]), "joint names, at most 1000"),
    ):
        with pytest.raises(MessageError, match=bound):
            read(bytes(serialize_message(message)))


@given(stamp=st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1)))
def test_a_template_is_what_the_middleware_writes(stamp):
    names = ["arm_1", "arm_2", "arm_3"]
    template = DoublesTemplate(
        "sensor_msgs/msg/JointState",
        JOINT_STATE,
        {"name": names, "position": [], "velocity": [], "effort": [0.0] * 3},
        stamped=True,
    )
    values = np.array([1.5, -math.inf, 5e-324])
    message = deserialize_message(template.fill(values, stamp), JointState)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == stamp
    assert list(message.effort) == values.tolist()
    assert list(message.name) == names
    assert len(message.position) == len(message.velocity) == 0
