# SPDX-License-Identifier: Apache-2.0
"""What all robots share: sections of their parameter files and the kinematic interface."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen import kernels
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import ParameterError, SingularityError, UnknownNameError, UnreachableError
from pkm_twin.machine import schema
from pkm_twin.machine.pose_grid import PoseGrid

Array = NDArray[np.float64]
R = TypeVar("R", bound="Robot")

MAX_LENGTH: Final = 100.0
MAX_MASS: Final = 1e5
SINGULARITY_BOUND: Final = 1e-9
"""Least singularity measure (0 singular, 1 best) at which a Jacobian is inverted."""


def length(**options: Any) -> Any:
    """Field: a length above zero, m."""
    return schema.number(above=0.0, at_most=MAX_LENGTH, **options)


def mass(**options: Any) -> Any:
    """Field: a mass of zero or more, kg."""
    return schema.number(at_least=0.0, at_most=MAX_MASS, **options)


def check_azimuths(azimuths: Array, path: str) -> None:
    """Refuse limbs that stand in one place."""
    for i in range(3):
        apart = math.remainder(float(azimuths[i] - azimuths[i - 1]), 2 * math.pi)
        if abs(apart) < 1e-3:
            raise ParameterError(path, azimuths.tolist(), "limbs at least 0.001 rad apart")


@dataclass(frozen=True, eq=False)
class Payload:
    """A body fixed to the platform: com from the platform's origin, inertia about the com."""

    mass: float = mass(default=0.0)
    com: Array = schema.vector(3, default=[0, 0, 0])
    inertia: Array = schema.inertia(positive=False, default=[0, 0, 0])


@dataclass(frozen=True, eq=False)
class Friction:
    """Friction at the actuated joints: viscous per rate, Coulomb by the rate's sign."""

    viscous: Array = schema.vector(3, at_least=0.0, spread=True, default=[0, 0, 0])
    coulomb: Array = schema.vector(3, at_least=0.0, spread=True, default=[0, 0, 0])


def dynamic_head(robot: Any) -> list[float]:
    """The head of the flat parameters of a robot with masses, as bodies.py numbers it."""
    return [
        *robot.gravity,
        *robot.friction.viscous,
        *robot.friction.coulomb,
        robot.payload.mass,
        *robot.payload.com,
        *robot.payload.inertia.ravel(),
    ]


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of the actuated joints; absent is None. One value stands for all joints."""

    position: Array | None = schema.interval(count=3, default=None)
    velocity: Array | None = schema.vector(3, above=0.0, spread=True, default=None)
    effort: Array | None = schema.vector(3, above=0.0, infinite=True, spread=True, default=None)


@dataclass(frozen=True, eq=False)
class Robot:
    """A parallel kinematic machine with three actuated joints and a three-parameter pose.

    Frozen; :meth:`changed` gives a copy with other parameters.
    """

    mechanism: str

    description: ClassVar[str]
    mobility: ClassVar[str]
    redundant_constraints: ClassVar[tuple[str, ...]] = ()
    """What rigid-body statics cannot tell; for robots with masses it follows from reactions."""
    limb_names: ClassVar[tuple[str, str, str]] = ("limb I", "limb II", "limb III")
    pose_names: ClassVar[tuple[str, str, str]]
    pose_units: ClassVar[tuple[str, str, str]]
    joint_unit: ClassVar[str]
    effort_unit: ClassVar[str]
    inverse_kernel: ClassVar[Kernel]
    forward_kernel: ClassVar[Kernel]
    jacobian_kernel: ClassVar[Kernel]
    motion_kernel: ClassVar[Kernel | None] = None
    dynamics_kernel: ClassVar[Kernel | None] = None
    body_names: ClassVar[tuple[str, ...]] = ()
    angles_kernel: ClassVar[Kernel | None] = None
    clearance_kernel: ClassVar[Kernel | None] = None
    """Least distance (m) of different limbs' members, of a pose and its q; needs ``radii``."""
    elastic_kernel: ClassVar[Kernel | None] = None
    energy_kernel: ClassVar[Kernel | None] = None
    element_names: ClassVar[tuple[str, ...]] = ()
    changeable: ClassVar[tuple[str, ...]] = ()

    @property
    def name(self) -> str:
        """The name that the robot was loaded by."""
        return str(self.__dict__.get("_name", self.mechanism))

    @property
    def radii(self) -> tuple[float, ...] | None:
        """Outer radii of the members that limb interference is about, m; None: not known."""
        return None

    @cached_property
    def parameters(self) -> Array:
        """Flat parameters for the kernels, read-only."""
        return schema.frozen(self._pack())

    def _pack(self) -> list[float]:
        raise NotImplementedError

    @property
    def joint_names(self) -> tuple[str, str, str]:
        """Names of the actuated joints, in the order of q."""
        joints: tuple[str, str, str] = getattr(self, "joints")  # noqa: B009
        return joints

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Units of q, ``m`` or ``rad`` each."""
        return (self.joint_unit,) * len(self.joint_names)

    def grid(self) -> PoseGrid:
        """How atlases lay out this machine's poses; without an axis of its own, as a box."""
        return PoseGrid("box", self.pose_names)

    def search_box(self) -> Array:
        """Bounds outside of which no pose of the workspace lies, shape (m, 2), m and rad.

        :raises ParameterError: what is missing that would bound the workspace.
        """
        raise ParameterError(
            "search_box", self.name, "a mechanism that tells where its poses end, for atlases"
        )

    def inverse(self, pose: ArrayLike) -> Array:
        """Joint positions q of a pose, shape (..., 3).

        :raises UnreachableError: naming limb, sample and miss.
        """
        q, fault = self.inverse_kernel(self.parameters, pose)
        self.raise_fault(fault, "pose")
        return q

    def forward(self, q: ArrayLike) -> Array:
        """Pose of joint positions q, shape (..., 3), in the mechanism's documented assembly.

        :raises UnreachableError: naming limb, sample and miss.
        """
        pose, fault = self.forward_kernel(self.parameters, q)
        self.raise_fault(fault, "joint state")
        return pose

    def home(self) -> Array:
        """The pose in the middle of the actuated joints' limits, shape (3,)."""
        limits: Array | None = getattr(self, "limits").position  # noqa: B009
        return self.forward(self._home_joints() if limits is None else limits.mean(1))

    def _home_joints(self) -> Array:
        """Joint positions to begin from where the file has no limits, shape (3,)."""
        return np.zeros(3)

    def jacobian(self, q: ArrayLike) -> Array:
        """Pose rates per joint rate, shape (..., 3, 3)."""
        return self._jacobians(q)[0]

    def platform_jacobian(self, q: ArrayLike) -> Array:
        """Platform twist (v at its origin, omega; world axes) per joint rate, shape (..., 6, 3)."""
        return self._jacobians(q)[1]

    def _jacobians(self, q: ArrayLike) -> tuple[Array, Array]:
        rates, twist, fault = self.jacobian_kernel(self.parameters, q)
        self.raise_fault(fault, "joint state")
        batch = rates.shape[:-1]
        return (
            rates.reshape(*batch, 3, 3).swapaxes(-1, -2),
            twist.reshape(*batch, 2, 3, 3).swapaxes(-1, -2).reshape(*batch, 6, 3),
        )

    def singularity(self, q: ArrayLike) -> Array:
        """How far a joint state is from a singularity: 0 in one, 1 at best, shape (...).

        The reciprocal condition number of the Jacobian, its angles multiplied by the platform's
        radius, so that units do not count. Goes to zero at singularities of either kind: where
        the actuators lose the platform and where they lose a direction.
        """
        radius = float(getattr(self, "geometry").platform_radius)  # noqa: B009
        scale = np.array([1.0 if unit == "m" else radius for unit in self.pose_units])
        values = np.linalg.svd(scale[:, None] * self.jacobian(q), compute_uv=False)
        return np.asarray(values[..., -1] / values[..., 0], np.float64)

    def rotation(self, pose: ArrayLike) -> Array:
        """Platform axes as columns in fixed axes, shape (..., 3, 3)."""
        raise NotImplementedError(f"{self.mechanism} has no rotation of its platform yet")

    def changed(self: R, **sections: Mapping[str, object] | object) -> R:
        """A copy with new values, e.g. ``payload={"mass": 0.2}, gravity=[0, 0, -9.81]``.

        All values are checked as in a file; one bad value refuses all.

        :raises ParameterError: a value out of range, or a section that cannot change.
        """
        new: dict[str, Any] = {}
        for key, value in sections.items():
            if key not in self.changeable:
                raise UnknownNameError(key, key, self.changeable)
            if isinstance(value, Mapping):
                new[key] = schema.replace(getattr(self, key), value, key)
            else:
                fields = {f.name: f for f in dataclasses.fields(self)}
                new[key] = fields[key].metadata["check"](key, value)
        robot = dataclasses.replace(self, **new)
        robot.__dict__["_name"] = self.name
        return robot

    def raise_fault(self, fault: Array, what: str) -> None:
        """Raise the typed error of the first faulty sample, if there is one; fault (..., 3)."""
        if fault.ndim == 1:
            code, detail, amount = fault.tolist()
            if code == kernels.OK:
                return
            index: tuple[int, ...] = ()
        else:
            bad = fault[..., 0] != kernels.OK
            if not bad.any():
                return
            index = tuple(int(i) for i in np.argwhere(bad)[0])
            code, detail, amount = fault[index].tolist()
        if code == kernels.NOT_FINITE:
            where = f" at sample {index}" if index else ""
            raise ValueError(f"{what}{where} is not finite, or leads to a result that is not")
        if code == kernels.SINGULAR:
            raise SingularityError(what, index, amount, SINGULARITY_BOUND)
        raise UnreachableError(what, self.limb_names[int(detail)], index, amount)
