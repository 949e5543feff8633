# SPDX-License-Identifier: Apache-2.0
"""The other side of the topics takes nothing that was sent before it forgot."""

import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from std_msgs.msg import Bool


def test_what_was_sent_before_is_forgotten_though_it_arrives_later(peer):
    peer.hear(Bool, "/said")
    peer.talk(Bool, "/said")
    peer.until(peer.matched)
    peer.send("/said", Bool(data=False))
    peer.clear()
    peer.send("/said", Bool(data=True))
    peer.until(lambda: peer.received("/said"))
    assert [message.data for message in peer.received("/said")] == [True]
