# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Differentiation, continuity, noise and counts of streams of samples. Pure: times are arguments."""
