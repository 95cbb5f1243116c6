"""Properties of XMP packets that say when and where a photo was taken.

XMP is RDF in XML (ISO 16684-1). A property is an attribute or a child of an `rdf:Description` of
`rdf:RDF`; one within a structure, such as the place that a photo shows, is none of the photo's.
The cost is bounded: by the size of the packet, which the reader of the file limits, by Expat's
limits of entities, and by the numbers below.
"""

from __future__ import annotations

from itertools import islice
from xml.etree import ElementTree

EXIF = "http://ns.adobe.com/exif/1.0/"
RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
MAX_DESCRIPTIONS = 100
MAX_ELEMENTS = 1000  # of a description
PLACE_PROPERTIES = (
    *("GPSLatitude", "GPSLatitudeRef", "GPSLongitude", "GPSLongitudeRef"),
    *("GPSAltitude", "GPSAltitudeRef", "GPSImgDirection", "GPSImgDirectionRef"),
)
# What else belongs to them, and is not written twice.
OTHER_PROPERTIES = (
    *("GPSTimeStamp", "GPSVersionID", "GPSMapDatum", "GPSHPositioningError"),
    "GPSProcessingMethod",
)
# Names of EXIF tags, and the properties of other schemas with the same meaning.
PROPERTIES = {
    **{name: (f"{{{EXIF}}}{name}",) for name in (*PLACE_PROPERTIES, *OTHER_PROPERTIES)},
    "DateTimeOriginal": (
        f"{{{EXIF}}}DateTimeOriginal",
        "{http://ns.adobe.com/photoshop/1.0/}DateCreated",
    ),
    "DateTimeDigitized": (
        f"{{{EXIF}}}DateTimeDigitized",
        "{http://ns.adobe.com/xap/1.0/}CreateDate",
    ),
}


def read_xmp(packet: bytes) -> dict[str, str]:
    """Return the properties of a packet by the names of the EXIF tags that they stand for.

    Raises:
        ValueError: It is no XML.
    """
    try:
        root = ElementTree.fromstring(packet.strip(b"\0 \t\r\n"))  # noqa: S314 Expat bounds entities
    except (ElementTree.ParseError, LookupError) as error:
        raise ValueError("its XMP is damaged") from error
    values: dict[str, str] = {}
    rdf = next(root.iter(f"{{{RDF}}}RDF"), None)
    for description in islice([] if rdf is None else rdf, MAX_DESCRIPTIONS):
        elements = {each.tag: each.text for each in islice(description, MAX_ELEMENTS)}
        for name, properties in PROPERTIES.items():
            for each in properties:
                text = (description.get(each) or elements.get(each) or "").strip()
                if text:
                    values.setdefault(name, text)
    return values
