# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The page's numbers as HTML: every number has an id, a unit and, where it is judged, a colour."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Final

import numpy as np

from pkm_twin.robot.robot import Robot
from pkm_twin.view.live import LiveValues
from pkm_twin.view.model import Grade, Model, State, StateQuantities
from pkm_twin.view.scene import colour_by_share
from pkm_twin.view.timeline import Instant, Timeline

GRADES: Final[Mapping[Grade, str]] = {"good": "#009E73", "warn": "#B87800", "bad": "#D55E00"}
"""Colours of Okabe and Ito; the middle one is darkened for contrast on white."""
MAX_LISTED_ELEMENTS: Final = 8
"""Largest number of listed elements; the shares of the others are summed."""
STYLE_AND_LINK_SCRIPT: Final = """<style>
.mantine-Slider-markLabel { font-size: 0.7rem !important; color: #343a40 !important; }
.mantine-Flex-root > .mantine-NumberInput-root { width: 4.4rem !important; }
@media (max-width: 36em) {
  div:has(> div canvas[data-engine]):has(+ .mantine-Paper-root) { height: 45% !important; }
  .mantine-Paper-root:has([role=tab]) { width: 100% !important; max-height: 55% !important; }
  .mantine-Paper-root:has([role=tab]) > *,
  .mantine-Paper-root:has([role=tab]) .mantine-ScrollArea-content > * { width: 100% !important; }
}
</style>
<img hidden src="data:," onerror="
  const link = location.search, tries = setInterval(() => {
    const label = [...document.querySelectorAll('label')].find(l => l.innerText === 'link');
    const input = label && label.closest('.mantine-Flex-root').querySelector('input');
    const asked = link.includes('robot=');
    if (asked && !input) return;
    clearInterval(tries);
    if (!asked) return;
    history.replaceState(null, '', location.pathname);
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set.call(input, link);
    input.dispatchEvent(new Event('input', {bubbles: true}));
  }, 100)">"""
"""A query in the address is copied once into the field ``link``.

In a narrow window the browser shows the sliders as a sheet at the bottom: it is as wide as the
window, and the scene ends above it."""

_BUTTON_STYLE: Final = (
    "font:inherit;color:#fff;background:rgb(0,114,178);border:0;border-radius:4px;"
    "padding:0.3em 0.8em;margin-right:0.5em;cursor:pointer"
)
_COPY_LINK_SCRIPT: Final = """
const label = [...document.querySelectorAll('label')].find(l => l.innerText === 'link');
const input = label.closest('.mantine-Flex-root').querySelector('input'), button = this;
const whole = location.origin + location.pathname + input.value;
const done = () => { button.innerText = 'Copied'; setTimeout(() => {
  button.innerText = 'Copy link' }, 1500) };
const plainly = () => {
  const text = document.createElement('textarea');
  text.value = whole; document.body.append(text); text.select();
  document.execCommand('copy'); text.remove(); done() };
if (navigator.clipboard) navigator.clipboard.writeText(whole).then(done, plainly);
else plainly()"""
# Setting the canvas size clears it until the next frame, so wait for a frame with content.
_SAVE_PICTURE_SCRIPT: Final = """
const scene = document.querySelector('canvas[data-engine]'), sheet = scene.cloneNode();
const pen = sheet.getContext('2d'), link = document.createElement('a');
const take = left => requestAnimationFrame(() => {
  sheet.width = scene.width; sheet.height = scene.height;
  pen.fillStyle = '#fff'; pen.fillRect(0, 0, sheet.width, sheet.height);
  pen.drawImage(scene, 0, 0);
  const empty = pen.getImageData(0, 0, sheet.width, sheet.height).data.every(c => c === 255);
  if (empty && left) return take(left - 1);
  link.href = sheet.toDataURL('image/png'); link.download = this.dataset.name; link.click() });
take(200)"""
_BLOCK_STYLE: Final = "font-size:0.82em;line-height:1.5;padding:0.15em 0.9em 0.4em"


def format_number(value: float) -> str:
    """Format a number with four digits; rounding errors of zero are shown as 0."""
    return f"{value:.4g}" if abs(value) > 1e-12 else "0"


def write_buttons(name: str) -> str:
    """Write buttons that the browser handles itself: copy the link, save the scene as a PNG."""
    return (
        f'<div style="{_BLOCK_STYLE}">'
        f'<button id="copy" style="{_BUTTON_STYLE}" onclick="{escape(_COPY_LINK_SCRIPT)}">Copy link</button>'
        f'<button id="save" style="{_BUTTON_STYLE}" data-name="{escape(name)}.png" '
        f'onclick="{escape(_SAVE_PICTURE_SCRIPT)}">Save picture</button></div>'
    )


def format_note(text: str) -> str:
    """Return text as one escaped line of the panel's HTML."""
    return f'<div id="note" style="{_BLOCK_STYLE}">{escape(text)}</div>'


def describe_state(model: Model, state: State, numbers: StateQuantities) -> str:
    """Describe singularity index, clearance, joints with their efforts at rest, and why a state is rejected."""
    gap = None if numbers.clearance is None else 1e3 * numbers.clearance
    rows = [
        _write_judged_row(
            "singularity", "singularity index", numbers.singularity, "", numbers.singularity_grade, "1 best, 0 singular"
        ),
        _write_judged_row(
            "clearance", "clearance between limbs", gap, "mm", numbers.clearance_grade, numbers.why.get("clearance", "")
        ),
    ]
    said = (
        f'<div id="refusal" style="color:#fff;background:{GRADES["bad"]};border-radius:4px;'
        f'padding:0.2em 0.6em;margin:0.3em 0">{escape(state.rejection)}</div>'
        if state.rejection
        else '<div id="refusal"></div>'
    )
    robot = model.robot
    effort: Sequence[float | None] = [None] * len(state.q) if numbers.effort is None else numbers.effort.tolist()
    joints = [_write_head("joint", "position", "effort at rest")]
    units = zip(robot.joint_names, robot.joint_units, robot.effort_units, strict=True)
    for k, (name, unit, effort_unit) in enumerate(units):
        colour = GRADES["bad"] if name in numbers.beyond_effort else "inherit"
        joints.append(
            _write_row(
                escape(name),
                _write_value(f"q_{k}", float(state.q[k]), unit),
                _write_value(f"effort_{k}", effort[k], effort_unit, colour),
            )
        )
    why = f"<div>efforts: {escape(numbers.why['effort'])}</div>" if numbers.why.get("effort") else ""
    return f'<div style="{_BLOCK_STYLE}">{_write_table(rows)}{said}{_write_table(joints)}{why}</div>'


def describe_load(numbers: StateQuantities) -> str:
    """Describe the platform's deflection, and the elements by their share of the strain energy."""
    energy = numbers.energy
    if energy is None:
        why = numbers.why.get("energy", "")
        return f'<div style="{_BLOCK_STYLE}">no elasticity: {escape(why)}</div>'
    rows = [_write_head("deflection", "along", "about")]
    moved = 1e6 * np.asarray(energy.deflection)
    for k, axis in enumerate("xyz"):
        rows.append(
            _write_row(
                axis,
                _write_value(f"deflection_{k}", float(moved[k]), "µm"),
                _write_value(f"deflection_{k + 3}", float(moved[k + 3]), "µrad"),
            )
        )
    tie = " (tie)" if energy.tie else ""
    shares = dict(zip(energy.elements, np.asarray(energy.factors).tolist(), strict=True))
    total = _write_row("strain energy", _write_value("energy", float(energy.total), "J"))
    return (
        f'<div style="{_BLOCK_STYLE}">{_write_table(rows)}{_write_table([total])}'
        f'<div>dominant element <b id="dominant">{escape(str(energy.dominant))}</b>{tie}</div>'
        f"{draw_share_bars(shares)}</div>"
    )


def draw_share_bars(shares: Mapping[str, float]) -> str:
    """Draw bars of the elements' shares, the largest first, in the colours of the scene."""
    colours = colour_by_share(shares)
    order = sorted(colours, key=lambda name: -shares[name])
    rows = []
    for k, name in enumerate(order[:MAX_LISTED_ELEMENTS]):
        part = 100 * shares[name]
        width = 100 * shares[name] / shares[order[0]]
        bar = f'<div style="height:0.75em;width:{width:.1f}%;border-radius:2px;background:rgb{colours[name]}"></div>'
        cells = (
            f'<td style="white-space:nowrap">{escape(name)}</td>'
            f'<td style="width:55%;padding:0 0.5em">{bar}</td>'
            f'<td style="text-align:right"><span id="share_{k}">{part:.1f}</span>&nbsp;%</td>'
        )
        rows.append(f"<tr>{cells}</tr>")
    rest = 100 * sum(shares[name] for name in order[MAX_LISTED_ELEMENTS:])
    others = len(order) - MAX_LISTED_ELEMENTS
    more = f"<div>{others} others: {rest:.1f} %</div>" if others > 0 else ""
    return _write_table(rows) + more


def describe_instant(robot: Robot, timeline: Timeline, at: Instant) -> str:
    """Describe the bag at one time: each joint's measured effort, the twin's, and the residual."""
    rows = [_write_head("joint", "measured", "model", "residual")]
    columns = (("measured", at.measured), ("twin", at.twin), ("residual", at.residual))
    for k, name in enumerate(robot.joint_names):
        unit = robot.effort_units[k]
        cells = [_write_value(f"bag_{what}_{k}", None if v is None else float(v[k]), unit) for what, v in columns]
        rows.append(_write_row(escape(name), *cells))
    why = f"<div>no torques: {escape(timeline.why)}</div>" if timeline.why else ""
    time = _write_row("time", _write_value("bag_time", at.time, "s"))
    return f'<div style="{_BLOCK_STYLE}">{_write_table([time])}{_write_table(rows)}{why}</div>'


def describe_live_values(robot: Robot, live: LiveValues, waiting: str) -> str:
    """Describe the messages of running nodes: efforts, residuals, dominant element, rejections."""
    rows = [_write_head("joint", "torque", "residual")]
    for k, name in enumerate(robot.joint_names):
        cells = []
        for what in ("torque", "residual"):
            trace = live.traces.get(what)
            value = None if trace is None else float(trace[1][-1, k])
            cells.append(_write_value(f"live_{what}_{k}", value, robot.effort_units[k]))
        rows.append(_write_row(escape(name), *cells))
    text = ""
    if waiting:
        text += f'<div id="waiting">waiting for {escape(waiting)}</div>'
    if live.rejected:
        text += (
            f'<div style="color:{GRADES["bad"]}">{live.rejected} messages rejected, the last: '
            f"{escape(live.reason)}</div>"
        )
    if live.dominant:
        text += f'<div>dominant element <b id="live_dominant">{escape(live.dominant)}</b></div>'
    return f'<div style="{_BLOCK_STYLE}">{_write_table(rows)}{text}{draw_share_bars(live.shares)}</div>'


def _write_judged_row(key: str, what: str, value: float | None, unit: str, grade: Grade, hint: str) -> str:
    # Words besides the colour, for colour-blind readers.
    words, colour = {"good": "", "warn": " low", "bad": " too low"}[grade], GRADES[grade]
    if value is None:
        words, colour = " unknown", "inherit"
    cell = _write_value(key, value, unit, colour, bold=True)
    note = f'<span style="color:{colour}">{words}</span>' if words else ""
    return _write_row(f'<span title="{escape(hint)}">{what}</span>', cell + note)


def _write_value(key: str, value: float | None, unit: str, colour: str = "inherit", bold: bool = False) -> str:
    if value is None:
        return f'<span id="{key}">{"&ndash;"}</span>'
    weight = ";font-weight:700" if bold else ""
    shown = f'<span id="{key}" style="color:{colour}{weight}">{format_number(value)}</span>'
    return f"{shown}&nbsp;{escape(unit)}" if unit else shown


def _write_row(first: str, *cells: str) -> str:
    rest = "".join(f'<td style="text-align:right">{cell}</td>' for cell in cells)
    return f'<tr><td style="padding-right:0.5em">{first}</td>{rest}</tr>'


def _write_head(first: str, *cells: str) -> str:
    style = "font-weight:500;opacity:0.65"
    rest = "".join(f'<th style="text-align:right;{style}">{cell}</th>' for cell in cells)
    return f'<tr><th style="text-align:left;{style}">{first}</th>{rest}</tr>'


def _write_table(rows: Iterable[str]) -> str:
    return (
        f'<table style="width:100%;border-collapse:collapse;font-variant-numeric:tabular-nums">{"".join(rows)}</table>'
    )
