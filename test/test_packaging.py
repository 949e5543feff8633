# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The package as colcon and pip build it from a clean copy of the tree."""

import ast
import configparser
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from functools import cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest

import pkm_twin
from tools.distribution import make_bill_of_materials

REPOSITORY = Path(__file__).resolve().parents[1]
EXECUTABLES = {
    "delta_dynamics",
    "stiffness_monitor",
    "command_gate",
    "machine_state",
    "machine_sim",
    "composed",
    "pkm-twin",
}
COLCON = Path(sys.executable).with_name("colcon")
needs_colcon = pytest.mark.skipif(not COLCON.exists(), reason="colcon is not installed beside this Python")


@cache
def tracked():
    """Files that a clone has, and those that are about to be committed."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    try:
        listed = subprocess.run(command, cwd=REPOSITORY, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    names = [Path(name) for name in listed.decode().split("\0") if name]
    return [name for name in names if (REPOSITORY / name).is_file()]


def run(*command, cwd, **environment):
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """A clean copy of the tree, with this file of its tests."""
    target = tmp_path_factory.mktemp("workspace") / "src/pkm_twin"
    for name in tracked():
        if name.parts[0] != "test" or name.name == Path(__file__).name:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(REPOSITORY / name, target / name)
    return target


def modules():
    """Every Python file that belongs to the installed packages."""
    tops = ("pkm_twin", "delta_dynamics", "stiffness_monitor")
    return {str(name) for name in tracked() if name.parts[0] in tops and name.suffix == ".py"}


def templates():
    """Sources of the exported ROS packages."""
    folders = {"moveit_package", "ros2_control_package"}
    return {str(name) for name in tracked() if folders & set(name.parts)}


def robots():
    return {name.stem for name in tracked() if name.match("config/*.yaml")}


def check_installation(site, folder):
    """Load every robot from an unpacked installation, away from the tree."""
    for name in modules() | templates():
        assert (site / name).is_file(), f"{name} is not installed: is its package in setup.py?"
    for typed in ("pkm_twin", "delta_dynamics", "stiffness_monitor"):
        assert (site / typed / "py.typed").is_file()
    code = (
        "import pkm_twin; from pkm_twin import load, robot_names;"
        "print(pkm_twin.__file__); print(*[load(name).name for name in robot_names()])"
    )
    place, names = run(sys.executable, "-c", code, cwd=folder, PYTHONPATH=str(site)).splitlines()
    assert Path(place) == site / "pkm_twin/__init__.py"
    assert set(names.split()) == robots()


@pytest.fixture(scope="module")
def wheel(copy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    # Without the wheel package, pip has to fetch it into an isolated build.
    isolation = [] if find_spec("wheel") is None else ["--no-build-isolation"]
    command = ["-m", "pip", "wheel", "--quiet", "--no-deps", *isolation, "--wheel-dir", folder]
    run(sys.executable, *command, copy, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


class TestWheel:
    def test_holds_all_modules_and_robots(self, wheel, tmp_path):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(tmp_path / "site")
        check_installation(tmp_path / "site", tmp_path)

    def test_metadata(self, wheel):
        with zipfile.ZipFile(wheel) as archive:
            names = archive.namelist()
            folder = next(name.split("/")[0] for name in names if ".dist-info/" in name)
            metadata = archive.read(f"{folder}/METADATA").decode()
            points = configparser.ConfigParser()
            points.read_string(archive.read(f"{folder}/entry_points.txt").decode())
            tops = set(archive.read(f"{folder}/top_level.txt").decode().split())
        assert f"\nVersion: {pkm_twin.__version__}\n" in metadata
        assert set(points["console_scripts"]) == EXECUTABLES
        # Tests and recorders are not for installing.
        assert tops == {"pkm_twin", "delta_dynamics", "stiffness_monitor"}
        # A machine with ROS 2 must not get a second one.
        required = re.findall(r"^Requires-Dist: (.*)$", metadata, re.MULTILINE)
        assert all("extra ==" in line for line in required if line.startswith("ros-"))


@pytest.fixture(scope="module")
def sdist(copy, tmp_path_factory):
    """The source distribution."""
    folder = tmp_path_factory.mktemp("sdist")
    code = f"from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})"
    run(sys.executable, "-c", code, cwd=copy)
    (source,) = folder.glob("*.tar.gz")
    return source


@pytest.fixture
def sdist_wheel(sdist, tmp_path):
    """A wheel built from the source distribution."""
    command = ["-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", sdist]
    run(sys.executable, *command, cwd=tmp_path)
    (built,) = tmp_path.glob("*.whl")
    return built


def test_the_source_distribution_has_what_a_user_reads_and_runs(sdist):
    folders = {"config", "docs", "examples", "launch", "pkm_twin", "resource"}
    files = {"LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "package.xml", "setup.py"}
    wanted = {
        str(name)
        for name in tracked()
        if name.parts[0] in folders
        or str(name) in files
        or (name.parts[0] == "bags" and name.suffix in (".mcap", ".csv"))
    }
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert not wanted - names
    assert not {name for name in names if name.startswith("test/")}


@pytest.mark.long
@pytest.mark.skipif(find_spec("wheel") is None, reason="wheel is not installed")
class TestSourceDistribution:
    def test_gives_the_same_wheel(self, wheel, sdist_wheel):
        names = [set(zipfile.ZipFile(file).namelist()) for file in (wheel, sdist_wheel)]
        assert names[0] == names[1]

    def test_both_run_in_a_clean_environment(self, wheel, sdist_wheel, tmp_path):
        """Its own packages are this one alone; those that it needs are found beside."""
        for built in (wheel, sdist_wheel):
            home = tmp_path / f"clean_{built.parent.name}"
            venv.create(home, with_pip=False)
            python = home / "bin/python"
            options = ["--python", python, "install", "--quiet", "--no-deps", "--no-index", built]
            run(sys.executable, "-m", "pip", *options, cwd=tmp_path)
            beside = {"PYTHONPATH": sysconfig.get_path("purelib")}
            code = "import pkm_twin; print(pkm_twin.__file__, pkm_twin.__version__)"
            place, version = run(python, "-c", code, cwd=tmp_path, **beside).split()
            assert Path(place).is_relative_to(home)
            assert version == pkm_twin.__version__
            listed = run(home / "bin/pkm-twin", "robots", cwd=tmp_path, **beside)
            assert {line.split()[0] for line in listed.splitlines()} == robots()


@pytest.mark.long
@pytest.mark.skipif(find_spec("wheel") is None, reason="wheel is not installed")
def test_two_builds_have_equal_hashes(tmp_path):
    """With other rights of new files, in another folder, at another time."""
    found = []
    for k, rights in enumerate((0o022, 0o077)):
        before = os.umask(rights)
        try:
            command = [sys.executable, "-m", "tools.distribution", tmp_path / str(k)]
            found.append(run(*command, cwd=REPOSITORY))
        finally:
            os.umask(before)
    assert len(found[0].splitlines()) == 2
    assert found[0] == found[1]


def test_the_bill_of_materials_has_each_dependency_with_its_licence():
    parts = {part["name"]: part["licenses"][0]["expression"] for part in make_bill_of_materials()["components"]}
    own = {line for line in metadata.requires("pkm_twin") if "extra" not in line}
    assert own and {re.split(r"[^\w-]", line)[0].lower() for line in own} <= parts.keys()
    assert not [name for name, words in parts.items() if words == "NOASSERTION"]
    assert {parts["numpy"][:4], parts["pyyaml"]} == {"BSD-", "MIT"}


STARTED = """
import os, runpy, sys
import rclpy
for path in sys.argv[1:]:
    name = os.path.basename(path)
    said, there = os.pipe()
    child = os.fork()
    if not child:
        os.dup2(there, 2)
        sys.argv = [path, *(["delta_dynamics", "machine_state"] if name == "composed" else [])]
        sys.argv += ["--ros-args", "-p", "mechanism:=no_such_robot"]
        try:
            runpy.run_path(path, run_name="__main__")
        except SystemExit as end:
            sys.stderr.flush()
            os._exit(int(end.code or 0))
        os._exit(99)
    os.close(there)
    text = open(said).read()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status == 1 and "no_such_robot" in text, (name, status, text)
"""
"""Starts the nodes' programs, each in a fork, with a robot that there is not."""


@needs_colcon
class TestColcon:
    def test_list(self, copy):
        workspace = copy.parents[1]
        listed = run(COLCON, "list", cwd=workspace).split()
        assert listed == ["pkm_twin", "src/pkm_twin", "(ros.ament_python)"]

    @pytest.mark.long
    def test_build(self, copy, tmp_path):
        workspace = copy.parents[1]
        # The build's Python is this one, as an unactivated venv needs to be told.
        path = os.pathsep.join((str(COLCON.parent), os.environ["PATH"]))
        run(COLCON, "build", cwd=workspace, PATH=path, PYTHONDONTWRITEBYTECODE="")
        assert not (workspace / "log/latest_build/pkm_twin/stderr.log").read_text()
        prefix = workspace / "install/pkm_twin"
        assert {file.name for file in (prefix / "lib/pkm_twin").iterdir()} == EXECUTABLES
        share = prefix / "share/pkm_twin"
        assert (share / "package.xml").is_file()
        launched = {file.name for file in (share / "launch").iterdir()}
        assert launched == {name.name for name in tracked() if str(name.parent) == "launch"}
        bags = {name.name for name in tracked() if name.match("bags/*.mcap")}
        assert bags and bags <= {file.name for file in (share / "bags").iterdir()}
        layouts = {"machine.rviz", "machine.foxglove.json", "machine.plotjuggler.xml"}
        assert {file.name for file in (share / "view").iterdir()} == layouts
        assert {file.stem for file in (share / "config").glob("*.yaml")} == robots()
        marker = prefix / "share/ament_index/resource_index/packages/pkm_twin"
        assert marker.is_file()
        (site,) = prefix.glob("lib/python*/site-packages")
        check_installation(site, tmp_path)

        start = prefix / "lib/pkm_twin/pkm-twin"
        sourced = "COLCON_CURRENT_PREFIX=$PWD/install . install/local_setup.sh"
        found = run("sh", "-c", f"{sourced}; command -v pkm-twin", cwd=workspace, PATH=path)
        assert found.strip() == str(start)
        listed = run(sys.executable, start, "robots", cwd=tmp_path, PYTHONPATH=str(site))
        assert {line.split()[0] for line in listed.splitlines()} == robots()
        if find_spec("rclpy"):
            nodes = [start.with_name(node) for node in sorted(EXECUTABLES - {"pkm-twin"})]
            environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "87"}
            run(
                sys.executable,
                "-c",
                STARTED,
                *nodes,
                cwd=tmp_path,
                PYTHONPATH=str(site),
                **environment,
            )


@pytest.fixture(scope="module")
def manifest():
    package = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is not installed")
    # Reading validates too.
    return package.parse_package(str(REPOSITORY / "package.xml"))


class TestManifest:
    def test_is_of_this_package(self, manifest):
        assert manifest.package_format == 3
        assert manifest.name == "pkm_twin"
        assert manifest.licenses == ["Apache-2.0"]
        assert manifest.get_build_type() == "ament_python"
        assert (REPOSITORY / "resource" / manifest.name).is_file()

    def test_one_version_everywhere(self):
        found = {"pkm_twin": pkm_twin.__version__}
        found["package.xml"] = ElementTree.parse(REPOSITORY / "package.xml").findtext("version")
        version = run(sys.executable, "setup.py", "--version", cwd=REPOSITORY)
        found["setup.py"] = version.splitlines()[-1]
        changes = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
        found["CHANGELOG.md"] = re.search(r"^## \[?v?(\d+\.\d+\.\d+)", changes, re.MULTILINE)[1]
        assert len(set(found.values())) == 1, found


DECLARED = {
    "hypothesis",
    "matplotlib",
    "numpy",
    "pkm_twin",
    "delta_dynamics",
    "stiffness_monitor",
    "pytest",
    "rich",
    "scipy",
    "setuptools",
    "support",
    "test",
    "tools",
    "bags",
    "click",
    "yaml",
}
"""What package.xml's dependencies bring, and this package."""


def foreign_imports(path):
    """Top-level imports of a test module that it has not asked for by pytest.importorskip."""
    asked = set()
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        call = getattr(statement, "value", None)
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "pytest.importorskip":
            asked.add(call.args[0].value.split(".")[0])
        modules = []
        if isinstance(statement, ast.Import):
            modules = [alias.name for alias in statement.names]
        elif isinstance(statement, ast.ImportFrom) and not statement.level:
            modules = [statement.module]
        for module in {module.split(".")[0] for module in modules}:
            # The middleware and its messages come together.
            ros = module == "rclpy" or re.search("_(msgs|interfaces|srvs)$", module)
            brought = module in DECLARED | asked | sys.stdlib_module_names
            if not (brought or (ros and "rclpy" in asked)):
                yield module


def test_a_workspace_with_the_declared_dependencies_collects_every_module():
    """What else a module needs it asks for by name, so that it is skipped where that is missing."""
    paths = [REPOSITORY / name for name in tracked() if name.match("test/**/test_*.py")]
    assert len(paths) > 100
    assert {path.name: list(foreign_imports(path)) for path in paths if any(foreign_imports(path))} == {}
