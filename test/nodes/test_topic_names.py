# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Every joint's name has a legal topic, and texts of rejections name their reason once."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from delta_dynamics import reactions
from pkm_twin import robot_names
from pkm_twin.errors import MessageError
from pkm_twin.streams.topics import make_topic_tokens
from test.support.robots import load


@example(names=["1U", "left-1", "left_1", "é", "e", "", "/", "a__b", "a b", "関節", "_x", "x_"])
@given(names=st.lists(st.text(max_size=8), max_size=12, unique=True))
def test_every_name_has_a_legal_token_of_its_own(names):
    validate = pytest.importorskip("rclpy.validate_full_topic_name", exc_type=ImportError)
    tokens = make_topic_tokens(names)
    assert list(tokens) == names
    assert len(set(tokens.values())) == len(names)
    for token in tokens.values():
        assert validate.validate_full_topic_name(f"/delta_dynamics/reactions/{token}")
        assert "__" not in token and not token.startswith("_")


def test_names_that_are_legal_but_for_spaces_stay():
    names = ["arm_1", "base joint I", "U joint 1"]
    assert list(make_topic_tokens(names).values()) == ["arm_1", "base_joint_I", "U_joint_1"]


@pytest.mark.parametrize("name", robot_names())
def test_a_node_publishes_the_reactions_of_every_robot(name, peer, launch):
    pytest.importorskip("rclpy", exc_type=ImportError)
    robot = load(name)
    q = robot.inverse(robot.home())
    try:
        names = reactions(robot, q, 0 * q, 0 * q).names
    except ValueError:
        pytest.skip("no masses")
    process = launch(
        "delta_dynamics.nodes.twin",
        f"mechanism:={name}",
        "publish_reactions:=true",
        arguments=["-r", f"__node:=of_{name}"],
    )
    tokens = make_topic_tokens(names).values()

    def published():
        assert process.alive(), process.output
        return all(peer.node.count_publishers(f"/of_{name}/reactions/{t}") for t in tokens)

    peer.until(published)
    process.stop()


@pytest.mark.parametrize(
    ("reason", "text", "said"),
    [
        ("no pose", "no pose: no joint state has arrived", "no pose: no joint state has arrived"),
        ("limit", "arm_1 is 3 rad", "limit: arm_1 is 3 rad"),
    ],
)
def test_a_rejection_names_its_reason_once(reason, text, said):
    assert MessageError(reason, text).labelled == said
