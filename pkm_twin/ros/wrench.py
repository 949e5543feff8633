# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes that take a measured wrench: alike in each."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from pkm_twin.errors import ParameterError
from pkm_twin.streams.wrench import PLATFORM, Mounts, WrenchSettings

if TYPE_CHECKING:
    from pkm_twin.ros.node import TwinNode

SECONDS: dict[str, Any] = {"unit": "s", "low": 0.0, "high": 3600.0}
PARAMETERS = {
    "wrench_frame": "wrench_frame",
    "accept_empty_frame": "accept_empty_frame",
    "sensor.xyz": "sensor_xyz",
    "sensor.rpy": "sensor_rpy",
}
"""Parameters that every such node has, and their settings."""
WRENCH_CHANGES = (*PARAMETERS, "max_state_age", "future_tolerance", "accept_zero_stamp")
"""Those that :func:`changed` takes of a node that pairs wrenches with joint states."""


def declare_wrench(node: TwinNode, read_only: bool = False, **others: Any) -> WrenchSettings:
    """Declare what every node with a wrench has, and make the settings.

    :param read_only: fixed at the start, all of them; ``others``: settings that the node declares
        by itself.
    :raises ParameterError: a value that is refused.
    """
    default = WrenchSettings()
    frame = node.declare("wrench_frame", default.wrench_frame, "frame of the wrench",
                         read_only=True)  # fmt: skip
    base = others.get("base_frame", default.base_frame)
    for name, value in (("wrench_frame", frame), ("base_frame", base)):
        if not value:
            raise ParameterError(name, value, "a frame's name")
    place = "position of the sensor from the platform's reference point, platform axes"
    return WrenchSettings(
        wrench_frame=frame,
        accept_empty_frame=node.declare(
            "accept_empty_frame", default.accept_empty_frame, "accept an empty frame id as "
            "wrench_frame",
            read_only=read_only,
        ),
        sensor_xyz=triple(node, "sensor.xyz", place, "m", read_only),
        sensor_rpy=triple(
            node, "sensor.rpy", "roll, pitch and yaw of the sensor relative to the platform", "rad",
            read_only,
        ),
        **others,
    )  # fmt: skip


def declare_stamps(node: TwinNode, pair: str) -> dict[str, Any]:
    """Declare the settings of a node that pairs wrenches with joint states.

    :param pair: what is paired with the nearest of what.
    """
    d = WrenchSettings()
    return {
        "max_state_age": node.declare(
            "max_state_age", d.max_state_age, f"largest time between {pair}", **SECONDS
        ),
        "future_tolerance": node.declare(
            "future_tolerance", d.future_tolerance, "how far time stamps may be ahead of the clock",
            **SECONDS,
        ),
        "accept_zero_stamp": node.declare(
            "accept_zero_stamp", d.accept_zero_stamp, "accept a zero stamp, as the arrival time"
        ),
    }  # fmt: skip


def declare_mounts(node: TwinNode, platform_frame: str = PLATFORM) -> Mounts | None:
    """The transforms that tell where a sensor stands; None where the parameters tell it.

    :raises ParameterError: transforms are asked for and tf2_ros is not installed.
    """
    wanted = node.declare(
        "use_tf", False, "take the sensor's pose from /tf in place of sensor.xyz and sensor.rpy",
        read_only=True,
    )  # fmt: skip
    if not wanted:
        return None
    from pkm_twin.ros.transforms import TransformMounts

    return TransformMounts(node, platform_frame)


def changed(settings: WrenchSettings, values: dict[str, Any]) -> WrenchSettings:
    """Settings with new values of parameters, others left out.

    :raises ParameterError: a value that is refused.
    """
    fields = {field.name for field in dataclasses.fields(settings)}
    new = {PARAMETERS.get(name, name): value for name, value in values.items()}
    chosen: dict[str, Any] = {
        name: tuple(value) if hasattr(value, "__iter__") and not isinstance(value, str) else value
        for name, value in new.items()
        if name in fields
    }
    return dataclasses.replace(settings, **chosen)


def triple(
    node: TwinNode, name: str, text: str, unit: str, read_only: bool = True
) -> tuple[float, float, float]:
    """Declare a parameter of three numbers, zeros by default.

    :raises ParameterError: not three.
    """
    values = node.declare(name, [0.0, 0.0, 0.0], text, unit=unit, read_only=read_only)
    if len(values) != 3:
        raise ParameterError(name, list(values), "3 numbers")
    x, y, z = values
    return float(x), float(y), float(z)
