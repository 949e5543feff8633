# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The ROS 2 nodes delta_dynamics, command_gate and machine_sim."""
