"""What an interrupted `placewise index` has done already: `--journal FILE`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from services.cli.output import printable_path
from services.cli.photo_places import LocalPhoto
from shared.errors import InvalidRequest, Misconfigured

JOURNAL_FORMAT = 1


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """A photo that the server has taken."""

    file_id: str
    job_id: str | None


class UploadJournal:
    """One line for each photo that was taken, written when the server has said so.

    A photo counts as done if its file has the size and the time of last change that it had then,
    and the same is said of it. A last line that a kill has cut off is passed over. It belongs to
    one server and one map: InvalidRequest (`bad_journal`) for another one's, or what is no journal.
    """

    def __init__(self, path: Path, url: str, map_name: str | None) -> None:
        self._path = path
        self._done: dict[str, dict[str, Any]] = {}
        about = {"placewise_journal": JOURNAL_FORMAT, "server": url, "map": map_name}
        try:
            text = path.read_text() if path.exists() else ""
            self._read(text, about)
            self._file = path.open("a")
            if not text:
                self._write(about)
            elif not text.endswith("\n"):
                self._file.write("\n")  # after a line that was cut off
        except (OSError, UnicodeDecodeError) as error:
            raise Misconfigured(
                "out_unwritable", f"The journal {printable_path(path)} can't be used: {error}."
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def done(self, photo: LocalPhoto) -> JournalEntry | None:
        """What the server has answered, if the photo was taken as it is now."""
        line = self._done.get(printable_path(photo.path))
        if line is None or line["state"] != _file_state(photo):
            return None  # a file that is gone says so when it is sent
        return JournalEntry(line["file_id"], line["job_id"])

    def add(self, photo: LocalPhoto, acknowledged: JournalEntry) -> None:
        self._write(
            {
                "path": printable_path(photo.path),
                "state": _file_state(photo),
                "file_id": acknowledged.file_id,
                "job_id": acknowledged.job_id,
            }
        )

    def _write(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()

    def _read(self, text: str, about: dict[str, Any]) -> None:
        lines = []
        for line in text.splitlines():
            try:
                lines.append(json.loads(line))
            except ValueError:
                continue  # cut off by a kill
        if not text:
            return
        if not lines or lines[0] != about:
            raise InvalidRequest(
                "bad_journal",
                f"{printable_path(self._path)} is no journal of this server and map. Name another file.",
            )
        self._done = {line["path"]: line for line in lines[1:]}


def _file_state(photo: LocalPhoto) -> list[Any]:
    """What makes the photo another one, as JSON."""
    try:
        about = photo.path.stat()
    except OSError:
        return []
    return [about.st_size, about.st_mtime_ns, photo.name, dict(sorted(photo.fields.items()))]
