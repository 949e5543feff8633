# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Publish the machine's state for display: all joints, the platform's motion, shapes to draw."""
