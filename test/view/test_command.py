# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin view`` as a process, and in a real browser without a window."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from urllib.parse import urlsplit

import numpy as np
import pytest

from pkm_twin.robot.limits import beyond_limits
from pkm_twin.view.scene import project_points
from pkm_twin.view.texts import format_number
from stiffness_monitor import strain_energy
from test.commands.conftest import DELTA, REPOSITORY
from test.maps.browser import Browser, find_browser
from test.nodes.harness import end_with_parent
from test.support.robots import load, partly_long
from test.support.waiting import wait_until

needs_viser = pytest.mark.usefixtures("viser")


@pytest.fixture
def viser():
    return pytest.importorskip("viser", reason="viser is not installed: the extra view")


@pytest.mark.parametrize(
    ("options", "told", "code"),
    [
        (("--port", "70000"), "65535", 2),
        (("--bag", "nothing.mcap", "--port", "0"), "nothing.mcap", 1),
    ],
)
@needs_viser
def test_what_cannot_be_served_is_one_line(twin, options, told, code):
    assert told in twin.refused("view", "delta_cu", *options, code=code)


@needs_viser
def test_a_port_in_use_is_told(twin):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        told = twin.refused("view", "delta_cu", "--port", port)
        assert f"127.0.0.1 port {port}: it is in use; choose another --port" in told


@pytest.mark.parametrize(
    "options",
    [
        ("--bag", str(DELTA), "--live"),
        ("--namespace", "cell"),
        ("--payload", "0.2"),
        ("--topic", "/joint_states"),
    ],
)
def test_options_that_need_another_are_usage(twin, options):
    assert twin.good("view", "delta_cu", *options, code=2).out == ""


def test_without_viser_the_line_says_what_brings_it(twin, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "viser is not installed; pip install '.[view]'" in twin.refused("view", "delta_cu")


@contextlib.contextmanager
def run_server(*arguments):
    """A running command and the address that it prints."""
    running = subprocess.Popen(
        [sys.executable, "-m", "pkm_twin.apps.cli", "view", *map(str, arguments), "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "PYTHONUNBUFFERED": "1"},
        preexec_fn=end_with_parent,
    )
    try:
        line = running.stdout.readline()
        found = re.search(r"http://\S+", line)
        assert found, f"{line}{running.stderr.read()}"
        yield running, found.group()
    finally:
        if running.poll() is None:
            running.kill()
        running.communicate()


@pytest.mark.parametrize("number", partly_long([signal.SIGINT, signal.SIGTERM], signal.SIGTERM))
@needs_viser
def test_a_signal_ends_it_quietly(number):
    with run_server("five_bar") as (running, _):
        running.send_signal(number)
        out, err = running.communicate()
        assert (running.returncode, out, err) == (130, "", "")


@pytest.fixture(scope="module")
def browser():
    pytest.importorskip("tornado")
    pytest.importorskip("viser")
    program = find_browser()
    if program is None:
        pytest.skip("no browser: set PKM_TWIN_BROWSER to a Chromium")
    with Browser(program, (1000, 700), 0.5) as browser:
        browser.slow_down(1.0)
        browser.call("Network.enable")
        yield browser


SLIDER = "(document.querySelectorAll('[role=slider]')[%d] || document.body)"
VALUE = SLIDER + ".getAttribute('aria-valuenow')"
TEXT = "(document.getElementById('%s') || {}).innerText"
TAB = "[...document.querySelectorAll('[role=tab]')].find(t => t.innerText === 'Move').focus()"


def moved(browser, slider, key):
    """Press a key on a slider: its value then."""
    value = VALUE % slider
    before = browser.run(value)
    browser.run(f"{SLIDER % slider}.focus()")
    browser.press(key)
    return float(browser.until(f"{value} !== '{before}' && {value}"))


def read(browser, key):
    return browser.run(TEXT % key)


def addresses(browser):
    """Hosts that the page asked, by its scripts and workers too."""
    asked = [
        event["params"].get("request", event["params"]).get("url", "")
        for event in browser.events
        if event["method"] in ("Network.requestWillBeSent", "Network.webSocketCreated")
    ]
    return {urlsplit(url).hostname for url in asked if not url.startswith(("data:", "blob:"))}


@pytest.mark.timeout(1800)  # without a graphics card, on a machine that has much else to do
def test_a_slider_moves_the_machine_and_the_numbers_are_the_cores(browser):
    robot = load("delta_cu")
    with run_server("delta_cu") as (_, address):
        browser.visit(address)
        browser.until(f"{TEXT % 'q_0'} === '{format_number(0.2)}'")
        assert float(browser.run(VALUE % 0)) == 0.2
        q = robot.inverse(robot.home())
        q[0] = moved(browser, 0, "ArrowRight")
        browser.until(f"{TEXT % 'q_0'} === '{format_number(q[0])}'")
        pose = robot.forward(q)
        assert read(browser, "singularity") == format_number(float(robot.singularity(q)))
        # The pose's sliders have followed, to a slider's step.
        shown = [float(browser.run(VALUE % k)) for k in (3, 4, 5)]
        np.testing.assert_allclose(shown, pose, atol=1e-3)
        # And the other way round.
        pose[2] = moved(browser, 5, "ArrowLeft")
        q = robot.inverse(pose)
        browser.until(f"{TEXT % 'q_1'} === '{format_number(q[1])}'")
        assert read(browser, "q_0") == format_number(q[0])
        # An end of the range that cannot be: words, and the machine stays.
        moved(browser, 5, "Home")
        browser.until(f"({TEXT % 'refusal'}).length > 10")
        assert "limits" in read(browser, "refusal") or "unreachable" in read(browser, "refusal")
        assert read(browser, "q_0") == format_number(q[0])
        # A force of one step, and what it does.
        browser.run(TAB)
        browser.press("ArrowRight")
        # A tab that was seen stays where it is: its six sliders come first.
        browser.until(f"{VALUE % 6} === '0'")
        wrench = np.zeros(6)
        wrench[0] = moved(browser, 6, "ArrowRight")
        energy = strain_energy(robot, pose, wrench)
        browser.until(f"{TEXT % 'dominant'} === '{energy.dominant}'")
        assert read(browser, "deflection_0") == format_number(1e6 * energy.deflection[0])
        assert read(browser, "energy") == format_number(float(energy.total))
        assert addresses(browser) == {"127.0.0.1"}
        assert colours(browser.picture()) > 200


ROOM = """(() => {
  const wide = document.documentElement, scene = document.querySelector('canvas[data-engine]');
  const inputs = [...document.querySelectorAll('input')].map(e => e.getBoundingClientRect());
  const seen = inputs.filter(box => box.width), box = scene.getBoundingClientRect();
  const shared = (a, b) => Math.min(a.right, b.right) > Math.max(a.left, b.left) + 1
    && Math.min(a.bottom, b.bottom) > Math.max(a.top, b.top) + 1;
  return {wide: wide.scrollWidth - wide.clientWidth, width: box.width, height: box.height,
          right: Math.max(...seen.map(box => box.right)),
          covered: seen.filter(b => b.top < innerHeight && shared(box, b)).length};
})()"""


def assert_fits(browser):
    """No sideways scrolling, and a scene of some size that no slider covers."""
    for width in (500, 1000, 1400):
        browser.resize(width, 900)
        fits = f"{ROOM}.width > 300 && {ROOM}.height > 300 && {ROOM}.covered === 0"
        browser.until(f"document.querySelector('canvas[data-engine]') && {fits}")
        room = browser.run(ROOM)
        assert room["wide"] <= 0
        assert room["right"] <= width
    browser.call("Emulation.clearDeviceMetricsOverride")


CLICK = "[...document.querySelectorAll('button')].find(e => e.innerText === '%s').click()"
LINK = "[...document.querySelectorAll('input')].find(e => e.value.startsWith('?robot='))"


def clicked(browser, text):
    browser.run(CLICK % text)


def checked(browser, label):
    """Tick a box by its label."""
    browser.run(
        f"[...document.querySelectorAll('label')].find(l => l.innerText === '{label}')"
        ".closest('.mantine-Flex-root').querySelector('input[type=checkbox]').click()"
    )


@pytest.mark.timeout(1800)
def test_every_control_does_what_it_says(browser, tmp_path):
    """A link leads to its pose and load, once; the picture is saved; all else moves the machine.

    It fits into a narrow window when it is opened, and into wider ones.
    """
    robot = load("five_bar")
    pose = robot.home() + np.array([0.02, -0.01])
    browser.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    browser.call("Browser.grantPermissions", permissions=["clipboardReadWrite", "clipboardSanitizedWrite"])
    with run_server("five_bar") as (_, address):
        link = f"?robot=five_bar&pose={pose[0]:.9g},{pose[1]:.9g}&load=0,5,0,0,0,0"
        browser.resize(500, 900)
        browser.visit(address + link)
        browser.until(f"{TEXT % 'q_0'} === '{format_number(robot.inverse(pose)[0])}'")
        assert_fits(browser)
        energy = strain_energy(robot, pose, [0.0, 5.0, 0.0, 0.0, 0.0, 0.0])
        assert browser.until(f"{LINK}.value") == link
        assert browser.run("location.search") == ""
        clicked(browser, "Copy link")
        browser.until("[...document.querySelectorAll('#copy')].some(e => e.innerText === 'Copied')")
        # Empty until the next frame, as after a new size.
        browser.run("document.querySelector('canvas[data-engine]').width += 1")
        clicked(browser, "Save picture")
        wait_until(lambda: (tmp_path / "five_bar.png").exists(), lambda: browser.run("1"), 60.0, "")
        assert colours((tmp_path / "five_bar.png").read_bytes()) > 200
        for label in ("trail of the tool", "drag platform", "names of drives"):
            checked(browser, label)
        clicked(browser, "Home")
        browser.until(f"{LINK}.value.includes('pose=0,')")
        browser.run(TAB)
        browser.press("ArrowRight")
        browser.until(f"{TEXT % 'energy'} && {TEXT % 'energy'} !== '0'")
        assert read(browser, "energy") != format_number(float(energy.total))
        clicked(browser, "Go to the softest pose")
        assert "µm" in browser.until(f"({TEXT % 'note'} || '').includes('along') && {TEXT % 'note'}")
        clicked(browser, "No wrench")
        browser.until(f"!{LINK}.value.includes('load')")
        assert addresses(browser) == {"127.0.0.1"}


PLACE = """(() => {
  const found = [...%s].filter(e => e.getBoundingClientRect().width).find(e => %s);
  if (!found) return false;
  found.scrollIntoView({block: 'nearest'});
  const box = found.getBoundingClientRect();
  return [box.left + box.width / 2, box.top + box.height / 2];
})()"""


def pressed(browser, selector, test):
    """Click with the mouse on what a selector and a test of it, ``e``, find."""
    browser.drag(browser.until(PLACE % (f"document.querySelectorAll('{selector}')", test)))


@pytest.fixture
def page():
    """A page of this process, its loop in a thread."""
    from pkm_twin.view.model import Model
    from pkm_twin.view.page import Page, run_server
    from pkm_twin.view.panels import ModePanel

    with run_server(0) as server:
        page = Page(server, Model(load("delta_cu")))
        page.mode = ModePanel(page)
        page.address = f"http://127.0.0.1:{server.get_port()}/"
        threading.Thread(target=page.run, daemon=True).start()
        yield page


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_the_mouse_drags_the_platform_along_one_axis_within_limits_and_chooses_a_mode(browser, page):
    browser.resize(1000, 700)
    browser.visit(page.address)
    pressed(browser, "label", "e.innerText === 'drag platform'")
    wide = browser.until("(document.querySelector('canvas[data-engine]') || {}).clientWidth")

    def camera():
        cameras = [camera for camera, _ in page.stage._labels.values()]
        return cameras and cameras[-1].image_width == wide and cameras[-1]

    def look():
        browser.run("new Promise(requestAnimationFrame)")

    reach = page.model.robot.graph.size * np.eye(3)
    wait_until(lambda: camera() and page.stage.gizmo.visible, look, 60.0, "")
    for axis, way in ((0, 0.2), (1, 0.2), (2, -0.2), (2, -0.6)):
        pose, at = page.state.pose, np.array(page.stage.gizmo.position)
        ends = at + np.outer([0.24, 0.24 + way / 2, 0.24 + way], reach[axis])

        def drag(ends=ends):
            browser.drag(*project_points(ends, camera())[0].tolist(), pause=look)

        wait_until(lambda p=pose: (page.state.pose != p).any() or page.state.rejection, drag, 60.0, "")
        wait_until(lambda: not page._dragged, look, 60.0, "")
        moved = page.state.pose - pose
        assert moved[axis] * way > 0.0 or page.state.rejection
        assert bool(page.state.rejection) == (way == -0.6)
        np.testing.assert_allclose(np.delete(moved, axis), 0.0, atol=1e-6)
        assert not beyond_limits(page.model.robot, page.state.q)[0]
    pressed(browser, "[role=tab]", "e.innerText === 'Load'")
    pressed(browser, "input", "e.value === 'none'")
    pressed(browser, "[role=option]", "e.innerText === '1'")
    wait_until(lambda: page.mode.busy, look, 60.0, "")
    rest = page.stage._balls.batched_positions.copy()
    wait_until(lambda: (page.stage._balls.batched_positions != rest).any(), look, 60.0, "")


def colours(png):
    """How many colours a picture has: a page that draws nothing has a handful."""
    from matplotlib.image import imread

    pixels = (255 * imread(io.BytesIO(png))[..., :3]).astype(int).reshape(-1, 3)
    return len(np.unique(pixels @ [1, 256, 65536]))


@pytest.mark.long
@pytest.mark.parametrize(
    "arguments",
    [
        ("stewart",),
        ("five_bar",),
        ("prru",),
        ("upr_rpu",),
        (REPOSITORY / "examples/machines/dual_scara.urdf",),
        ("delta_cu", "--bag", DELTA),
    ],
    ids=str,
)
def test_every_kind_of_machine_is_shown(browser, arguments, tmp_path):
    with run_server(*arguments) as (_, address):
        browser.visit(address)
        assert float(browser.until(TEXT % "singularity")) > 0.0
        if "--bag" in arguments:
            assert read(browser, "bag_time") == "0"
        assert addresses(browser) == {"127.0.0.1"}
        assert colours(browser.picture()) > 200
        assert_fits(browser)
