# SPDX-License-Identifier: Apache-2.0
"""What docs/validation.md says in numbers is so: computed again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin import load
from stiffness_monitor import strain_energy
from stiffness_monitor.modes import modes, natural_frequencies
from test.support.pages import assert_printed, numbers
from test.support.robots import parameters_of, partly_long
from test.support.workspaces import even_samples, polar_samples
from test.validation import test_delta_cu_paper as delta_cu
from test.validation import test_upr_rpu_paper as upr_rpu

PAGE = "docs/validation.md"


def test_tables_of_the_delta_cu_paper():
    robot = load("delta")
    phase = delta_cu.RATE * delta_cu.TIME[:, None]
    q = delta_cu.HOME_ANGLE + delta_cu.SIGNS * np.cos(phase)
    qd = -delta_cu.SIGNS * delta_cu.RATE * np.sin(phase)
    qdd = -delta_cu.SIGNS * delta_cu.RATE**2 * np.cos(phase)
    velocity = np.einsum("nij,nj->ni", robot.jacobian(q), qd) * delta_cu.DOWN * 1e3
    printed = np.stack(
        [
            -sign * np.array(table) @ np.array(axis) / np.dot(axis, axis) * 1e-3
            for sign, table, axis in zip([1, -1, -1], delta_cu.TORQUES, delta_cu.AXES, strict=True)
        ],
        -1,
    )
    speed = delta_cu.differences(velocity, delta_cu.VELOCITY)[0]
    rms, worst = delta_cu.differences(inverse_dynamics(robot, q, qd, qdd, delta_cu.LOAD), printed)
    pattern = r"velocity rms (\S+) mm/s of (\d+), torque rms (\S+) N m of (\S+), worst (\d+\.\d+)"
    greatest = np.abs(delta_cu.VELOCITY).max(), np.abs(printed).max()
    assert_printed(PAGE, pattern, speed, greatest[0], rms, greatest[1], worst)
    pattern = r"the home angle (\S+) rad and a platform load of (\d+) N"
    assert_printed(PAGE, pattern, delta_cu.HOME_ANGLE, -delta_cu.LOAD[2])


class TestFrequenciesOfTheDeltaCu:
    robot = load("delta_cu")
    pose = robot.forward([delta_cu.HOME_ANGLE] * 3)

    def first(self, robot):
        return natural_frequencies(robot, self.pose, 1)[0]

    def changed(self, folder, **members):
        data = parameters_of("delta_cu")
        data["members"].update(members)
        path = folder / "changed.yaml"
        path.write_text(yaml.safe_dump(data, sort_keys=False))
        return load(path)

    def across(self):
        """The same robot, the universal joint's second axis across its forearm."""
        robot = replace(self.robot, name="across")
        graph = self.robot.graph
        joint = graph.joints["platform joint III"]
        axis = np.cross(joint.axes[0], joint.at - graph.joints["elbow III"].at)
        turned = replace(joint, axes=np.array([joint.axes[0], axis / np.linalg.norm(axis)]))
        vars(robot)["graph"] = replace(graph, joints=graph.joints | {joint.name: turned})
        return robot

    def test_what_they_hang_on(self, tmp_path):
        members = parameters_of("delta_cu")["members"]
        carbon = {k: members["forearm"][k] for k in ("youngs_modulus", "shear_modulus", "density")}
        width = members["parallelogram_width"]
        rod = self.changed(tmp_path, rcu_forearm={**members["rcu_forearm"], **carbon})
        own = self.first(self.robot)
        pattern = (
            r"second axis is the limb's radial one \(first frequency (\d+) Hz; (\d+\.\d+) Hz with "
            r"an axis across the forearm\) and its rod is of aluminium \((\d+) Hz of carbon\)"
        )
        assert_printed(PAGE, pattern, own, self.first(self.across()), self.first(rod))
        moved = [
            abs(self.first(self.changed(tmp_path, parallelogram_width=f * width)) / own - 1)
            for f in (0.5, 2.0)
        ]
        pattern = r"half or twice the parallelograms' width moves it by (\d+) %"
        assert_printed(PAGE, pattern, 100 * max(moved))

    def test_where_their_energy_is(self):
        found = modes(self.robot, self.pose)
        names, kinetic = found.energies.elements, found.energies.kinetic
        share = [kinetic[:3, names.index(name)] for name in ("platform", "forearm III")]
        pattern = (
            r"in shapes 1 to 3 the platform has (\S+), (\S+) and (\S+) of the kinetic energy and "
            r"forearm III (\S+), (\S+) and (\S+); "
        )
        assert_printed(PAGE, pattern, *share[0], *share[1])
        size = np.linalg.norm(found.shapes[..., :3], axis=-1)
        ends = [found.nodes[k] for k in size[:2].argmax(-1)]
        # "in 1 and 2 that rod's elbow end moves the most"
        assert ends == ["forearm III 0/8"] * 2
        forearms = [k for k, name in enumerate(names) if name.startswith("forearm")]
        pattern = r"4 to 6 the forearms bend \(at least (\d+) % of the kinetic energy\)"
        assert_printed(PAGE, pattern, 100 * kinetic[3:][:, forearms].sum(1).min())


class TestTablesOfTheUprRpuPaper:
    def test_deflections(self):
        (share,) = numbers(PAGE, r"table 1\*\* \(deflections, both rows\): within (\S+) %")
        for pose, theory, _ in upr_rpu.TABLE_1:
            found = 1e6 * strain_energy(upr_rpu.ROBOT, pose, upr_rpu.LOAD).deflection
            allowed = np.maximum(share / 100 * np.abs(theory), upr_rpu.UNIT)
            assert (np.abs(found - theory) <= allowed).all()

    def test_finite_elements(self):
        shares = []
        for pose, _, solid in upr_rpu.TABLE_1:
            found = 1e6 * strain_energy(upr_rpu.ROBOT, pose, upr_rpu.LOAD).deflection
            shares.append((np.array(solid) / found - 1)[np.abs(solid) > 10 * upr_rpu.UNIT])
        softer = 100 * np.concatenate(shares)
        pattern = r"finite elements are (\d+) to (\d+) % softer"
        assert_printed(PAGE, pattern, softer.min(), softer.max())

    @pytest.mark.long
    def test_global_factors(self):
        most, evenly, on_rays = numbers(
            PAGE,
            r"P2 and P3 within (\S+); P1 within (\S+) when poses are spread evenly over the "
            r"workspace, within (\S+) on polar rays",
        )
        workspace = upr_rpu.regular_workspace(upr_rpu.ROBOT, upr_rpu.HEIGHTS)
        even, rays = even_samples(workspace), polar_samples(workspace)

        def worst(name, poses):
            wrench, expected = upr_rpu.TABLE_2[name]
            mean = strain_energy(upr_rpu.ROBOT, poses, wrench).factors.mean(0)
            return np.abs(mean - expected).max()

        others = [worst(name, poses) for name in ("P2", "P3") for poses in (even, rays)]
        assert max(others) < most
        assert worst("P1", even) < evenly
        assert worst("P1", rays) < on_rays


@pytest.mark.parametrize("machine", partly_long(range(6), 0, 1))
@pytest.mark.parametrize("name", ["delta", "delta_cu", "prru"])
def test_torques_of_random_machines(name, machine):
    """Some of the states that `make certificate` takes are within what the page says of all."""
    for library in ("mpmath", "mujoco", "pinocchio"):
        pytest.importorskip(library)
    from tools.certificate.compare import BALANCE_BOUNDS, PLACE_BOUND, ROUTES, compare
    from tools.certificate.machines import ROBOTS

    worst = numbers(PAGE, r"at 50 digits \(\d+ states\): worst relative difference (\S+)\. ")[0]
    found = compare(name, (20261121, ROBOTS.index(name), machine), states=20, exact=2)
    for route in ROUTES:
        assert len(found.efforts[route]) == (2 if route == "Lagrange" else 20)
        assert max(found.efforts[route]) < 2.0 * worst, route
        assert max(found.places[route]) < PLACE_BOUND, route
    for what, bound in BALANCE_BOUNDS.items():
        assert max(found.balances[what]) < bound, what
