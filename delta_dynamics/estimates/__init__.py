# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Contacts and payload from measured efforts."""
