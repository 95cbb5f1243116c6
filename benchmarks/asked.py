"""Asking as a user does, with photos whose place is known, and what the answers were worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from services.cli.photo_places import LocalPhoto
from shared.client import Client, Json
from shared.estimate.figures import auroc, expected_calibration_error, recall_at_precision
from shared.estimate.places import PhotoLocation, distance_between_m

CORRECT_WITHIN_M = 25.0


@dataclass(frozen=True, slots=True)
class QueryOutcome:
    """One query photo, its truth and its answer."""

    query: Path
    in_map: bool
    best: str
    """File name of the most similar photo."""
    best_is_correct: bool
    estimate: Json
    error_m: float | None
    """From the truth to the estimate; None where it gave no place."""

    @property
    def right(self) -> bool:
        return self.error_m is not None and self.error_m <= CORRECT_WITHIN_M


def query_with_photo(
    client: Client, query: LocalPhoto, database: Sequence[LocalPhoto]
) -> QueryOutcome:
    """Ask with a photo that is not stored, and compare the answer with what its name says."""
    truth = _location(query.fields)
    answer = client.similar_to_file(query.path, top_k=1)
    best, estimate = answer["similar_images"][0], answer["estimate"]
    return QueryOutcome(
        query=query.path,
        in_map=any(_is_near(truth, _location(photo.fields)) for photo in database),
        best=best["original_filename"],
        best_is_correct=_is_near(truth, _location(best)),
        estimate=estimate,
        error_m=distance_between_m(truth, _location(estimate)),
    )


def summarise_outcomes(outcomes: Sequence[QueryOutcome]) -> Json:
    """Recall, false accepts and the confidence's figures; the latter None while uncalibrated."""
    here = [a for a in outcomes if a.in_map]
    outside = [a for a in outcomes if not a.in_map]
    accepted = [a for a in outcomes if a.estimate["in_map"]]
    errors = [a.error_m for a in outcomes if a.right and a.error_m is not None]
    said = [a.estimate["confidence"] for a in outcomes]
    # Without a place no estimate is right; the best photo then stands for what was found.
    right = [a.right or (a.estimate["in_map"] is False and a.best_is_correct) for a in outcomes]
    known = None not in said
    return {
        "queries": len(outcomes),
        "out_of_map": len(outside),
        "R@1": _ratio(sum(a.best_is_correct for a in here), len(here)),
        "right_of_accepted": _ratio(sum(a.right for a in accepted), len(accepted)),
        "accepted_in_map": _ratio(sum(bool(a.estimate["in_map"]) for a in here), len(here)),
        "false_accepts": _ratio(sum(bool(a.estimate["in_map"]) for a in outside), len(outside)),
        "median_error_m": median(errors) if errors else None,
        "calibration_error": expected_calibration_error(said, right) if known else None,
        "auroc": auroc(said, right) if known else None,
        "recall_at_99_precision": recall_at_precision(said, right, len(here)) if known else None,
    }


def _location(fields: Json) -> PhotoLocation:
    latitude, longitude = fields.get("latitude"), fields.get("longitude")
    if latitude is None or longitude is None:
        return PhotoLocation(None, None, None)
    return PhotoLocation(float(latitude), float(longitude), None)


def _is_near(one: PhotoLocation, other: PhotoLocation) -> bool:
    away = distance_between_m(one, other)
    return away is not None and away <= CORRECT_WITHIN_M


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None
