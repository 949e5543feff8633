# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The page of ``pkm-twin view``: viser's sliders and numbers around the pure model.

Callbacks only store the latest request of each kind; one loop carries the requests out.
"""

from __future__ import annotations

import contextlib
import io
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from typing import Any, Final, Protocol

import numpy as np
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError, one_line
from pkm_twin.view import texts
from pkm_twin.view.model import Model, Range, State
from pkm_twin.view.scene import DRIVE_COLOUR, Scene
from pkm_twin.view.stage import Stage

ADDRESS: Final = "127.0.0.1"
"""The server listens on this address only."""


@contextmanager
def run_server(port: int) -> Iterator[Any]:
    """Run a viser server on the loopback address; port 0 chooses a free port.

    :raises PkmTwinError: another program uses the port.
    """
    import viser

    class Server(viser.ViserServer):
        """Serve without the public tunnel, which any visitor could request."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Do nothing instead of opening viser's public link."""

    # websockets logs a closed browser as an error.
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=ADDRESS, port=port, verbose=False)
    try:
        # viser takes the next port if the chosen one is in use.
        if port not in (0, server.get_port()):
            text = f"cannot listen on {ADDRESS} port {port}: it is in use; choose another --port"
            raise PkmTwinError(text)
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


class MovingPanel(Protocol):
    """A panel that moves the machine, in addition to the sliders."""

    @property
    def busy(self) -> bool:
        """True while the panel moves the machine."""

    def step(self) -> None:
        """Draw the motion since the last step."""


class Page:
    """The page of a robot; all connected browsers share one state."""

    def __init__(self, server: Any, model: Model, first: str = "") -> None:
        """Build the page; ``first`` is the title of an additional first tab, ``self.first``."""
        self.server, self.model, self.state = server, model, model.start
        lowest = min((r.low for r in model.pose_ranges if r.name == "z"), default=0.0)
        self.stage = Stage(server, Scene(model.robot), model.start.q, lowest)
        self.moving: list[MovingPanel] = []
        self._requests: dict[str, Callable[[], None]] = {}
        self._failures: set[str] = set()
        self._dragged = False
        self._wake = threading.Event()
        self._tops = np.array([r.high for r in model.wrench_ranges])
        server.gui.configure_theme(
            control_width="medium", show_logo=False, show_share_button=False, brand_color=DRIVE_COLOUR
        )
        # On a narrow screen the browser shows it as a sheet at the bottom instead.
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label(f"pkm-twin view {model.robot.name}")
        gui = server.gui
        gui.add_html(texts.STYLE_AND_LINK_SCRIPT)
        self._status = gui.add_html("")
        tabs = gui.add_tab_group()
        if first:
            self.first = tabs.add_tab(first)
        with tabs.add_tab("Move"):
            with gui.add_folder("Joints"):
                self._joints = self._add_sliders(model.joint_ranges, "joint", self._move_joint)
            with gui.add_folder("Pose of the platform"):
                self._pose = self._add_sliders(model.pose_ranges, "pose", self._move_pose)
            self.call_on(gui.add_button("Home").on_click, "home", self._go_home)
            self._add_checkbox("names of drives", True, self.stage.show_drive_names)
            self._add_checkbox("drag platform", False, partial(setattr, self.stage.gizmo, "visible"))
            self.call_on(self.stage.gizmo.on_update, "drag", self._move_platform)
            self._add_checkbox("trail of the tool", False, self.stage.show_trail)
            if self.stage.meshes:
                self._add_checkbox("meshes of the URDF, which do not bend", True, self.stage.show_meshes)
        self.load_tab = tabs.add_tab("Load")
        with self.load_tab:
            with gui.add_folder("Wrench on the platform, base axes"):
                self._wrench = self._add_sliders(model.wrench_ranges, "wrench", self._change_wrench)
                self.call_on(gui.add_button("No wrench").on_click, "unload", self._remove_wrench)
            r = model.enlargement
            self._enlarge = gui.add_slider("deflection magnified, times", r.low, r.high, r.step, r.high / 2)
            self.call_on(self._enlarge.on_update, "enlarge", self._update)
            self._loads = gui.add_html("")
            if "energy" not in model.compute_numbers(self.state).why:
                self.moving.append(SoftestPoseSearch(self))
        self._link = gui.add_text("link", model.write_url(self.state))
        self.call_on(
            self._link.on_update, "link", lambda: self.show_state(model.read_url(self.state, self._link.value))
        )
        gui.add_html(texts.write_buttons(model.robot.name))
        self._update()

    def call_on(self, react: Any, what: str, call: Callable[[], None]) -> None:
        """Call a function in the page's loop when a visitor triggers an event.

        :param react: ``on_update`` or ``on_click`` of a handle.
        :param what: name of the request; only the latest request of a name is carried out.
        """

        def store_request(event: Any) -> None:
            if event.client is not None:  # None if the page itself moved the handle
                self._dragged = getattr(event, "phase", "end") != "end"
                self._requests[what] = call
                self._wake.set()

        react(store_request)

    def run(self) -> None:
        """Serve until a signal ends the process."""
        while True:
            self._wake.wait(0.05 if any(item.busy for item in self.moving) else 1.0)
            self._wake.clear()
            self.step()

    def step(self) -> None:
        """Carry out the stored requests, then step the panels that move."""
        while self._requests:
            _, call = self._requests.popitem()
            self._attempt(call)
        for item in self.moving:
            if item.busy:
                self._attempt(item.step)

    def _attempt(self, call: Callable[[], None]) -> None:
        """Call a function; log an exception once per reason and keep serving."""
        try:
            call()
        except Exception as error:
            reason = f"{type(error).__name__}: {one_line(str(error))}"
            if reason not in self._failures:
                self._failures.add(reason)
                logging.getLogger("pkm_twin").warning("view: a change was rejected: %s", reason)

    def show_state(self, state: State) -> None:
        """Show another state; after a rejection the sliders stay as the visitor set them."""
        self.state = state
        self._update()

    def _add_checkbox(self, label: str, value: bool, call: Callable[[bool], None]) -> None:
        box = self.server.gui.add_checkbox(label, value)
        self.call_on(box.on_update, label, lambda: call(box.value))

    def _add_sliders(self, ranges: Sequence[Range], kind: str, move: Callable[[int], None]) -> list[Any]:
        handles = []
        for k, r in enumerate(ranges):
            initial = min(max(0.0, r.low), r.high)
            handle = self.server.gui.add_slider(f"{r.name}, {r.unit}", r.low, r.high, r.step, initial)
            self.call_on(handle.on_update, f"{kind} {k}", partial(move, k))
            handles.append(handle)
        return handles

    def _move_joint(self, k: int) -> None:
        q = self.state.q.copy()
        q[k] = self._joints[k].value
        self.show_state(self.model.to_joints(self.state, q))

    def _move_pose(self, k: int) -> None:
        pose = self.state.pose.copy()
        pose[k] = self._pose[k].value
        self.show_state(self.model.to_pose(self.state, pose))

    def _change_wrench(self, _: int) -> None:
        wrench = [handle.value for handle in self._wrench]
        self.show_state(self.model.apply_wrench(self.state, wrench))

    def _remove_wrench(self) -> None:
        self.show_state(self.model.apply_wrench(self.state, np.zeros(6)))

    def _move_platform(self) -> None:
        gizmo = self.stage.gizmo
        rotation = Rotation.from_quat(np.roll(gizmo.wxyz, -1)).as_matrix()
        self.show_state(self.model.to_platform(self.state, gizmo.position, rotation))

    def _go_home(self) -> None:
        self.show_state(self.model.to_joints(self.state, self.model.start.q))

    def _update(self) -> None:
        state, numbers = self.state, self.model.compute_numbers(self.state)
        energy = numbers.energy
        with self.server.atomic():
            if not state.rejection:
                _set_sliders(self._joints, state.q)
                _set_sliders(self._pose, state.pose)
                _set_sliders(self._wrench, state.wrench)
                self._link.value = self.model.write_url(state)
            self._status.content = texts.describe_state(self.model, state, numbers)
            self._loads.content = texts.describe_load(numbers)
            if energy is None or energy.dominant == "none":
                self.stage.draw(state.q)
            else:
                factors = np.asarray(energy.factors).tolist()
                shares = dict(zip(energy.elements, factors, strict=True))
                self.draw_deflected(energy.deflection, shares, str(energy.dominant))
            self.stage.draw_wrench(numbers.position, state.wrench / self._tops)
            self.stage.extend_trail(numbers.position)
            if not self._dragged:
                turn = Rotation.from_matrix(numbers.rotation).as_quat()
                self.stage.gizmo.position = numbers.position
                self.stage.gizmo.wxyz = np.roll(turn, 1)

    def draw_deflected(self, deflection: Array, shares: dict[str, float], dominant: str) -> None:
        """Draw the state with a deflection (6,), m and rad, base axes, enlarged by the slider."""
        moved = self.model.compute_deflection(self.state, deflection).times(self._enlarge.value)
        self.stage.draw(self.state.q, moved, shares, dominant)


class SoftestPoseSearch:
    """Search for the softest pose in a thread of its own, then move there."""

    def __init__(self, page: Page) -> None:
        self._page, self._progress = page, 0.0
        self._found: Future[tuple[Array, str]] | None = None
        button = page.server.gui.add_button("Go to the softest pose")
        self._note = page.server.gui.add_html("")
        page.call_on(button.on_click, "soft", self._start_search)

    @property
    def busy(self) -> bool:
        """True from the start of the search until its result is shown."""
        return self._found is not None

    def _start_search(self) -> None:
        if self.busy:
            return
        self._found = found = Future[tuple[Array, str]]()
        wrench = self._page.state.wrench

        def search() -> None:
            try:
                found.set_result(self._page.model.find_softest_pose(wrench, self._show_progress))
            except BaseException as error:
                found.set_exception(error)

        threading.Thread(target=search, name="softest", daemon=True).start()

    def _show_progress(self, done: float) -> None:
        self._progress = done

    def step(self) -> None:
        """Show the progress, then the result."""
        found, page = self._found, self._page
        if found is None:
            return
        if not found.done():
            self._note.content = texts.format_note(f"searching the workspace: {100 * self._progress:.0f} %")
            return
        self._found, self._progress = None, 0.0
        try:
            q, answer = found.result()
        except PkmTwinError as error:
            self._note.content = texts.format_note(str(error))
            return
        page.show_state(page.model.to_joints(page.state, q))
        self._note.content = texts.format_note(answer)


def _set_sliders(handles: Sequence[Any], values: Array) -> None:
    """Set sliders to values, clipped to their ranges."""
    for handle, value in zip(handles, values.tolist(), strict=True):
        # Round away the sign of -0.
        handle.value = round(min(max(value, handle.min), handle.max), 12) + 0.0
