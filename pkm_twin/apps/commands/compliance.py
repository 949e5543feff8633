# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin compliance``: deflection and the weak part at a pose under a load."""

from __future__ import annotations

from dataclasses import dataclass

import click

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import BeyondLimitsOption, RobotArgument
from pkm_twin.errors import PkmTwinError
from pkm_twin.report import Column, Fact, Report, Table
from pkm_twin.settings import setting

AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, kw_only=True)
class Compliance(RobotArgument, BeyondLimitsOption):
    """Compute compliance and strain energy at a pose.

    Example: `pkm-twin compliance upr_rpu -0.6 0 0 --wrench 30,-50,-40,10,-20,50`.

    The strain energy is given by element: the members and elastic joints of the robot's structure.
    For upr_rpu an element is the limb's number with R (revolute joint), B (bar) or U (universal
    joint). Stiffen the dominant element first: it stores the largest share.
    """

    pose: tuple[float, ...] = setting(..., "the pose's coordinates, m and rad", argument=True)
    wrench: tuple[float, ...] = setting(
        (0.0, 0.0, 1.0, 0.0, 0.0, 0.0), "load fx,fy,fz,mx,my,mz at the reference point, N and N m, base axes", count=6
    )


@command("Stiffness, workspace and vibration")
def compliance(given: Compliance) -> Report:
    """Compute the platform's compliance, deflection and shares of strain energy.

    :raises PkmTwinError: a pose that is out of reach or of limits.
    """
    import numpy as np

    from stiffness_monitor import compliance_deviation, deflection_deviation, strain_energy

    machine = given.machine()
    names = machine.pose_names
    if len(given.pose) != len(names):
        units = (f"{n} ({u})" for n, u in zip(names, machine.pose_units, strict=True))
        shown = " ".join(f"{number:g}" for number in given.pose)
        raise click.UsageError(f"a pose of {machine.name} is {', '.join(units)}, not {shown}")
    try:
        beyond = given.list_beyond_limits(machine, machine.inverse(given.pose))
        energy = strain_energy(machine, given.pose, given.wrench)
    except PkmTwinError:
        raise
    except ValueError as error:  # finite numbers, but so large that the result is not
        raise PkmTwinError(str(error)) from None
    c, moved = energy.compliance, energy.deflection
    # Name all elements whose energy is the largest within rounding, in the order of the structure.
    first = np.isclose(energy.factors, energy.factors.max(), rtol=1e-6)
    tied = [n for n, most in zip(energy.elements, first, strict=True) if most and energy.tie]
    shares = dict(zip(energy.elements, energy.factors.tolist(), strict=True))
    ordered = sorted(shares.items(), key=lambda pair: -pair[1])
    load = ", ".join(f"{value:g}" for value in given.wrench)
    dominant = (
        f"dominant elements, with equal shares: {', '.join(tied)}" if tied else f"dominant element {energy.dominant}"
    )
    least = 1e-12 * np.abs(moved).max()
    facts = [
        Fact("robot", machine.name),
        Fact("pose", dict(zip(names, given.pose, strict=True))),
        Fact("wrench", given.wrench),
        Fact("compliance", c),
        Fact("compliance_deviation", compliance_deviation(machine, given.pose)),
        Fact(
            "deflection",
            moved,
            text="deflection (µm, µrad)",
            shown=_format_micro(np.where(abs(moved) > least, moved, 0.0), ".4g"),
        ),
        Fact("total_energy", energy.total, "J", text="strain energy"),
        Fact(
            "factors",
            shares,
            text=None if energy.dominant == "none" else "shares",
            shown=", ".join(f"{name} {100 * part:.1f} %" for name, part in ordered),
        ),
        Fact("dominant", str(energy.dominant)),
        Fact("tie", tied),
        Fact("beyond_limits", {item.joint: item.value for item in beyond}),
    ]
    if machine.uncertainty:
        doubt = deflection_deviation(machine, given.pose, given.wrench)
        doubts = _format_micro(np.where(doubt > 1e-12 * doubt.max(), doubt, 0.0), ".2g")
        label = "standard deviation (from the robot file's uncertainty)" if doubt.any() else None
        facts.insert(6, Fact("", doubts, text=label))
    size = np.sqrt(np.diag(c))
    # Print rounding errors of entries that are zero by symmetry as zero.
    cells = np.where(abs(c) < 1e-9 * np.outer(size, size), 0.0, c)
    rows = {axis: row.tolist() for axis, row in zip(AXES, cells, strict=True)}
    columns = [Column("", text=name, form=".3e") for name in ("fx", "fy", "fz", "mx", "my", "mz")]
    title = "compliance at the platform's reference point, base axes: m and rad, per N and N m"
    return Report(
        answer=f"{machine.name}: {dominant} under the wrench {load} (N, N m)",
        facts=facts,
        tables=[Table("", columns, rows, title)],
        notes=[f"beyond limits: {item}" for item in beyond],
    )


def _format_micro(values: object, form: str) -> str:
    pairs = zip(AXES, values, strict=True)  # type: ignore[call-overload]
    return ", ".join(f"{name} {1e6 * value:{form}}" for name, value in pairs)
