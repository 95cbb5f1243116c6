"""XMP sidecars: coordinates are added and read back, and nothing else changes."""

from __future__ import annotations

import io
import os
from pathlib import Path
from unittest.mock import Mock
from xml.sax.saxutils import quoteattr

import pyexiv2
import pytest

from services.cli.ingest.local_headers import find_sidecars, read_local_header
from services.cli.locate.sidecars import (
    add_position,
    has_estimate,
    remove_position,
    replace_sidecar,
)
from shared.errors import Misconfigured, Unprocessable
from shared.imaging.xmp import EXIF
from tests.support.photos import photo_bytes, sidecar_position

DARKTABLE = b"""<?xml version="1.0" encoding="UTF-8"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/" x:xmptk="XMP Core 4.4.0-Exiv2">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="uuid:1"
    xmlns:xmp="http://ns.adobe.com/xap/1.0/"
    xmlns:darktable="http://darktable.sf.net/"
   xmp:Rating="4"
   darktable:history_end="0">
   <darktable:history><rdf:Seq/></darktable:history><!-- a comment -->
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
"""
PLACES = [(48.8583736, 2.2944813), (-33.8567844, 151.2152967), (-0.0000001, -179.9999999)]


@pytest.mark.parametrize(("latitude", "longitude"), PLACES)
def test_coordinates_are_read_back_within_a_decimetre(latitude: float, longitude: float) -> None:
    for existing in (None, DARKTABLE):
        sidecar = add_position(existing, latitude, longitude, 12.0)
        assert sidecar_position(sidecar) == pytest.approx((latitude, longitude), abs=1e-6)


def test_a_sidecar_is_edited_and_not_replaced() -> None:
    edited = add_position(DARKTABLE, *PLACES[0], 12.0)
    begin = edited.index(b"<rdf:Description rdf:about", DARKTABLE.index(b"<rdf:Description") + 1)
    end = edited.index(b"</rdf:RDF>")
    assert edited[:begin] + edited[end:] == DARKTABLE
    assert b'rdf:about="uuid:1"' in edited[begin:end], "the same subject"
    assert b'exif:GPSLatitude="48,51.502416N"' in edited


@pytest.mark.parametrize("subject", ["uuid:1", "", "it's", 'a "b" c', "a 'b' \"c\" & \n<d>"])
def test_a_sidecar_without_what_was_added_is_the_one_of_before(subject: str) -> None:
    about = f"rdf:about={quoteattr(subject)}".encode()
    before = DARKTABLE.replace(b'rdf:about="uuid:1"', about)
    edited = add_position(before, *PLACES[0], 12.0, 338.0)
    assert edited != before
    assert remove_position(edited) == before
    assert remove_position(add_position(None, *PLACES[0], 12.0)) is None


def test_an_added_element_that_was_edited_is_recognised_and_left() -> None:
    edited = add_position(DARKTABLE, *PLACES[0], 12.0).replace(b"\n    exif:", b" exif:")
    assert has_estimate(edited)
    assert remove_position(edited) == edited
    assert not has_estimate(DARKTABLE)


def test_a_sidecar_is_written_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.jpg.xmp"
    path.write_bytes(DARKTABLE)
    for owner, name in ((os, "fsync"), (Path, "replace")):
        with monkeypatch.context() as broken:
            broken.setattr(owner, name, Mock(side_effect=OSError("no space left")))
            with pytest.raises(Misconfigured):
                replace_sidecar(tmp_path, path, b"new", DARKTABLE)
        assert [each.read_bytes() for each in tmp_path.iterdir()] == [DARKTABLE]


def test_a_link_to_a_sidecar_outside_the_folder_is_not_written_to(tmp_path: Path) -> None:
    (tmp_path / "outside.xmp").write_bytes(DARKTABLE)
    folder = tmp_path / "trip"
    folder.mkdir()
    (folder / "a.xmp").symlink_to(tmp_path / "outside.xmp")
    (folder / "b.xmp").write_bytes(DARKTABLE)
    (folder / "c.xmp").symlink_to(folder / "b.xmp")
    with pytest.raises(Unprocessable) as refused:
        replace_sidecar(folder, folder / "a.xmp", b"new", DARKTABLE)
    assert refused.value.code == "outside_folder"
    replace_sidecar(folder, folder / "c.xmp", b"new", DARKTABLE)
    assert (folder / "c.xmp").is_symlink()
    assert (folder / "b.xmp").read_bytes() == b"new"


def test_coordinates_that_are_there_are_not_changed() -> None:
    sidecar = add_position(None, *PLACES[0], 12.0)
    with pytest.raises(Unprocessable) as refusal:
        add_position(sidecar, *PLACES[1], 12.0)
    assert refusal.value.code == "has_coordinates"
    as_element = DARKTABLE.replace(
        b"<!-- a comment -->",
        f'<e:GPSLatitude xmlns:e="{EXIF}">48,51.5N</e:GPSLatitude>'.encode(),
    )
    with pytest.raises(Unprocessable):
        add_position(as_element, *PLACES[1], 12.0)


@pytest.mark.parametrize(
    "broken",
    [b"", b"<x/>", b"no XML", DARKTABLE[:200], DARKTABLE.decode().encode("utf-16")],
)
def test_what_is_no_sidecar_is_refused(broken: bytes) -> None:
    with pytest.raises(Unprocessable) as refusal:
        add_position(broken or b" ", *PLACES[0], 12.0)
    assert refusal.value.code == "bad_sidecar"


def test_a_property_that_is_there_is_not_written_twice() -> None:
    with_datum = DARKTABLE.replace(
        b'xmp:Rating="4"', f'xmlns:exif="{EXIF}" exif:GPSMapDatum="WGS-84"'.encode()
    )
    assert add_position(with_datum, *PLACES[0], 12.0).count(b"GPSMapDatum") == 1


def test_the_sidecar_with_the_whole_name_comes_first(tmp_path: Path) -> None:
    photo = tmp_path / "a.jpg"
    assert find_sidecars(photo) == []
    (tmp_path / "a.xmp").write_bytes(DARKTABLE)
    assert find_sidecars(photo) == [tmp_path / "a.xmp"]
    (tmp_path / "a.jpg.XMP").write_bytes(DARKTABLE)
    assert find_sidecars(photo) == [tmp_path / "a.jpg.XMP", tmp_path / "a.xmp"]


def test_a_sidecar_that_is_broken_is_not_taken_for_one_without_coordinates() -> None:
    header = read_local_header(io.BytesIO(photo_bytes(1)), [DARKTABLE[:200]])
    assert (header.latitude, header.gps_error) == (None, "its XMP is damaged")


@pytest.mark.parametrize("existing", [None, DARKTABLE])
def test_exiv2_reads_the_sidecar_as_darktable_and_digikam_do(
    existing: bytes | None, tmp_path: Path
) -> None:
    path = tmp_path / "a.jpg.xmp"
    path.write_bytes(add_position(existing, *PLACES[1], 0.42, 338.04))
    with pyexiv2.Image(str(path)) as sidecar:
        values = sidecar.read_xmp()
    assert values["Xmp.exif.GPSLatitude"] == "33,51.407064S"
    assert values["Xmp.exif.GPSLongitude"] == "151,12.917802E"
    assert values["Xmp.exif.GPSHPositioningError"] == "42/100"
    assert values["Xmp.exif.GPSImgDirection"] == "33804/100"
    assert values["Xmp.exif.GPSImgDirectionRef"] == "T"
    assert values.get("Xmp.xmp.Rating") == ("4" if existing else None)


def test_a_heading_that_is_there_is_not_changed() -> None:
    measured = b'exif:GPSImgDirection="10/1" exif:GPSImgDirectionRef="M"\n   xmp:Rating'
    existing = DARKTABLE.replace(b"xmp:Rating", measured).replace(
        b"    xmlns:xmp=", f'    xmlns:exif="{EXIF}"\n    xmlns:xmp='.encode()
    )
    edited = add_position(existing, *PLACES[0], 1.0, 338.0)
    assert edited.count(b"GPSImgDirection=") == 1
    assert edited.count(b"GPSImgDirectionRef=") == 1
