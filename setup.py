# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import setup

NAME = "pkm_twin"

setup(
    name=NAME,
    version="0.1.0",
    description="Digital twin of parallel kinematic machines",
    license="Apache-2.0",
    author="pkm_twin maintainers",
    maintainer="pkm_twin maintainers",
    python_requires=">=3.11",
    packages=[
        "pkm_twin",
        "pkm_twin.apps",
        "pkm_twin.atlas",
        "pkm_twin.bags",
        "pkm_twin.codegen",
        "pkm_twin.config",
        "pkm_twin.kinematics",
        "pkm_twin.machine",
        "pkm_twin.mechanisms",
        "pkm_twin.ros",
        "pkm_twin.streams",
        "delta_dynamics",
        "stiffness_monitor",
    ],
    # The parameter files stand at the top for people and inside the package for load().
    package_dir={"pkm_twin.config": "config"},
    package_data={
        "pkm_twin": ["py.typed"],
        "pkm_twin.config": ["*.yaml"],
        "delta_dynamics": ["py.typed"],
        "stiffness_monitor": ["py.typed"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", sorted(glob("config/*.yaml"))),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py") + glob("launch/*.yaml"))),
    ],
    install_requires=[
        "matplotlib>=3.6",
        "lz4",
        "mcap>=1.6",
        "numba>=0.58",
        "numpy>=1.26",
        "PyYAML>=6",
        "rich>=13",
        "scipy>=1.11",
        "setuptools",
        "typer>=0.9",
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
        "test": [
            "colcon-core",
            "colcon-library-path",
            "colcon-metadata",
            "colcon-output",
            "colcon-package-information",
            "colcon-python-setup-py",
            "colcon-recursive-crawl",
            "colcon-ros",
            "dask[distributed]",
            "h5netcdf",
            "h5py",
            "hypothesis",
            "mcap-ros2-support",
            "mpmath",
            "mypy",
            "pin",
            "plotly",
            "psutil",
            "pytest",
            "pytest-timeout",
            "ruff",
            "threadpoolctl",
            "types-PyYAML",
            "wheel",
            "xarray",
        ],
        "atlas": ["h5netcdf", "h5py", "plotly", "threadpoolctl", "xarray"],
        "cluster": ["dask[distributed]"],
        "bags": ["pin", "PyNiteFEA"],
        "certificate": ["mpmath", "mujoco", "pin", "pytest", "scipy"],
        "bench": ["pin", "pytest", "pytest-benchmark"],
    },
    entry_points={
        "console_scripts": [
            "delta_dynamics = pkm_twin.apps.nodes:delta_dynamics",
            "command_gate = pkm_twin.apps.nodes:command_gate",
            "stiffness_monitor = pkm_twin.apps.nodes:stiffness_monitor",
            "pkm-twin = pkm_twin.apps.cli:main",
        ],
    },
    zip_safe=False,
)
