# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Check the package by independent engines that compute a machine from its plain description.

The description is the mapping of a machine's YAML file. The engines import nothing of the package
but the names, freedoms and constraints of joint types, see ``pkm_twin.machine.joints``.
"""
