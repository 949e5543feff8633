# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Panels that move the machine: a bag's timeline, a mode, and running nodes."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError, one_line
from pkm_twin.report import plots
from pkm_twin.view import texts
from pkm_twin.view.live import TOPICS, TRACE_SECONDS, TRACES, Live
from pkm_twin.view.model import MAX_SHOWN_DEFLECTION, State
from pkm_twin.view.page import Page
from pkm_twin.view.scene import Deflection
from pkm_twin.view.timeline import Timeline
from stiffness_monitor.modes import Modes, modes

MODE_COUNT: Final = 6
"""Number of natural modes to choose from."""
_MEASURED: Final = "measured"
"""Name of the measured curve, drawn wide so that the model's curve on it is visible."""


class BagPanel:
    """Replay a recording: a time slider, a play button, numbers at that time, and charts."""

    def __init__(self, page: Page, timeline: Timeline) -> None:
        self._page, self._timeline = page, timeline
        self._since: tuple[float, float] | None = None
        self._marked = -np.inf
        gui = page.server.gui
        with page.first:
            self._time = gui.add_slider("time, s", 0.0, max(timeline.end, 0.01), 0.001, 0.0)
            self._play = gui.add_button("Play")
            self._speed = gui.add_dropdown("speed factor", ("0.25", "0.5", "1", "2", "4"), initial_value="1")
            self._instant = gui.add_html("")
            names = page.model.robot.joint_names
            self._times, self._twin, self._measured = timeline.sample_curves()
            self._charts: list[tuple[Any, Array]] = []
            if len(self._times) > 1:
                self._joint = gui.add_dropdown("joint", names, initial_value=names[0])
                page.call_on(self._joint.on_update, "joint", self._draw_joint)
                efforts = {_MEASURED: "#999999", "model": plots.COLOURS[1]}
                if self._measured is None:
                    del efforts[_MEASURED]
                self._add_chart("effort of the joint", self._select_efforts(), efforts)
                if self._measured is not None:
                    self._add_chart(
                        "residual: measured minus model", self._measured - self._twin, _assign_colours(names)
                    )
        page.call_on(self._time.on_update, "time", self._show_time)
        page.call_on(self._play.on_click, "play", self._play_or_pause)
        page.call_on(self._speed.on_update, "speed", self._restart_playing)
        page.moving.append(self)
        self._show_time()

    def _add_chart(self, title: str, values: Array, colours: dict[str, str]) -> None:
        chart = _create_chart(self._page, title, self._times, values, colours, mark=True)
        self._charts.append((chart, values))

    def _select_efforts(self) -> Array:
        """Return the chosen joint's measured efforts, if any, and the model's, (j, k)."""
        k = self._page.model.robot.joint_names.index(self._joint.value)
        both = (self._measured, self._twin)
        return np.column_stack([values[:, k] for values in both if values is not None])

    def _draw_joint(self) -> None:
        chart, _ = self._charts[0]
        values = self._select_efforts()
        self._charts[0] = chart, values
        chart.data = (self._times, *map(np.ascontiguousarray, values.T), self._mark_time(values))

    def _mark_time(self, values: Array) -> Array:
        return _draw_time_mark(self._times, values, self._time.value)

    @property
    def busy(self) -> bool:
        """True while the recording plays."""
        return self._since is not None

    def show_time(self, at: float) -> None:
        """Set the slider to a time, s, and show it."""
        self._time.value = min(max(at, 0.0), self._timeline.end)
        self._show_time()

    def _show_time(self) -> None:
        self._restart_playing()
        page, at = self._page, self._timeline.sample_at(self._time.value)
        state = page.state
        if at.wrench is not None:
            state = page.model.apply_wrench(state, at.wrench)
        state = page.model.to_joints(state, at.q)
        self._instant.content = texts.describe_instant(page.model.robot, self._timeline, at)
        page.show_state(state)
        if not self.busy or time.monotonic() - self._marked > 0.25:
            self._marked = time.monotonic()
            for chart, values in self._charts:
                chart.data = (*chart.data[:-1], self._mark_time(values))

    def _play_or_pause(self) -> None:
        if self.busy:
            self._since = None
        else:
            if self._time.value >= self._timeline.end:
                self._time.value = 0.0
            self._since = time.monotonic(), self._time.value
        self._play.label = "Pause" if self.busy else "Play"

    def _restart_playing(self) -> None:
        if self.busy:
            self._since = time.monotonic(), self._time.value

    def step(self) -> None:
        """Advance the slider to the present playing time."""
        if self._since is None:
            return
        began, start = self._since
        now = start + (time.monotonic() - began) * float(self._speed.value)
        self._time.value = min(now, self._timeline.end)
        if now >= self._timeline.end:
            self._since = None
            self._play.label = "Play"
        self._show_time()


class ModePanel:
    """Animate a natural mode of the present pose as a slow vibration."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._modes: Modes | None = None
        self._state: State | None = None
        gui = page.server.gui
        with page.load_tab:
            choices = ("none", *map(str, range(1, MODE_COUNT + 1)))
            self._choice = gui.add_dropdown("animated mode", choices, initial_value=choices[0])
            self._note = gui.add_html("")
        page.call_on(self._choice.on_update, "mode", self._on_choice)
        page.moving.append(self)

    @property
    def busy(self) -> bool:
        """True if a mode is chosen."""
        return bool(self._choice.value != "none")

    def _on_choice(self) -> None:
        self._state = None
        if not self.busy:
            self._note.content = ""
            self._page.show_state(self._page.state)

    def _compute_modes(self, state: State) -> None:
        self._state, self._modes = state, None
        k = int(self._choice.value) - 1
        try:
            self._modes = modes(self._page.model.robot, state.pose, MODE_COUNT)
        except (PkmTwinError, ValueError) as error:
            self._note.content = texts.format_note(one_line(str(error)))
            return
        shape, names = self._modes.shapes[k], self._modes.nodes
        sizes = np.linalg.norm(shape[:, :3], axis=1)
        text = f"{texts.format_number(float(self._modes.frequencies[k]))} Hz, drives locked"
        if sizes[0] < 0.1 * sizes.max():
            text += f"; {names[int(sizes.argmax())]} moves most, the platform hardly"
        self._note.content = texts.format_note(text)
        part = MAX_SHOWN_DEFLECTION / 3 * self._page.model.robot.graph.size / sizes.max()
        # Node names are a member's name and a number.
        owners = [name.rpartition(" ")[0] for name in names[1:]]
        at, moved = self._modes.positions[1:], shape[1:, :3]
        rows = {name: np.array([owner == name for owner in owners]) for name in owners}
        members = {name: (at[own], moved[own]) for name, own in rows.items()}
        self._shape = Deflection(shape[0], members).times(part)
        strain = self._modes.energies.strain[k].tolist()
        self._shares = dict(zip(self._modes.energies.elements, strain, strict=True))

    def step(self) -> None:
        """Draw the mode at the present phase of the vibration."""
        state = self._page.state
        if self._state is None or not np.array_equal(self._state.pose, state.pose):
            self._compute_modes(state)
        if self._modes is not None:
            swing = float(np.sin(2 * np.pi * time.monotonic() / 1.5))
            most = max(self._shares, key=lambda name: self._shares[name])
            self._page.stage.draw(state.q, self._shape.times(swing), self._shares, most)


class LivePanel:
    """Show running nodes: the machine follows their joint states; charts have the torques."""

    busy = True

    def __init__(self, page: Page, live: Live) -> None:
        self._page, self._live = page, live
        self._seen: tuple[dict[str, int], int] | None = None
        gui = page.server.gui
        with page.first:
            self._heard = gui.add_html("")
            joints = _assign_colours(page.model.robot.joint_names)
            nothing = np.zeros((2, len(joints)))
            self._charts = {
                name: _create_chart(
                    page, f"{name}, the last {TRACE_SECONDS:g} s", np.array([-TRACE_SECONDS, 0.0]), nothing, joints
                )
                for name in TRACES
            }
        page.moving.append(self)

    def step(self) -> None:
        """Show the latest messages."""
        page, heard = self._page, self._live.read_latest()
        counts = (heard.counts, heard.rejected)
        if counts == self._seen:
            return
        self._seen = counts
        waiting = ", ".join(TOPICS[name][1] for name in TOPICS if not heard.counts.get(name))
        self._heard.content = texts.describe_live_values(page.model.robot, heard, waiting)
        for name, (times, values) in heard.traces.items():
            if len(times) > 1:
                self._charts[name].data = (times, *map(np.ascontiguousarray, values.T))
        if heard.q is None:
            return
        page.show_state(page.model.to_joints(page.state, heard.q))
        # A wrench of the sliders has priority over the measured one.
        if heard.shares and heard.deflection is not None and not page.state.wrench.any():
            rotation = page.model.robot.platform(page.state.q)[1]
            moved = np.concatenate([rotation @ part for part in np.split(heard.deflection, 2)])
            page.draw_deflected(moved, heard.shares, heard.dominant)


def _assign_colours(names: Sequence[str]) -> dict[str, str]:
    return {name: plots.COLOURS[k % 6] for k, name in enumerate(names)}


def _create_chart(
    page: Page, title: str, times: Array, values: Array, colours: Mapping[str, str], *, mark: bool = False
) -> Any:
    """Create a chart of named curves, values (k, n); with ``mark`` also of the present time."""
    from viser import uplot

    points = uplot.Series_Points(show=False)
    series = [uplot.Series(label="t, s")]
    series += [
        uplot.Series(label=name, stroke=colour, width=4.0 if name == _MEASURED else 1.5, points=points)
        for name, colour in colours.items()
    ]
    curves = list(map(np.ascontiguousarray, values.T))
    if mark:
        series.append(uplot.Series(label="now", stroke="#555555", width=1, points=points))
        curves.append(_draw_time_mark(times, values, 0.0))
    return page.server.gui.add_uplot(
        (times, *curves),
        tuple(series),
        title=f"{title}, {page.model.robot.effort_unit}",
        scales={"x": uplot.Scale(time=False)},
        height=185,
    )


def _draw_time_mark(times: Array, values: Array, now: float) -> Array:
    """Return a curve with a peak at the present time, as charts cannot draw vertical lines."""
    result = np.full(len(times), float(values.min()))
    result[int(np.argmin(np.abs(times - now)))] = float(values.max())
    return result
