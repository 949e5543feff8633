# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a bag says of its publishers is read, or refused by the field's name."""

from __future__ import annotations

import pytest

from pkm_twin.bags.qos import MAX_TOPIC_CHARACTERS, OfferedQos, parse_qos, require_topic
from pkm_twin.bags.writer import offered_qos
from pkm_twin.errors import BagError


@pytest.mark.parametrize("reliability", ["reliable", "best_effort"])
@pytest.mark.parametrize("durability", ["volatile", "transient_local"])
def test_what_is_written_is_read(reliability: str, durability: str) -> None:
    text = offered_qos(reliability, durability, 7)
    expected = OfferedQos(reliability == "reliable", durability == "transient_local", 7)
    assert parse_qos("/t", text) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", OfferedQos()),
        (" \n", OfferedQos()),
        ("[]", OfferedQos()),
        ("- {depth: 3, reliability: 2, durability: 1}", OfferedQos(False, True, 3)),
        ("- {depth: 3}\n- {depth: 5}", OfferedQos(depth=3)),
        ("- {reliability: unknown, durability: system_default}", OfferedQos()),
    ],
)
def test_older_and_sparse_offers(text: str, expected: OfferedQos) -> None:
    assert parse_qos("/t", text) == expected


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("- {depth: .inf}", "depth is inf"),
        ("- {depth: .nan}", "depth is nan"),
        ("- {depth: -1}", "depth is -1"),
        ("- {depth: 1e99}", "depth is '1e99'"),
        ("- {depth: 99999999999}", "depth is 99999999999"),
        ("- {depth: [1]}", "depth is"),
        ("- {depth: true}", "depth is True"),
        ("- {depth: " + "9" * 6000 + "}", "the text is"),
        ("- 3", "the text is"),
        ("reliable", "the text is"),
        ("{depth: 3}", "the text is"),
        ("- [", "the text is"),
        ("&a [*a]", "the text is"),
        ("[" * 5000, "the text is"),
        ("- !!python/object/apply:os.system [ls]", "the text is"),
        ("\0", "the text is"),
        ("x" * 200_000, "length is 200000"),
    ],
)
def test_nonsense_is_refused_by_the_fields_name(text: str, field: str) -> None:
    with pytest.raises(BagError, match=f"topic /t: offered_qos_profiles: {field}") as caught:
        parse_qos("/t", text)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("name", ["/a", "/a/b_1", "/_a/B", "/a__b", "/" + "a" * 246])
def test_topic_names_that_ros_takes(name: str) -> None:
    assert require_topic(name) == name


@pytest.mark.parametrize("name", ["", "/", "a", "/a/", "//a", "/1a", "/a b", "/\u00e4", "/a\n", "~/a", "/{a}", "/a-b"])
def test_topic_names_that_it_does_not(name: str) -> None:
    with pytest.raises(BagError, match="is no topic name"):
        require_topic(name)


def test_the_longest_topic_name_is_that_of_ros() -> None:
    with pytest.raises(BagError):
        require_topic("/" + "a" * MAX_TOPIC_CHARACTERS)
    validate = pytest.importorskip("rclpy.validate_full_topic_name").validate_full_topic_name
    assert validate("/" + "a" * (MAX_TOPIC_CHARACTERS - 1))
    with pytest.raises(Exception, match="exceed"):
        validate("/" + "a" * MAX_TOPIC_CHARACTERS)
