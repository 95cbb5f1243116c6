"""The system's certificates, which all HTTP clients of a process trust, are read once."""

from __future__ import annotations

import functools

import httpcore2
import httpx2


def share_tls_context() -> None:
    """Let all clients of this process, and of its forks, share one TLS context.

    Each would read all certificates for itself: 40 ms of CPU time.
    """
    httpcore2.default_ssl_context = functools.cache(httpcore2.default_ssl_context)
    httpx2.Client().close()
