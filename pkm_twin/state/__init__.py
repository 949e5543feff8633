# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The machine's state for others to see: all joints, the platform's motion, shapes to draw."""
