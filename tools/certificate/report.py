# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write the results as a part of docs/validation.md."""

from __future__ import annotations

import datetime
import platform
import textwrap
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rich.console import Console

from test.support.pages import write_section
from test.validation.test_upr_rpu_paper import LOAD
from tools.calculix import ABSENT, CCX, calculix_version
from tools.certificate.compare import BALANCE_BOUNDS, EFFORT_BOUND, PLACE_BOUND, ROUTES, Figures
from tools.certificate.lagrange import DIGITS
from tools.certificate.links import (
    BOUND,
    FINE,
    MESH,
    PAPER_BOUND,
    POSES,
    RESOLVED,
    Links,
    PaperRows,
    error,
    round_bar,
    with_rigid_joints,
)
from tools.certificate.machines import LEAST_MEASURE
from tools.certificate.swing import (
    DURATION,
    STEP,
    TOLERANCE,
    Swing,
)

SWING_BOUNDS = {"drift": 1e-9, "closure": 1e-10, "DOP853": 1e-9, "its own step": 1e-7}
"""Greatest energy drift (relative), opening of a loop (m), and differences of the end states."""

BALANCES = {
    "residual": ("bodies", "force and moment of every body, with reactions"),
    "efforts": ("efforts", "from these balances, against virtual work"),
    "power": ("power", "of efforts and wrench, against the rate of the Lagrange energy"),
    "energy": ("energy", "kinetic and potential, against Lagrange"),
}

PACKAGES = ("numpy", "llvmlite", "scipy", "pin", "mujoco", "mpmath")


class Judge:
    """Format numbers with their verdicts and count those beyond their bounds."""

    def __init__(self) -> None:
        self.failures: list[str] = []

    def __call__(self, value: float, bound: float, what: str) -> str:
        """Write a figure; bold, and counted as a failure, if above ``bound`` or NaN."""
        if value <= bound:
            return f"{value:.1e}"
        self.failures.append(f"{what}: {value:.3g} is above {bound:.0e}")
        return f"**{value:.1e}**"


def document(
    figures: dict[str, Figures],
    swings: list[Swing],
    links: dict[str, Links],
    rows: PaperRows,
    seed: int,
) -> tuple[str, list[str]]:
    """Write the cross-checks in Markdown, and one line per exceeded bound."""
    judge = Judge()
    parts = [_head(seed)]
    parts.append(_torques(figures, judge))
    parts.append(_balances(figures, judge))
    if swings:
        parts.append(_swings(swings, judge))
    parts.append(_compliance(links, judge))
    parts.append(_paper_rows(rows, judge))
    verdict = "All figures are within their bounds."
    if judge.failures:
        verdict = "**Bounds exceeded:**\n\n" + "\n".join(f"- {line}" for line in judge.failures)
    parts.insert(1, verdict + "\n")
    return "\n".join(parts), judge.failures


def _head(seed: int) -> str:
    today = datetime.datetime.now(datetime.UTC).date()
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    if CCX is not None:
        versions += f", CalculiX {calculix_version()}"
    return f"""## Cross-checks with other engines

`make certificate` (seed {seed}) printed this on {today}; it fails if a bound is exceeded.
Python {platform.python_version()}, {versions}.
"""


def _torques(figures: dict[str, Figures], judge: Judge) -> str:
    rows, counts, furthest = [], dict.fromkeys(ROUTES, 0), 0.0
    for name, found in figures.items():
        cells = [f"`{name}`"]
        for route in ROUTES:
            values, places = np.array(found.efforts[route]), np.array(found.places[route])
            if not len(values):
                cells.append("")
                continue
            what = f"{name}, {route}"
            counts[route] = len(values)
            cells.append(judge(float(values.max()), EFFORT_BOUND, f"{what}, torque"))
            judge(float(places.max()), PLACE_BOUND, f"{what}, place")
            furthest = max(furthest, float(places.max()))
        rows.append(f"| {' | '.join(cells)} |")
    table = "\n".join(rows)
    states = ", ".join(f"{count} ({route})" for route, count in counts.items())
    count = max(found.machines for found in figures.values())
    return f"""### Torques

{count} machines per robot have random dimensions, azimuths, masses, inertias, payload, gravity and
friction; states have random positions, rates, accelerations and a wrench, and a condition number up
to {1 / LEAST_MEASURE:.0f}.

- **Pinocchio**: a tree with loop constraints; recursive Newton-Euler sweeps and multipliers.
- **MuJoCo**: another tree, as in `pkm-twin certify`; `mj_rne`, projected on the actuators.
- **Lagrange**: energies as functions of points, derived by central differences in {DIGITS} digits.

Worst differences, relative to the largest effort (bound {EFFORT_BOUND:.0e}), of {states} states
per robot. Positions of the platform differ by at most {furthest:.1e} m (bound {PLACE_BOUND:.0e}).

| robot | {" | ".join(ROUTES)} |
|---|{"---|" * len(ROUTES)}
{table}
"""


def _balances(figures: dict[str, Figures], judge: Judge) -> str:
    rows = []
    for key, (title, text) in BALANCES.items():
        found = [np.array(one.balances[key]) for one in figures.values()]
        if not sum(map(len, found)):
            continue
        worst = judge(max(float(v.max()) for v in found if len(v)), BALANCE_BOUNDS[key], f"balance of {title}")
        rows.append(f"| {title} | {text} | {worst} | {BALANCE_BOUNDS[key]:.0e} |")
    table = "\n".join(rows)
    return f"""### Balances

Worst relative differences of the three robots; power and energy at the states for Lagrange.

| balance | | worst | bound |
|---|---|---|---|
{table}
"""


def _swings(swings: list[Swing], judge: Judge) -> str:
    rows = []
    twin = {swing.machine: swing for swing in swings if swing.route.startswith("pkm_twin")}
    for swing in swings:
        what = f"swing of {swing.machine}, {swing.route}"
        drift = judge(swing.drift, SWING_BOUNDS["drift"], f"{what}, energy")
        closure = judge(swing.closure, SWING_BOUNDS["closure"], f"{what}, closure")
        ends = []
        other = twin[swing.machine]
        if swing is not other:
            bound = SWING_BOUNDS[swing.route.split(", ")[1]]
            for k, (one, two) in enumerate(((swing.q, other.q), (swing.qd, other.qd))):
                apart = float(np.abs(one[-1] - two[-1]).max())
                ends.append(judge(apart, bound, f"{what}, {('position', 'rate')[k]} at the end"))
        rows.append(f"| `{swing.machine}` | {swing.route} | {drift} | {closure} | {', '.join(ends)} |")
    table = "\n".join(rows)
    return f"""### Free swing of {DURATION:.0f} s

Shipped robots without friction start away from a stable equilibrium; constant efforts balance the
weight. DOP853 integrates `forward_dynamics` of both engines with tolerances of {TOLERANCE:.0e};
Pinocchio's own step is RK4 at {1e3 * STEP:.0f} ms. Energy drift: relative to the largest kinetic
energy (bound {SWING_BOUNDS["drift"]:.0e}); closure: largest opening of a loop
(bound {SWING_BOUNDS["closure"]:.0e} m); last column: difference from pkm_twin at the end, rad or m,
and per second (bound {SWING_BOUNDS["DOP853"]:.0e}, RK4 {SWING_BOUNDS["its own step"]:.0e}).

| robot | engine | energy drift | closure, m | difference of q, q' |
|---|---|---|---|---|
{table}
"""


def _compliance(links: dict[str, Links], judge: Judge) -> str:
    title = "### Platform compliance of the 2UPR-RPU"
    if not links:
        return f"{title}\n\nNot compared: {ABSENT}.\n"
    rows = []
    coarse = max(found.refinement.worst for found in links.values())
    mesh = judge(coarse, BOUND / 4, "compliance, refinement")
    for name, found in links.items():
        z, beta, gamma = POSES[name]
        what = f"compliance, {name}"
        entries = judge(found.shipped.entries, BOUND, f"{what}, entries")
        diagonal = judge(_find_worst(found.shipped.diagonal), BOUND, f"{what}, diagonal")
        bent = judge(_find_worst(found.shipped.deflection), BOUND, f"{what}, deflection")
        rows.append(
            f"| {name} | {z:g}, {np.degrees(beta):.0f}, {np.degrees(gamma):.0f} "
            f"| {entries} | {diagonal} | {bent} | {found.shear_area_ratio.worst:.1e} |"
        )
    table = "\n".join(rows)
    robot = with_rigid_joints()
    spans = _write_span(np.concatenate([found.shipped.diagonal for found in links.values()]))
    return f"""{title}

The shipped parameters with joints that are free or rigid, compared with CalculiX, where bars are
solid bricks (C3D20R; {FINE} per bar). Differences of all entries are relative to
sqrt(C_ii C_jj); those of the diagonal and of the deflections under {_write_wrench(LOAD)} N and N m, to
their own values. Bound {BOUND:.0e}. {MESH} bricks per bar differ by at most {mesh}.

| pose | z (m), beta, gamma (deg) | entries | diagonal | deflections | Cowper |
|---|---|---|---|---|---|
{table}

The diagonal of pkm_twin differs by {spans} (negative is stiffer). *Cowper*: with the shear factor
{round_bar(robot):.3f} in place of {robot.members.shear_factor:g}.
"""


def _paper_rows(rows: PaperRows, judge: Judge) -> str:
    known = rows.excess[RESOLVED]
    worst = judge(error(rows.twin), PAPER_BOUND, "table 1, finite elements")
    cause = _filled(f"""
        Compared with pkm_twin with the shipped joint compliances, the finite elements of table 1 in
        the 2UPR-RPU paper are softer in {int((known > 0).sum())} of {known.size} components, by
        {_write_span(known)}. The worst difference relative to them is {worst}; the paper states
        {PAPER_BOUND:g}. If one factor multiplies all joints' compliances,
        at least {_write_percent(rows.joints[1])} remains; with a factor of {rows.bars[0]:.2f} on all
        bars' compliances, {_write_percent(rows.bars[1])}.
        The paper shows neither mesh nor contacts, so the cause cannot be determined.
    """)
    return f"""### The paper's finite elements

{cause}
"""


def _filled(text: str) -> str:
    """Wrap a paragraph to the page's line length."""
    return textwrap.fill(" ".join(text.split()), 100)


def conclude(path: Path, text: str, failures: list[str], console: Console) -> int:
    """Write the page's part, print what exceeds its bounds, and return the exit code."""
    write_section("cross-checks", text, path)
    console.print(f"{path} written")
    for line in failures:
        console.print(line, style="red")
    return 1 if failures else 0


def _write_percent(value: float) -> str:
    return f"{100 * value:.2g} %"


def _find_worst(values: np.ndarray) -> float:
    return float(np.abs(values).max())


def _write_span(values: np.ndarray) -> str:
    """Format the smallest and largest value in per cent."""
    return f"{100 * values.min():+.2f} to {100 * values.max():+.2f} %"


def _write_wrench(values: list[float]) -> str:
    return "(" + ", ".join(f"{v:g}" for v in values) + ")"
