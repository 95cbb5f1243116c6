"""`placewise evaluate` of a live map: how often the right place comes first."""

from __future__ import annotations

from rich.progress import Progress
from rich.table import Column, Table

from services.cli.client import connect, wait_for_job
from services.cli.output import console, print_json, progress_bar
from shared.client import Client, Json
from shared.errors import Conflict
from shared.evaluation.calibration import MIN_LABELLED_QUERIES, MIN_QUERIES_PER_CLASS

MAX_EVALUATIONS_SHOWN = 6  # evaluations that were asked for, this one and those before
EVALUATIONS_FETCHED = 100


def evaluate_map(
    sample: int | None,
    seed: int | None,
    word_weights: bool,
    map_name: str | None,
    server: str | None,
    key: str | None,
    as_json: bool,
) -> None:
    """Ask the map about its own photos (each left out in turn) and its labelled queries."""
    wanted = {"sample": sample, "seed": seed}
    given = {name: value for name, value in wanted.items() if value is not None}
    learnt: Json | None = None
    with connect(server, map_name, key) as client, progress_bar() as progress:
        if word_weights:
            learnt = _fit_word_weights(client, given, progress)
        job = wait_for_job(client, client.evaluate(**given)["job_id"], progress, "asking")
        asked_for = [e for e in client.evaluations(EVALUATIONS_FETCHED) if not e["automatic"]][
            :MAX_EVALUATIONS_SHOWN
        ]
        vocabularies = _vocabulary_origins(client)
    if as_json:
        print_json({**job["result"], "word_weights": learnt} if learnt else job["result"])
        return
    _print_evaluations(asked_for, vocabularies)
    if learnt:
        console.print(
            f"Word weights: {learnt['outcome']}. {learnt['reason']}",
            soft_wrap=True,
            markup=False,
        )


def _fit_word_weights(client: Client, parameters: dict[str, int], progress: Progress) -> Json:
    """Learn the active generation's word weights; what came of it."""
    active = [g["generation_id"] for g in client.generations() if g["state"] == "active"]
    if not active:
        raise Conflict(
            "nothing_to_evaluate",
            "The map has no described photo yet. Upload some: placewise index.",
        )
    started = client.learn_word_weights(active[0], **parameters)
    result: Json = wait_for_job(client, started["job_id"], progress, "word weights")["result"]
    return result


def _vocabulary_origins(client: Client) -> dict[str, str]:
    """The origin of each generation's vocabulary, by generation."""
    origins = {v["vocabulary_id"]: v["origin"] for v in client.vocabularies()}
    return {
        g["generation_id"]: origins.get(g["vocabulary_id"], "none") for g in client.generations()
    }


def _print_evaluations(evaluations: list[Json], vocabularies: dict[str, str]) -> None:
    table = Table(
        Column("evaluated", no_wrap=True),
        "vocabulary",
        "photos",
        "asked with",
        *(Column(f"R@{k}", justify="right", no_wrap=True) for k in (1, 5, 10)),
    )
    for found in evaluations:
        figures = found["figures"]
        rows = _recall_rows(figures)
        # Evaluations of earlier releases don't speak of weights.
        if weighted := figures.get("with_word_weights"):
            rows += [(f"{what}, word weights", recall) for what, recall in _recall_rows(weighted)]
        for what, recall in rows:
            table.add_row(
                found["evaluated_at"][5:19].replace("T", " "),
                vocabularies.get(found["generation_id"], ""),
                str(found["searchable"]),
                f"{recall['queries']} {what}",
                *(_format_percent(recall[f"R@{k}"]) for k in (1, 5, 10)),
            )
    console.print(table)
    figures = evaluations[0]["figures"]
    for line in _estimate_lines(figures.get("with_word_weights") or figures):
        console.print(line, soft_wrap=True)


def _recall_rows(figures: Json) -> list[tuple[str, Json]]:
    rows = [("own photos", figures["leave_one_out"])]
    if figures["labelled_queries"]:
        rows.append(("labelled queries", figures["labelled_queries"]))
    return rows


def _estimate_lines(figures: Json) -> list[str]:
    labelled, estimate = figures["labelled_queries"], figures["estimate"]
    lines = [f"Right means within {figures['radius_m']:g} m, or the same label."]
    if labelled is None:
        lines.append(
            "Confidence is uncalibrated: upload photos of another day, with coordinates, as "
            "labelled queries (placewise index DIR --role query)."
        )
        return lines
    if estimate["calibration"] == "uncalibrated":
        teaching = labelled["queries"] + labelled["out_of_map"] - labelled["same_session"]
        lines.append(
            f"Confidence is uncalibrated: {teaching} labelled queries of another session are "
            f"there, at least {MIN_LABELLED_QUERIES} are needed, with "
            f"{MIN_QUERIES_PER_CLASS} whose answer is "
            f"right and {MIN_QUERIES_PER_CLASS} whose answer is wrong."
        )
    lines.append(
        f"Of {labelled['queries']} queries in the map "
        f"{_format_percent(labelled['accepted_in_map'])} are "
        f"accepted; of {labelled['out_of_map']} out of it "
        f"{_format_percent(labelled['false_accepts'])}; "
        f"of all accepted {_format_percent(labelled['right_of_accepted'])} are right."
    )
    if labelled["auroc"] is not None:
        lines.append(
            f"Confidence ({estimate['calibration']}, cross-validated): calibration error "
            f"{labelled['calibration_error']:.3f}, AUROC {labelled['auroc']:.3f}, recall at 99 % "
            f"precision {_format_percent(labelled['recall_at_99_precision'])}."
        )
    return lines


def _format_percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"
