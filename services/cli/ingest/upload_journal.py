"""The journal of `placewise index --journal FILE`: the uploads that a server has acknowledged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Self

from placewise.answers import Uploaded
from services.cli.ingest.geotags import LocalPhoto
from services.cli.output import Json, printable_path, utf8_path
from shared.errors import InvalidRequest, Misconfigured

JOURNAL_FORMAT = 1


class UploadJournal:
    """A JSONL file with one line per photo, appended when the server acknowledges the upload.

    A photo counts as uploaded while the size and modification time of its file (or of its archive)
    and its metadata are unchanged. An incomplete last line, left by a killed process, is ignored. A
    journal belongs to one server and one map.

    Raises:
        InvalidRequest: `bad_journal` if the file is not a journal of this server and map.
        Misconfigured: `out_unwritable` if the file can't be read or written.
    """

    def __init__(self, path: Path, url: str, map_name: str | None) -> None:
        header = {"placewise_journal": JOURNAL_FORMAT, "server": url, "map": map_name}
        try:
            text = path.read_text() if path.exists() else ""
            lines = _parse_lines(text)
            if text and (not lines or lines[0] != header):
                raise InvalidRequest(
                    "bad_journal",
                    f"{printable_path(path)} is not a journal of this server and map. Use another "
                    "file.",
                )
            self._done = {line["path"]: line for line in lines[1:]}
            self._file = path.open("a")
            if not text:
                self._write(header)
            elif not text.endswith("\n"):
                self._file.write("\n")  # ends an incomplete last line
        except (OSError, UnicodeDecodeError) as error:
            raise Misconfigured(
                "out_unwritable", f"Can't use the journal {printable_path(path)}: {error}."
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def done(self, photo: LocalPhoto) -> Json | None:
        """Return `file_id` and `job_id` of the recorded upload; None for a new or changed photo."""
        line = self._done.get(utf8_path(photo.path))
        if line is None or line["state"] != _file_state(photo):
            return None  # a missing file is reported by the upload itself
        return line

    def add(self, photo: LocalPhoto, uploaded: Uploaded) -> None:
        """Record an acknowledged upload."""
        ids = uploaded.model_dump(mode="json", include={"file_id", "job_id"})
        self._write({"path": utf8_path(photo.path), "state": _file_state(photo), **ids})

    def _write(self, line: Json) -> None:
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()


def _parse_lines(text: str) -> list[Json]:
    lines = []
    for line in text.splitlines():
        try:
            lines.append(json.loads(line))
        except ValueError:
            continue  # incomplete: the process was killed while writing it
    return lines


def _file_state(photo: LocalPhoto) -> list[Any]:
    """The file attributes and metadata whose change requires a new upload, as JSON."""
    try:
        stat = photo.file.stat()
    except OSError:
        return []
    return [stat.st_size, stat.st_mtime_ns, photo.name, dict(sorted(photo.fields.items()))]
