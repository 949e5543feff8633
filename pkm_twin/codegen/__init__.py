# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Expressions, and the code that is made of them: knows nothing of machines."""
