# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a browser may change on the page: the values of its inputs, within what each can take.

All browsers share one page, and viser writes whatever property a message names. Of the others,
a browser's messages on its camera and on the platform that it drags are taken, and no more.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Final

from pkm_twin.errors import PkmTwinError
from pkm_twin.view.door import UNKNOWN

LONGEST: Final = 1000
"""Characters of a text."""


def guard(server: Any) -> None:
    """Let only values that inputs can take pass to a viser server that was just made.

    :raises PkmTwinError: the viser that is installed works in another way.
    """
    from viser import _messages as messages

    try:
        handlers = server._websock_server._incoming_handlers
        gizmo = server.scene._handle_transform_controls_updates
        released = server.scene._handle_transform_controls_drag_end
        take, inputs = server.gui._handle_gui_updates, server.gui._gui_input_handle_from_uuid
    except AttributeError:
        raise PkmTwinError(UNKNOWN) from None
    handlers.clear()

    async def update(client: int, message: Any) -> None:
        match message.uuid, message.updates:
            case str(uuid), {"value": value, **others} if not others:
                taken = acceptable(inputs[uuid], value) if uuid in inputs else None
                if taken is not None:
                    message.updates = {"value": taken}
                    await take(client, message)

    async def drag(take: Any, client: int, message: Any) -> None:
        turn = getattr(message, "wxyz", (1.0,))
        place = [*turn, *getattr(message, "position", ())]
        known = all(isinstance(v, (int, float)) and math.isfinite(v) for v in place)
        if known and any(turn) and not message.owner:
            await take(client, message)

    register = server._websock_server.register_handler
    register(messages.GuiUpdateMessage, update)
    register(messages.TransformControlsUpdateMessage, partial(drag, gizmo))
    register(messages.TransformControlsDragEndMessage, partial(drag, released))


def acceptable(handle: Any, value: Any) -> Any:
    """The value that an input takes for one that a browser sends, or None.

    Sliders take finite numbers, limited to their ends; menus one of their options; texts up to
    LONGEST characters; checkboxes and buttons true or false.
    """
    now = handle.value
    if isinstance(now, bool) or isinstance(value, bool):
        return value if type(value) is type(now) else None
    if isinstance(now, str):
        options = getattr(handle, "options", None)
        text = isinstance(value, str) and len(value) <= LONGEST
        return value if text and (options is None or value in options) else None
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    return float(min(max(value, handle.min), handle.max))
