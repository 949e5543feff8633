# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Commands and the demonstration: may import everything, nobody imports them."""
