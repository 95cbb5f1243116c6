"""The lists that name local photos."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.cli.ingest.geotags import read_photo_manifest
from shared.errors import InvalidRequest


def test_a_list_that_names_a_missing_photo_is_refused_by_its_line(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").write_bytes(b"one")
    data = b'{"filename": "1.jpg"}\n{"filename": "2.jpg"}\n'
    with pytest.raises(InvalidRequest) as caught:
        read_photo_manifest(tmp_path / "list.jsonl", data)
    assert caught.value.code == "bad_manifest"
    assert [error["line"] for error in caught.value.extra["errors"]] == [2]
