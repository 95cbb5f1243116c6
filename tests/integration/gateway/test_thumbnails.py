"""A thumbnail is a picture and nothing else: what a camera wrote beside it is left out."""

from __future__ import annotations

import io

import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from tests.integration.in_process_api import Service
from tests.support.photos import encoded, photo_image

SERIAL = "camera-serial-0815"


def photo_with_metadata(media: str) -> bytes:
    """Position, owner, camera, comment: all that must not be passed on."""
    exif = Image.Exif()
    exif[Base.Artist] = "Somebody"
    exif.get_ifd(IFD.Exif)[Base.BodySerialNumber] = SERIAL
    exif.get_ifd(IFD.GPSInfo).update(
        {
            GPS.GPSLatitudeRef: "N",
            GPS.GPSLatitude: (45.0, 4.0, 12.0),
            GPS.GPSLongitudeRef: "E",
            GPS.GPSLongitude: (7.0, 41.0, 24.0),
        }
    )
    more = {"comment": b"a private note"} if media == "JPEG" else {}
    xmp = {"xmp": b"<x:xmpmeta xmlns:x='adobe:ns:meta/'>private</x:xmpmeta>"}
    return encoded(photo_image(7, 640, 480), media, exif=exif, **more, **xmp)


@pytest.mark.parametrize("media", ["JPEG", "WEBP"])
def test_a_thumbnail_has_no_metadata_and_the_original_keeps_its_own(
    service: Service, media: str
) -> None:
    data = photo_with_metadata(media)
    assert SERIAL.encode() in data
    file_id = service.upload(data)["file_id"]
    service.drain()
    known = service.json("GET", f"/uploads/{file_id}")
    assert known["latitude"] == pytest.approx(45.07), "or else there was nothing to strip"
    assert service("GET", f"/uploads/{file_id}/image").content == data

    thumbnail = service("GET", f"/uploads/{file_id}/thumbnail").content
    with Image.open(io.BytesIO(thumbnail)) as image:
        image.load()
        assert image.format == "JPEG"
        assert dict(image.getexif()) == {}
        assert not {"exif", "xmp", "comment", "photoshop", "icc_profile"} & image.info.keys()
    for reported in (b"Exif", b"GPS", SERIAL.encode(), b"Somebody", b"private", b"ns.adobe.com"):
        assert reported not in thumbnail
