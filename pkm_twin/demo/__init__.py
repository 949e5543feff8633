# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The demonstration: recorded bags through the real nodes, and what came back."""
