"""A folder that several processes write into."""

from __future__ import annotations

from pathlib import Path

from shared.storage import FolderStore


def test_only_who_is_alone_in_a_folder_removes_what_is_half_written(tmp_path: Path) -> None:
    writer = FolderStore(tmp_path).writer("a")
    writer.write(b"half")
    reader = FolderStore(tmp_path, exclusive=False)
    writer.commit()
    assert reader.get("a") == b"half"

    (tmp_path / ".partial" / "left by a killed writer").write_bytes(b"half")
    FolderStore(tmp_path, exclusive=False)
    assert list((tmp_path / ".partial").iterdir())
    FolderStore(tmp_path)
    assert not list((tmp_path / ".partial").iterdir())
