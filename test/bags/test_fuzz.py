# SPDX-License-Identifier: Apache-2.0
"""Every bit of a bag, turned over: long, run by ``make fuzz``."""

import pytest

from pkm_twin.bags.reader import read_messages
from pkm_twin.errors import BagError

pytestmark = [pytest.mark.long, pytest.mark.timeout(3600)]


def test_every_bit_of_a_bag_is_covered(make_bag, tmp_path):
    whole = make_bag(tmp_path / "whole.mcap").read_bytes()
    target = tmp_path / "flipped.mcap"
    passed = []
    for bit in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << (bit % 8)
        target.write_bytes(damaged)
        try:
            for message in read_messages(target):
                assert message.message is not None
        except BagError:
            continue
        passed.append(bit)
    assert not passed


def test_every_cut_of_a_bag_is_seen(make_bag, tmp_path):
    whole = make_bag(tmp_path / "whole.mcap").read_bytes()
    target = tmp_path / "cut.mcap"
    for size in range(len(whole)):
        target.write_bytes(whole[:size])
        with pytest.raises(BagError):
            list(read_messages(target))
