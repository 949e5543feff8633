# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Who gets the page and its data, by the rules and over real sockets."""

import asyncio
import http.client
import socket

import numpy as np
import pytest

from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.view.door import LEAST_TOKEN, Door, is_loopback, listen

TOKEN = "correct-horse-battery"
LOCAL = {"host": "127.0.0.1:8080"}


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "127.3.2.1"])
def test_the_loopback_needs_no_token(host):
    assert is_loopback(host)
    assert Door(host).judge("/", LOCAL, 8080) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "192.168.1.2", "example.com"])
def test_any_other_address_does(host):
    with pytest.raises(ParameterError, match="--token"):
        Door(host)
    Door(host, TOKEN)


@pytest.mark.parametrize(
    "token", ["short", "a" * (LEAST_TOKEN - 1), "with a space in it....", "ü" * 20]
)
def test_tokens_are_long_and_plain(token):
    with pytest.raises(ParameterError, match=str(LEAST_TOKEN)) as raised:
        Door("0.0.0.0", token)
    assert token not in str(raised.value)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"host": "localhost:8080"}, None),
        ({"host": "[::1]:8080"}, None),
        ({"host": "evil.example:8080"}, 403),
        ({"host": "127.0.0.1.evil.example"}, 403),
        ({"host": "[::1"}, 403),
        ({}, 403),
        ({**LOCAL, "origin": "http://127.0.0.1:8080"}, None),
        ({**LOCAL, "origin": "http://evil.example"}, 403),
        ({**LOCAL, "origin": "http://127.0.0.1:9999"}, 403),
        ({**LOCAL, "origin": "null"}, 403),
    ],
)
def test_pages_of_other_sites_and_bent_names_stay_out(headers, status):
    refusal = Door("127.0.0.1").judge("/", headers, 8080)
    assert (None if refusal is None else refusal.status) == status


def test_the_token_is_asked_for_once_and_kept_in_a_cookie():
    door = Door("0.0.0.0", TOKEN)
    host = {"host": "machine.lan:8080"}
    for path in ("/", "/?token=", f"/?token={TOKEN}x", "/?token=wrong", f"/{TOKEN}"):
        assert door.judge(path, host, 8080).status == 401
    welcome = door.judge(f"//evil.example/?token={TOKEN}&a=b", host, 8080)
    headers = dict(welcome.headers)
    assert (welcome.status, headers["Location"]) == (303, "/evil.example/?a=b")
    assert TOKEN not in headers["Set-Cookie"]
    assert "HttpOnly" in headers["Set-Cookie"]
    cookie = headers["Set-Cookie"].split(";")[0]
    assert door.judge("/", {**host, "cookie": cookie}, 8080) is None
    assert door.judge("/", {**host, "cookie": cookie}, 8081).status == 401
    assert door.judge("/", {**host, "cookie": cookie + "x"}, 8080).status == 401
    assert door.judge("/", {**host, "cookie": "a=\x00; ;;="}, 8080).status == 401
    assert door.judge("/", {**host, "authorization": f"Bearer {TOKEN}"}, 8080) is None
    assert door.judge("/", {**host, "authorization": "Bearer nonsense"}, 8080).status == 401
    # Another process has another cookie.
    other = Door("0.0.0.0", TOKEN)
    assert other.judge("/", {**host, "cookie": cookie}, 8080).status == 401


def test_a_port_in_use_is_told():
    with listen("127.0.0.1", 0) as first:
        port = first.getsockname()[1]
        with pytest.raises(
            PkmTwinError, match=f"127.0.0.1 port {port}: .*in use; choose another --port"
        ):
            listen("127.0.0.1", port)
    with pytest.raises(PkmTwinError, match="is not an address"):
        listen("no.such.host.invalid", 0)
    with pytest.raises(ParameterError, match="65535"):
        listen("127.0.0.1", 70000)


@pytest.fixture(scope="module")
def served():
    """A server with a token and something to hide; its port."""
    pytest.importorskip("viser")
    from pkm_twin.view.page import serving

    with (
        listen("127.0.0.1", 0) as listening,
        serving(Door("127.0.0.1", TOKEN), listening) as server,
    ):
        server.gui.add_html("<b>the machine's secret</b>")
        server.scene.add_point_cloud("/secret", np.zeros((4, 3)), (0, 0, 0))
        yield listening.getsockname()[1]


def get(port, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def test_without_the_token_no_byte_of_the_page_comes(served):
    for path, headers in (
        ("/", {}),
        ("/index.html", {}),
        ("/?token=wrong-wrong-wrong", {}),
        ("/", {"Cookie": f"pkm_twin_view_{served}=guessed"}),
        ("/", {"Authorization": "Bearer wrong-wrong-wrong"}),
    ):
        status, _, body = get(served, path, **headers)
        assert status == 401, path
        assert len(body) < 200
        assert b"script" not in body


def test_with_it_the_page_comes_and_may_ask_no_other_host(served):
    status, headers, _ = get(served, f"/?token={TOKEN}")
    assert (status, headers["Location"]) == (303, "/")
    cookie = headers["Set-Cookie"].split(";")[0]
    status, headers, body = get(served, Cookie=cookie)
    assert status == 200
    assert b"<html" in body
    policy = headers["Content-Security-Policy"]
    assert "http:" not in policy
    assert "https:" not in policy
    assert "*" not in policy


def connect(port, **headers):
    """The first message of a websocket, or the status that it was refused with."""
    import viser
    from websockets.asyncio.client import connect as open_socket
    from websockets.exceptions import InvalidStatus

    async def talk():
        try:
            async with open_socket(
                f"ws://127.0.0.1:{port}",
                subprotocols=[f"viser-v{viser.__version__}"],
                additional_headers=headers,
                max_size=None,
            ) as websocket:
                return await asyncio.wait_for(websocket.recv(), 60)
        except InvalidStatus as error:
            return error.response.status_code

    return asyncio.run(talk())


def test_the_data_come_by_the_same_door(served):
    assert connect(served) == 401
    assert connect(served, Cookie=f"pkm_twin_view_{served}=guessed") == 401
    assert connect(served, Origin="http://evil.example", Authorization=f"Bearer {TOKEN}") == 403
    data = connect(served, Authorization=f"Bearer {TOKEN}")
    assert isinstance(data, bytes)
    cookie = get(served, f"/?token={TOKEN}")[1]["Set-Cookie"].split(";")[0]
    assert isinstance(connect(served, Cookie=cookie), bytes)


def test_what_is_no_http_leaves_the_server_up(served):
    with socket.create_connection(("127.0.0.1", served), timeout=60) as raw:
        raw.sendall(b"\x00\xff not http\r\n\r\n")
        raw.recv(100)
    assert get(served)[0] == 401
