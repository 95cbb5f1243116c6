"""Archives."""

from __future__ import annotations

import gzip
import io
import random
import stat
import tarfile
import warnings
import zipfile
from collections.abc import Iterator

from tests.support.archives import tar_of, tar_with, zip_of
from tests.support.hostile.file import OF_ARCHIVES, Hostile, photo


def archives() -> Iterator[Hostile]:
    for number, (what, data) in enumerate(_archive_files()):
        suffix = "zip" if data[:2] == b"PK" else "tar"
        yield Hostile(
            f"archive {number}: {what}", data, OF_ARCHIVES, f"photos.{suffix}", archive=True
        )


def _archive_files() -> Iterator[tuple[str, bytes]]:
    paths = (
        "../../evil.jpg",
        "/tmp/evil.jpg",
        "a/../../../evil.jpg",
        "..\\..\\evil.jpg",
        "C:\\evil.jpg",
    )
    for number, path in enumerate(paths):
        yield f"zip to {path}", zip_of({path: photo(200 + number)})
        yield f"tar to {path}", tar_of({path: photo(210 + number)})
    for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE):
        info = tarfile.TarInfo("link.jpg")
        info.type, info.linkname = kind, "/etc/passwd"
        behind = tarfile.TarInfo("link.jpg/evil.jpg")
        yield f"tar with a link or device {kind!r}", tar_with((info, b""), (behind, photo(220)))
    link = zipfile.ZipInfo("link.jpg")
    link.create_system, link.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(link, "/etc/passwd")
    yield "zip with a link", buffer.getvalue()
    yield "zip bomb", zip_of({"bomb.jpg": bytes(50_000_000)})
    yield "tar.gz bomb", tar_of({"bomb.jpg": bytes(50_000_000)}, "w:gz")
    yield "zip of small bombs", zip_of({f"{n}.jpg": bytes(1_000_000) for n in range(20)})
    inner = zip_of({"inner.zip": zip_of({"a.jpg": bytes(10_000_000)})})
    yield "zip of zips", zip_of({f"{n}.zip": inner for n in range(10)})
    yield "gzip of noise", gzip.compress(bytes(10_000_000))
    yield "zip of too many", zip_of({f"{n}.jpg": b"x" for n in range(1000)})
    yield "tar of too many", tar_of({f"{n}.jpg": b"x" for n in range(1000)})
    yield "zip without members", zip_of({})
    yield "zip without photos", zip_of({"notes.txt": b"none"})
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        twice = zip_of([("a.jpg", photo(230)), ("a.jpg", photo(231))])
    yield "the same name twice", twice
    places = b"filename,latitude,longitude\na.jpg,nan,inf\n"
    yield "a table with no numbers", zip_of({"a.jpg": photo(232), "places.csv": places})
    lines = b'{"filename": "a.jpg", "latitude": NaN, "longitude": 1e999}\n'
    yield "a manifest with no numbers", zip_of({"a.jpg": photo(233), "manifest.jsonl": lines})
    yield "text", b"this is no archive" * 100
    good = zip_of({f"{n}.jpg": photo(240 + n) for n in range(3)})
    as_tar = tar_of({f"{n}.jpg": photo(250 + n) for n in range(3)})
    for whole in (good, as_tar):
        for share in (10, 50, 95):
            yield f"cut off at {share} %", whole[: len(whole) * share // 100]
    encrypted = bytearray(good)
    encrypted[6] |= 1
    yield "encrypted, as its member says", bytes(encrypted)
    dice = random.Random(3)
    for seed in range(6):
        for whole in (good, as_tar):
            data = bytearray(whole)
            for _ in range(4**seed // 2 + 1):
                data[dice.randrange(4, len(data))] = dice.randrange(256)
            yield f"noise {seed}", bytes(data)
