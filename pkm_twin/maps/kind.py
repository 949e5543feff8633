# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Define a kind of map: a quantity of a pose, its unit, and which value is worst.

Grid, search of the worst pose, storage, pictures, pages and commands are the same for all kinds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import belong_to_workspace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

FORMAT_VERSION: Final = "2"
"""Version of the file format; files of another version are rejected."""
NON_NEGATIVE: Final = {"valid_min": 0.0}
UNIT_INTERVAL: Final = {"units": "1", "valid_min": 0.0, "valid_max": 1.0}
FLAG_BOUNDS: Final = {"valid_min": 0, "valid_max": 1}
NO_BOUNDS: Final[Mapping[str, Any]] = MappingProxyType({})
"""Attributes that bound a variable (CF conventions, 2.5.1), checked when a file is opened."""
Values = dict[str, NDArray[Any]]


def describe(what: str, units: str = "", bounds: Mapping[str, Any] = NO_BOUNDS) -> dict[str, Any]:
    """Return the attributes of a variable: its bounds, its unit if any, and its description."""
    return {**bounds, **({"units": units} if units else {}), "long_name": what}


@dataclass(frozen=True, eq=False)
class Variable:
    """Hold a small array with named dimensions: a coordinate or a summary."""

    dims: tuple[str, ...]
    values: NDArray[Any]
    attrs: Mapping[str, Any]


@dataclass(frozen=True)
class Field:
    """Describe a large array that is computed chunk by chunk."""

    dims: tuple[str, ...]
    attrs: Mapping[str, Any]
    dtype: str = "f8"


def scalar(value: Any, what: str, units: str = "", bounds: Mapping[str, Any] = NO_BOUNDS) -> Variable:
    """Return a single number as a variable."""
    return Variable((), np.array(value), describe(what, units, bounds))


def name_labels(dim: str, words: Iterable[str]) -> Variable:
    """Return names along a dimension as a variable."""
    return Variable((dim,), np.array(list(words), "U"), {})


class Found(NamedTuple):
    """Values of a quantity in k poses: ``value`` (k,), ``direction`` (k, axes), ``element`` (k,).

    ``element``: index of the critical element. ``shares``: fractions of the elements, shape (k,
    elements). A kind without directions, elements or shares leaves them out.
    """

    value: Array
    direction: Array | None = None
    element: NDArray[np.int64] | None = None
    shares: Array | None = None


@dataclass(frozen=True)
class Case:
    """Describe one quantity of a map, for example one load case or one mode.

    ``what`` and ``unit``: of the value. ``answer``: name of the worst pose, as "softest".
    ``largest``: whether the largest value is the worst. ``wrench``: external force (N) and moment
    (N m) on the platform at its reference point, base axes. ``interfering``: whether poses in which
    limbs interfere count.
    """

    name: str
    what: str
    unit: str
    answer: str
    largest: bool = True
    wrench: tuple[float, ...] | None = None
    interfering: bool = False


@dataclass(frozen=True)
class Kind:
    """Define a kind of map; its fields are the options of its command.

    ``question``: what its picture answers. ``points``: of the grid; ``chunk``: poses that are
    computed at once; ``samples``, ``population`` and ``rounds``: size of the search for the worst
    pose. ``screen``: for a slow quantity, a fast one that is bad in the same poses.
    ``least``: default singularity index below which a pose does not count. ``together``: all cases
    share the worst pose of the first. ``signed``: values may be negative. ``facts_first``: whether
    the facts answer the question. ``page_help``: explains the further figure of the page.
    """

    name: ClassVar[str]
    question: ClassVar[str]
    answer: ClassVar[str]
    what: ClassVar[str]
    unit: ClassVar[str] = ""
    largest: ClassVar[bool] = True
    element: ClassVar[str] = "element"
    has_shares: ClassVar[bool] = False
    takes_wrench: ClassVar[bool] = False
    together: ClassVar[bool] = False
    signed: ClassVar[bool] = False
    facts_first: ClassVar[bool] = False
    least: ClassVar[float] = 0.05
    points: ClassVar[int] = 50_000
    chunk: ClassVar[int] = 16384
    samples: ClassVar[int] = 8192
    population: ClassVar[int] = 256
    rounds: ClassVar[int] = 200
    screen: ClassVar[Kind | None] = None
    page_help: ClassVar[str] = ""

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Evaluate the quantity at joint positions (k, n), k above zero.

        :raises ParameterError: the robot's file lacks what the quantity needs.
        """
        raise NotImplementedError

    def each(self, robot: Robot, q: Array, cases: Sequence[Case]) -> list[Found]:
        """Evaluate several cases at joint positions (k, n)."""
        return [self.found(robot, q, case) for case in cases]

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return the cases of a map without given loads."""
        return (Case(self.name, self.what, self.unit, self.answer, self.largest),)

    def loaded(self, robot: Robot, name: str, wrench: Sequence[float]) -> Case:
        """Return a load case with a name.

        :raises ParameterError: other than six finite numbers, or a kind without loads.
        """
        if not self.takes_wrench:
            raise ParameterError("wrench", name, f"no wrench for the map {self.name}")
        if len(wrench) != 6 or not np.isfinite(wrench).all() or not np.any(wrench):
            raise ParameterError("wrench", list(wrench), "six finite numbers, not all zero")
        return replace(self.cases(robot)[0], name=name, wrench=tuple(map(float, wrench)))

    def elements(self, robot: Robot) -> tuple[str, ...]:
        """Return the names that ``element`` indexes; those of the drives for an element "drive"."""
        return robot.joint_names if self.element == "drive" else ()

    def axes(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of a direction's components."""
        return ("x", "y", "z")

    def arrays(self, robot: Robot, poses: Array) -> dict[str, Array]:
        """Return further arrays of poses (k, m) for an .npz file."""
        return {}

    @property
    def options(self) -> dict[str, Any]:
        """The kind's own options, for a file."""
        return asdict(self)

    def summaries(self, space: Space, counted: int, separate: int) -> dict[str, Variable]:
        """Return results over the whole workspace.

        :param counted: number of grid poses that keep all bounds except that on the clearance;
            ``separate``: number of these in which no limbs interfere.
        """
        return {}

    @classmethod
    def facts(cls, data: Dataset) -> list[str]:
        """Return sentences about a stored map, in addition to those on worst poses."""
        return []

    @classmethod
    def overlay(cls, data: Dataset, names: tuple[str, ...], through: Mapping[str, float], ax: Axes) -> str:
        """Draw over a plane of two pose coordinates; return an explanation for the caption."""
        return ""

    @classmethod
    def figures(cls, data: Dataset) -> dict[str, Figure]:
        """Draw further pictures of a stored map, by name."""
        return {}

    @classmethod
    def page(cls, data: Dataset) -> Any:
        """Return a further plotly figure of a stored map for its page; None without one."""
        return None


@dataclass(frozen=True, eq=False)
class Worst:
    """Hold a worst pose (m,), its joint positions (n,), and the kind's values there.

    ``index``: singularity index. ``bounded``: whether only the bound on it excludes worse poses
    nearby.
    """

    pose: Array
    q: Array
    found: Found
    index: float
    bounded: bool


@dataclass(frozen=True, eq=False)
class Space:
    """Describe the poses of a map, and decide which of them count.

    ``bounds``: of the pose coordinates, shape (m, 2). ``ticks``: of a grid of up to three of them;
    otherwise empty, and ``samples`` joint positions are drawn at random. ``side``: poses along a
    side of a plane. ``least``: singularity index, and ``least_clearance``: distance of the limbs,
    m, below which a pose does not count. ``at``: the pose (m,) that planes go through, instead of
    the worst. ``worst``: of each case, once they are known. ``circles``: heights and radii, shape
    (2, k), of the circles about the axis that a pose has to be in; None for all poses.
    """

    robot: Robot
    kind: Kind
    cases: tuple[Case, ...]
    bounds: Array
    ticks: tuple[Array, ...]
    samples: int
    side: int
    least: float
    least_clearance: float
    at: Array | None = None
    worst: tuple[Worst, ...] = ()
    circles: Array | None = None

    @property
    def has_joint_limits(self) -> bool:
        """True if finite limits bound the joint positions."""
        limits = self.robot.limits.position
        return limits is not None and bool(np.isfinite(limits).all())

    @property
    def box(self) -> Array:
        """Box of the search for worst poses: limits of joints (n, 2), or bounds of poses."""
        limits = self.robot.limits.position
        return limits if self.has_joint_limits and limits is not None else self.bounds

    def evaluate_point(self, x: Array) -> tuple[Array, Array, Mask]:
        """Return joint positions, poses, and which are known, for points (k, n) of the box."""
        if not self.has_joint_limits:
            return self.evaluate_poses(x)
        pose, known = self.robot.try_forward(x)
        return x, np.where(known[:, None], pose, self.robot.home()), known

    def evaluate_poses(self, poses: Array) -> tuple[Array, Array, Mask]:
        """Return joint positions, the poses (k, m), and which of them are known."""
        q, known = self.robot.try_inverse(poses)
        return np.where(known[:, None], q, self.robot.graph.home), poses, known

    def is_in_workspace(self, q: Array, pose: Array, known: Mask, case: Case) -> Mask:
        """Return the mask of joint positions (k, n) and poses (k, m) in the workspace, (k,)."""
        bound = -math.inf if case.interfering else self.least_clearance
        return belong_to_workspace(self.robot, q, pose, known & self.is_encircled(pose), self.least, bound)

    def is_encircled(self, pose: Array) -> Mask:
        """Return which poses (k, m) are inside the circles, linear between their heights."""
        if self.circles is None:
            return np.ones(len(pose), bool)
        grid = self.robot.grid()
        height = pose[:, self.robot.pose_names.index(grid.height)]
        layers, radii = self.circles
        radius = np.interp(height, layers, radii, left=np.nan, right=np.nan)
        # Comparisons with NaN, for a circle that is too small, are false.
        return np.asarray(radius >= grid.distance(pose))

    def planes_pose(self, case: int) -> Array:
        """Return the pose (m,) in which the planes of a case intersect."""
        return self.worst[case].pose if self.at is None else self.at


def evaluate_kind(kind: Kind, robot: Robot, q: Array, cases: Sequence[Case]) -> list[Found]:
    """Evaluate a kind's cases at joint positions (k, n); NaN in poses without a value."""
    ways = len(kind.axes(robot))

    def fill_absent(k: int) -> Found:
        shares = np.full((k, len(kind.elements(robot))), np.nan) if kind.has_shares else None
        return Found(np.full(k, np.nan), np.full((k, ways), np.nan), np.full(k, -1), shares)

    if not len(q):
        return [fill_absent(0) for _ in cases]
    try:
        return kind.each(robot, q, cases)
    except ParameterError:
        raise
    except PkmTwinError:
        if len(q) == 1:
            return [fill_absent(1) for _ in cases]
        halves = [evaluate_kind(kind, robot, part, cases) for part in np.array_split(q, 2)]
        return [concatenate_found(pair) for pair in zip(*halves, strict=True)]


def concatenate_found(parts: Sequence[Found]) -> Found:
    """Join a quantity's values of successive poses."""

    def join(column: Sequence[NDArray[Any] | None]) -> Any:
        arrays = [part for part in column if part is not None]
        return np.concatenate(arrays) if len(arrays) == len(column) else None

    return Found(*map(join, zip(*parts, strict=True)))


def drive_limits(robot: Robot, name: str) -> Array:
    """Return the drives' limits ``effort`` or ``velocity``, shape (n,); SI units.

    :raises ParameterError: the robot's file has no such limits.
    """
    limits = getattr(robot.limits, name)
    if limits is None or not np.isfinite(limits).any():
        raise ParameterError(f"limits.{name}", None, f"the drives' {name} limits")
    return np.asarray(limits, np.float64)


def unit_motions(robot: Robot, q: Array) -> tuple[Array, Array]:
    """Return joint rates of unit platform velocities, (k, n, d), and their directions, (d, 3).

    Velocities are those of the pose's position at constant angles, or, without a position, the
    angular velocity about the base axes.
    """
    back = robot.inverse_jacobian(q)
    places = [k for k, name in enumerate(robot.pose_names) if name in "xyz"]
    if not places:
        return back @ np.linalg.pinv(robot.platform_jacobian(q)[..., 3:, :] @ back), np.eye(3)
    ways = np.eye(3)[["xyz".index(robot.pose_names[k]) for k in places]]
    return back[..., places], ways


def unit_of_motion(robot: Robot) -> str:
    """Return the unit of :func:`unit_motions`: ``m`` or ``rad``."""
    return "m" if set("xyz") & set(robot.pose_names) else "rad"


def tightest_limit(room: Array, rows: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return the smallest margin of each pose, the direction of its row, and the joint's index.

    :param room: margins, shape (k, n); ``rows``: shape (k, n, 3).
    """
    joint = room.argmin(-1)
    value = np.take_along_axis(room, joint[..., None], -1)[..., 0]
    row = np.take_along_axis(rows, joint[..., None, None], -2)[..., 0, :]
    return value, size_and_direction(row)[1], joint


def largest_axis(matrices: Array) -> tuple[Array, Array]:
    """Return the largest eigenvalue (k,) and its vector (k, 3) of symmetric (k, 3, 3) matrices.

    The direction's largest entry is positive.
    """
    values, vectors = np.linalg.eigh(matrices)
    direction = vectors[..., -1]
    index = np.abs(direction).argmax(-1)[..., None]
    sign = np.sign(np.take_along_axis(direction, index, -1))
    return values[..., -1], direction * sign


def size_and_direction(vectors: Array) -> tuple[Array, Array]:
    """Return lengths (k,) and unit vectors (k, 3); zero vectors stay zero."""
    size = np.linalg.norm(vectors, axis=-1)
    return size, vectors / np.where(size > 0.0, size, 1.0)[..., None]
