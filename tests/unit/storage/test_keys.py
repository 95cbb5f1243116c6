"""Keys of the originals: an ending that other programs know, and none of other people's files."""

from __future__ import annotations

from uuid import uuid4

import pytest

from shared.ids import new_id
from shared.imaging.file_formats import photo_suffix
from shared.storage.keys import is_original_key, new_original_key


@pytest.mark.parametrize(
    ("filename", "suffix"),
    [
        ("IMG_2078.JPG", ".jpg"),
        ("Day 2/a.b.jpeg", ".jpeg"),
        ("scan.tiff", ".tiff"),
        ("phone.heic", ".heic"),
        ("noending", ""),
        ("run.exe", ""),
        ("a.jpg/../../b", ""),
        (".jpg", ""),
        ("nul\0.jp\0g", ""),
    ],
)
def test_an_original_has_the_ending_of_its_file_if_it_is_a_photos(
    filename: str, suffix: str
) -> None:
    assert photo_suffix(filename) == suffix
    key = new_original_key(photo_suffix(filename))
    assert key.endswith(suffix)
    assert is_original_key(key)


@pytest.mark.parametrize(
    "name",
    [
        "holiday.jpg",
        f"{uuid4()}.jpg",  # of the AnyLoc similarity service, in the same folder
        f"{new_id()}.jpg.bak",
        f"{new_id()}.",
        f"{new_id()}.JPG",
        str(new_id()).upper(),
        f"{new_id()}/a.jpg",
    ],
)
def test_other_files_in_the_folder_of_the_originals_are_not_ours(name: str) -> None:
    assert not is_original_key(f"originals/{name}")
