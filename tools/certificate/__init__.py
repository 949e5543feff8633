# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The comparison with other engines at length: ``make certificate``."""
