"""Place estimate of a similarity search: where, how certain, or "not in this map".

The headline is the only sentence that says it. It is made here, from the fields of the estimate, so
that no client can contradict them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from uuid import UUID

from shared.catalog.photos import Photo
from shared.evaluation.places.evidence import PhotoLocation, RankedPhoto
from shared.evaluation.places.probability import PlaceEstimate
from shared.responses.similarity import CameraPoseResponse, EstimateLevelResponse, EstimateResponse
from shared.search_api.protocol import SearchHit

POSE_SHARES = (("radius_95_m", 0.95), ("radius_68_m", 0.68))
NOT_MEASURED = (
    "How certain this place is, and whether it is in the map, is not measured yet: the map has not "
    "been evaluated with 20 or more photos that have coordinates or a label."
)
NEW_TO_THE_MAP = (
    "Photos like these are new to this map: recent queries are less similar to it than those that "
    "its probabilities were measured on, as in another season or with another camera. Add 40 of "
    "them with their places as labelled queries."
)

LOOK_ALIKE = (
    "Places of this map look alike: {} of its photos get a wrong answer when their own place is "
    "taken out of it, and it may lack the place of this one."
)


def locate_hits(hits: Sequence[SearchHit], photos: Mapping[UUID, Photo]) -> list[RankedPhoto]:
    """Join hits with the locations of their photos."""
    located = ((hit, photos[hit.photo_id]) for hit in hits)
    return [
        RankedPhoto(hit.score, PhotoLocation(p.latitude, p.longitude, p.place), hit.photo_id)
        for hit, p in located
    ]


def estimate_place(
    estimate: PlaceEstimate | None,
    certainty: float,
    elsewhere: float,
    no_place_reason: str,
    *,
    is_new: bool = False,
) -> EstimateResponse:
    """Return the place that a ranking points to, and how certain it is.

    Position, label, radius and confidence are those of the answered level, or of the finest one as
    a guess. Before the map's first evaluation, the place is named without probabilities.

    Args:
        estimate: The model's estimate; None if the best photos have no location.
        certainty: Share of the answers that must be right.
        elsewhere: Prior probability that a query is from elsewhere.
        no_place_reason: The reason if there is no estimate.
        is_new: Whether the recent queries are new to the map (`PlaceModel.is_new`).
    """
    if estimate is None:
        return EstimateResponse(headline=no_place_reason, reason=no_place_reason)
    spot = estimate.location
    if not estimate.model.is_fitted:
        return EstimateResponse(
            latitude=spot.latitude,
            longitude=spot.longitude,
            place=spot.place,
            has_place=True,
            elsewhere=elsewhere,
            headline="Best guess. How certain it is has not been measured yet",
            reason=NOT_MEASURED,
        )
    levels = [
        EstimateLevelResponse(
            place=level.place,
            latitude=level.latitude,
            longitude=level.longitude,
            radius_m=level.radius_m,
            whole_map=level.is_whole_map,
            probability=probability,
        )
        for level, probability in zip(estimate.levels, estimate.probabilities, strict=True)
    ]
    response = EstimateResponse(
        in_map=estimate.in_map,
        headline="",
        reason="",
        levels=levels,
        answer_level=estimate.answer,
        certainty=certainty,
        elsewhere=elsewhere,
        not_in_map_probability=estimate.not_in_map,
        radius_68_m=estimate.radius_68_m,
        radius_95_m=estimate.radius_95_m,
        calibration_source=estimate.model.calibration_source,
    )
    worded = _in_words(response)
    reasons = [worded.reason]
    mistaken = estimate.model.mistaken_share(certainty)
    if estimate.answer is not None and mistaken > 1 - certainty:
        reasons.append(LOOK_ALIKE.format(_percent(mistaken)))
    if is_new:
        reasons.append(NEW_TO_THE_MAP)
    return worded.model_copy(update={"new_to_map": is_new, "reason": " ".join(reasons)})


def place_at_pose(estimate: EstimateResponse, pose: CameraPoseResponse) -> EstimateResponse:
    """Return an estimate whose position is that of a pose, which is right within its radii.

    An estimate of labels, and one with a pose without coordinates or radii, stays as it is.
    """
    is_labelled = estimate.place or any(level.place for level in estimate.levels)
    if pose.latitude is None or pose.radius_95_m is None or is_labelled:
        return estimate
    at = {"latitude": pose.latitude, "longitude": pose.longitude}
    radii = {
        "radius_m": pose.radius_95_m,
        "radius_68_m": pose.radius_68_m,
        "radius_95_m": pose.radius_95_m,
    }
    levels = []
    for level in estimate.levels:
        reached = [
            share
            for name, share in POSE_SHARES
            if level.whole_map or (level.radius_m or 0.0) >= (radii[name] or 0.0)
        ]
        probability = max([level.probability, *reached[:1]])
        levels.append(level.model_copy(update={**at, "probability": probability}))
    probable = (n for n, level in enumerate(levels) if level.probability >= POSE_SHARES[0][1])
    share = POSE_SHARES[0][1]
    return estimate.model_copy(
        update={
            **at,
            **radii,
            "in_map": True,
            "has_place": True,
            "levels": levels,
            "answer_level": next(probable, None),
            "confidence": share,
            "not_in_map_probability": 1 - levels[-1].probability if levels else None,
            "headline": f"Here, within {_metres(pose.radius_95_m)}: {_percent(share)}",
            "reason": "The position is that of the pose.",
        }
    )


def _in_words(estimate: EstimateResponse) -> EstimateResponse:
    """Return the estimate with its place, headline and reason."""
    answer, levels = estimate.answer_level, estimate.levels
    outside = _percent(estimate.not_in_map_probability or 0.0)
    if estimate.in_map is False:
        return estimate.model_copy(
            update={
                "headline": f"Probably not in this map: {outside}",
                "reason": "Photos of elsewhere are as similar to the map as this one.",
            }
        )
    named = levels[answer or 0]
    place = {
        "latitude": named.latitude,
        "longitude": named.longitude,
        "radius_m": named.radius_m,
        "place": named.place,
        "confidence": named.probability,
        "has_place": named.place is not None or named.latitude is not None,
    }
    where = _where(named)
    if answer is None:
        headline = (
            f"Not certain. Best guess: {where[0].lower()}{where[1:]}; not in this map: {outside}"
        )
        reason = f"No level reaches the certainty of {_percent(estimate.certainty or 0.0)}."
    else:
        finer = "Where in it" if named.whole_map else "A finer level"
        headline = f"{where}. {finer} is not certain" if answer > 0 else where
        reason = f"The probability that it is not in this map is {outside}."
    return estimate.model_copy(update={**place, "headline": headline, "reason": reason})


def _where(level: EstimateLevelResponse) -> str:
    """Return a level with its probability, as the start of a sentence."""
    probable = _percent(level.probability)
    if level.whole_map:
        return f"In this map: {probable}"
    if level.place is not None:
        return f"In {level.place.replace('/', ', ')}: {probable}"
    return f"Here, within {_metres(level.radius_m or 0.0)}: {probable}"


def _percent(probability: float) -> str:
    """Return a probability in whole percent; neither 0 nor 100 are certain."""
    if probability > 0.99:
        return "more than 99 %"
    return "less than 1 %" if probability < 0.01 else f"{100 * probability:.0f} %"


def _metres(length_m: float) -> str:
    if length_m < 9.95:
        return f"{length_m:.1f} m"
    return f"{length_m:.0f} m" if length_m < 999.5 else f"{round(length_m / 1000, 1):g} km"
