"""HTTP server shared by all services: uvicorn with connection limits and graceful shutdown."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import uvicorn
from fastapi import FastAPI
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from services.http_connections import Connections, LimitedProtocol, receive_in_time
from shared.errors import Misconfigured
from shared.security.api_keys import is_loopback

PEER_ADDRESS = "placewise.peer"
"""Key of the ASGI scope: address of the connection, whatever the headers say."""
BACKLOG = 2048  # connections that wait to be accepted
# Connections accepted per wakeup. They are counted before more are accepted, so that a burst of
# connections can't use up all file descriptors.
ACCEPTED_AT_ONCE = 16
# Longer than the idle timeout of clients and load balancers (mostly 60 s): if the server closed the
# connection first, a request sent at the same moment would be lost.
KEEP_ALIVE_SECONDS = 75
SHUTDOWN_GRACE_SECONDS = 10  # for requests in flight when the server is stopped


class _NotifyingServer(uvicorn.Server):
    """uvicorn server that checks its connections regularly and calls `on_stop` before shutdown.

    `on_stop` lets requests that wait for something finish early.
    """

    on_stop: Callable[[], object]
    connections: Connections

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        asyncio.get_running_loop().set_exception_handler(self.connections.on_loop_error)
        await super().startup(sockets)
        for listener in sockets or []:
            listener.listen(BACKLOG)  # asyncio uses one number for both

    async def on_tick(self, counter: int) -> bool:
        if counter % 10 == 0:  # a tick is a tenth of a second
            self.connections.check()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self.on_stop()
        await super().shutdown(sockets)


def http_server(
    app: FastAPI, connections: Connections, *, on_stop: Callable[[], object] = lambda: None
) -> _NotifyingServer:
    """Creates a server for the application without starting it.

    Args:
        on_stop: Called on the event loop when the shutdown begins. Requests in flight have
            SHUTDOWN_GRACE_SECONDS to finish.
    """
    proxies = [str(network) for network in connections.limits.trusted_proxies]
    # uvicorn types ASGI messages one by one, Starlette does not.
    forwarded: Any = ProxyHeadersMiddleware(app, trusted_hosts=proxies)  # type: ignore[arg-type]
    server = _NotifyingServer(
        uvicorn.Config(
            # Instead of uvicorn's own, which would replace the address before it can be recorded.
            _limit_bodies(forwarded, connections),
            proxy_headers=False,
            loop="asyncio",
            http=partial(LimitedProtocol, connections),  # type: ignore[arg-type]
            backlog=ACCEPTED_AT_ONCE,
            log_config=None,
            access_log=False,  # `request_log` logs requests
            timeout_keep_alive=KEEP_ALIVE_SECONDS,
            timeout_graceful_shutdown=SHUTDOWN_GRACE_SECONDS,
        )
    )
    server.on_stop = on_stop
    server.connections = connections
    return server


def _limit_bodies(app: ASGIApp, connections: Connections) -> ASGIApp:
    """Limit the time that bodies take, and record the address of the connection in the scope.

    The latter before `X-Forwarded-For` replaces it.
    """

    async def limited(scope: Scope, receive: Receive, send: Send) -> None:
        if client := scope.get("client"):
            scope[PEER_ADDRESS] = client[0]
        if scope["type"] == "http":
            receive = receive_in_time(receive, connections)
        await app(scope, receive, send)

    return limited


@contextlib.contextmanager
def stop_on_signals(server: uvicorn.Server) -> Iterator[None]:
    """Context manager in which SIGTERM, SIGINT and SIGHUP stop the server gracefully.

    A closed terminal sends SIGHUP; under `nohup` it is ignored. uvicorn raises the signal again
    after its shutdown. Python's default handlers would then end the process before the other
    services have released their resources.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set signal handlers
        return

    def stop(_number: int, _frame: object) -> None:
        server.should_exit = True

    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    previous = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def listen(host: str, port: int) -> Iterator[socket.socket]:
    """Context manager that opens a listening socket; port 0 chooses a free port.

    Raises:
        Misconfigured: `address_in_use`, if the socket can't be bound.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Inherited by every connection. Without it, Nagle's algorithm delays the second packet of a
        # response by 40 ms. (asyncio sets it only on sockets that it has created.)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        listener.bind(address)
        listener.listen(BACKLOG)
    except OSError as error:
        raise Misconfigured(
            "address_in_use",
            f"Can't listen on {host}:{port}: {error.strerror or error}. "
            "Choose another port, for example: make run PORT=8001.",
        ) from error
    with listener:
        yield listener


WILDCARD_ADDRESSES = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104


def reachable_url(host: str, port: int) -> str:
    """Returns a URL for this machine; the wildcard addresses are replaced by loopback ones."""
    return _http_url(WILDCARD_ADDRESSES.get(host, host), port)


def lan_url(host: str, port: int) -> str | None:
    """Returns a URL for other devices of the network; None if they can't reach the server.

    For a wildcard address, it has the address from which this machine reaches other networks.
    """
    if is_loopback(host):
        return None
    if host in WILDCARD_ADDRESSES:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(("192.0.2.1", 9))  # selects a route; sends nothing
            except OSError:  # no network
                return None
            host = probe.getsockname()[0]
    return _http_url(host, port)


def _http_url(host: str, port: int) -> str:
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"
