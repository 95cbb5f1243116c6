"""Place estimate of a similarity search: where, how certain, or "not in this map"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from uuid import UUID

from services.gateway.schemas import EstimateLevelResponse, EstimateResponse
from shared.catalog.photos import Photo
from shared.evaluation.places.evidence import PhotoLocation, RankedPhoto
from shared.evaluation.places.probability import PlaceEstimate
from shared.search_api.protocol import SearchHit

MIN_GUESS_PROBABILITY = 0.1  # of the finest level; a less probable place is not named as a guess
NOT_MEASURED = (
    "How certain this place is, and whether it is in the map, is not measured yet: the map has not "
    "been evaluated with 20 or more photos that have coordinates or a label."
)


def locate_hits(hits: Sequence[SearchHit], photos: Mapping[UUID, Photo]) -> list[RankedPhoto]:
    """Join hits with the locations of their photos."""
    return [
        RankedPhoto(hit.score, _photo_location(photos[hit.photo_id]), hit.photo_id) for hit in hits
    ]


def estimate_place(
    estimate: PlaceEstimate | None,
    certainty: float,
    radius_m: float,
    no_place_reason: str,
) -> EstimateResponse:
    """Return the place that a ranking points to, and how certain it is.

    Before the map's first evaluation, the place is named without probabilities.

    Args:
        estimate: The model's estimate; None if the best photo has no location.
        certainty: Share of the answers that must be right.
        radius_m: Photos within this distance in metres of the best one determine the position.
        no_place_reason: The reason if there is no estimate.
    """
    if estimate is None:
        return EstimateResponse(reason=no_place_reason)
    in_map, model = estimate.in_map, estimate.model
    spot = PhotoLocation(None, None, None) if in_map is False else estimate.location
    response = EstimateResponse(
        in_map=in_map,
        latitude=spot.latitude,
        longitude=spot.longitude,
        radius_m=None if spot.latitude is None else radius_m,
        place=spot.place,
        has_place=in_map is not False,
        reason=NOT_MEASURED,
    )
    if not model.is_fitted:
        return response
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
            "reason": _reason(estimate),
        }
    )


def _reason(estimate: PlaceEstimate) -> str:
    model = estimate.model
    if model.in_map_limit is None:
        return "Too few photos were evaluated to tell whether the place is in the map."
    compared = (
        f"The probability that the map has no photo of the place is {estimate.not_in_map:.4f}; "
        f"that of 5 % of the queries outside the map is below {model.in_map_limit:.4f}."
    )
    return compared if estimate.in_map else f"Probably not in this map. {compared}"


def _photo_location(photo: Photo) -> PhotoLocation:
    return PhotoLocation(photo.latitude, photo.longitude, photo.place)
