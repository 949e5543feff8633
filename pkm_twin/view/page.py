# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The page of ``pkm-twin view``: viser's sliders and numbers around the pure model.

Callbacks only note what was asked for; one loop does it, the latest of each kind.
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
from pkm_twin.view.scene import DRIVE, Scene
from pkm_twin.view.stage import Stage

ADDRESS: Final = "127.0.0.1"
"""The only address that is listened on."""


@contextmanager
def serving(port: int) -> Iterator[Any]:
    """Run a viser server on this computer's own address; port 0 is any that is free.

    :raises PkmTwinError: the port is another program's.
    """
    import viser

    class Server(viser.ViserServer):
        """Without the tunnel to a host outside that any visitor could ask for."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Refuse viser's public link: the page is for this computer alone."""

    # A visitor that breaks off is no error of this program's.
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=ADDRESS, port=port, verbose=False)
    try:
        # viser takes the next port where one is in use.
        if port not in (0, server.get_port()):
            text = f"cannot listen on {ADDRESS} port {port}: it is in use; choose another --port"
            raise PkmTwinError(text)
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


class Moving(Protocol):
    """A panel that moves the machine, in addition to the sliders."""

    @property
    def busy(self) -> bool:
        """True if it moves now."""

    def step(self) -> None:
        """Draw what moved since the last step."""


class Page:
    """A robot on a server; all connected browsers share it."""

    def __init__(self, server: Any, model: Model, first: str = "") -> None:
        """Build the page; ``first`` names a tab before the others, ``self.first``, for a bag or nodes."""
        self.server, self.model, self.state = server, model, model.start
        lowest = min((r.low for r in model.pose_ranges if r.name == "z"), default=0.0)
        self.stage = Stage(server, Scene(model.robot), model.start.q, lowest)
        self.moving: list[Moving] = []
        self._asked: dict[str, Callable[[], None]] = {}
        self._failures: set[str] = set()
        self._dragged = False
        self._wake = threading.Event()
        self._tops = np.array([r.high for r in model.wrench_ranges])
        server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False, brand_color=DRIVE)
        # On a narrow screen the browser shows it as a sheet at the bottom instead.
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label(f"pkm-twin view {model.robot.name}")
        gui = server.gui
        gui.add_html(texts.SHEET)
        self._status = gui.add_html("")
        tabs = gui.add_tab_group()
        if first:
            self.first = tabs.add_tab(first)
        with tabs.add_tab("Move"):
            with gui.add_folder("Joints"):
                self._joints = self._add_sliders(model.joint_ranges, "joint", self._move_joint)
            with gui.add_folder("Pose of the platform"):
                self._pose = self._add_sliders(model.pose_ranges, "pose", self._move_pose)
            self.ask(gui.add_button("Home").on_click, "home", self._go_home)
            self._check("names of drives", True, self.stage.name_drives)
            self._check("drag platform", False, partial(setattr, self.stage.gizmo, "visible"))
            self.ask(self.stage.gizmo.on_update, "drag", self._drag)
            self._check("trail of the tool", False, self.stage.leave_trail)
            if self.stage.meshes:
                self._check("meshes of the URDF, which do not bend", True, self.stage.show_meshes)
        self.load_tab = tabs.add_tab("Load")
        with self.load_tab:
            with gui.add_folder("Wrench on the platform, base axes"):
                self._wrench = self._add_sliders(model.wrench_ranges, "wrench", self._load)
                self.ask(gui.add_button("No wrench").on_click, "unload", self._unload)
            r = model.enlargement
            self._enlarge = gui.add_slider("deflection magnified, times", r.low, r.high, r.step, r.high / 2)
            self.ask(self._enlarge.on_update, "enlarge", self._show)
            self._loads = gui.add_html("")
            if "energy" not in model.numbers(self.state).why:
                self.moving.append(Search(self))
        self._link = gui.add_text("link", model.link(self.state))
        self.ask(self._link.on_update, "link", self._follow)
        gui.add_html(texts.buttons(model.robot.name))
        self._show()

    def ask(self, react: Any, what: str, call: Callable[[], None]) -> None:
        """Make the call in the page's loop when a visitor triggers the event of ``react``.

        :param react: ``on_update`` or ``on_click`` of a handle; of many calls with one name,
            ``what``, the last one is made.
        """

        def noted(event: Any) -> None:
            if event.client is not None:  # else the page itself moved it
                self._dragged = getattr(event, "phase", "end") != "end"
                self._asked[what] = call
                self._wake.set()

        react(noted)

    def run(self) -> None:
        """Serve until a signal ends the process."""
        while True:
            self._wake.wait(0.05 if any(item.busy for item in self.moving) else 1.0)
            self._wake.clear()
            self.step()

    def step(self) -> None:
        """Do what was asked for, and draw what moved by itself."""
        while self._asked:
            _, call = self._asked.popitem()
            self._attempt(call)
        for item in self.moving:
            if item.busy:
                self._attempt(item.step)

    def _attempt(self, call: Callable[[], None]) -> None:
        """Make a call; one that fails is logged, once a reason, and the page goes on for all."""
        try:
            call()
        except Exception as error:
            reason = f"{type(error).__name__}: {one_line(str(error))}"
            if reason not in self._failures:
                self._failures.add(reason)
                logging.getLogger("pkm_twin").warning("view: a change was rejected: %s", reason)

    def become(self, state: State) -> None:
        """Show another state; one with a refusal leaves the sliders where they were put."""
        self.state = state
        self._show()

    def _check(self, label: str, value: bool, call: Callable[[bool], None]) -> None:
        box = self.server.gui.add_checkbox(label, value)
        self.ask(box.on_update, label, lambda: call(box.value))

    def _add_sliders(self, ranges: Sequence[Range], kind: str, move: Callable[[int], None]) -> list[Any]:
        handles = []
        for k, r in enumerate(ranges):
            amid = min(max(0.0, r.low), r.high)
            handle = self.server.gui.add_slider(f"{r.name}, {r.unit}", r.low, r.high, r.step, amid)
            self.ask(handle.on_update, f"{kind} {k}", partial(move, k))
            handles.append(handle)
        return handles

    def _move_joint(self, k: int) -> None:
        q = self.state.q.copy()
        q[k] = self._joints[k].value
        self.become(self.model.to_joints(self.state, q))

    def _move_pose(self, k: int) -> None:
        pose = self.state.pose.copy()
        pose[k] = self._pose[k].value
        self.become(self.model.to_pose(self.state, pose))

    def _load(self, _: int) -> None:
        wrench = [handle.value for handle in self._wrench]
        self.become(self.model.loaded(self.state, wrench))

    def _unload(self) -> None:
        self.become(self.model.loaded(self.state, np.zeros(6)))

    def _drag(self) -> None:
        gizmo = self.stage.gizmo
        rotation = Rotation.from_quat(np.roll(gizmo.wxyz, -1)).as_matrix()
        self.become(self.model.to_platform(self.state, gizmo.position, rotation))

    def _follow(self) -> None:
        self.become(self.model.linked(self.state, self._link.value))

    def _go_home(self) -> None:
        self.become(self.model.to_joints(self.state, self.model.start.q))

    def _show(self) -> None:
        state, numbers = self.state, self.model.numbers(self.state)
        energy = numbers.energy
        with self.server.atomic():
            if not state.refusal:
                _put(self._joints, state.q)
                _put(self._pose, state.pose)
                _put(self._wrench, state.wrench)
                self._link.value = self.model.link(state)
            self._status.content = texts.status(self.model, state, numbers)
            self._loads.content = texts.load(numbers)
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
        moved = self.model.deflected(self.state, deflection).times(self._enlarge.value)
        self.stage.draw(self.state.q, moved, shares, dominant)


class Search:
    """The softest pose, looked for in a thread of its own."""

    def __init__(self, page: Page) -> None:
        self._page, self._done = page, 0.0
        self._found: Future[tuple[Array, str]] | None = None
        button = page.server.gui.add_button("Go to the softest pose")
        self._note = page.server.gui.add_html("")
        page.ask(button.on_click, "soft", self._begin)

    @property
    def busy(self) -> bool:
        """True if it is under way, or found what is not shown yet."""
        return self._found is not None

    def _begin(self) -> None:
        if self.busy:
            return
        self._found = found = Future[tuple[Array, str]]()
        wrench = self._page.state.wrench

        def work() -> None:
            try:
                found.set_result(self._page.model.softest(wrench, self._show_progress))
            except BaseException as error:
                found.set_exception(error)

        threading.Thread(target=work, name="softest", daemon=True).start()

    def _show_progress(self, done: float) -> None:
        self._done = done

    def step(self) -> None:
        """Say how far it is, then go there."""
        found, page = self._found, self._page
        if found is None:
            return
        if not found.done():
            self._note.content = texts.note(f"searching the workspace: {100 * self._done:.0f} %")
            return
        self._found, self._done = None, 0.0
        try:
            q, told = found.result()
        except PkmTwinError as error:
            self._note.content = texts.note(str(error))
            return
        page.become(page.model.to_joints(page.state, q))
        self._note.content = texts.note(told)


def _put(handles: Sequence[Any], values: Array) -> None:
    """Move sliders to values, or to the nearest end of their range."""
    for handle, value in zip(handles, values.tolist(), strict=True):
        # What is zero but for rounding has no sign.
        handle.value = round(min(max(value, handle.min), handle.max), 12) + 0.0
