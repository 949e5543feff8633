# SPDX-License-Identifier: Apache-2.0
"""Robots: kinematics by the engine, the catalogue, files in and out, workspace, derivatives."""
