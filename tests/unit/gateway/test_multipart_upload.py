"""Multipart bodies, taken apart as they arrive: in any pieces, within limits, leaving nothing."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from starlette.requests import ClientDisconnect, Request
from starlette.types import Message

from services.gateway.uploads.multipart import (
    MAX_FIELDS_BYTES,
    OVERHEAD_BYTES,
    STORE_WRITE_BYTES,
    receive_form_file,
)
from shared.errors import InvalidRequest, PlacewiseError, TooLarge, UnsupportedMedia
from shared.ingest.validation import StoredUpload, check_photo_signature
from shared.storage import FolderStore
from tests.support.photos import photo_bytes

BOUNDARY = "the-boundary"
KEY = "originals/test"
LIMIT = 100_000
PHOTO = photo_bytes(1)


def field(name: str, value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return part(f'form-data; name="{name}"', data)


def file(data: bytes = PHOTO, name: str = "street.jpg", field: str = "file") -> bytes:
    return part(f'form-data; name="{field}"; filename="{name}"', data, "image/jpeg")


def part(disposition: str, data: bytes, media: str | None = None) -> bytes:
    head = f"--{BOUNDARY}\r\nContent-Disposition: {disposition}\r\n"
    head += f"Content-Type: {media}\r\n" if media else ""
    return head.encode() + b"\r\n" + data + b"\r\n"


END = f"--{BOUNDARY}--\r\n".encode()


class Body:
    """What a client sends, piece by piece; counts the bytes that were read."""

    def __init__(self, pieces: Iterable[bytes], *, cut_off: bool = False) -> None:
        self._pieces = list(pieces)
        self._cut_off = cut_off
        self.taken = 0

    @property
    def left(self) -> int:
        return len(self._pieces) - self.taken

    async def receive(self) -> Message:
        if self.taken == len(self._pieces):
            assert self._cut_off, "the server read on behind the end"
            return {"type": "http.disconnect"}
        piece = self._pieces[self.taken]
        self.taken += 1
        more = self._cut_off or self.taken < len(self._pieces)
        return {"type": "http.request", "body": piece, "more_body": more}


def in_pieces(data: bytes, size: int) -> list[bytes]:
    return [data[begin : begin + size] for begin in range(0, len(data), size)]


def receive(
    store: FolderStore,
    body: Body | bytes,
    *,
    headers: dict[str, str] | None = None,
    max_bytes: int = LIMIT,
    check_begin: Callable[[bytes], object] = lambda begin: None,
) -> StoredUpload:
    if isinstance(body, bytes):
        body = Body([body])
    sent = {"content-type": f"multipart/form-data; boundary={BOUNDARY}"} | (headers or {})
    scope = {
        "type": "http",
        "method": "POST",
        "path": "/api/v1/upload",
        "query_string": b"",
        "headers": [(k.encode(), v.encode()) for k, v in sent.items()],
    }
    request = Request(scope, body.receive)

    async def receive_and_complete() -> StoredUpload:
        async with receive_form_file(
            request, store, lambda _: KEY, max_bytes, check_begin
        ) as received:
            return received.complete()

    return asyncio.run(receive_and_complete())


def refused(store: FolderStore, body: Body | bytes, **options: object) -> PlacewiseError:
    """The error; nothing is left of the body, neither whole nor half written."""
    with pytest.raises(PlacewiseError) as caught:
        receive(store, body, **options)  # type: ignore[arg-type]
    assert_nothing_left(store)
    return caught.value


def assert_nothing_left(store: FolderStore) -> None:
    assert [path for path in Path(store.root).rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("beyond", [-1, 0, 1, 2 * STORE_WRITE_BYTES + 1])
@pytest.mark.parametrize("piece", [65_536, 10**9])
def test_file_of_any_size_is_stored_and_opened_whole(
    store: FolderStore, beyond: int, piece: int
) -> None:
    data = (PHOTO + bytes(range(256)) * 10_000)[: STORE_WRITE_BYTES + beyond]
    received = receive(
        store, Body(in_pieces(file(data) + END, piece)), max_bytes=10 * STORE_WRITE_BYTES
    )
    assert store.get(KEY) == data
    assert received.sha256 == hashlib.sha256(data).hexdigest()
    with received.open(store) as opened:
        assert opened.read() == data
    assert (received.content is None) == (beyond >= 0), "only the beginning stays in memory"


@pytest.mark.parametrize("size", [1, 2, 7, 64, 10**9])
def test_pieces_of_any_size_give_the_same_file_and_fields(store: FolderStore, size: int) -> None:
    body = field("latitude", "45.07") + file() + field("place", "Café") + field("tags", "") + END
    first, *rest = in_pieces(body, size)
    received = receive(store, Body([b"", first, b"", b"", *rest, b""]))  # an empty one is no end
    assert store.get(KEY) == PHOTO
    assert received == StoredUpload(
        key=KEY,
        filename="street.jpg",
        size_bytes=len(PHOTO),
        sha256=hashlib.sha256(PHOTO).hexdigest(),
        first_bytes=PHOTO[:16],
        fields={"latitude": "45.07", "place": "Café", "tags": ""},
        content=PHOTO,
    )


@pytest.mark.parametrize("size", [1, 5, 10**9])
def test_file_full_of_partial_boundaries_is_stored_whole(store: FolderStore, size: int) -> None:
    tricky = b"\xff\xd8\xff" + b"\r\n--the-boundar\r\n--\r\n\r\n-the-boundary--\r\n" * 20
    receive(store, Body(in_pieces(file(tricky) + END, size)))
    assert store.get(KEY) == tricky


@pytest.mark.parametrize("size", [1, 10, 10**9])
def test_first_bytes_are_checked_once_and_whole(store: FolderStore, size: int) -> None:
    seen: list[bytes] = []
    for photo in (PHOTO, b"BM12"):  # which is shorter than a signature
        received = receive(store, Body(in_pieces(file(photo) + END, size)), check_begin=seen.append)
        assert received.first_bytes == photo[:16]
        store.delete(KEY)
    assert seen == [PHOTO[:16], b"BM12"]


def test_unsupported_file_is_refused_without_reading_the_rest(store: FolderStore) -> None:
    body = Body(in_pieces(file(b"this is a text, not a photo " * 2000) + END, 200))
    error = refused(store, body, check_begin=check_photo_signature)
    assert isinstance(error, UnsupportedMedia)
    assert error.code == "unsupported_photo"
    assert body.taken <= 2


def test_file_over_the_limit_is_refused_without_reading_the_rest(store: FolderStore) -> None:
    assert receive(store, file() + END, max_bytes=len(PHOTO)).size_bytes == len(PHOTO)
    store.delete(KEY)
    assert refused(store, file() + END, max_bytes=len(PHOTO) - 1).code == "file_too_large"

    body = Body(in_pieces(file(bytes(50_000)) + END, 100))
    error = refused(store, body, max_bytes=1000)
    assert isinstance(error, TooLarge)
    assert (error.code, error.extra["max_bytes"]) == ("file_too_large", 1000)
    assert body.taken <= 13


def test_declared_length_over_the_limit_is_refused_before_anything_is_read(
    store: FolderStore,
) -> None:
    body = Body([file() + END])
    length = {"content-length": str(LIMIT + OVERHEAD_BYTES + 1)}
    assert refused(store, body, headers=length).code == "file_too_large"
    assert body.taken == 0


def test_text_fields_over_their_limit_are_refused_without_reading_the_rest(
    store: FolderStore,
) -> None:
    fields = b"".join(field(f"f{number}", "x" * 1000) for number in range(1000))
    body = Body(in_pieces(fields + file() + END, 1000))
    assert refused(store, body).code == "fields_too_large"
    assert body.taken <= MAX_FIELDS_BYTES // 1000 + 100


@pytest.mark.parametrize(
    "endless",
    [
        END + b"what follows the form " * 100_000,
        b"".join(field(f"f{number}", "") for number in range(20_000)),
    ],
    ids=["behind the end", "empty fields"],
)
def test_endless_body_is_refused(store: FolderStore, endless: bytes) -> None:
    body = Body(in_pieces(file() + endless, 10_000), cut_off=True)
    assert refused(store, body).code == "file_too_large"
    assert body.left > 0


def test_endless_part_header_is_refused(store: FolderStore) -> None:
    endless = f"--{BOUNDARY}\r\nContent-Disposition: ".encode() + b"x" * 1_000_000
    body = Body(in_pieces(endless, 1000), cut_off=True)
    assert refused(store, body).code == "malformed_body"
    assert body.left > 0


@pytest.mark.parametrize("keep", [0.0, 0.1, 0.5, 0.99])
def test_body_that_ends_early_is_refused_and_leaves_nothing(
    store: FolderStore, keep: float
) -> None:
    whole = field("place", "hall") + file() + END
    body = Body([whole[: int(len(whole) * keep)]])
    error = refused(store, body)
    assert isinstance(error, InvalidRequest)
    assert error.code == "malformed_body"


def test_a_client_that_disconnects_leaves_no_object(store: FolderStore) -> None:
    whole = file(bytes(5000)) + END
    body = Body(in_pieces(whole[:4000], 500), cut_off=True)
    with pytest.raises(ClientDisconnect):
        receive(store, body)
    assert_nothing_left(store)


@pytest.mark.parametrize(
    ("body", "code", "named"),
    [
        (field("place", "hall") + END, "no_file", "'file'"),
        (field("file", "sent as text") + END, "no_file", "'file'"),
        (file(field="photo") + END, "no_file", "'photo'"),
        (file() + file(photo_bytes(2)) + END, "several_files", "send one"),
        (file(b"") + END, "empty_file", "empty"),
        (file(b"", "") + END, "empty_file", "empty"),
    ],
)
def test_a_form_without_exactly_one_file_is_refused(
    store: FolderStore, body: bytes, code: str, named: str
) -> None:
    error = refused(store, body)
    assert (error.code, error.status) == (code, 400)
    assert named in error.detail


@pytest.mark.parametrize(
    ("sent", "remaining"),
    [
        ("street.jpg", "street.jpg"),
        ("../../etc/passwd", "passwd"),
        ("C:\\\\photos\\\\street.jpg", "street.jpg"),
        ("/", "photo"),
        ("naïve café.jpg", "naïve café.jpg"),
        ("a\x00b\x07c.jpg", "abc.jpg"),
        ("x" * 300 + ".jpg", "x" * 255),
    ],
)
def test_only_the_last_part_of_the_file_name_is_kept(
    store: FolderStore, sent: str, remaining: str
) -> None:
    assert receive(store, file(name=sent) + END).filename == remaining


@pytest.mark.parametrize(
    ("content_type", "code"),
    [
        ("", "no_file"),
        ("image/jpeg", "unsupported_body"),
        ("multipart/mixed; boundary=the-boundary", "unsupported_body"),
        ("multipart/form-data", "malformed_body"),
        ("multipart/form-data; boundary=", "malformed_body"),
        (f"multipart/form-data; boundary={'x' * 71}", "malformed_body"),
    ],
)
def test_other_kinds_of_body_are_refused_unread(
    store: FolderStore, content_type: str, code: str
) -> None:
    body = Body([file() + END])
    assert refused(store, body, headers={"content-type": content_type}).code == code
    assert body.taken == 0


@pytest.mark.parametrize(
    "body",
    [
        b"this is no multipart body at all",
        b"--other\r\n\r\n",
        f"--{BOUNDARY}\r\n\r\nno name\r\n".encode() + END,
        part("form-data", b"no name") + END,
        field("place", b"\xff\xfe not UTF-8") + file() + END,
        field("tags", "night") + field("tags", "wet") + file() + END,
    ],
)
def test_bodies_that_cannot_be_read_are_refused(store: FolderStore, body: bytes) -> None:
    assert refused(store, body).code == "malformed_body"


def test_a_refused_body_replaces_no_existing_object(store: FolderStore) -> None:
    store.put(KEY, b"there before")
    with pytest.raises(InvalidRequest):
        receive(store, file()[:-100])
    assert store.get(KEY) == b"there before"
