"""`make demo`: indexes a generated city, fits, evaluates, queries, and draws a picture.

    python -m lab.demo [--places 300] [--picture docs/demo.jpg]

Half of the city's queries are uploaded as labelled queries: the printed recall is theirs, and the
map's confidence is calibrated with them. The other half is held out and queried as a user's photos,
for the picture. Results of a generated city are not comparable with published ones.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from PIL import Image, ImageDraw, ImageFont

from lab.city.plan import CityOptions, make_plan
from lab.city.write import NOT_COMPARABLE, write_city
from placewise.answers import Estimate
from placewise.client import Client
from services.cli.client import connect, wait_for_job
from services.cli.ingest.geotags import LocalPhoto, find_photos
from services.cli.ingest.upload import switch_off_fits, upload_photos
from services.cli.output import progress_bar
from shared.evaluation.places.evidence import PhotoLocation, distance_between_m

if TYPE_CHECKING:
    from rich.progress import Progress


CORRECT_WITHIN_M = 25.0


@dataclass(frozen=True, slots=True)
class QueryOutcome:
    """A query photo with its ground truth and its result."""

    query: Path
    in_map: bool
    best: str
    """File name of the most similar photo."""
    best_is_correct: bool
    estimate: Estimate
    error_m: float | None
    """Distance of the estimate from the ground truth; None without an estimated location."""


def _query_with_photo(
    client: Client, query: LocalPhoto, database: Sequence[LocalPhoto]
) -> QueryOutcome:
    """Query with a photo that is not stored, and compare the result with its ground truth."""
    truth = _location(query.fields)
    answer = client.similar(query.path, top_k=1)
    best, estimate = answer.similar_images[0], answer.estimate
    return QueryOutcome(
        query=query.path,
        in_map=any(_is_near(truth, _location(photo.fields)) for photo in database),
        best=best.original_filename,
        best_is_correct=_is_near(truth, _location(dict(best))),
        estimate=estimate,
        error_m=distance_between_m(truth, _location(dict(estimate))),
    )


def _location(fields: Mapping[str, Any]) -> PhotoLocation:
    latitude, longitude = fields.get("latitude"), fields.get("longitude")
    if latitude is None or longitude is None:
        return PhotoLocation(None, None, None)
    return PhotoLocation(float(latitude), float(longitude), None)


def _is_near(a: PhotoLocation, b: PhotoLocation) -> bool:
    distance = distance_between_m(a, b)
    return distance is not None and distance <= CORRECT_WITHIN_M


COLUMNS = 6
CELL = (240, 180)
CAPTION = 22
EDGE = 4
GAP = 16
CORRECT_COLOUR, WRONG_COLOUR, OUT_OF_MAP_COLOUR = (46, 160, 67), (207, 60, 50), (150, 150, 150)


def _draw_outcomes(outcomes: Sequence[QueryOutcome], database: Path, target: Path) -> None:
    """Write a JPEG of queries, each above its best match in the colour of the answer."""
    chosen = _choose_outcomes(outcomes)
    width = COLUMNS * (CELL[0] + GAP) + GAP
    block = 2 * CELL[1] + 2 * CAPTION + 2 * GAP
    rows = -(-len(chosen) // COLUMNS)
    sheet = Image.new("RGB", (width, rows * block + GAP), "white")
    pen = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=14)
    for number, outcome in enumerate(chosen):
        left = GAP + number % COLUMNS * (CELL[0] + GAP)
        top = GAP + number // COLUMNS * block
        frame = OUT_OF_MAP_COLOUR if outcome.estimate.in_map is False else WRONG_COLOUR
        frame = CORRECT_COLOUR if outcome.best_is_correct and frame == WRONG_COLOUR else frame
        _paste(sheet, outcome.query, left, top)
        pen.text((left, top + CELL[1] + 2), "query", fill="black", font=font)
        below = top + CELL[1] + CAPTION
        right, bottom = left + CELL[0], below + CELL[1]
        pen.rectangle((left - EDGE, below - EDGE, right + EDGE, bottom + EDGE), frame)
        _paste(sheet, database / outcome.best, left, below)
        pen.text((left, below + CELL[1] + EDGE), _caption(outcome), fill=frame, font=font)
    target.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(target, quality=85)


def _choose_outcomes(outcomes: Sequence[QueryOutcome]) -> list[QueryOutcome]:
    """Choose two rows: mostly accepted and correct, then wrong, then rejected queries."""
    accepted = [a for a in outcomes if a.estimate.in_map]
    rejected = [a for a in outcomes if a.estimate.in_map is False]
    groups = (
        ([a for a in accepted if a.best_is_correct], COLUMNS + 1),
        ([a for a in accepted if not a.best_is_correct], 1),
        ([a for a in rejected if a.in_map], 1),
        ([a for a in rejected if not a.in_map], 3),
    )
    chosen = [group[:: max(1, len(group) // count)][:count] for group, count in groups]
    return [outcome for group in chosen for outcome in group][: 2 * COLUMNS]


def _caption(outcome: QueryOutcome) -> str:
    if outcome.estimate.in_map is False:
        return "not in this map" + (" (it is)" if outcome.in_map else "")
    confidence = outcome.estimate.confidence
    error = f"{outcome.error_m:.0f} m off" if outcome.error_m is not None else "no place"
    return error if confidence is None else f"{error}, {confidence:.0%} sure"


def _paste(sheet: Image.Image, path: Path, left: int, top: int) -> None:
    with Image.open(path) as photo:
        sheet.paste(photo.convert("RGB").resize(CELL, Image.Resampling.BICUBIC), (left, top))


def main(
    places: int = 300,
    views: int = 3,
    queries: int = 400,
    out_of_map: float = 0.2,
    seed: int = 0,
    picture: Path | None = None,
) -> None:
    """Index and query a generated city; half of the queries are labelled.

    `views` are the database photos of a place, `out_of_map` is the share of the queries outside the
    map, and `picture` the JPEG file of queries and matches to write.
    """
    # As the command does before torch is loaded; see services/cli/__init__.py.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with tempfile.TemporaryDirectory() as folder, progress_bar() as progress:
        os.environ["PLACEWISE_HOME"] = str(Path(folder, "home"))
        os.environ["AUTO_EVALUATE_PHOTOS"] = "0"  # the demo starts its evaluations itself
        city = Path(folder, "city")
        options = CityOptions(places, views, queries, seed, 0, out_of_map, 320, 240, train=False)
        plan = make_plan(options)
        bar = progress.add_task("rendering", total=len(plan.photos))
        write_city(plan, city, lambda count: progress.advance(bar, count))
        with connect(None, None) as client:
            outcomes = _run_demo(client, city, progress)
        if picture:
            _draw_outcomes(outcomes, city / "database", picture)
            print(f"Queries and their matches: {picture}")


def _run_demo(client: Client, city: Path, progress: Progress) -> list[QueryOutcome]:
    """Index, evaluate, fit, evaluate again, query; prints recall before and after the fit."""
    database = find_photos(city / "database", None, None)
    queries = find_photos(city / "queries", None, None)
    labelled = [replace(q, fields={**q.fields, "role": "query"}) for q in queries[::2]]
    switch_off_fits(client)
    indexed = upload_photos(client, database + labelled, progress)
    print(NOT_COMPARABLE)
    print(f"{indexed['searchable']} photos indexed; R@1 / R@5 / R@10 of the labelled queries:")
    for vocabulary in ("foreign", "own"):
        if vocabulary == "own":
            wait_for_job(client, client.fit_vocabulary(), progress, "vocabulary")
        job = wait_for_job(client, client.evaluate(), progress, "evaluating")
        metrics = (job.result or {})["labelled_queries"]
        shares = " / ".join(f"{metrics[f'R@{k}']:.1%}" for k in (1, 5, 10))
        print(f"  {vocabulary:7s} vocabulary  {shares}  ({metrics['queries']} queries)")
    bar = progress.add_task("querying", total=len(queries[1::2]))
    outcomes = []
    for query in queries[1::2]:
        outcomes.append(_query_with_photo(client, query, database))
        progress.advance(bar)
    return outcomes


if __name__ == "__main__":
    typer.run(main)
