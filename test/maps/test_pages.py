# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Pages in a real browser: the numbers under the cursor are the file's at the place they say."""

from __future__ import annotations

import functools
import re

import numpy as np
import pytest

from pkm_twin.maps.page import write_page
from pkm_twin.maps.store import open_map
from test.maps.browser import Browser, find_browser
from test.support.robots import partly_long

pytest.importorskip("plotly")
pytest.importorskip("tornado")

POINTS = partly_long([4, 8], 4)
"""Places that the mouse is put to for each entry of a page's menu."""
LONG = functools.partial(pytest.param, marks=pytest.mark.long)
"""Robots whose pages are of the same kind as those of the default run."""
LISTEN = """
window.gd = document.querySelector('.js-plotly-plot');
window.under = null;
gd.on('plotly_hover', event => { window.under = event.points[0]; });
gd.on('plotly_unhover', () => { window.under = null; });
// Where a point of a trace stands on the screen.
window.place = (trace, at) => {
  const scene = gd._fullLayout[trace.scene]._scene, camera = scene.glplot.cameraParams;
  const times = (m, v) => [0, 1, 2, 3].map(
    i => m[i] * v[0] + m[4 + i] * v[1] + m[8 + i] * v[2] + m[12 + i] * v[3]);
  const v = at.map((value, k) => value * scene.dataScale[k]).concat(1);
  const p = times(camera.projection, times(camera.view, times(camera.model, v)));
  const box = scene.glplot.canvas.getBoundingClientRect();
  return [box.left + (0.5 + 0.5 * p[0] / p[3]) * box.width,
          box.top + (0.5 - 0.5 * p[1] / p[3]) * box.height];
};
// What is under the mouse is looked up, and its label drawn, within some pictures.
window.soon = read => new Promise(found => {
  let left = 5;
  const look = () => {
    const label = read();
    if (label || --left === 0) found(label); else requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
});
// Points of the traces that have labels, spread over all of them.
window.known = count => {
  const traces = gd._fullData.filter(
    trace => trace.hoverinfo !== 'skip' && trace.x && trace.x.length);
  return [...Array(count).keys()].map(k => {
    const trace = traces[Math.floor(k * traces.length / count)];
    const n = Math.floor(trace.x.length * ((k * 0.381966 + 0.2) % 1));
    return window.place(trace, [trace.x[n], trace.y[n], trace.z[n]]);
  });
};
"""
READ = """(() => {
  const label = document.querySelector('.hovertext');
  if (!window.under || !label) return null;
  const spans = [...label.querySelectorAll('tspan')].map(span => span.textContent);
  const point = window.under;
  const [x, y] = window.place(point.fullData, [point.x, point.y, point.z]);
  return {lines: spans.length ? spans : [label.textContent],
          off: Math.hypot(x - window.mouse[0], y - window.mouse[1])};
})()"""


@pytest.fixture(params=POINTS)
def points(request):
    return request.param


@pytest.fixture(scope="module")
def browser():
    program = find_browser()
    if program is None:
        pytest.skip("no chromium or chrome on this machine; apt-get install chromium brings one")
    with Browser(program, scale=0.5) as made:
        yield made


def show(browser, stored, folder):
    browser.open(write_page(stored, folder / "page.html"))
    browser.until("!!(document.querySelector('.js-plotly-plot') || {})._fullLayout")
    browser.run(LISTEN)
    browser.run("gd.scrollIntoView()")


def choose(browser, number):
    """Do what an entry of the page's menu does."""
    browser.run(
        "(() => { const [data, layout, traces] = "
        f"gd.layout.updatemenus[0].buttons[{number}].args; "
        "return Plotly.update(gd, data, layout, traces).then(() => null); })()"
    )


def labels(browser, points):
    """Lines of the labels at known points, or at what stands before them.

    The points that labels tell of are under the mouse, but for some pixels between points.
    """
    found = []
    for x, y in browser.run(f"window.known({points})"):
        browser.run(f"window.under = null; window.mouse = [{x}, {y}]")
        # From beside it: a place that the mouse is at already tells nothing new.
        browser.move(x - 3, y)
        browser.move(x, y)
        label = browser.run(f"window.soon(() => {READ})")
        if label:
            found.append(label)
    assert len(found) >= points // 2, found
    assert np.median([label["off"] for label in found]) < 20, found
    return [label["lines"] for label in found]


def number(line):
    """Name, number and unit of a line like "gamma -0.0785 rad"."""
    match = re.fullmatch(r"(.*) ([-−]?[\d.]+(?:e[-+−]?\d+)?(?:[kmµnp]?)) ?(.*)", line.strip())
    assert match, line
    name, text, unit = match.groups()
    return name, float(text.replace("−", "-")), unit


@pytest.mark.parametrize("robot", ["delta_cu", LONG("prru"), LONG("upr_rpu")])
def test_layers(browser, points, robot, small_maps, tmp_path):
    with open_map(small_maps[f"workspace {robot}"]) as data:
        show(browser, data, tmp_path)
        for entry, case in enumerate(data.case.values):
            choose(browser, entry)
            for *place, value in labels(browser, points):
                if value.startswith("worst"):
                    continue
                where = {}
                for name, shown in (line.split(") ") for line in place):
                    name, unit = name.split(" (")
                    assert unit == data.unit.sel(coordinate=name)
                    where[name] = float(shown.replace("−", "-"))
                point = data.sel(where, method="nearest").sel(case=case)
                for name, shown in where.items():
                    assert float(point[name]) == pytest.approx(shown, abs=1e-4)
                scale = {"mm": 1e3}.get(number(value)[2], 1.0)
                stored = scale * float(point.value)
                assert number(value)[1] == pytest.approx(stored, rel=1e-3, abs=1e-4)


FITTED = """(() => {
  const texts = '.gtitle, .annotation-text, .cbtitle, .updatemenu-header, .updatemenu-button, '
    + '.xtitle, .ytitle, .legendtext';
  const seen = [...gd.querySelectorAll(texts)].map(e => [e, e.getBoundingClientRect()]);
  const boxes = seen.filter(([, box]) => box.width).map(([e, box]) => ({
    name: e.getAttribute('class') + ' ' + e.textContent, left: box.left, right: box.right,
    top: box.top, bottom: box.bottom}));
  const e = document.documentElement;
  return {boxes, wide: e.scrollWidth - e.clientWidth};
})()"""
SETTLED = """new Promise(found => {
  let last = null, same = 0;
  const look = () => {
    const now = JSON.stringify(gd.layout) + gd.clientWidth;
    same = now === last ? same + 1 : 0; last = now;
    if (same > 5) found(true); else setTimeout(look, 100);
  };
  look();
})"""


@pytest.mark.parametrize(
    "stored",
    [
        "workspace delta_cu",
        "payload stewart",
        LONG("modes upr_rpu"),
        LONG("isotropy prru"),
        LONG("acceleration five_bar"),
        LONG("strain-energy upr_rpu"),
    ],
)
def test_a_page_fits_into_its_window(browser, stored, small_maps, tmp_path):
    """No sideways scrolling, no text beyond the edges, and none over another."""
    with open_map(small_maps[stored]) as data:
        browser.resize(1400, 900)
        show(browser, data, tmp_path)
    entries = browser.run("gd.layout.updatemenus[0].buttons.length")
    for width in (1400, 1000, 500):
        browser.resize(width, 900)
        for entry in (0, entries - 1):
            choose(browser, entry)
            assert browser.run(SETTLED)
            found = browser.run(FITTED)
            assert found["wide"] <= 0, (width, found)
            boxes = found["boxes"]
            assert len(boxes) >= 2
            for box in boxes:
                assert box["left"] >= -1 and box["right"] <= width + 1, (width, box)
            for k, one in enumerate(boxes):
                for other in boxes[:k]:
                    across = min(one["right"], other["right"]) - max(one["left"], other["left"])
                    along = min(one["bottom"], other["bottom"]) - max(one["top"], other["top"])
                    assert min(across, along) <= 2, (width, one, other)
