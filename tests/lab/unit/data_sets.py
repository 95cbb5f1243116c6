"""Small data sets that tests write: real photos of a few pixels under the names of the field."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import utm
from PIL import Image

from lab.datasets.dataset import EvaluationSet
from lab.datasets.utm_names import UtmFileName
from shared.errors import PlacewiseError


def utm_name(east: float, north: float, note: str = "") -> str:
    """A file name at a place in UTM zone 32T, metres."""
    return UtmFileName(east, north, 32, "T", note=note).file_name()


def write_photo(path: Path, number: int = 0) -> Path:
    """A photo of 8 x 6 pixels, another for each number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    Image.new("RGB", (8, 6), (number % 256, number // 256, 7)).save(buffer, "JPEG")
    path.write_bytes(buffer.getvalue())
    return path


def write_photos(folder: Path, names: Iterable[str]) -> list[Path]:
    return [write_photo(folder / name, number) for number, name in enumerate(names)]


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
    return path


def save_names(path: Path, names: Sequence[str]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.array(names))
    return path


def save_lists(path: Path, rows: Sequence[Sequence[int]]) -> Path:
    """An object array of Python lists, as the ground truths of sf_xs are."""
    lists = np.empty(len(rows), object)
    for number, row in enumerate(rows):
        lists[number] = list(row)
    np.save(path, lists, allow_pickle=True)
    return path


def msls_city(folder: Path, photos: list[dict[str, Any]]) -> None:
    """The four tables as Mapillary writes them; `m` is metres east of the city's corner."""

    def write(name: str, header: tuple[str, ...], cells: Any) -> None:
        table = [(number, *cells(photo)) for number, photo in enumerate(photos)]
        write_csv(folder / name, ("", *header), table)

    def degrees(photo: dict[str, Any]) -> tuple[float, float]:
        latitude, longitude = utm.to_latlon(350_000 + photo["m"], 6_170_000, 33, "U")
        return float(longitude), float(latitude)

    write(
        "raw.csv",
        ("key", "lon", "lat", "ca", "captured_at", "pano"),
        lambda p: (p["key"], *degrees(p), 370.0, "2019-01-01", p.get("pano", False)),
    )
    # Metres as if the city lay 7 m further east: only the official protocol uses them.
    write(
        "postprocessed.csv",
        ("key", "easting", "northing", "night", "view_direction"),
        lambda p: (p["key"], 350_007.0 + p.get("official", p["m"]), 6_170_000.0, False, "Forward"),
    )
    write(
        "seq_info.csv",
        ("key", "sequence_key", "frame_number"),
        lambda p: (p["key"], p.get("sequence", "s1"), p.get("frame", 4)),
    )
    write("subtask_index.csv", ("all", "s2w"), lambda p: (p.get("all", True), False))
    write_photos(folder / "images", [f"{photo['key']}.jpg" for photo in photos])


def pair(base: Path, database: list[float], queries: list[float]) -> None:
    """Photos along one street, at these metres."""
    for name, spots in (("database", database), ("queries", queries)):
        write_photos(base / name, [utm_name(480_000 + m, 4_880_000) for m in spots])


def rows(opened: EvaluationSet) -> list[list[int]]:
    return [found.tolist() for found in opened.positives]


def names(opened: EvaluationSet) -> tuple[list[str], list[str]]:
    return [s.name for s in opened.database], [s.name for s in opened.queries]


@contextlib.contextmanager
def refused(code: str, message: str | None = None) -> Iterator[None]:
    """Expect an error with this code, whose detail matches the pattern `message`."""
    with pytest.raises(PlacewiseError, match=message) as caught:
        yield
    assert caught.value.code == code
