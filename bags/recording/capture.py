# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
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


def smooth(fraction: float) -> tuple[float, float, float]:
    """Rise from 0 to 1 by a quintic; value, first and second derivative to ``fraction``."""
    u = min(1.0, max(0.0, fraction))
    return (
        u**3 * (10.0 + u * (-15.0 + 6.0 * u)),
        30.0 * u**2 * (1.0 - u) ** 2,
        60.0 * u * (1.0 - u) * (1.0 - 2.0 * u),
    )


class WrenchSensor:
    """What measures the load on a platform: noise and steps, N and N m."""

    noise: Final = np.repeat((0.5, 0.02), 3)
    step: Final = np.repeat((0.05, 0.001), 3)

    def facts(self) -> dict[str, float]:
        """Return what the metadata say of it."""
        found = {}
        for kind, unit, k in (("force", "N", 0), ("moment", "N_m", 3)):
            found[f"{kind}_noise_{unit}"] = float(self.noise[k])
            found[f"{kind}_step_{unit}"] = float(self.step[k])
        return found

    def read(self, wrench: Array, rng: np.random.Generator) -> Array:
        """Return what it reads of a wrench, shape (6,)."""
        return steps(wrench + self.noise * rng.normal(size=6), self.step)


class Capture:
    """Messages of one recording, kept in memory and written in order of their log times.

    :param name: of the recorder in this package.
    :param parameters: of the machine that is simulated.
    :param engine: what simulates it, and the distribution that it comes from.
    :param facts: what else the metadata record "pkm_twin" says, one text each.
    """

    TOPICS: Final = {
        "/joint_states": ("sensor_msgs/msg/JointState", 200_000),
        "/wrench": ("geometry_msgs/msg/WrenchStamped", 300_000),
        "/delta_dynamics/joint_trajectory": ("trajectory_msgs/msg/JointTrajectory", -50_000_000),
        "/ground_truth/deflection": ("geometry_msgs/msg/TransformStamped", 400_000),
        "/ground_truth/strain_energy": ("diagnostic_msgs/msg/DiagnosticArray", 400_000),
        "/ground_truth/wrench": ("geometry_msgs/msg/WrenchStamped", 400_000),
        "/measured_deflection": ("geometry_msgs/msg/TransformStamped", 400_000),
    }
    """Types of topics, and how much later than its stamp a message is logged, ns."""

    def __init__(
        self,
        name: str,
        robot: str,
        parameters: Mapping[str, Any],
        engine: tuple[str, str],
        seed: int,
        duration: float,
        topics: Sequence[str],
        facts: Mapping[str, Any],
    ) -> None:
        common = {
            "robot": robot,
            "source": "simulated",
            "engine": engine[0],
            "engine_version": importlib.metadata.version(engine[1]),
            "recorder": f"bags.recording.{name}",
            "parameters_sha256": parameters_digest(parameters),
            "seed": seed,
            "duration_s": duration,
        }
        self.names: Final = list(parameters["joints"])
        self.facts: Final = {key: str(value) for key, value in {**common, **facts}.items()}
        self._topics = topics
        self._messages: list[tuple[int, int, str, dict[str, Any]]] = []

    def write(self, topic: str, time_ns: int, message: dict[str, Any]) -> None:
        """Keep a message that is stamped ``time_ns`` after the recording's beginning."""
        log_time = EPOCH_NS + time_ns + self.TOPICS[topic][1]
        self._messages.append((log_time, len(self._messages), topic, message))

    def joint_state(
        self,
        time_ns: int,
        position: Array,
        velocity: Array | None = None,
        effort: Array | None = None,
    ) -> None:
        """Keep a sensor_msgs/JointState; what is not measured stays empty."""
        message = {
            "header": header(time_ns, "base_link"),
            "name": self.names,
            "position": position.tolist(),
            "velocity": [] if velocity is None else velocity.tolist(),
            "effort": [] if effort is None else effort.tolist(),
        }
        self.write("/joint_states", time_ns, message)

    def wrench(self, topic: str, time_ns: int, frame: str, wrench: Array) -> None:
        """Keep a geometry_msgs/WrenchStamped of force and moment, shape (6,), N and N m."""
        message = {
            "header": header(time_ns, frame),
            "wrench": {"force": vector3(wrench[:3]), "torque": vector3(wrench[3:])},
        }
        self.write(topic, time_ns, message)

    def trajectory(self, start_ns: int, step_ns: int, motion: Sequence[Array]) -> None:
        """Keep a trajectory_msgs/JointTrajectory.

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
        message = {
            "header": header(start_ns, "base_link"),
            "joint_names": self.names,
            "points": points,
        }
        self.write("/delta_dynamics/joint_trajectory", start_ns, message)

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
            for topic in self._topics:
                bag.add_topic(topic, self.TOPICS[topic][0])
            for log_time, _, topic, message in sorted(self._messages, key=lambda entry: entry[:2]):
                bag.write(topic, message, log_time)
        part.replace(path)
