"""Reader for the photos of a zip or tar on this machine, which is never unpacked to disk."""

from __future__ import annotations

import contextlib
import io
import stat
import tarfile
import unicodedata
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Self, cast

from services.cli.ingest.local_headers import SIDECAR_SUFFIX, sidecar_names
from services.cli.output import printable_path
from shared.errors import InvalidRequest, PlacewiseError, TooLarge
from shared.imaging.bounded_reader import MAX_METADATA_BYTES
from shared.imaging.file_formats import PHOTO_SUFFIXES
from shared.ingest.photo_metadata import (
    MAX_MANIFEST_BYTES,
    MAX_REPORTED_LINES,
    bad_lines_error,
    parse_relative_path,
    read_csv_manifest,
    read_jsonl_manifest,
)

TABLE_NAME, MANIFEST_NAME = "photos.csv", "manifest.jsonl"
MAX_PHOTO_BYTES = 1024**3  # a photo is read into memory
ZIP_UTF8_FLAG = 0x0800
UNIX = 3  # `create_system` of a zip's member whose attributes are a Unix file mode

# What the standard library raises for content that it can't read, or that is encrypted.
READ_ERRORS = (
    EOFError,
    OSError,
    RuntimeError,
    ValueError,
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
)


@dataclass(frozen=True, slots=True)
class ArchivedFile:
    """A file in an archive."""

    archive: PhotoArchive
    name: str
    """Its path in the archive, without drives, `..` and unprintable characters: a label."""
    info: zipfile.ZipInfo | tarfile.TarInfo

    def read(self) -> bytes:
        """Return its bytes.

        Raises:
            InvalidRequest: `unreadable_file` if it is damaged, encrypted, or no regular file.
            TooLarge: `file_too_large` for more than MAX_PHOTO_BYTES.
        """
        size = self.info.size if isinstance(self.info, tarfile.TarInfo) else self.info.file_size
        if size > MAX_PHOTO_BYTES:
            raise TooLarge("file_too_large", f"{self.name} is larger than {MAX_PHOTO_BYTES} bytes.")
        if _is_link_or_device(self.info):
            raise InvalidRequest("unreadable_file", f"{self.name} is not a regular file.")
        with _convert_read_errors(self.name, "Unpack the archive and index the folder."):
            return self.archive.read(self.info)

    def read_sidecars(self) -> dict[str, bytes]:
        """Return the XMP sidecars of a photo by path; one that can't be read is empty."""
        folder, slash, name = self.name.rpartition("/")
        found = {}
        for each in sidecar_names(name):
            file = self.archive.sidecars.get(f"{folder}{slash}{each}")
            if file is not None:
                found[f"{self.archive.path}/{file.name}"] = b""
                with contextlib.suppress(PlacewiseError):
                    found[f"{self.archive.path}/{file.name}"] = file.read()[:MAX_METADATA_BYTES]
        return found


class PhotoArchive:
    """The photos of a zip or tar; a context manager that keeps it open."""

    def __init__(self, path: Path) -> None:
        """Open the archive and list its members.

        Raises:
            InvalidRequest: `unreadable_file` if it is damaged; `no_photos`.
        """
        self.path = path
        self.photos: list[ArchivedFile] = []
        """In the order of the archive: reading them in another one is slow for a gzipped tar."""
        self.other_files: Counter[str] = Counter()
        """Number of files that are no photos by their suffix; hidden ones are left out."""
        self.sidecars: dict[str, ArchivedFile] = {}
        """XMP by name, also counted among `other_files`"""
        self._tables: list[ArchivedFile] = []
        with _convert_read_errors(printable_path(path), "Create the archive again."):
            self._file = _open(path)
            try:
                self._list_members()
            except BaseException:
                self._file.close()
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, info: zipfile.ZipInfo | tarfile.TarInfo) -> bytes:
        """Return the bytes of a member, as many as it declares."""
        if isinstance(self._file, zipfile.ZipFile):
            # `ZipFile.read` would decompress more than declared before it notices.
            with self._file.open(zip_info := cast("zipfile.ZipInfo", info)) as file:
                return file.read(zip_info.file_size + 1)
        stream = self._file.extractfile(cast("tarfile.TarInfo", info))
        assert stream is not None, "the member is a regular file"
        return stream.read()

    def table_fields(self) -> dict[str, dict[str, str]]:
        """Return the metadata of the archive's own table, `photos.csv` or `manifest.jsonl`.

        Of several tables the outermost one is read. Names in it are relative to its folder.

        Returns:
            Form fields of `POST /upload` by the name of the photo.

        Raises:
            InvalidRequest: `bad_table` or `bad_manifest`, also for photos that don't exist;
                `several_manifests`.
            TooLarge: `manifest_too_large`.
        """
        if not self._tables:
            return {}
        depth = min(table.name.count("/") for table in self._tables)
        [table, *others] = [each for each in self._tables if each.name.count("/") == depth]
        if others:
            names = ", ".join(each.name for each in (table, *others))
            raise InvalidRequest(
                "several_manifests", f"The archive has several tables: {names}. Remove all but one."
            )
        data = table.read()
        if len(data) > MAX_MANIFEST_BYTES:
            raise TooLarge(
                "manifest_too_large", f"{table.name} is larger than {MAX_MANIFEST_BYTES} bytes."
            )
        is_csv = table.name.endswith(TABLE_NAME)
        entries = (read_csv_manifest if is_csv else read_jsonl_manifest)(data, table.name)
        folder = PurePosixPath(table.name).parent
        fields = {}
        missing = []
        # Archives of macOS have decomposed names; tables are often typed elsewhere.
        photos = {unicodedata.normalize("NFC", photo.name): photo.name for photo in self.photos}
        for entry in entries:
            name = parse_relative_path(str(folder / entry.name)) or ""
            found = photos.get(unicodedata.normalize("NFC", name))
            if found is None:
                missing.append((entry.line, f"photo {name} does not exist"))
            else:
                fields[found] = entry.fields
        if missing:
            code = "bad_table" if is_csv else "bad_manifest"
            raise bad_lines_error(code, table.name, missing[:MAX_REPORTED_LINES])
        return fields

    def _list_members(self) -> None:
        for info in self._members():
            raw_name = _zip_name(info) if isinstance(info, zipfile.ZipInfo) else info.name
            name = parse_relative_path(raw_name)
            if name is None or raw_name.endswith("/") or _is_system_file(name):
                continue
            suffix = PurePosixPath(name).suffix.lower()
            file = ArchivedFile(self, name, info)
            if PurePosixPath(name).name in (TABLE_NAME, MANIFEST_NAME):
                self._tables.append(file)
            elif suffix in PHOTO_SUFFIXES:
                self.photos.append(file)
            else:
                self.other_files[suffix] += 1
                if suffix == SIDECAR_SUFFIX:
                    self.sidecars[name] = file
        if not self.photos:
            raise InvalidRequest(
                "no_photos",
                f"No photos ({', '.join(sorted(PHOTO_SUFFIXES))}) found in "
                f"{printable_path(self.path)}.",
            )

    def _members(self) -> Iterator[zipfile.ZipInfo | tarfile.TarInfo]:
        if isinstance(self._file, zipfile.ZipFile):
            yield from self._file.infolist()
            return
        for info in self._file:
            if info.size < 0:  # `tarfile` would read the same members for ever
                raise tarfile.ReadError("a member declares a negative size")
            if not info.isdir():
                yield info
        # `tarfile` takes a damaged or missing header for the end of the archive.
        stream = cast("io.BufferedIOBase", self._file.fileobj)
        stream.seek(self._file.offset)
        if stream.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
            raise tarfile.ReadError(f"no header and no end at byte {self._file.offset}")


def is_archive(path: Path) -> bool:
    """Return whether a file is a zip or tar by its content, also a compressed tar."""
    try:
        return path.is_file() and (zipfile.is_zipfile(path) or tarfile.is_tarfile(path))
    except READ_ERRORS:
        return False


def _open(path: Path) -> zipfile.ZipFile | tarfile.TarFile:
    if zipfile.is_zipfile(path):
        return zipfile.ZipFile(path)
    return tarfile.open(path, encoding="utf-8", errors="replace")


def _zip_name(info: zipfile.ZipInfo) -> str:
    # Many zips have UTF-8 names without the flag; by APPNOTE.TXT 4.4.4 that is code page 437.
    if not info.flag_bits & ZIP_UTF8_FLAG:
        with contextlib.suppress(UnicodeError):
            return info.filename.encode("cp437").decode("utf-8")
    return info.filename


def _is_system_file(name: str) -> bool:
    """Return whether it is hidden or made by macOS: `__MACOSX/`, `._a.jpg`, `.git/`."""
    return any(part == "__MACOSX" or part.startswith(".") for part in name.split("/"))


def _is_link_or_device(info: zipfile.ZipInfo | tarfile.TarInfo) -> bool:
    if isinstance(info, tarfile.TarInfo):
        return not info.isreg()
    return info.create_system == UNIX and stat.S_ISLNK(info.external_attr >> 16)


@contextlib.contextmanager
def _convert_read_errors(name: str, advice: str) -> Iterator[None]:
    try:
        yield
    except READ_ERRORS as error:
        raise InvalidRequest("unreadable_file", f"Can't read {name}: {error}. {advice}") from None
