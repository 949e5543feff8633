# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What one browser sends cannot end or change the page for the others, over real websockets."""

import asyncio
import contextlib
import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser")
pytest.importorskip("msgspec")
pytest.importorskip("websockets")

import msgspec
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from pkm_twin.view.door import Door, listen
from pkm_twin.view.model import VISIBLE, Model
from pkm_twin.view.page import Page, serving
from pkm_twin.view.panels import BagPanel, ModePanel
from pkm_twin.view.stage import farther
from pkm_twin.view.texts import number
from pkm_twin.view.timeline import Timeline
from stiffness_monitor.modes import modes
from test.support.robots import load

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [0, 0, 1], "fov": 1.0,
    "near": 0.1, "far": 10.0, "image_height": 10, "image_width": 10, "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}  # fmt: skip
VALUES = [
    "0.3", "nan", "", None, [], [0.1], {}, {"a": 1}, True, math.nan, math.inf, -math.inf, b"\0",
    "x" * 10_000,
]  # fmt: skip
PROPERTIES = [
    {"removed": True}, {"props": None}, {"props": {}}, {"update_cb": []}, {"sync_cb": None},
    {"uuid": "other"}, {"__class__": None}, {"value": 0.25, "removed": True}, {"min": 9.0}, {},
]  # fmt: skip
KINDS = [
    {"type": "GuiFormDirtyMessage", "uuid": "a"},
    {"type": "GuiFormSubmitMessage", "uuid": "a"},
    {"type": "ShareUrlRequest"},
    {"type": "ResetGuiMessage"},
    {**CAMERA, "position": [math.nan, 0, 0]},
]
UNREADABLE = [
    b"", b"\xc1", b"not msgpack", "text", msgspec.msgpack.encode([1]),
    msgspec.msgpack.encode({"type": "NoSuchMessage"}),
    msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "a"}),
    msgspec.msgpack.encode({**CAMERA, "wxyz": None}),
]  # fmt: skip


@pytest.fixture(scope="module")
def page():
    """A page with a time line of one second, and its port."""
    robot = load("delta_cu")
    q = robot.inverse(robot.home())
    rows = q + np.linspace(0.0, 0.1, 11)[:, None]
    line = Timeline(np.linspace(0.0, 1.0, 11), rows, None, None, None, "no masses")
    with listen("127.0.0.1", 0) as socket, serving(Door("127.0.0.1"), socket) as server:
        page = Page(server, Model(robot), "Bag")
        page.bag = BagPanel(page, line)
        page.port = socket.getsockname()[1]
        yield page


def inputs(page):
    bag = page.bag
    return [*page._joints, *page._wrench, page._enlarge, bag._time, bag._play, bag._speed]


def shown(page):
    """Everything of the inputs that a browser could have written to."""
    return [
        (h.value, h._impl.removed, h._impl.props is None, h._impl.uuid, len(h._impl.update_cb),
         getattr(h, "min", None))
        for h in inputs(page)
    ]  # fmt: skip


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


def attack(page, messages):
    """Messages from one socket: that one and another can move the machine afterwards."""

    async def talk():
        async with open_socket(page) as bad, open_socket(page) as good:
            for socket in (bad, good):
                await socket.send(msgspec.msgpack.encode(CAMERA))
            await press(page, bad, 1, 0.25)
            before = shown(page)
            for message in messages:
                await bad.send(msgspec.msgpack.encode(message))
            # One that comes after them all has been heard: so have they.
            await press(page, bad, 0, 0.15)
            await press(page, good, 0, float(page.model.start.q[0]))
            before[0] = (page._joints[0].value, *before[0][1:])
            assert shown(page) == before

    asyncio.run(talk())


def test_values_of_another_type_or_not_finite_change_nothing(page, caplog):
    attack(
        page,
        [
            update(handle, {"value": value})
            for handle in inputs(page)
            for value in VALUES
            if not (value is True and isinstance(handle.value, bool))
        ],
    )
    assert not caplog.records


def test_a_menu_takes_its_options_alone(page):
    speed = page.bag._speed
    attack(page, [update(speed, {"value": value}) for value in ("abc", "3", "-1", "1e9", 2)])
    assert speed.value == "1"


def test_properties_are_the_pages_own(page):
    attack(page, [update(h, updates) for h in inputs(page) for updates in PROPERTIES])
    attack(page, [{**update(page._joints[0], {}), "updates": u} for u in (None, [], "a", 3)])
    attack(page, [{**update(page._joints[0], {"value": 0.1}), "uuid": u} for u in (None, [], "a")])


def test_other_kinds_of_messages_do_nothing(page):
    attack(page, KINDS)


def test_buttons_and_menus_do_what_they_are_for(page):
    """A bag plays to its end, whatever else is sent meanwhile."""
    bag = page.bag
    assert bag._time.value < 1.0
    messages = [
        update(bag._speed, {"value": "4"}),
        update(bag._play, {"value": True}),
        update(bag._speed, {"value": "fast"}),
        update(bag._time, {"value": "now"}),
    ]

    async def talk():
        async with open_socket(page) as socket:
            for message in (CAMERA, *messages):
                await socket.send(msgspec.msgpack.encode(message))
            # On a busy machine one step may show it from its beginning to its end.
            await until(page, lambda: bag._time.value == 1.0 and not bag.busy)

    asyncio.run(talk())
    assert bag._speed.value == "4"


def test_the_platform_is_dragged_by_finite_numbers_alone(page, caplog):
    start = page.model.robot.platform(page.model.start.q)[0]
    place = start + np.array([0.0, 0.0, 0.01])
    drag = {
        "type": "TransformControlsUpdateMessage", "name": "/drag", "owner": "",
        "wxyz": [1.0, 0.0, 0.0, 0.0], "position": place.tolist(),
    }  # fmt: skip
    bad = [
        {**drag, "position": [math.nan, 0.0, 0.0]},
        {**drag, "position": [math.inf, 0.0, 0.0]},
        {**drag, "wxyz": [0.0, 0.0, 0.0, 0.0]},
        {**drag, "name": "/other"},
    ]

    async def talk():
        async with open_socket(page) as socket:
            for message in (CAMERA, *bad):
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
    assert number(float(found.frequencies[1])) in panel._told.content
    shape = found.shapes[1, 0]
    for _, moved, shares, most in drawn:
        np.testing.assert_allclose(np.outer(moved.platform, shape), np.outer(shape, moved.platform))
        assert np.linalg.norm(moved.platform[:3]) <= VISIBLE * page.model.robot.graph.size
        for name, (at, way) in moved.members.items():
            own = [k for k, node in enumerate(found.nodes) if node.startswith(f"{name} ")]
            np.testing.assert_array_equal(at, found.positions[own])
            both = np.outer(way, shape), np.outer(found.shapes[1, own, :3], moved.platform)
            np.testing.assert_allclose(*both, atol=1e-12 * np.abs(both[1]).max())
        assert shares[most] == found.energies.strain[1].max()
    panel._choice.value = "none"
    assert not panel.busy


def test_a_value_beyond_the_ends_is_the_end(page):
    slider, rows = page.bag._time, page.bag._timeline.q

    async def talk():
        async with open_socket(page) as socket:
            await socket.send(msgspec.msgpack.encode(CAMERA))
            for value, row, taken in (
                (0.5, 5, 0.5),
                (1e300, -1, slider.max),
                (-2.0, 0, slider.min),
            ):
                await socket.send(msgspec.msgpack.encode(update(slider, {"value": value})))
                await until(page, lambda row=row: np.array_equal(page.state.q, rows[row]))
                assert slider.value == taken

    asyncio.run(talk())


@pytest.mark.parametrize("data", UNREADABLE, ids=repr)
def test_what_cannot_be_read_ends_its_own_connection_at_most(page, data):
    async def talk():
        async with open_socket(page) as good:
            await good.send(msgspec.msgpack.encode(CAMERA))
            try:
                async with open_socket(page) as bad:
                    await bad.send(data)
                    await bad.send(msgspec.msgpack.encode(CAMERA))
            except ConnectionClosed:
                pass
            await press(page, good, 2, 0.15)
            await press(page, good, 2, 0.2)

    asyncio.run(talk())


def test_a_change_that_fails_is_logged_once_and_the_page_goes_on(page, caplog, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("nobody\nexpected this")

    with monkeypatch.context() as patch:
        patch.setattr(page.model, "loaded", fail)
        for _ in range(3):
            page._asked["load"] = page._unload
            page.step()
    assert len(caplog.records) == 1
    attack(page, [])


def test_the_machine_fits_into_narrow_windows():
    """As wide as in a square window."""
    assert farther(1400, 757) == 1.0
    sizes = np.linspace(0.3, 2.0, 200)
    assert all(farther(aspect, 1.0) * aspect >= 1.0 - 1e-12 for aspect in sizes)


def placed(page, states):
    """Distances of the camera, in those of the beginning, after a browser reported states.

    :param states: width, height, and the camera's distance at which the browser is.
    """
    start = page.server.initial_camera
    middle, begin = np.array(start.look_at), np.array(start.position) - np.array(start.look_at)
    calls = []
    camera = SimpleNamespace(on_update=calls.append, wxyz=np.eye(4)[0], fov=1.0)
    client = SimpleNamespace(
        camera=camera, atomic=contextlib.nullcontext, client_id=-1, scene=page.server.scene
    )
    asyncio.run(page.stage._frame(client))
    for width, height, distance in states:
        camera.image_width, camera.image_height = width, height
        camera.position, camera.look_at = middle + distance * begin, middle
        asyncio.run(calls[0](camera))
        yield float(np.linalg.norm(camera.position - middle) / np.linalg.norm(begin))


@pytest.mark.parametrize("late", [0.0, 1.0])
def test_reports_that_come_late_do_not_move_the_camera_away(page, late):
    """A page that is laid out slowly: thin first, then wide, while the browser lags behind."""
    thin, wide = farther(150, 600), farther(1200, 700)
    assert (thin, wide) == (4.0, 1.0)
    behind = thin + late * (wide - thin)
    states = [(3, 700, 1.0), (150, 600, 1.0), (1200, 700, behind), (1200, 700, thin)]
    assert list(placed(page, states))[-1] == pytest.approx(wide)
    # A camera that a visitor has moved stays.
    assert list(placed(page, [(150, 600, 0.7)])) == pytest.approx([0.7])
