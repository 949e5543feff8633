# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin view``: the options, and what is opened, in which order."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pkm_twin.apps.options import BagTopics, LoadTimes, Payload, Platform, RobotName, read_options
from pkm_twin.console import progress
from pkm_twin.options import OptionalPath

if TYPE_CHECKING:
    from pkm_twin.apps.view.timeline import Timeline
    from pkm_twin.recordings import ReadOptions


def view(
    robot: RobotName,
    platform: Platform = None,
    bag: Annotated[OptionalPath, typer.Option(help="replay this recording on a timeline")] = None,
    topic: BagTopics = [],  # noqa: B006  typer copies it
    payload: Payload = None,
    load_times: LoadTimes = None,
    live: Annotated[bool, typer.Option("--live", help="follow running nodes; needs ROS")] = False,
    namespace: Annotated[
        str, typer.Option(help="the robot's namespace, with --live", show_default=False)
    ] = "",
    host: Annotated[
        str, typer.Option(help="address to listen on; every address except loopback needs --token")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="port to listen on; 0: any free port")] = 8080,
    token: Annotated[
        str,
        typer.Option(
            envvar="PKM_TWIN_TOKEN",
            help="access token, at least 16 characters; prefer the environment variable, because "
            "other users can see the command line",
            show_default=False,
        ),
    ] = "",
) -> None:
    """Show a robot in the browser, with sliders for pose and load.

    The page shows joint positions and their limits, the singularity index, the clearance between
    limbs, and deflection and strain energy under a wrench. With --bag it replays a recording with
    the model's torques; with --live it follows running nodes. It loads nothing from other hosts.

    Runs until Ctrl-C, and is reachable from this machine only, unless --host and --token are given.
    """
    from pkm_twin.apps.view.door import Door, listen
    from pkm_twin.maps.extras import require

    how = read_options(topic, payload, load_times, limited=True)
    if bag is None and (topic or how.load is not None):
        raise typer.BadParameter("--topic, --payload and --load-times need --bag")
    if bag is not None and live:
        raise typer.BadParameter("give --bag or --live, not both")
    if namespace and not live:
        raise typer.BadParameter("--namespace needs --live")
    require("viser", "view")
    door = Door(host, token)
    from pkm_twin import load
    from pkm_twin.apps.view.live import Live
    from pkm_twin.apps.view.model import Model
    from pkm_twin.apps.view.page import Page, serving
    from pkm_twin.apps.view.panels import BagPanel, LivePanel

    with ExitStack() as stack:
        door_socket = stack.enter_context(listen(host, port))
        machine = load(robot, platform=platform)
        timeline = None if bag is None else _timeline(bag, robot, how)
        model = Model(machine)
        server = stack.enter_context(serving(door, door_socket))
        page = Page(server, model)
        if timeline is not None:
            BagPanel(page, timeline)
        if live:
            heard = Live(machine)
            stack.enter_context(listening(heard, namespace))
            LivePanel(page, heard)
        name, number = door_socket.getsockname()[:2]
        shown = f"[{name}]" if ":" in name else name
        asked = "?token=TOKEN" if token else ""
        typer.echo(f"{machine.name}: http://{shown}:{number}/{asked}  (Ctrl-C ends)")
        page.run()


def _timeline(bag: Path, robot: str, how: ReadOptions) -> Timeline:
    from pkm_twin.apps.view.timeline import Timeline
    from pkm_twin.recordings import read

    with progress("reading", None) as update:
        recording = read(bag, robot, how, update)
    return Timeline.of(recording)


@contextmanager
def listening(live: Any, namespace: str) -> Iterator[None]:
    """Messages of the nodes in a namespace reach ``live`` while the block lasts."""
    from pkm_twin.apps.view.live import TOPICS
    from pkm_twin.ros.listener import listening_node, subscribe_best_effort

    ended = threading.Event()
    with listening_node("view", namespace=namespace) as (node, spin):
        for name, (kind, topic) in TOPICS.items():
            subscribe_best_effort(node, kind, topic, lambda m, name=name: live.take(name, m))  # type: ignore[misc]

        def work() -> None:
            while not ended.is_set():
                spin(0.1)

        thread = threading.Thread(target=work, name="view listens")
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
