# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""robots, info and compliance: what they print for people and for scripts."""

import os
import subprocess
import sys

import numpy as np
import pytest

from pkm_twin import load, robot_names
from pkm_twin.apps.commands.info import Info, info
from pkm_twin.report.terminal import format_report
from stiffness_monitor import compliance, strain_energy
from test.commands.conftest import REPOSITORY
from test.support.command import forked
from test.support.robots import every_robot, partly_long

POSE = (-0.6, 0.1, -0.05)
WRENCH = (30.0, -50.0, -40.0, 10.0, -20.0, 50.0)


def test_processes(process):
    listed = process("robots")
    assert (listed.code, listed.err) == (0, "")
    assert [line.split()[0] for line in listed.out.splitlines()] == robot_names()


def test_siblings_are_told_apart(twin):
    described = [row["description"] for row in twin.told("robots")["robots"].values()]
    assert len(set(described)) == len(described)


@pytest.mark.parametrize("name", robot_names())
class TestInfo:
    def test_json_has_all_and_nothing_else_is_on_stdout(self, twin, name):
        data, robot = twin.told("info", name), load(name)
        assert list(data["home_pose"]) == list(robot.pose_names)
        assert data["joints"] == list(robot.joint_names)
        pose = list(data["home_pose"].values())
        assert np.allclose(robot.inverse(pose), list(data["home_joints"].values()))

    def test_every_parameter_is_shown_with_its_unit(self, twin, name):
        report = info.run(Info(robot=name))
        assert twin("info", name).out == format_report(report) + "\n"
        assert "-0.0000" not in format_report(report)
        rows = {fact.text: fact.formatted for fact in report.facts if fact.text}
        robot = load(name)
        units = robot.parameter_units()

        def shown(row, value, unit):
            if isinstance(value, dict):
                for key, item in value.items():
                    shown(f"{row}: {key}", item, unit[key])
            else:
                assert rows[row] == "none" if value is None else rows[row].endswith(unit), row

        for section, value in robot.parameter_sections().items():
            if isinstance(value, dict):
                shown(section, value, units[section])
        assert rows["gravity"].endswith(" m/s2")
        if robot.limits.effort is not None and "limits" in units:
            assert units["limits"]["effort"] == robot.effort_units[0]
        assert rows["pose"] and rows["actuated joints"].count("(") == len(robot.joint_names)


@every_robot
def test_closures_that_are_redundant_make_a_machine_overconstrained(name):
    """Or it is told which joint of the model repeats what the limbs hold."""
    report = info.run(Info(robot=name))
    data, shown = report.data, {fact.text: fact.formatted for fact in report.facts}
    redundant, open_reactions = data["redundant_closures"], data["overconstrained"]
    repeats = f"joint {'+'.join(data['assumed_joints'])} repeats"
    assert (repeats in shown["loop constraints"]) == bool(redundant and not open_reactions)
    assert bool(redundant) == bool(open_reactions or repeats in shown["loop constraints"])
    # The Delta-CU's is the one that has both: its third limb holds the turn about the vertical.
    assert (repeats in shown["loop constraints"]) == (name == "delta_cu")


class TestCompliance:
    def test_json_is_what_the_library_says(self, twin):
        data = twin.told("compliance", "upr_rpu", *POSE, "--wrench", ",".join(map(str, WRENCH)))
        robot = load("upr_rpu")
        energy = strain_energy(robot, POSE, WRENCH)
        assert np.array_equal(data["compliance"], compliance(robot, POSE))
        assert np.array_equal(data["deflection"], energy.deflection)
        assert data["factors"] == dict(zip(energy.elements, energy.factors, strict=True))
        assert (data["dominant"], data["total_energy"]) == (energy.dominant, energy.total)
        assert (list(data["pose"].values()), data["wrench"]) == (list(POSE), list(WRENCH))

    def test_the_text_has_units_and_names_the_dominant_element_first(self, twin):
        result = twin.good("compliance", "upr_rpu", *POSE)
        assert "m and rad, per N and N m" in result.out
        assert "deflection (µm, µrad)" in result.out
        dominant = result.out.split("dominant element ")[1].split()[0]
        assert f"shares: {dominant} " in result.out

    def test_a_machine_solved_as_a_frame_names_its_members(self, twin):
        result = twin.good("compliance", "delta_cu", 0.02, 0.01, -0.38, "--wrench", "0,5,0,0,0,0")
        robot = load("delta_cu")
        dominant = strain_energy(robot, [0.02, 0.01, -0.38], [0, 5, 0, 0, 0, 0]).dominant
        assert f"dominant element {dominant}" in result.out

    def test_two_dashes_before_a_negative_number_are_allowed_not_needed(self, twin):
        plain = twin.good("compliance", "upr_rpu", "-0.6", "-1e-3", "0")
        dashed = twin("compliance", "upr_rpu", "--", "-0.6", "-1e-3", "0")
        assert plain.out == dashed.out

    def test_a_tie_is_told_as_one(self, twin):
        text = twin("compliance", "upr_rpu", *POSE, "--wrench", "0,0,1,0,0,0").out
        energy = strain_energy(load("upr_rpu"), POSE, [0, 0, 1, 0, 0, 0])
        assert energy.tie == bool(twin.told("compliance", "upr_rpu", *POSE)["tie"])
        assert ("dominant elements, with equal shares" in text) == energy.tie
        assert twin.told("compliance", "upr_rpu", -0.6, 0, 0)["tie"] == ["1U", "2U"]
        assert "shares: 1U, 2U" in twin("compliance", "upr_rpu", -0.6, 0, 0).out

    def test_beyond_limits_is_refused_or_marked(self, twin):
        close = "compliance", "upr_rpu", -0.25, 0, 0
        assert "0.3 to 1 m" in twin.refused(*close)
        result = twin.good(*close, "--beyond-limits")
        assert result.out.splitlines()[-1].startswith("beyond limits: limb_3.position is 0.2")
        marked = twin.told(*close, "--beyond-limits")["beyond_limits"]
        assert set(marked) == set(load("upr_rpu").joint_names)
        assert twin.told("compliance", "upr_rpu", *POSE)["beyond_limits"] == {}

    @pytest.mark.parametrize(
        ("arguments", "code", "text"),
        [
            (("upr_rpo", -0.6, 0, 0), 1, "did you mean 'upr_rpu'"),
            (("upr_rpu", 0.6, 0, 0), 1, "beyond a singularity"),
            (("upr_rpu", -1e300, 0, 0), 1, ""),
            (("upr_rpu", -0.6, 0, 0, "--wrench", "1e300,0,0,0,0,0"), 1, "finite"),
            (("upr_rpu", -0.6, 0), 2, "z (m), beta (rad), gamma (rad)"),
            (("upr_rpu", "nan", 0, 0), 2, "POSE: 'nan'; expected a number"),
            (("upr_rpu", "z", 0, 0), 2, "POSE: 'z'"),
            (("upr_rpu", -0.6, 0, 0, "--jsn"), 2, ""),
            (("upr_rpu", -0.6, 0, 0, "--wrench", "1,2,3"), 2, "6 numbers"),
            (("upr_rpu", -0.6, 0, 0, "--wrench", "nan,0,0,0,0,0"), 2, "6 numbers"),
        ],
    )
    def test_refusals(self, twin, arguments, code, text):
        assert text in twin.refused("compliance", *arguments, code=code)

    def test_a_bad_robot_file_is_one_line(self, twin, tmp_path):
        path = tmp_path / "bad.yaml"
        path.write_text("mechanism: delta\ngeometry: {base_radius: -1}\n")
        assert "geometry" in twin.refused("info", path)
        assert twin("info", tmp_path / "absent.yaml").code == 1


class TestEnds:
    """Where the output goes wrong, and what a command says of itself."""

    @pytest.mark.parametrize(
        "command", partly_long(["robots", "info delta_cu", "info prru --json"], "info prru --json")
    )
    def test_a_full_disk_is_one_line(self, command, tmp_path):
        done = forked(tmp_path, *command.split(), out="/dev/full")
        assert done.code == 1
        assert done.err == "pkm-twin: cannot write the output: No space left on device\n"

    def test_a_reader_that_leaves_is_no_error(self):
        command = f"{sys.executable} -m pkm_twin.apps.cli info delta_cu | head -n 1"
        done = subprocess.run(
            command,
            shell=True,
            capture_output=True,
            text=True,
            env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        )
        assert done.stderr == ""

    @pytest.mark.parametrize("name", ["a" * 5000, "a/" * 3000, "\n\x1b[31m", "x\udcff.yaml"])
    def test_odd_names_are_one_line(self, twin, name):
        for command in ("info", "check", "compliance", "torques"):
            arguments = {"compliance": (0, 0, 0), "torques": ("m.csv",)}.get(command, ())
            twin.refused(command, name, *arguments)

    def test_version(self, twin):
        result = twin("--version")
        assert result.code == 0 and result.out.startswith("pkm-twin")
