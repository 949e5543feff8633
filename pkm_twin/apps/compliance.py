# SPDX-License-Identifier: Apache-2.0
"""The command ``pkm-twin compliance``."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer

from pkm_twin.apps import export, maps  # noqa: F401  maps adds its commands to atlas
from pkm_twin.apps.options import BeyondLimits, Json, Platform, RobotName
from pkm_twin.console import numbers, print_json
from pkm_twin.errors import PkmTwinError


def compliance(
    robot: RobotName,
    pose: Annotated[
        list[float],
        typer.Argument(help="the pose's coordinates, for upr_rpu z (m), beta, gamma (rad)"),
    ],
    wrench: Annotated[
        str,
        typer.Option(
            help="load case, FX,FY,FZ,MX,MY,MZ at the platform's reference point, N and N m, base "
            "axes"
        ),
    ] = "0,0,1,0,0,0",
    platform: Platform = None,
    beyond_limits: BeyondLimits = False,
    as_json: Json = False,
) -> None:
    """Compute compliance and strain energy at a pose.

    Example: `pkm-twin compliance upr_rpu -0.6 0 0 --wrench 30,-50,-40,10,-20,50`.

    The strain energy is given by element: the members and elastic joints of the robot's structure.
    For upr_rpu an element is the limb's number with R (revolute joint), B (bar) or U (universal
    joint). Stiffen the dominant element first: it stores the largest share.
    """
    from pkm_twin import load
    from pkm_twin.apps.limits import beyond_limits as find_beyond
    from pkm_twin.apps.limits import refuse_beyond
    from stiffness_monitor import compliance_deviation, deflection_deviation, strain_energy

    machine = load(robot, platform=platform)
    names = ", ".join(
        f"{name} ({unit})"
        for name, unit in zip(machine.pose_names, machine.pose_units, strict=True)
    )
    if len(pose) != len(machine.pose_names) or not np.isfinite(pose).all():
        given = " ".join(f"{number:g}" for number in pose)
        raise typer.BadParameter(f"a pose of {machine.name} is {names}, not {given}")
    load_case = numbers(wrench, 6)
    try:
        _, beyond = find_beyond(machine, machine.inverse(pose))
        if not beyond_limits:
            refuse_beyond(beyond)
        energy = strain_energy(machine, pose, load_case)
        c = energy.compliance
    except PkmTwinError:
        raise
    except ValueError as error:  # finite numbers, but so large that the result is not
        raise PkmTwinError(str(error)) from None
    # Elements that share the first place within rounding are named together, the stable one first.
    first = np.isclose(energy.factors, energy.factors.max(), rtol=1e-6)
    shared = zip(energy.elements, first, strict=True)
    tied = [name for name, greatest in shared if greatest and energy.tie]
    if as_json:
        result = {
            "robot": machine.name,
            "pose": dict(zip(machine.pose_names, pose, strict=True)),
            "wrench": load_case,
            "compliance": c.tolist(),
            "compliance_deviation": compliance_deviation(machine, pose).tolist(),
            "deflection": energy.deflection.tolist(),
            "total_energy": float(energy.total),
            "factors": dict(zip(energy.elements, energy.factors.tolist(), strict=True)),
            "dominant": str(energy.dominant),
            "tie": tied,
            "beyond_limits": {item.joint: item.value for item in beyond},
        }
        print_json(result)
        return
    axes = ("x", "y", "z", "rx", "ry", "rz")
    typer.echo(
        f"compliance of {machine.name} at the platform's reference point, base axes: rows m and "
        "rad, per N and N m"
    )
    typer.echo(" " * 4 + "".join(f"{name:>11}" for name in ("fx", "fy", "fz", "mx", "my", "mz")))
    size = np.sqrt(np.diag(c))
    for name, row, scale in zip(axes, c, np.outer(size, size), strict=True):
        # What is zero by symmetry is printed so, not as rounding.
        cells = ("0" if abs(v) < 1e-9 * s else f"{v:.3e}" for v, s in zip(row, scale, strict=True))
        typer.echo(f"{name:>4}" + "".join(f"{cell:>11}" for cell in cells))
    least = 1e-12 * np.abs(energy.deflection).max()
    moved = (
        f"{name} {1e6 * v if abs(v) > least else 0.0:.4g}"
        for name, v in zip(axes, energy.deflection, strict=True)
    )
    typer.echo(f"\nunder the wrench {wrench} (N, N m)")
    typer.echo(f"deflection (µm, µrad): {', '.join(moved)}")
    shares = sorted(zip(energy.factors, energy.elements, strict=True), key=lambda pair: -pair[0])
    dominant = (
        f"dominant elements, with equal shares: {', '.join(tied)}"
        if tied
        else f"dominant element {energy.dominant}"
    )
    if machine.uncertainty:
        turned = deflection_deviation(machine, pose, load_case)
        doubts = ", ".join(f"{n} {1e6 * v:.2g}" for n, v in zip(axes, turned, strict=True))
        typer.echo(f"standard deviation (from the robot file's uncertainty): {doubts}")
    typer.echo(f"strain energy {energy.total:.4g} J, {dominant}")
    if energy.dominant != "none":
        typer.echo("shares: " + ", ".join(f"{name} {100 * part:.1f} %" for part, name in shares))
    for item in beyond:
        typer.echo(f"beyond limits: {item}")
