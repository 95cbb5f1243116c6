"""Map evaluation: recall and place estimates of a live map, through the search tier.

*Leave-one-out*: each photo of a sample of the map is searched, itself excluded. The frames before
and after it are easy matches, so the recall is optimistic; it is measured a second time without the
photos of its sequence. Use both to compare two generations of a map. *Labelled queries* (photos of
role `query`) were taken at another time: their recall is what users see.

Where the photos have local features, a second place model is fitted on some of the photos with
their matches. It is used unless it answers less (`answers_less`).
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import filterfalse, islice
from statistics import median
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from services.steward.evaluation_search import (
    UNKNOWN_LOCATION,
    EvaluationSearch,
    GeotaggedPhoto,
    GeotaggedPhotos,
    read_geotagged_photos,
)
from shared.catalog.chunks import find_features_model
from shared.catalog.database.session import Catalog
from shared.catalog.generations import Generation
from shared.catalog.maps import Map, Matching
from shared.catalog.photos import PhotoRole
from shared.catalog.vocabularies import vocabulary_standing
from shared.errors import NotFound
from shared.evaluation.places.evidence import (
    DIFFERENT_PLACE_M,
    EVIDENCE_DEPTH,
    MATCHED_PHOTOS,
    RankedPhoto,
    are_matched,
    distance_between_m,
    estimate_location,
    is_same_place,
)
from shared.evaluation.places.figures import PlaceEvaluation, evaluate_places
from shared.evaluation.places.fit import MIN_OWN_PHOTOS, MapScores, PlaceSample
from shared.evaluation.places.levels import LevelScheme, candidate_levels
from shared.evaluation.places.probability import (
    MIN_LABELLED_QUERIES,
    Background,
    MapExtent,
    PlaceModel,
)
from shared.evaluation.places.samples import (
    SAME_SESSION_PERIOD,
    IndexRanking,
    OwnPhotoSampler,
    attach_matches,
)
from shared.search_api.photo_filter import PhotoFilter
from shared.search_api.protocol import SearchBackend, SearchHit
from shared.storage import ObjectStore
from shared.storage.keys import thumbnail_key

Photo = TypeVar("Photo")

RECALL_RANKS = (1, 5, 10)
COPY_CORRELATION = 0.99  # seen: 0.9997 at 60 % of the size; 0.82 between frames of a walk


@dataclass(slots=True)
class RecallCounter:
    """Recall@k over queries that have a true positive."""

    queries: int = 0
    hits: dict[int, int] = field(default_factory=lambda: dict.fromkeys(RECALL_RANKS, 0))
    """k -> queries with a true positive among the first k."""

    def add(self, correct: Sequence[bool]) -> None:
        """Add a query: for each result, best first, whether it shows the query's place."""
        self.queries += 1
        for rank in RECALL_RANKS:
            self.hits[rank] += any(correct[:rank])

    def figures(self) -> dict[str, Any]:
        return {
            "queries": self.queries,
            **{f"R@{k}": ratio(hits, self.queries) for k, hits in self.hits.items()},
        }


@dataclass(slots=True)
class _OwnPhotoRecall:
    """Recall@k of own photos, and the number of those without another photo of their place."""

    radius_m: float
    recall: RecallCounter = field(default_factory=RecallCounter)
    without_positive: int = 0

    def add(
        self,
        query: GeotaggedPhoto,
        ranked: Iterable[GeotaggedPhoto],
        at_place: Iterable[GeotaggedPhoto],
    ) -> None:
        """Add a query: the photos that it finds, best first, and all others of its place."""
        if not any(True for _ in at_place):
            self.without_positive += 1
            return
        first = islice(ranked, RECALL_RANKS[-1])
        self.recall.add([is_same_place(query.spot, p.spot, self.radius_m) for p in first])

    def figures(self) -> dict[str, Any]:
        return {**self.recall.figures(), "without_positive": self.without_positive}


@dataclass(frozen=True, slots=True)
class QueryOutcome:
    """The result of one labelled query."""

    in_map: bool
    """Whether the map has a photo of its place."""
    is_correct: bool
    """Whether the estimate shows its place."""
    error_m: float | None
    same_session: bool
    """Taken within SAME_SESSION_PERIOD of the photo that it matched: not used for the fit."""
    sample: PlaceSample | None
    """its levels; None if no photo with a place was found"""
    matched_sample: PlaceSample | None
    """the same with features of matches; None if the first photos could not all be matched"""


@dataclass(slots=True)
class _LabelledQueryMetrics:
    """Metrics over all labelled queries of an evaluation."""

    recall: RecallCounter = field(default_factory=RecallCounter)
    outcomes: list[QueryOutcome] = field(default_factory=list)
    denied: list[QueryOutcome] = field(default_factory=list)
    """of photos of which only the denied place is known"""

    def figures(self, model: PlaceModel) -> dict[str, Any]:
        """Return the metrics as JSON; queries are accepted by the model's `in_map`.

        Recall is over queries whose place is in the map, the other metrics are over all.
        """
        accepted = [o for o in self.outcomes if o.sample and model.accepts(o.sample.levels)]
        inside = [o for o in self.outcomes if o.in_map]
        outside = [o for o in self.outcomes if not o.in_map]
        errors = [o.error_m for o in inside if o.is_correct and o.error_m is not None]
        return {
            **self.recall.figures(),
            "out_of_map": len(outside),
            "denied": len(self.denied),
            "same_session": sum(o.same_session for o in self.outcomes),
            "median_error_of_right_ones_m": median(errors) if errors else None,
            "accepted_in_map": ratio(sum(o.in_map for o in accepted), len(inside)),
            "right_of_accepted": ratio(sum(o.is_correct for o in accepted), len(accepted)),
            "false_accepts": ratio(sum(not o.in_map for o in accepted), len(outside)),
        }


def ratio(part: int, total: int) -> float | None:
    """Return `part / total`; None if the total is 0."""
    return part / total if total else None


MAX_MATCHED_SAMPLE = 500  # photos whose matches are computed: about a minute on one core
MIN_PHOTOS_TO_DECIDE = 100  # with fewer, it stays open whether matches help
MAX_ANSWERED_FALL = 0.1  # of the shares of answered queries, at any level and at the finest
DECISIVE_CERTAINTY = 0.95
BACKGROUND_PHOTOS = 200  # whose scores with BACKGROUND_QUERIES others are those of random pairs
BACKGROUND_QUERIES = 30
MAX_RANKS = 800  # depth of the search for other places where hundreds of photos show the same one


@dataclass(frozen=True, slots=True)
class MapEvaluationResult:
    """The metrics of an evaluation, as JSON, and the place model fitted on it."""

    figures: dict[str, Any]
    model: PlaceModel
    uses_matches: bool | None
    """Whether estimates use matches; None if too few photos could be matched."""


def answers_less(without: PlaceEvaluation, with_matches: PlaceEvaluation) -> bool:
    """Return whether fewer queries are answered with matches, at any level and at the finest.

    Where own photos are answered as often, queries of another day are answered more often with
    matches. The share of right answers is the same: both models' thresholds are chosen for it.
    """
    return _answered(with_matches) < _answered(without) - MAX_ANSWERED_FALL


def _answered(places: PlaceEvaluation) -> float:
    assert places.figures is not None
    at = next(a for a in places.figures["answers"] if a["certainty"] == DECISIVE_CERTAINTY)
    answered: float = at["answered"]["mean"] + at["answered_at_finest_level"]["mean"]
    return answered


def _draw(photos: Sequence[Photo], size: int, seed: int) -> list[Photo]:
    """Draw at most `size` photos, reproducible by `seed`, in their order."""
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(photos), size=min(size, len(photos)), replace=False)
    return [photos[index] for index in sorted(chosen.tolist())]


class MapEvaluation:
    """Evaluates one generation of a map.

    Photos within `radius_m` metres show the same place; `scheme` has the levels of an estimate, and
    `matching` tells whether matches are evaluated. `on_query` is called after every search and
    every matched photo; an exception that it raises ends the evaluation. At most `max_photos` of
    the map's photos, and of its labelled queries, are drawn; by default all.
    """

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        search: SearchBackend,
        generation: Generation,
        radius_m: float,
        scheme: LevelScheme,
        matching: Matching,
        on_query: Callable[[], None],
        max_photos: int | None = None,
    ) -> None:
        self.radius_m = radius_m
        self.scheme = scheme
        self.on_query = on_query
        with catalog.read() as session:
            ids = (generation.map_id, generation.id)
            database = read_geotagged_photos(session, *ids, PhotoRole.DATABASE)
            self.database = GeotaggedPhotos(_draw(database, max_photos or len(database), seed=0))
            queries = read_geotagged_photos(session, *ids, PhotoRole.QUERY)
            self.queries = _draw(queries, max_photos or len(queries), seed=0)
            self.denied = read_geotagged_photos(session, *ids, None)
            version = session.get_one(Map, generation.map_id).version
            has_features = find_features_model(session, generation.id) is not None
            has_own_vocabulary = vocabulary_standing(session, generation) == "own"
        self.matching = matching if has_features else Matching.OFF
        is_known = has_own_vocabulary and "pca" not in generation.spec
        self._extractor = generation.extractor if is_known else ""
        self._by_id = {photo.photo_id: photo for photo in self.database.photos}
        self._index_of = {photo.photo_id: i for i, photo in enumerate(self.database.photos)}
        self.search = EvaluationSearch(catalog, search, generation, version, self._by_id)
        self._store = store
        self._pixels: dict[int, NDArray[np.float32]] = {}

    def draw_sample(self, size: int, seed: int) -> list[GeotaggedPhoto]:
        """Draw at most `size` database photos as leave-one-out queries, reproducible by `seed`.

        Not those whose place is an accepted proposal: it would measure the map by its own answers.
        """
        known = [photo for photo in self.database.photos if not photo.place_is_estimated]
        return _draw(known, size, seed)

    def evaluate(self, sample: Sequence[GeotaggedPhoto]) -> MapEvaluationResult:
        """Search with every photo of the sample and every labelled query, and compute the metrics.

        The sample is that of the leave-one-out evaluation.
        """
        own_photos = OwnPhotoSampler(
            [photo.spot for photo in self.database.photos],
            [photo.captured_at for photo in self.database.photos],
            self.scheme,
            self.radius_m,
            self._rank_own_photo,
            self._is_copy,
        )
        recalls = self._leave_one_out(sample, own_photos, lambda _, ranked: ranked)
        indices = [self._index_of[photo.photo_id] for photo in sample]
        spread = own_photos.spread(indices)
        labelled = self._evaluate_labelled_queries(own_photos, spread)
        samples = list(own_photos.samples(indices, spread))
        to_fit = [o for o in labelled.outcomes if not o.same_session]
        if len(to_fit) >= MIN_LABELLED_QUERIES:  # denied answers alone are all wrong
            to_fit += [o for o in labelled.denied if not o.same_session]
        scores = MapScores(
            spread,
            self._measure_background(sample),
            MapExtent.of([photo.spot for photo in self.database.photos], self.scheme),
            self._extractor,
        )
        places = evaluate_places(
            samples, [o.sample for o in to_fit if o.sample], self.scheme, scores
        )
        model = places.model
        with_matches, uses_matches = self._evaluate_matches(own_photos, samples, to_fit, scores)
        if with_matches is not None:
            of_matches = self._leave_one_out(
                _draw(sample, MAX_MATCHED_SAMPLE, seed=len(sample)),
                own_photos,
                self._order_by_matches,
            )
            recalls |= {f"{name}_by_matches": recall for name, recall in of_matches.items()}
            if uses_matches:
                model = model.model_copy(update={"with_matches": with_matches.model})
        figures = {
            "radius_m": self.radius_m,
            **recalls,
            "labelled_queries": labelled.figures(places.model) if self.queries else None,
            "places": places.figures,
            "places_with_matches": with_matches and with_matches.figures,
            "uses_matches": uses_matches,
        }
        return MapEvaluationResult(figures, model, uses_matches)

    def matched_photos(self, sample: Sequence[GeotaggedPhoto]) -> int:
        """Return how many photos of a sample are matched with others."""
        return 0 if self.matching == Matching.OFF else min(len(sample), MAX_MATCHED_SAMPLE)

    def _evaluate_matches(
        self,
        own_photos: OwnPhotoSampler,
        samples: Sequence[PlaceSample],
        labelled: Sequence[QueryOutcome],
        scores: MapScores,
    ) -> tuple[PlaceEvaluation | None, bool | None]:
        """Fit a place model with matches, and one without on the same photos to compare it with.

        Returns:
            The model, and whether it is used; None if too few photos can be matched with those
            that they find.
        """
        if self.matching == Matching.OFF:
            return None, None
        sampled = sorted({sample.photo for sample in samples})
        chosen = _draw(sampled, MAX_MATCHED_SAMPLE, seed=len(sampled))
        matched: list[PlaceSample] = []
        for photo in chosen:
            matched += own_photos.samples([photo], scores.spread, self._match_own_photo)
            self.on_query()
        photos = {sample.photo for sample in matched}
        if len(photos) < MIN_OWN_PHOTOS:
            return None, None
        plain = [sample for sample in samples if sample.photo in photos]
        both = [(o.sample, o.matched_sample) for o in labelled if o.sample and o.matched_sample]
        without = evaluate_places(plain, [each for each, _ in both], self.scheme, scores)
        places = evaluate_places(matched, [each for _, each in both], self.scheme, scores)
        if self.matching == Matching.ON or not answers_less(without, places):
            return places, True
        return places, False if len(photos) >= MIN_PHOTOS_TO_DECIDE else None

    def _measure_background(self, sample: Sequence[GeotaggedPhoto]) -> Background:
        """Return what random pairs of photos score, and how well those of two places match."""
        others = _draw(self.database.photos, BACKGROUND_PHOTOS, seed=1)
        among = PhotoFilter(ids=tuple(other.photo_id for other in others))
        scores: list[float] = []
        supports: list[float | None] = []
        for number, photo in enumerate(_draw(sample, BACKGROUND_QUERIES, seed=2)):
            ranking = self.search.rank_similar(photo, len(others), among) or []
            scores += [hit.score for hit, _ in ranking]
            if self.matching != Matching.OFF:
                apart = [
                    other.photo_id
                    for other in others[number::BACKGROUND_QUERIES]
                    if not is_same_place(photo.spot, other.spot, DIFFERENT_PLACE_M)
                ]
                supports += self.search.match(photo.photo_id, apart)
        return Background.of(scores, [each for each in supports if each is not None])

    def _order_by_matches(
        self, query: GeotaggedPhoto, ranked: Iterable[GeotaggedPhoto]
    ) -> list[GeotaggedPhoto]:
        """Return the first MATCHED_PHOTOS of a ranking, ordered by their match support."""
        first = list(islice(ranked, MATCHED_PHOTOS))
        supports = self.search.match(query.photo_id, [photo.photo_id for photo in first])
        order = sorted(range(len(first)), key=lambda rank: -(supports[rank] or 0.0))
        return [first[rank] for rank in order]

    def _match_own_photo(self, photo: int, others: Sequence[Any]) -> Sequence[float | None]:
        return self._match(self.database.photos[photo], others)

    def _match(self, query: GeotaggedPhoto, others: Sequence[Any]) -> Sequence[float | None]:
        """Return the match support of a photo with others, which are numbers in `database`."""
        ids = [self.database.photos[number].photo_id for number in others]
        return self.search.match(query.photo_id, ids)

    def _leave_one_out(
        self,
        sample: Sequence[GeotaggedPhoto],
        own_photos: OwnPhotoSampler,
        order: Callable[[GeotaggedPhoto, Iterable[GeotaggedPhoto]], Iterable[GeotaggedPhoto]],
    ) -> dict[str, Any]:
        """Return recall with and without the photos of a query's sequence.

        `order` returns the photos that a query finds in another order.
        """
        recall, apart = _OwnPhotoRecall(self.radius_m), _OwnPhotoRecall(self.radius_m)
        photos = self.database.photos
        for query in sample:
            found = own_photos.ranking(self._index_of[query.photo_id])
            if found is None:
                continue
            ranked = [photos[index] for index in found[0].tolist()]
            at_place = self.database.find_at_place(query.spot, self.radius_m)
            at_place = [photo for photo in at_place if photo.photo_id != query.photo_id]
            recall.add(query, order(query, ranked), at_place)
            is_apart = partial(filterfalse, query.is_same_sequence)
            apart.add(query, order(query, is_apart(ranked)), is_apart(at_place))
        return {
            "leave_one_out": recall.figures(),
            "leave_one_out_without_sequence": apart.figures(),
        }

    def _rank_own_photo(self, index: int) -> IndexRanking | None:
        """Rank the photos with a location by their similarity to one of them."""
        ranking = self.search.rank_similar(self.database.photos[index], MAX_RANKS)
        self.on_query()
        if ranking is None:
            return None
        indices = np.array([self._index_of[hit.photo_id] for hit, _ in ranking], dtype=np.int64)
        return indices, np.array([hit.score for hit, _ in ranking], dtype=np.float64)

    def _is_copy(self, photo: int, other: int) -> bool:
        """Return whether two photos are alike pixel by pixel, but for their contrast and noise."""
        return float(self._thumbnail(photo) @ self._thumbnail(other)) > COPY_CORRELATION

    def _thumbnail(self, photo: int) -> NDArray[np.float32]:
        """Return (1024,) numbers whose product with another photo's is their correlation."""
        if photo not in self._pixels:
            pixels = np.zeros(1024, np.float32)
            with contextlib.suppress(NotFound):  # a photo that is deleted meanwhile
                data = self._store.get(thumbnail_key(self.database.photos[photo].photo_id))
                small = Image.open(io.BytesIO(data)).convert("L").resize((32, 32))
                pixels += np.asarray(small, np.float32).ravel()
                pixels -= pixels.mean()
            self._pixels[photo] = pixels / max(float(np.linalg.norm(pixels)), 1.0)
        return self._pixels[photo]

    def _evaluate_labelled_queries(
        self, own_photos: OwnPhotoSampler, spread: float
    ) -> _LabelledQueryMetrics:
        labelled = _LabelledQueryMetrics()
        for number, query in enumerate([*self.queries, *self.denied]):
            ranking = self.search.rank_similar(query, EVIDENCE_DEPTH)
            self.on_query()
            if ranking is None:
                continue
            in_map = bool(self.database.find_at_place(query.spot, self.radius_m))
            if in_map:
                labelled.recall.add(
                    [is_same_place(query.spot, spot, self.radius_m) for _, spot in ranking]
                )
            ranked = [
                RankedPhoto(hit.score, spot, self._index_of.get(hit.photo_id))
                for hit, spot in ranking
            ]
            best = self._index_of.get(ranking[0][0].photo_id) if ranking else None
            neighbours = own_photos.neighbours(best) if best is not None else []
            levels = candidate_levels(ranked, neighbours, self.scheme, spread, self.radius_m)
            right = [query.is_right(level) for level in levels]
            matched = None
            if levels and self.matching != Matching.OFF and number < MAX_MATCHED_SAMPLE:
                matched = self._match_query(query, number, ranked, neighbours, spread)
            estimate = estimate_location(ranked, self.radius_m) if levels else UNKNOWN_LOCATION
            outcomes = labelled.denied if query.denied else labelled.outcomes
            outcomes.append(
                QueryOutcome(
                    in_map=in_map,
                    is_correct=is_same_place(query.spot, estimate, self.radius_m),
                    error_m=distance_between_m(query.spot, estimate),
                    same_session=bool(ranking) and self._same_session(query, ranking[0][0]),
                    sample=PlaceSample(number, levels, right) if levels else None,
                    matched_sample=matched,
                )
            )
        return labelled

    def _match_query(
        self,
        query: GeotaggedPhoto,
        number: int,
        ranked: Sequence[RankedPhoto],
        neighbours: Sequence[RankedPhoto],
        spread: float,
    ) -> PlaceSample | None:
        known = [r for r in ranked if r.photo is not None]
        ranked = attach_matches(known, partial(self._match, query))
        if not are_matched(ranked):
            return None
        levels = candidate_levels(ranked, neighbours, self.scheme, spread, self.radius_m)
        return PlaceSample(number, levels, [query.is_right(level) for level in levels])

    def _same_session(self, query: GeotaggedPhoto, best: SearchHit) -> bool:
        match = self._by_id.get(best.photo_id)
        if match is None or match.captured_at is None or query.captured_at is None:
            return False
        return abs(match.captured_at - query.captured_at) < SAME_SESSION_PERIOD
