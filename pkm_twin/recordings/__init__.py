# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings and planned motions: one type, one reader of bags and tables."""

from pkm_twin.recordings.payload import Load, split_by_load
from pkm_twin.recordings.read import read
from pkm_twin.recordings.recording import ReadOptions, Recording, find_resting_joints
from pkm_twin.recordings.tables import Dialect, Table, map_column_quantities, read_table, write_table

__all__ = [
    "Dialect",
    "Load",
    "ReadOptions",
    "Recording",
    "Table",
    "find_resting_joints",
    "map_column_quantities",
    "read",
    "read_table",
    "split_by_load",
    "write_table",
]
