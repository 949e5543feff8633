# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The page, moved by browsers over real websockets."""

import asyncio
import contextlib
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser")
pytest.importorskip("msgspec")
pytest.importorskip("websockets")

import msgspec
from websockets.asyncio.client import connect

from pkm_twin.view.model import MAX_SHOWN_DEFLECTION, Model
from pkm_twin.view.page import Page, run_server
from pkm_twin.view.panels import BagPanel, ModePanel
from pkm_twin.view.stage import fit_narrow_window
from pkm_twin.view.texts import format_number
from pkm_twin.view.timeline import Timeline
from stiffness_monitor.modes import modes
from test.support.robots import load

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [0, 0, 1],
    "fov": 1.0,
    "near": 0.1,
    "far": 10.0,
    "image_height": 10,
    "image_width": 10,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}


@pytest.fixture(scope="module")
def page():
    """A page with a time line of one second, and its port."""
    robot = load("delta_cu")
    q = robot.inverse(robot.home())
    rows = q + np.linspace(0.0, 0.1, 11)[:, None]
    line = Timeline(np.linspace(0.0, 1.0, 11), rows, None, None, None, "no masses")
    with run_server(0) as server:
        page = Page(server, Model(robot), "Bag")
        page.bag = BagPanel(page, line)
        page.port = server.get_port()
        yield page


def update(handle, updates):
    return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": updates}


def open_socket(page):
    import viser

    return connect(
        f"ws://127.0.0.1:{page.port}",
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
    )


async def until(page, condition):
    """Step until it is so; what never comes ends with the test's own limit."""
    while not condition():
        page.step()
        await asyncio.sleep(0.01)


async def press(page, socket, joint, value):
    """Move a joint's slider as a browser does: it is shown."""
    message = update(page._joints[joint], {"value": value})
    await socket.send(msgspec.msgpack.encode(message))
    await until(page, lambda: page.state.q[joint] == value)


def test_buttons_and_menus_do_what_they_are_for(page):
    """A bag plays to its end."""
    bag = page.bag
    assert bag._time.value < 1.0
    messages = [
        update(bag._speed, {"value": "4"}),
        update(bag._play, {"value": True}),
    ]

    async def talk():
        async with open_socket(page) as socket:
            for message in (CAMERA, *messages):
                await socket.send(msgspec.msgpack.encode(message))
            # On a busy machine one step may show it from its beginning to its end.
            await until(page, lambda: bag._time.value == 1.0 and not bag.busy)

    asyncio.run(talk())
    assert bag._speed.value == "4"


def test_the_platform_is_dragged(page, caplog):
    start = page.model.robot.platform(page.model.start.q)[0]
    place = start + np.array([0.0, 0.0, 0.01])
    drag = {
        "type": "TransformControlsUpdateMessage",
        "name": "/drag",
        "owner": "",
        "wxyz": [1.0, 0.0, 0.0, 0.0],
        "position": place.tolist(),
    }

    async def talk():
        async with open_socket(page) as socket:
            for message in (CAMERA,):
                await socket.send(msgspec.msgpack.encode(message))
            await press(page, socket, 1, 0.21)
            before = page.state.pose
            await socket.send(msgspec.msgpack.encode(drag))
            await until(page, lambda: page.state.pose is not before)
            np.testing.assert_allclose(page.state.pose, place, atol=1e-9)
            end = {"type": "TransformControlsDragEndMessage", "name": "/drag", "owner": ""}
            await socket.send(msgspec.msgpack.encode(end))
            await until(page, lambda: not page._dragged)
            page.step()
            np.testing.assert_allclose(page.stage.gizmo.position, place, atol=1e-9)

    asyncio.run(talk())
    assert not caplog.records
    page._go_home()


def test_a_mode_is_animated_at_the_pose_that_is_shown(page, monkeypatch):
    drawn = []
    monkeypatch.setattr(page.stage, "draw", lambda *given: drawn.append(given))
    panel = ModePanel(page)
    panel._choice.value = "2"
    for _ in range(3):
        panel.step()
    found = modes(page.model.robot, page.state.pose, 6)
    assert format_number(float(found.frequencies[1])) in panel._note.content
    shape = found.shapes[1, 0]
    for _, moved, shares, most in drawn:
        np.testing.assert_allclose(np.outer(moved.platform, shape), np.outer(shape, moved.platform))
        assert np.linalg.norm(moved.platform[:3]) <= MAX_SHOWN_DEFLECTION * page.model.robot.graph.size
        for name, (at, way) in moved.members.items():
            own = [k for k, node in enumerate(found.nodes) if node.startswith(f"{name} ")]
            np.testing.assert_array_equal(at, found.positions[own])
            both = np.outer(way, shape), np.outer(found.shapes[1, own, :3], moved.platform)
            np.testing.assert_allclose(*both, atol=1e-12 * np.abs(both[1]).max())
        assert shares[most] == found.energies.strain[1].max()
    panel._choice.value = "none"
    assert not panel.busy


def test_a_change_that_fails_is_logged_once_and_the_page_goes_on(page, caplog, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("nobody\nexpected this")

    with monkeypatch.context() as patch:
        patch.setattr(page.model, "apply_wrench", fail)
        for _ in range(3):
            page._requests["load"] = page._remove_wrench
            page.step()
    assert len(caplog.records) == 1

    async def talk():
        async with open_socket(page) as socket:
            await socket.send(msgspec.msgpack.encode(CAMERA))
            await press(page, socket, 1, 0.25)

    asyncio.run(talk())


def test_the_machine_fits_into_narrow_windows():
    """As wide as in a square window."""
    assert fit_narrow_window(1400, 757) == 1.0
    sizes = np.linspace(0.3, 2.0, 200)
    assert all(fit_narrow_window(aspect, 1.0) * aspect >= 1.0 - 1e-12 for aspect in sizes)


def placed(page, states):
    """Distances of the camera, in those of the beginning, after a browser reported states.

    :param states: width, height, and the camera's distance at which the browser is.
    """
    start = page.server.initial_camera
    middle, begin = np.array(start.look_at), np.array(start.position) - np.array(start.look_at)
    calls = []
    camera = SimpleNamespace(on_update=calls.append, wxyz=np.eye(4)[0], fov=1.0)
    client = SimpleNamespace(camera=camera, atomic=contextlib.nullcontext, client_id=-1, scene=page.server.scene)
    asyncio.run(page.stage._fit_camera(client))
    for width, height, distance in states:
        camera.image_width, camera.image_height = width, height
        camera.position, camera.look_at = middle + distance * begin, middle
        asyncio.run(calls[0](camera))
        yield float(np.linalg.norm(camera.position - middle) / np.linalg.norm(begin))


@pytest.mark.parametrize("late", [0.0, 1.0])
def test_reports_that_come_late_do_not_move_the_camera_away(page, late):
    """A page that is laid out slowly: thin first, then wide, while the browser lags behind."""
    thin, wide = fit_narrow_window(150, 600), fit_narrow_window(1200, 700)
    assert (thin, wide) == (4.0, 1.0)
    behind = thin + late * (wide - thin)
    states = [(3, 700, 1.0), (150, 600, 1.0), (1200, 700, behind), (1200, 700, thin)]
    assert list(placed(page, states))[-1] == pytest.approx(wide)
    # A camera that a visitor has moved stays.
    assert list(placed(page, [(150, 600, 0.7)])) == pytest.approx([0.7])
