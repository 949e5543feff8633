# SPDX-License-Identifier: Apache-2.0
"""What docs/validation.md says in numbers is so: computed again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from pkm_twin import load
from stiffness_monitor import strain_energy
from stiffness_monitor.modes import modes, natural_frequencies
from test.support.pages import assert_printed, numbers
from test.support.robots import parameters_of, partly_long
from test.validation import test_delta_cu_paper as delta_cu
from test.validation import test_upr_rpu_paper as upr_rpu

PAGE = "docs/validation.md"


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
    def test_finite_elements(self):
        shares = []
        for pose, _, solid in upr_rpu.TABLE_1:
            found = 1e6 * strain_energy(upr_rpu.ROBOT, pose, upr_rpu.LOAD).deflection
            shares.append((np.array(solid) / found - 1)[np.abs(solid) > 10 * upr_rpu.UNIT])
        softer = 100 * np.concatenate(shares)
        pattern = r"finite elements are (\d+) to (\d+) % softer"
        assert_printed(PAGE, pattern, softer.min(), softer.max())


@pytest.mark.parametrize("machine", partly_long(range(6), 0))
@pytest.mark.parametrize("name", ["delta", "delta_cu", "prru"])
def test_torques_of_random_machines(name, machine):
    """Some of the states that `make certificate` takes are within what the page says of all."""
    for library in ("mpmath", "mujoco", "pinocchio"):
        pytest.importorskip(library)
    from tools.certificate.compare import BALANCE_BOUNDS, PLACE_BOUND, ROUTES, compare
    from tools.certificate.machines import ROBOTS

    pattern = (
        r"digits \(\d+ states\): worst relative difference (\S+)\. MuJoCo \(\d+ states\): (\S+)\. "
    )
    worst, mujoco = numbers(PAGE, pattern)
    found = compare(name, (20261121, ROBOTS.index(name), machine), states=20, exact=2)
    for route in ROUTES:
        assert len(found.efforts[route]) == (20 if route == "Pinocchio" else 2)
        assert max(found.efforts[route]) < 2.0 * (mujoco if route == "MuJoCo" else worst), route
        assert max(found.places[route]) < PLACE_BOUND, route
    for what, bound in BALANCE_BOUNDS.items():
        assert max(found.balances[what]) < bound, what
