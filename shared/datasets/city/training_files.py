"""The city's training photos in the layout that a trainer asks for, and the table beside them.

`plan` puts them into gsv_xs; the same photos can be laid out as the original GSV-Cities.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path

import utm

from shared.datasets.city.plan import ZONE_LETTER, ZONE_NUMBER, CityPlan, PlannedPhoto, city_name

GSV_XS_COLUMNS = ("place_id", "class_name", "UTMx", "UTMy", "filename")
GSV_CITIES_COLUMNS = (
    "place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid",
)  # fmt: skip


class TrainingLayoutName(StrEnum):
    """How the photos to learn from are laid out."""

    GSV_XS = "gsv_xs"
    GSV_CITIES = "gsv-cities"


def with_training_layout(plan: CityPlan, layout: TrainingLayoutName) -> CityPlan:
    """The same photos, those to learn from under the layout's folders and names."""
    if layout == TrainingLayoutName.GSV_XS:
        return plan
    folder = f"{layout}/Images/{city_name(plan.options)}"
    shots = [
        replace(shot, folder=folder, name=f"{'_'.join(_gsv_cities_fields(plan, shot))}.jpg")
        if shot.role == "train"
        else shot
        for shot in plan.photos
    ]
    return CityPlan(plan.options, plan.quarters, shots)


def write_training_table(plan: CityPlan, out: Path) -> None:
    """The CSV of the training photos, in the layout that their folder says."""
    city = city_name(plan.options)
    train = sorted((s for s in plan.photos if s.role == "train"), key=lambda shot: shot.number)
    if not train or train[0].folder.startswith(TrainingLayoutName.GSV_XS):
        path = out / TrainingLayoutName.GSV_XS / "dataframes" / f"{city}.csv"
        _write(path, GSV_XS_COLUMNS, _gsv_xs_rows(city, train))
    else:
        path = out / TrainingLayoutName.GSV_CITIES / "Dataframes" / f"{city}.csv"
        _write(path, GSV_CITIES_COLUMNS, _gsv_cities_rows(plan, train))


def _gsv_xs_rows(city: str, train: Sequence[PlannedPhoto]) -> Iterator[tuple[object, ...]]:
    for shot in train:
        yield shot.place, city, f"{shot.camera.x:.2f}", f"{shot.camera.y:.2f}", shot.name


def _gsv_cities_rows(plan: CityPlan, train: Sequence[PlannedPhoto]) -> Iterator[tuple[object, ...]]:
    for shot in train:
        city, _, year, month, heading, *rest = _gsv_cities_fields(plan, shot)
        yield shot.place, int(year), int(month), int(heading), city, *rest


def _gsv_cities_fields(plan: CityPlan, shot: PlannedPhoto) -> tuple[str, ...]:
    """city, place, year, month, heading, latitude, longitude, panorama: as its name has them."""
    latitude, longitude = utm.to_latlon(shot.camera.x, shot.camera.y, ZONE_NUMBER, ZONE_LETTER)
    return (
        city_name(plan.options),
        f"{shot.place:07d}",
        f"{shot.session.starts_at:%Y}",
        f"{shot.session.starts_at:%m}",
        f"{round(shot.camera.yaw) % 360:03d}",
        f"{float(latitude):.6f}",
        f"{float(longitude):.6f}",
        f"{shot.quarter}{shot.place:05d}-{shot.session.name}-{shot.number:06d}",
    )


def _write(path: Path, columns: Sequence[str], rows: Iterator[tuple[object, ...]]) -> None:
    path.parent.mkdir(parents=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
