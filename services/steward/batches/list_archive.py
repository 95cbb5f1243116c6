"""From an archive to the items of a batch: its photos, with what its table says of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from services.steward.archives import Archive, Member
from services.steward.archives.member import MemberKind
from shared.datasets.utm_names import fields_of_name
from shared.errors import (
    InvalidRequest,
    PlacewiseError,
    TooLarge,
    Unprocessable,
    UnsupportedMedia,
)
from shared.intake.manifest import (
    MAX_MANIFEST_BYTES,
    MOST_NAMED,
    Said,
    bad_lines,
    read_csv,
    read_jsonl,
)
from shared.jobs import JobState
from shared.photo_formats import PHOTO_SUFFIXES

TABLE, MANIFEST = "photos.csv", "manifest.jsonl"
# Archives inside of archives.
ARCHIVE_SUFFIXES = {".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst", ".7z", ".rar"}
MAX_LABEL_CHARACTERS = 1000


@dataclass(slots=True)
class Listing:
    items: list[dict[str, Any]] = field(default_factory=list)
    """Columns of BatchItem."""
    ignored: int = 0
    """Members that are no photos and were not meant to be: folders, texts, what systems leave."""


def list_archive(archive: Archive) -> Listing:
    """What of the archive is to be brought in.

    Raises what `Archive.members` does, and Unprocessable or InvalidRequest: `no_photos`,
    `bad_table`, `bad_manifest`, `several_manifests`.
    """
    listing = Listing()
    photos: list[tuple[str, Member]] = []
    tables: list[tuple[str, Member]] = []
    for member in archive.members():
        name = _label(member.name)
        path = PurePosixPath(name)
        if _is_clutter(path) or member.kind == MemberKind.FOLDER:
            listing.ignored += 1
        elif path.name in (TABLE, MANIFEST):
            tables.append((name, member))
        elif path.suffix.lower() in PHOTO_SUFFIXES | ARCHIVE_SUFFIXES:
            photos.append((name, member))
        else:
            listing.ignored += 1
    if not photos:
        raise Unprocessable(
            "no_photos", f"The archive has no photo ({', '.join(sorted(PHOTO_SUFFIXES))}) in it."
        )
    said = _read_table(archive, tables, {name for name, _ in photos})
    listing.items = list(_items(photos, said))
    return listing


def _label(name: str) -> str:
    """What the member is called: for people, and for its line in the table. No path to anything."""
    kept = "".join(c for c in name.replace("\\", "/") if c.isprintable())
    return kept.removeprefix("./")[:MAX_LABEL_CHARACTERS] or "photo"


def _is_clutter(path: PurePosixPath) -> bool:
    """What macOS and others leave behind: `__MACOSX/`, `._a.jpg`, `.DS_Store`, `.git/`."""
    return any(
        part == "__MACOSX" or (part.startswith(".") and part not in (".", ".."))
        for part in path.parts
    )


def _read_table(
    archive: Archive, tables: list[tuple[str, Member]], names: set[str]
) -> dict[str, Said]:
    """What the outermost table says, by the photos' names."""
    if not tables:
        return {}
    depth = min(name.count("/") for name, _ in tables)
    outermost = [(name, member) for name, member in tables if name.count("/") == depth]
    if len(outermost) > 1:
        raise InvalidRequest(
            "several_manifests",
            f"The archive has {' and '.join(name for name, _ in outermost[:5])}: leave one.",
        )
    [(called, member)] = outermost
    if member.size_bytes > MAX_MANIFEST_BYTES:
        raise TooLarge("manifest_too_large", f"{called} is larger than {MAX_MANIFEST_BYTES} bytes.")
    data = b"".join(archive.read(member))
    is_table = called.endswith(TABLE)
    lines = read_csv(data, called) if is_table else read_jsonl(data, called)
    # Names in it are relative to where it lies: people pack a folder as a whole.
    folder = called[: called.rfind("/") + 1]
    said = {folder + _label(line.name): line for line in lines}
    strange = [
        (line.line, f"the archive has no photo {name!r}")
        for name, line in said.items()
        if name not in names
    ]
    if strange:
        code = "bad_table" if is_table else "bad_manifest"
        raise bad_lines(code, called, strange[:MOST_NAMED])
    return said


def _items(photos: list[tuple[str, Member]], said: dict[str, Said]) -> Iterator[dict[str, Any]]:
    times = Counter(name for name, _ in photos)
    for name, member in photos:
        line = said.get(name)
        item: dict[str, Any] = {
            "name": name,
            "source": place_of(member),
            "line": line.line if line else None,
        }
        try:
            item["fields"] = _check(name, member, line, times[name])
        except PlacewiseError as error:
            item |= {"state": JobState.FAILED, "error": error.as_problem()}
        yield item


def _check(name: str, member: Member, line: Said | None, times: int) -> dict[str, str]:
    """What is said of the photo; raises why it can't be brought in, as far as that can be told."""
    if member.fault is not None:
        raise member.fault
    path = PurePosixPath(name)
    if path.suffix.lower() in ARCHIVE_SUFFIXES:
        raise UnsupportedMedia(
            "nested_archive", "An archive inside of an archive is not unpacked: upload it itself."
        )
    if line is not None and times > 1:
        raise Unprocessable(
            "ambiguous_name",
            f"{times} photos of the archive are called {name!r}, and line {line.line} of its table "
            "does not say which of them it means.",
        )
    return {**fields_of_name(path.name, None), **(line.fields if line else {})}


def place_of(member: Member) -> dict[str, Any]:
    """What is kept of a member to find it again: `member_at` reads it."""
    return {
        "offset": member.offset,
        "size_bytes": member.size_bytes,
        "packed_bytes": member.packed_bytes,
        "method": member.method,
        "crc32": member.crc32,
    }


def member_at(name: str, place: dict[str, Any]) -> Member:
    """The member that `place_of` has kept."""
    return Member(name=name, kind=MemberKind.FILE, **place)
