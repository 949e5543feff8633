# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a machine is: schema, bodies, joints, members, formats of files."""
