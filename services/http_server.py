"""What every process that answers HTTP does alike: listen, serve, stop in good order."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from functools import partial

import uvicorn
from fastapi import FastAPI

from services.http_connections import Connections, LimitedProtocol
from shared.errors import Misconfigured

BACKLOG = 2048  # connections that wait to be accepted
# Then those are counted before more are accepted: a crowd can't use up all file descriptors.
ACCEPTED_AT_ONCE = 16
# Of a connection without a request. Longer than clients and balancers keep theirs (mostly 60 s):
# who closes first must not be the one that may be sent a request at the same moment.
KEEP_ALIVE_SECONDS = 75
SHUTDOWN_GRACE_SECONDS = 10  # for requests under way when the server is asked to stop


class NotifyingServer(uvicorn.Server):
    """uvicorn's, with limits for connections, that says when it begins to stop: requests under way
    may then come to an end."""

    on_stop: Callable[[], object]
    connections: Connections

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        asyncio.get_running_loop().set_exception_handler(self.connections.on_loop_error)
        await super().startup(sockets)
        for listener in sockets or []:
            listener.listen(BACKLOG)  # asyncio takes one number for both

    async def on_tick(self, counter: int) -> bool:
        if counter % 10 == 0:  # tenths of a second
            self.connections.check()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self.on_stop()
        await super().shutdown(sockets)


def http_server(
    app: FastAPI, connections: Connections, *, on_stop: Callable[[], object] = lambda: None
) -> NotifyingServer:
    """A server of the application, not started yet, within the limits of `connections`. `on_stop`
    is called on its event loop when it takes no more requests; it answers those that it has for
    GRACEFUL_SECONDS."""
    proxies = [str(network) for network in connections.limits.trusted_proxies]
    server = NotifyingServer(
        uvicorn.Config(
            app,
            loop="asyncio",
            http=partial(LimitedProtocol, connections),  # type: ignore[arg-type]
            forwarded_allow_ips=proxies,
            backlog=ACCEPTED_AT_ONCE,
            log_config=None,
            access_log=False,  # `call_log` writes them
            timeout_keep_alive=KEEP_ALIVE_SECONDS,
            timeout_graceful_shutdown=SHUTDOWN_GRACE_SECONDS,
        )
    )
    server.on_stop = on_stop
    server.connections = connections
    return server


@contextlib.contextmanager
def stop_on_signals(server: uvicorn.Server) -> Iterator[None]:
    """SIGTERM and Ctrl-C end the block in good order, not the process.

    uvicorn raises the signal that stopped it once more. By Python's own handlers that would end
    the process there, before its parts have given back what they hold.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's, and so is their handling
        return

    def stop(_number: int, _frame: object) -> None:
        server.should_exit = True

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def listen(host: str, port: int) -> Iterator[socket.socket]:
    """The listening socket; port 0 takes a free one. Misconfigured: `address_in_use`."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Inherited by every connection: an answer's second packet waits for no acknowledgement,
        # which costs 40 ms a call. (asyncio sets it only on sockets that it has made.)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        listener.bind(address)
        listener.listen(BACKLOG)
    except OSError as error:
        raise Misconfigured(
            "address_in_use",
            f"Can't listen on {host}:{port}: {error.strerror or error}. "
            "Choose another one, for example: make run PORT=8001.",
        ) from error
    with listener:
        yield listener


def reachable_url(host: str, port: int) -> str:
    """An address that this machine reaches; "every address" is none that can be called."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"
