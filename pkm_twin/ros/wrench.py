# SPDX-License-Identifier: Apache-2.0
"""Parameters of the nodes that take a measured wrench."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pkm_twin.errors import ParameterError
from pkm_twin.streams.wrench import PLATFORM, Mounts

if TYPE_CHECKING:
    from pkm_twin.ros.node import TwinNode


def declare_mounts(node: TwinNode, platform_frame: str = PLATFORM) -> Mounts | None:
    """The transforms that tell where a sensor stands; None where the parameters tell it.

    :raises ParameterError: transforms are asked for and tf2_ros is not installed.
    """
    wanted = node.declare(
        "use_tf", False, "take the sensor's pose from /tf in place of sensor.xyz and sensor.rpy, "
        "between wrench_frame and platform_frame at the wrench's stamp; needs tf2_ros",
        read_only=True,
    )  # fmt: skip
    if not wanted:
        return None
    from pkm_twin.ros.transforms import TransformMounts

    return TransformMounts(node, platform_frame)


def triple(node: TwinNode, name: str, text: str, unit: str) -> tuple[float, float, float]:
    """Declare a parameter of three numbers, zeros by default.

    :raises ParameterError: not three.
    """
    values = node.declare(name, [0.0, 0.0, 0.0], text, unit=unit, read_only=True)
    if len(values) != 3:
        raise ParameterError(name, list(values), f"3 numbers, {unit}")
    x, y, z = values
    return float(x), float(y), float(z)
