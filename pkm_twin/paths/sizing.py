# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Size drives for a motion: efforts, speeds, power and energy, at joint and motor.

At the joint power is effort times rate. With a drive of ``turns`` N (motor angle per joint motion),
rotor inertia J and efficiency e of the gear, the motor gives

    torque = J N qdd + load / (N e)     where the load takes power,
    torque = J N qdd + load e / N       where it gives power back,

with load = effort - J N^2 qdd, the effort through the gear. J includes a gear's own inertia at the
motor. Joint and effort are the model's: the ratio of a ``joint_map`` converts a controller's
numbers before that, and is not N.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from delta_dynamics import mass_matrix
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine import schema
from pkm_twin.machine.sections import MAX_LEAD, DriveSpec
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.mechanisms.catalogue import config_folder
from pkm_twin.recordings.payload import split_by_load
from pkm_twin.recordings.recording import Recording

SAMPLES_PER_BLOCK: Final = 4096
"""Samples computed at a time, so that memory use is bounded."""
SHIPPED: Final = "shipped"
"""Name of the file of drives that is shipped with the package."""
RPM: Final = 2 * math.pi / 60
"""One revolution per minute, rad/s."""
CLOSED_CYCLE: Final = 1e-4
"""Part of the regenerated energy below which the net energy is an integration error: one drive of a
fastest cycle errs by 1.3e-5 at 1 kHz, as its effort steps within an interval."""
GEARS_PER_ROUND: Final = 33
"""Gears of a range that are tried in a round."""


@dataclass(frozen=True)
class Duty:
    """Hold one side of a drive over a motion; torques in N m (or N), speeds in rad/s (or m/s).

    ``peak``: largest magnitude of the effort; ``rms``: its root mean square, which heats the motor;
    ``speed``, ``mean_speed``: largest and mean magnitude; ``power``: largest, W; ``braking``:
    largest regenerated power, W; ``work``, ``returned``: energy delivered and regenerated, J.
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
        """Energy delivered minus energy regenerated, J."""
        return self.work - self.returned

    @classmethod
    def from_samples(cls, time: Array, effort: Array, rate: Array, net: Array) -> Duty:
        """Integrate a motion's samples (k,) by the trapezoidal rule.

        :param net: energy delivered minus regenerated in each interval, shape (k - 1,), J. Where an
            effort steps between two samples, trapezoids alone would not conserve energy.
        """
        power = effort * rate
        whole = float(time[-1] - time[0])
        given, back = (_integrate_intervals(time, np.maximum(side * power, 0.0)) for side in (1.0, -1.0))
        less = net < given - back
        given, back = (
            np.where(less, np.maximum(net + back, 0.0), np.maximum(given, net)),
            np.where(less, np.maximum(back, -net), np.maximum(given - net, 0.0)),
        )
        return cls(
            float(np.abs(effort).max()),
            rms(time, effort),
            float(np.abs(rate).max()),
            float(_integrate_intervals(time, np.abs(rate)).sum()) / whole,
            max(0.0, float(power.max())),
            max(0.0, -float(power.min())),
            float(given.sum()),
            float(back.sum()),
        )

    def as_json(self, slides: bool) -> dict[str, float]:
        """Return plain data, units in the keys."""
        force, rate = ("N", "m_s") if slides else ("N_m", "rad_s")
        return {
            f"peak_effort_{force}": self.peak,
            f"rms_effort_{force}": self.rms,
            f"peak_speed_{rate}": self.speed,
            f"mean_speed_{rate}": self.mean_speed,
            "peak_power_W": self.power,
            "peak_regenerated_power_W": self.braking,
            "work_J": self.work,
            "regenerated_J": self.returned,
            "energy_J": self.energy,
        }


def compute_net_energy(duties: Sequence[Duty]) -> float:
    """Return the energy that drives take, J: 0 for a closed cycle, which gives back all of it."""
    net = sum(duty.energy for duty in duties)
    return net if abs(net) > CLOSED_CYCLE * sum(duty.returned for duty in duties) else 0.0


def _integrate_intervals(time: Array, values: Array) -> Array:
    """Return the trapezoid under each interval of values (k,), shape (k - 1,)."""
    return np.asarray(0.5 * np.diff(time) * (values[:-1] + values[1:]), np.float64)


@dataclass(frozen=True, eq=False)
class Motor:
    """Describe a motor by its data sheet: torques in N m, speeds in 1/min, inertia in kg m2.

    ``curve``: rows of speed and largest torque; without it the peak torque up to the rated speed,
    then a straight line to the continuous torque at the greatest speed.
    """

    inertia: float = schema.number(low=1e-10, high=1e4, unit="kg m2")
    continuous_torque: float = schema.number(low=1e-6, high=1e7, unit="N m")
    peak_torque: float = schema.number(low=1e-6, high=1e7, unit="N m")
    rated_speed: float = schema.number(low=1e-3, high=1e7, unit="1/min")
    max_speed: float = schema.number(low=1e-3, high=1e7, unit="1/min")
    cost: float | None = schema.number(low=0.0, default=None)
    source: str = schema.text(default="")
    curve: Any = schema.key(lambda field, value: _read_curve(field, value), "rows of speed and torque", default=None)

    def verify(self, path: str) -> None:
        """Check that the data sheet's values are consistent."""
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
        """Rising speeds (k,), rad/s, and the largest torque at them, N m."""
        rows = self.curve
        if rows is None:
            peak, last = self.peak_torque, [self.max_speed, self.continuous_torque]
            rows = np.array([[0.0, peak], [self.rated_speed, peak], last])
        return RPM * rows[:, 0], rows[:, 1]

    def most(self, speed: Array) -> Array:
        """Return the largest torque at speeds (k,), rad/s; 0 beyond the curve."""
        amount, (speeds, torques) = np.abs(speed), self.limits
        return np.where(amount > speeds[-1], 0.0, np.interp(amount, speeds, torques))


def _read_curve(field: str, value: Any) -> Array:
    try:
        rows = np.array(value, float)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    pairs = rows.ndim == 2 and rows.shape[1:] == (2,) and len(rows) > 1
    if not (
        pairs
        and rows[0, 0] == 0.0
        and (np.diff(rows[:, 0]) > 0.0).all()
        and ((rows >= 0.0) & (rows <= 1e7)).all()
        and rows[:, 1].any()
    ):
        raise ParameterError(field, value, "rows of speed (1/min, rising from 0) and torque (N m), up to 1e+07")
    return rows


def read_entries(path: Path, key: str, entry_kind: str, needed: bool = True) -> dict[Any, Any]:
    """Read the YAML mapping under a key; return {} if it is missing and not ``needed``.

    :param entry_kind: what the keys name, for the error.

    :raises ParameterError: the file cannot be read or has no such mapping.
    """
    entries = read_yaml(path).get(key)
    if entries is None and not needed:
        return {}
    if not isinstance(entries, dict) or not entries:
        raise ParameterError(str(path), None, f"a mapping {key} of {entry_kind} to data")
    return entries


@dataclass(frozen=True)
class Gear:
    """Describe a gear for rotary joints, or a screw or belt for sliding joints.

    ``ratio``: turns of the motor per turn of the joint; ``lead``: m per turn of the motor.
    ``inertia``: at the motor, kg m2. At the joint, N m and rad, or N and m: ``backlash``,
    ``continuous_torque`` (RMS) and ``peak_torque``.
    """

    ratio: float | None = schema.number(low=1e-6, high=1e6, unit="turns per turn", default=None)
    lead: float | None = schema.number(low=1e-6, high=MAX_LEAD, unit="m per turn", default=None)
    efficiency: float = schema.number(above=0.0, high=1.0, default=1.0)
    inertia: float = schema.number(low=0.0, high=1e4, unit="kg m2", default=0.0)
    backlash: float | None = schema.number(low=0.0, unit="rad or m", default=None)
    continuous_torque: float | None = schema.number(above=0.0, unit="N m or N", default=None)
    peak_torque: float | None = schema.number(above=0.0, unit="N m or N", default=None)
    cost: float | None = schema.number(low=0.0, default=None)
    source: str = schema.text(default="")
    name: str = ""

    def verify(self, path: str) -> None:
        """Check that exactly one of ratio and lead is given."""
        self.drive().verify(path)

    def drive(self, inertia: float = 0.0) -> DriveSpec:
        """Return a drive with this gear and a rotor inertia, kg m2."""
        return DriveSpec(inertia, self.ratio, self.lead, self.efficiency)

    @property
    def size(self) -> float:
        """The ratio or the lead."""
        return (self.ratio if self.lead is None else self.lead) or 0.0

    def with_size(self, key: str, size: float) -> Gear:
        """Return the gear with another ratio or lead."""
        return replace(self, ratio=size) if key == "ratio" else replace(self, lead=size)

    def used(self, time: Array, through: Array) -> float:
        """Return the largest used fraction of the gear's torques by an effort (k,)."""
        peak = float(np.abs(through).max()) / (self.peak_torque or math.inf)
        return max(peak, rms(time, through) / (self.continuous_torque or math.inf))

    def __str__(self) -> str:
        words = f"{self.size:.4g}:1" if self.lead is None else f"{1e3 * self.lead:.4g} mm per turn"
        return f"{self.name} ({words})" if self.name else words


@dataclass(frozen=True)
class Gears:
    """Hold gears to choose from; ``span``: also all ratios between two neighbours."""

    gears: tuple[Gear, ...]
    span: bool = False

    @classmethod
    def parse(cls, key: str, text: str, efficiency: float = 1.0) -> Gears:
        """Parse ``LOW:HIGH`` or numbers separated by commas; ``key``: ratio or lead.

        :raises ParameterError: another form, or numbers that no gear has.
        """
        span = ":" in text
        try:
            values = [float(word) for word in text.split(":" if span else ",")]
        except ValueError:
            values = []
        low_first = len(values) == 2 and values[0] < values[1]
        most, unit = (1e6, "") if key == "ratio" else (MAX_LEAD, " m per turn")
        if not values or not all(1e-6 <= v <= most for v in values) or (span and not low_first):
            bound = f"LOW:HIGH or numbers with commas, 1e-6 to {most:g}{unit}"
            raise ParameterError(f"--{key}s", text, bound)
        steps = np.geomspace(values[0], values[1], GEARS_PER_ROUND).tolist() if span else values
        own = Gear(efficiency=efficiency)
        return cls(tuple(own.with_size(key, value) for value in steps), span)


def read_motors(path: Path, names: Sequence[str] = ()) -> dict[str, Motor]:
    """Read motors by name from a YAML mapping ``drives``.

    :raises ParameterError: names the field.
    """
    path = _resolve_file(path)
    entries = read_entries(path, "drives", "names")
    for name in names:
        if name not in entries:
            raise UnknownNameError(f"{path}: motor", name, [str(n) for n in entries])
    return {
        str(name): schema.build(Motor, entry, f"{path}: drives.{name}")
        for name, entry in entries.items()
        if not names or name in names
    }


def read_gears(path: Path) -> tuple[Gear, ...]:
    """Read gears from the mapping ``gears`` of the same file; none if it has none.

    :raises ParameterError: by the field.
    """
    path = _resolve_file(path)
    return tuple(
        replace(schema.build(Gear, entry, f"{path}: gears.{name}"), name=str(name))
        for name, entry in read_entries(path, "gears", "names", needed=False).items()
    )


def _resolve_file(path: Path) -> Path:
    """Return the path of a file of drives, or of the shipped one."""
    if str(path) == SHIPPED:
        return config_folder() / "drives" / "servos.yaml"
    if not path.suffix and not path.exists():
        raise UnknownNameError("drives", str(path), [SHIPPED, "FILE.yaml"])
    return path


@dataclass(frozen=True, eq=False)
class Fit:
    """Describe how a motor and a gear suit a drive, with the motor's rotor instead of the file's.

    ``torque``, ``thermal``, ``speed``, ``geared``: largest used fractions of the torque curve, the
    continuous torque, the largest speed and the gear's torques, 1 at the bound. ``inertia_ratio``:
    largest load inertia at the motor plus the gear's, over the rotor's. ``torques``, ``speeds``:
    the motor's, shape (k,), N m and rad/s; ``rms``, N m.
    """

    name: str
    motor: Motor
    gear: Gear
    torque: float
    thermal: float
    speed: float
    geared: float
    inertia_ratio: float
    rms: float
    torques: Array
    speeds: Array

    @property
    def used(self) -> float:
        """Largest used fraction."""
        return max(self.torque, self.thermal, self.speed, self.geared)

    @property
    def good(self) -> bool:
        """True if all bounds are kept."""
        return self.used <= 1.0

    @property
    def answer(self) -> str:
        """Verdict in words; beyond its largest speed a motor has no torque to compare with."""
        slow = self.speed > 1.0
        small = max(self.thermal, 0.0 if slow else self.torque) > 1.0
        words = ["too small"] * small + ["too slow"] * slow + ["gear too small"] * (self.geared > 1)
        return " and ".join(words) or "fits"

    @property
    def cost(self) -> float | None:
        """Cost of the motor, and of the gear if it has one."""
        return None if self.motor.cost is None else self.motor.cost + (self.gear.cost or 0.0)

    def as_json(self) -> dict[str, Any]:
        """Return plain data; fractions are 1 at the bound."""
        return {
            "good": self.good,
            "used_torque": _finite_or_none(self.torque),
            "used_continuous_torque": self.thermal,
            "used_speed": self.speed,
            "inertia_ratio": _finite_or_none(self.inertia_ratio),
            "source": self.motor.source,
            **self.choice,
            "used_gear_torque": self.geared,
            "rms_torque_N_m": self.rms,
            "peak_torque_N_m": float(np.abs(self.torques).max()),
            "peak_speed_rad_s": float(np.abs(self.speeds).max()),
            "cost": self.cost,
            "backlash": self.gear.backlash,
        }

    @property
    def choice(self) -> dict[str, Any]:
        """Motor and gear as plain data."""
        gear = self.gear
        return {"motor": self.name, "gear": gear.name or None, "ratio": gear.ratio, "lead_m": gear.lead}

    def __str__(self) -> str:
        return f"{self.name} with {self.gear}"


@dataclass(frozen=True)
class DriveDuty:
    """Describe the load of one drive: at its joint, and at its motor if the file has a ``drive``.

    ``load_inertia``: smallest and largest inertia of the machine at the joint without the rotor,
    kg m2 or kg; ``inertia_ratio``: the largest at the motor over the rotor's inertia.
    ``torques``, ``speeds``: the motor's, shape (k,), N m and rad/s. ``fits``: each motor with the
    gear that is best for this drive; ``alike``: with the gear that is best for all such drives.
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
    alike: tuple[Fit, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return plain data, units in the keys."""
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
    motion: Recording,
    effort: Array,
    motors: Mapping[str, Motor] | None = None,
    given: Sequence[Gear] = (),
    choices: Sequence[Gears] = (),
) -> list[DriveDuty]:
    """Compute what each drive must supply for a motion.

    :param motion: with rates and accelerations; ``effort``: the joints' efforts, shape (k, n).
    :param motors: candidates by name; each replaces the rotor of the robot's file.
    :param given: gears of joints without a ``drive`` in the file, one per type; the file's
        ``rotor_inertia`` is behind them.
    :param choices: gears to choose from, in place of the file's: of each type, every motor gets
        the one that leaves the most margin.
    :raises ParameterError: fewer than two samples; motors for a joint without a gear; a gear for a
        joint that has one, or of another type.
    """
    robot, time, (q, qd, qdd, _) = motion.robot, motion.time, motion.motion
    if len(time) < 2:
        raise ParameterError("motion", f"{len(time)} samples", "2 or more")
    loaded = split_by_load(robot, motion.load, time, SAMPLES_PER_BLOCK)
    inertias = np.concatenate([mass_matrix(one, q[rows]) for one, rows in loaded])
    masses = np.diagonal(inertias, axis1=-2, axis2=-1)
    # Positions and rates at an interval's ends give its exact mean rate and acceleration.
    step, mean = np.diff(time)[:, None], 0.5 * (qd[:-1] + qd[1:])
    change = np.diff(qd, axis=0) / step
    middle = 0.5 * (inertias[:-1] + inertias[1:])
    rest = effort - np.einsum("kij,kj->ki", inertias, qdd)
    net = 0.5 * (rest[:-1] + rest[1:]) * np.diff(q, axis=0)
    net = net + np.einsum("kij,kj->ki", middle, change) * mean * step
    duties, axes = [], []
    for i, (joint, own) in enumerate(zip(robot.joint_names, robot.drives, strict=True)):
        slides = robot.joint_units[i] == "m"
        rotor = robot.graph.joints[joint].rotor_inertia
        load = masses[:, i] - rotor
        span = (float(load.min()), float(load.max()))
        duty = DriveDuty(joint, slides, Duty.from_samples(time, effort[:, i], qd[:, i], net[:, i]), span)
        axis = _Axis(time, qd[:, i], qdd[:, i], effort[:, i] - rotor * qdd[:, i], span[1])
        drive = own
        if given:
            if own is not None:
                raise ParameterError(f"drive of {joint}", "in the file", "no ratio or lead; or --ratios")
            gear = next((gear for gear in given if (gear.lead is not None) == slides), None)
            if gear is None:
                raise ParameterError(
                    f"drive of {joint}", None, f"--{'lead' if slides else 'ratio'}, for this type of joint"
                )
            drive = gear.drive(rotor / gear.drive().turns ** 2)
        if drive is not None:
            torques = axis.torques(drive.inertia, drive)
            speeds = drive.turns * axis.qd
            factors = 0.5 * (axis.efficiency_factor(drive)[:-1] + axis.efficiency_factor(drive)[1:])
            turning = (change * mean * step)[:, i]
            own_net = drive.inertia * drive.turns**2 * turning
            own_net = own_net + (net[:, i] - rotor * turning) * factors
            ratio = span[1] / drive.turns**2 / drive.inertia if drive.inertia > 0.0 else None
            duty = replace(
                duty,
                drive=drive,
                at_motor=Duty.from_samples(time, torques, speeds, own_net),
                inertia_ratio=ratio,
                torques=torques,
                speeds=speeds,
            )
        duties.append(duty)
        axes.append(axis)
    if not motors:
        return duties
    chosen = []
    for duty in duties:
        drive, allowed = (
            duty.drive,
            next((one for one in choices if (one.gears[0].lead is not None) == duty.slides), None),
        )
        if allowed is None:
            if drive is None or choices:
                need = "lead, m per turn of the motor" if duty.slides else "ratio, turns of the motor"
                raise ParameterError(
                    f"{robot.name}: drive of {duty.joint}",
                    f"no {need.partition(',')[0]}",
                    f"--{need}, or a section drive in the file, to compare motors",
                )
            allowed = Gears((Gear(drive.ratio, drive.lead, drive.efficiency),))
        chosen.append(allowed)
    for choice in dict.fromkeys(chosen):
        rows = [i for i, one in enumerate(chosen) if one == choice]
        alike = [_fit_best_gear([axes[i] for i in rows], n, m, choice) for n, m in motors.items()]
        for column, i in enumerate(rows):
            shared = tuple(row[column] for row in alike)
            own_fits = shared
            if len(choice.gears) > 1 and len(rows) > 1:
                own_fits = tuple(_fit_best_gear([axes[i]], n, m, choice)[0] for n, m in motors.items())
            duties[i] = replace(duties[i], fits=own_fits, alike=shared)
    return duties


@dataclass(frozen=True)
class _Axis:
    """Hold a joint over a motion: velocities, accelerations and efforts through the gear, (k,).

    ``load``: largest inertia of the load, kg m2 or kg.
    """

    time: Array
    qd: Array
    qdd: Array
    through: Array
    load: float

    def torques(self, inertia: float, drive: DriveSpec) -> Array:
        """Return the motor's torques (module equation), (k,), N m; ``inertia``: at the motor."""
        turns = drive.turns
        return np.asarray(inertia * turns * self.qdd + self.through * self.efficiency_factor(drive) / turns)

    def efficiency_factor(self, drive: DriveSpec) -> Array:
        """Return the factor by which the gear's efficiency changes the load, shape (k,)."""
        back = self.through * self.qd < 0.0
        return np.where(back, drive.efficiency, 1.0 / drive.efficiency)

    def fit(self, name: str, motor: Motor, gear: Gear) -> Fit:
        """Evaluate a motor with a gear for the joint."""
        drive = gear.drive()
        torques = self.torques(motor.inertia + gear.inertia, drive)
        speeds = drive.turns * self.qd
        most = motor.most(speeds)
        with np.errstate(divide="ignore", invalid="ignore"):
            idle = np.where(torques == 0.0, 0.0, np.inf)
            parts = np.where(most > 0.0, np.abs(torques) / most, idle)
        root = rms(self.time, torques)
        seen = self.load / drive.turns**2 + gear.inertia
        return Fit(
            name,
            motor,
            gear,
            float(parts.max()),
            root / motor.continuous_torque,
            float(np.abs(speeds).max()) / float(motor.limits[0][-1]),
            gear.used(self.time, self.through),
            seen / motor.inertia,
            root,
            torques,
            speeds,
        )


def _fit_best_gear(axes: Sequence[_Axis], name: str, motor: Motor, choice: Gears) -> list[Fit]:
    """Choose one gear for several joints: it minimises the largest used fraction of all joints."""
    # Refine a range between the neighbours of the best gear. A motor beyond its curve has no torque,
    # so that its used fraction is infinite; then heat and speed decide.
    for _ in range(4 if choice.span else 1):
        rows = [[axis.fit(name, motor, gear) for axis in axes] for gear in choice.gears]
        ranks = [(max(f.used for f in fits), max(max(f.thermal, f.speed) for f in fits)) for fits in rows]
        k = ranks.index(min(ranks))
        if choice.span:
            low, high = choice.gears[max(0, k - 1)], choice.gears[min(k + 1, len(choice.gears) - 1)]
            key = "ratio" if low.lead is None else "lead"
            steps = np.geomspace(low.size, high.size, GEARS_PER_ROUND).tolist()
            choice = replace(choice, gears=tuple(low.with_size(key, size) for size in steps))
    return rows[k]


def find_smallest(fits: Sequence[Sequence[Fit]]) -> int | None:
    """Find the motor of the smallest continuous torque that suits all drives; None without one."""
    good = [k for k, row in enumerate(zip(*fits, strict=True)) if all(fit.good for fit in row)]
    return min(good, key=lambda k: fits[0][k].motor.continuous_torque, default=None)


def rms(time: Array, values: Array) -> float:
    """Return the root mean square over time of values (k,)."""
    return math.sqrt(float(_integrate_intervals(time, values**2).sum()) / float(time[-1] - time[0]))


def _finite_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
