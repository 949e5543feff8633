# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What tests share."""
