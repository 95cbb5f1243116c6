"""The journal of `placewise locate --write`: undo restores every byte, after a kill, too."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from services.cli.locate.undo_journal import FOLDER, JOURNAL, open_journal, undo
from shared.errors import Conflict, NotFound

MOMENTS = 40
"""More than there are moments at which a call is killed below"""


def run_until(killed_at: int, work: Callable[[], object]) -> bool:
    """Run in a process of its own that is killed before its n-th call that touches a file.

    Returns False if it ended before.
    """
    child = os.fork()
    if child == 0:
        _kill_at(killed_at, work)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def _kill_at(killed_at: int, work: Callable[[], object]) -> None:
    calls = 0

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == killed_at:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **options)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for owner, name in (
            *((os, name) for name in ("fsync", "link")),
            *((Path, name) for name in ("mkdir", "open", "replace", "unlink")),
        ):
            patch.setattr(owner, name, counted(getattr(owner, name)))
        work()


def contents(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()
    }


def without_journal(root: Path) -> dict[str, bytes]:
    return {name: data for name, data in contents(root).items() if not name.startswith(FOLDER)}


def write_two(root: Path) -> None:
    for name in ("old.xmp", "new.xmp"):
        write(root, name, b"written")


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


def test_a_kill_at_any_moment_leaves_what_undo_repairs(folder: Path) -> None:
    before = contents(folder)
    killed = 0
    for moment in range(1, MOMENTS):
        killed += run_until(moment, lambda: write_two(folder))
        for name, old in (("old.xmp", before["old.xmp"]), ("new.xmp", None)):
            path = folder / name
            present = path.read_bytes() if path.exists() else None
            assert present in (old, b"written"), "never half of it"
        if (folder / FOLDER / JOURNAL).exists():
            undo(folder)
        assert without_journal(folder) == before, f"killed before call {moment}"
    assert 15 < killed < MOMENTS - 1, "after the last moment, all was written"


def test_an_undo_that_was_killed_is_finished_by_the_next(folder: Path) -> None:
    before = contents(folder)
    killed = 0
    for moment in range(1, MOMENTS):
        write_two(folder)
        killed += run_until(moment, lambda: undo(folder))
        if (folder / FOLDER / JOURNAL).exists():
            undo(folder)
        assert without_journal(folder) == before, f"killed before call {moment}"
    assert 5 < killed < MOMENTS - 1


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
