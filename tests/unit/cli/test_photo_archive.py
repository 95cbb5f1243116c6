"""Photos of archives: what honest ones give, and that damaged ones end in a clear error."""

from __future__ import annotations

import contextlib
import gzip
import os
import random
import stat
import struct
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from services.cli.ingest.geotags import LocalPhoto, LocalSource, count_other_files, find_photos
from services.cli.ingest.photo_archive import is_archive
from shared.errors import InvalidRequest, PlacewiseError
from tests.support.archives import PACKED, tar_of, zip_of

every_kind = pytest.mark.parametrize("packed", PACKED.values(), ids=PACKED.keys())


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "photos.zip"


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as stack:
        yield stack


def found_in(path: Path, data: bytes, table: Path | None = None) -> list[tuple[LocalPhoto, bytes]]:
    """The photos of an archive with their bytes."""
    path.write_bytes(data)
    with contextlib.ExitStack() as stack:
        source = LocalSource.open(path, stack)
        photos = find_photos(source.path, table, None, own_table=source.table)
        return [(photo, photo.path.read_bytes()) for photo in photos]


def refused(path: Path, data: bytes) -> PlacewiseError:
    with pytest.raises(PlacewiseError) as caught:
        found_in(path, data)
    return caught.value


@every_kind
def test_photos_have_their_bytes_and_their_paths_in_the_archive(
    path: Path, packed: Callable[[Any], bytes], stack: contextlib.ExitStack
) -> None:
    members = {"b.jpg": os.urandom(70_000), "Day 2/a.PNG": b"x" * 5000, "ünï/日本.jpg": b"named"}
    others = {"notes.txt": b"", "inner.zip": b"", "__MACOSX/._b.jpg": b"", ".git/c.jpg": b""}
    found = found_in(path, packed({**members, **others}))
    assert {photo.relative_path: data for photo, data in found} == members
    assert not any(photo.path.exists() for photo, _ in found), "nothing stays"
    folder = LocalSource.open(path, stack).path
    assert count_other_files(folder) == {".txt": 1, ".zip": 1}


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (zip_of({"a": b"x"}), True),
        (tar_of({"a": b"x"}), True),
        (tar_of({"a": b"x"}, form=tarfile.GNU_FORMAT), True),
        (tar_of({"a": b"x"}, "w:gz"), True),
        (b"PK is how this text begins" * 100, False),
        (gzip.compress(b"just a text" * 100), False),
        (b"", False),
    ],
    ids=["zip", "tar", "gnu tar", "tar.gz", "text", "gzip", "nothing"],
)
def test_an_archive_is_detected_by_its_content(path: Path, data: bytes, expected: bool) -> None:
    path.write_bytes(data)
    assert is_archive(path) == expected
    assert not is_archive(path.parent)
    assert not is_archive(path.parent / "nothing")


@every_kind
def test_names_that_lead_elsewhere_write_nothing_there(
    path: Path, packed: Callable[[Any], bytes]
) -> None:
    names = ["/outside.jpg", "../../up.jpg"]
    found = found_in(path, packed({name: name.encode() for name in names}))
    assert [photo.relative_path for photo, _ in found] == ["outside.jpg", "up.jpg"]
    assert not (path.parent.parent / "up.jpg").exists()


def test_a_zip_whose_names_are_utf_8_without_the_flag_is_read(path: Path) -> None:
    data = zip_of({"ü.jpg": b"named"})
    at = data.index(b"PK\x01\x02") + 8
    data = data[:6] + b"\0\0" + data[8:at] + b"\0\0" + data[at + 2 :]
    [(photo, _)] = found_in(path, data)
    assert photo.relative_path == "ü.jpg"
    latin = data.replace("ü.jpg".encode(), b"a\x81.jpg")
    [(photo, _)] = found_in(path, latin)
    assert photo.relative_path == "aü.jpg"


# --- metadata ----------------------------------------------------------------------------------


@every_kind
def test_fields_come_from_the_name_the_table_inside_and_the_csv(
    path: Path, packed: Callable[[Any], bytes], tmp_path: Path
) -> None:
    named = "city/@0396544.00@4991543.00@32@T@45.0691@7.6931@@@@@@@@@.jpg"
    members = {
        "city/photos.csv": b'filename,latitude,longitude,tags\nin/2.jpg,45.5,7.25,"a,b"\n',
        "city/in/photos.csv": b"filename\nnothing.jpg\n",
        "city/in/2.jpg": b"two",
        named: b"three",
    }
    found = found_in(path, packed(members))
    fields = {photo.relative_path: photo.fields for photo, _ in found}
    expected = {"latitude": "45.5", "longitude": "7.25", "tags": "a,b"}
    assert fields["city/in/2.jpg"] == expected
    assert float(fields[named]["latitude"]) == 45.0691
    table = tmp_path / "places.csv"
    table.write_text("filename,place,tags\ncity/in/2.jpg,hall,c\n")
    found = found_in(path, packed(members), table)
    fields = {photo.relative_path: photo.fields for photo, _ in found}
    assert fields["city/in/2.jpg"] == {**expected, "place": "hall", "tags": "c"}


def test_a_manifest_inside_gives_any_field_of_an_upload(path: Path) -> None:
    line = b'{"filename": "./a.jpg", "role": "query", "metadata": {"floor": 2}}\n'
    [(photo, _)] = found_in(path, zip_of({"x/manifest.jsonl": line, "x/a.jpg": b"x"}))
    assert photo.fields == {"role": "query", "metadata": '{"floor": 2}'}


def test_the_place_of_a_photo_is_its_folder_in_the_archive(
    path: Path, stack: contextlib.ExitStack
) -> None:
    path.write_bytes(zip_of({"rooms/hall/1.jpg": b"x", "2.jpg": b"x"}))
    source = LocalSource.open(path, stack)
    photos = find_photos(source.path, None, None, places_by_folder=True)
    assert [photo.fields for photo in photos] == [{}, {"place": "hall"}]


@pytest.mark.parametrize(
    ("members", "code"),
    [
        ({"readme.txt": b"hello", "folder/": b""}, "no_photos"),
        ({}, "no_photos"),
        ({"a.jpg": b"x", "photos.csv": b"latitude,longitude\n1,2\n"}, "bad_table"),
        ({"a.jpg": b"x", "photos.csv": b"file,place\nb.jpg,hall\n"}, "bad_table"),
        ({"a.jpg": b"x", "manifest.jsonl": b'{"file": "a.jpg"}\noops'}, "bad_manifest"),
        ({"a.jpg": b"x", "manifest.jsonl": b"", "photos.csv": b"file\n"}, "several_manifests"),
    ],
)
def test_an_archive_that_makes_no_sense_is_refused_as_a_whole(
    path: Path, members: dict[str, bytes], code: str
) -> None:
    assert refused(path, zip_of(members)).code == code


# --- damaged and hostile archives --------------------------------------------------------------


@every_kind
@pytest.mark.parametrize("keep", [0.3, 0.7, 0.85])
def test_an_archive_that_was_cut_off_is_refused(
    path: Path, packed: Callable[[Any], bytes], keep: float
) -> None:
    archive = packed({f"{number}.jpg": os.urandom(20_000) for number in range(5)})
    error = refused(path, archive[: int(len(archive) * keep)])
    assert isinstance(error, InvalidRequest)
    assert error.code == "unreadable_file"


def edited(archive: bytes, at: int, data: bytes) -> bytes:
    return archive[:at] + data + archive[at + len(data) :]


def entry_of(archive: bytes) -> int:
    """Where the directory's first entry stands."""
    return archive.index(b"PK\x01\x02")


def test_an_archive_with_a_photo_that_can_not_be_read_is_refused(path: Path) -> None:
    archive = zip_of({"bad.jpg": os.urandom(1000), "good.jpg": b"good"}, zipfile.ZIP_STORED)
    for data in (
        edited(archive, 500, b"\x55\xaa\x55\xaa"),
        edited(edited(archive, 6, b"\x01"), entry_of(archive) + 8, b"\x01"),  # encrypted
        edited(archive, entry_of(archive) + 42, struct.pack("<L", 0xFFFF_FFFE)),
        edited(archive, entry_of(archive) + 10, b"\x63"),  # an unknown compression
    ):
        error = refused(path, data)
        assert error.code == "unreadable_file"
        assert "Unpack it and index the folder" in error.detail


@pytest.mark.parametrize(
    "kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE]
)
def test_links_and_devices_in_a_tar_are_left_out(path: Path, kind: bytes) -> None:
    info = tarfile.TarInfo("a.jpg")
    info.type, info.linkname = kind, "/etc/passwd"
    with tarfile.open(path, "w") as archive:
        archive.addfile(info)
        archive.addfile(tarfile.TarInfo("b.jpg"))
    assert [photo.relative_path for photo, _ in found_in(path, path.read_bytes())] == ["b.jpg"]


def test_a_link_in_a_zip_is_not_followed(path: Path) -> None:
    link = zipfile.ZipInfo("a.jpg")
    link.create_system, link.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(link, "/etc/passwd")
    [(_, data)] = found_in(path, path.read_bytes())
    assert data == b"/etc/passwd"


def test_a_photo_is_read_no_further_than_it_declares(path: Path) -> None:
    """The bomb that lies: it says 10 bytes, and has 50 million."""
    archive = zip_of({"a.jpg": bytes(50_000_000)})
    error = refused(path, edited(archive, entry_of(archive) + 24, struct.pack("<L", 10)))
    assert error.code == "unreadable_file"


def header(name: bytes, size: bytes) -> bytes:
    """A tar's header with any text for its size."""
    block = bytearray(512)
    block[: len(name)] = name
    block[124 : 124 + len(size)] = size
    block[156:157] = b"0"
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


@pytest.mark.parametrize(
    "size", [b"\x80" + b"\x7f" * 11, b"\xff" * 12, b"-1\0", b"nonsense\0", b"77777777777\0"]
)
@pytest.mark.parametrize("gzipped", [False, True])
def test_sizes_that_can_not_be_true_are_refused(path: Path, size: bytes, gzipped: bool) -> None:
    archive = header(b"a.jpg", size) + bytes(2048)
    error = refused(path, gzip.compress(archive) if gzipped else archive)
    assert error.code == "unreadable_file"


@pytest.mark.parametrize("seed", range(40))
def test_noise_in_an_archive_ends_in_an_error_or_in_photos(path: Path, seed: int) -> None:
    rng = random.Random(seed)
    kinds = list(PACKED.values())
    archive = bytearray(kinds[seed % len(kinds)]({"a.jpg": b"abc" * 500, "b/c.png": b"d"}))
    for _ in range(rng.randint(1, 30)):
        archive[rng.randrange(4, len(archive))] = rng.randrange(256)
    with contextlib.suppress(PlacewiseError):
        found = found_in(path, bytes(archive))
        assert sum(len(data) for _, data in found) <= len(archive) + 1500
