"""`make demo`: a made-up city, indexed, fitted, evaluated and asked, from nothing to a picture.

    python -m benchmarks.demo [--places 300] [--picture docs/demo.jpg]

Half of the city's queries are uploaded as labelled queries, so that the map learns what its scores
mean; the other half it has never seen: they are asked as a user's photos, and what is printed of
them is what a user would get. Every figure is of a generated place: not comparable with published
figures.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.asked import QueryOutcome, query_with_photo, summarise_outcomes
from benchmarks.picture import draw_outcomes
from shared.client import Client
from shared.datasets.city.plan import CityOptions, make_plan
from shared.datasets.city.write import NOT_COMPARABLE, write_city

if TYPE_CHECKING:
    from rich.progress import Progress


def main() -> None:
    # As the command does before torch is loaded; see services/cli/__init__.py.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    options = _arguments()
    from services.cli.connect import connect
    from services.cli.output import progress_bar

    with tempfile.TemporaryDirectory() as folder, progress_bar() as progress:
        os.environ["PLACEWISE_HOME"] = str(Path(folder, "home"))
        os.environ["AUTO_EVALUATE_PHOTOS"] = "0"  # the demo evaluates when it wants to print
        city = Path(folder, "city")
        _draw_city(options, city, progress)
        with connect(None, None) as client:
            asked = _run_demo(client, city, progress)
        _print_outcomes(asked)
        if options.picture:
            draw_outcomes(asked, city / "database", options.picture)
            print(f"Queries and their matches: {options.picture}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="From a made-up city to answers.")
    parser.add_argument("--places", type=int, default=300)
    parser.add_argument("--views", type=int, default=3, help="database photos of a place")
    parser.add_argument("--queries", type=int, default=400, help="half of them labelled")
    parser.add_argument("--out-of-map", type=float, default=0.2, help="share of the queries")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, help="where to draw queries and matches")
    return parser.parse_args()


def _draw_city(options: argparse.Namespace, city: Path, progress: Progress) -> None:
    plan = make_plan(
        CityOptions(
            places=options.places,
            views=options.views,
            queries=options.queries,
            seed=options.seed,
            catalogue_seed=0,
            out_of_map=options.out_of_map,
            width=320,
            height=240,
            train=False,
        )
    )
    bar = progress.add_task("drawing the city", total=len(plan.photos))
    write_city(plan, city, lambda count: progress.advance(bar, count))


def _run_demo(client: Client, city: Path, progress: Progress) -> list[QueryOutcome]:
    """Index, evaluate, fit, evaluate, ask; prints recall before and after the fit."""
    from services.cli.photo_places import find_photos
    from services.cli.upload_many import upload_photos
    from services.cli.vocabulary import fit_and_wait
    from services.cli.wait import wait_for_job

    database = find_photos(city / "database", None, None)
    queries = find_photos(city / "queries", None, None)
    labelled = [replace(q, fields={**q.fields, "role": "query"}) for q in queries[::2]]
    indexed = upload_photos(client, database + labelled, fit=False, progress=progress)
    print(NOT_COMPARABLE)
    print(f"{indexed['searchable']} photos indexed; R@1 / R@5 / R@10 of the labelled queries:")
    for vocabulary in ("foreign", "own"):
        if vocabulary == "own":
            fit_and_wait(client, {}, progress)
        job = wait_for_job(client, client.evaluate()["job_id"], progress, "evaluating")
        found = job["result"]["labelled_queries"]
        shares = " / ".join(f"{found[f'R@{k}']:.1%}" for k in (1, 5, 10))
        print(f"  {vocabulary:7s} vocabulary  {shares}  ({found['queries']} queries)")
    bar = progress.add_task("asking", total=len(queries[1::2]))
    asked = []
    for query in queries[1::2]:
        asked.append(query_with_photo(client, query, database))
        progress.advance(bar)
    return asked


def _print_outcomes(outcomes: list[QueryOutcome]) -> None:
    found = summarise_outcomes(outcomes)
    print(f"{found['queries']} photos that it had never seen, {found['out_of_map']} out of map:")
    print(f"  right place first, of those in the map    {found['R@1']:.1%}")
    print(
        f"  of the estimates that it gave, right      {_format_percent(found['right_of_accepted'])}"
    )
    print(
        f"  places in the map that it gave            {_format_percent(found['accepted_in_map'])}"
    )
    print(f"  false accepts of photos out of map        {_format_percent(found['false_accepts'])}")
    print(f"  median error of the right ones            {found['median_error_m']:.1f} m")
    if found["calibration_error"] is not None:
        print(f"  calibration error of the confidence       {found['calibration_error']:.3f}")
        print(f"  AUROC                                     {found['auroc']:.3f}")
        print(f"  recall at 99 % precision                  {found['recall_at_99_precision']:.1%}")


def _format_percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


if __name__ == "__main__":
    main()
