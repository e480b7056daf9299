"""The server of the page: on this machine alone unless another address is asked for, and for pages it sent itself.

A page's connection is taken only from the address that is served (its origin), and its messages are bounded in size.
"""

from __future__ import annotations

import logging
import socket
import sys
from collections.abc import Callable
from typing import Any

from stochfuse.errors import UsageError, needed
from stochfuse.explore.state import MOST_BYTES, OpenedScenario

FIRST_PORT, PORTS = 5006, 10
LOOPBACK = "127.0.0.1"
PING = 20
"""Seconds between signs of life, to pages and to what stands between."""


def serve(given: OpenedScenario, port: int | None, address: str, started: Callable[[str], Any]) -> None:
    """Serve the page until the process is ended.

    Parameters
    ----------
    given : the scenario that pages begin with.
    port : default: the first that is free from `FIRST_PORT` on.
    address : of this machine.
    started : told the page's address when it can be opened.

    Raises
    ------
    StochfuseError
        If Bokeh is not installed.
    UsageError
        If the port cannot be had.
    """
    needed("bokeh", "page", "the page needs")
    from bokeh.application import Application
    from bokeh.application.handlers.function import FunctionHandler
    from bokeh.server.server import Server

    from stochfuse.explore.page import Page

    logging.getLogger("bokeh").setLevel(logging.ERROR)
    chosen = _free(address, port)
    names = {address, "localhost"} if address == LOOPBACK else {address, socket.gethostname()}
    server = Server(
        {"/": Application(FunctionHandler(lambda doc: Page(doc, given) and None))},
        port=chosen,
        address=address,
        allow_websocket_origin=[f"{name}:{chosen}" for name in sorted(names)],
        websocket_max_message_size=2 * MOST_BYTES,
        keep_alive_milliseconds=0,
        check_unused_sessions_milliseconds=5_000,
        unused_session_lifetime_milliseconds=30_000,
    )
    # Bokeh's own pings give a connection up that has just closed, and its `WSHandler.on_close` then fails on it
    # (AssertionError in `ServerConnection.session`); Tornado's know of one another, and of pongs that do not come
    server._tornado.settings["websocket_ping_interval"] = PING
    sys.setswitchinterval(0.001)  # so that a page is answered while engines work beside it
    server.start()
    started(f"http://{address}:{chosen}/")
    try:
        server.io_loop.start()
    finally:
        server.stop(wait=False)


def _free(address: str, port: int | None) -> int:
    """Return a port that can be had.

    Raises
    ------
    UsageError
        If there is none.
    """
    for one in range(FIRST_PORT, FIRST_PORT + PORTS) if port is None else (port,):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, one))
            except OSError as error:
                if port is not None:
                    reason = error.strerror or error
                    raise UsageError(f"--port: expected one that is free, got {port} ({reason})") from None
                continue
            return one
    last = FIRST_PORT + PORTS - 1
    raise UsageError(f"--port: expected one that is free, since {FIRST_PORT} to {last} are taken")
