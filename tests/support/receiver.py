"""A receiver of webhooks, as a user would write one."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import hmac
import json
import ssl
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@dataclass(frozen=True, slots=True)
class Message:
    """One POST as it came."""

    path: str
    headers: dict[str, str]
    body: bytes

    def is_signed_with(self, secret: str) -> bool:
        """Written from https://www.standardwebhooks.com, not from our code."""
        key = base64.b64decode(secret.split("_", 1)[1])
        head = f"{self.headers['webhook-id']}.{self.headers['webhook-timestamp']}."
        digest = hmac.new(key, head.encode() + self.body, hashlib.sha256).digest()
        return (
            f"v1,{base64.b64encode(digest).decode()}" in self.headers["webhook-signature"].split()
        )

    def json(self) -> Any:
        return json.loads(self.body)


class Receiver:
    """Keeps what comes, and answers with `status` and `headers`."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.messages: list[Message] = []
        self.status = 204
        self.headers: dict[str, str] = {}


@contextlib.contextmanager
def receiving(tls: ssl.SSLContext | None = None) -> Iterator[Receiver]:
    """On loopback, on a free port."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            named = {name.lower(): value for name, value in self.headers.items()}
            receiver.messages.append(Message(self.path, named, body))
            self.send_response(receiver.status)
            for name, value in receiver.headers.items():
                self.send_header(name, value)
            self.end_headers()

        def log_message(self, *args: Any) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        if tls is not None:
            server.socket = tls.wrap_socket(server.socket, server_side=True)
        scheme, name = ("https", "localhost") if tls else ("http", "127.0.0.1")
        receiver = Receiver(f"{scheme}://{name}:{server.server_port}/hook?a=1")
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield receiver
        finally:
            server.shutdown()
            thread.join()
