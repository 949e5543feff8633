# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A maker of messages, and per module a domain, a peer and processes."""

import os
import sys

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.mechanisms.catalogue import robot_of_data
from stiffness_monitor import compliance, strain_energy
from test.nodes.harness import NODES, Command, Domain, Forked, Maker, Peer, Plain, node_words
from test.support.robots import load, parameters_of


@pytest.fixture(scope="session")
def make():
    """Builds messages as plain attribute objects, which test_messages reads as the real ones."""
    return Maker(Plain())


@pytest.fixture(scope="session")
def limitless():
    """The Delta-CU without limits."""
    data = parameters_of("delta_cu")
    del data["limits"]
    return robot_of_data(data, "limitless")


@pytest.fixture(scope="module")
def domain():
    pytest.importorskip("rclpy", exc_type=ImportError)
    domain = Domain()
    yield domain
    domain.close()


@pytest.fixture(scope="module")
def peer(domain):
    before = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE")
    peer = Peer(domain)
    yield peer
    peer.close()
    if before is None:
        del os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"]
    else:
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = before


@pytest.fixture(scope="module")
def launch(domain):
    """Start node processes that end with the module: launch(module, *parameters)."""
    # Compiled here once: two processes that find no compiled kernels would both take their time.
    delta, head = load("delta_cu"), load("upr_rpu")
    for batch in ((), (1,)):
        zero = np.zeros((*batch, 3))
        inverse_dynamics(delta, zero, zero, zero)
        delta.forward(zero)
        delta.singularity(zero)
        pose = head.forward(np.full((*batch, 3), 0.7))
        strain_energy(head, pose, np.ones(6))
        compliance(head, pose)
    yield from started(domain)


@pytest.fixture
def launch_alone(domain):
    """The same for one test: what it leaves is no other test's peer."""
    yield from started(domain)


def started(domain):
    """Gives a function that starts processes, then ends them.

    A fork is cheaper; ``fresh`` asks for an interpreter of its own, ``begin`` is called there. By
    default no message is dropped however long this machine lets it wait.
    """
    processes = []

    def start(module, *parameters, fresh=False, begin=lambda: None, **options):
        if module in NODES and not any(p.startswith("max_wait") for p in parameters):
            parameters += ("max_wait:=600.0",)
        words = node_words(module, *parameters, **options)
        if fresh:
            processes.append(Command(domain, [sys.executable, *words], begin))
        else:
            processes.append(Forked(domain, words))
        return processes[-1]

    yield start
    for process in processes:
        process.close()
