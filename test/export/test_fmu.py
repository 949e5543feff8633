# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Functional Mock-up Units: what fmpy accepts, and what it simulates against the plant."""

from __future__ import annotations

import functools
import shutil
import xml.etree.ElementTree as ET
import zipfile

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.simulation.plant import Plant
from pkm_twin.export.fmu import KINDS, VERSIONS, Fmu, find_compiler
from pkm_twin.mechanisms.machine import Machine
from test.export.c_programs import compile_in
from test.machine.random_machines import variant
from test.support.robots import loaded, partly_long, random_motion

fmpy = pytest.importorskip("fmpy")
from fmpy.build import build_platform_binary  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

STRICT = (
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Wconversion",
    "-Wshadow",
    "-Wvla",
    "-Wundef",
    "-Wcast-qual",
    "-Werror",
)
RANDOM = {"random bolted": 1, "random hinged_platform": 3}
"""Redundant closures, dry friction in all joints."""
NAMES = ("five_bar", "delta_cu", "stewart", *RANDOM)
KINDS_OF = [(version, kind) for version in VERSIONS for kind in KINDS]
TYPES = "ModelExchange", "CoSimulation"
WRENCH = [f"wrench.{axis}" for axis in ("fx", "fy", "fz", "mx", "my", "mz")]


@functools.cache
def robot_of(name):
    if name == "rubbed":
        rub = {"viscous": [0.05, 0.02], "coulomb": [0.3, 0.2], "offset": [0.01, 0.0]}
        return loaded("five_bar").changed(friction=rub)
    if name not in RANDOM:
        return loaded(name)
    data = variant(name.split()[1], np.random.default_rng(RANDOM[name]))
    # Stops are the plant's alone.
    for joint in data["joints"].values():
        joint.pop("limits", None)
    return Machine.from_data(data | {"mechanism": "machine"}, name)


@pytest.fixture(scope="module")
def unit(tmp_path_factory):
    """The file of a robot's FMU, made once."""
    made = {}

    def get(robot, version, kind):
        key = id(robot), version, kind
        if key not in made:
            path = tmp_path_factory.mktemp("fmu") / "robot.fmu"
            path.write_bytes(Fmu(robot, version, kind).archive(find_compiler()))
            made[key] = robot, str(path)
        return made[key][1]

    return get


def named(what, robot, values):
    return {f"{what}.{j}": float(x) for j, x in zip(robot.joint_names, values, strict=True)}


def last(result, what, robot):
    return np.array([result[f"{what}.{j}"][-1] for j in robot.joint_names])


def simulated(path, kind, span, start, **more):
    if kind == "ModelExchange":
        more |= {"solver": "CVode", "relative_tolerance": 1e-11}
    return fmpy.simulate_fmu(path, stop_time=span, fmi_type=kind, start_values=start, output_interval=span / 10, **more)


@pytest.mark.parametrize("unit", partly_long(KINDS_OF, *KINDS_OF[1:3]), ids=str)
def test_fmpy_finds_nothing_wrong_and_every_run_writes_the_same(unit, tmp_path):
    version, kind = unit
    robot = robot_of("rubbed")
    path = tmp_path / "robot.fmu"
    path.write_bytes(Fmu(robot, version, kind).archive())
    assert validate_fmu(str(path)) == []
    assert path.read_bytes() == Fmu(robot, version, kind).archive()
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
    for compiler in filter(shutil.which, ("gcc", "clang")):
        compile_in(tmp_path / "sources", compiler, "-std=c99", *STRICT, "-fsyntax-only", "fmu.c")


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", partly_long(NAMES, "five_bar"))
def test_a_free_swing_is_the_plant_s(name, version, kind, unit):
    robot = robot_of(name)
    home, none = robot.graph.home, np.zeros(6)
    rest = inverse_dynamics(robot, home, 0.0 * home, 0.0 * home)
    effort = 0.7 * rest + 0.02 * np.abs(rest).max() * np.arange(len(home))
    effort += 5.0 * robot.friction.coulomb
    plant = Plant(robot, home)
    for _ in range(100):
        plant.advance(effort, none, 1e-3)
    assert np.abs(plant.q - home).max() > 1e-3
    start = named("tau", robot, effort)
    result = simulated(unit(robot, version, "dynamics"), kind, 0.1, start)
    assert np.abs(last(result, "q", robot) - plant.q).max() < 1e-8
    assert np.abs(last(result, "qd", robot) - plant.qd).max() < 1e-7
    pose = [result[f"pose.{name}"][-1] for name in robot.pose_names]
    np.testing.assert_allclose(pose, robot.forward(plant.q), 0.0, 1e-8)


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("name", partly_long(("rubbed", *RANDOM), "rubbed"))
def test_joints_stick_and_slip_as_the_plant_s(name, kind, unit):
    """Let go with a rate, stopped by friction, pulled away again."""
    robot = robot_of(name)
    home, none = robot.graph.home, np.zeros(6)
    n = len(home)
    rest = inverse_dynamics(robot, home, 0.0 * home, 0.0 * home)
    rates = 0.5 * (-1.0) ** np.arange(n)
    pull = rest + 3.0 * np.abs(robot.friction.coulomb) + 0.05
    plant = Plant(robot, home)
    plant.qd = rates.copy()
    stood = False
    for step in range(300):
        plant.advance(rest if step < 200 else pull, none, 1e-3)
        stood |= step < 200 and not plant.qd.any()
    assert stood or name != "rubbed"
    signals = np.array(
        [(0.0, *rest), (0.2, *rest), (0.2, *pull), (0.3, *pull)],
        dtype=[("time", float), *((f"tau.{j}", float) for j in robot.joint_names)],
    )
    path = unit(robot, 2, "dynamics")
    start = named("qd", robot, rates)
    result = simulated(path, kind, 0.3, start, input=signals, step_size=1e-3)
    assert np.abs(last(result, "q", robot) - plant.q).max() < 1e-6
    assert np.abs(last(result, "qd", robot) - plant.qd).max() < 1e-5


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", partly_long(NAMES, "five_bar"))
def test_torques_of_a_motion_with_another_payload(name, version, kind, unit):
    robot = robot_of(name)
    inertia = [[2e-3, 1e-4, 2e-4], [1e-4, 3e-3, 3e-4], [2e-4, 3e-4, 4e-3]]
    load = {"mass": 0.4, "com": [0.01, -0.02, 0.03], "inertia": inertia}
    q, qd, qdd, wrench = (rows[0] for rows in random_motion(robot, np.random.default_rng(3), 1))
    start = named("q", robot, q) | named("qd", robot, qd) | named("qdd", robot, qdd)
    start |= dict(zip(WRENCH, wrench.tolist(), strict=True))
    start |= {"payload.mass": load["mass"]}
    start |= {f"payload.com.{a}": x for a, x in zip("xyz", load["com"], strict=True)}
    start |= {
        f"payload.inertia.{a}{b}": inertia[i][k] for i, a in enumerate("xyz") for k, b in enumerate("xyz") if k >= i
    }
    result = simulated(unit(robot, version, "torques"), kind, 0.01, start)
    right = inverse_dynamics(robot.changed(payload=load), q, qd, qdd, wrench)
    np.testing.assert_allclose(last(result, "tau", robot), right, 0.0, 1e-12 * np.abs(right).max())
    assert result["singularity"][-1] == pytest.approx(robot.singularity(q), abs=1e-12)
    assert result["status"][-1] == 0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("version", VERSIONS)
def test_what_cannot_be_is_no_result(version, kind, unit):
    robot = loaded("five_bar")
    path = unit(robot, version, kind)
    states = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 2))
    far = states[~robot.try_forward(states)[1]][0]
    said = []
    for start in (named("q", robot, far), {"payload.mass": -1.0}, {"wrench.fx": float("nan")}):
        said.clear()
        with pytest.raises(fmpy.fmi1.FMICallException):
            fmpy.simulate_fmu(
                path,
                stop_time=0.01,
                fmi_type="CoSimulation",
                start_values=start,
                logger=lambda *words: said.append(words),
            )
        assert said


def started(path, version, folder, name="one"):
    """An instance of a unit for co-simulation, not yet initialised, and its description."""
    described = fmpy.read_model_description(path)
    slave = {2: fmpy.fmi2.FMU2Slave, 3: fmpy.fmi3.FMU3Slave}[version](
        guid=described.guid,
        unzipDirectory=fmpy.extract(path, str(folder / name)),
        modelIdentifier=described.coSimulation.modelIdentifier,
        instanceName=name,
    )
    if version == 2:
        # The logger that fmpy shares may be that of a simulation that has ended.
        callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(lambda *_: None)
        slave.instantiate(callbacks=callbacks)
        slave.setupExperiment(startTime=0.0)
    else:
        slave.instantiate()
    return slave, described


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("version", VERSIONS)
def test_calls_out_of_order_are_refused_and_change_nothing(version, kind, unit, tmp_path):
    slave, _ = started(unit(loaded("five_bar"), version, kind), version, tmp_path)

    def refused(call, *values):
        with pytest.raises(fmpy.fmi1.FMICallException):
            call(*values)

    refused(slave.doStep, 0.0, 0.01)
    refused(slave.exitInitializationMode)
    refused(slave.terminate)
    slave.enterInitializationMode()
    refused(slave.enterInitializationMode)
    refused(slave.doStep, 0.0, 0.01)
    slave.exitInitializationMode()
    for time, span in ((0.0, -0.01), (0.0, float("nan")), (0.01, 0.01), (float("nan"), 0.01)):
        refused(slave.doStep, time, span)
    slave.doStep(0.0, 0.01)
    refused(slave.doStep, 0.0, 0.01)
    slave.doStep(0.01, 0.0)
    slave.doStep(0.01, 0.01)
    slave.terminate()
    refused(slave.doStep, 0.02, 0.01)
    slave.reset()
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    slave.doStep(0.0, 0.01)
    slave.terminate()
    slave.freeInstance()


@pytest.mark.parametrize("version", VERSIONS)
def test_a_saved_state_goes_on_as_before(version, unit, tmp_path):
    slave, described = started(unit(loaded("five_bar"), version, "dynamics"), version, tmp_path)
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    at = [v.valueReference for v in described.modelVariables if v.name.startswith(("q.", "qd."))]
    read = slave.getReal if version == 2 else slave.getFloat64
    names = ("getFMU{}", "setFMU{}", "serializeFMU{}", "{}erializeFMU{}")
    words = [("state",)] * 3 + [("deS", "state")]
    if version == 3:
        words = [("State",)] * 3 + [("des", "State")]
    get, restore, save, load = (getattr(slave, name.format(*word)) for name, word in zip(names, words, strict=True))
    slave.doStep(0.0, 0.01)
    state = get()
    slave.doStep(0.01, 0.01)
    after = read(at)
    saved = save(state)
    # A state that is damaged, or of another size, is none.
    for other in (saved[:-8], bytes(len(saved)), saved[:8] + b"\xff" * 8 + saved[16:]):
        with pytest.raises(fmpy.fmi1.FMICallException):
            load(other)
    restore(load(saved))
    assert read(at) != after
    slave.doStep(0.01, 0.01)
    assert read(at) == after
    slave.terminate()
    slave.freeInstance()


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cmake") is None, reason="there is no CMake")
@pytest.mark.parametrize(("version", "kind"), KINDS_OF)
def test_an_importer_compiles_the_sources(version, kind, tmp_path):
    path = tmp_path / "robot.fmu"
    path.write_bytes(Fmu(robot_of("rubbed"), version, kind).archive())
    fmpy.extract(str(path), str(tmp_path / "out"))
    build_platform_binary(tmp_path / "out")
    assert fmpy.simulate_fmu(str(tmp_path / "out"), stop_time=0.01)["status"][-1] == 0


def test_the_command_writes_a_unit_that_has_its_units(twin, tmp_path):
    out = tmp_path / "five_bar.fmu"
    words = ["export", "fmu", "five_bar", "--out", str(out), "--fmi", "2", "--kind", "torques"]
    assert twin(*words).code == 0
    with zipfile.ZipFile(out) as archive:
        top = ET.fromstring(archive.read("modelDescription.xml"))
        assert [name for name in archive.namelist() if name.startswith("binaries/")]
    units = {v.get("name"): v[0].get("unit") for v in top.iter("ScalarVariable")}
    assert units["tau.left"] == "N.m" and units["qdd.left"] == "rad/s2"
    assert twin(*words[:-4], "--overwrite", "--fmi", "4").code
