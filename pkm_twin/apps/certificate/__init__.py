# SPDX-License-Identifier: Apache-2.0
"""Judges of the twin: other engines that compute a machine from its plain description.

Nothing here imports the twin's mechanics; a machine is the mapping that its YAML file holds.
"""
