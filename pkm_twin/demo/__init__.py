# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The demonstration: play recorded bags through the real nodes and check their answers."""
