# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin view``: a robot, a recording or running nodes in the browser."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import RecordingOptions, TimedPayloadOptions
from pkm_twin.console import draw_progress
from pkm_twin.report import Report
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from pkm_twin.view.live import Live


@dataclass(frozen=True, kw_only=True)
class View(TimedPayloadOptions, RecordingOptions):
    """Show a robot in the browser, with sliders for pose and load.

    The page shows joint positions and their limits, the singularity index, the clearance between
    limbs, and deflection and strain energy under a wrench. With --bag it replays a recording with
    the model's torques; with --live it follows running nodes. It loads nothing from other hosts.

    Runs until Ctrl-C, and is reachable from this machine only; from another one, use ssh -L.
    """

    bag: Path | None = setting(None, "replay this recording on a timeline")
    live: bool = setting(False, "follow running nodes; needs ROS")
    namespace: str = setting("", "the robot's namespace, with --live")
    port: int = setting(8080, "port to listen on; 0: any free port", low=0, high=65535)


@command("Robots")
def view(given: View) -> Report:
    """Serve the page until a signal ends it.

    :raises PkmTwinError: a recording that cannot be read, or a port that is not free.
    """
    from pkm_twin.errors import import_extra

    bag = given.bag
    if bag is None and (given.topic or given.load is not None):
        raise click.UsageError("--topic, --payload and --load-times need --bag")
    if bag is not None and given.live:
        raise click.UsageError("give --bag or --live, not both")
    if given.namespace and not given.live:
        raise click.UsageError("--namespace needs --live")
    import_extra("viser", "view")
    from pkm_twin import load
    from pkm_twin.view.live import Live
    from pkm_twin.view.model import Model
    from pkm_twin.view.page import ADDRESS, Page, run_server
    from pkm_twin.view.panels import BagPanel, LivePanel, ModePanel
    from pkm_twin.view.timeline import Timeline
    from stiffness_monitor.modes import has_modes

    with ExitStack() as stack:
        machine = load(given.robot, **given.part)
        timeline = None
        if bag is not None:
            with draw_progress("reading", None) as update:
                timeline = Timeline.from_recording(given.read(bag, given.robot, update, limited=True))
        model = Model(machine)
        server = stack.enter_context(run_server(given.port))
        page = Page(server, model, "Bag" if timeline is not None else "Live" if given.live else "")
        if has_modes(machine):
            ModePanel(page)
        if timeline is not None:
            BagPanel(page, timeline)
        if given.live:
            live = Live(machine)
            stack.enter_context(receive_messages(live, given.namespace))
            LivePanel(page, live)
        click.echo(f"{machine.name}: http://{ADDRESS}:{server.get_port()}/  (Ctrl-C ends)")
        page.run()
    return Report()


@contextmanager
def receive_messages(live: Live, namespace: str) -> Iterator[None]:
    """Pass messages of the nodes in a namespace to ``live`` while the block lasts."""
    from pkm_twin.ros.context import listening_node, subscribe_best_effort
    from pkm_twin.view.live import TOPICS

    ended = threading.Event()
    with listening_node("view", namespace=namespace) as (node, spin):
        for name, (kind, topic) in TOPICS.items():
            subscribe_best_effort(node, kind, topic, lambda m, name=name: live.take(name, m))  # type: ignore[misc]

        def receive() -> None:
            while not ended.is_set():
                spin(0.1)

        thread = threading.Thread(target=receive, name="view listens")
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
