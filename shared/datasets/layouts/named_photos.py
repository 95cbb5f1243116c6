"""Photos on disk as shots: by their file names, and by EXIF where names say nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from shared.datasets.shots import DatasetPhoto
from shared.datasets.utm_names import parse_utm_file_name
from shared.errors import Unprocessable
from shared.intake.photo_header import read_photo_header

UNLIMITED_PIXELS = 2**62  # of pixels: only the header is read here


def photo_from_filename(path: Path, name: str, place: str | None = None) -> DatasetPhoto:
    """By an `@UTM@` file name; a photo of another name has no position.

    Raises InvalidRequest (`bad_coordinates`).
    """
    spot = parse_utm_file_name(path.name)
    if spot is None:
        return DatasetPhoto(path, name, place=place)
    return DatasetPhoto(
        path,
        name,
        easting=spot.east,
        northing=spot.north,
        zone=spot.zone,
        latitude=spot.latitude,
        longitude=spot.longitude,
        heading=spot.heading,
        place=place,
    )


def add_exif_positions(
    shots: Iterable[DatasetPhoto], done: Callable[[int], None] = lambda count: None
) -> list[DatasetPhoto]:
    """The shots, those without a position with what EXIF says; a photo that has none, or that can't
    be read, stays without."""
    located = []
    for shot in shots:
        located.append(shot if shot.easting is not None else _add_exif_position(shot))
        done(1)
    return located


def _add_exif_position(shot: DatasetPhoto) -> DatasetPhoto:
    try:
        with shot.path.open("rb") as file:
            header = read_photo_header(file, UNLIMITED_PIXELS)
    except (OSError, Unprocessable):
        # Whoever decodes it says so; here it is a photo of which nothing is known.
        return shot
    return DatasetPhoto(
        shot.path,
        shot.name,
        latitude=header.latitude,
        longitude=header.longitude,
        heading=header.heading,
        place=shot.place,
        frame=shot.frame,
        sequence=shot.sequence,
    )
