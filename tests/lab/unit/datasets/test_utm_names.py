"""@UTM@ file names: what is written is what is read."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from lab.datasets.utm_names import FileNameLocation, UtmFileName, parse_utm_file_name
from shared.errors import InvalidRequest
from shared.utm_filenames import upload_fields_of_file_name

MOLE = UtmFileName(
    east=396877.76,
    north=4991561.25,
    zone_number=32,
    zone_letter="T",
    pano_id="pano",
    heading=-10.5,
    captured_at=datetime(2026, 5, 1, 9, 30, 7, tzinfo=UTC),
    note="spring",
)


def test_written_name_has_all_fields_in_the_order_of_the_convention() -> None:
    parts = MOLE.file_name().split("@")
    assert len(parts) == 16
    assert parts[1:5] == ["0396877.76", "4991561.25", "32", "T"]
    assert parts[7] == "pano"
    assert parts[9] == "349.50"
    assert parts[13:] == ["20260501093007", "spring", ".jpg"]


def test_what_is_written_is_read_again_to_a_fifth_of_a_metre() -> None:
    fields = upload_fields_of_file_name(MOLE.file_name(), None)
    exact = upload_fields_of_file_name("@396877.76@4991561.25@32@T@.jpg", None)
    for name in ("latitude", "longitude"):
        assert float(fields[name]) == pytest.approx(float(exact[name]), abs=1.5e-6)
    assert fields["heading"] == "349.5"
    assert datetime.fromisoformat(fields["captured_at"]) == MOLE.captured_at


def test_southern_and_western_degrees_keep_their_sign() -> None:
    rio = UtmFileName(east=683466.0, north=7460687.0, zone_number=23, zone_letter="K")
    fields = upload_fields_of_file_name(rio.file_name(), None)
    assert float(fields["latitude"]) == pytest.approx(-22.95, abs=0.01)
    assert float(fields["longitude"]) == pytest.approx(-43.21, abs=0.01)
    assert "heading" not in fields
    assert "captured_at" not in fields


def test_field_with_an_at_sign_is_refused_because_it_would_shift_all_others() -> None:
    with pytest.raises(ValueError, match="@"):
        UtmFileName(396877.76, 4991561.25, 32, "T", note="a@b").file_name()


def test_spot_has_exactly_the_fields_of_the_file_name() -> None:
    full = parse_utm_file_name(
        "@0660329.93@1522162.46@47@P@013.76438@0100.48301@3TQZ-W_x@@398@@@@201905@4257_Bangkok@.jpg"
    )
    assert full == FileNameLocation(
        660329.93, 1522162.46, "47P", 13.76438, 100.48301, 38.0, "4257_Bangkok"
    )
    assert parse_utm_file_name("@1@2@.jpg") == FileNameLocation(
        1.0, 2.0, None, None, None, None, ""
    )
    assert parse_utm_file_name("IMG_1.jpg") is None


@pytest.mark.parametrize("name", ["@x@2@.jpg", "@nan@2@.jpg", "@inf@2@.jpg"])
def test_spot_without_two_numbers_is_refused(name: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        parse_utm_file_name(name)
    assert caught.value.code == "bad_coordinates"
