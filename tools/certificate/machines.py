# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Draw random machines and states for the comparison."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pkm_twin import Robot, load
from pkm_twin.errors import SingularityError, UnreachableError

LEAST_MEASURE = 0.03
"""States nearer to a singularity (reciprocal condition of the Jacobian) are not drawn: there all
routes lose digits alike."""

AZIMUTH_ERROR = 0.1
"""Largest deviation of limb azimuths from even spacing, rad."""
THIN_ROD_FRACTION = 0.3
"""Part of the PRRUs whose links are rods without inertia about themselves, the default."""

ROBOTS = ("delta", "delta_cu", "prru")


@dataclass(frozen=True)
class Case:
    """One machine with several states; arrays of shape (states, 3), the wrench (states, 6)."""

    data: dict[str, Any]
    robot: Robot
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    wrench: np.ndarray


def build(data: dict[str, Any]) -> Robot:
    """Build the robot of a parameter mapping."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "machine.yaml"
        path.write_text(yaml.safe_dump(data))
        return load(path)


def friction(data: dict[str, Any], qd: np.ndarray) -> np.ndarray:
    """Return the friction effort, for engines without friction."""
    values = data.get("friction", {})
    return np.multiply(values.get("viscous", 0.0), qd) + np.multiply(values.get("coulomb", 0.0), np.sign(qd))


def random_case(name: str, rng: np.random.Generator, states: int) -> Case:
    """Draw a machine of the kind ``name``, and states in which it can be assembled."""
    for _ in range(100):
        data = _draw_prru(rng) if name == "prru" else _draw_delta(rng, name == "delta_cu")
        robot = build(data)
        q = _draw_positions(name, robot, rng, states)
        if q is not None:
            break
    else:
        raise RuntimeError(f"no machine of the kind {name} with {states} states")
    if name == "prru":
        rate, change, load_scale = 0.4, 6.0, 150.0
    else:
        rate, change, load_scale = 4.0, 60.0, 20.0
    wrench = rng.normal(0.0, load_scale, (states, 6)) * [1, 1, 1, 0.3, 0.3, 0.3]
    qd, qdd = rng.normal(0.0, rate, (states, 3)), rng.normal(0.0, change, (states, 3))
    return Case(data, robot, q, qd, qdd, wrench)


def _draw_positions(name: str, robot: Robot, rng: np.random.Generator, states: int) -> np.ndarray | None:
    found: list[np.ndarray] = []
    for _ in range(50 * states):
        try:
            if name == "prru":
                pose = rng.uniform([-0.2, -0.45, -0.45], [0.2, 0.45, 0.45])
                q = robot.inverse(pose)
                if np.abs(robot.forward(q) - pose).max() > 1e-9:
                    continue
            else:
                q = rng.uniform(-0.6, 1.0, 3)
            if _compute_index(robot, q) > LEAST_MEASURE:
                found.append(q)
        except (UnreachableError, SingularityError):
            continue
        if len(found) == states:
            return np.array(found)
    return None


def _compute_index(robot: Robot, q: np.ndarray) -> float:
    """Return the reciprocal condition of the Jacobian with angles times the platform's radius."""
    values = np.linalg.svd(robot.pose_scales[:, None] * robot.jacobian(q), compute_uv=False)
    return float(values[-1] / values[0])


def _draw_inertia(rng: np.random.Generator, mass: float, size: float) -> list[list[float]]:
    """Return the inertia of a random body of eight equal points, kg m2."""
    points = rng.uniform(-size, size, (8, 3))
    points -= points.mean(0)
    moments = np.einsum("ki,ki->", points, points) * np.eye(3) - points.T @ points
    return (mass / 8 * moments).tolist()


def _draw_common(rng: np.random.Generator, payload: float, size: float, drag: float) -> dict[str, Any]:
    mass = float(rng.uniform(0.0, payload))
    direction = rng.normal(size=3)
    gravity = rng.uniform(1.0, 15.0) * direction / np.linalg.norm(direction)
    return {
        "payload": {
            "mass": mass,
            "com": rng.uniform(-size, size, 3).tolist(),
            "inertia": _draw_inertia(rng, mass, size),
        },
        "friction": {
            "viscous": rng.uniform(0.0, drag, 3).tolist(),
            "coulomb": rng.uniform(0.0, drag, 3).tolist(),
        },
        "gravity": gravity.tolist(),
    }


def _draw_delta(rng: np.random.Generator, sliding: bool) -> dict[str, Any]:
    arm = rng.uniform(0.12, 0.4)
    closures = ["rod", "rod", "rod"]
    if sliding:
        closures[rng.integers(3)] = "rcu"
    azimuths = np.array([-1.0, 3.0, 7.0]) * math.pi / 6 + rng.uniform(-AZIMUTH_ERROR, AZIMUTH_ERROR, 3)
    inertia = {
        "platform_mass": rng.uniform(0.1, 1.0),
        "arm_mass": rng.uniform(0.1, 1.0),
        "forearm_mass": rng.uniform(0.05, 0.4),
        "arm_com": rng.uniform(0.0, 1.0),
        "arm_inertia": rng.uniform(1e-4, 1e-2),
        "rotor_inertia": rng.uniform(0.0, 1e-2),
    }
    return {
        "mechanism": "delta",
        "geometry": {
            "base_radius": float(arm * rng.uniform(0.3, 0.7)),
            "platform_radius": float(rng.uniform(0.03, 0.06)),
            "arm_length": float(arm),
            "forearm_length": float(arm * rng.uniform(1.8, 2.6)),
            "azimuths": azimuths.tolist(),
            "closures": closures,
        },
        "inertia": {key: float(value) for key, value in inertia.items()},
        **_draw_common(rng, 1.0, 0.05, 0.2),
    }


def _draw_prru(rng: np.random.Generator) -> dict[str, Any]:
    base = rng.uniform(0.25, 0.5)
    limb = base * rng.uniform(1.4, 2.2)
    azimuths = np.array([3.0, 5.0, 1.0]) * math.pi / 3 + rng.uniform(-AZIMUTH_ERROR, AZIMUTH_ERROR, 3)
    platform = float(rng.uniform(10.0, 40.0))
    links: dict[str, Any] = {}
    thin = rng.random() < THIN_ROD_FRACTION
    for name in ("lower", "upper"):
        mass = float(rng.uniform(1.0, 5.0))
        across = mass * limb**2 * rng.uniform(0.05, 0.15)
        links[f"{name}_link_mass"] = mass
        if not thin:
            about = across * rng.uniform(0.01, 1.5)
            links[f"{name}_link_inertia"] = [float(across), float(about)]
    return {
        "mechanism": "prru",
        "geometry": {
            "base_radius": float(base),
            "platform_radius": float(base * rng.uniform(0.5, 1.0)),
            "limb_length": float(limb),
            "azimuths": azimuths.tolist(),
            "branch": str(rng.choice(["above", "below"])),
        },
        "inertia": {
            "slider_mass": float(rng.uniform(2.0, 12.0)),
            **links,
            "link_com": float(rng.uniform(0.0, 1.0)),
            "platform_mass": platform,
            "platform_com": rng.uniform(-0.05, 0.05, 3).tolist(),
            "platform_inertia": _draw_inertia(rng, platform, 0.2),
        },
        **_draw_common(rng, 10.0, 0.15, 5.0),
    }
