"""Keys of the originals: an ending that other programs know, and none of other people's files."""

from __future__ import annotations

import pytest

from shared.imaging.file_formats import photo_suffix
from shared.storage.keys import is_original_key, new_original_key

# Written out, so that each process of a parallel run collects the same names.
RANDOM = "0e1f6dcb-9a0f-4a52-8f0e-6a1df9a9a0b4"
OURS = "01a204e6-f347-754c-a403-7c49c822a51a"


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
        f"{RANDOM}.jpg",  # of the AnyLoc similarity service, in the same folder
        f"{OURS}.jpg.bak",
        f"{OURS}.",
        f"{OURS}.JPG",
        OURS.upper(),
        f"{OURS}/a.jpg",
    ],
)
def test_foreign_files_in_the_folder_of_originals_are_no_originals(name: str) -> None:
    assert not is_original_key(f"originals/{name}")
