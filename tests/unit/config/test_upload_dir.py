"""UPLOAD_DIR: one folder for one home, and never a start with the photos out of reach."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from shared.config.settings import Settings
from shared.errors import Misconfigured
from shared.ids import new_id
from shared.storage.open_store import resolve_upload_dir


def place(home: Path, upload_dir: Path | None) -> Mapping[str, Path]:
    home.mkdir(exist_ok=True)
    return resolve_upload_dir(home, home / "objects", upload_dir)


def refused(home: Path, upload_dir: Path | None, code: str) -> str:
    with pytest.raises(Misconfigured) as caught:
        place(home, upload_dir)
    assert caught.value.code == code
    return caught.value.detail


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "home"


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return tmp_path / "disk" / "photos"


def test_without_the_setting_originals_are_under_the_home(home: Path) -> None:
    assert place(home, None) == {}
    assert list(home.iterdir()) == []


def test_the_folder_is_made_and_taken_again_at_the_next_start(home: Path, photos: Path) -> None:
    for _ in range(2):
        assert place(home, photos) == {"originals": photos}
    assert [path.name for path in photos.iterdir()] == [".placewise"]


def test_a_folder_in_which_people_keep_photos_is_taken_too(home: Path, photos: Path) -> None:
    photos.mkdir(parents=True)
    (photos / "holiday.jpg").write_bytes(b"theirs")
    place(home, photos)


@pytest.mark.parametrize("inside", ["objects", "objects/originals", "objects/chunks/x", "."])
def test_neither_folder_may_lie_inside_the_other(home: Path, inside: str) -> None:
    upload_dir = (home / inside).resolve()
    detail = refused(home, upload_dir, "upload_dir_overlaps")
    assert str(upload_dir) in detail
    assert str(home / "objects") in detail
    assert not (home / "objects").exists()
    refused(home, home.parent, "upload_dir_overlaps")
    place(home, home / "uploads")


def test_a_folder_that_can_not_be_written_is_named(home: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    for upload_dir in (tmp_path / "file", tmp_path / "file" / "below", Path("/proc/photos")):
        assert str(upload_dir) in refused(home, upload_dir, "upload_dir_unwritable")


def test_two_homes_never_share_a_folder(home: Path, photos: Path, tmp_path: Path) -> None:
    place(home, photos)
    for other in ("new", "with its own"):
        (tmp_path / other).mkdir()
    place(tmp_path / "with its own", tmp_path / "its photos")
    for other in ("new", "with its own"):
        detail = refused(tmp_path / other, photos, "upload_dir_taken")
        assert str(photos) in detail
        assert str(tmp_path / other) in detail


def test_a_changed_folder_is_refused_while_the_former_one_has_photos(
    home: Path, photos: Path
) -> None:
    place(home, photos)
    assert str(photos) in refused(home, None, "upload_dir_changed")
    elsewhere = photos.with_name("elsewhere")
    assert str(photos) in refused(home, elsewhere, "upload_dir_changed")

    (photos / ".placewise").unlink()  # as on a disk that is not mounted
    assert "mounted" in refused(home, photos, "upload_dir_changed")


def test_a_folder_may_move_with_all_that_is_in_it(home: Path, photos: Path) -> None:
    place(home, photos)
    moved = photos.with_name("moved")
    photos.rename(moved)
    assert place(home, moved) == {"originals": moved}
    assert str(moved) in refused(home, None, "upload_dir_changed")


def test_photos_under_the_home_are_moved_first(home: Path, photos: Path) -> None:
    originals = home / "objects" / "originals"
    originals.mkdir(parents=True)
    stored = originals / str(new_id())
    stored.write_bytes(b"photo")
    assert str(originals) in refused(home, photos, "upload_dir_changed")
    stored.rename(photos / stored.name)
    assert place(home, photos) == {"originals": photos}


def test_the_setting_is_absolute_and_may_be_empty(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("UPLOAD_DIR", "./uploads")
    assert Settings().upload_dir == tmp_path / "uploads"
    monkeypatch.setenv("UPLOAD_DIR", "")
    assert Settings().upload_dir is None
