"""Matches the photos of a map with each other, verified as those of queries are."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Self
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from services.extractor.geometry.pairs import Pairs
from shared.geometry.component import UNREADABLE
from shared.matching.features import LocalFeatures
from shared.matching.mutual_nearest import match_keypoints
from shared.matching.verification import verify_matches

MIN_INLIERS = 15
"""COLMAP's least number of matches of a pair"""
BLOCK = 64
"""Pairs between two reports"""


@dataclass(frozen=True, slots=True, eq=False)
class VerifiedMatches:
    """Matches of the pairs of a map's photos that show the same."""

    photo_ids: tuple[UUID, ...]
    pairs: Pairs
    """(m, 2) numbers of photos"""
    keypoints: tuple[NDArray[np.uint16], ...]
    """for each pair (k, 2) keypoints of the first and the second photo"""

    def only(self, chosen: NDArray[np.bool_]) -> VerifiedMatches:
        """Return the matches of the chosen pairs (m,)."""
        keypoints = tuple(self.keypoints[n] for n in np.flatnonzero(chosen).tolist())
        return VerifiedMatches(self.photo_ids, self.pairs[chosen], keypoints)

    def joined(self, other: VerifiedMatches) -> VerifiedMatches:
        """Return the matches of both, those of `other` as far as its photos are among these."""
        numbers = {id_: number for number, id_ in enumerate(self.photo_ids)}
        known = np.array([numbers.get(id_, -1) for id_ in other.photo_ids], np.int32)
        pairs = known[other.pairs]
        is_here = pairs.min(axis=1, initial=0) >= 0
        return VerifiedMatches(
            self.photo_ids,
            np.concatenate([self.pairs, pairs[is_here]]),
            (*self.keypoints, *other.only(is_here).keypoints),
        )

    def encode(self) -> bytes:
        """Encode as a compressed npz."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            photo_ids=np.array([list(i.bytes) for i in self.photo_ids], np.uint8).reshape(-1, 16),
            pairs=self.pairs,
            counts=np.array([len(k) for k in self.keypoints], np.int32),
            keypoints=np.concatenate([*self.keypoints, np.empty((0, 2), np.uint16)]),
        )
        return buffer.getvalue()

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Decode the result of `encode`; ValueError if it is damaged."""
        names = ("photo_ids", "pairs", "counts", "keypoints")
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as file:
                ids, pairs, counts, keypoints = (file[name] for name in names)
        except (*UNREADABLE, ValueError) as error:
            raise ValueError(f"no verified matches: {error}") from error
        if counts.sum() != len(keypoints) or len(counts) != len(pairs):
            raise ValueError(f"{len(keypoints)} matches of {len(pairs)} pairs")
        if len(pairs) and not 0 <= pairs.min() <= pairs.max() < len(ids):
            raise ValueError("a pair has the number of a photo that is not there")
        return cls(
            tuple(UUID(bytes=row.tobytes()) for row in ids),
            pairs,
            tuple(np.split(keypoints, np.cumsum(counts)[:-1])) if len(counts) else (),
        )


def match_pairs(
    photos: Mapping[UUID, LocalFeatures],
    pairs: Pairs,
    on_progress: Callable[[int], None],
    threads: int = min(os.cpu_count() or 1, 4),
) -> VerifiedMatches:
    """Match pairs of photos, given by their numbers in the order of the mapping.

    Args:
        on_progress: Called with the number of pairs that are done, about twice a second; what it
            raises ends the work.
    """
    features = list(photos.values())

    def match(pair: Sequence[int]) -> NDArray[np.uint16]:
        one, other = features[pair[0]], features[pair[1]]
        matches = match_keypoints(one, other)
        is_inlier = verify_matches(
            one.working_pixels()[matches[:, 0]], other.working_pixels()[matches[:, 1]]
        )
        return matches[is_inlier].astype(np.uint16)

    found: list[NDArray[np.uint16]] = []
    with ThreadPoolExecutor(threads, "match-pairs") as pool:
        for start in range(0, len(pairs), BLOCK):
            found += pool.map(match, pairs[start : start + BLOCK].tolist())
            on_progress(len(found))
    is_enough = np.array([len(matches) >= MIN_INLIERS for matches in found], dtype=bool)
    return VerifiedMatches(
        tuple(photos),
        pairs[is_enough],
        tuple(matches for matches, enough in zip(found, is_enough, strict=True) if enough),
    )
