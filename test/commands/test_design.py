# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""`pkm-twin design` as a user runs it."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from pkm_twin.mechanisms.catalogue import config_folder, load
from test.support.command import forked
from test.support.robots import parameters_of, partly_long

VARY = ("--vary", "geometry.arm_length=0.15:0.3", "--vary", "geometry.forearm_length=0.3:0.6")
TOLERANCES = ("--tolerance", "geometry.arm_length=1e-4", "--tolerance", "geometry.base_radius=5e-5")
PARTS = ("--tolerance", "bodies.arm I.length=1e-4", "--tolerance", "joints.arm_2.offset=1e-4")


@pytest.fixture(scope="module")
def pick(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pick")
    line = "path delta --cycle 25,200,25 --duration 0.5 --rate 100 --no-picture --out pick.csv"
    assert forked(folder, *line.split()).code == 0
    return folder / "pick.csv"


def test_a_better_robot_is_written_and_loads(twin, pick, tmp_path):
    out, picture = tmp_path / "better.yaml", tmp_path / "better.png"
    line = ("design", "delta", *VARY, "--path", pick, "--minimise", "peak-effort")
    bound = ("--subject-to", "singularity>=0.2", "--starts", "8")
    files = ("--out", out, "--picture", picture)
    data = twin.told(*line, *bound, *files)
    peak, index = data["quantities"]["peak-effort"], data["quantities"]["singularity"]
    assert peak["after"] < peak["before"] and peak["unit"] == "N m"
    assert index["after"] >= 0.2 - 1e-6
    effort, least = data["items"]
    assert effort["value"] == f"{peak['after']:.4g} N m"
    assert [effort["verdict"], least["verdict"]] == ["good", "good"]
    assert effort["number"] == pytest.approx(peak["after"])
    assert (effort["limit"], effort["unit"]) == (20.0, "N m")
    assert least["number"] == pytest.approx(index["after"])
    assert picture.read_bytes()[:4] == b"\x89PNG"
    better = load(out)
    for path, value in data["numbers"].items():
        assert better.number(path) == pytest.approx(value, rel=1e-10)
    assert twin(*line, *files).code == 1


def test_a_machine_that_asks_too_much_of_its_drives_is_bad(twin, pick, tmp_path):
    weak, out = tmp_path / "weak.yaml", tmp_path / "light.yaml"
    text = (config_folder() / "delta.yaml").read_text().replace("effort: 20.0", "effort: 2.0")
    weak.write_text(text)
    line = ("design", weak, *VARY, "--path", pick, "--minimise", "mass", "--starts", "4")
    data = twin.told(*line, "--out", out)
    effort = data["items"][0]
    assert data["quantities"]["peak-effort"]["after"] > 2.0
    assert (effort["bound"], effort["verdict"]) == ("2 N m", "bad")


def test_a_sweep_is_a_file_with_the_variables_as_axes(twin, pick, tmp_path):
    xarray = pytest.importorskip("xarray")
    out = tmp_path / "box.nc"
    line = ("design", "delta", *VARY, "--path", pick, "--sweep", "grid", "--samples", "4")
    assert twin.told(*line, "--out", out)["machines"] == 16
    with xarray.open_dataset(out, engine="h5netcdf") as data:
        assert data["peak-effort"].shape == (4, 4)
        assert data["peak-effort"].attrs["units"] == "N m"
        np.testing.assert_allclose(data["geometry.arm_length"], np.linspace(0.15, 0.3, 4))
        assert np.isfinite(data["singularity"]).any()


def test_a_budget_names_each_contribution(twin, pick):
    for errors, where in ((TOLERANCES, ()), (PARTS, ("--path", pick, "--monte-carlo", "400"))):
        data = twin.told("design", "delta", *errors, *where)
        parts = data["contributions"].values()
        assert sum(part["share"] for part in parts) == pytest.approx(1.0)
        # Rounding is no rotation.
        assert all(one == 0.0 or one > 1e-9 for one in (part["rms_angle_rad"] for part in parts))
        squares = sum(part["rms_position_m"] ** 2 for part in parts)
        assert data["rms_position_m"] == pytest.approx(np.sqrt(squares))
    machines = data["monte_carlo"]
    assert machines["rms_position_m"] == pytest.approx(machines["first_order_rms_position_m"], rel=0.15)


@pytest.mark.parametrize("name", partly_long(["delta", "linear_delta"], "linear_delta"))
def test_a_file_has_tolerances_of_its_parts(twin, tmp_path, name):
    path, data = tmp_path / "loose.yaml", parameters_of(name)
    actuated = load(name).joint_names
    data["tolerances"] = {
        "joints.*.offset": {"deviation": 1e-4},
        f"joints.{actuated[0]}.backlash": {"bound": 3e-4},
    }
    path.write_text(yaml.safe_dump(data))
    asked = twin.told("design", path, "--tolerance", "file")
    given = [f"joints.{joint}.offset=1e-4" for joint in actuated]
    given.append(f"joints.{actuated[0]}.backlash=+-3e-4")
    same = twin.told("design", name, *(w for one in given for w in ("--tolerance", one)))
    assert asked["contributions"] == same["contributions"]
    assert asked["bound_position_m"] == same["bound_position_m"] > asked["greatest_position_m"]
    # Zeros of joints are calibrated, a play is not.
    rows = asked["contributions"]
    play = rows.pop(f"joints.{actuated[0]}.backlash")
    assert play["rms_calibrated_position_m"] == pytest.approx(play["rms_position_m"])
    assert max(row["rms_calibrated_position_m"] for row in rows.values()) < 1e-9
    assert asked["rms_calibrated_position_m"] == pytest.approx(play["rms_position_m"])
    twin.refused("design", name, "--tolerance", "file")
    out = tmp_path / "graph.yaml"
    twin.good("convert", path, "--out", out)
    assert yaml.safe_load(out.read_text())["tolerances"] == data["tolerances"]
    # A graph has no parameters: what names one is left out, and named.
    more = {"geometry.arm_length": {"deviation": 1e-4}}
    path.write_text(yaml.safe_dump(data | {"tolerances": data["tolerances"] | more}))
    twin.good("convert", path, "--out", out, "--overwrite")
    assert yaml.safe_load(out.read_text())["tolerances"] == data["tolerances"]
    assert "tolerances of geometry.arm_length" in out.read_text()
    data["tolerances"] = {"joints.*.offset": {"deviation": 1e-4, "bound": 1e-4}}
    path.write_text(yaml.safe_dump(data))
    assert "tolerances.joints.*.offset" in twin.refused("design", path, "--tolerance", "file")


@pytest.mark.long
def test_copies_that_are_off_alike_stay_so_without_limbs(twin, tmp_path):
    path, out = tmp_path / "delta.yaml", tmp_path / "graph.yaml"
    data = yaml.safe_load(Path("examples/machines/delta_graph.yaml").read_text())
    data["tolerances"] = {
        "limbs.joints.*.offset": {"deviation": 1e-4},
        "limbs.rods.*.length": {"bound": 2e-4},
        "limbs.bodies.arm.length": {"deviation": 3e-5},
        "rods.left_2.length": {"deviation": 1e-5},
        "limbs.joints.motor.at[0]": {"deviation": 1e-4},
    }
    path.write_text(yaml.safe_dump(data))
    assert "tolerances of limbs.joints.motor.at[0]" in twin.good("convert", path, "--out", out).out
    del data["tolerances"]["limbs.joints.motor.at[0]"]
    path.write_text(yaml.safe_dump(data))
    before, after = (twin.told("design", one, "--tolerance", "file") for one in (path, out))
    for key in ("rms_position_m", "bound_position_m", "rms_angle_rad", "rms_calibrated_position_m"):
        assert after[key] == pytest.approx(before[key], rel=1e-9, abs=1e-12)
    assert len(after["contributions"]) == len(before["contributions"]) == 5
    one = "joints.motor_1.offset,-joints.motor_2.offset=1e-4"
    other = "joints.motor_1.offset,joints.motor_2.offset=1e-4"
    ways = [twin.told("design", out, "--tolerance", text)["rms_position_m"] for text in (one, other)]
    assert ways[0] != pytest.approx(ways[1], rel=0.1)
    bad = "joints.motor_1.offset,rods.left_1.length=1e-4"
    assert "rods.left_1.length" in twin.refused("design", out, "--tolerance", bad, code=2)


@pytest.mark.parametrize(
    "line",
    [
        ("--minimise", "mass"),
        ("--vary", "geometry.arm_length=0.3:0.15", "--minimise", "mass"),
        ("--vary", "geometry.arm_length", "--minimise", "mass"),
        ("--vary", "geometry.arm=0.1:0.2", "--minimise", "mass"),
        (*VARY, "--minimise", "torque"),
        (*VARY, "--minimise", "mass", "--subject-to", "mass>=1"),
        (*VARY, "--minimise", "deflection"),
        (*VARY, "--sweep", "circle", "--out", "no.nc"),
        (*VARY, "--sweep", "grid"),
        (*VARY,),
        ("--tolerance", "geometry.arm_length"),
        (*VARY, "--minimise", "mass", "--monte-carlo", "5"),
    ],
)
def test_what_cannot_be_asked_is_rejected_in_a_line(twin, pick, line):
    result = twin("design", "delta", "--path", pick, *line)
    assert result.code in (1, 2) and not result.out
    assert "Traceback" not in result.err


def test_a_payload_that_changes_matters_to_efforts_alone(twin, tmp_path):
    out = tmp_path / "loaded.csv"
    line = ("path", "delta", "--cycle", "25,100,25", "--rate", "100", "--no-picture")
    twin.good(*line, "--load", "0.5@0:3", "--out", out)
    asked = ("design", "delta", "--path", out)
    own, other = (twin.told(*asked, *TOLERANCES, *more) for more in ((), ("--payload", "0.2")))
    assert own["rms_position_m"] == other["rms_position_m"] > 0.0
    assert "--payload" in twin.refused(*asked, *VARY, "--minimise", "peak-effort")
