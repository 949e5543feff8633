# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map the standard deviation of the platform's position, from the file's `uncertainty`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine.places import split_path
from pkm_twin.maps.kind import Case, Found, Kind, largest_axis
from pkm_twin.robot.derivatives import position_errors_by_source
from pkm_twin.robot.robot import Robot


class PoseError(Kind):
    """Map the standard deviation of the position, from the file's `uncertainty`."""

    name = "pose-error"
    question = "where is it least accurate?"
    answer = "least accurate"
    what = "standard deviation of the position"
    unit = "m"
    element = "cause"
    points = 20_000
    chunk = 4096
    samples = 1024
    population = 64
    rounds = 100

    def elements(self, robot: Robot) -> tuple[str, ...]:
        """Return the numbers of the geometry whose errors move the platform."""
        return tuple(list(robot.uncertainty_changes)[k] for k in _moving_causes(robot))

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the standard deviation in the worst direction, joints at their set points.

        To first order, for independent causes. ``element``: the cause that contributes most.
        """
        effects = position_errors_by_source(robot, q)[..., _moving_causes(robot)].swapaxes(-1, -2)
        value, direction = largest_axis(effects.swapaxes(-1, -2) @ effects)
        along = np.abs((effects * direction[..., None, :]).sum(-1))
        return Found(np.sqrt(np.maximum(value, 0.0)), direction, along.argmax(-1))


def _moving_causes(robot: Robot) -> NDArray[np.intp]:
    """Return the indices of the causes that move the platform at home.

    :raises ParameterError: a file without standard deviations of the geometry, or with those of
    points or axes at home: all parts that meet there move along, and home still closes.
    """
    for name, steps in robot.uncertainty_changes.items() if robot.mechanism == "machine" else ():
        places = {"at", "axis", "axes", "ends"}
        shared = [path for path, step in steps.items() if step and places & {*split_path(path)[2:3]}]
        if shared:
            raise ParameterError(
                f"uncertainty.{name}",
                shared[0],
                "numbers that move the platform at home, where this one is a place that parts "
                "share; errors of single parts: pkm-twin design --tolerance",
            )
    found = np.flatnonzero(position_errors_by_source(robot, robot.graph.home).any(0))
    if not len(found):
        what = "the standard deviation of a length or angle that moves the platform"
        if robot.tolerances:
            what += "; errors of the file's tolerances: pkm-twin design --tolerance file"
        raise ParameterError("uncertainty", None, what)
    return found
