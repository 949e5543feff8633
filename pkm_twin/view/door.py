# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Who may enter: every request is judged before a byte of the page or of its data leaves.

On the loopback any program of this machine may; a page of another site in this machine's browser
may not, nor a name that was bent to this machine. Elsewhere a token is asked for. The answers
carry a policy that keeps the browser from asking any other host.

``Door`` knows of no library; ``behind`` puts it before viser's server.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final
from urllib.parse import parse_qsl, urlencode, urlsplit

from pkm_twin.errors import ParameterError, PkmTwinError, install

UNKNOWN: Final = f"unsupported version of viser: {install('view')}"
LEAST_TOKEN: Final = 16
"""Characters of a token: fewer could be guessed."""
POLICY: Final = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
    "connect-src 'self' data: blob:; form-action 'none'; frame-ancestors 'self'"
)
"""Content-Security-Policy: nothing is fetched from elsewhere, whatever the page's script asks."""


def is_loopback(host: str) -> bool:
    """Whether a host's name or address is this machine's own."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Refusal:
    """An answer instead of the page: an HTTP status, a line of text, and more headers."""

    status: HTTPStatus
    text: str
    headers: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Door:
    """What is asked of a request to ``host``; ``token`` empty: none is asked for.

    :raises ParameterError: an address that is not the loopback's without a token, or a token that
        is too short or not plain characters.
    """

    host: str
    token: str = ""
    _pass: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    def __post_init__(self) -> None:
        if not self.token and not is_loopback(self.host):
            raise ParameterError(
                "--host", self.host, "127.0.0.1, or another address together with --token"
            )
        plain = self.token.isascii() and self.token.isprintable() and " " not in self.token
        if self.token and not (plain and len(self.token) >= LEAST_TOKEN):
            given = f"{len(self.token)} characters"
            bound = f"at least {LEAST_TOKEN} ASCII characters without spaces"
            raise ParameterError("--token", given, bound)

    def judge(self, path: str, headers: Mapping[str, str], port: int) -> Refusal | None:
        """None lets a request in.

        :param headers: by name in lower case; ``port``: the one that is listened on.
        """
        host = headers.get("host", "")
        if is_loopback(self.host) and not is_loopback(_name(host)):
            return Refusal(HTTPStatus.FORBIDDEN, "this page is available on its own computer only")
        origin = headers.get("origin")
        if origin is not None and origin.partition("://")[2].lower() != host.lower():
            return Refusal(HTTPStatus.FORBIDDEN, "pages of other sites have no access")
        if not self.token:
            return None
        if self._has_pass(headers.get("cookie", ""), port) or self._bears(headers):
            return None
        place, _, asked = path.partition("?")
        query = dict(parse_qsl(asked))
        if _same(query.pop("token", ""), self.token):
            # Out of the address line and the history, into a cookie that scripts cannot read.
            rest = f"?{urlencode(query)}" if query else ""
            cookie = f"{_cookie(port)}={self._pass}; HttpOnly; SameSite=Strict; Path=/"
            # One slash: two would name another host.
            to = f"/{place.lstrip('/')}{rest}"
            return Refusal(HTTPStatus.SEE_OTHER, "", (("Location", to), ("Set-Cookie", cookie)))
        return Refusal(
            HTTPStatus.UNAUTHORIZED,
            "access needs a token: /?token=TOKEN, or the header Authorization: Bearer TOKEN",
            (("WWW-Authenticate", "Bearer"),),
        )

    def _has_pass(self, cookies: str, port: int) -> bool:
        try:
            found = SimpleCookie(cookies).get(_cookie(port))
        except CookieError:
            return False
        return found is not None and _same(found.value, self._pass)

    def _bears(self, headers: Mapping[str, str]) -> bool:
        kind, _, given = headers.get("authorization", "").partition(" ")
        return kind.lower() == "bearer" and _same(given.strip(), self.token)


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens; port 0 is any that is free.

    :raises PkmTwinError: no such address, or the port is another program's.
    """
    if not 0 <= port <= 65535:
        raise ParameterError("--port", port, "0 to 65535")
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        result = socket.socket(family, kind)
    except OSError as error:
        raise PkmTwinError(
            f"--host {host!r} is not an address of this computer: {error.strerror}"
        ) from None
    try:
        result.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        result.bind(address)
        result.listen(100)
    except OSError as error:
        result.close()
        raise PkmTwinError(
            f"cannot listen on {host} port {port}: {error.strerror}; choose another --port"
        ) from None
    return result


@contextmanager
def behind(door: Door, listening: socket.socket) -> Iterator[None]:
    """A viser server that is made in this block serves on the socket, behind the door.

    viser binds ports by itself, the next one where one is taken, and asks nobody who comes in. Both
    are arguments of ``websockets``' serve(), which it calls: they are put in there.

    :raises PkmTwinError: the viser that is installed made no server in that way.
    """
    import websockets.asyncio.server as library

    plain, port = library.serve, listening.getsockname()[1]
    made = []

    def serve(handler: Any, *_: Any, **options: Any) -> Any:
        page = options.pop("process_request", None)

        def process(connection: Any, request: Any) -> Any:
            headers = {name.lower(): value for name, value in request.headers.raw_items()}
            refusal = door.judge(request.path, headers, port)
            if refusal is not None:
                answer = connection.respond(refusal.status, f"{refusal.text}\n")
                for name, value in refusal.headers:
                    answer.headers[name] = value
                return answer
            answer = None if page is None else page(connection, request)
            if answer is not None:
                answer.headers["Content-Security-Policy"] = POLICY
                answer.headers["Referrer-Policy"] = "no-referrer"
            return answer

        made.append(port)
        return plain(handler, sock=listening, process_request=process, **options)

    library.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        library.serve = plain  # type: ignore[misc]
    if made != [port]:
        raise PkmTwinError(UNKNOWN)


def _cookie(port: int) -> str:
    # Browsers send a host's cookies to all of its ports.
    return f"pkm_twin_view_{port}"


def _name(host: str) -> str:
    """The host's name of a Host header, without the port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _same(given: str, right: str) -> bool:
    return hmac.compare_digest(given.encode(), right.encode())
