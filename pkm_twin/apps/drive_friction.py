# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin drive-friction``: torque constant and friction law by weights hung from a drive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkm_twin.apps.options import Json
from pkm_twin.console import print_json
from pkm_twin.errors import ParameterError
from pkm_twin.recordings import read_table

GRAVITY = 9.80665
"""Standard gravity, m/s2."""


def drive_friction_command(
    table: Annotated[
        Path,
        typer.Argument(
            help="CSV with one row per run: mass_kg or torque_nm, iq_up_A, iq_down_A; "
            "optional: speed, drive (a number)"
        ),
    ],
    lever: Annotated[
        float,
        typer.Option(help="for mass_kg: travel per radian of the motor (spool radius), m"),
    ] = 0.0,
    as_json: Json = False,
) -> None:
    """Fit a drive's torque constant and friction to slow traverses with weights, up and down.

    At least two weights are needed. A friction law has the terms that the runs determine: Coulomb,
    viscous (two speeds or more), load-dependent. A term is accepted if an F test at 5 % rejects the
    law without it, and if the law predicts left-out runs better. Each run is left out once. Several
    drives of one kind share their numbers; each drive is left out once, too.
    """
    from pkm_twin.identification.hanging_mass import drive_friction, lines

    columns = read_table(table)
    columns.require(["iq_up_A", "iq_down_A"])
    if "torque_nm" in columns:
        torque = columns["torque_nm"]
    elif "mass_kg" in columns:
        if not lever > 0.0:
            raise ParameterError("--lever", lever, "m per rad, above 0, for a column mass_kg")
        torque = GRAVITY * lever * columns["mass_kg"]
    else:
        raise ParameterError(str(table), ", ".join(columns), "a column 'mass_kg' or 'torque_nm'")
    found = drive_friction(
        torque, columns["iq_up_A"], columns["iq_down_A"], columns.get("speed"), columns.get("drive")
    )
    if as_json:
        print_json(found.as_json())
        return
    for line in lines(found):
        typer.echo(line)
