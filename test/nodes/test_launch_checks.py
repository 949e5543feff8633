# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A launch file that cannot start all of its nodes starts none: checked without launch."""

import re
import shutil
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import pytest
import yaml

from pkm_twin.ros.launching import load_launch_file
from test.nodes.test_launch import FILES, LAUNCH, NODES


class Recorded:
    """Stands for an action, an event or a node of launch: what it was made of."""

    def __init__(self, *arguments, **options):
        self.arguments, self.options = arguments, options


class Stub(ModuleType):
    """Stands for a module of launch, which the wheels do not have."""

    __path__ = ()

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (Recorded,), {})


class TestBeforeTheFirstAction:
    """Each launch file's function on stand-ins of launch: it returns all nodes, or raises."""

    PROGRAMS: ClassVar = {
        "pkm_twin": (*NODES, "composed", "pkm-twin"),
        "robot_state_publisher": ("robot_state_publisher",),
        "rviz2": ("rviz2",),
        "controller_manager": ("ros2_control_node", "spawner"),
    }
    NEEDS: ClassVar = {
        "twin": (["pkm_twin"], {}),
        "cell": (["pkm_twin"], {}),
        "view": (
            ["pkm_twin", "robot_state_publisher", "rviz2"],
            {"rviz": "true", "robot_state_publisher": "true"},
        ),
        "control": (["pkm_twin", "robot_state_publisher", "controller_manager"], {}),
    }

    @pytest.fixture
    def call(self, monkeypatch, tmp_path):
        """Call a file's function with arguments: ``call(name, missing, **arguments)``."""
        for name in (
            "launch",
            "launch.actions",
            "launch.event_handlers",
            "launch.events",
            "launch.events.process",
            "launch.launch_context",
            "launch.launch_description_entity",
            "launch_ros",
            "launch_ros.actions",
        ):
            monkeypatch.setitem(sys.modules, name, Stub(name))
        monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))

        def call(name, missing="", **arguments):
            index = tmp_path / "share/ament_index/resource_index/packages"
            shutil.rmtree(tmp_path / "lib", ignore_errors=True)
            shutil.rmtree(index, ignore_errors=True)
            index.mkdir(parents=True)
            for package, programs in self.PROGRAMS.items():
                if package != missing:
                    (index / package).touch()
                for program in programs:
                    file = tmp_path / "lib" / package / program
                    if program != missing:
                        file.parent.mkdir(parents=True, exist_ok=True)
                        file.write_text("#!/bin/sh\necho '<robot/>'\n")
                        file.chmod(0o755)
            module = load_launch_file(LAUNCH / f"{name}.launch.py")
            given = {key: default for key, (default, _) in module.ARGUMENTS.items()} | arguments
            context = SimpleNamespace(argv=[], launch_configurations=given)
            *_, function = module.generate_launch_description().arguments[0]
            return function.options["function"](context)

        return call

    @pytest.mark.parametrize("name", FILES)
    def test_with_all_packages_there_are_nodes_and_without_one_of_them_none(self, call, name):
        needed, arguments = self.NEEDS[name]
        nodes = [one.options for one in call(name, **arguments) if "executable" in one.options]
        assert {node["package"] for node in nodes} == set(needed)
        for missing in [*needed, *(node["executable"] for node in nodes)]:
            with pytest.raises(RuntimeError, match=f"nothing was started: .*{missing}"):
                call(name, missing, **arguments)

    @pytest.mark.parametrize("name", FILES)
    def test_every_process_gets_simulated_time(self, call, name):
        _, arguments = self.NEEDS[name]
        for value in (True, False):
            made = call(name, use_sim_time=str(value).lower(), **arguments)
            for node in (one.options for one in made if one.options.get("parameters")):
                files = [yaml.safe_load(Path(f).read_text()) for f in node["parameters"] if isinstance(f, str)]
                sections = [section.get("ros__parameters", {}) for file in files for section in file.values()]
                given = [p for p in node["parameters"] if isinstance(p, dict)] + sections
                assert [p["use_sim_time"] for p in given if "use_sim_time" in p] == [value]

    @pytest.mark.parametrize(
        ("name", "arguments", "said"),
        [
            ("twin", {"executor": "multi"}, "executor: 'multi' is not one of events, single"),
            ("twin", {"acceleration": "guess"}, "acceleration: 'guess' is not one of"),
            ("twin", {"use_wrench": "perhaps"}, "use_wrench: 'perhaps' is neither"),
            ("twin", {"delta_dynamics": "false", "stiffness_monitor": "false"}, "nothing to run"),
            ("twin", {"robot": "nope"}, "robot: unknown robot 'nope'"),
            ("cell", {"machines": "a=delta_cu,b=nope"}, "robot: unknown robot 'nope'"),
            ("view", {"robot": "nope"}, "robot: unknown robot 'nope'"),
            ("view", {"params_file": "/no/such.yaml"}, "params_file: '/no/such.yaml' is no file"),
            ("control", {"robot": "nope"}, "robot: unknown robot 'nope'"),
            ("control", {"robot_state_publisher": "1"}, "robot_state_publisher: '1' is neither"),
            ("control", {"bandwidth": "fast"}, "bandwidth 'fast'"),
            ("control", {"params_file": "/no/such.yaml"}, "params_file: '/no/such.yaml' is no"),
            *((name, {"log_level": "loud"}, "log_level: 'loud' is not one of") for name in FILES),
        ],
    )
    def test_a_wrong_argument_is_named(self, call, name, arguments, said):
        with pytest.raises(RuntimeError, match=re.escape(said)):
            call(name, **arguments)
