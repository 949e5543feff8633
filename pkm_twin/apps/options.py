# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands of ``pkm-twin`` share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pkm_twin.console import parse_count_of_numbers
from pkm_twin.errors import ParameterError
from pkm_twin.files import STANDARD
from pkm_twin.report import Fact
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from pkm_twin.codegen.arrays import Array
    from pkm_twin.recordings import Dialect, Load, Recording
    from pkm_twin.robot.limits import LimitViolation
    from pkm_twin.robot.robot import Robot
    from stiffness_monitor.chatter import Milling

REFUSED, USAGE, SALVAGED, NOT_JUDGED = 1, 2, 3, 4
"""Exit codes: rejected; wrong usage; damaged, with messages that `recover` saves; no verdict."""

PICTURE_ENDINGS = (".png", ".svg", ".pdf")
"""Allowed endings of a picture's name."""
NEXT_TO_OUTPUT = "auto"
"""Value of --picture without a name: next to --out."""
ROBOT_HELP = "a robot's name (see `pkm-twin robots`), or its YAML, URDF, MJCF, SDF, USD"


class CheckedOptions:
    """Options that can be wrong in themselves, or name a robot that cannot be read."""

    def check_options(self) -> None:
        """Raise the error of wrong options before an existing target is rejected."""


@dataclass(frozen=True, kw_only=True)
class CutOutOptions:
    """Options that cut a machine out of a URDF, MJCF, SDF or USD: platform, base, motors, pose."""

    platform: str | None = setting(None, "for a URDF, MJCF, SDF or USD: the link that carries the tool")
    base: str | None = setting(
        None,
        "the link that is the ground of such a file; only parts between base and platform, and loops "
        "with them, are kept; default: the root",
    )
    actuated: tuple[str, ...] = setting((), "joints of such a file that have motors, NAME,NAME,...; default: as marked")
    pose_names: tuple[str, ...] = setting(
        (), "pose coordinates, of x y z roll pitch yaw; default: see `info`", name="pose", metavar="NAMES"
    )
    carry: bool = setting(False, "with --base: parts beyond the platform are its payload")

    @property
    def part(self) -> dict[str, Any]:
        """Keyword arguments of ``load`` that cut the machine out of its file."""
        lists = {"actuated": self.actuated, "pose": self.pose_names}
        split = {key: [n for text in some for n in text.split(",")] for key, some in lists.items()}
        chosen = {key: names or None for key, names in split.items()}
        return {"platform": self.platform, "base": self.base, "carry": self.carry, **chosen}


@dataclass(frozen=True, kw_only=True)
class RobotArgument(CutOutOptions, CheckedOptions):
    """Argument of a command on a robot."""

    robot: str = setting(..., ROBOT_HELP, argument=True)

    def machine(self) -> Robot:
        """Load the robot, with the payload if the command has one.

        :raises PkmTwinError: it cannot be read.
        """
        from pkm_twin import load

        return load(self.robot, **self.part)

    def check_options(self) -> None:
        """Raise the error of a robot or payload that cannot be read."""
        self.machine()


@dataclass(frozen=True, kw_only=True)
class PayloadOption(RobotArgument):
    """Option of a payload on the platform."""

    payload: str | None = setting(
        None,
        "payload: MASS[,x,y,z], kg, m from the platform's reference point; default: the recording's, "
        "else the robot file's",
    )

    @property
    def load(self) -> Load | None:
        """The payload; None if the option is not given."""
        from pkm_twin.recordings.payload import Load, parse_intervals, parse_payload

        times = getattr(self, "load_times", None)
        if self.payload is None:
            if times is not None:
                raise click.UsageError("--load-times needs --payload")
            return None
        try:
            return Load(*parse_payload(self.payload), () if times is None else parse_intervals(times))
        except ParameterError as error:
            raise click.UsageError(str(error)) from None

    def machine(self) -> Robot:
        """Load the robot with its payload."""
        machine, carried = super().machine(), self.load
        return machine if carried is None else carried.apply_to(machine)


@dataclass(frozen=True, kw_only=True)
class TimedPayloadOptions(PayloadOption):
    """Options of a payload that is held in intervals of time."""

    load_times: str | None = setting(None, "times at which --payload is held: FROM,TO[,FROM,TO...], s; default: always")

    def machine(self) -> Robot:
        """Load the robot without the payload, which is added at the times at which it is held."""
        return RobotArgument.machine(self)


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Options of the format of tables that are read."""

    separator: str | None = setting(None, "column separator: , ; or tab; default: detected")
    decimal: str | None = setting(None, "decimal mark: . or ,; default: detected")
    columns: tuple[str, ...] = setting((), "column names, OURS=THEIRS,...: 'leg_*.position=motor_*, x=pos_x [mm]'")
    units: str | None = setting(
        None,
        "units of columns whose header has none: rad, mrad, deg, rev, m, cm, mm, um, s, ms, us, ns, "
        "percent (of rated torque); default: SI",
        older=("--unit",),
    )
    time: str | None = setting(None, "name of the time column")

    @property
    def dialect(self) -> Dialect:
        """Format of the tables that are read.

        :raises ParameterError: an option has an invalid value.
        """
        from pkm_twin.recordings import Dialect

        return Dialect.from_options(self.separator, self.decimal, self.columns, self.units, self.time)


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(TableOptions):
    """Options of topics and of the format of recordings."""

    topic: tuple[str, ...] = setting((), "topic of joint states or wrenches; default: by joint names")
    side: str = setting(
        "joint",
        "whose values a table has: the joint's, controller's (joint_map) or motor's (drive)",
        choices=("joint", "controller", "motor"),
    )
    wrench_frame: str | None = setting(
        None,
        "frame of wrenches that turns with the platform; default: platform or --base-frame, as in the first wrench",
    )
    base_frame: str = setting("base_link", "frame of wrenches with base axes")

    def read(
        self, path: Path, robot: Robot | str | None, progress: Callable[[int], None] | None = None, **more: Any
    ) -> Recording:
        """Read a recording; ``more``: other fields of ``ReadOptions``."""
        from pkm_twin.bags.storage import is_bag
        from pkm_twin.recordings import ReadOptions, read

        if self.topic and not is_bag(path):
            raise click.UsageError(f"--topic is for bags; {path} is read as a table")
        names = ("load", "follow", "dialect", "side", "wrench_frame", "base_frame")
        own: dict[str, Any] = {name: getattr(self, name, None) for name in names}
        return read(path, robot, ReadOptions(self.topic, **own, **more), progress)


@dataclass(frozen=True, kw_only=True)
class MotionOptions(RecordingOptions):
    """Option of the coordinates that a motion is read from."""

    follow: str | None = setting(
        None,
        "the table's motion: joints, or pose (planned again for this robot); default: both, which must agree",
        choices=("joints", "pose"),
    )

    def read_motion(self, path: Path, robot: Robot) -> Recording:
        """Return a recorded or planned motion with velocities and accelerations.

        :raises ParameterError: its efforts were computed with what the file lacks, unless another
            payload is asked for.
        """
        from pkm_twin.paths.along import check_efforts, zero_resting_motion

        motion = zero_resting_motion(self.read(path, robot, planned=True).with_rates())
        return motion if getattr(self, "payload", None) is not None else check_efforts(motion)


@dataclass(frozen=True, kw_only=True)
class BeyondLimitsOption:
    """Option to compute outside the joint limits, too."""

    beyond_limits: bool = setting(False, "also compute outside the joint limits, marked")

    def list_beyond_limits(
        self, machine: Robot, q: Array, qd: Array | None = None, where: str = ""
    ) -> list[LimitViolation]:
        """Return the joints that joint states (..., n) take beyond their limits.

        :param where: name of the recording, for the error, if there are several.
        :raises ParameterError: a joint is beyond a limit and --beyond-limits is not given.
        """
        from pkm_twin.robot.limits import beyond_limits, reject_beyond_limits

        _, found = beyond_limits(machine, q, qd)
        if not self.beyond_limits:
            reject_beyond_limits(found, where)
        return found


@dataclass(frozen=True, kw_only=True)
class PoseOption(PayloadOption, BeyondLimitsOption):
    """Option of a pose of the platform."""

    at: str | None = setting(None, "the pose's coordinates, separated by commas; default: home")

    def pose(self, machine: Robot) -> list[float]:
        """Return the pose, shape (m,).

        :raises ParameterError: the pose is beyond the joint limits, and --beyond-limits is not given.
        """
        names = machine.pose_names
        pose: list[float] = machine.home().tolist()
        if self.at is not None:
            pose = parse_count_of_numbers(self.at, len(names), f"a pose {','.join(names)}")
        for joint in self.list_beyond_limits(machine, machine.inverse(pose)):
            click.echo(f"outside the limits: {joint}", err=True)
        return pose


@dataclass(frozen=True, kw_only=True)
class ToolOptions:
    """Options of the tool point and of modal damping."""

    tool: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), "tool point from the reference point, platform axes, m", count=3, metavar="x,y,z"
    )
    damping: tuple[float, ...] | None = setting(
        None,
        "damping ratios of modes from the lowest; the last holds for all others; default: the robot file's",
        count=0,
    )


@dataclass(frozen=True, kw_only=True)
class MillingOptions:
    """Options of a milling process."""

    teeth: int = setting(..., "teeth of the tool")
    tangential: float = setting(..., "tangential cutting coefficient Kt, N/m2, e.g. 600e6 for 600 MPa")
    radial: float = setting(..., "ratio of radial to tangential cutting force, Kr")
    immersion: float = setting(1.0, "radial depth of cut over tool diameter, 1 is a slot")
    up: bool = setting(False, "up-milling instead of down-milling")
    feed: float = setting(0.0, "direction of the feed, degrees from x towards y")

    @property
    def milling(self) -> Milling:
        """Milling process of the options.

        :raises ParameterError: a number out of range.
        """
        from stiffness_monitor.chatter import Milling

        return Milling(self.teeth, self.tangential, self.radial, self.immersion, self.up, math.radians(self.feed))


@dataclass(frozen=True, kw_only=True)
class AcceptOption:
    """Option to use data that the machine cannot have produced."""

    accept: bool = setting(False, "also use a recording that contradicts the machine, marked")


@dataclass(frozen=True, kw_only=True)
class OverwriteOption:
    """Option to replace existing files."""

    overwrite: bool = setting(False, "replace files that exist")


@dataclass(frozen=True, kw_only=True)
class OutputOption(OverwriteOption):
    """Option of a file to write; a command describes it by its own field ``out``."""

    out: Path | None = setting(None, "file to write", writes=True)


class DrawingOptions:
    """Options of a command that draws its result."""

    def drawing(self, command: str) -> Path | None:
        """Return the picture's file; None if none is drawn."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class PictureOptions(OverwriteOption, DrawingOptions):
    """Options of a picture of the result: named, or next to ``--out``."""

    picture: str | None = setting(
        None,
        "picture to draw: .png, .svg or .pdf, - for stdout; default: next to --out",
        metavar="[FILE]",
        alone=NEXT_TO_OUTPUT,
    )
    no_picture: bool = setting(False, "draw nothing next to --out")

    def drawing(self, command: str) -> Path | None:
        """Return the picture's file; None if none is drawn.

        :raises ParameterError: the name has an ending of no picture.
        """
        out = getattr(self, "out", None)
        if self.picture == STANDARD:
            if str(out) == STANDARD:
                raise click.UsageError("--out - and --picture -: only one of them to stdout")
            return Path(STANDARD)
        next_to_output = None if out is None or str(out) == STANDARD else out.with_suffix(".png")
        if self.no_picture or (self.picture is None and next_to_output is None):
            return None
        if self.picture in (None, NEXT_TO_OUTPUT):
            robot = getattr(self, "robot", None) or "recording"
            return next_to_output or Path(f"{command}_{Path(robot).stem}.png")
        picture = Path(str(self.picture))
        if picture.suffix not in PICTURE_ENDINGS:
            bound = f"a name that ends in {', '.join(PICTURE_ENDINGS)}"
            raise ParameterError("--picture", self.picture, bound)
        return picture


@dataclass(frozen=True, kw_only=True)
class ProcessesOption:
    """Option of the number of parallel processes."""

    jobs: int | None = setting(None, "processes on this computer; default: one per core", low=1, high=10**4)


@dataclass(frozen=True, kw_only=True)
class SeedOption:
    """Option of the seed of random numbers."""

    seed: int = setting(0, "seed of the random numbers", low=0, high=2**32 - 1)


@dataclass(frozen=True, kw_only=True)
class SingularityOption:
    """Option of the smallest singularity index of poses that count."""

    singularity: float = setting(0.05, "least singularity index of a pose", low=0.0, high=1.0)


def payload_fact(carried: Load | None) -> Fact:
    """Report the payload that a command used."""
    data = None if carried is None else carried.as_json()
    return Fact("payload", data, text="payload", shown=str(carried or "as in the robot file"))
