# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The gallery's pictures of ``pkm-twin view``: ``python -m tools.pages.view docs/gallery``.

Needs a browser; where there is none it says so and leaves the pictures as they are.
"""

from __future__ import annotations

import contextlib
import io
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from pkm_twin import load
from pkm_twin.recordings import read
from pkm_twin.view.model import Model
from pkm_twin.view.page import Page, run_server
from pkm_twin.view.panels import BagPanel
from pkm_twin.view.timeline import Timeline
from test.maps.browser import Browser, find_browser

SIZE = (1100, 900)
CLOSE_NOTIFICATIONS = "document.querySelectorAll('[class*=Notification] button').forEach(b => b.click())"
FOCUS_MOVE_TAB = "[...document.querySelectorAll('[role=tab]')].find(t => t.innerText === 'Move').focus()"
SETTLING_SECONDS = 10.0
"""Time in which a browser without a graphics card draws a changed scene."""


def show_loaded_delta(page: Page) -> str:
    """Show a Delta off its axis under a sideways force."""
    moved = page.model.to_pose(page.state, [0.08, -0.06, -0.37])
    page.show_state(page.model.apply_wrench(moved, [60.0, 20.0, -80.0, 0.0, 0.0, 0.0]))
    return "Load"


def show_recording(page: Page) -> str:
    """Show a recording in the middle of a stroke with payload."""
    panel = BagPanel(page, Timeline.from_recording(read("bags/delta_cu_pick_and_place.mcap")))
    panel.show_time(9.05)
    return "Move"


def show_tilted_hexapod(page: Page) -> str:
    """Show a tilted hexapod."""
    page.show_state(page.model.to_pose(page.state, [0.03, 0.02, 0.66, 0.12, -0.16, 0.2]))
    return "Move"


def show_milling_head(page: Page) -> str:
    """Show a head under a cutting force."""
    moved = page.model.to_pose(page.state, np.array([-0.6, 0.25, -0.2]))
    page.show_state(page.model.apply_wrench(moved, [30.0, -50.0, -40.0, 10.0, -20.0, 50.0]))
    return "Load"


PICTURES: dict[str, tuple[str, Callable[[Page], str]]] = {
    "view_load": ("delta_cu", show_loaded_delta),
    "view_bag": ("delta_cu", show_recording),
    "view_stewart": ("stewart", show_tilted_hexapod),
    "view_upr_rpu": ("upr_rpu", show_milling_head),
}
DEFAULT_PICTURES = ("view_load", "view_bag", "load")
"""Pictures of the pages; `load` is the animation."""
FRAMES = 10


@contextlib.contextmanager
def open_picture(browser: Browser, name: str) -> Iterator[Page]:
    """Yield a page in the browser once it is drawn."""
    robot, prepare = PICTURES[name]
    with run_server(0) as server:
        page = Page(server, Model(load(robot)), "Bag" if prepare is show_recording else "")
        tab = prepare(page)
        browser.visit(f"http://127.0.0.1:{server.get_port()}/")
        browser.until("!!document.getElementById('singularity')")
        time.sleep(SETTLING_SECONDS)
        if tab == "Load":
            browser.run(FOCUS_MOVE_TAB)
            browser.press("ArrowRight")
            browser.run("document.activeElement.blur()")
        browser.run(CLOSE_NOTIFICATIONS)
        time.sleep(SETTLING_SECONDS)
        yield page


def animate(browser: Browser, path: Path) -> None:
    """Animate a load that grows and falls."""
    frames = []
    with open_picture(browser, "view_load") as page:
        full = np.array(page.state.wrench)
        for part in np.linspace(0.0, 1.0, FRAMES):
            page.show_state(page.model.apply_wrench(page.state, part * full))
            time.sleep(SETTLING_SECONDS / 3)
            frame = Image.open(io.BytesIO(browser.picture()))
            frames.append(frame.convert("RGB").resize((SIZE[0] * 7 // 10, SIZE[1] * 7 // 10)))
    palette = frames[-1].quantize(96)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    frames += frames[-2:0:-1]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=120, loop=0)


def main(folder: Path, names: tuple[str, ...]) -> None:
    """Write the named pictures into a folder."""
    program = find_browser()
    if program is None:
        print("no browser here: the pictures of `pkm-twin view` stay as they are")
        return
    with Browser(program, SIZE) as browser:
        browser.slow_down(0.5)
        for name in names:
            if name == "load":
                animate(browser, folder / "load.gif")
                continue
            with open_picture(browser, name):
                (folder / f"{name}.png").write_bytes(browser.picture())


if __name__ == "__main__":
    main(Path(sys.argv[1]), tuple(sys.argv[2:]) or DEFAULT_PICTURES)
