"""Archives: what honest ones give, and that hostile ones end in a clear error, soon."""

from __future__ import annotations

import gzip
import io
import os
import random
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import pytest

from services.steward.archives.archive import (
    ArchiveLimits,
    ArchiveMember,
    BoundedFile,
    MemberKind,
    RangedFile,
)
from services.steward.archives.readers import ZipArchive, open_archive
from shared.errors import Gone, PlacewiseError
from shared.imaging.file_formats import ArchiveFormat, detect_archive_format
from shared.storage import FolderStore
from tests.support.archives import PACKED, tar_of, tar_with, zip_of

LIMITS = ArchiveLimits(members=100, unpacked_bytes=50_000_000)
KEY = "archives/a"
MEMBERS = {
    "a.jpg": os.urandom(700_000),
    "in/b.png": b"compressible " * 50_000,
    "empty.jpg": b"",
    "ünï/日本.jpg": b"named",
}
every_kind = pytest.mark.parametrize("packed", PACKED.values(), ids=PACKED.keys())


def contents(
    store: FolderStore, archive: bytes, limits: ArchiveLimits = LIMITS
) -> dict[str, bytes]:
    store.put(KEY, archive)
    opened = open_archive(store, KEY, limits)
    members = list(opened.members())
    return {member.name: b"".join(opened.read(member)) for member in members}


def refused(store: FolderStore, archive: bytes, limits: ArchiveLimits = LIMITS) -> PlacewiseError:
    with pytest.raises(PlacewiseError) as caught:
        contents(store, archive, limits)
    return caught.value


def listed(store: FolderStore, archive: bytes) -> list[ArchiveMember]:
    store.put(KEY, archive)
    return list(open_archive(store, KEY, LIMITS).members())


@every_kind
def test_members_are_given_whole_and_in_order(
    store: FolderStore, packed: Callable[[Any], bytes]
) -> None:
    found = contents(store, packed(MEMBERS))
    assert list(found) == list(MEMBERS)
    assert found == MEMBERS


@every_kind
def test_each_member_is_found_again_by_its_place_alone(
    store: FolderStore, packed: Callable[[Any], bytes]
) -> None:
    members = listed(store, packed(MEMBERS))
    for member in reversed(members):
        again = open_archive(store, KEY, LIMITS)
        assert b"".join(again.read(member)) == MEMBERS[member.name]


@pytest.mark.parametrize(
    ("archive", "found"),
    [
        (zip_of({"a": b"x"}), ArchiveFormat.ZIP),
        (zip_of({}), ArchiveFormat.ZIP),
        (tar_of({"a": b"x"}), ArchiveFormat.TAR),
        (tar_of({"a": b"x"}, form=tarfile.GNU_FORMAT), ArchiveFormat.TAR),
        (tar_of({"a": b"x"}, "w:gz"), ArchiveFormat.GZIP),
        (b"PK is how this text begins" * 100, None),
        (b"", None),
        (bytes(1024), None),
        (tar_of({"a": b"x"}, "w:xz"), None),
    ],
    ids=["zip", "empty zip", "tar", "gnu tar", "gzip", "text", "nothing", "zeros", "xz"],
)
def test_an_archive_is_detected_by_its_content(archive: bytes, found: ArchiveFormat | None) -> None:
    assert detect_archive_format(archive[:512]) == found


def test_a_missing_archive_and_a_file_of_another_format_are_errors(store: FolderStore) -> None:
    with pytest.raises(Gone) as caught:
        open_archive(store, "archives/nothing", LIMITS)
    assert caught.value.code == "archive_gone"
    assert refused(store, b"just a text" * 100).code == "unsupported_archive"
    assert refused(store, gzip.compress(b"just a text" * 100)).code == "damaged_archive"


@every_kind
def test_names_that_lead_elsewhere_are_only_names(
    store: FolderStore, packed: Callable[[Any], bytes]
) -> None:
    names = ["/etc/passwd.jpg", "../../up.jpg", "C:\\windows.jpg", "twice.jpg"]
    found = [member.name for member in listed(store, packed([(n, n.encode()) for n in names]))]
    assert found == names
    assert {path.name for path in store.root.rglob("*") if path.is_file()} == {"a"}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@every_kind
def test_a_name_may_stand_there_twice(store: FolderStore, packed: Callable[[Any], bytes]) -> None:
    store.put(KEY, packed([("a.jpg", b"one"), ("a.jpg", b"two")]))
    opened = open_archive(store, KEY, LIMITS)
    assert [b"".join(opened.read(member)) for member in opened.members()] == [b"one", b"two"]


@every_kind
def test_more_members_than_allowed_are_refused(
    store: FolderStore, packed: Callable[[Any], bytes]
) -> None:
    archive = packed({f"{number}.jpg": b"x" for number in range(11)})
    error = refused(store, archive, ArchiveLimits(10, 10**6))
    assert error.code == "too_many_photos"
    assert "MAX_BATCH_PHOTOS" in error.detail
    assert len(contents(store, archive, ArchiveLimits(11, 10**6))) == 11


@pytest.mark.parametrize("kind", ["zip", "tar.gz"])
def test_a_bomb_is_refused_by_what_it_declares(store: FolderStore, kind: str) -> None:
    bomb = PACKED[kind]({f"{number}.jpg": bytes(3_000_000) for number in range(4)})
    assert len(bomb) < 100_000
    assert refused(store, bomb, ArchiveLimits(100, 10_000_000)).code == "batch_too_large"


@every_kind
@pytest.mark.parametrize("keep", [0.3, 0.7, 0.85])
def test_an_archive_that_was_cut_off_is_damaged(
    store: FolderStore, packed: Callable[[Any], bytes], keep: float
) -> None:
    archive = packed({f"{number}.jpg": os.urandom(20_000) for number in range(5)})
    error = refused(store, archive[: int(len(archive) * keep)])
    assert error.code == "damaged_archive"
    assert "upload it again" in error.detail


# --- zips --------------------------------------------------------------------------------------


def edited(archive: bytes, at: int, data: bytes) -> bytes:
    return archive[:at] + data + archive[at + len(data) :]


def entry_of(archive: bytes) -> int:
    """Where the directory's first entry stands."""
    return archive.index(b"PK\x01\x02")


def only(store: FolderStore, archive: bytes) -> PlacewiseError:
    """The error of the only member, which is listed."""
    [member] = listed(store, archive)
    with pytest.raises(PlacewiseError) as caught:
        b"".join(open_archive(store, KEY, LIMITS).read(member))
    return caught.value


def test_a_zip_that_unpacks_itself_is_read_behind_its_program(store: FolderStore) -> None:
    program = b"#!/bin/sh\n" + bytes(5000)
    store.put(KEY, zip_of(MEMBERS))
    shifted = program + zip_of(MEMBERS)
    # It begins with the program, so only an archive that is known to be one is read like this.
    store.put(KEY, shifted)
    opened = ZipArchive(BoundedFile(RangedFile(store, KEY, len(shifted))), len(shifted), LIMITS)
    assert {m.name: b"".join(opened.read(m)) for m in opened.members()} == MEMBERS


def test_a_zip_with_a_comment_and_zip64_members_is_read(store: FolderStore) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        with archive.open("a.jpg", "w", force_zip64=True) as member:
            member.write(b"large in principle")
        archive.comment = b"PK said the comment" * 100
    assert contents(store, buffer.getvalue()) == {"a.jpg": b"large in principle"}


def test_a_zip64_directory_is_read(store: FolderStore) -> None:
    """65,536 members is more than the old directory can count."""
    many = zip_of([(f"{number}", b"") for number in range(65_536)], zipfile.ZIP_STORED)
    store.put(KEY, many)
    opened = open_archive(store, KEY, ArchiveLimits(70_000, 10**6))
    assert sum(1 for _ in opened.members()) == 65_536
    with pytest.raises(PlacewiseError) as caught:
        list(open_archive(store, KEY, ArchiveLimits(65_535, 10**6)).members())
    assert caught.value.code == "too_many_photos"


def test_a_directory_of_many_bytes_is_refused_unread(store: FolderStore) -> None:
    """20 members, whose comments are most of it."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for number in range(20):
            member = zipfile.ZipInfo(f"{number}.jpg")
            member.comment = bytes(65_000)
            archive.writestr(member, b"x")
    error = refused(store, buffer.getvalue(), ArchiveLimits(20, 10**6))
    assert error.code == "too_many_photos"
    assert "directory" in error.detail


def test_a_zip_without_members_has_none(store: FolderStore) -> None:
    assert contents(store, zip_of({})) == {}


def test_an_encrypted_member_is_named_as_such(store: FolderStore) -> None:
    archive = zip_of({"a.jpg": b"x" * 100})
    flags = entry_of(archive) + 8
    assert only(store, edited(archive, flags, b"\x01\x00")).code == "encrypted_member"


def test_a_member_packed_in_another_way_says_which_are_read(store: FolderStore) -> None:
    error = only(store, zip_of({"a.jpg": b"x" * 100}, zipfile.ZIP_LZMA))
    assert error.code == "unsupported_member"
    assert "deflated" in error.detail


def test_a_link_in_a_zip_is_no_file(store: FolderStore) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        link = zipfile.ZipInfo("a.jpg")
        link.create_system = 3
        link.external_attr = 0o120777 << 16
        archive.writestr(link, "/etc/passwd")
    [member] = listed(store, buffer.getvalue())
    assert member.kind == MemberKind.OTHER
    assert only(store, buffer.getvalue()).code == "unsupported_member"


def test_a_member_whose_bytes_were_changed_is_damaged(store: FolderStore) -> None:
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        archive = zip_of({"a.jpg": os.urandom(1000)}, method)
        assert only(store, edited(archive, 500, b"\x55\xaa\x55\xaa")).code == "damaged_member"


def test_a_member_is_read_no_further_than_it_declares(store: FolderStore) -> None:
    """The bomb that lies: it says 10 bytes, and has 50 million."""
    archive = zip_of({"a.jpg": bytes(50_000_000)})
    lying = edited(archive, entry_of(archive) + 24, struct.pack("<L", 10))
    [member] = listed(store, lying)
    pieces = open_archive(store, KEY, LIMITS).read(member)
    with pytest.raises(PlacewiseError) as caught:
        next(pieces)
    assert caught.value.code == "damaged_member"


def test_members_that_share_their_bytes_are_refused(store: FolderStore) -> None:
    """The overlapping bomb: every entry of the directory means the same large member."""
    data = os.urandom(10_000)
    archive = zip_of([(f"{number:02}.jpg", data if number == 0 else b"") for number in range(50)])
    begin = archive.index(b"PK\x01\x02")
    end = archive.rindex(b"PK\x05\x06")
    entries, size = archive[begin:end], (end - begin) // 50
    shared = b"".join(
        entries[:46] + entries[number * size + 46 : (number + 1) * size] for number in range(50)
    )
    error = refused(store, archive[:begin] + shared + archive[end:])
    assert error.code == "damaged_archive"
    assert "overlap" in error.detail


def test_a_directory_that_says_it_is_short_is_counted_all_the_same(store: FolderStore) -> None:
    archive = zip_of([(f"{number}.jpg", b"") for number in range(200)])
    end = archive.rindex(b"PK\x05\x06")
    lying = edited(archive, end + 8, struct.pack("<2H", 1, 1))
    assert refused(store, lying).code == "too_many_photos"


@pytest.mark.parametrize("offset", [1, 0x1000_0000, 0xFFFF_FFFE])
def test_a_member_that_is_not_where_it_should_be_is_damaged(
    store: FolderStore, offset: int
) -> None:
    archive = zip_of({"a.jpg": b"x" * 100})
    lying = edited(archive, entry_of(archive) + 42, struct.pack("<L", offset))
    assert only(store, lying).code == "damaged_member"


@pytest.mark.parametrize("seed", range(40))
def test_noise_in_an_archive_ends_in_an_error_or_in_members(store: FolderStore, seed: int) -> None:
    rng = random.Random(seed)
    kinds = list(PACKED.values())
    archive = bytearray(kinds[seed % len(kinds)]({"a.jpg": b"abc" * 500, "b/c.png": b"d"}))
    for _ in range(rng.randint(1, 30)):
        archive[rng.randrange(4, len(archive))] = rng.randrange(256)
    store.put(KEY, bytes(archive))
    try:
        opened = open_archive(store, KEY, LIMITS)
        for member in opened.members():
            try:
                assert len(b"".join(opened.read(member))) <= LIMITS.unpacked_bytes
            except PlacewiseError as error:
                assert error.status < 500  # noqa: PT017  (either is fine)
    except PlacewiseError as error:
        assert error.status < 500  # noqa: PT017


# --- tars --------------------------------------------------------------------------------------


def info(name: str, kind: bytes = tarfile.REGTYPE, **columns: Any) -> tarfile.TarInfo:
    made = tarfile.TarInfo(name)
    made.type = kind
    for column, value in columns.items():
        setattr(made, column, value)
    return made


def test_links_and_devices_in_a_tar_are_no_files(store: FolderStore) -> None:
    kinds = [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE]
    archive = tar_with(
        *((info(f"{n}.jpg", kind, linkname="/etc/passwd"), b"") for n, kind in enumerate(kinds)),
        (info("folder", tarfile.DIRTYPE), b""),
        (info("last.jpg"), b"a file"),
    )
    members = listed(store, archive)
    assert [member.kind for member in members] == [
        *[MemberKind.OTHER] * 5,
        MemberKind.FOLDER,
        MemberKind.FILE,
    ]
    opened = open_archive(store, KEY, LIMITS)
    for member in members[:5]:
        with pytest.raises(PlacewiseError) as caught:
            b"".join(opened.read(member))
        assert caught.value.code == "unsupported_member"
    assert b"".join(opened.read(members[-1])) == b"a file"


@pytest.mark.parametrize("form", [tarfile.PAX_FORMAT, tarfile.GNU_FORMAT, tarfile.USTAR_FORMAT])
def test_long_names_are_read_in_every_dialect(store: FolderStore, form: int) -> None:
    name = "deep/" * 20 + "x" * 90 + ".jpg"
    if form != tarfile.USTAR_FORMAT:
        name = "deep/" * 50 + "ü" * 90 + ".jpg"
    found = contents(store, tar_of({name: b"one", "b.jpg": b"two"}, form=form))
    assert found == {name: b"one", "b.jpg": b"two"}


def header(name: bytes, size: bytes, kind: bytes = b"0") -> bytes:
    """A tar's header with any text for its size."""
    block = bytearray(512)
    block[: len(name)] = name
    block[124 : 124 + len(size)] = size
    block[156:157] = kind
    block[148:156] = b" " * 8
    block[148:156] = b"%06o\0 " % sum(block)
    return bytes(block)


@pytest.mark.parametrize(
    "size",
    [
        b"\x80" + b"\x7f" * 11,  # nearly 2^88 bytes
        b"\xff" * 12,  # minus one
        b"-1\0",
        b"nonsense\0",
        b"77777777777\0",  # 8 GiB
    ],
)
@pytest.mark.parametrize("gzipped", [False, True])
def test_sizes_that_can_not_be_true_end_it_at_once(
    store: FolderStore, size: bytes, gzipped: bool
) -> None:
    archive = header(b"a.jpg", size) + bytes(2048)
    error = refused(store, gzip.compress(archive) if gzipped else archive)
    assert error.code in ("damaged_archive", "batch_too_large")


@pytest.mark.parametrize("kind", [b"x", b"L"])
def test_a_header_of_many_megabytes_is_refused_unread(store: FolderStore, kind: bytes) -> None:
    large = 2 * 1024 * 1024
    archive = header(b"h", b"%011o" % large, kind) + bytes(large) + bytes(1024)
    assert refused(store, archive).code == "damaged_archive"


@pytest.mark.parametrize(
    "record", [b"0 path=a\n", b"999 path=a\n", b"x path=a\n", b"12 size=1x\n", b"5 a=\n9"]
)
def test_pax_headers_that_make_no_sense_are_refused_or_harmless(
    store: FolderStore, record: bytes
) -> None:
    """Newer releases of Python refuse more of them."""
    pax = header(b"p", b"%011o" % len(record), b"x") + record.ljust(512, b"\0")
    try:
        found = contents(store, pax + header(b"a.jpg", b"0") + header(b"b", b"0") + bytes(1024))
    except PlacewiseError as error:
        assert error.code == "damaged_archive"  # noqa: PT017  (either is fine)
    else:
        assert len(found) == 2
        assert found["b"] == b""


@pytest.mark.parametrize("count", [500, 5000])
def test_headers_without_members_are_refused(store: FolderStore, count: int) -> None:
    empty = header(b"h", b"0", b"g")
    assert refused(store, empty * count + bytes(1024)).code == "damaged_archive"


def test_a_sparse_file_with_headers_without_end_is_refused(store: FolderStore) -> None:
    """50 MB of them are 50 kB of a gzipped archive."""
    first = bytearray(header(b"a.jpg", b"0", b"S"))
    first[482] = 1  # more follow
    first[148:156] = b" " * 8
    first[148:156] = b"%06o\0 " % sum(first)
    more = (b"%011o\0" % 512) * 42 + b"\1" + bytes(7)
    archive = gzip.compress(bytes(first) + more * 100_000 + bytes(1024))
    error = refused(store, archive)
    assert error.code == "damaged_archive"
    assert "header is larger" in error.detail


def test_a_gzip_whose_checksum_is_wrong_is_damaged(store: FolderStore) -> None:
    archive = bytearray(tar_of({"a.jpg": os.urandom(5000)}, "w:gz"))
    archive[-8] ^= 1
    error = refused(store, bytes(archive))
    assert error.code == "damaged_archive"


def test_a_gzip_in_several_pieces_is_one(store: FolderStore) -> None:
    plain = tar_of({"a.jpg": os.urandom(5000), "b.jpg": b"b"})
    pieces = b"".join(gzip.compress(plain[at : at + 3000]) for at in range(0, len(plain), 3000))
    assert len(contents(store, pieces)) == 2


def test_a_bomb_that_hides_its_size_in_a_pax_header_is_refused(store: FolderStore) -> None:
    record = b"22 size=1000000000000\n"
    assert len(record) == 22
    pax = header(b"p", b"%011o" % len(record), b"x") + record.ljust(512, b"\0")
    archive = pax + header(b"a.jpg", b"0") + bytes(1024)
    for packed in (archive, gzip.compress(archive)):
        assert refused(store, packed).code == "batch_too_large"


def test_deflate_of_nothing_but_empty_blocks_ends(store: FolderStore) -> None:
    """A megabyte of packed bytes that unpack to none."""
    blocks = b"\x00\x00\x00\xff\xff" * 200_000 + zlib.compress(b"")[2:-4]
    archive = zip_of({"a.jpg": b"x" * len(blocks)}, zipfile.ZIP_STORED)
    at = archive.index(b"x" * 100)
    archive = edited(archive, at, blocks)
    archive = edited(archive, entry_of(archive) + 10, b"\x08\x00")
    assert only(store, archive).code == "damaged_member"
