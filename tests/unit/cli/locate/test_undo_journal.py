"""The journal of `placewise locate --write`: undo restores every byte, after a kill, too."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock

from services.cli.locate.undo_journal import FOLDER, JOURNAL, open_journal, undo
from shared.errors import Conflict, NotFound

WRITER = """
import os, signal, sys
from pathlib import Path
from services.cli.locate import undo_journal as tested

root, killed_at = Path(sys.argv[1]), int(sys.argv[2])
calls = 0

def counted(function):
    def call(*arguments, **options):
        global calls
        calls += 1
        if calls == killed_at:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)
    return call

os.fsync, os.link = counted(os.fsync), counted(os.link)
Path.replace, Path.write_bytes = counted(Path.replace), counted(Path.write_bytes)
with tested.open_journal(root) as journal:
    for name in ("old.xmp", "new.xmp"):
        path = root / name
        journal.install(path, journal.stage(path, b"written"))
"""


def contents(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


def write(root: Path, name: str, content: bytes) -> None:
    with open_journal(root) as journal:
        journal.install(root / name, journal.stage(root / name, content))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "photos"
    (root / "sub").mkdir(parents=True)
    (root / "old.xmp").write_bytes(b"old \xff bytes")
    (root / "sub" / "b.jpg").write_bytes(b"photo")
    return root


def test_undo_restores_changed_files_and_removes_new_ones(folder: Path) -> None:
    before = contents(folder)
    modified = (folder / "old.xmp").stat().st_mtime_ns
    write(folder, "old.xmp", b"first")
    write(folder, "old.xmp", b"second")
    write(folder, "new.xmp", b"new")
    with open_journal(folder) as journal:
        staged = journal.stage(folder / "sub" / "b.jpg")
        staged.write_bytes(staged.read_bytes() + b" with EXIF")
        journal.install(folder / "sub" / "b.jpg", staged)
    assert (folder / "sub" / "b.jpg").read_bytes() == b"photo with EXIF"
    report = undo(folder)
    assert (report.restored, report.removed) == (["old.xmp", "sub/b.jpg"], ["new.xmp"])
    assert contents(folder) == before
    assert (folder / "old.xmp").stat().st_mtime_ns == modified
    with pytest.raises(NotFound, match="no journal"):
        undo(folder)


def test_a_file_that_was_changed_since_is_left_as_it_is(folder: Path) -> None:
    write(folder, "old.xmp", b"ours")
    write(folder, "new.xmp", b"ours")
    (folder / "new.xmp").write_bytes(b"edited by another program")
    report = undo(folder)
    assert (report.restored, report.changed_since) == (["old.xmp"], ["new.xmp"])
    assert (folder / "new.xmp").read_bytes() == b"edited by another program"
    (folder / "new.xmp").unlink()
    assert undo(folder).changed_since == [], "the journal was kept"
    assert not (folder / FOLDER).exists()


@pytest.mark.parametrize("killed_at", range(1, 25, 2))
def test_a_kill_at_any_moment_leaves_what_undo_repairs(folder: Path, killed_at: int) -> None:
    before = contents(folder)
    command = [sys.executable, "-c", WRITER, str(folder), str(killed_at)]
    code = subprocess.run(command, check=False, timeout=100).returncode
    assert code in (-signal.SIGKILL, 0)
    for name, old in (("old.xmp", before["old.xmp"]), ("new.xmp", None)):
        path = folder / name
        present = path.read_bytes() if path.exists() else None
        assert present in (old, b"written"), "never half of it"
    if (folder / FOLDER / JOURNAL).exists():
        undo(folder)
    left = {name: data for name, data in contents(folder).items() if not name.startswith(FOLDER)}
    assert left == before


def test_an_incomplete_last_line_of_the_journal_stands_for_no_change(folder: Path) -> None:
    before = contents(folder)
    write(folder, "old.xmp", b"ours")
    with (folder / FOLDER / JOURNAL).open("ab") as journal:
        journal.write(b'{"path": "sub/b.jpg", "bef')
    write(folder, "new.xmp", b"later")
    undo(folder)
    assert contents(folder) == before


def test_files_are_copied_where_hard_links_are_not_possible(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "link", refuse)
    before = contents(folder)
    write(folder, "old.xmp", b"ours")
    undo(folder)
    assert contents(folder) == before


def test_two_commands_do_not_write_at_the_same_time(folder: Path) -> None:
    write(folder, "old.xmp", b"ours")
    with FileLock(folder / FOLDER / "lock"), pytest.raises(Conflict, match="Another"):
        undo(folder)
    undo(folder)
