"""Draws a planned city on all cores and leaves it as a data set on disk.

The city's training photos in the layout that a trainer asks for, and the table beside them.

`plan` puts them into gsv_xs; the same photos can be laid out as the original GSV-Cities.
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

from shared.errors import Conflict, Misconfigured
from shared.synthetic_city.camera import TextureCache
from shared.synthetic_city.catalogue import make_catalogue
from shared.synthetic_city.plan import ZONE_LETTER, ZONE_NUMBER, CityPlan, PlannedPhoto, city_name
from shared.synthetic_city.postprocess import SkyAndGrain, encode_jpeg, postprocess
from shared.synthetic_city.render import QuarterRenderer
from shared.synthetic_city.textures import random_stream

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


PHOTOS_PER_TASK = 160
"""a few streets: their houses are drawn once for all photos of a task"""
MAX_WORKERS = 16
"""each keeps about 300 MB: textures, and a photo at work"""
NOT_COMPARABLE = "generated: not comparable with published figures"


def check_output_empty(out: Path) -> None:
    """Conflict (`out_not_empty`) when the folder holds anything."""
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise Conflict(
            "out_not_empty",
            f"{out} is not an empty folder. Name a folder that does not exist yet, or empty it "
            "(an interrupted drawing leaves its photos there, without a city.json).",
        )


def write_city(
    plan: CityPlan, out: Path, on_progress: Callable[[int], None] = lambda count: None
) -> None:
    """Write `database/`, `queries/`, `gsv_xs/` (or `gsv-cities/`) and `city.json` below `out`.

    The photos to learn from are drawn for themselves, in a quarter of their own. `on_progress`
    is told
    how many photos are ready. Raises Conflict when `out` is not empty, Misconfigured
    (`out_unwritable`) when it can't be written.
    """
    check_output_empty(out)
    try:
        for folder in sorted({shot.folder for shot in plan.photos} | {"database", "queries"}):
            (out / folder).mkdir(parents=True, exist_ok=True)
        _draw_all(plan, out, on_progress)
        if plan.options.train:
            write_training_table(plan, out)
        (out / "city.json").write_text(json.dumps(describe_city(plan), indent=1) + "\n")
    except OSError as error:
        raise Misconfigured("out_unwritable", f"Can't write below {out}: {error}.") from error


def _draw_all(plan: CityPlan, out: Path, drawn: Callable[[int], None]) -> None:
    tasks = [
        (start, start + PHOTOS_PER_TASK) for start in range(0, len(plan.photos), PHOTOS_PER_TASK)
    ]
    workers = min(len(tasks), os.cpu_count() or 1, MAX_WORKERS)
    if workers <= 1:  # not worth a process
        workshop = _RenderWorker(plan, out)
        for task in tasks:
            drawn(workshop.draw(*task))
        return
    # Spawned, not forked: the parent may hold threads, and a fork of those can hang.
    with ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_render_worker,
        initargs=(plan, out),
    ) as pool:
        try:
            for done in as_completed([pool.submit(_draw, *task) for task in tasks]):
                drawn(done.result())
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def describe_city(plan: CityPlan) -> dict[str, Any]:
    """What `city.json` holds: every argument, what was made, and the kind of each query."""
    queries = [shot for shot in plan.photos if shot.role == "query"]
    return {
        "made_by": "placewise datasets synth",
        "note": NOT_COMPARABLE,
        "arguments": asdict(plan.options),
        "city": city_name(plan.options),
        "counts": dict(sorted(Counter(shot.role for shot in plan.photos).items())),
        "query_kinds": dict(sorted(Counter(shot.kind for shot in queries).items())),
        "sessions": {
            role: dict(
                sorted(Counter(s.session.name for s in plan.photos if s.role == role).items())
            )
            for role in ("database", "query", "train")
        },
        "queries": {
            shot.name: {"kind": shot.kind, "session": shot.session.name}
            for shot in sorted(queries, key=lambda shot: shot.number)
        },
    }


class _RenderWorker:
    """What one drawing process keeps between tasks: catalogue, film, textures."""

    def __init__(self, plan: CityPlan, out: Path) -> None:
        self.plan = plan
        self.out = out
        self.catalogue = make_catalogue(plan.options.catalogue_seed)
        self.film = SkyAndGrain.generate(
            plan.options.catalogue_seed, plan.options.width, plan.options.height
        )
        memory = TextureCache()
        self.painters = {
            name: QuarterRenderer(quarter, self.catalogue, memory)
            for name, quarter in plan.quarters.items()
        }

    def draw(self, start: int, stop: int) -> int:
        """Draw and write the plan's shots from `start` to before `stop`; how many they are."""
        shots = self.plan.photos[start:stop]
        for shot in shots:
            (self.out / shot.folder / shot.name).write_bytes(self.photo(shot))
        return len(shots)

    def photo(self, shot: PlannedPhoto) -> bytes:
        view = self.painters[shot.quarter].view(shot.camera, shot.session)
        rng = random_stream(self.plan.options.seed, "photo", shot.role, shot.number)
        return encode_jpeg(
            postprocess(view, shot.camera, shot.session, self.film, rng), shot.session
        )


_render_worker: _RenderWorker | None = None  # of this drawing process


def _start_render_worker(plan: CityPlan, out: Path) -> None:
    global _render_worker
    # Ctrl-C is for the parent, which ends its pool; a child's own trace would only confuse.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _render_worker = _RenderWorker(plan, out)


def _draw(start: int, stop: int) -> int:
    assert _render_worker is not None
    return _render_worker.draw(start, stop)
