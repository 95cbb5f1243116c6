"""Renders a planned city on all cores and writes it as a dataset, its training set as gsv_xs."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lab.city.light import encode_jpeg, take_photo
from lab.city.plan import CityPlan, PlannedPhoto, city_name
from lab.city.scene import CityStyle, Scene
from lab.city.textures import random_stream
from shared.errors import Conflict, Misconfigured

GSV_XS_COLUMNS = ("place_id", "class_name", "UTMx", "UTMy", "filename")


def _write_training_table(plan: CityPlan, out: Path) -> None:
    """Write the CSV table of the training photos."""
    city = city_name(plan.options)
    train = sorted((s for s in plan.photos if s.role == "train"), key=lambda photo: photo.number)
    rows = [
        (photo.place, city, f"{photo.camera.x:.2f}", f"{photo.camera.y:.2f}", photo.name)
        for photo in train
    ]
    path = out / "gsv_xs" / "dataframes" / f"{city}.csv"
    path.parent.mkdir(parents=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([GSV_XS_COLUMNS, *rows])


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
    """Write `database/`, `queries/`, `gsv_xs/` and `city.json` below `out`.

    `on_progress` is called with the number of photos written since the last call. Raises Conflict
    (`out_not_empty`), Misconfigured (`out_unwritable`).
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
    starts = range(0, len(plan.photos), PHOTOS_PER_TASK)
    workers = min(len(starts), os.cpu_count() or 1, MAX_WORKERS)
    if workers <= 1:  # no process pool needed
        renderer = PhotoRenderer(plan)
        for start in starts:
            on_progress(renderer.write(out, start, start + PHOTOS_PER_TASK))
        return
    # Spawned, not forked: forking a parent with threads can deadlock.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _start_process, (plan,)) as pool:
        try:
            tasks = [
                pool.submit(_write_photos, out, start, start + PHOTOS_PER_TASK) for start in starts
            ]
            for done in as_completed(tasks):
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
                sorted(Counter(p.session.name for p in plan.photos if p.role == role).items())
            )
            for role in ("database", "query", "ride", "train")
        },
        "queries": {
            photo.name: {"kind": photo.kind, "session": photo.session.name}
            for photo in sorted(queries, key=lambda photo: photo.number)
        },
    }


class PhotoRenderer:
    """Renders the photos of a plan; each process has one, with its textures."""

    def __init__(self, plan: CityPlan) -> None:
        style = CityStyle(plan.options.catalogue_seed)
        self.plan = plan
        self._scenes = {name: Scene(quarter, style) for name, quarter in plan.quarters.items()}

    def render(self, photo: PlannedPhoto) -> bytes:
        """Render one photo to JPEG bytes."""
        scene, session = self._scenes[photo.quarter], photo.session
        rng = random_stream(self.plan.options.seed, "photo", photo.role, photo.number)
        canvas = scene.view(photo.camera, session)
        return encode_jpeg(take_photo(canvas, session, scene.lamps(photo.camera), rng), session)

    def write(self, out: Path, start: int, stop: int) -> int:
        """Render and write the photos [start, stop) of the plan; return their number."""
        photos = self.plan.photos[start:stop]
        for photo in photos:
            photo.path(out).write_bytes(self.render(photo))
        return len(photos)


_renderer: PhotoRenderer | None = None  # of this process


def _start_process(plan: CityPlan) -> None:
    global _renderer
    # The parent handles Ctrl-C and shuts down the pool; workers print no traceback.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _renderer = PhotoRenderer(plan)


def _write_photos(out: Path, start: int, stop: int) -> int:
    assert _renderer is not None
    return _renderer.write(out, start, stop)
