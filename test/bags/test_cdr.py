# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Message definitions and their encoding, against rclpy and mcap_ros2 as independent readers."""

from __future__ import annotations

import array
import math
import struct
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.definitions import (
    Field,
    live_type_name,
    message_class,
    message_definition,
    parse_definition,
)
from pkm_twin.errors import BagError

HEADER = {"stamp": {"sec": -5, "nanosec": 7}, "frame_id": "häuser"}
VALUES: dict[str, dict[str, Any]] = {
    "sensor_msgs/msg/JointState": {
        "header": HEADER,
        "name": ["a", "", "bcd"],
        "position": [1.5, -2.0, math.inf],
        "effort": [0.25],
    },
    "trajectory_msgs/msg/JointTrajectory": {
        "header": HEADER,
        "joint_names": ["a"],
        "points": [
            {"positions": [1.0], "time_from_start": {"sec": 1, "nanosec": 2}},
            {"effort": [3.0], "time_from_start": {"sec": 2, "nanosec": 0}},
        ],
    },
    "geometry_msgs/msg/WrenchStamped": {
        "header": HEADER,
        "wrench": {"force": {"x": 1.0, "y": 2.0, "z": 3.0}, "torque": {"x": -1.0}},
    },
    "std_msgs/msg/Float64MultiArray": {
        "layout": {"dim": [{"label": "row", "size": 6, "stride": 36}], "data_offset": 1},
        "data": [float(i) for i in range(36)],
    },
    "diagnostic_msgs/msg/DiagnosticArray": {
        "header": HEADER,
        "status": [{"level": b"\x02", "name": "n", "message": "m", "values": [{"key": "k", "value": "v"}]}],
    },
    "std_msgs/msg/String": {"data": "text"},
    "geometry_msgs/msg/TransformStamped": {
        "header": HEADER,
        "child_frame_id": "c",
        "transform": {"translation": {"x": 1.0}, "rotation": {"w": 1.0}},
    },
    "rosgraph_msgs/msg/Clock": {"clock": {"sec": 3, "nanosec": 4}},
    "geometry_msgs/msg/PoseWithCovariance": {
        "pose": {"orientation": {"w": 1.0}},
        "covariance": [i / 7 for i in range(36)],
    },
    "std_msgs/msg/Empty": {},
    "std_msgs/msg/ByteMultiArray": {"data": [b"\x01", b"\xff"]},
}


def plain(value: Any) -> Any:
    """Turn any kind of message into dicts and lists."""
    if isinstance(value, bytes):
        return list(value) if len(value) != 1 else value[0]
    if isinstance(value, str | float | int):
        return value
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "get_fields_and_field_types"):
        names = list(value.get_fields_and_field_types())
    else:
        names = list(value.__slots__)
    return {name: plain(getattr(value, name)) for name in names}


def live(kind: str, values: dict[str, Any]) -> Any:
    """Make a live message of nested values."""
    message = message_class(kind)()
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        spec = types[name].removeprefix("sequence<").removesuffix(">")
        if "/" in spec:
            package, short = spec.split("/")
            items = value if isinstance(value, list) else [value]
            made = [live(f"{package}/msg/{short}", item) for item in items]
            setattr(message, name, made if isinstance(value, list) else made[0])
        else:
            setattr(message, name, value)
    return message


@pytest.fixture
def codec(request: pytest.FixtureRequest) -> MessageCodec:
    pytest.importorskip("sensor_msgs")
    return MessageCodec(request.param, message_definition(request.param))


@pytest.mark.parametrize(("codec", "kind"), [(k, k) for k in VALUES], indirect=["codec"])
class TestAgainstOtherReaders:
    def test_rclpy_reads_what_we_write(self, codec: MessageCodec, kind: str) -> None:
        serialization = pytest.importorskip("rclpy.serialization")
        found = serialization.deserialize_message(codec.encode(VALUES[kind]), message_class(kind))
        assert plain(found) == plain(live(kind, VALUES[kind]))

    def test_we_read_what_rclpy_writes(self, codec: MessageCodec, kind: str) -> None:
        serialization = pytest.importorskip("rclpy.serialization")
        message = live(kind, VALUES[kind])
        found = codec.decode(serialization.serialize_message(message))
        assert plain(found) == plain(message)
        assert codec.decode(codec.encode(message)) == found
        assert type(found).__name__ == type(message).__name__

    def test_mcap_ros2_reads_our_definition_and_bytes(self, codec: MessageCodec, kind: str) -> None:
        dynamic = pytest.importorskip("mcap_ros2._dynamic")
        text = message_definition(kind)
        data = codec.encode(VALUES[kind])
        assert plain(dynamic.generate_dynamic(kind, text)[kind](data)) == plain(codec.decode(data))
        if "Byte" in kind or "Diagnostic" in kind:
            return  # mcap_ros2 does not write single octets
        assert codec.decode(dynamic.serialize_dynamic(kind, text)[kind](VALUES[kind])) == (codec.decode(data))

    def test_truncation_is_an_error_at_every_length(self, codec: MessageCodec, kind: str) -> None:
        data = codec.encode(VALUES[kind])
        for length in range(len(data)):
            with pytest.raises(BagError) as caught:
                codec.decode(data[:length])
            assert caught.value.reason == "cdr"

    def test_values_have_the_types_of_live_ones(self, codec: MessageCodec, kind: str) -> None:
        def compare(ours: Any, theirs: Any) -> None:
            for name in theirs.get_fields_and_field_types():
                one, other = getattr(ours, name), getattr(theirs, name)
                if hasattr(other, "get_fields_and_field_types"):
                    compare(one, other)
                elif isinstance(other, array.array):
                    assert isinstance(one, array.array) and one.typecode == other.typecode
                elif isinstance(other, list | str | bytes | int | float):
                    assert type(one) is type(other)

        compare(codec.decode(codec.encode(VALUES[kind])), live(kind, VALUES[kind]))


numbers = st.integers(0, 2**32 - 1)


@settings(max_examples=100, deadline=None)
@given(
    texts=st.lists(st.text(st.characters(exclude_categories=("Cs",))), max_size=4),
    reals=st.lists(st.floats(allow_nan=False), max_size=5),
    number=numbers,
    flag=st.booleans(),
)
def test_what_is_encoded_is_decoded(texts: list[str], reals: list[float], number: int, flag: bool) -> None:
    codec = MessageCodec("a/msg/T", "bool flag\nstring[] texts\nuint32 number\nfloat64[] reals")
    values = {"flag": flag, "texts": texts, "number": number, "reals": reals}
    found = codec.decode(codec.encode(values))
    assert (found.flag, found.texts, found.number, list(found.reals)) == tuple(values.values())
    assert codec.decode(codec.encode(SimpleNamespace(**values))) == found


def test_big_endian() -> None:
    codec = MessageCodec("a/msg/T", "uint8 a\nfloat64 b\nint16[] c")
    data = b"\x00\x00\x00\x00" + struct.pack(">BxxxxxxxdIhh", 7, 1.5, 2, -1, 300)
    found = codec.decode(data)
    assert (found.a, found.b, list(found.c)) == (7, 1.5, [-1, 300])


def test_definition_text() -> None:
    pytest.importorskip("sensor_msgs")
    first, header, stamp = message_definition("rosgraph_msgs/msg/Clock").partition("=" * 80)
    assert first == "builtin_interfaces/Time clock\n" and header == "=" * 80
    assert stamp == "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    assert "float64[36] covariance" in message_definition("geometry_msgs/msg/PoseWithCovariance")


def test_definitions_as_rosbag2_records_them() -> None:
    """With comments, constants, defaults, bounds, bare names and long type names."""
    text = (
        '# A comment\n\nuint8 OK=0\nstring NAME = "with # sign"  # why\n'
        "Header header # bare\nfloat64 x 1.5\nstring<=5[<=3] names\nint32[] list [1, 2]\n"
        "Part part\nbuiltin_interfaces/Duration wait\n"
        "================================================================================\n"
        "MSG: std_msgs/msg/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        "================================================================================\n"
        "MSG: some_msgs/Part\nbyte[4] b\n"
    )
    definition = parse_definition("some_msgs/msg/Thing", text)
    assert next(iter(definition)) == "some_msgs/Thing"
    assert definition["some_msgs/Thing"] == (
        Field("header", "std_msgs/Header"),
        Field("x", "float64"),
        Field("names", "string", 3, True, 5),
        Field("list", "int32", 0),
        Field("part", "some_msgs/Part"),
        Field("wait", "builtin_interfaces/Duration"),
    )
    assert definition["some_msgs/Part"] == (Field("b", "byte", 4),)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("what?", "is not a field"),
        ("other/Type x", "no definition of other/Type, which a/T contains"),
        ("P p\n===\nMSG: a/P\nP p", "a/P contains itself"),
        ("T t", "a/T contains itself"),
        ("wstring w", "wstring"),
        ("int8 a\n===\nint8 b", "not 'MSG:'"),
        ("int8 a\nint8 a", "cannot be attributes"),
        ("int8 class", "cannot be attributes"),
    ],
)
def test_definitions_that_are_refused(text: str, expected: str) -> None:
    with pytest.raises(BagError, match=expected) as caught:
        MessageCodec("a/msg/T", text)
    assert caught.value.reason == "schema"


@pytest.mark.parametrize(
    ("text", "values", "expected"),
    [
        ("int8 a", {"a": 128}, r"a/msg/T\.a is 128"),
        ("uint8 a", {"a": "x"}, r"a/msg/T\.a is 'x'"),
        ("float64[2] a", {"a": [1.0]}, "has 1 items; expected 2"),
        ("float64[<=2] a", {"a": [1.0] * 3}, "has 3 items; expected at most 2"),
        ("float64[] a", {"a": 1.0}, "expected a sequence"),
        ("string[] a", {"a": "text"}, "expected a sequence"),
        ("string a", {"a": 1}, "expected text"),
        ("string<=2 a", {"a": "abc"}, "has 3 characters; at most 2"),
        ("int8 a", {"b": 1}, "has no field b; fields: a"),
        ("int8 a", SimpleNamespace(b=1), "without a"),
    ],
)
def test_values_that_are_refused(text: str, values: Any, expected: str) -> None:
    with pytest.raises(BagError, match=expected) as caught:
        MessageCodec("a/msg/T", text).encode(values)
    assert caught.value.reason == "message"


def test_bounds_hold_in_decoding() -> None:
    data = MessageCodec("a/msg/T", "int8[] a").encode({"a": [1, 2, 3]})
    with pytest.raises(BagError, match="field a has 3 items; at most 2"):
        MessageCodec("a/msg/T", "int8[<=2] a").decode(data)


@pytest.mark.parametrize("kind", ["String", "std_msgs/String", "std_msgs/msg/Strings", "no/msg/T"])
def test_unknown_types(kind: str) -> None:
    with pytest.raises(BagError) as caught:
        message_definition(kind) if kind.count("/") != 1 else message_class(kind)
    assert caught.value.reason == "type"


def test_live_type_name() -> None:
    pytest.importorskip("sensor_msgs")
    name = "sensor_msgs/msg/JointState"
    assert live_type_name(message_class(name)()) == name
    assert live_type_name({}) is None
