"""XMP sidecars: coordinates are read, and added to a sidecar without changing anything else in it.

XMP is RDF in XML (ISO 16684-1). Coordinates are properties of the EXIF schema with degrees and
decimal minutes, such as `exif:GPSLatitude="48,51.500000N"`. They go into an `rdf:Description` of
their own before the end of `rdf:RDF`; all other bytes stay as they are, which no XML library of
Python does when it writes a document again.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from shared.errors import Unprocessable
from shared.imaging.file_formats import PHOTO_READ_ERRORS
from shared.imaging.file_structure import read_structure

EXIF = "http://ns.adobe.com/exif/1.0/"
RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
METHOD = "estimated by Placewise"
TRUE_NORTH = "T"  # GPSImgDirectionRef: not the magnetic one
EMPTY_SIDECAR = f"""<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="{RDF}">
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>
""".encode()
COORDINATE = re.compile(r"(\d{1,3}),(\d+(?:\.\d+)?)(?:,(\d+(?:\.\d+)?))?([NSEW])")


def find_sidecar(photo: Path) -> Path | None:
    """Return the sidecar of a photo: `IMG_1.jpg.xmp`, or else `IMG_1.xmp`; None if none exists."""
    names = (sidecar_path(photo), photo.with_suffix(".xmp"))
    return next((path for path in names if os.path.isfile(path)), None)  # noqa: PTH113 any length


def sidecar_path(photo: Path) -> Path:
    """Return the path of the XMP sidecar that is written for a photo: `IMG_1.jpg.xmp`."""
    return photo.with_name(f"{photo.name}.xmp")


def embedded_xmp(file: BinaryIO) -> bytes | None:
    """Return the XMP in a JPEG, PNG, WebP or TIFF photo; None if there is none."""
    try:
        return read_structure(file).xmp
    except PHOTO_READ_ERRORS:
        return None


def read_position(xmp: bytes) -> tuple[float, float] | None:
    """Return (latitude, longitude) in degrees; None if there are none, or they can't be read."""
    try:
        values = _exif_properties(xmp)
    except ElementTree.ParseError:
        return None
    latitude = _parse_degrees(values.get("GPSLatitude"))
    longitude = _parse_degrees(values.get("GPSLongitude"))
    return None if latitude is None or longitude is None else (latitude, longitude)


def add_position(
    existing: bytes | None,
    latitude: float,
    longitude: float,
    radius_68_m: float,
    heading: float | None = None,
) -> bytes:
    """Return a sidecar with coordinates.

    Args:
        existing: The sidecar so far; None for a new one.
        latitude, longitude: Degrees.
        radius_68_m: Radius that contains the position with a probability of 68 %.
        heading: Degrees clockwise from north; a sidecar that has one keeps it.

    Raises:
        Unprocessable: `bad_sidecar` if it can't be edited, `has_coordinates` if it has some.
    """
    data = existing or EMPTY_SIDECAR
    try:
        there = _exif_properties(data)
        offset, about = _end_of_rdf(data)
    except (ElementTree.ParseError, expat.ExpatError, ValueError) as error:
        raise Unprocessable("bad_sidecar", f"The sidecar can't be edited: {error}.") from error
    if {"GPSLatitude", "GPSLongitude"} & there.keys():
        raise Unprocessable("has_coordinates", "The sidecar has coordinates already.")
    properties = {
        "GPSVersionID": "2.3.0.0",
        "GPSLatitude": _format_degrees(latitude, "NS"),
        "GPSLongitude": _format_degrees(longitude, "EW"),
        "GPSMapDatum": "WGS-84",
        "GPSHPositioningError": hundredths(radius_68_m),
        "GPSProcessingMethod": METHOD,
    }
    if heading is not None and "GPSImgDirection" not in there:
        properties |= {
            "GPSImgDirection": hundredths(heading),
            "GPSImgDirectionRef": TRUE_NORTH,
        }
    added = "".join(
        f'\n    exif:{name}="{value}"' for name, value in properties.items() if name not in there
    )
    element = (
        f"<rdf:Description rdf:about={quoteattr(about)}\n"
        f'    xmlns:rdf="{RDF}"\n    xmlns:exif="{EXIF}"{added}/>\n '
    )
    return data[:offset] + element.encode() + data[offset:]


def hundredths(value: float) -> str:
    """Return a length or an angle as a rational of EXIF."""
    return f"{round(100 * value)}/100"


def _exif_properties(xmp: bytes) -> dict[str, str]:
    """Return the properties of the EXIF schema, as attributes or elements."""
    prefix, values = f"{{{EXIF}}}", {}
    for element in ElementTree.fromstring(xmp).iter():  # noqa: S314 Expat bounds entities
        pairs = [*element.attrib.items(), (element.tag, element.text or "")]
        values.update(
            {name.removeprefix(prefix): text for name, text in pairs if name.startswith(prefix)}
        )
    return values


def _end_of_rdf(xmp: bytes) -> tuple[int, str]:
    """Return the offset of the end tag of rdf:RDF in bytes, and what its content is about."""
    xmp.decode("utf-8")  # offsets and what is inserted are UTF-8
    parser = expat.ParserCreate(namespace_separator=" ")
    ends: list[int] = []
    about: list[str] = []

    def start(name: str, attributes: dict[str, str]) -> None:
        if name == f"{RDF} Description":
            about.append(attributes.get(f"{RDF} about", attributes.get("about", "")))

    def end(name: str) -> None:
        if name == f"{RDF} RDF":
            ends.append(parser.CurrentByteIndex)

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(xmp, True)
    if len(ends) != 1 or not xmp.startswith(b"</", ends[0]):
        raise ValueError("it has no element rdf:RDF with an end tag")
    return ends[0], about[0] if about else ""


def _format_degrees(degrees: float, letters: str) -> str:
    whole, minutes = divmod(round(abs(degrees) * 60, 6), 60)
    return f"{whole:.0f},{minutes:.6f}{letters[degrees < 0]}"


def _parse_degrees(text: str | None) -> float | None:
    match = COORDINATE.fullmatch((text or "").strip())
    if match is None:
        return None
    degrees = float(match[1]) + float(match[2]) / 60 + float(match[3] or 0) / 3600
    return -degrees if match[4] in "SW" else degrees
