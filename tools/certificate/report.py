# SPDX-License-Identifier: Apache-2.0
"""The figures as a document."""

from __future__ import annotations

import datetime
import platform
import textwrap
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rich.console import Console

from test.validation.test_upr_rpu_paper import LOAD
from tools.calculix import ABSENT, CCX, calculix_version
from tools.certificate.compare import BALANCE_BOUNDS, BOUNDS, PLACE_BOUND, ROUTES, Figures
from tools.certificate.lagrange import DIGITS
from tools.certificate.links import (
    BOUND,
    FACTORS,
    FINE,
    FINITE_ELEMENTS,
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
from tools.certificate.machines import AZIMUTH_ERROR, LEAST_MEASURE, THIN
from tools.certificate.mujoco_models import SPECK
from tools.certificate.swing import (
    DELTA_DEVIATION,
    DELTA_REST,
    DURATION,
    PRRU_RATES,
    SAMPLES,
    STEP,
    TOLERANCE,
    TOOL,
    Swing,
)

SWING_BOUNDS = {"drift": 1e-9, "closure": 1e-10, "DOP853": 1e-9, "its own step": 1e-7}
"""Greatest energy drift (relative), opening of a loop (m), and differences of the end states."""

BALANCES = {"residual": "bodies", "efforts": "efforts", "power": "power", "energy": "energy"}

TITLES = {
    "delta": "Delta, three rods",
    "delta_cu": "Delta, two rods and an R-C-U",
    "prru": "3-PRRU",
}

PACKAGES = ("numpy", "llvmlite", "scipy", "pin", "mujoco", "mpmath")


class Judge:
    """Formats a figure with its verdict and counts what goes beyond its bound."""

    def __init__(self) -> None:
        self.failures: list[str] = []

    def __call__(self, value: float, bound: float, what: str) -> str:
        """The figure as text, bold and counted where it is above ``bound`` or not a number."""
        if value <= bound:
            return f"{value:.1e}"
        self.failures.append(f"{what}: {value:.3g} is above {bound:.0e}")
        return f"**{value:.1e}**"


def document(
    figures: dict[str, Figures],
    swings: list[Swing],
    links: dict[str, Links],
    rows: PaperRows,
    command: str,
    seed: int,
) -> tuple[str, list[str]]:
    """The certificate in Markdown, and one line for every bound that is exceeded."""
    judge = Judge()
    parts = [_head(command, seed)]
    parts.append(_torques(figures, judge))
    parts.append(_balances(figures, judge))
    if swings:
        parts.append(_swings(swings, judge))
    parts.append(_compliance(links, judge))
    parts.append(_paper_rows(rows, links, judge))
    verdict = "All figures are within their bounds."
    if judge.failures:
        verdict = "**Bounds exceeded:**\n\n" + "\n".join(f"- {line}" for line in judge.failures)
    parts.insert(1, verdict + "\n")
    return "\n".join(parts), judge.failures


def _head(command: str, seed: int) -> str:
    today = datetime.datetime.now(datetime.UTC).date()
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    if CCX is not None:
        versions += f", CalculiX {calculix_version()}"
    return f"""# Cross-checks of dynamics and static stiffness

This page compares the torques, reactions, energies and free motion of pkm_twin with three
independent methods, and the 2UPR-RPU's platform compliance with finite elements. A program writes
the page; every number in the tables comes from its run of {today}. Write it again with

    make certificate

which runs `{command}`. It takes some minutes and fails if a bound is
exceeded. The seed of the random numbers is {seed}. Written with Python {platform.python_version()},
{versions}.
"""


def _torques(figures: dict[str, Figures], judge: Judge) -> str:
    rows = []
    for name, found in figures.items():
        for route in ROUTES:
            values, places = np.array(found.efforts[route]), np.array(found.places[route])
            if not len(values):
                continue
            what = f"{TITLES[name]}, {route}"
            worst = judge(float(values.max()), BOUNDS[route], f"{what}, torque")
            place = judge(float(places.max()), PLACE_BOUND, f"{what}, place")
            rows.append(
                f"| {TITLES[name]} | {route} | {found.machines} | {len(values)} | {worst} "
                f"| {np.median(values):.1e} | {BOUNDS[route]:.0e} | {place} |"
            )
    table = "\n".join(rows)
    return f"""## Torques

Each machine has random dimensions, limb azimuths up to {AZIMUTH_ERROR} rad off, masses and
inertias, a payload with its own centre of mass and full inertia matrix, gravity in any direction,
and friction. Each state has random positions, rates, accelerations and a wrench on the platform.
The R-C-U limb is any of the limbs. The 3-PRRU's sliders are above or below, and the links of
{THIN:.0%} of its machines are rods without inertia about their axes. States whose Jacobian, as
computed by pkm_twin, has a condition number above {1 / LEAST_MEASURE:.0f} are left out.

- **Pinocchio**: an open tree of bodies and loop constraints; tree motion by Newton's method and
  the constraints' Jacobian, efforts from recursive Newton-Euler sweeps and the multipliers.
- **MuJoCo**: another tree, an MJCF made from the same parameter mapping; loops closed by Newton's
  method on MuJoCo's kinematics, rates and accelerations by its Jacobians and their derivatives,
  `mj_inverse` on the tree, projected on the actuators. Rods have {SPECK:.0e} kg m2 about
  their axes, because MuJoCo requires a positive inertia.
- **Lagrange**: kinetic and potential energy as functions of points and their velocities, all
  derivatives by central differences in {DIGITS} digits, the loops closed by Newton's method in the
  same precision. The remaining difference is the rounding of pkm_twin.

A difference is the largest difference of the three efforts, divided by the largest effort of the
other method. The last column is the largest difference of the platform's position by forward
kinematics.

| robot | method | machines | states | worst | median | bound \
| position, m (bound {PLACE_BOUND:.0e}) |
|---|---|---|---|---|---|---|---|
{table}
"""


def _balances(figures: dict[str, Figures], judge: Judge) -> str:
    rows = []
    for key, title in BALANCES.items():
        for name, found in figures.items():
            values = np.array(found.balances[key])
            if not len(values):
                continue
            worst = judge(
                float(values.max()), BALANCE_BOUNDS[key], f"{TITLES[name]}, balance of {title}"
            )
            rows.append(
                f"| {title} | {TITLES[name]} | {len(values)} | {worst} "
                f"| {np.median(values):.1e} | {BALANCE_BOUNDS[key]:.0e} |"
            )
    table = "\n".join(rows)
    return f"""## Balances

Computed for the same states; the last two for the states of the Lagrange method.

- Bodies: force and moment balance of every body with the joints' reactions; the worst imbalance,
  divided by the largest load.
- Efforts: the actuators' efforts from these balances, compared with those by virtual work.
- Power: the efforts and platform twist of pkm_twin, compared with the rate of the Lagrange method's
  energy; the difference, divided by the sum of the absolute powers.
- Energy: kinetic and potential energy of pkm_twin, compared with the Lagrange method.

The first two compare reactions with pkm_twin's own inertia forces. A couple that does no work in
any motion of the machine, such as the gyroscopic one of a 3-PRRU's upper link, occurs in the
reactions but not in torques or energies; `test/validation/test_reactions_pinocchio.py` checks it.

| balance | robot | states | worst | median | bound |
|---|---|---|---|---|---|
{table}
"""


def _swings(swings: list[Swing], judge: Judge) -> str:
    rows = []
    twin = {swing.machine: swing for swing in swings if swing.route.startswith("twin")}
    for swing in swings:
        what = f"swing of {swing.machine}, {swing.route}"
        drift = judge(swing.drift, SWING_BOUNDS["drift"], f"{what}, energy")
        closure = judge(swing.closure, SWING_BOUNDS["closure"], f"{what}, closure")
        ends = ["", ""]
        other = twin[swing.machine]
        if swing is not other:
            bound = SWING_BOUNDS[swing.route.split(", ")[1]]
            for k, (one, two) in enumerate(((swing.q, other.q), (swing.qd, other.qd))):
                apart = float(np.abs(one[-1] - two[-1]).max())
                ends[k] = judge(apart, bound, f"{what}, {('position', 'rate')[k]} at the end")
        travel = float(np.ptp(swing.q, axis=0).max())
        rows.append(
            f"| {TITLES[swing.machine]} | {swing.route} | {travel:.2f} | {swing.kinetic:.3f} "
            f"| {drift} | {closure} | {ends[0]} | {ends[1]} |"
        )
    table = "\n".join(rows)
    return f"""## Free swing of {DURATION:.0f} s

The robots are the shipped parameter files without friction. The actuators apply constant efforts
that balance the weight at a stable equilibrium. Both Deltas have arms at {DELTA_REST} rad and
start at rest {_list(DELTA_DEVIATION)} rad away from there. (Without efforts a Delta of these
dimensions swings about stretched limbs, and most starts reach the edge of its workspace.) The
sliders of the 3-PRRU are vertical, so without efforts it would fall. It hangs from its sliders
(`branch: above`) with a tool of {TOOL["mass"]:.0f} kg, {-TOOL["com"][2]} m below the platform,
which makes the tilt stable. It starts with slider rates of {_list(PRRU_RATES)} m/s; their mean is
zero because its height is free.

DOP853 integrates `forward_dynamics` of pkm_twin and of Pinocchio with tolerances of
{TOLERANCE:.0e}, Pinocchio's whole tree without closing the loops again. Pinocchio's own step is
RK4 at {1e3 * STEP:.0f} ms with the loops closed after each step. Energy: the Lagrange method's
function at {SAMPLES} instants minus the work of the constant efforts; its largest change, divided
by the largest kinetic energy. Closure: the limbs' lengths and planes between actuators and
platform; pkm_twin solves its loops for each state. Travel of one actuator, and differences from
pkm_twin at the end, in rad, rad/s (Delta) and m, m/s (3-PRRU). Bounds: energy
{SWING_BOUNDS["drift"]:.0e}, closure {SWING_BOUNDS["closure"]:.0e} m, end states
{SWING_BOUNDS["DOP853"]:.0e} with DOP853 and {SWING_BOUNDS["its own step"]:.0e} with the step.

| robot | engine | travel | kinetic energy, J | energy drift | closure, m \
| difference of q | of q' |
|---|---|---|---|---|---|---|---|
{table}
"""


def _compliance(links: dict[str, Links], judge: Judge) -> str:
    title = "## Platform compliance of the 2UPR-RPU"
    if not links:
        return f"{title}\n\nNot compared: {ABSENT}.\n"
    rows = []
    for name, found in links.items():
        z, beta, gamma = POSES[name]
        what = f"compliance, {name}"
        entries = judge(found.shipped.entries, BOUND, f"{what}, entries")
        diagonal = judge(_worst(found.shipped.diagonal), BOUND, f"{what}, diagonal")
        bent = judge(_worst(found.shipped.deflection), BOUND, f"{what}, deflection")
        refinement = judge(found.refinement.worst, BOUND / 4, f"{what}, refinement")
        rows.append(
            f"| {name} | {z:g}, {np.degrees(beta):.0f}, {np.degrees(gamma):.0f} "
            f"| {entries} | {diagonal} | {bent} | {found.cowper.worst:.1e} "
            f"| {_span(found.rigid_ends.diagonal)} | {refinement} |"
        )
    table = "\n".join(rows)
    robot = with_rigid_joints()
    spans = _span(np.concatenate([found.shipped.diagonal for found in links.values()]))
    return f"""{title}

The robot has the shipped parameters, locked drives, and joints that are rigid in all directions in
which they are not free. The CalculiX model has solid bricks for the three bars (C3D20R; {FINE} per
bar, section x length), no beam theory and no shear factor. Its joints constrain the mean
displacement and mean rotation of a bar's end section, which can warp and contract, by equations
between displacements; the platform is rigid.

Differences are relative: those of all 36 entries to sqrt(C_ii C_jj), those of the diagonal entries
each to its own value, and those of the six deflections under the load of the paper's table 1,
{_wrench(LOAD)} in N and N m, each to its own value, however small. The bound is {BOUND:.0e}, for
the mesh a quarter of it. Mesh: {MESH} bricks per bar compared with {FINE}.

| pose | z (m), beta, gamma (deg) | entries | diagonal | deflections | Cowper | rigid ends | mesh |
|---|---|---|---|---|---|---|---|
{table}

The diagonal of pkm_twin differs by {spans}; negative is stiffer. Its shear factor is
{robot.members.shear_factor:g}, as in the paper. *Cowper* is the worst difference of entries and
diagonal with {round_bar(robot):.3f}, the factor of a round bar (Cowper 1966). *Rigid ends* compares
the diagonal with solids whose end sections are rigid and therefore cannot contract.
"""


def _paper_rows(rows: PaperRows, links: dict[str, Links], judge: Judge) -> str:
    lines = []
    names = ("dx, µm", "dy, µm", "dz, µm", "rx, µrad", "ry, µrad", "rz, µrad")
    for k, name in enumerate(names):
        cells = []
        for c in range(2):
            theirs, ours = FINITE_ELEMENTS[c, k], rows.twin[c, k]
            excess = f"{100 * rows.excess[c, k]:+.1f} %" if RESOLVED[c, k] else "one digit"
            cells += [f"{ours:.3f}", f"{theirs:.3f}", excess]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    table = "\n".join(lines)
    known = rows.excess[RESOLVED]
    worst = judge(error(rows.twin), PAPER_BOUND, "table 1, finite elements")
    beams = ""
    if links:
        apart = max(_worst(found.shipped.diagonal) for found in links.values())
        beams = (
            "Beam theory does not explain it either: solid bars are within "
            f"{_percent(apart)} (above)."
        )
    # Where joints hardly matter.
    bent = (0, 5)
    joints = _worst(rows.rigid[:, bent] / rows.twin[:, bent] - 1)
    softer = _filled(f"""
        The finite elements are softer in {int((known > 0).sum())} of the {known.size} components
        that are printed with three digits, by {_span(known)}. The worst difference relative to the
        finite elements is {worst}; the paper states {PAPER_BOUND:g}.
    """)
    cause = _filled(f"""
        A common factor on the joints' printed compliances does not explain the difference: of all
        factors from {FACTORS[0]:g} to {FACTORS[-1]:g} the best one, {rows.joints[0]:.2f}, leaves
        {_percent(rows.joints[1])}. With rigid joints dx and rz of pkm_twin change by
        {_percent(joints)} or less, but the finite elements are softer by
        {_span(rows.excess[:, bent])}. {beams} A common factor on the compliance of all bars,
        {rows.bars[0]:.2f}, would leave {_percent(rows.bars[1])}. Possible causes are bars that are
        softer than round ones between the joints, single joints several times softer than printed,
        or an elastic platform. The paper shows neither mesh nor contacts, so the cause cannot be
        determined.
    """)
    return f"""## The paper's finite elements

Table 1 of the 2UPR-RPU paper compared with pkm_twin, with the shipped joint compliances. The
percentages are the relative differences of the paper's finite elements from pkm_twin.

| | pkm_twin, 1 | finite elements, 1 | difference | pkm_twin, 2 | finite elements, 2 | difference |
|---|---|---|---|---|---|---|
{table}

{softer}

{cause}
"""


def _filled(text: str) -> str:
    """One paragraph, in lines as long as the page's."""
    return textwrap.fill(" ".join(text.split()), 100)


def conclude(path: Path, text: str, failures: list[str], console: Console) -> int:
    """Write a certificate, say what exceeds its bounds: the exit code."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    console.print(f"{path} written")
    for line in failures:
        console.print(line, style="red")
    return 1 if failures else 0


def _percent(value: float) -> str:
    return f"{100 * value:.2g} %"


def _worst(values: np.ndarray) -> float:
    return float(np.abs(values).max())


def _span(values: np.ndarray) -> str:
    """Least and greatest in per cent."""
    return f"{100 * values.min():+.2f} to {100 * values.max():+.2f} %"


def _wrench(values: list[float]) -> str:
    return "(" + ", ".join(f"{v:g}" for v in values) + ")"


def _list(values: tuple[float, ...]) -> str:
    return ", ".join(str(v) for v in values[:-1]) + f" and {values[-1]}"
