"""Photo headers: size, location and capture time, read without decoding pixels.

EXIF and XMP are untrusted: fields that are missing, broken or out of range become None, and
coordinates that are there but not understood give a reason. The cost of a header
is bounded whatever the file says (`shared.imaging.bounded_reader`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from operator import index
from typing import Any, BinaryIO, cast

from PIL.ExifTags import GPS, IFD, Base

from shared.errors import Unprocessable
from shared.geometry.cameras import focal_length_from_exif
from shared.imaging.capture_place import CapturePlace, finite_number, read_place, true_heading
from shared.imaging.capture_time import read_time
from shared.imaging.exif import TiffBlock
from shared.imaging.file_formats import PHOTO_READ_ERRORS, check_pixel_count
from shared.imaging.file_structure import Metadata, read_structure
from shared.imaging.takeout import read_takeout
from shared.imaging.xmp import PLACE_PROPERTIES, read_xmp

MAIN_TAGS = (Base.Orientation, Base.Make, Base.Model, IFD.Exif, IFD.GPSInfo)
CAMERA_TAGS = (
    *(Base.DateTimeOriginal, Base.OffsetTimeOriginal, Base.SubsecTimeOriginal),
    *(Base.DateTimeDigitized, Base.OffsetTimeDigitized, Base.SubsecTimeDigitized),
    *(Base.CameraOwnerName, Base.BodySerialNumber),
    *(Base.FocalLengthIn35mmFilm, Base.FocalLength),
    *(Base.FocalPlaneXResolution, Base.FocalPlaneResolutionUnit),
    *(Base.ExifImageWidth, Base.ExifImageHeight),
)
GPS_TAGS = tuple(GPS[n] for n in (*PLACE_PROPERTIES, "GPSMapDatum", "GPSDateStamp", "GPSTimeStamp"))
ROTATED_ORIENTATIONS = (5, 6, 7, 8)  # EXIF orientations that swap width and height
QUARTER_TURNS = {1: 0, 6: 1, 3: 2, 8: 3, **dict.fromkeys((2, 4, 5, 7))}  # clockwise; None: mirrored
READ_BYTES = 1024 * 1024
EXIF_INCH = 2  # the default of FocalPlaneResolutionUnit


@dataclass(frozen=True, slots=True)
class PhotoHeader:
    """Size, location and capture time of a photo; None for unknown values."""

    width: int
    """pixels, upright"""
    height: int
    latitude: float | None = None
    """degrees, WGS 84"""
    longitude: float | None = None
    altitude: float | None = None
    """metres, as the camera's GPS gives them"""
    heading: float | None = None
    """degrees clockwise from true north, in [0, 360)"""
    has_heading: bool = False
    """Whether there is a heading, also a magnetic one that can't be converted."""
    captured_at: datetime | None = None
    """UTC; if `time_zone_is_known` is False, the camera's clock as if it were UTC"""
    time_zone_is_known: bool = False
    clock_offset: timedelta | None = None
    """of the camera's clock from UTC, if its tag or the GPS time says it"""
    camera: str | None = None
    """make, model, owner and serial number"""
    camera_is_unique: bool = False
    """Whether the owner or the serial number is known."""
    focal_length: float | None = None
    """multiple of the longer side"""
    gps_error: str | None = None
    """why the photo may have coordinates although none are known; such a photo is never changed"""
    picture: PictureData | None = field(default=None, compare=False)
    quarter_turns: int | None = 0
    """clockwise, by which EXIF says that the pixels are turned upright; None if also mirrored"""

    @property
    def camera_key(self) -> str | None:
        """What photos of one camera, zoom and size have in common; None without make and model."""
        if self.camera is None or self.quarter_turns is None:
            return None
        size = (self.width, self.height)[:: -1 if self.quarter_turns % 2 else 1]
        return f"{self.camera} {size[0]}x{size[1]} {self.focal_length or 0:.3f}"


@dataclass(frozen=True, slots=True)
class PictureData:
    """The parts of a photo's file that hold the picture, without its metadata."""

    size_and_orientation: str
    parts: Sequence[tuple[int, int]]
    """(offset, length); the last may end behind the file"""

    def sha256(self, file: BinaryIO, path: str) -> str:
        """Return the hash of the picture under this path, which other metadata does not change."""
        digest = hashlib.sha256(f"{self.size_and_orientation} {path}".encode())
        for offset, left in self.parts:
            file.seek(offset)
            while left and (piece := file.read(min(left, READ_BYTES))):
                digest.update(piece)
                left -= len(piece)
        return digest.hexdigest()


def read_photo_header(
    file: BinaryIO, max_pixels: int, sidecars: Sequence[bytes] = ()
) -> PhotoHeader:
    """Read a photo's header from its beginning.

    Coordinates and time are those of the EXIF, or else of the XMP in the file, or of a sidecar,
    which is XMP, or JSON of Google Takeout.

    Raises Unprocessable: `undecodable_photo`, `too_many_pixels`.
    """
    try:
        structure = read_structure(file)
    except (OSError, ValueError) as error:
        raise Unprocessable("undecodable_photo", f"The photo can't be decoded: {error}.") from error
    width, height, metadata = structure.width, structure.height, structure.metadata
    check_pixel_count(width, height, max_pixels)
    main, details, gps = _ExifReader(metadata).read()
    orientation = 1 if structure.is_upright else main.get(Base.Orientation) or 1
    if orientation in ROTATED_ORIENTATIONS:
        width, height = height, width
    sources: list[Mapping[str, Any]] = [
        {Base(tag).name: value for tag, value in details.items()}
        | {GPS(tag).name: value for tag, value in gps.items()}
    ]
    unread = metadata.unread
    for packet in (*metadata.xmp, *sidecars):
        try:
            read = read_takeout if packet[:1] in (b"{", b"[") else read_xmp
            sources.append(read(packet))
        except ValueError as error:
            unread = str(error)
    time = read_time(sources)
    places = [read_place(tags) for tags in sources]
    located = next((place for place in places if place.latitude is not None), CapturePlace())
    errors = (*(place.error for place in places), unread)
    headings = (
        true_heading(
            replace(place, latitude=located.latitude, longitude=located.longitude), time.captured_at
        )
        for place in places
    )
    camera, is_unique = _camera(main, details)
    parts = structure.picture
    return PhotoHeader(
        width=width,
        height=height,
        latitude=located.latitude,
        longitude=located.longitude,
        altitude=next((p.altitude for p in places if p.altitude is not None), None),
        heading=next((heading for heading in headings if heading is not None), None),
        has_heading=any(place.heading is not None for place in places),
        captured_at=time.captured_at,
        time_zone_is_known=time.time_zone_is_known,
        clock_offset=time.clock_offset,
        camera=camera,
        camera_is_unique=is_unique,
        focal_length=_focal_length(details, structure.width, structure.height),
        gps_error=next(filter(None, errors), None) if located.latitude is None else None,
        picture=PictureData(f"{width} {height} {orientation}", parts) if parts else None,
        quarter_turns=QUARTER_TURNS.get(orientation, 0) if isinstance(orientation, int) else 0,
    )


class _ExifReader:
    """Reads the directories of all EXIF blocks of a photo, and notes those that are broken."""

    def __init__(self, metadata: Metadata) -> None:
        self._metadata = metadata

    def read(self) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any]]:
        """Return the tags of the main directory, of the camera's and of the GPS."""
        main: dict[int, Any] = {}
        details: dict[int, Any] = {}
        gps: dict[int, Any] = {}
        for block in self._metadata.exif:
            found = self._directory(block, block.first_offset, MAIN_TAGS)
            main |= found
            if IFD.Exif in found:
                details |= self._directory(block, found[IFD.Exif], CAMERA_TAGS)
            if IFD.GPSInfo in found:
                gps |= self._directory(block, found[IFD.GPSInfo], GPS_TAGS)
        return main, details, gps

    def _directory(self, block: TiffBlock, offset: Any, tags: Collection[int]) -> dict[int, Any]:
        try:
            return block.read_directory(index(offset), tags)
        except PHOTO_READ_ERRORS:
            self._metadata.unread = "its EXIF is damaged"
            return {}


def _focal_length(details: dict[int, Any], width: int, height: int) -> float | None:
    # The resolution is that of the photo as it was taken: this file may be a smaller copy.
    taken = details.get(Base.ExifImageWidth), details.get(Base.ExifImageHeight)
    if all(isinstance(side, int) and side > 0 for side in taken):
        width, height = cast("tuple[int, int]", taken)
    return focal_length_from_exif(
        width,
        height,
        finite_number(details.get(Base.FocalLengthIn35mmFilm)),
        finite_number(details.get(Base.FocalLength)),
        finite_number(details.get(Base.FocalPlaneXResolution)),
        details.get(Base.FocalPlaneResolutionUnit, EXIF_INCH),
    )


def _camera(main: dict[int, Any], details: dict[int, Any]) -> tuple[str | None, bool]:
    """Return the camera's name, and whether it tells the camera from others of its model."""
    names, own = (
        [text.strip("\0 ") for text in texts if isinstance(text, str) and text.strip("\0 ")]
        for texts in (
            (main.get(Base.Make), main.get(Base.Model)),
            (details.get(Base.CameraOwnerName), details.get(Base.BodySerialNumber)),
        )
    )
    return " ".join(names + own) or None, any(text.strip("0") for text in own)
