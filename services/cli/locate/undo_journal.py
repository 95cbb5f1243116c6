"""The journal of `placewise locate --write`: every change of a file can be undone, byte by byte.

The folder `.placewise-locate` beside the photos holds the journal and the files as they were. A
file is changed in this order: its new content is written into the folder; the present file gets a
second name there (a hard link, or else a copy); the journal gets a line with the SHA-256 of both;
the new content replaces the file. A process that is killed in between leaves the file as it was or
as the journal says, never half of it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from services.cli.locate.library import UndoReport
from services.cli.output import Json, printable_path
from shared.errors import Conflict, Misconfigured, NotFound, Unprocessable
from shared.ids import new_id

FOLDER = ".placewise-locate"
JOURNAL, BACKUPS, STAGED = "journal.jsonl", "before", "new"


class UndoJournal:
    """Replaces files below a folder so that `undo` can restore them. Use `open_journal`."""

    def __init__(self, root: Path) -> None:
        self._root = root.resolve()  # paths are relative to it
        self._folder = root / FOLDER
        self._journal = self._folder / JOURNAL
        for name in (BACKUPS, STAGED):
            (self._folder / name).mkdir(exist_ok=True)
        lines = read_journal(self._journal, _check_line)
        repair_journal(self._journal, lines)
        self._known: dict[str, set[str | None]] = {}  # path -> SHA-256 of what undo may discard
        for line in lines:
            self._remember(line)

    def write(self, path: Path, content: bytes, existing: bytes | None) -> None:
        """Replace `path` by this content.

        Args:
            existing: What the content was made of; None for a new file.

        Raises:
            Unprocessable: `outside_folder`, for a link to a file that is not below the folder;
                `owner_differs`, if only another user can write a file with the same owner.
            Conflict: `changed_meanwhile`, if the file is another than `existing` by now.
        """
        path = path.resolve()  # a link stays a link
        name = os.path.relpath(path, self._root)
        _check_is_below(self._root, name)
        staged = self._folder / STAGED / path.name
        staged.unlink(missing_ok=True)
        staged.write_bytes(content)
        if path.exists():
            _copy_ownership(path, staged)
        _sync(staged)
        line = {"path": name, "before": _sha256(path), "after": _sha256(staged), "backup": None}
        if line["before"] != (None if existing is None else hashlib.sha256(existing).hexdigest()):
            raise Conflict(
                "changed_meanwhile", "Another program has changed the file meanwhile. Try again."
            )
        is_known = line["before"] in self._known.get(name, ())
        if not is_known and line["before"] is not None:  # new, or changed by something else since
            line["backup"] = str(new_id())  # a name that no earlier backup has
            _link_or_copy(path, self._folder / BACKUPS / str(line["backup"]))
            _sync(self._folder / BACKUPS)
        append_to_journal(self._journal, line)
        self._remember(line)
        staged.replace(path)
        _sync(path.parent)

    def _remember(self, line: Json) -> None:
        self._known.setdefault(line["path"], set()).update((line["before"], line["after"]))


@contextmanager
def open_journal(root: Path) -> Iterator[UndoJournal]:
    """Open the journal of a folder, or begin one.

    Raises:
        Conflict: `locate_in_progress`.
        Misconfigured: `out_unwritable`.
    """
    with _exclusive(root):
        yield UndoJournal(root)


def undo(root: Path) -> UndoReport:
    """Restore all files that the journal of a folder names, and remove the journal.

    A file that something else has changed since stays as it is, and so does the journal then. One
    that was changed between two writes is restored to what it was before the second.

    Raises:
        NotFound: `nothing_to_undo`.
        Conflict: `locate_in_progress`.
        Misconfigured: `out_unwritable`.
        Unprocessable: `journal_damaged` or `outside_folder`; nothing is changed then.
    """
    folder = root / FOLDER
    if not (folder / JOURNAL).exists():
        raise NotFound("nothing_to_undo", f"{printable_path(root)} has no journal of changes.")
    report = UndoReport()
    with _exclusive(root):
        originals: dict[str, Json] = {}
        written: dict[str, set[str]] = {}
        for line in read_journal(folder / JOURNAL, _check_line):
            if line["backup"] is not None:
                originals[line["path"]] = line
            originals.setdefault(line["path"], line)
            written.setdefault(line["path"], set()).add(line["after"])
        for name in originals:
            _check_is_below(root.resolve(), name)
        for name, line in originals.items():
            path = root.resolve() / name
            present = _sha256(path)
            if present == line["before"]:
                continue
            if present not in written[name]:
                report.changed_since.append(name)
            elif line["backup"] is None:
                path.unlink()
                report.removed.append(name)
            else:
                staged = folder / STAGED / path.name
                staged.unlink(missing_ok=True)
                _link_or_copy(folder / BACKUPS / line["backup"], staged)
                staged.replace(path)
                report.restored.append(name)
            if path.parent.exists():
                _sync(path.parent)
        if not report.changed_since:
            (folder / JOURNAL).unlink()
            shutil.rmtree(folder)
    return report


@contextmanager
def _exclusive(root: Path) -> Iterator[None]:
    folder = root / FOLDER
    try:
        folder.mkdir(exist_ok=True)
        for path in (folder, *folder.iterdir()):
            if path.is_symlink() or not (path.is_dir() or path.is_file()):
                raise OSError(f"{FOLDER} is or contains a symbolic link or special file")
        with FileLock(folder / "lock", timeout=0):
            yield
    except Timeout as error:
        raise Conflict(
            "locate_in_progress",
            f"Another `placewise locate` changes files in {printable_path(root)}.",
        ) from error
    except OSError as error:
        raise Misconfigured(
            "out_unwritable", f"Can't change files in {printable_path(root)}: {error}."
        ) from error


def _check_line(line: Json) -> None:
    paths = [line["path"], *([line["backup"]] if line["backup"] is not None else [])]
    if not all(isinstance(path, str) for path in paths) or "/" in "".join(paths[1:]):
        raise ValueError
    _ = line["before"], line["after"]


def read_journal(journal: Path, check: Callable[[Json], object]) -> list[Json]:
    """Return the lines of a journal; an incomplete last line stands for no change.

    Args:
        check: Raises ValueError, KeyError or TypeError for a line of another form.

    Raises:
        Unprocessable: `journal_damaged`.
    """
    data = journal.read_bytes() if journal.exists() else b""
    lines: list[Json] = []
    for number, text in enumerate(data.split(b"\n")[:-1], start=1):
        try:
            line = json.loads(text)
            check(line)
        except (ValueError, KeyError, TypeError) as error:
            raise Unprocessable(
                "journal_damaged", f"{printable_path(journal)}: line {number} can't be read."
            ) from error
        lines.append(line)
    return lines


def repair_journal(journal: Path, lines: Sequence[Json]) -> None:
    """Take away an incomplete last line, which a killed process has left."""
    _write_synced(journal, b"".join(_to_line(line) for line in lines))


def append_to_journal(journal: Path, line: Json) -> None:
    """Append a line, which is on the disk when the call returns."""
    with journal.open("ab") as file:
        file.write(_to_line(line))
        file.flush()
        os.fsync(file.fileno())


def _check_is_below(root: Path, name: str) -> None:
    """Refuse a path that leads out of the folder: its journal may come from somebody else."""
    if not (root / name).resolve().is_relative_to(root):
        raise Unprocessable(
            "outside_folder",
            f"{printable_path(Path(name))} is outside of the folder. Run the command in the folder "
            "that the file is in.",
        )


def _to_line(line: Json) -> bytes:
    # File names that are no UTF-8 are read back as they were.
    return json.dumps(line).encode() + b"\n"


def _sha256(path: Path) -> str | None:
    if not path.exists():
        return None
    if not path.is_file():  # reading a FIFO would wait for ever
        raise Unprocessable("not_a_file", f"{printable_path(path)} is not a regular file.")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _link_or_copy(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copy2(source, target)
        _copy_ownership(source, target)
        _sync(target)


def _copy_ownership(source: Path, target: Path) -> None:
    """Give a file the owner, group, mode and extended attributes (so the ACL) of another one."""
    info, new = source.stat(), target.stat()
    if (info.st_uid, info.st_gid) != (new.st_uid, new.st_gid):
        try:
            os.chown(target, info.st_uid, info.st_gid)
        except PermissionError as error:
            raise Unprocessable(
                "owner_differs",
                f"The file belongs to user {info.st_uid} and group {info.st_gid}, which writing it "
                "would change. Run the command as its owner or as root.",
            ) from error
    if sys.platform == "linux":
        names: list[str] = []
        with suppress(OSError):  # of a file system without them
            names = os.listxattr(source)
        for name in names:
            with suppress(OSError):  # only the system may set some
                os.setxattr(target, name, os.getxattr(source, name))
    shutil.copymode(source, target)  # last: a change of the owner clears bits of it


def _write_synced(path: Path, content: bytes) -> None:
    partial = path.with_name(f"{path.name}.partial")
    partial.write_bytes(content)
    _sync(partial)
    partial.replace(path)


def _sync(path: Path) -> None:
    """Force a file or folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
