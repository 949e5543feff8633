# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Exported C of other payloads, and of files that leave parts out."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pkm_twin import robot_names
from pkm_twin.errors import ParameterError, RobotWarning
from pkm_twin.export.c_package import c_identifier, c_package
from test.support.robots import (
    load,
    loaded,
    massless,
    often,
    partly_long,
    random_joints,
    random_motion,
)

from .c_programs import (
    CLOSE,
    COMPILERS,
    PLAIN,
    Package,
    compile_in,
    functions,
    inputs_of,
)


def test_a_program_is_compiled_anew_when_a_source_or_a_flag_changes(tmp_path):
    """One that has been compiled is taken again by its content."""
    (tmp_path / "main.c").write_text('#include "value.h"\nint main(void) { return VALUE + MORE; }\n')
    for value, more in ((1, 0), (2, 0), (2, 3), (1, 0)):
        (tmp_path / "value.h").write_text(f"#define VALUE {value}\n")
        compile_in(tmp_path, COMPILERS[0], f"-DMORE={more}", "main.c", "-o", "main")
        assert subprocess.run([tmp_path / "main"], check=False).returncode == value + more


def test_only_constants_and_functions_of_the_robot_s_name(small):
    """No heap, no variable outside of functions, no name that another program may have."""
    _, package = small
    text = (package.folder / f"{package.prefix}.c").read_text()
    assert re.findall(r"#include (\S+)", text) == [f'"{package.prefix}.h"', "<math.h>"]
    assert not re.search(r"\b(malloc|calloc|realloc|free|alloca|goto)\b", text)
    for line in text.splitlines():
        if line.startswith("static") and not line.rstrip().endswith(")"):
            assert line.startswith("static const "), line
    compile_in(package.folder, COMPILERS[0], "-std=c99", "-c", f"{package.prefix}.c", "-o", "o.o")
    symbols = subprocess.run(["nm", "o.o"], cwd=package.folder, capture_output=True, text=True, check=True).stdout
    kinds = dict(re.findall(r"(\w) (\w+)$", symbols, re.MULTILINE)[::-1])
    assert not set(kinds) & set("dDbBcC"), symbols
    own = re.findall(r" [a-zA-TV-Z] (\w+)", symbols)
    assert own and all(name.startswith(package.prefix) for name in own)


@pytest.mark.parametrize("name", partly_long(robot_names(), "five_bar"))
def test_another_payload_by_parameters(name, tmp_path, rng):
    robot = load(name)
    mass, com = 0.7, np.array([0.02, -0.01, 0.03])
    inertia = np.array([[3e-4, 1e-5, -2e-5], [1e-5, 4e-4, 3e-5], [-2e-5, 3e-5, 2e-4]])
    package = Package(tmp_path, c_package(robot))
    size = int(re.search(r"_PARAMETERS (\d+)", package.header).group(1))
    numbers = [mass, *com, *inertia.ravel()]
    given = ", ".join(map(repr, map(float, numbers)))
    driver = (package.folder / "driver.c").read_text()
    driver = driver.replace(
        "    long row;\n",
        f"""\
    long row;
    static const double load[13] = {{{given}}};
    double parameters[{size}];
    if (@_parameters(-1.0, load + 1, load + 4, parameters) != 2) {{ return 7; }}
    if (@_parameters(load[0], load + 1, load + 4, parameters) != 0) {{ return 7; }}
""".replace("@", package.prefix),
    )
    driver = re.sub(rf"(\(double\){package.prefix}_\w+)\(", r"\1_with(parameters, ", driver)
    (package.folder / "driver.c").write_text(driver)
    program = package.build(*PLAIN)
    load_section = {"mass": mass, "com": com.tolist(), "inertia": inertia.tolist()}
    other = robot.changed(payload=load_section)
    asked = functions(other)
    inputs = inputs_of(other, random_motion(other, rng, 50))
    for name, ask in asked.items():
        status, found = package.run(program, name, *inputs[name])
        right = ask(*inputs[name])
        assert not status.any(), name
        np.testing.assert_allclose(found, right, 0.0, CLOSE.get(name, 1e-12) * np.abs(right).max(), err_msg=name)


def drawn_payloads(rng, count):
    """Rows of mass, com and inertia, of real bodies and of others, some at the rule's edge."""
    rows = np.zeros((count, 13))
    for k, row in enumerate(rows):
        row[0] = rng.choice([0.0, 1.0, 1e5, -1e-9, 100_001.0, 1e300, np.nan], p=[0.2, 0.4] + [0.08] * 5)
        row[1:4] = rng.normal(size=3) * rng.choice([0.0, 1.0, 40.0, 1e300, np.inf], p=[0.3, 0.4] + [0.1] * 3)
        one, other = np.abs(rng.normal(size=2))
        edge = 1.0 + rng.choice([0.0, 1e-10, 1e-8, -1e-8, 1e-3])
        moments = [
            rng.normal(size=3),
            2.0 + np.abs(rng.normal(size=3)),
            [0.0, one, one * edge],
            [one, other, (one + other) * edge],
            np.zeros(3),
            [0.0, 0.0, one],
        ][k % 6]
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        inertia = axes @ np.diag(moments) @ axes.T * 10.0 ** rng.integers(-12, 15)
        inertia = (inertia + inertia.T) / 2.0
        inertia[0, 1] *= 1.0 + rng.choice([0.0, 1e-12, 1e-3], p=[0.8, 0.1, 0.1])
        row[4:] = inertia.ravel()
    return rows


@pytest.mark.parametrize("count", often(600, 20_000))
def test_payloads_are_accepted_as_in_python(small, tmp_path, count, rng):
    robot, package = small
    size = int(re.search(r"_PARAMETERS (\d+)", package.header).group(1))
    (tmp_path / "judge.c").write_text(f"""
#include <stdio.h>
#include "{package.prefix}.h"
int main(void)
{{
    double load[13], out[{size}];
    while (fread(load, sizeof(double), 13, stdin) == 13) {{
        putchar('0' + {package.prefix}_parameters(load[0], load + 1, load + 4, out));
    }}
    return 0;
}}
""")
    sources = "judge.c", package.folder / f"{package.prefix}.c"
    compile_in(tmp_path, COMPILERS[0], "-std=c99", f"-I{package.folder}", *sources, "-o", "judge", "-lm")
    rows = drawn_payloads(rng, count)
    done = subprocess.run([tmp_path / "judge"], input=rows.tobytes(), capture_output=True, check=True)
    right = []
    for mass, *rest in rows.tolist():
        try:
            robot.changed(payload={"mass": mass, "com": rest[:3], "inertia": np.reshape(rest[3:], (3, 3))})
            right.append("0")
        except ParameterError:
            right.append("2")
    assert done.stdout.decode() == "".join(right)
    assert min(right.count("0"), right.count("2")) > count / 20


def test_the_command_s_example_agrees_with_python(twin, tmp_path, small):
    assert twin("export", "c", "five_bar", "--out", tmp_path / "out").code == 0
    sources = "example.c", "pkm_five_bar.c"
    compile_in(tmp_path / "out", COMPILERS[0], "-std=c99", *sources, "-o", "example", "-lm")
    done = subprocess.run(["./example"], cwd=tmp_path / "out", check=False, capture_output=True)
    assert not done.returncode


def test_a_robot_without_masses_has_kinematics_and_elasticity(tmp_path):
    robot = load(massless(tmp_path / "hollow-1.yaml"))
    package = Package(tmp_path / "out", c_package(robot))
    assert set(package.heads) == set(functions(robot))
    assert "torques" not in package.heads and "compliance" in package.heads
    assert package.prefix == "pkm_hollow_1"
    q = random_joints(robot, np.random.default_rng(0), 5)
    status, found = package.run(package.build("-O0"), "forward", q)
    assert not status.any()
    np.testing.assert_allclose(found, robot.forward(q), 1e-12, 1e-14)


def test_a_compliance_that_is_missing_leaves_the_rest(tmp_path):
    """Drives alone have one, and a rigid joint holds the platform."""
    text = Path("examples/machines/rrr3_point.yaml").read_text()
    text = text.replace("limits: {effort", "compliance: [0, 0, 0, 0, 0, 1.0e-5], limits: {effort")
    (tmp_path / "point.yaml").write_text(text)
    with pytest.warns(RobotWarning, match=r"elasticity: joints\.slide\.compliance: missing"):
        made = c_package(load(tmp_path / "point.yaml"))
    assert "_torques(" in made["pkm_point.h"] and "_compliance(" not in made["pkm_point.h"]


def test_sections_that_contradict_masses_leave_elasticity_out_with_the_reason(variant):
    heavy, _ = variant("delta_cu", inertia={"forearm_mass": 5.0})
    with pytest.warns(RobotWarning, match=r"elasticity: .*members\.forearm\.density"):
        made = c_package(heavy)
    assert "_torques(" in made["pkm_delta_cu.h"] and "_compliance(" not in made["pkm_delta_cu.h"]


def test_names_become_identifiers():
    for name in ("my robot-2", "3rps", "größe", "a/b.c", "", "*/", "int"):
        assert re.fullmatch(r"[A-Za-z0-9_]+", c_identifier(name))
    # Letters beyond ASCII tell names apart, and two packages can be linked into one program.
    assert len({c_identifier(name) for name in ("é", "ü", "e", "_", "é_1", "ü_1")}) == 6


def test_friction_laws_are_those_of_python(tmp_path, rng):
    robot = loaded("five_bar").changed(
        friction={
            "coulomb": 0.1,
            "stribeck": 0.2,
            "stribeck_speed": 0.3,
            "load_dependent": 0.1,
            "cogging_cos": 0.05,
            "cogging_period": 0.2,
        }
    )
    package = Package(tmp_path, c_package(robot))
    program, inputs = package.build(*PLAIN), inputs_of(robot, random_motion(robot, rng, 50))
    for name in ("torques", "accelerations"):
        status, found = package.run(program, name, *inputs[name])
        right = functions(robot)[name](*inputs[name])
        assert not status.any()
        assert np.abs(found - right).max() <= 1e-12 * np.abs(right).max(), name
