"""From the ranking of a similarity search to the answer's estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from uuid import UUID

from services.gateway.schemas import EstimateResponse
from shared.catalog.photos import Photo
from shared.estimate.calibration import Calibration
from shared.estimate.evidence import RankedPhoto, compute_evidence, estimate_location
from shared.estimate.places import PhotoLocation
from shared.search_protocol import SearchHit


def locate_hits(hits: Sequence[SearchHit], photos: Mapping[UUID, Photo]) -> list[RankedPhoto]:
    """Hits with the places of their photos."""
    return [RankedPhoto(hit.ranked_by, _photo_location(photos[hit.photo_id])) for hit in hits]


def estimate_place(
    calibration: Calibration | None,
    ranking: Sequence[RankedPhoto],
    unfiltered_ranking: Sequence[RankedPhoto],
    radius_m: float,
) -> EstimateResponse:
    """Where the ranking points to, and what the generation's evaluations say of that place.

    `calibration` is what rankings of this kind, plain or by word weights, have taught. `unfiltered_ranking`
    is the ranking without a filter: the place has to stand up to all others, as it had to when the
    evaluations learnt what is in the map.
    """
    state = calibration.state if calibration else "uncalibrated"
    evidence = compute_evidence(unfiltered_ranking, radius_m, ranking[0].spot) if ranking else None
    if evidence is None:
        reason = (
            "No photo of the map passes the filter."
            if not ranking
            else "The most similar photo has neither coordinates nor a place."
        )
        return EstimateResponse(calibration=state, reason=reason)
    accepted = calibration.accepts(evidence) if calibration else None
    confidence = (
        calibration.confidence.probability(evidence)
        if calibration and calibration.confidence
        else None
    )
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
        confidence=confidence,
        calibration=state,
        reason=_estimate_reason(accepted, evidence.support, calibration),
    )


def _estimate_reason(accepted: bool | None, support: float, calibration: Calibration | None) -> str:
    if accepted is None or calibration is None or calibration.support_threshold is None:
        return (
            "Whether the place is in the map can't be told yet: first an evaluation has to see at "
            "least 20 photos with coordinates or places (POST /api/v1/evaluations)."
        )
    compared = (
        f"The first ten photos support the place by {support:.4f}; of photos that are not in the "
        f"map one in twenty reaches {calibration.support_threshold:.4f}."
    )
    return compared if accepted else f"Not in this map, as far as can be told. {compared}"


def _photo_location(photo: Photo) -> PhotoLocation:
    return PhotoLocation(photo.latitude, photo.longitude, photo.place)
