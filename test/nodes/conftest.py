# SPDX-License-Identifier: Apache-2.0
"""A maker of messages of both kinds, and per module a domain, a peer and processes."""

import os

import pytest
import yaml

from delta_dynamics.virtual_work import kernels as dynamics_kernels
from pkm_twin import load
from stiffness_monitor.compliance import kernels as stiffness_kernels
from test.conftest import parameters_of
from test.nodes.harness import Domain, Maker, NodeProcess, Peer, Plain, Ros


@pytest.fixture(scope="session", params=["plain", "ros"])
def make(request):
    """Builds messages as plain attribute objects, then as real ROS messages."""
    if request.param == "ros":
        pytest.importorskip("trajectory_msgs.msg", exc_type=ImportError)
        return Maker(Ros())
    return Maker(Plain())


@pytest.fixture(scope="session")
def limitless(tmp_path_factory):
    """The Delta-CU without limits."""
    data = parameters_of("delta_cu")
    del data["limits"]
    path = tmp_path_factory.mktemp("limitless") / "limitless.yaml"
    path.write_text(yaml.safe_dump(data))
    return load(path)


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
    for kernel in (*dynamics_kernels(load("delta_cu")), *stiffness_kernels(load("upr_rpu"))):
        kernel.warm_up()
    processes = []

    def start(module, *parameters, **options):
        processes.append(NodeProcess(domain, module, *parameters, **options))
        return processes[-1]

    yield start
    for process in processes:
        process.close()
