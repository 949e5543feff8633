# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The three papers: each numbered equation, table and figure compared with this package."""
