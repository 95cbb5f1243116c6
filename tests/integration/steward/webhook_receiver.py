"""A receiver of webhooks, as a user would write one."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import hmac
import json
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from tests.support.fake_server import QuietHandler, serving


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

    class Handler(QuietHandler):
        def do_POST(self) -> None:  # noqa: N802
            body = self.rfile.read(int(self.headers["content-length"]))
            named = {name.lower(): value for name, value in self.headers.items()}
            receiver.messages.append(Message(self.path, named, body))
            self.send_response(receiver.status)
            for name, value in receiver.headers.items():
                self.send_header(name, value)
            self.end_headers()

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        if tls is not None:
            server.socket = tls.wrap_socket(server.socket, server_side=True)
        scheme, name = ("https", "localhost") if tls else ("http", "127.0.0.1")
        receiver = Receiver(f"{scheme}://{name}:{server.server_port}/hook?a=1")
        with serving(server):
            yield receiver


@contextlib.contextmanager
def hanging_receiver(tls: ssl.SSLContext, kind: str) -> Iterator[str]:
    """URL of an HTTPS receiver that never comes to an end; it ends when its clients hang up.

    `kind` is where it hangs: in the "handshake", or sending one byte after the other of the
    response's "head" or "body".
    """
    threads: list[threading.Thread] = []

    def hang(connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            if kind == "handshake":
                while connection.recv(1024):
                    pass
                return
            with tls.wrap_socket(connection, server_side=True) as secured:
                secured.recv(65_536)
                head = b"HTTP/1.1 200 OK\r\n"
                secured.sendall(head + (b"\r\n" if kind == "body" else b""))
                while True:
                    secured.sendall(b"x" if kind == "body" else b"X: y\r\n")
                    time.sleep(0.02)

    def accept() -> None:
        with contextlib.suppress(OSError):  # the listener was shut down
            while True:
                connection, _ = listener.accept()
                threads.append(threading.Thread(target=hang, args=[connection]))
                threads[-1].start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threads.append(threading.Thread(target=accept))
        threads[0].start()
        try:
            yield f"https://localhost:{listener.getsockname()[1]}/hook"
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            for thread in threads:
                thread.join(60)
                assert not thread.is_alive(), "a connection was left open"


def certificate(folder: Path, name: str) -> Path:
    """A PEM file with the certificate of a host of that name, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    file = folder / f"{name}.pem"
    file.write_bytes(
        made.public_bytes(serialization.Encoding.PEM)
        + key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    return file
