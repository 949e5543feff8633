# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Strain energy of loads, and each element's share."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.maps.kind import Case, Found, size_and_direction
from pkm_twin.maps.kinds.compliance import Compliance
from pkm_twin.robot.robot import Robot
from stiffness_monitor import platform_response

if TYPE_CHECKING:
    from xarray import Dataset


class StrainEnergy(Compliance):
    """The strain energy of loads, and each element's share; without a load 1 N along z."""

    name = "strain-energy"
    question = "which part gives?"
    answer = "most strain energy"
    what = "strain energy"
    unit = "J"
    has_shares = True

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """A force of 1 N upwards."""
        (case,) = super().cases(robot)
        return (replace(case, name="1 N along z", wrench=(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),)

    def loaded(self, robot: Robot, name: str, wrench: object) -> Case:
        """The same quantity under another load."""
        load = super().loaded(robot, name, wrench)  # type: ignore[arg-type]
        return replace(self.cases(robot)[0], name=name, wrench=load.wrench)

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Total strain energy, the way that the platform moves, and the elements' shares."""
        response = platform_response(robot, q, np.array(case.wrench))
        _, direction = size_and_direction(response.deflection[..., :3])
        factors = response.factors
        return Found(np.asarray(response.total), direction, factors.argmax(-1), factors)

    @classmethod
    def facts(cls, data: Dataset) -> list[str]:
        """Mean share of the elements, largest first."""
        lines = []
        for k, case in enumerate(data.case.values):
            mean = data.factor.isel(case=k).mean([d for d in data.factor.dims[:-2]]).values
            order = np.argsort(-mean, kind="stable")[:4]
            parts = [f"{data.element.values[n]} {100 * mean[n]:.1f} %" for n in order]
            lines.append(f"{case}: mean share over the workspace: {', '.join(parts)}")
        return lines
