"""What a ranking tells of the place: the best score, its lead over other places, agreement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shared.estimate.places import Spot, elsewhere, same_place
from shared.geodesy import centre_of

DEPTH = 50  # ranks looked at; a rival that is not among them scores at most what the last does
VOTERS = 10  # of them, those that may agree with the first


@dataclass(frozen=True, slots=True)
class Ranked:
    """One photo of a ranking: its cosine and where it was taken."""

    score: float
    spot: Spot


@dataclass(frozen=True, slots=True)
class Evidence:
    """`score`: the best cosine. `lead`: how much higher it is than the best one of another place.
    `agreement`: share of the first ten that show the best one's place."""

    score: float
    lead: float
    agreement: float


def weigh(ranking: Sequence[Ranked], radius_m: float) -> Evidence | None:
    """The evidence of a ranking, best first; None when it is empty or its first has no place."""
    if not ranking or not ranking[0].spot.is_known:
        return None
    first = ranking[0]
    rival = next((r.score for r in ranking if elsewhere(first.spot, r.spot)), ranking[-1].score)
    voters = ranking[:VOTERS]
    agreeing = sum(same_place(first.spot, r.spot, radius_m) for r in voters)
    return Evidence(first.score, first.score - rival, agreeing / len(voters))


def locate(ranking: Sequence[Ranked], radius_m: float) -> Spot:
    """Where the ranking points to: the first photo's label, and the centre of the first ten that
    lie within `radius_m` of it, each weighed by its score's lead over the last of the ranking."""
    first = ranking[0].spot
    if first.latitude is None:
        return first
    floor = ranking[-1].score
    near = [
        r
        for r in ranking[:VOTERS]
        if r.spot.latitude is not None
        and same_place(
            Spot(first.latitude, first.longitude, None),
            Spot(r.spot.latitude, r.spot.longitude, None),
            radius_m,
        )
    ]
    weights = np.array([r.score - floor for r in near]) + 1e-9
    latitude, longitude = centre_of(
        np.array([r.spot.latitude for r in near], dtype=np.float64),
        np.array([r.spot.longitude for r in near], dtype=np.float64),
        weights,
    )
    return Spot(latitude, longitude, first.place)
