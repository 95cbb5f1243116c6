"""Capture sessions: the days on which photos are taken, with their light, weather and camera."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

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


SUMMER = CaptureSession(
    name="summer",
    starts_at=datetime(2025, 6, 18, 11, 0, tzinfo=UTC),
    foliage="summer",
    sky_top=(0.30, 0.52, 0.86),
    sky_horizon=(0.76, 0.86, 0.95),
    clouds=0.35,
    sun_azimuth=205.0,
    sun=(0.46, 0.43, 0.37),
    ambient=(0.76, 0.78, 0.82),
    haze=(0.78, 0.85, 0.92),
    haze_per_m=0.0012,
)
SPRING = CaptureSession(
    name="spring",
    starts_at=datetime(2025, 4, 9, 8, 30, tzinfo=UTC),
    foliage="spring",
    sky_top=(0.66, 0.72, 0.80),
    sky_horizon=(0.88, 0.90, 0.92),
    clouds=0.8,
    sun_azimuth=120.0,
    sun=(0.12, 0.12, 0.11),
    ambient=(0.86, 0.88, 0.90),
    haze=(0.84, 0.87, 0.90),
    haze_per_m=0.002,
    gain=(0.98, 1.0, 1.03),
    quality=80,
)
AUTUMN = CaptureSession(
    name="autumn",
    starts_at=datetime(2025, 10, 21, 15, 30, tzinfo=UTC),
    foliage="autumn",
    sky_top=(0.42, 0.50, 0.68),
    sky_horizon=(0.97, 0.84, 0.66),
    clouds=0.5,
    sun_azimuth=245.0,
    sun=(0.62, 0.45, 0.26),
    ambient=(0.56, 0.55, 0.60),
    haze=(0.90, 0.80, 0.66),
    haze_per_m=0.003,
    lit_panes=(3,),
    glow=0.35,
    gain=(1.06, 0.99, 0.90),
    contrast=1.08,
    exposure_spread=0.12,
    noise=3.5,
    quality=72,
)
WINTER = CaptureSession(
    name="winter",
    starts_at=datetime(2026, 1, 14, 10, 0, tzinfo=UTC),
    foliage="bare",
    sky_top=(0.74, 0.77, 0.82),
    sky_horizon=(0.88, 0.89, 0.92),
    clouds=0.9,
    sun_azimuth=170.0,
    sun=(0.05, 0.05, 0.06),
    ambient=(0.76, 0.80, 0.88),
    haze=(0.86, 0.88, 0.92),
    haze_per_m=0.006,
    lit_panes=(1, 6),
    glow=0.25,
    snow=0.85,
    gain=(0.95, 0.99, 1.07),
    mixing=0.15,
    exposure_spread=0.12,
    noise=3.5,
    quality=70,
)
NIGHT = CaptureSession(
    name="night",
    starts_at=datetime(2025, 11, 20, 20, 30, tzinfo=UTC),
    foliage="autumn",
    sky_top=(0.03, 0.04, 0.09),
    sky_horizon=(0.14, 0.13, 0.16),
    clouds=0.3,
    sun_azimuth=0.0,
    sun=(0.0, 0.0, 0.0),
    ambient=(0.21, 0.23, 0.33),
    haze=(0.13, 0.12, 0.15),
    haze_per_m=0.004,
    lit_panes=(0, 2, 5),
    glow=1.0,
    lamps=1.0,
    gain=(1.05, 0.98, 0.92),
    contrast=1.05,
    exposure_spread=0.15,
    noise=7.0,
    blur=0.5,
    quality=64,
)
FOG = CaptureSession(
    name="fog",
    starts_at=datetime(2025, 12, 3, 7, 30, tzinfo=UTC),
    foliage="bare",
    sky_top=(0.72, 0.74, 0.76),
    sky_horizon=(0.76, 0.77, 0.79),
    clouds=0.2,
    sun_azimuth=100.0,
    sun=(0.0, 0.0, 0.0),
    ambient=(0.74, 0.76, 0.80),
    haze=(0.76, 0.77, 0.79),
    haze_per_m=0.022,
    lit_panes=(4,),
    glow=0.5,
    wet=0.3,
    mixing=0.25,
    exposure_spread=0.1,
    noise=3.0,
    blur=0.4,
    quality=70,
)
RAIN = CaptureSession(
    name="rain",
    starts_at=datetime(2026, 3, 5, 16, 0, tzinfo=UTC),
    foliage="bare",
    sky_top=(0.46, 0.49, 0.54),
    sky_horizon=(0.64, 0.66, 0.69),
    clouds=0.9,
    sun_azimuth=0.0,
    sun=(0.0, 0.0, 0.0),
    ambient=(0.58, 0.61, 0.66),
    haze=(0.62, 0.64, 0.67),
    haze_per_m=0.009,
    lit_panes=(0, 7),
    glow=0.5,
    wet=0.8,
    gain=(0.97, 1.0, 1.04),
    mixing=0.1,
    exposure_spread=0.12,
    noise=4.5,
    blur=0.3,
    quality=70,
)

DATABASE_SESSIONS = (SUMMER, SPRING)
QUERY_SESSIONS = (AUTUMN, WINTER, NIGHT, FOG, RAIN)
RIDE_SESSIONS = (WINTER, NIGHT)
SESSIONS = (*DATABASE_SESSIONS, *QUERY_SESSIONS)
