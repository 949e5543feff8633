# SPDX-License-Identifier: Apache-2.0
"""Both nodes, for a Delta and an overconstrained head; every argument has a default."""

from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    arguments = {
        "dynamics_mechanism": ("delta_cu", "robot of delta_dynamics: a name or a path"),
        "stiffness_mechanism": ("upr_rpu", "robot of stiffness_monitor: a name or a path"),
        "acceleration": ("trajectory", "trajectory or differentiate"),
        "dynamics_joint_states": ("/joint_states", "topic that delta_dynamics listens to"),
        "stiffness_joint_states": ("/joint_states", "topic that stiffness_monitor listens to"),
        "wrench": ("/wrench", "topic of the measured wrench"),
        "wrench_frame": ("platform", "frame of the measured wrench"),
        "use_sim_time": ("false", "true where a bag is replayed with --clock"),
    }
    sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in arguments.items()
            ),
            # Matrices here are small: threads cost more than they bring.
            SetEnvironmentVariable("OMP_NUM_THREADS", "1"),
            Node(
                package="pkm_twin",
                executable="delta_dynamics",
                parameters=[
                    {
                        "mechanism": LaunchConfiguration("dynamics_mechanism"),
                        "acceleration": LaunchConfiguration("acceleration"),
                        "use_sim_time": sim_time,
                    }
                ],
                remappings=[("joint_states", LaunchConfiguration("dynamics_joint_states"))],
            ),
            Node(
                package="pkm_twin",
                executable="stiffness_monitor",
                parameters=[
                    {
                        "mechanism": LaunchConfiguration("stiffness_mechanism"),
                        "wrench_frame": LaunchConfiguration("wrench_frame"),
                        "use_sim_time": sim_time,
                    }
                ],
                remappings=[
                    ("joint_states", LaunchConfiguration("stiffness_joint_states")),
                    ("wrench", LaunchConfiguration("wrench")),
                ],
            ),
        ]
    )
