"""Draws a planned city on all cores and leaves it as a data set on disk."""

from __future__ import annotations

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

from shared.datasets.city.catalogue import make_catalogue
from shared.datasets.city.develop import SkyAndGrain, encode_jpeg, postprocess
from shared.datasets.city.plan import CityPlan, PlannedPhoto, city_name
from shared.datasets.city.random_streams import random_stream
from shared.datasets.city.render import QuarterRenderer
from shared.datasets.city.texture_memory import TextureCache
from shared.datasets.city.training_files import write_training_table
from shared.errors import Conflict, Misconfigured

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

    The photos to learn from are drawn for themselves, in a quarter of their own. `on_progress` is told
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
