# SPDX-License-Identifier: Apache-2.0
"""Quality of service of the suite's topics, and what of it parameters may override."""

from __future__ import annotations

from typing import Final

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy

OVERRIDES: Final = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
EXPIRY: Final = (QoSPolicyKind.LIFESPAN, QoSPolicyKind.DEADLINE)
"""QoS policies that parameters may override; the second ones of topics that expire."""


def output_qos() -> QoSProfile:
    """Reliable and volatile: a torque or a compliance is for now, never for a late joiner."""
    return QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def latched_qos() -> QoSProfile:
    """What does not change while a node runs, such as a description: late joiners get it too."""
    return QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def input_qos(depth: int, *, best_effort: bool, expiry: float | None = None) -> QoSProfile:
    """Best effort takes what publishers of both kinds send; reliable only what reliable ones do.

    :param expiry: lifespan and deadline that they have to offer, s; None is any.
    """
    kind = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
    qos = QoSProfile(depth=depth, reliability=kind)
    if expiry is not None:
        qos.lifespan = qos.deadline = Duration(seconds=expiry)
    return qos
