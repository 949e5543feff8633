# SPDX-License-Identifier: Apache-2.0
"""The machines in MuJoCo: a tree of bodies made from the parameter file, loops by its Jacobians.

MuJoCo moves the open tree (`mj_kinematics`), gives the Jacobians of the points and axes that close
the loops (`mj_jac`, `mj_jacDot`) and the tree's inverse dynamics (`mj_inverse`). Its own soft
constraints are off. The loops are closed by Newton's method on MuJoCo's kinematics, from the
symmetric assembly on in small steps; the tree's generalised forces are projected on the actuators
by the tree's rates per actuator rate.

MuJoCo wants every moving body to have some inertia about every axis. Rods get ``SPECK`` about
themselves, which is below the last digits of the inertia across.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

SPECK = 1e-14
"""Inertia about a thin rod's own axis, kg m2."""
WAY = 12
"""Steps from the symmetric assembly to the wanted one."""


class OpenLoopError(ValueError):
    """The loops did not close."""


class LoopTree:
    """A tree with loops, three actuated joints and a platform; the two machines fill it."""

    def __init__(self, params: Mapping[str, Any]) -> None:
        self.params = params
        self.points: list[tuple[str, str]] = []
        """Pairs of sites that coincide."""
        self.crossings: list[tuple[str, int, str, int]] = []
        """Site and axis, site and axis, at a right angle."""
        self.model = mujoco.MjModel.from_xml_string(self._xml())
        self.data = mujoco.MjData(self.model)
        self.actuated = np.array([self._joint(f"actuated_{i}") for i in range(3)])
        self.passive = np.setdiff1d(np.arange(self.model.nv), self.actuated)
        if 3 * len(self.points) + len(self.crossings) != len(self.passive):
            raise AssertionError("tree and loops do not leave three freedoms")
        self._pairs = [(self._site(a), self._site(b)) for a, b in self.points]
        self._axes = [(self._site(a), x, self._site(b), y) for a, x, b, y in self.crossings]
        self._platform = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, "platform")

    def _xml(self) -> str:
        raise NotImplementedError

    def _home(self, middle: float) -> dict[str, float]:
        """Joint values of the symmetric assembly with all actuators at ``middle``."""
        raise NotImplementedError

    def _middles(self, q: np.ndarray) -> list[float]:
        """Where the symmetric assemblies are that a walk to ``q`` may begin from."""
        return [float(np.mean(q))]

    def _joint(self, name: str) -> int:
        joint = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name)
        return int(self.model.jnt_dofadr[joint])

    def _site(self, name: str) -> int:
        return int(mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, name))

    def _move(self, configuration: np.ndarray) -> None:
        self.data.qpos[:] = configuration
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def _axis(self, site: int, axis: int) -> np.ndarray:
        return self.data.site_xmat[site].reshape(3, 3)[:, axis]

    def error(self) -> np.ndarray:
        """How far the loops stand open, m and unitless."""
        sites = self.data.site_xpos
        rows = [sites[a] - sites[b] for a, b in self._pairs]
        rows += [np.array([self._axis(a, x) @ self._axis(b, y)]) for a, x, b, y in self._axes]
        return np.concatenate(rows)

    def _site_jacobian(self, site: int, derivative: bool) -> tuple[np.ndarray, np.ndarray]:
        linear, angular = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        if derivative:
            point, body = self.data.site_xpos[site], int(self.model.site_bodyid[site])
            mujoco.mj_jacDot(self.model, self.data, linear, angular, point, body)
        else:
            mujoco.mj_jacSite(self.model, self.data, linear, angular, site)
        return linear, angular

    def jacobian(self) -> np.ndarray:
        """Rates of `error` per tree rate."""
        rows = []
        for a, b in self._pairs:
            rows.append(self._site_jacobian(a, False)[0] - self._site_jacobian(b, False)[0])
        for a, x, b, y in self._axes:
            relative = self._site_jacobian(a, False)[1] - self._site_jacobian(b, False)[1]
            rows.append(np.cross(self._axis(a, x), self._axis(b, y))[None] @ relative)
        return np.vstack(rows)

    def drift(self, rates: np.ndarray) -> np.ndarray:
        """Second derivative of `error` at zero tree acceleration."""
        self.data.qvel[:] = rates
        mujoco.mj_comVel(self.model, self.data)
        rows = []
        for a, b in self._pairs:
            change = self._site_jacobian(a, True)[0] - self._site_jacobian(b, True)[0]
            rows.append(change @ rates)
        for a, x, b, y in self._axes:
            one, other = self._axis(a, x), self._axis(b, y)
            turn_a = self._site_jacobian(a, False)[1] @ rates
            turn_b = self._site_jacobian(b, False)[1] @ rates
            change = self._site_jacobian(a, True)[1] - self._site_jacobian(b, True)[1]
            turning = np.cross(np.cross(turn_a, one), other)
            turning += np.cross(one, np.cross(turn_b, other))
            value = np.cross(one, other) @ change @ rates + (turn_a - turn_b) @ turning
            rows.append(np.array([value]))
        return np.concatenate(rows)

    def assemble(self, q: np.ndarray) -> np.ndarray:
        """Tree configuration at actuator positions ``q``, reached from a symmetric assembly."""
        for middle in self._middles(q):
            try:
                return self._walk(q, middle)
            except (OpenLoopError, np.linalg.LinAlgError):
                continue
        raise OpenLoopError(f"no way to the assembly at {q}")

    def _walk(self, q: np.ndarray, middle: float) -> np.ndarray:
        configuration = np.zeros(self.model.nv)
        for name, value in self._home(middle).items():
            configuration[self._joint(name)] = value
        for k in range(WAY + 1):
            configuration[self.actuated] = middle + k / WAY * (q - middle)
            size = math.inf
            for _ in range(25):
                self._move(configuration)
                error = self.error()
                now = float(np.abs(error).max())
                if now == 0.0 or (now < 1e-13 and now >= size):
                    break
                size = now
                step = np.linalg.solve(self.jacobian()[:, self.passive], error)
                configuration[self.passive] -= step
            if not size < 1e-12:
                raise OpenLoopError(f"the loops stay open by {size:.3g}")
        return configuration

    def platform(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre and axes of the platform in the configuration moved to last."""
        place = self.data.xpos[self._platform].copy()
        return place, self.data.xmat[self._platform].reshape(3, 3).copy()

    def inverse_dynamics(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, wrench: np.ndarray
    ) -> np.ndarray:
        """Actuator efforts without friction, shape (3,)."""
        model, data = self.model, self.data
        self._move(self.assemble(q))
        jacobian = self.jacobian()
        passive = jacobian[:, self.passive]
        spread = np.zeros((model.nv, 3))
        spread[self.actuated] = np.eye(3)
        spread[self.passive] = -np.linalg.solve(passive, jacobian[:, self.actuated])
        rates = spread @ qd
        acceleration = spread @ qdd
        acceleration[self.passive] -= np.linalg.solve(passive, self.drift(rates))
        data.qacc[:] = acceleration
        mujoco.mj_inverse(model, data)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, linear, angular, self._platform)
        force = data.qfrc_inverse - linear.T @ wrench[:3] - angular.T @ wrench[3:]
        return spread.T @ force

    # Building blocks

    def _document(self, bodies: str) -> str:
        gravity = self.params.get("gravity", (0.0, 0.0, -9.81))
        return f"""<mujoco>
  <compiler angle="radian" inertiafromgeom="false" autolimits="false"/>
  <option gravity="{_text(gravity)}">
    <flag contact="disable" constraint="disable"/>
  </option>
  <worldbody>{bodies}</worldbody>
</mujoco>"""

    def _payload(self) -> str:
        payload = self.params.get("payload") or {}
        if not payload.get("mass"):
            return ""
        return f"<body>{_inertial(payload['mass'], payload['com'], payload['inertia'])}</body>"


class DeltaTree(LoopTree):
    """A Delta: the platform on three slides; a limb's forearm on two joints at the elbow."""

    def _xml(self) -> str:
        g, m = self.params["geometry"], self.params["inertia"]
        arm, forearm = g["arm_length"], g["forearm_length"]
        across = m["forearm_mass"] * forearm**2 / 12
        joints = "".join(
            f'<joint name="{n}" type="slide" axis="{a}"/>'
            for n, a in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
        )
        corners = limbs = ""
        for i, (azimuth, closure) in enumerate(zip(g["azimuths"], g["closures"], strict=True)):
            out = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            corners += f'<site name="corner_{i}" pos="{_text(g["platform_radius"] * out)}"/>'
            self.points.append((f"end_{i}", f"corner_{i}"))
            if closure == "rod":
                elbow = f"""<joint name="swing_{i}" axis="0 1 0"/>
                  <joint name="lean_{i}" axis="1 0 0"/>"""
            else:
                elbow = f"""<joint name="slide_{i}" type="slide" axis="0 1 0"/>
                  <joint name="swing_{i}" axis="0 1 0"/>"""
            about = m["arm_inertia"]
            limbs += f"""
            <body pos="{_text(g["base_radius"] * out)}" quat="{_turn(azimuth)}">
              <joint name="actuated_{i}" axis="0 1 0" armature="{m["rotor_inertia"]!r}"/>
              {_inertial(m["arm_mass"], (m["arm_com"] * arm, 0, 0), (SPECK, about, about))}
              <body pos="{arm!r} 0 0">
                {elbow}
                {_inertial(m["forearm_mass"], (0, 0, -forearm / 2), (across, across, SPECK))}
                <site name="end_{i}" pos="0 0 {-forearm!r}"/>
              </body>
            </body>"""
        # The platform does not turn: its inertia is without effect.
        platform = f"""<body name="platform">{joints}
            {_inertial(m["platform_mass"], (0, 0, 0), (1e-3, 1e-3, 1e-3))}
            {corners}{self._payload()}</body>"""
        return self._document(platform + limbs)

    def _middles(self, q: np.ndarray) -> list[float]:
        """The mean angle and others where three forearms meet."""
        g = self.params["geometry"]
        angles = [float(np.mean(q)) + shift for shift in (0.0, 0.2, 0.4, 0.7, 1.0)]
        reach = g["base_radius"] - g["platform_radius"]
        return [
            angle
            for angle in angles
            if abs(reach + g["arm_length"] * math.cos(angle)) < 0.99 * g["forearm_length"]
        ]

    def _home(self, middle: float) -> dict[str, float]:
        g = self.params["geometry"]
        out = g["base_radius"] + g["arm_length"] * math.cos(middle) - g["platform_radius"]
        slope = math.asin(out / g["forearm_length"])
        height = g["arm_length"] * math.sin(middle) + g["forearm_length"] * math.cos(slope)
        return {"z": -height, **{f"swing_{i}": slope - middle for i in range(3)}}


class PrruTree(LoopTree):
    """A 3-PRRU head: the platform on six joints; a limb's slider, lower and upper link."""

    def _xml(self) -> str:
        g, m = self.params["geometry"], self.params["inertia"]
        limb = g["limb_length"]
        com = (0, 0, m["link_com"] * limb)
        joints = "".join(
            f'<joint name="{n}" type="{t}" axis="{a}"/>'
            for t, names in (("slide", "xyz"), ("hinge", "abc"))
            for n, a in zip(names, ("1 0 0", "0 1 0", "0 0 1"), strict=True)
        )
        corners = limbs = ""
        for i, azimuth in enumerate(g["azimuths"]):
            inward = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            # The site's y axis is the platform's tangent.
            corners += f"""<site name="corner_{i}" quat="{_turn(azimuth)}"
                pos="{_text(-g["platform_radius"] * inward)}"/>"""
            self.points.append((f"end_{i}", f"corner_{i}"))
            self.crossings.append((f"end_{i}", 0, f"corner_{i}", 1))
            inertials = []
            for link in ("lower", "upper"):
                mass = m[f"{link}_link_mass"]
                given = m.get(f"{link}_link_inertia") or (mass * limb**2 / 12, 0.0)
                about = (given[0], given[0], max(given[1], SPECK))
                inertials.append(_inertial(mass, com, about))
            limbs += f"""
            <body pos="{_text(-g["base_radius"] * inward)}" quat="{_turn(azimuth)}">
              <joint name="actuated_{i}" type="slide" axis="0 0 1"/>
              {_inertial(m["slider_mass"], (0, 0, 0), (1e-3, 1e-3, 1e-3))}
              <body>
                <joint name="swing_{i}" axis="0 1 0"/>{inertials[0]}
                <body>
                  <joint name="spin_{i}" axis="0 0 1"/>{inertials[1]}
                  <site name="end_{i}" pos="0 0 {limb!r}"/>
                </body>
              </body>
            </body>"""
        inertia, centre = m["platform_inertia"], m.get("platform_com", (0, 0, 0))
        platform = f"""<body name="platform">{joints}
            {_inertial(m["platform_mass"], centre, inertia)}{corners}{self._payload()}</body>"""
        return self._document(platform + limbs)

    def _home(self, middle: float) -> dict[str, float]:
        g = self.params["geometry"]
        sine = (g["base_radius"] - g["platform_radius"]) / g["limb_length"]
        swing = math.asin(sine) if g["branch"] == "below" else math.pi - math.asin(sine)
        height = middle + g["limb_length"] * math.cos(swing)
        return {"z": height, **{f"swing_{i}": swing for i in range(3)}}


def tree(params: Mapping[str, Any]) -> LoopTree:
    """The MuJoCo model of a parameter mapping."""
    return PrruTree(params) if params["mechanism"] == "prru" else DeltaTree(params)


def _text(values: Any) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def _turn(angle: float) -> str:
    return f"{math.cos(angle / 2)!r} 0 0 {math.sin(angle / 2)!r}"


def _inertial(mass: float, com: Any, inertia: Any) -> str:
    """An inertial element; three numbers are the diagonal, nine the matrix about the com."""
    values = np.asarray(inertia, dtype=float)
    if values.shape == (3,):
        moments = f'diaginertia="{_text(values)}"'
    else:
        order = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        moments = f'fullinertia="{_text([values[k] for k in order])}"'
    return f'<inertial mass="{float(mass)!r}" pos="{_text(com)}" {moments}/>'
