"""Belief of a track: where the camera may be after the frames so far."""

from __future__ import annotations

import json
import math
import zlib
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

FORMAT_VERSION = 4
MAX_BYTES = 1_000_000
START_GAIN = 0.5
"""`gain` before the first frame, cautious"""
START_GAIN_WEIGHT = 20.0
FloatArray = NDArray[np.float64]

TrackStatus = Literal["converging", "tracking", "lost"]


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Probabilities of where the camera is. Photos, `elsewhere` and `outside` add up to 1."""

    time: datetime
    """UTC, of the last frame"""
    photos: tuple[str, ...]
    """(n,) ids of the photos with a probability of their own"""
    probabilities: FloatArray
    """(n,)"""
    elsewhere: float
    """at any other photo of the map, all equally probable"""
    outside: float
    """outside the map"""
    seen: dict[str, float]
    """what the last frame's hits had beyond their prior, to tell how much the next frame adds"""
    gain: float = START_GAIN
    """mean log-likelihood of the frames at the predicted places, relative to that of any place"""
    gain_weight: float = START_GAIN_WEIGHT
    """number of independent, tracked frames that `gain` is the mean of"""
    pace: float = 1.0
    """seconds along the map's sequences for each second of the track, negative backwards"""
    position: tuple[float, float] | None = None
    """latitude and longitude, if they are known"""
    velocity: tuple[float, float] = (0.0, 0.0)
    """degrees of latitude and longitude per second"""
    direction: float = 0.0
    """log-likelihood of the frames so far if the camera moves along the map's sequence as it did,
    relative to the opposite direction; the oldest frames fade"""
    status: TrackStatus = "converging"
    frames: int = 0
    """number of frames so far"""

    def to_bytes(self) -> bytes:
        """Serialise: compressed JSON with a format version."""
        content = {
            "version": FORMAT_VERSION,
            **{name: getattr(self, name) for name in self.__slots__},
            "time": self.time.isoformat(),
            "probabilities": self.probabilities.tolist(),
        }
        return zlib.compress(json.dumps(content, separators=(",", ":")).encode())

    @classmethod
    def from_bytes(cls, data: bytes) -> Belief:
        """Read what `to_bytes` wrote.

        Raises:
            ValueError: Damaged, longer than MAX_BYTES, or of a newer format.
        """
        if len(data) > MAX_BYTES:
            raise ValueError(f"A belief has at most {MAX_BYTES} bytes, not {len(data)}.")
        try:
            content: dict[str, Any] = json.loads(zlib.decompress(data))
            version = content.pop("version")
            if version > FORMAT_VERSION:  # older ones lack fields that have a default
                raise ValueError(
                    f"The belief has format {version}; this release reads formats up to "
                    f"{FORMAT_VERSION}. Use the release that began the track."
                )
            belief = cls(
                **content
                | {
                    "time": datetime.fromisoformat(content["time"]),
                    "photos": tuple(content["photos"]),
                    "probabilities": np.array(content["probabilities"], dtype=np.float64),
                }
            )
        except (zlib.error, KeyError, TypeError, UnicodeDecodeError) as error:
            raise ValueError(f"Not a belief: {error}") from error
        total = float(belief.probabilities.sum()) + belief.elsewhere + belief.outside
        if len(belief.photos) != len(belief.probabilities) or not math.isclose(
            total, 1.0, abs_tol=1e-6
        ):
            raise ValueError("Not a belief: its probabilities do not add up to 1.")
        return belief
