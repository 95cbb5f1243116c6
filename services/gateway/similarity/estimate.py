"""Place estimate of a similarity search: where, how certain, or "not in this map"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from uuid import UUID

from services.gateway.schemas import EstimateLevelResponse, EstimateResponse
from shared.catalog.photos import Photo
from shared.evaluation.calibration import Calibration
from shared.evaluation.places.evidence import (
    PhotoLocation,
    RankedPhoto,
    compute_evidence,
    estimate_location,
)
from shared.evaluation.places.probability import PlaceEstimate, PlaceModel
from shared.search_api.protocol import SearchHit

MIN_GUESS_PROBABILITY = 0.1
"""of the finest level of a guess that is named although its support is below the threshold"""


def locate_hits(hits: Sequence[SearchHit], photos: Mapping[UUID, Photo]) -> list[RankedPhoto]:
    """Join hits with the locations of their photos."""
    return [
        RankedPhoto(hit.ranked_by, _photo_location(photos[hit.photo_id]), hit.photo_id)
        for hit in hits
    ]


def estimate_place(
    calibration: Calibration | None,
    ranking: Sequence[RankedPhoto],
    unfiltered_ranking: Sequence[RankedPhoto],
    radius_m: float,
    no_place_reason: str,
) -> EstimateResponse:
    """Estimate the place that a ranking points to.

    Args:
        calibration: That of this kind of ranking (plain, or by word weights).
        ranking: The photos that have a place and match the filter, best first.
        unfiltered_ranking: The same without the filter. The evidence is computed from it, because
            the calibration was learnt on photos with a place and without filters.
        radius_m: Photos within this distance in metres show the same place.
        no_place_reason: The reason if a ranking is empty.
    """
    evidence = (
        compute_evidence(unfiltered_ranking, radius_m, ranking[0].location) if ranking else None
    )
    if evidence is None:
        return EstimateResponse(reason=no_place_reason)
    accepted = calibration.accepts(evidence) if calibration else None
    spot = (
        estimate_location(ranking, radius_m)
        if accepted is not False
        else PhotoLocation(None, None, None)
    )
    return EstimateResponse(
        in_map=accepted,
        latitude=spot.latitude,
        longitude=spot.longitude,
        radius_m=None if spot.latitude is None else radius_m,
        place=spot.place,
        has_place=accepted is not False,
        reason=_estimate_reason(accepted, evidence.support, calibration),
    )


def add_levels(
    response: EstimateResponse, estimate: PlaceEstimate, model: PlaceModel, certainty: float
) -> EstimateResponse:
    """Return the response with the levels of the estimate and their probabilities."""
    return response.model_copy(
        update={
            "levels": [
                EstimateLevelResponse(
                    place=level.place,
                    latitude=level.latitude,
                    longitude=level.longitude,
                    radius_m=level.radius_m,
                    probability=probability,
                )
                for level, probability in zip(estimate.levels, estimate.probabilities, strict=True)
            ],
            "confidence": estimate.probabilities[0],
            "answer_level": estimate.answer,
            "has_place": response.has_place
            or estimate.answer is not None
            or estimate.probabilities[0] >= MIN_GUESS_PROBABILITY,
            "certainty": certainty,
            "not_in_map_probability": estimate.not_in_map,
            "radius_68_m": estimate.radius_68_m,
            "radius_95_m": estimate.radius_95_m,
            "calibration_source": model.calibration_source,
        }
    )


def _estimate_reason(accepted: bool | None, support: float, calibration: Calibration | None) -> str:
    if accepted is None or calibration is None or calibration.support_threshold is None:
        return (
            "How certain this place is, and whether it is in the map, is not measured yet: the map "
            "has not been evaluated with 20 or more photos that have coordinates or a label."
        )
    compared = (
        f"The support of the first ten photos for the place is {support:.4f}; 5 % of the queries "
        f"outside the map reach {calibration.support_threshold:.4f}."
    )
    return compared if accepted else f"Probably not in this map. {compared}"


def _photo_location(photo: Photo) -> PhotoLocation:
    return PhotoLocation(photo.latitude, photo.longitude, photo.place)
