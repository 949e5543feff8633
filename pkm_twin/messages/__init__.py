# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages to arrays and back, by attributes or bytes. Needs no ROS."""
