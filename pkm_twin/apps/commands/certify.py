# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin certify``: a robot against independent engines."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import RobotArgument, SeedOption
from pkm_twin.console import draw_progress
from pkm_twin.report import Column, Fact, Report, Table, Verdict
from pkm_twin.settings import setting

if TYPE_CHECKING:
    pass


@dataclass(frozen=True, kw_only=True)
class Certify(RobotArgument, SeedOption):
    """Cross-check a robot with independent engines.

    Three engines compute the machine from its description and share no mechanics code with
    pkm_twin: maximal (free bodies, every joint as equations), pinocchio and mujoco (a tree with
    loop constraints each; `pip install '.[certificate]'`). The command compares torques with
    wrench, payload and friction, the platform's pose and Jacobian, and the mass matrix, at random
    states inside the limits. Lines `twin` compare pkm_twin with itself:
    the round trip from joint positions to pose and back, and one state with a batch of states.
    States beyond a singularity on pkm_twin's way from home are skipped and counted.

    --variants N repeats this for N machines whose masses, inertias, friction and lengths are drawn
    at random, with a relative standard deviation of 2 %. If a machine
    closes only with the file's lengths, they are kept. The results are the worst over all machines.

    Exit code 0: all differences are within their bounds. 1: one is not, or the machine cannot be
    checked.
    """

    states: int = setting(20, "number of random states", low=1, high=100000)
    seed: int = setting(1, "seed of the random states", low=0, high=2**63 - 1)
    engine: tuple[str, ...] = setting((), "use only this engine: maximal, pinocchio or mujoco")
    variants: int = setting(0, "also check this many randomly changed machines", low=0, high=10000)


@command("Robots")
def certify(given: Certify) -> Report:
    """Compare the model with each independent engine, against the bounds."""
    from pkm_twin.certify.certificate import ENGINES, certify_variants

    unknown = [name for name in given.engine if name not in ENGINES]
    if unknown:
        raise click.UsageError(f"no engine {unknown[0]!r}; there are {', '.join(ENGINES)}")
    with draw_progress("states", given.states * (given.variants + 1)) as update:
        found = certify_variants(
            given.machine(),
            given.variants,
            seed=given.seed,
            progress=update,
            states=given.states,
            engines=given.engine or tuple(ENGINES),
        )
    which = f"{found.robot} and {given.variants} variants" if given.variants else found.robot
    rows = {
        f"{item.engine}: {item.what.replace('_', ' ')}": [
            item.worst,
            item.median,
            item.bound,
            "good" if item.good else "bad",
        ]
        for item in found.items
    }
    columns = [Column("", text=name, form=".1e") for name in ("worst", "median", "bound")]
    notes = [f"{name} was not used: {reason}" for name, reason in found.missing.items()]
    if found.skipped:
        notes.insert(
            0,
            f"{found.skipped} of {found.drawn} states drawn were skipped: pkm_twin meets a "
            "singularity on the way from home",
        )
    # Report the comparison with the largest ratio of difference to bound, infinite for a bound of 0.
    worst = max(found.items, key=lambda i: i.worst / i.bound if i.bound else math.inf if i.worst else 0.0, default=None)
    most = (
        ""
        if worst is None
        else (
            f"; nearest to its bound: {worst.what.replace('_', ' ')} {worst.worst:.1e} of "
            f"{worst.bound:.1e}, against {worst.engine}"
        )
    )
    return Report(
        f"{'good' if found.good else 'bad'}: {which}, compared with pkm_twin at {found.states} "
        f"states, seed {found.seed}{most}",
        [Fact(name, value) for name, value in found.data.items()],
        [Table("", [*columns, Column("", text="verdict")], rows)],
        notes=notes,
        verdict=Verdict.GOOD if found.good else Verdict.BAD,
    )
