"""Load generator: synthetic JPEGs, an HTTP client with little overhead, waiting for jobs.

The client shares the machine with the measured services. Request bodies are therefore built before
the clock starts, and are sent over persistent connections without a framework.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from PIL import Image
from sqlalchemy import func, select

from shared.catalog.database.session import Catalog
from shared.catalog.jobs import UNFINISHED_STATES
from shared.jobs import Job, JobKind, JobState
from tests.support.server import SERVICES_KEY

BOUNDARY = "placewise-bench"
CONTENT_TYPE = {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}
AUTH_HEADER = {"Authorization": f"Bearer {SERVICES_KEY}"}
TIMEOUT_SECONDS = 60.0
MAX_JPEG_QUALITY, MIN_JPEG_QUALITY = 95, 5  # JPEG qualities

_numbers = itertools.count()


def connect(url: str) -> HTTPConnection:
    """Return a persistent connection to a server; use it in one thread."""
    parts = urlsplit(url)
    return HTTPConnection(str(parts.hostname), parts.port, timeout=TIMEOUT_SECONDS)


def post_form(
    connection: HTTPConnection, path: str, form: bytes, **headers: str
) -> tuple[int, bytes]:
    """Return status and body of the response; OSError or HTTPException if there is none."""
    connection.request("POST", path, form, {**AUTH_HEADER, **CONTENT_TYPE, **headers})
    answer = connection.getresponse()
    return answer.status, answer.read()


def make_jpegs(count: int, size: tuple[int, int], size_bytes: int) -> list[bytes]:
    """Create JPEGs of about `size_bytes`, each with another texture."""
    rng = np.random.default_rng(0)
    return [_make_jpeg(rng, size, size_bytes) for _ in range(count)]


def _make_jpeg(rng: np.random.Generator, size: tuple[int, int], size_bytes: int) -> bytes:
    """Combine coarse noise (makes photos differ) with fine noise (gives a realistic file size)."""
    width, height = size
    coarse = Image.fromarray(rng.integers(0, 256, (12, 16, 3), dtype=np.uint8))
    fine = Image.fromarray(rng.integers(0, 256, (height // 4, width // 4, 3), dtype=np.uint8))
    image = Image.blend(
        coarse.resize(size, Image.Resampling.BICUBIC),
        fine.resize(size, Image.Resampling.BICUBIC),
        0.35,
    )
    rough, sharp = MIN_JPEG_QUALITY, MAX_JPEG_QUALITY
    while sharp - rough > 1:
        middle = (rough + sharp) // 2
        rough, sharp = (
            (middle, sharp) if len(_encode_jpeg(image, middle)) <= size_bytes else (rough, middle)
        )
    return _encode_jpeg(image, rough)


def _encode_jpeg(image: Image.Image, quality: int) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def multipart_form(photo: bytes) -> bytes:
    """Build a multipart form with the photo as a unique file.

    Bytes after the end of the JPEG change its hash but no pixel.
    """
    head = (
        f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="file"; filename="photo.jpg"\r\n'
        "Content-Type: image/jpeg\r\n\r\n"
    )
    return head.encode() + photo + f"{next(_numbers):020d}\r\n--{BOUNDARY}--\r\n".encode()


def multipart_forms(photos: Sequence[bytes], count: int) -> list[bytes]:
    """Build `count` forms; the photos are repeated."""
    return [multipart_form(photos[number % len(photos)]) for number in range(count)]


def upload_all(
    url: str,
    forms: Sequence[bytes],
    clients: int,
    *,
    path: str = "/api/v1/upload",
) -> list[Any]:
    """Upload all files with `clients` threads and return the JSON responses.

    Raises AssertionError: an upload was not accepted.
    """
    waiting = iter(enumerate(forms))  # shared by the threads
    answers: dict[int, Any] = {}

    def upload() -> None:
        with contextlib.closing(connect(url)) as connection:
            for number, form in waiting:
                status, body = post_form(connection, path, form)
                assert status < 300, body
                answers[number] = json.loads(body)

    with ThreadPoolExecutor(clients, thread_name_prefix="client") as pool:
        for client in [pool.submit(upload) for _ in range(clients)]:
            client.result()
    return [answers[number] for number in range(len(forms))]


POLL_SECONDS = 0.2


def wait_for_jobs(catalog: Catalog, seconds: float) -> None:
    """Wait until every stored photo is described.

    Raises AssertionError: a job failed, or the timeout has passed.
    """
    deadline = time.monotonic() + seconds
    while True:
        with catalog.read() as session:
            counts: dict[str, int] = dict(
                session.execute(
                    select(Job.state, func.count())
                    .where(Job.kind == JobKind.INDEX)
                    .group_by(Job.state)
                ).all()
            )
        assert not counts.get(JobState.FAILED), f"{counts[JobState.FAILED]} photos have failed"
        left = sum(counts.get(state, 0) for state in UNFINISHED_STATES)
        if not left:
            return
        assert time.monotonic() < deadline, f"{left} photos wait after {seconds:g} s"
        time.sleep(POLL_SECONDS)
