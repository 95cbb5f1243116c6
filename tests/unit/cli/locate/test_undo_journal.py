"""The journal of `placewise locate --write`: undo restores every byte, after a kill, too."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from services.cli.locate.undo_journal import FOLDER, JOURNAL, open_journal, undo
from shared.errors import Misconfigured, NotFound, Unprocessable


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
        path = root / name
        journal.write(path, content, path.read_bytes() if path.exists() else None)


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
    write(folder, "sub/b.jpg", b"other")
    assert (folder / "sub" / "b.jpg").read_bytes() == b"other"
    report = undo(folder)
    assert (report.restored, report.removed) == (["old.xmp", "sub/b.jpg"], ["new.xmp"])
    assert contents(folder) == before
    assert (folder / "old.xmp").stat().st_mtime_ns == modified
    with pytest.raises(NotFound, match="no journal"):
        undo(folder)


def test_a_change_between_two_writes_is_not_lost_by_undo(folder: Path) -> None:
    for name in ("old.xmp", "new.xmp"):
        write(folder, name, b"first")
        (folder / name).write_bytes(b"edited by its owner")
        write(folder, name, b"second")
        write(folder, name, b"third")
    report = undo(folder)
    assert (sorted(report.restored), report.removed) == (["new.xmp", "old.xmp"], [])
    for name in ("old.xmp", "new.xmp"):
        assert (folder / name).read_bytes() == b"edited by its owner"


def test_a_deleted_backup_lets_no_other_be_overwritten(folder: Path) -> None:
    write(folder, "old.xmp", b"ours")
    write(folder, "sub/b.jpg", b"ours")
    before, _ = sorted((folder / FOLDER / "before").iterdir())
    before.unlink()
    (folder / "third.xmp").write_bytes(b"third")
    write(folder, "third.xmp", b"ours")
    with pytest.raises(Misconfigured):
        undo(folder)  # the backup of the first is missing
    (folder / "old.xmp").write_bytes(b"old \xff bytes")
    assert sorted(undo(folder).restored) == ["sub/b.jpg", "third.xmp"]
    assert (folder / "sub" / "b.jpg").read_bytes() == b"photo"


def test_a_link_to_a_file_outside_the_folder_is_not_written_to(
    folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "outside.xmp").write_bytes(b"of somebody else")
    (folder / "link.xmp").symlink_to(tmp_path / "outside.xmp")
    with pytest.raises(Unprocessable) as refused:
        write(folder, "link.xmp", b"ours")
    assert refused.value.code == "outside_folder"
    assert (tmp_path / "outside.xmp").read_bytes() == b"of somebody else"


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ('{"path": "../outside", "before": "0", "after": null, "backup": "1"}', "outside_folder"),
        ('{"path": "/outside", "before": null, "after": null, "backup": null}', "outside_folder"),
        ('{"path": "a", "before": "0", "after": null, "backup": "../1"}', "journal_damaged"),
        ('{"path": "a"}', "journal_damaged"),
        ("not JSON", "journal_damaged"),
    ],
)
def test_a_forged_or_damaged_journal_changes_nothing(
    folder: Path, tmp_path: Path, line: str, code: str
) -> None:
    write(folder, "old.xmp", b"ours")
    with (folder / FOLDER / JOURNAL).open("a") as journal:
        journal.write(f"{line}\n")
    (folder / FOLDER / "before" / "1").write_bytes(b"planted")
    before = contents(tmp_path)
    with pytest.raises(Unprocessable) as refused:
        undo(folder)
    assert refused.value.code == code
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", [".", "new", "before"])
def test_a_journal_folder_that_is_a_link_is_refused(
    folder: Path, tmp_path: Path, name: str
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "old.xmp").write_bytes(b"of somebody else")
    link = folder / FOLDER / name
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(elsewhere)
    with pytest.raises(Misconfigured, match="symbolic link"):
        write(folder, "old.xmp", b"ours")
    assert (elsewhere / "old.xmp").read_bytes() == b"of somebody else"


def test_undo_finds_the_files_of_a_folder_behind_a_link(folder: Path, tmp_path: Path) -> None:
    before = contents(folder)
    link = tmp_path / "deep" / "er" / "link"
    link.parent.mkdir(parents=True)
    link.symlink_to(folder)
    write_two(link)
    assert undo(link).changed_since == []
    assert contents(folder) == before


def test_a_kill_at_any_moment_leaves_what_undo_repairs(folder: Path) -> None:
    before = contents(folder)
    for moment in itertools.count(1):
        killed = run_until(moment, lambda: write_two(folder))
        for name, old in (("old.xmp", before["old.xmp"]), ("new.xmp", None)):
            path = folder / name
            present = path.read_bytes() if path.exists() else None
            assert present in (old, b"written"), "never half of it"
        if (folder / FOLDER / JOURNAL).exists():
            undo(folder)
        assert without_journal(folder) == before, f"killed before call {moment}"
        if not killed:
            break
    assert moment > 15


def test_an_undo_that_was_killed_is_finished_by_the_next(folder: Path) -> None:
    before = contents(folder)
    for moment in itertools.count(1):
        write_two(folder)
        killed = run_until(moment, lambda: undo(folder))
        if (folder / FOLDER / JOURNAL).exists():
            undo(folder)
        assert without_journal(folder) == before, f"killed before call {moment}"
        if not killed:
            break
    assert moment > 5
