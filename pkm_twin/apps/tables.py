# SPDX-License-Identifier: Apache-2.0
"""Options of how tables are written."""

from __future__ import annotations

from contextvars import ContextVar
from typing import Annotated, Final

import typer

from pkm_twin.options import OptionalText, shared_options
from pkm_twin.recordings.tables import PLAIN, Dialect

CHOSEN: Final = ContextVar("dialect", default=PLAIN)
"""The dialect of the command that runs."""


def _options(
    separator: Annotated[
        OptionalText, typer.Option(help="of a table's columns: , ; or tab; default: found")
    ] = None,
    decimal: Annotated[OptionalText, typer.Option(help="of a table's numbers: . or ,")] = None,
    columns: Annotated[
        OptionalText,
        typer.Option(help="names of a table's columns, OURS=THEIRS,...: time=t,arm_1.position=q1"),
    ] = None,
    units: Annotated[
        OptionalText, typer.Option(help="of a table: of rad, deg, m, mm, s, ms, us; default SI")
    ] = None,
    time: Annotated[OptionalText, typer.Option(help="name of a table's column of times")] = None,
) -> None:
    del separator, decimal, columns, units, time


tables = shared_options(_options, CHOSEN, Dialect.of)
"""Gives a command that reads tables the options of their dialect."""
