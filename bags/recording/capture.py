# SPDX-License-Identifier: Apache-2.0
"""What the recordings have in common: parameters, clock, sensors, and the bag they end in.

May import: numpy, yaml, pkm_twin.bags (the writer only), the standard library.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from pkm_twin.bags.reader import BagWriter

Array = NDArray[np.float64]
Progress = Callable[[float], None]
"""Called with the fraction of a recording that is done."""

CONFIG: Final = Path(__file__).resolve().parents[2] / "config"
EPOCH_NS: Final = 1_700_000_000_000_000_000
"""Simulated time zero as a ROS time, ns: 2023-11-14 22:13:20 UTC."""
CHUNK_SIZE: Final = 128 * 1024
"""Bytes of messages in one compressed chunk of a bag."""


class _Loader(yaml.SafeLoader):
    """Plain YAML that takes 1e-10 for a number, as YAML 1.2 does."""


_Loader.yaml_implicit_resolvers = {
    letter: list(resolvers) for letter, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?\d+(\.\d*)?[eE][-+]?\d+$"),
    list("-+0123456789"),
)


def machine_parameters(name: str) -> dict[str, Any]:
    """Read a machine's parameter file from config/ into a plain dict."""
    text = (CONFIG / f"{name}.yaml").read_text(encoding="utf-8")
    parameters: dict[str, Any] = yaml.load(text, Loader=_Loader)
    return parameters


def parameters_digest(parameters: Mapping[str, Any]) -> str:
    """Return a digest of a machine's parameters that comments and layout do not change.

    A bag whose digest is not that of the machine's file was recorded with another machine.
    """
    # How well the numbers are known changes no machine, nor does damping that no recording has.
    beside = ("uncertainty", "modal_damping")
    machine = {name: value for name, value in parameters.items() if name not in beside}
    return hashlib.sha256(json.dumps(machine, sort_keys=True).encode()).hexdigest()


def require_within(values: Array, limits: Any, what: str) -> None:
    """Refuse a motion that leaves the machine's limits.

    :param values: shape (samples, 3).
    :param limits: ``[min, max]`` for all, or one such pair for each of the three; None: no limits.
    :raises ValueError: with what leaves, how far it goes, and the limits.
    """
    if limits is None:
        return
    low, high = np.broadcast_to(np.asarray(limits, dtype=float), (3, 2)).T
    if np.any(values < low) or np.any(values > high):
        reached = f"{values.min(axis=0)} to {values.max(axis=0)}"
        raise ValueError(f"{what} goes from {reached}, outside {limits}")


def engine_version(distribution: str) -> str:
    """Return the version of the engine that is installed."""
    return importlib.metadata.version(distribution)


def stamp(time_ns: int) -> dict[str, int]:
    """Return a builtin_interfaces/Time for nanoseconds since the recording began."""
    total = EPOCH_NS + time_ns
    return {"sec": total // 1_000_000_000, "nanosec": total % 1_000_000_000}


def header(time_ns: int, frame: str) -> dict[str, Any]:
    """Return a std_msgs/Header."""
    return {"stamp": stamp(time_ns), "frame_id": frame}


def vector3(values: Iterable[float]) -> dict[str, float]:
    """Return a geometry_msgs/Vector3."""
    return dict(zip("xyz", map(float, values), strict=True))


def steps(value: Array, step: float | Array) -> Array:
    """Round to whole steps of a sensor's resolution, one for all or one each."""
    rounded: Array = np.round(value / step) * step
    return rounded


def joint_state(
    time_ns: int,
    names: Sequence[str],
    position: Array,
    velocity: Array | None = None,
    effort: Array | None = None,
) -> dict[str, Any]:
    """Return a sensor_msgs/JointState; what is not measured stays empty."""
    return {
        "header": header(time_ns, "base_link"),
        "name": list(names),
        "position": position.tolist(),
        "velocity": [] if velocity is None else velocity.tolist(),
        "effort": [] if effort is None else effort.tolist(),
    }


def joint_trajectory(
    start_ns: int, step_ns: int, names: Sequence[str], motion: Sequence[Array]
) -> dict[str, Any]:
    """Return a trajectory_msgs/JointTrajectory.

    :param motion: positions, velocities and accelerations, each of shape (points, 3).
    """
    points = [
        {
            "positions": position.tolist(),
            "velocities": velocity.tolist(),
            "accelerations": acceleration.tolist(),
            "effort": [],
            "time_from_start": {
                "sec": k * step_ns // 1_000_000_000,
                "nanosec": k * step_ns % 1_000_000_000,
            },
        }
        for k, (position, velocity, acceleration) in enumerate(zip(*motion, strict=True))
    ]
    return {"header": header(start_ns, "base_link"), "joint_names": list(names), "points": points}


def wrench_stamped(time_ns: int, frame: str, wrench: Array) -> dict[str, Any]:
    """Return a geometry_msgs/WrenchStamped for force and moment, shape (6,), N and N m."""
    return {
        "header": header(time_ns, frame),
        "wrench": {"force": vector3(wrench[:3]), "torque": vector3(wrench[3:])},
    }


def smooth(fraction: float) -> tuple[float, float, float]:
    """Rise from 0 to 1 by a quintic; value, first and second derivative to ``fraction``."""
    u = min(1.0, max(0.0, fraction))
    return (
        u**3 * (10.0 + u * (-15.0 + 6.0 * u)),
        30.0 * u**2 * (1.0 - u) ** 2,
        60.0 * u * (1.0 - u) * (1.0 - 2.0 * u),
    )


class Capture:
    """Messages of one recording, kept in memory and written in order of their log times.

    :param facts: what the metadata record "pkm_twin" says, one text each.
    """

    def __init__(self, facts: Mapping[str, Any]) -> None:
        self.facts: Final = {name: str(value) for name, value in facts.items()}
        self._topics: dict[str, str] = {}
        self._messages: list[tuple[int, int, str, dict[str, Any]]] = []

    def add_topic(self, topic: str, message_type: str) -> None:
        """Declare a topic, reliable and volatile, ten messages deep."""
        self._topics[topic] = message_type

    def write(self, topic: str, message: dict[str, Any], log_time_ns: int) -> None:
        """Keep a message; ``log_time_ns`` counts from the recording's beginning."""
        self._messages.append((EPOCH_NS + log_time_ns, len(self._messages), topic, message))

    def save(self, path: Path) -> None:
        """Write the bag, replacing an older one of the same name."""
        part = path.with_suffix(".part")
        with BagWriter(
            part,
            overwrite=True,
            chunk_size=CHUNK_SIZE,
            metadata={"pkm_twin": self.facts},
            flush_period=None,
        ) as bag:
            for topic, message_type in self._topics.items():
                bag.add_topic(topic, message_type)
            for log_time, _, topic, message in sorted(self._messages, key=lambda entry: entry[:2]):
                bag.write(topic, message, log_time)
        part.replace(path)
