# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a stream of samples needs: differentiation, continuity, counting. Pure."""
