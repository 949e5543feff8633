# SPDX-License-Identifier: Apache-2.0
"""What ``pkm-twin size`` reads, prints and draws."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from pkm_twin.errors import FileError, ParameterError, UnknownNameError
from pkm_twin.machine import schema
from pkm_twin.paths.along import Compared
from pkm_twin.paths.sizing import DriveDuty, Fit, Gear, Motor, size_drives
from pkm_twin.paths.worst import worst_over_workspace
from pkm_twin.robot.catalogue import config_folder
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]

MOST_PERCENT: Final = 1000.0
"""A used part of more is printed as more."""
SHIPPED: Final = "shipped"
RPM: Final = 2 * math.pi / 60


def duties(taken: Compared, motors: Sequence[Motor], gear: Gear | None = None) -> list[DriveDuty]:
    """What each drive gives."""
    m = taken.motion
    robot = m.carried or m.robot
    return size_drives(robot, m.time, *m.motion[:3], taken.effort, motors, gear)


@dataclass(frozen=True, eq=False)
class MotorSpec:
    """A motor as its data sheet has it: torques in N m, speeds in 1/min, inertia in kg m2.

    ``curve``: rows of speed and greatest torque; without it the peak torque up to the rated speed,
    then a straight line to the continuous torque at the greatest speed.
    """

    inertia: float = schema.number(at_least=1e-10, at_most=1e4, unit="kg m2")
    continuous_torque: float = schema.number(at_least=1e-6, at_most=1e7, unit="N m")
    peak_torque: float = schema.number(at_least=1e-6, at_most=1e7, unit="N m")
    rated_speed: float = schema.number(at_least=1e-3, at_most=1e7, unit="1/min")
    max_speed: float = schema.number(at_least=1e-3, at_most=1e7, unit="1/min")
    source: str = schema.text(default="")
    curve: Any = dataclasses.field(
        default=None, metadata={"check": lambda field, value: _curve(field, value), "key": None}
    )

    def verify(self, path: str) -> None:
        """What a data sheet says of one motor agrees."""
        most, where = self.peak_torque, "peak_torque"
        if self.curve is not None and self.curve[:, 1].max() < most:
            most, where = float(self.curve[:, 1].max()), "the curve's greatest torque"
        for name, value, bound, what in (
            ("continuous_torque", self.continuous_torque, most, where),
            ("rated_speed", self.rated_speed, self.max_speed, "max_speed"),
        ):
            if value > bound:
                raise ParameterError(f"{path}.{name}", value, f"at most {what}, {bound:g}")

    def motor(self, name: str) -> Motor:
        """In SI units."""
        rows = self.curve
        if rows is None:
            rows = np.array(
                [[0.0, self.peak_torque], [self.rated_speed, self.peak_torque],
                 [self.max_speed, self.continuous_torque]]
            )  # fmt: skip
        return Motor(
            name, self.inertia, self.continuous_torque, rows * np.array([RPM, 1.0]), self.source
        )


def _curve(field: str, value: Any) -> Array:
    try:
        rows = np.array(value, float)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    pairs = rows.ndim == 2 and rows.shape[1:] == (2,) and len(rows) > 1
    if not (
        pairs and rows[0, 0] == 0.0 and (np.diff(rows[:, 0]) > 0.0).all()
        and ((rows >= 0.0) & (rows <= 1e7)).all() and rows[:, 1].any()
    ):  # fmt: skip
        raise ParameterError(
            field, value, "rows of speed (1/min, rising from 0) and torque (N m), up to 1e+07"
        )
    return rows


def read_motors(path: Path, names: Sequence[str] = ()) -> list[Motor]:
    """Motors of a YAML with a mapping ``drives`` of names to data.

    :raises ParameterError: by the field.
    """
    if str(path) == SHIPPED:
        path = config_folder() / "drives" / "servos.yaml"
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise FileError(path, error, "a YAML file of drives") from None
    entries = data.get("drives") if isinstance(data, dict) else None
    if not isinstance(entries, dict) or not entries:
        raise ParameterError(str(path), None, "a mapping drives of names to data")
    for name in names:
        if name not in entries:
            raise UnknownNameError(f"{path}: motor", name, [str(n) for n in entries])
    return [
        schema.build(MotorSpec, entry, f"{path}: drives.{name}").motor(str(name))
        for name, entry in entries.items()
        if not names or name in names
    ]


def report(taken: Compared, result: Sequence[DriveDuty]) -> tuple[dict[str, Any], str]:
    """The result as plain data and as text."""
    m = taken.motion
    duration = float(m.time[-1] - m.time[0])
    total = [d.at_joint.energy for d in result]
    data = {
        "robot": m.robot.name, "duration_s": duration, "samples": len(m.time),
        "efforts": taken.source, "difference_from_model": taken.difference.tolist(),
        "payload": None if m.load is None else m.load.as_json(),
        "drives": {d.joint: d.as_json() for d in result},
        "energy_J": sum(total), "mean_power_W": sum(total) / duration,
        "regenerated_J": sum(d.at_joint.returned for d in result),
    }  # fmt: skip
    lines = [
        f"{m.robot.name}: {len(m.time)} samples, {duration:.4g} s; efforts: {taken.source}; "
        f"payload: {m.load or 'as in the robot file'}"
    ]
    for d in result:
        force, rate, inertia = ("N", "m/s", "kg") if d.slides else ("N m", "rad/s", "kg m2")
        lines.append(f"{d.joint}:")
        lines.append("  joint: " + _words(d.at_joint, force, rate))
        low, high = d.load_inertia
        lines.append(f"  load inertia at the joint {low:.4g} to {high:.4g} {inertia}")
        if d.at_motor is not None:
            lines.append("  motor: " + _words(d.at_motor, "N m", "rad/s"))
            if d.inertia_ratio is not None:
                lines.append(f"  inertia ratio, load to rotor: {d.inertia_ratio:.4g}")
        for fit in sorted(d.fits, key=lambda f: (not f.good, f.motor.continuous)):
            lines.append(
                f"  {'fits' if fit.good else 'too small'}: {fit.motor.name}: peak torque "
                f"{_percent(fit.torque)}, RMS torque {_percent(fit.thermal)}, speed "
                f"{_percent(fit.speed)} of the motor's, inertia ratio {fit.inertia_ratio:.3g}"
            )
    lines.append(
        f"all drives: net energy {sum(total):.4g} J ({data['regenerated_J']:.4g} J regenerated), "
        f"mean power {data['mean_power_W']:.4g} W"
    )
    lines += list(m.notes)
    if taken.unlike:
        lines.append(f"{taken.unlike}; --efforts model uses the model's")
    return data, "\n".join(lines)


def _percent(part: float) -> str:
    value = 100.0 * part
    return f"{value:.4g} %" if value <= MOST_PERCENT else f"over {MOST_PERCENT:.0f} %"


def _words(duty: Any, force: str, rate: str) -> str:
    return (
        f"effort peak {duty.peak:.4g}, RMS {duty.rms:.4g} {force}; speed peak {duty.speed:.4g}, "
        f"mean {duty.mean_speed:.4g} {rate}; power peak {duty.power:.4g}, regenerated peak "
        f"{duty.braking:.4g} W; net energy {duty.energy:.4g} J ({duty.returned:.4g} J regenerated)"
    )


def worst_report(
    robot: Robot, speed: float, change: float, singularity: float
) -> tuple[dict[str, Any], str]:
    """The worst efforts and speeds over the workspace, as plain data and as text."""
    worst = worst_over_workspace(robot, speed, change, singularity=singularity)
    names = robot.pose_names
    data: dict[str, Any] = {
        "robot": robot.name, "speed_m_s": speed, "acceleration_m_s2": change,
        "poses": worst.poses, "drives": {},
    }  # fmt: skip
    lines = [
        f"{robot.name}: tool point at {speed:g} m/s and {change:g} m/s2 in the worst directions, "
        f"{worst.poses} poses of the workspace"
    ]
    for i, joint in enumerate(robot.joint_names):
        force = "N" if robot.joint_units[i] == "m" else "N_m"
        rate = "m_s" if robot.joint_units[i] == "m" else "rad_s"
        entry: dict[str, Any] = {}
        for what, value, pose in (
            (f"effort_{force}", worst.effort[i], worst.effort_pose[i]),
            (f"holding_effort_{force}", worst.holding[i], worst.holding_pose[i]),
            (f"speed_{rate}", worst.speed[i], worst.speed_pose[i]),
        ):
            entry[what] = float(value)
            entry[f"{what.split('_')[0]}_pose"] = dict(zip(names, pose.tolist(), strict=True))
            where = ", ".join(f"{n} {v:.4g}" for n, v in zip(names, pose, strict=True))
            words = what.replace("_N_m", " (N m)").replace("_N", " (N)")
            words = words.replace("_rad_s", " (rad/s)").replace("_m_s", " (m/s)").replace("_", " ")
            lines.append(f"{joint}: {words} {value:.4g} at {where}")
        data["drives"][joint] = entry
    return data, "\n".join(lines)


def near(duty: DriveDuty) -> list[Fit]:
    """The motors to draw: the smallest that fits, or the largest, and the three below it."""
    fits = sorted(duty.fits, key=lambda fit: fit.motor.continuous)
    first = next((k for k, fit in enumerate(fits) if fit.good), len(fits) - 1)
    return fits[max(first - 3, 0) : first + 1]


def draw(taken: Compared, result: Sequence[DriveDuty], path: Path) -> None:
    """Torque against speed, an axes for each drive, with the curves of motors."""
    from pkm_twin.report import plots

    shown = list(result)[:4]
    figure, axes = plots.columns(1, len(shown))
    m = taken.motion
    for k, (ax, d) in enumerate(zip(axes[0], shown, strict=True)):
        if d.torques is not None and d.speeds is not None:
            side, speeds, torques = "motor", d.speeds / RPM, d.torques
            labels = "speed of the motor (1/min)", "torque (N m)"
        else:
            side, speeds, torques = "joint", m.motion[1][:, k], taken.effort[:, k]
            unit = m.robot.joint_units[k]
            labels = f"speed of the joint ({unit}/s)", f"effort ({m.robot.effort_units[k]})"
        ax.plot(speeds, torques, color="black", lw=1.5, label="motion")
        most = float(np.abs(torques).max())
        for colour, fit in zip(plots.COLOURS, near(d), strict=False):
            most = max(most, float(fit.motor.curve[:, 1].max()))
            speed, torque = fit.motor.curve.T
            for sign in (1.0, -1.0):
                for way in (1.0, -1.0):
                    label = fit.motor.name if sign == way == 1.0 else None
                    ax.plot(way * speed / RPM, sign * torque, color=colour, lw=1, label=label)
        if d.fits:
            fastest = 1.3 * float(np.abs(speeds).max())
            ax.set(xlim=(-fastest, fastest), ylim=(-1.1 * most, 1.1 * most))
        title = f"{m.robot.name}: is the drive of {d.joint} strong enough? ({side})"
        plots.label(ax, *labels, title)
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    plots.save(figure, path)
