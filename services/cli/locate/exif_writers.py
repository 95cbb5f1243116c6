"""Writing coordinates into the EXIF of a photo, by the program exiftool or the library pyexiv2."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from services.cli.locate.sidecars import METHOD
from shared.errors import Misconfigured, PlacewiseError, Unprocessable
from shared.imaging.photo_header import read_photo_header

TOLERANCE_DEGREES = 1e-6
ExifWriter = Callable[[Path, float, float, float], None]
"""Takes the photo, latitude and longitude in degrees, and the radius of 68 % in metres"""


def find_exif_writer() -> ExifWriter:
    """Return the writer that is installed.

    Raises:
        Misconfigured: `no_exif_writer`.
    """
    program = shutil.which("exiftool")
    if program:
        return lambda *position: _write_with_exiftool(program, *position)
    if find_spec("pyexiv2"):
        return _write_with_pyexiv2
    raise Misconfigured(
        "no_exif_writer",
        "Writing EXIF needs exiftool (Debian, Ubuntu: apt install libimage-exiftool-perl; macOS: "
        "brew install exiftool), or pyexiv2: uv pip install '.[exif]' in the repository. "
        "--write sidecar needs neither.",
    )


def write_exif(
    writer: ExifWriter, photo: Path, latitude: float, longitude: float, radius_68_m: float
) -> None:
    """Write coordinates into a photo and read them back.

    Raises:
        Unprocessable: `exif_not_written`.
    """
    writer(photo, latitude, longitude, radius_68_m)
    try:
        with photo.open("rb") as file:
            header = read_photo_header(file, sys.maxsize)
    except PlacewiseError as error:
        raise Unprocessable("exif_not_written", error.detail) from error
    for written, read in ((latitude, header.latitude), (longitude, header.longitude)):
        if read is None or abs(written - read) > TOLERANCE_DEGREES:
            raise Unprocessable(
                "exif_not_written", "The coordinates can't be read back from the EXIF."
            )


def _write_with_exiftool(
    program: str, photo: Path, latitude: float, longitude: float, radius_68_m: float
) -> None:
    arguments = [
        f"-GPSLatitude={abs(latitude):.7f}",
        f"-GPSLatitudeRef={'NS'[latitude < 0]}",
        f"-GPSLongitude={abs(longitude):.7f}",
        f"-GPSLongitudeRef={'EW'[longitude < 0]}",
        "-GPSMapDatum=WGS-84",
        f"-GPSHPositioningError={radius_68_m:.0f}",
        f"-GPSProcessingMethod={METHOD}",
    ]
    run = subprocess.run(  # noqa: S603 the program is exiftool
        [program, "-q", "-overwrite_original", *arguments, str(photo.absolute())],
        capture_output=True,
        text=True,
    )
    if run.returncode:
        reason = " ".join(run.stderr.split())
        raise Unprocessable("exif_not_written", f"exiftool can't write the EXIF: {reason}")


def _write_with_pyexiv2(photo: Path, latitude: float, longitude: float, radius_68_m: float) -> None:
    import pyexiv2  # optional

    values = {
        "GPSVersionID": "2 3 0 0",
        "GPSLatitude": _rationals(latitude),
        "GPSLatitudeRef": "NS"[latitude < 0],
        "GPSLongitude": _rationals(longitude),
        "GPSLongitudeRef": "EW"[longitude < 0],
        "GPSMapDatum": "WGS-84",
        "GPSHPositioningError": f"{radius_68_m:.0f}/1",
        "GPSProcessingMethod": f'charset="Ascii" {METHOD}',
    }
    try:
        with pyexiv2.Image(str(photo)) as image:
            image.modify_exif({f"Exif.GPSInfo.{name}": text for name, text in values.items()})
    except RuntimeError as error:
        raise Unprocessable("exif_not_written", f"pyexiv2 can't write the EXIF: {error}") from error


def _rationals(degrees: float) -> str:
    """Format degrees as EXIF's degrees, minutes and seconds."""
    minutes, seconds = divmod(round(abs(degrees) * 3600, 5), 60)
    whole, minutes = divmod(minutes, 60)
    return f"{whole:.0f}/1 {minutes:.0f}/1 {round(seconds * 100_000)}/100000"
