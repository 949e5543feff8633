# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Robots: kinematics by the engine, URDF in and out, workspace, derivatives."""
