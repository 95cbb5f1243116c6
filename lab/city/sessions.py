"""Capture sessions: the days on which photos are taken, with their light, weather and camera."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from pydantic import TypeAdapter

Rgb = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class CaptureSession:
    """One capture drive through the city. Colours are fractions of full brightness."""

    name: str
    starts_at: datetime
    foliage: str
    sky_top: Rgb
    sky_horizon: Rgb
    clouds: float
    """Cloud cover, 0 to 1"""
    sun_azimuth: float
    """degrees clockwise from north"""
    sun: Rgb
    """light on a facade that faces the sun"""
    ambient: Rgb
    """light everywhere"""
    haze: Rgb
    haze_per_m: float
    lit_panes: tuple[int, ...] = ()
    """Pane codes (0 to 7) that are lit"""
    glow: float = 0.0
    """Emission of lit windows, signs and lamps"""
    lamps: float = 0.0
    """strength of the street lamps"""
    snow: float = 0.0
    wet: float = 0.0
    gain: Rgb = (1.0, 1.0, 1.0)
    """white balance of the camera"""
    mixing: float = 0.0
    """Desaturation: fraction of grey mixed into every colour"""
    contrast: float = 1.0
    exposure_spread: float = 0.06
    """Standard deviation of the natural logarithm of the exposure"""
    noise: float = 2.0
    """standard deviation, of 255"""
    blur: float = 0.0
    """radius in pixels"""
    quality: int = 88
    """of the JPEG"""


FILE = Path(__file__).with_suffix(".json")
SESSIONS = tuple(TypeAdapter(list[CaptureSession]).validate_json(FILE.read_bytes()))
SUMMER, SPRING, AUTUMN, WINTER, NIGHT, FOG, RAIN = SESSIONS
DATABASE_SESSIONS = (SUMMER, SPRING)
QUERY_SESSIONS = (AUTUMN, WINTER, NIGHT, FOG, RAIN)
RIDE_SESSIONS = (WINTER, NIGHT)
