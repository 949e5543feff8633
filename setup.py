# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = "pkm_twin"
# ROS tools read it there, so it is the only place.
VERSION = ElementTree.parse(Path(__file__).with_name("package.xml")).findtext("version")  # noqa: S314  its own file

setup(
    name=NAME,
    version=VERSION,
    description="Digital twin of parallel kinematic machines",
    license="Apache-2.0",
    author="pkm_twin maintainers",
    maintainer="pkm_twin maintainers",
    python_requires=">=3.11",
    packages=[
        *find_packages(include=["pkm_twin*", "delta_dynamics*", "stiffness_monitor*"]),
        "pkm_twin.config",
    ],
    # The parameter files stand at the top for people and inside the package for load().
    package_dir={"pkm_twin.config": "config"},
    package_data={
        "pkm_twin": ["py.typed"],
        "pkm_twin.config": ["*.yaml", "drives/*.yaml"],
        "pkm_twin.export": [
            "fmu_sources/*.c",
            "moveit_package/*.*",
            "moveit_package/*/*.*",
            "ros2_control_package/*.*",
            "ros2_control_package/*/*.*",
            "transmission_package/*.*",
            "transmission_package/*/*.*",
        ],
        "delta_dynamics": ["py.typed"],
        "stiffness_monitor": ["py.typed"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml", "CITATION.cff"]),
        # colcon.pkg names it: the commands are on PATH in a sourced workspace, as with pip.
        (f"share/{NAME}/hook", ["resource/path.dsv"]),
        (f"share/{NAME}/bags", sorted(glob("bags/*.mcap") + glob("bags/*.md"))),
        (f"share/{NAME}/config", sorted(glob("config/*.yaml"))),
        (f"share/{NAME}/config/drives", sorted(glob("config/drives/*.yaml"))),
        (
            f"share/{NAME}/examples",
            sorted(n for end in ("py", "md", "ipynb", "cfg", "xml") for n in glob(f"examples/*.{end}")),
        ),
        (f"share/{NAME}/examples/machines", sorted(glob("examples/machines/*.*"))),
        (f"share/{NAME}/examples/machines/hexapod", sorted(glob("examples/machines/hexapod/*"))),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py") + glob("launch/*.yaml"))),
        (f"share/{NAME}/view", sorted(glob("launch/view/*"))),
    ],
    install_requires=[
        "click>=8.1",
        "matplotlib>=3.6",
        "lz4",
        "llvmlite>=0.41",
        "mcap>=1.6",
        "numpy>=1.26",
        "PyYAML>=6",
        "rich>=13",
        "scipy>=1.11",
        "setuptools",
        "zstandard",
    ],
    extras_require={
        # The real ROS 2 Jazzy as wheels, for machines without a ROS installation. Unpinned names
        # bring another distribution.
        "jazzy": [
            "ros-jazzy-rclpy[fastrtps]==7.1.6",
            "ros-jazzy-common-interfaces==5.3.6",
            "threadpoolctl",
        ],
        "docs": ["mkdocs-material", "mkdocstrings[python]"],
        "test": [
            "colcon-core",
            "colcon-library-path",
            "colcon-metadata",
            "colcon-output",
            "colcon-package-information",
            "colcon-python-setup-py",
            "colcon-recursive-crawl",
            "colcon-ros",
            "cvxpy>=1.4",
            "dask[distributed]",
            "fmpy",
            "h5netcdf",
            "h5py",
            "hypothesis",
            "mcap-ros2-support",
            "mpmath",
            "mujoco",
            "mypy",
            "pin",
            "plotly",
            "psutil",
            "pytest",
            "pytest-timeout",
            "pytest-xdist",
            "rosbags",
            "ruff",
            "threadpoolctl",
            "types-PyYAML",
            "usd-core",
            "viser>=1.1",
            "wheel",
            "xarray",
            "yourdfpy",
        ],
        "maps": ["h5netcdf", "h5py", "plotly", "threadpoolctl", "xarray"],
        "cluster": ["dask[distributed]"],
        "bags": ["pin", "PyNiteFEA"],
        "certificate": ["mpmath", "mujoco", "pin", "pytest", "scipy"],
        "fit": ["cvxpy>=1.4"],
        "mjcf": ["mujoco"],
        "usd": ["usd-core"],
        "audit": ["pip-audit"],
        "coverage": ["coverage>=7.10"],
        "view": ["viser>=1.1"],
        "bench": ["pin", "pytest", "pytest-benchmark"],
    },
    entry_points={
        "console_scripts": [
            "delta_dynamics = pkm_twin.apps.nodes:delta_dynamics",
            "command_gate = pkm_twin.apps.nodes:command_gate",
            "stiffness_monitor = pkm_twin.apps.nodes:stiffness_monitor",
            "machine_state = pkm_twin.apps.nodes:machine_state",
            "machine_sim = pkm_twin.apps.nodes:machine_sim",
            "composed = pkm_twin.apps.nodes:composed",
            "pkm-twin = pkm_twin.apps.cli:main",
        ],
    },
    zip_safe=False,
)
