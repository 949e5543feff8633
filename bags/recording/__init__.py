# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Engines that record the bags: multibody dynamics by Pinocchio, elastic frames by PyNite.

Nothing here shares a formula with the twin: that is what makes a replayed bag a test of it.
"""
