"""Renders a planned city on all cores and writes it as a dataset.

Training photos are written in the layout gsv_xs, or in that of the original GSV-Cities.
"""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import utm

from lab.city.camera import TextureCache
from lab.city.catalogue import make_catalogue
from lab.city.plan import ZONE_LETTER, ZONE_NUMBER, CityPlan, PlannedPhoto, city_name
from lab.city.postprocess import SkyAndGrain, encode_jpeg, postprocess
from lab.city.render import QuarterRenderer
from lab.city.textures import random_stream
from shared.errors import Conflict, Misconfigured

GSV_XS_COLUMNS = ("place_id", "class_name", "UTMx", "UTMy", "filename")
GSV_CITIES_COLUMNS = (
    "place_id", "year", "month", "northdeg", "city_id", "lat", "lon", "panoid",
)  # fmt: skip


class TrainingLayoutName(StrEnum):
    """Layout of the training photos."""

    GSV_XS = "gsv_xs"
    GSV_CITIES = "gsv-cities"


def with_training_layout(plan: CityPlan, layout: TrainingLayoutName) -> CityPlan:
    """Return the plan with the training photos in the folders and names of a layout."""
    if layout == TrainingLayoutName.GSV_XS:
        return plan
    folder = f"{layout}/Images/{city_name(plan.options)}"
    photos = [
        replace(photo, folder=folder, name=f"{'_'.join(_gsv_cities_fields(plan, photo))}.jpg")
        if photo.role == "train"
        else photo
        for photo in plan.photos
    ]
    return CityPlan(plan.options, plan.quarters, photos)


def _write_training_table(plan: CityPlan, out: Path) -> None:
    """Write the CSV table of the training photos, in the layout of their folder."""
    city = city_name(plan.options)
    train = sorted((s for s in plan.photos if s.role == "train"), key=lambda photo: photo.number)
    if not train or train[0].folder.startswith(TrainingLayoutName.GSV_XS):
        path = out / TrainingLayoutName.GSV_XS / "dataframes" / f"{city}.csv"
        _write(path, GSV_XS_COLUMNS, _gsv_xs_rows(city, train))
    else:
        path = out / TrainingLayoutName.GSV_CITIES / "Dataframes" / f"{city}.csv"
        _write(path, GSV_CITIES_COLUMNS, _gsv_cities_rows(plan, train))


def _gsv_xs_rows(city: str, train: Sequence[PlannedPhoto]) -> Iterator[tuple[object, ...]]:
    for photo in train:
        yield photo.place, city, f"{photo.camera.x:.2f}", f"{photo.camera.y:.2f}", photo.name


def _gsv_cities_rows(plan: CityPlan, train: Sequence[PlannedPhoto]) -> Iterator[tuple[object, ...]]:
    for photo in train:
        city, _, year, month, heading, *rest = _gsv_cities_fields(plan, photo)
        yield photo.place, int(year), int(month), int(heading), city, *rest


def _gsv_cities_fields(plan: CityPlan, photo: PlannedPhoto) -> tuple[str, ...]:
    """Return city, place, year, month, heading, latitude, longitude and panorama id."""
    latitude, longitude = utm.to_latlon(photo.camera.x, photo.camera.y, ZONE_NUMBER, ZONE_LETTER)
    return (
        city_name(plan.options),
        f"{photo.place:07d}",
        f"{photo.session.starts_at:%Y}",
        f"{photo.session.starts_at:%m}",
        f"{round(photo.camera.yaw) % 360:03d}",
        f"{float(latitude):.6f}",
        f"{float(longitude):.6f}",
        f"{photo.quarter}{photo.place:05d}-{photo.session.name}-{photo.number:06d}",
    )


def _write(path: Path, columns: Sequence[str], rows: Iterator[tuple[object, ...]]) -> None:
    path.parent.mkdir(parents=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


PHOTOS_PER_TASK = 160
"""A few streets; their houses are drawn once for all photos of a task"""
MAX_WORKERS = 16
"""Each worker needs about 300 MB for textures and the current photo"""
NOT_COMPARABLE = "generated: not comparable with published figures"


def check_output_empty(out: Path) -> None:
    """Raise Conflict (`out_not_empty`) if the folder is not empty."""
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise Conflict(
            "out_not_empty",
            f"{out} is not an empty folder. Use a folder that does not exist yet, or empty it "
            "(an interrupted run leaves photos without a city.json).",
        )


def write_city(
    plan: CityPlan, out: Path, on_progress: Callable[[int], None] = lambda count: None
) -> None:
    """Write `database/`, `queries/`, `gsv_xs/` (or `gsv-cities/`) and `city.json` below `out`.

    Training photos are of a separate quarter. `on_progress` is called with the number of photos
    written since the last call.

    Raises:
        Conflict: `out_not_empty`.
        Misconfigured: `out_unwritable`.
    """
    check_output_empty(out)
    try:
        for folder in sorted({photo.folder for photo in plan.photos} | {"database", "queries"}):
            (out / folder).mkdir(parents=True, exist_ok=True)
        _render_all(plan, out, on_progress)
        if plan.options.train:
            _write_training_table(plan, out)
        (out / "city.json").write_text(json.dumps(describe_city(plan), indent=1) + "\n")
    except OSError as error:
        raise Misconfigured("out_unwritable", f"Can't write to {out}: {error}.") from error


def _render_all(plan: CityPlan, out: Path, on_progress: Callable[[int], None]) -> None:
    tasks = [
        (start, start + PHOTOS_PER_TASK) for start in range(0, len(plan.photos), PHOTOS_PER_TASK)
    ]
    workers = min(len(tasks), os.cpu_count() or 1, MAX_WORKERS)
    if workers <= 1:  # no process pool needed
        worker = _RenderWorker(plan, out)
        for task in tasks:
            on_progress(worker.render(*task))
        return
    # Spawned, not forked: forking a parent with threads can deadlock.
    with ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_render_worker,
        initargs=(plan, out),
    ) as pool:
        try:
            for done in as_completed([pool.submit(_render, *task) for task in tasks]):
                on_progress(done.result())
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def describe_city(plan: CityPlan) -> dict[str, Any]:
    """Return the content of `city.json`: arguments, counts, and the kind of each query."""
    queries = [photo for photo in plan.photos if photo.role == "query"]
    return {
        "made_by": "placewise datasets synth",
        "note": NOT_COMPARABLE,
        "arguments": asdict(plan.options),
        "city": city_name(plan.options),
        "counts": dict(sorted(Counter(photo.role for photo in plan.photos).items())),
        "query_kinds": dict(sorted(Counter(photo.kind for photo in queries).items())),
        "sessions": {
            role: dict(
                sorted(Counter(s.session.name for s in plan.photos if s.role == role).items())
            )
            for role in ("database", "query", "ride", "train")
        },
        "queries": {
            photo.name: {"kind": photo.kind, "session": photo.session.name}
            for photo in sorted(queries, key=lambda photo: photo.number)
        },
    }


class _RenderWorker:
    """State of a rendering process: catalogue, sky and grain, texture cache."""

    def __init__(self, plan: CityPlan, out: Path) -> None:
        self.plan = plan
        self.out = out
        self.catalogue = make_catalogue(plan.options.catalogue_seed)
        self.sky_and_grain = SkyAndGrain.generate(
            plan.options.catalogue_seed, plan.options.width, plan.options.height
        )
        cache = TextureCache()
        self.renderers = {
            name: QuarterRenderer(quarter, self.catalogue, cache)
            for name, quarter in plan.quarters.items()
        }

    def render(self, start: int, stop: int) -> int:
        """Render and write the photos [start, stop) of the plan; return their number."""
        photos = self.plan.photos[start:stop]
        for photo in photos:
            photo.path(self.out).write_bytes(self.render_photo(photo))
        return len(photos)

    def render_photo(self, photo: PlannedPhoto) -> bytes:
        """Render one photo to JPEG bytes."""
        view = self.renderers[photo.quarter].view(photo.camera, photo.session)
        rng = random_stream(self.plan.options.seed, "photo", photo.role, photo.number)
        return encode_jpeg(
            postprocess(view, photo.camera, photo.session, self.sky_and_grain, rng), photo.session
        )


_render_worker: _RenderWorker | None = None  # of this process


def _start_render_worker(plan: CityPlan, out: Path) -> None:
    global _render_worker
    # The parent handles Ctrl-C and shuts down the pool; workers print no traceback.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _render_worker = _RenderWorker(plan, out)


def _render(start: int, stop: int) -> int:
    assert _render_worker is not None
    return _render_worker.render(start, stop)
