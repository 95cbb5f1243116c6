"""The benchmark of place estimates, on a map whose photos are points around their places."""

from __future__ import annotations

import numpy as np

from benchmarks.estimates import (
    DescribedPhotos,
    add_answers,
    add_left_out,
    add_reliability,
    fit_and_judge,
    left_out_labels,
)
from benchmarks.report import Report
from shared.evaluation.place_evidence import PhotoLocation
from shared.evaluation.place_levels import LevelScheme

PLACES, PER_PLACE, FLOORS = 24, 6, 8


def described() -> DescribedPhotos:
    rng = np.random.default_rng(0)
    rows = np.repeat(rng.normal(size=(PLACES, 16)), PER_PLACE, 0)
    rows += 0.3 * rng.normal(size=rows.shape)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    places = [f"house/{n % FLOORS}/{n}" for n in range(PLACES) for _ in range(PER_PLACE)]
    return DescribedPhotos(
        "house",
        rows.astype(np.float32),
        [PhotoLocation(None, None, place) for place in places],
        [None] * len(places),
        np.arange(len(places)) % PER_PLACE == 0,
        np.arange(len(places)) // PER_PLACE,
        LevelScheme(labels_are_paths=True, radii_m=(25.0,)),
        25.0,
    )


def test_queries_of_clear_places_are_answered_rightly() -> None:
    photos = described()
    judged = fit_and_judge(photos, ~photos.is_query, photos.is_query)
    assert len(judged) == PLACES
    report = Report("estimates")
    add_answers(report, "house", judged)
    add_reliability(report, "house", judged)
    measured = {figure.what: figure.measured for figure in report.figures}
    assert measured["house: answered"] > 80
    assert measured["house: right"] == 100
    assert measured["house: ECE of level 0"] < 0.2


def test_each_floor_is_left_out_once_and_its_photos_get_few_fine_answers() -> None:
    photos = described()
    groups = list(left_out_labels(photos))
    assert np.sum(groups, axis=0).tolist() == [1] * len(photos.rows)
    missing = groups[0]
    judged = fit_and_judge(photos, ~photos.is_query & ~missing, missing)
    report = Report("estimates")
    add_left_out(report, "house", judged)
    assert next(figure.measured for figure in report.figures) <= 20
    assert all(j.is_right[0] is False for j in judged)
