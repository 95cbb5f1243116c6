"""Asking as a user does, with photos whose place is known, and what the answers were worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from services.cli.photo_places import FoundPhoto
from shared.client import Client, Json
from shared.estimate.figures import auroc, calibration_error, recall_at_precision
from shared.estimate.places import Spot, metres_between

RIGHT_M = 25.0


@dataclass(frozen=True, slots=True)
class Asked:
    """One query photo, its truth and its answer."""

    query: Path
    in_map: bool
    best: str
    """File name of the most similar photo."""
    best_right: bool
    estimate: Json
    error_m: float | None
    """From the truth to the estimate; None where it gave no place."""

    @property
    def right(self) -> bool:
        return self.error_m is not None and self.error_m <= RIGHT_M


def ask(client: Client, query: FoundPhoto, database: Sequence[FoundPhoto]) -> Asked:
    """Ask with a photo that is not stored, and compare the answer with what its name says."""
    truth = _spot(query.fields)
    answer = client.similar_to_file(query.path, top_k=1)
    best, estimate = answer["similar_images"][0], answer["estimate"]
    return Asked(
        query=query.path,
        in_map=any(_near(truth, _spot(photo.fields)) for photo in database),
        best=best["original_filename"],
        best_right=_near(truth, _spot(best)),
        estimate=estimate,
        error_m=metres_between(truth, _spot(estimate)),
    )


def figures_of(asked: Sequence[Asked]) -> Json:
    """Recall, false accepts and the confidence's figures; the latter None while uncalibrated."""
    here = [a for a in asked if a.in_map]
    outside = [a for a in asked if not a.in_map]
    accepted = [a for a in asked if a.estimate["in_map"]]
    errors = [a.error_m for a in asked if a.right and a.error_m is not None]
    said = [a.estimate["confidence"] for a in asked]
    # Without a place no estimate is right; the best photo then stands for what was found.
    right = [a.right or (a.estimate["in_map"] is False and a.best_right) for a in asked]
    known = None not in said
    return {
        "queries": len(asked),
        "out_of_map": len(outside),
        "R@1": _share(sum(a.best_right for a in here), len(here)),
        "right_of_accepted": _share(sum(a.right for a in accepted), len(accepted)),
        "accepted_in_map": _share(sum(bool(a.estimate["in_map"]) for a in here), len(here)),
        "false_accepts": _share(sum(bool(a.estimate["in_map"]) for a in outside), len(outside)),
        "median_error_m": median(errors) if errors else None,
        "calibration_error": calibration_error(said, right) if known else None,
        "auroc": auroc(said, right) if known else None,
        "recall_at_99_precision": recall_at_precision(said, right, len(here)) if known else None,
    }


def _spot(fields: Json) -> Spot:
    latitude, longitude = fields.get("latitude"), fields.get("longitude")
    if latitude is None or longitude is None:
        return Spot(None, None, None)
    return Spot(float(latitude), float(longitude), None)


def _near(one: Spot, other: Spot) -> bool:
    away = metres_between(one, other)
    return away is not None and away <= RIGHT_M


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
