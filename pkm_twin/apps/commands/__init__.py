# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The commands of ``pkm-twin``: a file each, which is found by its name."""
