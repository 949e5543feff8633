# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Judges of the twin: other engines that compute a machine from its plain description.

A machine is the mapping that its YAML file holds. Of the twin nothing is imported but what joint
types are called, let move and hold, see ``pkm_twin.machine.joints``.
"""
