"""Coordinates that are added to an XMP sidecar without changing anything else in it.

Coordinates are properties of the EXIF schema with degrees and
decimal minutes, such as `exif:GPSLatitude="48,51.500000N"`. They go into an `rdf:Description` of
their own before the end of `rdf:RDF`; all other bytes stay as they are, which no XML library of
Python does when it writes a document again. So the sidecar of before is what is left without that
element, and undoing needs no journal.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from services.cli.output import atomic_write, printable_path
from shared.errors import Conflict, Unprocessable
from shared.imaging.xmp import EXIF, RDF, read_xmp

METHOD = "estimated by Placewise"
TRUE_NORTH = "T"  # GPSImgDirectionRef: not the magnetic one
NEW_SIDECAR = f"""<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/" x:xmptk="Placewise">
 <rdf:RDF xmlns:rdf="{RDF}">
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>
""".encode()
NAMESPACES = f'\n    xmlns:rdf="{RDF}"\n    xmlns:exif="{EXIF}"'
ADDED_ELEMENT = re.compile(
    rf"""<rdf:Description rdf:about=("[^"]*"|'[^']*'){NAMESPACES}"""
    r"""(\n    exif:\w+="[^"]*")+/>\n """.encode()
)


def sidecar_path(photo: Path) -> Path:
    """Return the path of the XMP sidecar that is written for a photo: `IMG_1.jpg.xmp`."""
    return photo.with_name(f"{photo.name}.xmp")


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
    data = existing or NEW_SIDECAR
    try:
        there = read_xmp(data)
        offset, about = _end_of_rdf(data)
    except (expat.ExpatError, ValueError) as error:
        raise Unprocessable("bad_sidecar", f"The sidecar can't be edited: {error}.") from error
    if {"GPSLatitude", "GPSLongitude"} & there.keys():
        raise Unprocessable("has_coordinates", "The sidecar has coordinates already.")
    properties = {
        "GPSVersionID": "2.3.0.0",
        "GPSLatitude": _format_degrees(latitude, "NS"),
        "GPSLongitude": _format_degrees(longitude, "EW"),
        "GPSMapDatum": "WGS-84",
        "GPSHPositioningError": _hundredths(radius_68_m),
        "GPSProcessingMethod": METHOD,
    }
    if heading is not None and "GPSImgDirection" not in there:
        properties |= {"GPSImgDirection": _hundredths(heading), "GPSImgDirectionRef": TRUE_NORTH}
    added = "".join(
        f'\n    exif:{name}="{value}"' for name, value in properties.items() if name not in there
    )
    element = f"<rdf:Description rdf:about={quoteattr(about)}{NAMESPACES}{added}/>\n "
    return data[:offset] + element.encode() + data[offset:]


def has_estimate(sidecar: bytes) -> bool:
    """Return whether `add_position` has added to a sidecar, however that was edited since."""
    return ADDED_ELEMENT.search(sidecar) is not None or METHOD.encode() in sidecar


def remove_position(sidecar: bytes) -> bytes | None:
    """Return a sidecar as it was before `add_position`; None if there was none.

    One whose added element another program has changed stays as it is.
    """
    former = ADDED_ELEMENT.sub(b"", sidecar)
    return None if former == NEW_SIDECAR else former


def replace_sidecar(folder: Path, path: Path, content: bytes, existing: bytes | None) -> None:
    """Write a sidecar, whole or not at all; owner, group, mode and extended attributes stay.

    Args:
        folder: What the sidecar has to be in, behind all links.
        existing: What the content was made of; None for a new file.

    Raises:
        Unprocessable: `outside_folder`; `not_a_file`; `owner_differs`, if only another user can
            write a file with the same owner.
        Conflict: `changed_meanwhile`, if the file is another than `existing` by now.
        Misconfigured: `out_unwritable`.
    """
    path = path.resolve()  # a link stays a link
    if not path.is_relative_to(folder.resolve()):
        raise Unprocessable("outside_folder", f"{printable_path(path)} is outside of the folder.")
    if path.exists() and not path.is_file():  # reading a FIFO would wait for ever
        raise Unprocessable("not_a_file", f"{printable_path(path)} is not a regular file.")
    with atomic_write(path) as file:
        file.write(content)
        if existing is not None:
            _copy_attributes(path, Path(file.name))
        if (path.read_bytes() if path.exists() else None) != existing:
            raise Conflict(
                "changed_meanwhile", "Another program has changed the file meanwhile. Try again."
            )


def _copy_attributes(source: Path, target: Path) -> None:
    """Give a file the owner, group, mode and extended attributes (so the ACL) of another one."""
    info, new = source.stat(), target.stat()
    if (info.st_uid, info.st_gid) != (new.st_uid, new.st_gid):
        try:
            os.chown(target, info.st_uid, info.st_gid)
        except PermissionError as error:
            raise Unprocessable(
                "owner_differs",
                f"The file belongs to user {info.st_uid} and group {info.st_gid}, which writing it "
                "would change. Run the command as its owner or as root.",
            ) from error
    shutil.copystat(source, target)  # last: a change of the owner clears bits of the mode
    os.utime(target)


def _hundredths(value: float) -> str:
    """Return a length or an angle as a rational of EXIF."""
    return f"{round(100 * value)}/100"


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
