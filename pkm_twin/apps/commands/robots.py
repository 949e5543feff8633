# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin robots``: what ships with pkm_twin."""

from __future__ import annotations

from dataclasses import dataclass

from pkm_twin.apps.frame import command
from pkm_twin.report import Column, Report, Table


@dataclass(frozen=True, kw_only=True)
class Robots:
    """List the robots that ship with pkm_twin."""


@command("Robots")
def robots(given: Robots) -> Report:
    """List the robots with a sentence on each."""
    from pkm_twin import load, robot_names

    rows = {name: [load(name).description] for name in robot_names()}
    return Report(tables=[Table("robots", [Column("description", text=" ")], rows)])
