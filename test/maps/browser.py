# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A real browser without a window, driven over its DevTools protocol: pages, mouse, scripts."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from test.support.waiting import wait_until

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    # WebGL without a graphics card.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)
PATIENCE = 120.0
"""Seconds that a page may take, on a machine that does other things as well."""


def _pause() -> None:
    time.sleep(0.05)


def find_browser() -> str | None:
    """Path of a browser of this machine; PKM_TWIN_BROWSER goes first."""
    given = os.environ.get("PKM_TWIN_BROWSER")
    return given or next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One browser with one page; a context manager that leaves nothing behind.

    :param scale: drawn pixels per pixel of the page, along each side. Places and sizes stay the
        page's; at a half, drawing without a graphics card costs a quarter.
    """

    def __init__(self, program: str, size: tuple[int, int] = (600, 520), scale: float = 1.0) -> None:
        self._program, self._size, self._scale = program, size, scale
        self._count = 0
        self.events: list[dict[str, Any]] = []
        """What the protocol told unasked, once a domain is enabled."""

    def __enter__(self) -> Browser:
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._loop = asyncio.new_event_loop()
        self._process = subprocess.Popen(
            [
                self._program,
                *FLAGS,
                "--window-size={},{}".format(*self._size),
                f"--force-device-scale-factor={self._scale:g}",
                f"--user-data-dir={self._folder.name}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            self._socket = self._loop.run_until_complete(self._connect())
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._loop.close()
        self._folder.cleanup()

    def _port(self) -> str:
        """The port that the browser opens."""
        told = Path(self._folder.name) / "DevToolsActivePort"

        def words() -> list[str]:
            assert self._process.poll() is None, "the browser ended"
            return told.read_text().split() if told.exists() else []

        return wait_until(words, _pause, PATIENCE, "the browser's port")[0]

    async def _connect(self) -> Any:
        from tornado.httpclient import AsyncHTTPClient
        from tornado.websocket import websocket_connect

        address = f"127.0.0.1:{self._port()}"
        answer = await AsyncHTTPClient().fetch(f"http://{address}/json/list")
        page = next(p for p in json.loads(answer.body) if p["type"] == "page")
        return await websocket_connect(page["webSocketDebuggerUrl"], max_message_size=2**28)

    def call(self, method: str, **parameters: Any) -> Any:
        """One command of the protocol, and its result."""
        self._count += 1
        number = self._count

        async def exchange() -> Any:
            await self._socket.write_message(json.dumps({"id": number, "method": method, "params": parameters}))
            while True:
                text = await asyncio.wait_for(self._socket.read_message(), PATIENCE)
                assert text is not None, "the browser closed the connection"
                answer = json.loads(text)
                if answer.get("id") == number:
                    assert "error" not in answer, answer
                    return answer["result"]
                self.events.append(answer)

        return self._loop.run_until_complete(exchange())

    def run(self, script: str) -> Any:
        """Value of a script in the page; a promise is waited for."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, script: str) -> Any:
        """Value of a script, as soon as it is true."""
        return wait_until(lambda: self.run(script), _pause, PATIENCE, script)

    def slow_down(self, seconds: float) -> None:
        """From the next page on, let so much time pass between frames.

        Without a graphics card a scene that is drawn all the time leaves time for nothing else.
        """
        script = (
            "window.requestAnimationFrame = call => setTimeout("
            f"() => call(performance.now()), {1e3 * seconds:g});"
            "window.cancelAnimationFrame = clearTimeout;"
        )
        self.call("Page.enable")
        self.call("Page.addScriptToEvaluateOnNewDocument", source=script)

    def resize(self, width: int, height: int) -> None:
        """Let the page have this many pixels."""
        sizes = {
            "width": width,
            "height": height,
            "deviceScaleFactor": self._scale,
            "mobile": False,
        }
        self.call("Emulation.setDeviceMetricsOverride", **sizes)
        self.until(f"innerWidth === {width}")

    def open(self, path: Path) -> None:
        """Go to a file of this machine."""
        self.visit(path.resolve().as_uri())

    def visit(self, address: str) -> None:
        """Go to an address."""
        self.call("Page.navigate", url=address)
        self.until("document.readyState === 'complete'")

    def picture(self) -> bytes:
        """The page as it is seen, PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def move(self, x: float, y: float) -> None:
        """Put the mouse to a place, in pixels of the window."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def press(self, key: str) -> None:
        """Press and release a key, by its name (ArrowRight)."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def drag(self, *places: tuple[float, float], pause: Callable[[], object] = _pause) -> None:
        """Press the mouse at the first place, move it along, and release it at the last.

        :param pause: called before each event: a page may have to draw what is under the mouse.
        """
        kinds = ["mouseMoved", "mousePressed", *["mouseMoved"] * (len(places) - 1), "mouseReleased"]
        for k, (kind, (x, y)) in enumerate(zip(kinds, (places[0], *places, places[-1]), strict=True)):
            pause()
            held = kind != "mouseReleased" and k > 0
            self.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left" if k else "none",
                buttons=int(held),
                clickCount=int(k > 0),
            )
