"""The JSON that Google Takeout writes beside a photo, which has the place that a user gave it."""

from __future__ import annotations

import contextlib
import json
from datetime import UTC, datetime


def read_takeout(data: bytes) -> dict[str, str]:
    """Return place and time by the names of EXIF tags; empty for another program's JSON.

    Raises:
        ValueError: It is no JSON.
    """
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError("its JSON is damaged") from error
    tags = {}
    with contextlib.suppress(LookupError, TypeError, ValueError):
        place = value["geoData"]
        tags["GPSLatitude"] = f"{place['latitude']:.9f}"
        tags["GPSLongitude"] = f"{place['longitude']:.9f}"
        if place["altitude"]:  # 0 if it is unknown
            tags["GPSAltitude"] = f"{place['altitude']:.2f}"
    with contextlib.suppress(LookupError, TypeError, ValueError, OverflowError, OSError):
        taken = datetime.fromtimestamp(int(value["photoTakenTime"]["timestamp"]), UTC)
        tags["DateTimeOriginal"] = taken.isoformat()
    return tags
