# SPDX-License-Identifier: Apache-2.0
"""The pose error budget of ``pkm-twin design --tolerance``: computed, as data and as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.apps.design_report import read_path
from pkm_twin.apps.options import read_options
from pkm_twin.codegen.arrays import Array
from pkm_twin.design import Tolerances, drawn, tolerances
from pkm_twin.design.tolerance import workspace_states
from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot import Robot

STATES: Final = 2000
"""Joint states that stand for the workspace."""
DRAWN_STATES: Final = 25
"""Joint states, spread over all, in which drawn machines are assembled."""


def parse_tolerances(texts: Sequence[str]) -> dict[str, float]:
    """Standard deviations by path of ``PATH=SIGMA`` texts.

    :raises ParameterError: another form, or a path that is given twice.
    """
    found: dict[str, float] = {}
    for text in texts:
        path, _, value = text.rpartition("=")
        try:
            sigma = float(value)
        except ValueError:
            sigma = math.nan
        if not path or path in found or not 0.0 <= sigma < math.inf:
            raise ParameterError(
                "tolerance", text, "PATH=SIGMA, each path once, a standard deviation of 0 or more"
            )
        found[path] = sigma
    return found


def rms(vectors: Array) -> float:
    """Root mean square length of vectors (..., 3)."""
    return float(np.sqrt((vectors**2).sum(-1).mean()))


def budget(
    robot: Robot, sigma: Mapping[str, float], path: Path | None,
    wrench: Sequence[float] | None = None, count: int = 0, seed: int = 0,
) -> tuple[dict[str, Any], str]:  # fmt: skip
    """The budget over a path, or over the workspace without one, as plain data and as text.

    :param wrench: on the platform, (6,), whose deflection is given too; None is none.
    :param count: machines to draw and assemble exactly; 0 is none.
    :raises ParameterError: as :func:`~pkm_twin.design.tolerances`, or a file without limits.
    """
    if path is None:
        q, where = workspace_states(robot, STATES, seed), "the workspace"
    else:
        q, where = robot.inverse(read_path(path, robot, None, read_options())[1].pose), path.name
    found = tolerances(robot, sigma, q, wrench)
    variance = {name: float((found.part(name)[..., :3] ** 2).sum()) for name in sigma}
    whole = sum(variance.values())
    rows: dict[str, Any] = {}
    for name in sorted(sigma, key=lambda name: -variance[name]):
        moves, turns = np.split(found.part(name), 2, -1)
        rows[name] = {
            "varied": found.texts[name], "sigma": sigma[name], "unit": found.units[name],
            "rms_position_m": rms(moves),
            "greatest_position_m": float(np.linalg.norm(moves, axis=-1).max()),
            "rms_angle_rad": rms(turns),
            "greatest_angle_rad": float(np.linalg.norm(turns, axis=-1).max()),
            "share": variance[name] / whole if whole > 0.0 else 0.0,
        }  # fmt: skip
    position = np.linalg.norm(found.deviation[:, :3], axis=-1)
    angle = np.linalg.norm(found.deviation[:, 3:], axis=-1)
    worst = int(position.argmax())
    data: dict[str, Any] = {
        "robot": robot.name, "states": len(q), "path": None if path is None else str(path),
        "contributions": rows, "rms_position_m": rms(found.deviation[:, :3]),
        "greatest_position_m": float(position.max()),
        "rms_angle_rad": rms(found.deviation[:, 3:]),
        "greatest_angle_rad": float(angle.max()),
        "worst_pose": robot.forward(q[worst]).tolist(),
    }  # fmt: skip
    lines = _table(robot, found, data, where)
    if count:
        chosen = np.unique(np.linspace(0, len(q) - 1, DRAWN_STATES).round().astype(int))
        errors = drawn(robot, sigma, q[chosen], count, seed)
        data["monte_carlo"] = {
            "machines": count, "states": len(chosen), "rms_position_m": rms(errors[..., :3]),
            "greatest_position_m": float(np.linalg.norm(errors[..., :3], axis=-1).max()),
            "rms_angle_rad": rms(errors[..., 3:]),
            "first_order_rms_position_m": rms(found.deviation[chosen, :3]),
        }  # fmt: skip
        drawn_ = data["monte_carlo"]
        lines.append(
            f"{count} drawn machines, assembled exactly in {len(chosen)} of the states: RMS "
            f"{1e3 * drawn_['rms_position_m']:.4g} mm, to first order there "
            f"{1e3 * drawn_['first_order_rms_position_m']:.4g} mm; largest error "
            f"{1e3 * drawn_['greatest_position_m']:.4g} mm"
        )
    if found.deflection is not None:
        data["rms_deflection_m"] = rms(found.deflection[..., :3])
        lines.append(
            f"deflection under the wrench, not in the table: RMS "
            f"{1e3 * data['rms_deflection_m']:.4g} mm"
        )
    return data, "\n".join(lines)


def _table(robot: Robot, found: Tolerances, data: Mapping[str, Any], where: str) -> list[str]:
    lines = [
        f"{robot.name}: standard deviation of the platform's position (mm) and rotation (mrad) "
        f"over {where}, {data['states']} states, actuated joints held",
        f"{'error':34}{'sigma':>12} {'unit':5}{'RMS mm':>10}{'max mm':>10}{'RMS mrad':>10}"
        f"{'share':>8}  what varies",
    ]
    for name, row in data["contributions"].items():
        none = "" if np.any(np.abs(found.sensitivity[name]) > 1e-9) else ": moves nothing"
        lines.append(
            f"{name:34}{row['sigma']:12.4g} {row['unit']:5}{1e3 * row['rms_position_m']:10.4g}"
            f"{1e3 * row['greatest_position_m']:10.4g}{1e3 * row['rms_angle_rad']:10.4g}"
            f"{100 * row['share']:7.3g}%  {row['varied']}{none}"
        )
    pose = zip(robot.pose_names, data["worst_pose"], strict=True)
    return [
        *lines,
        f"{'all':34}{'':18}{1e3 * data['rms_position_m']:10.4g}"
        f"{1e3 * data['greatest_position_m']:10.4g}{1e3 * data['rms_angle_rad']:10.4g}",
        "largest position error at " + ", ".join(f"{name} {value:.4g}" for name, value in pose),
    ]
