"""Place estimates: how many queries are answered, how many answers are right, how well calibrated.

    placewise bench estimates [FOLDER...] [--splits 5]

Each folder is an evaluation set with coordinates or place labels; labels with a slash are paths.
Without one, it is the folder `tower` of PLACEWISE_TEST_DATA. It is described by the default
extractor, with a vocabulary fitted on its database photos. The place model is fitted on the
database photos only, as that of a live map is, and judged

- on the set's queries;
- on random splits: of all photos, as many as the set has queries become queries, so that a query
  has the same neighbours as a photo of the map;
- on a random half of the set's queries, with the other half as labelled queries, as often;
- on the set's queries with a quarter of the map's second coarsest labels left out, such as floors,
  four times: how many of the photos of these labels get an answer;
- on photos of elsewhere, those of each of the other folders: how many get an answer. Probabilities
  are also judged on the queries with as many of them as the prior says.

Intervals are those of the cluster bootstrap (`shared/evaluation/bootstrap.py`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import Progress

from lab.benchmarks.report import Report, printed_report
from lab.datasets.open_dataset import open_evaluation_set
from lab.evaluation.places import measure_background
from lab.evaluation.query_clusters import cluster_queries
from services.cli.environment import read_settings
from services.cli.output import JsonOption, Table
from shared.errors import InvalidRequest, Misconfigured
from shared.evaluation.bootstrap import share_intervals
from shared.evaluation.calibration import expected_calibration_error
from shared.evaluation.places.evidence import (
    EVIDENCE_DEPTH,
    PhotoLocation,
    RankedPhoto,
    is_same_place,
)
from shared.evaluation.places.fit import MapScores, PlaceSample, fit_place_model
from shared.evaluation.places.levels import LevelScheme, candidate_levels
from shared.evaluation.places.probability import (
    ELSEWHERE_SHARE,
    MapExtent,
    PlaceEstimate,
    PlaceModel,
)
from shared.evaluation.places.samples import (
    IndexRanking,
    MatchOwnPhoto,
    OwnPhotoSampler,
    attach_matches,
)
from shared.place_paths import label_levels

CERTAINTY = 0.95
LEFT_OUT_GROUPS = 4
FOREIGN_PHOTOS = 150  # of each other folder, at most
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class DescribedPhotos:
    """All photos of a set with their descriptors."""

    name: str
    rows: NDArray[np.float32]
    """(n, D)"""
    locations: Sequence[PhotoLocation]
    captured_at: Sequence[datetime | None]
    is_query: Mask
    """(n,) which photos are queries in the published split"""
    clusters: NDArray[np.int64]
    """(n,) clusters of the bootstrap"""
    scheme: LevelScheme
    radius_m: float
    foreign: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """numbers of the photos of other sets, which are neither database photos nor queries"""
    match: MatchOwnPhoto | None = None
    """compares photos; None for estimates without matches"""
    paths: Sequence[Path] = ()
    extractor: str = ""
    """of the descriptors, with a vocabulary fitted on the set"""

    @property
    def is_database(self) -> Mask:
        """(n,) which photos are the map in the published split."""
        in_map = ~self.is_query
        in_map[[number for numbers in self.foreign.values() for number in numbers]] = False
        return in_map


@dataclass(frozen=True, slots=True)
class Judged:
    """An estimate and whether each of its levels is right; None where the truth does not say."""

    estimate: PlaceEstimate
    is_right: Sequence[bool | None]
    cluster: int
    """of the bootstrap"""

    @property
    def is_finest(self) -> bool:
        return self.estimate.answer == 0

    @property
    def is_answer_right(self) -> bool | None:
        return None if self.estimate.answer is None else self.is_right[self.estimate.answer]


@dataclass(frozen=True, slots=True)
class Share:
    """A share of estimates, with its target in %."""

    name: str
    judged: Sequence[Judged]
    counts: Callable[[Judged], bool]
    at_least: float | None = None
    at_most: float | None = None


Folders = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Evaluation sets with coordinates or places. Default: tower in PLACEWISE_TEST_DATA.",
        exists=True,
    ),
]


def evaluation_folders(folders: list[Path] | None) -> list[Path]:
    """Return the folders to measure, by default the tower; Misconfigured (`no_data_set`)."""
    if folders:
        return folders
    if "PLACEWISE_TEST_DATA" not in os.environ:
        raise Misconfigured(
            "no_data_set", "Name an evaluation set, or the folder of tower/ in PLACEWISE_TEST_DATA."
        )
    return [Path(os.environ["PLACEWISE_TEST_DATA"]) / "tower"]


def bench(
    folders: Folders = None,
    splits: Annotated[int, typer.Option(min=0, help="Random splits of each set.")] = 5,
    as_json: JsonOption = False,
) -> None:
    """Measure how often place estimates answer, how often they are right, and their calibration."""
    measured = evaluation_folders(folders)
    with printed_report(f"estimates at certainty {CERTAINTY}", as_json) as (report, progress):
        for photos in describe_sets(measured, progress):
            measure_set(report, photos, splits, progress)


def measure_set(report: Report, photos: DescribedPhotos, splits: int, progress: Progress) -> None:
    """Report the estimates of one evaluation set."""
    bar = progress.add_task(photos.name, total=1 + splits)
    in_map = photos.is_database
    add_published(report, photos.name, photos)
    progress.advance(bar)
    drawn: list[Judged] = []
    refined: list[Judged] = []
    for seed in range(splits):
        everything = in_map | photos.is_query
        chosen = draw(everything, int(photos.is_query.sum()), seed)
        drawn += fit_and_judge(photos, everything & ~chosen, chosen)
        labelled = draw(photos.is_query, int(photos.is_query.sum()) // 2, seed)
        unlabelled = photos.is_query & ~labelled
        refined += fit_and_judge(photos, in_map, unlabelled, labelled)
        progress.advance(bar)
    add_judged(report, f"{photos.name}, {splits} random splits", drawn)
    add_judged(report, f"{photos.name}, half of its queries labelled", refined)
    add_left_out(report, photos.name, photos)


def add_published(report: Report, what: str, photos: DescribedPhotos) -> list[Judged]:
    """Report and return the estimates of the set's queries; report those of photos of elsewhere."""
    trial = TrialMap(photos, photos.is_database)
    model = trial.fit()
    judged = trial.judge(model, np.flatnonzero(photos.is_query))
    add_judged(report, f"{what}, its queries", judged)
    foreign = {name: trial.judge(model, numbers) for name, numbers in photos.foreign.items()}
    for name, each in foreign.items():
        share = Share(
            "in the map", each, lambda j: j.estimate.in_map is True, at_most=100 * (1 - CERTAINTY)
        )
        _add_shares(report, f"{what}, photos of {name}", share)
    elsewhere = list(chain(*foreign.values()))
    if count := min(len(elsewhere), round(len(judged) * ELSEWHERE_SHARE / (1 - ELSEWHERE_SHARE))):
        mixed = [*judged, *elsewhere[:: len(elsewhere) // count][:count]]
        _add_reliability(report, f"{what}, with {ELSEWHERE_SHARE:.0%} from elsewhere", mixed)
    return judged


def describe_sets(
    folders: Sequence[Path],
    progress: Progress,
    own_vocabulary: bool = True,
    most_of_each: int = FOREIGN_PHOTOS,
) -> Iterator[DescribedPhotos]:
    """Describe evaluation sets as new maps would be, with photos of the others as queries.

    A set whose photos have no places is no map; its photos are those of another set all the same.
    """
    # Decoder processes import the program, and their memory limit leaves no room for torch.
    from lab.cli.evaluation.describers import FeatureCache, extractor_describer
    from lab.evaluation.ranking import describe_to_matrix

    settings = read_settings()
    cache = FeatureCache(settings.new_map_extractor, settings)
    for folder in folders:
        try:
            dataset = open_evaluation_set(folder)
        except InvalidRequest as error:
            if error.code != "no_positions":
                raise
            continue
        photos = [*dataset.database, *dataset.queries]
        paths, foreign = [photo.path for photo in photos], {}
        for other in (each for each in folders if each != folder):
            found = sorted(p for p in other.rglob("*") if p.suffix.lower() in (".jpg", ".png"))
            shown = found[:: -(-len(found) // most_of_each) or 1]
            foreign[other.name] = range(len(paths), len(paths) + len(shown))
            paths += shown
        spots = [PhotoLocation(photo.latitude, photo.longitude, photo.place) for photo in photos]
        if not any(spot.is_known for spot in spots):
            continue
        describer = extractor_describer(
            settings.new_map_extractor, None, dataset, settings, progress,
            fit=own_vocabulary, extractor=cache,
        )  # fmt: skip
        with describe_to_matrix(describer.describe, paths) as rows:
            matrix = np.array(rows)
        numbers, extra = np.arange(len(paths)), len(paths) - len(photos)
        yield DescribedPhotos(
            folder.name,
            matrix,
            [*spots, *[PhotoLocation(None, None, None)] * extra],
            [*(photo.captured_at for photo in photos), *[None] * extra],
            (numbers >= len(dataset.database)) & (numbers < len(photos)),
            np.concatenate([cluster_queries(photos).labels, len(photos) + numbers[:extra]]),
            LevelScheme(
                labels_are_paths=any("/" in (spot.place or "") for spot in spots),
                radii_m=settings.level_radii_m,
            ),
            settings.estimate_radius_m,
            foreign,
            paths=paths,
            extractor=describer.name if own_vocabulary else "",
        )


class TrialMap:
    """A map of some of the photos of a set, searched in memory.

    The model is fitted with matches where the set has them.

    Args:
        photos: The set.
        in_map: (n,) which of its photos are in the map.
    """

    def __init__(self, photos: DescribedPhotos, in_map: Mask) -> None:
        self.members = np.flatnonzero(in_map).tolist()
        self.photos = photos
        self._rows = photos.rows[self.members]
        scores = self._rows @ self._rows.T
        self.locations = [photos.locations[index] for index in self.members]
        match = self.match if photos.match else None
        self.background = measure_background(self._rows, self.locations, match)
        self.extent = MapExtent.of(self.locations, photos.scheme)
        self.own_photos = OwnPhotoSampler(
            self.locations,
            [photos.captured_at[index] for index in self.members],
            photos.scheme,
            photos.radius_m,
            lambda photo: _rank(scores[photo], without=photo),
        )

    def own_samples(self) -> tuple[list[PlaceSample], float]:
        """Return the samples of the map's photos, and their unit of score differences."""
        own = range(len(self.members))
        spread = self.own_photos.spread(own)
        match = self.match if self.photos.match else None
        return list(self.own_photos.samples(own, spread, match)), spread

    def match(self, photo: int, candidates: Sequence[Any]) -> Sequence[float | None]:
        """Return the match support of one photo of the map with others."""
        return self._match(self.members[photo], candidates)

    def _match(self, photo: int, candidates: Sequence[Any]) -> Sequence[float | None]:
        assert self.photos.match is not None
        return self.photos.match(photo, [self.members[number] for number in candidates])

    def fit(self, labelled: Sequence[int] = ()) -> PlaceModel:
        """Fit the place model on the map's photos, and on photos of the set as labelled queries."""
        samples, spread = self.own_samples()
        labels = [sample for q in labelled if (sample := self.query_sample(q, spread)).levels]
        scores = MapScores(spread, self.background, self.extent, self.photos.extractor)
        model = fit_place_model(samples, labels, self.photos.scheme, scores).model
        return model.model_copy(update={"with_matches": model}) if self.photos.match else model

    def estimate(self, query: int, model: PlaceModel) -> PlaceEstimate | None:
        """Estimate the place of a photo; None without similar photos of known place."""
        scheme, radius_m = self.photos.scheme, self.photos.radius_m
        return model.estimate(*self.search(query), scheme, CERTAINTY, radius_m)

    def judge(self, model: PlaceModel, queries: Iterable[int]) -> list[Judged]:
        """Estimate the places of photos, and compare them with the true ones."""
        judged = []
        for query in queries:
            estimate = self.estimate(query, model)
            if estimate is not None:
                truth = self.photos.locations[query]
                # The whole map is judged by the photos of elsewhere.
                finer = estimate.levels[:-1]
                right = [level.is_right(truth) if truth.is_known else False for level in finer]
                right.append(self.has_place(query))
                judged.append(Judged(estimate, right, int(self.photos.clusters[query])))
        return judged

    def has_place(self, query: int) -> bool:
        """Return whether the map has a photo of the place of a photo of the set."""
        truth, radius_m = self.photos.locations[query], self.photos.radius_m
        return any(is_same_place(truth, spot, radius_m) for spot in self.locations)

    def search(self, query: int) -> tuple[list[RankedPhoto], list[RankedPhoto]]:
        """Return the ranking of a photo, and that of the best photo in it."""
        found, scores = _rank(self._rows @ self.photos.rows[query])
        ranking = [
            RankedPhoto(score, self.locations[index], index)
            for index, score in zip(found[:EVIDENCE_DEPTH].tolist(), scores.tolist(), strict=False)
        ]
        if self.photos.match:
            ranking = attach_matches(ranking, partial(self._match, query))
        return ranking, self.own_photos.neighbours(int(found[0]))

    def query_sample(self, query: int, spread: float) -> PlaceSample:
        """Return the sample of a photo of the set."""
        truth = self.photos.locations[query]
        scheme, radius_m = self.photos.scheme, self.photos.radius_m
        levels = candidate_levels(*self.search(query), scheme, spread, radius_m)
        return PlaceSample(query, levels, [level.is_right(truth) for level in levels])


def draw(among: Mask, count: int, seed: int) -> Mask:
    """Return the (n,) mask of `count` photos, drawn at random among some."""
    drawn = np.zeros(len(among), dtype=bool)
    drawn[np.random.default_rng(seed).choice(np.flatnonzero(among), count, replace=False)] = True
    return drawn


def fit_and_judge(
    photos: DescribedPhotos, in_map: Mask, queries: Mask, labelled: Mask | None = None
) -> list[Judged]:
    """Fit the model of a map of some of the photos, and estimate the places of others.

    Args:
        photos: The set.
        in_map: (n,) which of its photos are in the map.
        queries: (n,) which are estimated.
        labelled: (n,) which are labelled queries; none by default.
    """
    trial = TrialMap(photos, in_map)
    model = trial.fit(np.flatnonzero(labelled).tolist() if labelled is not None else [])
    return trial.judge(model, np.flatnonzero(queries).tolist())


def left_out_labels(photos: DescribedPhotos) -> Iterable[Mask]:
    """Yield the (n,) masks of the photos of each group of second coarsest labels."""
    paths = [label_levels(p.place, photos.scheme.labels_are_paths) for p in photos.locations]
    labels = np.array([path[-2] if len(path) > 1 else "" for path in paths])
    names = sorted({*labels.tolist()} - {""})
    for group in range(LEFT_OUT_GROUPS if len(names) > LEFT_OUT_GROUPS else 0):
        yield np.isin(labels, names[group::LEFT_OUT_GROUPS])


def add_judged(report: Report, what: str, judged: Sequence[Judged]) -> None:
    """Report the shares of answers and of right ones among them, in %, and their calibration."""
    if not judged:
        return
    known = [j for j in judged if j.is_answer_right is not None]
    finest = [j for j in known if j.is_finest]
    precision = 100 * CERTAINTY
    _add_shares(
        report,
        what,
        Share("answered", judged, lambda j: j.estimate.answer is not None, at_least=60),
        Share("right", known, lambda j: j.is_answer_right is True, at_least=precision),
        Share("answered at the finest level", judged, lambda j: j.is_finest, at_least=40),
        Share("right there", finest, lambda j: j.is_answer_right is True, at_least=precision),
    )
    _add_reliability(report, what, judged)


def _add_reliability(report: Report, what: str, judged: Sequence[Judged]) -> None:
    """Report the ECE of each level, and show the mean of stated and of observed probabilities."""
    table = Table("level", "stated", "observed", "ECE", title=what)
    for position in range(max(len(j.is_right) for j in judged)):
        known = [
            (j.estimate.probabilities[position], right)
            for j in judged
            if position < len(j.is_right) and (right := j.is_right[position]) is not None
        ]
        stated, observed = [p for p, _ in known], [right for _, right in known]
        error = expected_calibration_error(stated, observed)
        means = (float(np.mean(stated)), float(np.mean(observed)), error)
        table.add_row(str(position), *(f"{value:.3f}" for value in means))
        report.add(f"{what}: ECE of level {position}", error, at_most=0.05)
    report.tables.append(table)


def add_left_out(report: Report, what: str, photos: DescribedPhotos) -> None:
    """Report the shares of photos that get an answer although their label is not in the map."""
    judged: list[Judged] = []
    for missing in left_out_labels(photos):
        judged += fit_and_judge(photos, photos.is_database & ~missing, missing)
    if judged:
        _add_shares(
            report,
            f"{what}, labels left out",
            Share("answered at the finest level", judged, lambda j: j.is_finest, at_most=5),
            Share("wrong at any level", judged, lambda j: j.is_answer_right is False),
        )


def _rank(scores: NDArray[np.float32], without: int | None = None) -> IndexRanking:
    order = np.argsort(-scores, kind="stable")
    order = order[order != without] if without is not None else order
    return order, scores[order].astype(np.float64)


def _add_shares(report: Report, what: str, *shares: Share) -> None:
    """Report shares in %, 100 % of no estimates, and show them with their intervals."""
    table = Table("share", "%", "95 % interval", title=what)
    for share in shares:
        values = np.array([float(share.counts(j)) for j in share.judged])[:, None]
        mean = 100 * float(values.mean()) if len(values) else 100.0
        report.add(
            f"{what}: {share.name}", mean, "%", at_most=share.at_most, at_least=share.at_least
        )
        clusters = np.array([j.cluster for j in share.judged], dtype=np.int64)
        intervals = share_intervals(values, clusters)
        bounds = intervals[0].as_percent() if intervals else ""
        table.add_row(share.name, f"{mean:.1f}", bounds)
    report.tables.append(table)
