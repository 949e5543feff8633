# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Convert messages to arrays and back, from attributes or bytes; needs no ROS."""
