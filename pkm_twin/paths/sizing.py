# SPDX-License-Identifier: Apache-2.0
"""What drives must give for a motion: efforts, speeds, power and energy, at joint and motor.

At the joint power is effort times rate. With a drive of ``turns`` N (motor angle per joint motion),
rotor inertia J and efficiency e of the gear, the motor gives

    torque = J N qdd + load / (N e)     where the load takes power,
    torque = J N qdd + load e / N       where it gives power back,

with load = effort - J N^2 qdd, what goes through the gear.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from delta_dynamics import mass_matrix
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import FileError, ParameterError, UnknownNameError
from pkm_twin.machine import schema
from pkm_twin.machine.sections import DriveSpec
from pkm_twin.mechanisms.catalogue import config_folder
from pkm_twin.recordings.payload import by_load
from pkm_twin.recordings.recording import Recording

BLOCK: Final = 4096
"""Samples computed at a time, so that memory stays flat."""
LEAST: Final = 2
"""Samples of a motion."""
SHIPPED: Final = "shipped"
RPM: Final = 2 * math.pi / 60


@dataclass(frozen=True)
class Duty:
    """One side of a drive over a motion; torques in N m (or N), speeds in rad/s (or m/s).

    ``peak``: greatest amount of the effort; ``rms``: its root mean square, which heats the motor;
    ``speed``, ``mean_speed``: greatest and mean amount; ``power``: greatest, W; ``braking``:
    greatest power that comes back, W; ``work``, ``returned``: energy given and come back, J.
    """

    peak: float
    rms: float
    speed: float
    mean_speed: float
    power: float
    braking: float
    work: float
    returned: float

    @property
    def energy(self) -> float:
        """Given less come back, J."""
        return self.work - self.returned

    @classmethod
    def of(cls, time: Array, effort: Array, rate: Array) -> Duty:
        """Of a motion's samples (k,), by trapezoids."""
        power = effort * rate
        whole = float(time[-1] - time[0])
        return cls(
            float(np.abs(effort).max()), math.sqrt(integral(time, effort**2) / whole),
            float(np.abs(rate).max()), integral(time, np.abs(rate)) / whole,
            max(0.0, float(power.max())), max(0.0, -float(power.min())),
            integral(time, np.maximum(power, 0.0)), integral(time, np.maximum(-power, 0.0)),
        )  # fmt: skip

    def as_json(self, slides: bool) -> dict[str, float]:
        """Plain data, units in the keys."""
        force, rate = ("N", "m_s") if slides else ("N_m", "rad_s")
        return {
            f"peak_effort_{force}": self.peak, f"rms_effort_{force}": self.rms,
            f"peak_speed_{rate}": self.speed, f"mean_speed_{rate}": self.mean_speed,
            "peak_power_W": self.power, "peak_regenerated_power_W": self.braking,
            "work_J": self.work, "regenerated_J": self.returned, "energy_J": self.energy,
        }  # fmt: skip


def integral(time: Array, values: Array) -> float:
    """Trapezoids under values (k,) at times (k,)."""
    return float(np.sum(0.5 * np.diff(time) * (values[:-1] + values[1:])))


@dataclass(frozen=True, eq=False)
class Motor:
    """A motor as its data sheet has it: torques in N m, speeds in 1/min, inertia in kg m2.

    ``curve``: rows of speed and greatest torque; without it the peak torque up to the rated speed,
    then a straight line to the continuous torque at the greatest speed.
    """

    inertia: float = schema.number(low=1e-10, high=1e4, unit="kg m2")
    continuous_torque: float = schema.number(low=1e-6, high=1e7, unit="N m")
    peak_torque: float = schema.number(low=1e-6, high=1e7, unit="N m")
    rated_speed: float = schema.number(low=1e-3, high=1e7, unit="1/min")
    max_speed: float = schema.number(low=1e-3, high=1e7, unit="1/min")
    source: str = schema.text(default="")
    curve: Any = schema.key(
        lambda field, value: _curve(field, value), "rows of speed and torque", default=None
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

    @cached_property
    def limits(self) -> tuple[Array, Array]:
        """Rising speeds (k,), rad/s, and the greatest torque at them, N m."""
        rows = self.curve
        if rows is None:
            rows = np.array(
                [[0.0, self.peak_torque], [self.rated_speed, self.peak_torque],
                 [self.max_speed, self.continuous_torque]]
            )  # fmt: skip
        return RPM * rows[:, 0], rows[:, 1]

    def most(self, speed: Array) -> Array:
        """Greatest torque at speeds (k,), rad/s; 0 beyond the curve."""
        amount, (speeds, torques) = np.abs(speed), self.limits
        return np.where(amount > speeds[-1], 0.0, np.interp(amount, speeds, torques))


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


def read_entries(path: Path, key: str, of: str) -> dict[Any, Any]:
    """The mapping of a YAML under a key, from ``of`` to data.

    :raises ParameterError: the file cannot be read or has no such mapping.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise FileError(path, error, f"a YAML file of {key}") from None
    entries = data.get(key) if isinstance(data, dict) else None
    if not isinstance(entries, dict) or not entries:
        raise ParameterError(str(path), None, f"a mapping {key} of {of} to data")
    return entries


def read_motors(path: Path, names: Sequence[str] = ()) -> dict[str, Motor]:
    """Motors by name, of a YAML with a mapping ``drives`` of names to data.

    :raises ParameterError: by the field.
    """
    if str(path) == SHIPPED:
        path = config_folder() / "drives" / "servos.yaml"
    elif not path.suffix and not path.exists():
        raise UnknownNameError("drives", str(path), [SHIPPED, "FILE.yaml"])
    entries = read_entries(path, "drives", "names")
    for name in names:
        if name not in entries:
            raise UnknownNameError(f"{path}: motor", name, [str(n) for n in entries])
    return {
        str(name): schema.build(Motor, entry, f"{path}: drives.{name}")
        for name, entry in entries.items()
        if not names or name in names
    }


@dataclass(frozen=True)
class Fit:
    """How a motor suits a drive, its rotor in place of the file's.

    Greatest used parts of its torque curve, of its continuous torque and of its greatest speed, 1
    at the bound.
    """

    name: str
    motor: Motor
    torque: float
    thermal: float
    speed: float
    inertia_ratio: float

    @property
    def good(self) -> bool:
        """Whether all three are kept."""
        return max(self.torque, self.thermal, self.speed) <= 1.0

    @property
    def answer(self) -> str:
        """In words; beyond its greatest speed a motor has no torque to be compared."""
        slow = self.speed > 1.0
        small = max(self.thermal, 0.0 if slow else self.torque) > 1.0
        return " and ".join(["too small"] * small + ["too slow"] * slow) or "fits"

    def as_json(self) -> dict[str, Any]:
        """Plain data; parts are 1 at the bound."""
        return {
            "motor": self.name, "good": self.good, "used_torque": _finite(self.torque),
            "used_continuous_torque": self.thermal, "used_speed": self.speed,
            "inertia_ratio": _finite(self.inertia_ratio), "source": self.motor.source,
        }  # fmt: skip


@dataclass(frozen=True)
class Gear:
    """A gear for joints that turn, a screw or belt for joints that slide, where the file has none.

    ``ratio``: turns of the motor per turn of the joint; ``lead``: m per turn of the motor;
    ``efficiency``: of both.
    """

    ratio: float | None = None
    lead: float | None = None
    efficiency: float = 1.0

    def drive(self, joint: str, slides: bool, rotor: float, own: DriveSpec | None) -> DriveSpec:
        """The drive of a joint whose rotor has this inertia at the joint, kg m2 or kg.

        :raises ParameterError: the file has a drive, or this has no gear of the joint's type.
        """
        if own is not None:
            raise ParameterError(f"drive of {joint}", "in the file", "no other ratio or lead")
        way, name = (self.lead, "lead") if slides else (self.ratio, "ratio")
        if way is None:
            raise ParameterError(f"drive of {joint}", None, f"--{name}, for this type of joint")
        made = DriveSpec(0.0, efficiency=self.efficiency, **{name: way})
        return dataclasses.replace(made, inertia=rotor / made.turns**2)


@dataclass(frozen=True)
class DriveDuty:
    """What one drive gives: at its joint, and at its motor where the file has a ``drive``.

    ``load_inertia``: least and greatest inertia of the machine at the joint without the rotor,
    kg m2 or kg; ``inertia_ratio``: the greatest, seen by the motor, against the rotor's inertia.
    ``torques``, ``speeds``: the motor's, shape (k,), N m and rad/s.
    """

    joint: str
    slides: bool
    at_joint: Duty
    load_inertia: tuple[float, float]
    drive: DriveSpec | None = None
    at_motor: Duty | None = None
    inertia_ratio: float | None = None
    torques: Array | None = None
    speeds: Array | None = None
    fits: tuple[Fit, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Plain data, units in the keys."""
        unit = "kg" if self.slides else "kg_m2"
        data: dict[str, Any] = {
            "joint": self.at_joint.as_json(self.slides),
            f"load_inertia_{unit}": list(self.load_inertia),
            "motor": None if self.at_motor is None else self.at_motor.as_json(False),
            "inertia_ratio": self.inertia_ratio,
        }
        if self.fits:
            data["drives"] = [fit.as_json() for fit in self.fits]
        return data


def size_drives(
    motion: Recording, effort: Array, motors: Mapping[str, Motor] | None = None,
    gear: Gear | None = None,
) -> list[DriveDuty]:  # fmt: skip
    """What each drive must supply for a motion.

    :param motion: with rates and accelerations; ``effort``: the joints' efforts, shape (k, n).
    :param motors: candidates by name; each replaces the rotor of the robot's file.
    :param gear: of joints without a ``drive`` in the file; its ``rotor_inertia`` is behind it.
    :raises ParameterError: fewer than two samples; motors for a joint without a gear; a gear for a
        joint that has one, or of another type.
    """
    robot, time, (q, qd, qdd, _) = motion.robot, motion.time, motion.motion
    if len(time) < LEAST:
        raise ParameterError("motion", f"{len(time)} samples", f"{LEAST} or more")
    loaded = by_load(robot, motion.load, time, BLOCK)
    inertias = [mass_matrix(one, q[rows]) for one, rows in loaded]
    masses = np.diagonal(np.concatenate(inertias), axis1=-2, axis2=-1)
    graph = robot.graph
    result = []
    for i, (joint, drive) in enumerate(zip(robot.joint_names, robot.drives, strict=True)):
        slides = robot.joint_units[i] == "m"
        rotor = graph.joints[joint].rotor_inertia
        load = masses[:, i] - rotor
        span = (float(load.min()), float(load.max()))
        at_joint = Duty.of(time, effort[:, i], qd[:, i])
        if gear is not None:
            drive = gear.drive(joint, slides, rotor, drive)
        if drive is None:
            if motors:
                need = "lead, m per turn of the motor" if slides else "ratio, turns of the motor"
                raise ParameterError(
                    f"{robot.name}: drive of {joint}", "no gear in the file",
                    f"--{need}, or a section drive in the file, to compare motors",
                )  # fmt: skip
            result.append(DriveDuty(joint, slides, at_joint, span))
            continue
        through = effort[:, i] - rotor * qdd[:, i]
        turns, share = drive.turns, drive.efficiency
        speeds = turns * qd[:, i]
        torques = motor_torque(through, qd[:, i], qdd[:, i], drive.inertia, turns, share)
        fits = []
        for name, motor in (motors or {}).items():
            own = motor_torque(through, qd[:, i], qdd[:, i], motor.inertia, turns, share)
            fits.append(_fit(name, motor, time, own, speeds, span[1] / turns**2))
        ratio = span[1] / turns**2 / drive.inertia if drive.inertia > 0.0 else None
        result.append(
            DriveDuty(
                joint, slides, at_joint, span, drive, Duty.of(time, torques, speeds), ratio,
                torques, speeds, tuple(fits),
            )
        )  # fmt: skip
    return result


def motor_torque(
    through: Array, qd: Array, qdd: Array, inertia: float, turns: float, efficiency: float
) -> Array:
    """Torque of the motor, shape (k,), N m, see the module.

    :param through: effort at the joint that goes through the gear, shape (k,), N m or N.
    :param inertia: of the rotor, kg m2.
    """
    losses = np.where(through * qd < 0.0, efficiency, 1.0 / efficiency)
    return inertia * turns * qdd + through * losses / turns


def _fit(name: str, motor: Motor, time: Array, torques: Array, speeds: Array, load: float) -> Fit:
    most = motor.most(speeds)
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = np.where(most > 0.0, np.abs(torques) / most, np.where(torques == 0.0, 0.0, np.inf))
    rms = math.sqrt(integral(time, torques**2) / float(time[-1] - time[0]))
    fastest = float(np.abs(speeds).max()) / float(motor.limits[0][-1])
    return Fit(
        name,
        motor,
        float(parts.max()),
        rms / motor.continuous_torque,
        fastest,
        load / motor.inertia,
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
