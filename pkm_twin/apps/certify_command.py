# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin certify``: a robot against independent engines."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from pkm_twin.apps.options import REFUSED, Json, Platform, RobotName
from pkm_twin.console import print_json, progress, table_console


def certify(
    robot: RobotName,
    states: Annotated[int, typer.Option(min=1, max=100000, help="number of random states")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="seed of the random states")] = 1,
    engine: Annotated[
        list[str], typer.Option(help="use only this engine: maximal, pinocchio or mujoco")
    ] = [],  # noqa: B006  typer copies it
    variants: Annotated[
        int,
        typer.Option(
            min=0, max=10000, help="also check this many machines with other lengths and masses"
        ),
    ] = 0,
    platform: Platform = None,
    as_json: Json = False,
) -> None:
    """Cross-check a robot with independent engines.

    Three engines compute the machine from its description and share no mechanics code with
    pkm_twin: maximal (free bodies, every joint as equations), pinocchio and mujoco (a tree with
    loop constraints each; `pip install '.[certificate]'`). The command compares torques with
    wrench, payload and friction, the platform's pose and Jacobian, and the mass matrix, at random
    states inside the limits. It also checks the round trip from joint positions to pose and back.
    States beyond a singularity on pkm_twin's way from home are skipped and counted.

    --variants N repeats this for N machines whose masses, inertias, friction and lengths are drawn
    at random, with a relative standard deviation of 2 %. If a machine
    closes only with the file's lengths, they are kept. The results are the worst over all machines.

    Exit code 0: all differences are within their bounds. 1: one is not, or the machine cannot be
    checked.
    """
    from pkm_twin import load
    from pkm_twin.apps.certify import ENGINES, certify_variants

    unknown = [name for name in engine if name not in ENGINES]
    if unknown:
        raise typer.BadParameter(f"no engine {unknown[0]!r}; there are {', '.join(ENGINES)}")
    with progress("states", states * (variants + 1)) as update:
        result = certify_variants(
            load(robot, platform=platform), variants, seed=seed, progress=update,
            states=states, engines=engine or tuple(ENGINES),
        )  # fmt: skip
    if as_json:
        print_json(result.as_json())
    else:
        which = f"{result.robot} and {variants} variants" if variants else result.robot
        table = Table(
            title=Text(
                f"{which}: differences from pkm_twin at {result.states} states, seed {result.seed}"
            )
        )
        for column in ("engine", "what", "worst", "median", "bound", "verdict"):
            table.add_column(column)
        for item in result.items:
            verdict = Text("good", "green") if item.good else Text("bad", "red")
            values = (f"{value:.1e}" for value in (item.worst, item.median, item.bound))
            table.add_row(item.engine, item.what.replace("_", " "), *values, verdict)
        table_console().print(table)
        if result.skipped:
            typer.echo(
                f"{result.skipped} of {result.drawn} states drawn were skipped: pkm_twin meets a "
                "singularity on the way from home"
            )
        for name, reason in result.missing.items():
            typer.echo(f"{name} was not used: {reason}")
        typer.echo("good" if result.good else "bad")
    if not result.good:
        raise typer.Exit(REFUSED)
