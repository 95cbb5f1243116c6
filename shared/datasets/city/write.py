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
from shared.datasets.city.develop import Film, develop, encode
from shared.datasets.city.plan import Plan, Shot, city_name
from shared.datasets.city.random_streams import stream
from shared.datasets.city.render import Painter
from shared.datasets.city.texture_memory import TextureMemory
from shared.datasets.city.training_files import write_train_table
from shared.errors import Conflict, Misconfigured

SHOTS_PER_TASK = 160
"""a few streets: their houses are drawn once for all photos of a task"""
MOST_WORKERS = 16
"""each keeps about 300 MB: textures, and a photo at work"""
NOT_COMPARABLE = "generated: not comparable with published figures"


def check_empty(out: Path) -> None:
    """Conflict (`out_not_empty`) when the folder holds anything."""
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise Conflict(
            "out_not_empty",
            f"{out} is not an empty folder. Name a folder that does not exist yet, or empty it "
            "(an interrupted drawing leaves its photos there, without a city.json).",
        )


def write_city(plan: Plan, out: Path, drawn: Callable[[int], None] = lambda count: None) -> None:
    """Write `database/`, `queries/`, `gsv_xs/` (or `gsv-cities/`) and `city.json` below `out`.

    The photos to learn from are drawn for themselves, in a quarter of their own. `drawn` is told
    how many photos are ready. Raises Conflict when `out` is not empty, Misconfigured
    (`out_unwritable`) when it can't be written.
    """
    check_empty(out)
    try:
        for folder in sorted({shot.folder for shot in plan.shots} | {"database", "queries"}):
            (out / folder).mkdir(parents=True, exist_ok=True)
        _draw_all(plan, out, drawn)
        if plan.options.train:
            write_train_table(plan, out)
        (out / "city.json").write_text(json.dumps(describe(plan), indent=1) + "\n")
    except OSError as error:
        raise Misconfigured("out_unwritable", f"Can't write below {out}: {error}.") from error


def _draw_all(plan: Plan, out: Path, drawn: Callable[[int], None]) -> None:
    tasks = [(start, start + SHOTS_PER_TASK) for start in range(0, len(plan.shots), SHOTS_PER_TASK)]
    workers = min(len(tasks), os.cpu_count() or 1, MOST_WORKERS)
    if workers <= 1:  # not worth a process
        workshop = _Workshop(plan, out)
        for task in tasks:
            drawn(workshop.draw(*task))
        return
    # Spawned, not forked: the parent may hold threads, and a fork of those can hang.
    with ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_open_workshop,
        initargs=(plan, out),
    ) as pool:
        try:
            for done in as_completed([pool.submit(_draw, *task) for task in tasks]):
                drawn(done.result())
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def describe(plan: Plan) -> dict[str, Any]:
    """What `city.json` holds: every argument, what was made, and the kind of each query."""
    queries = [shot for shot in plan.shots if shot.role == "query"]
    return {
        "made_by": "placewise datasets synth",
        "note": NOT_COMPARABLE,
        "arguments": asdict(plan.options),
        "city": city_name(plan.options),
        "counts": dict(sorted(Counter(shot.role for shot in plan.shots).items())),
        "query_kinds": dict(sorted(Counter(shot.kind for shot in queries).items())),
        "sessions": {
            role: dict(
                sorted(Counter(s.session.name for s in plan.shots if s.role == role).items())
            )
            for role in ("database", "query", "train")
        },
        "queries": {
            shot.name: {"kind": shot.kind, "session": shot.session.name}
            for shot in sorted(queries, key=lambda shot: shot.number)
        },
    }


class _Workshop:
    """What one drawing process keeps between tasks: catalogue, film, textures."""

    def __init__(self, plan: Plan, out: Path) -> None:
        self.plan = plan
        self.out = out
        self.catalogue = make_catalogue(plan.options.catalogue_seed)
        self.film = Film.of(plan.options.catalogue_seed, plan.options.width, plan.options.height)
        memory = TextureMemory()
        self.painters = {
            name: Painter(quarter, self.catalogue, memory)
            for name, quarter in plan.quarters.items()
        }

    def draw(self, start: int, stop: int) -> int:
        """Draw and write the plan's shots from `start` to before `stop`; how many they are."""
        shots = self.plan.shots[start:stop]
        for shot in shots:
            (self.out / shot.folder / shot.name).write_bytes(self.photo(shot))
        return len(shots)

    def photo(self, shot: Shot) -> bytes:
        view = self.painters[shot.quarter].view(shot.camera, shot.session)
        rng = stream(self.plan.options.seed, "photo", shot.role, shot.number)
        return encode(develop(view, shot.camera, shot.session, self.film, rng), shot.session)


_workshop: _Workshop | None = None  # of this drawing process


def _open_workshop(plan: Plan, out: Path) -> None:
    global _workshop
    # Ctrl-C is for the parent, which ends its pool; a child's own trace would only confuse.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _workshop = _Workshop(plan, out)


def _draw(start: int, stop: int) -> int:
    assert _workshop is not None
    return _workshop.draw(start, stop)
