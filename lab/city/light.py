"""From a view to a photo: the session's light, weather and sky, and its camera."""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache
from math import exp
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from lab.city.camera import Camera, Floats
from lab.city.raster import FIRST_SOLID, SUPERSAMPLING, Canvas
from lab.city.sessions import CaptureSession
from lab.city.textures import CODE_FLAT, GreyImage, emission_table, random_stream, smooth_noise

LAMPLIGHT = np.array((0.62, 0.46, 0.24), np.float32)
GLOW = np.array((1.5, 1.2, 0.75), np.float32)
LAMP_REACH_M = 4.0
"""Distance at which a street lamp has half of its light"""
CLOUDS_PER_DEGREE = 3.0

Light = NDArray[np.float32]


def take_photo(
    canvas: Canvas, session: CaptureSession, lamps: Sequence[Floats], rng: np.random.Generator
) -> Image.Image:
    """Make an RGB photo of a view; `lamps` are (3,) metres of the street lamps around."""
    camera, texels = canvas.camera, canvas.texels
    whole = Image.frombuffer("RGBX", texels.shape[::-1], texels, "raw", "RGBX", 0, 1)
    colours = np.asarray(whole.reduce(SUPERSAMPLING))[..., :3] * np.float32(1 / 255)
    cover = _mean(texels >= FIRST_SOLID)[..., None]
    codes = texels[::2, ::2] >> 24
    nearness, sun = canvas.nearness[::2, ::2], canvas.sun[::2, ::2]
    flat = codes == CODE_FLAT
    if session.snow:
        colours[flat] += session.snow * (0.48 - 0.47 * colours[flat])
    if session.wet:
        gleam = 0.18 * np.array(session.sky_horizon)
        colours[flat] += session.wet * (gleam - 0.45 * colours[flat])
    light = sun[..., None] * np.array(session.sun, np.float32)
    light += np.array(session.ambient, np.float32)
    if session.glow:
        shine = emission_table(session.lit_panes, session.glow).take(texels >> 24)
        light += _mean(shine)[..., None] * GLOW
    if session.lamps and len(lamps):
        light += session.lamps * _lamplight(camera, nearness, lamps)[..., None] * LAMPLIGHT
    with np.errstate(divide="ignore"):
        through = np.exp(-session.haze_per_m / nearness)[..., None]
    haze = np.array(session.haze, np.float32)
    colours = colours * light * through + cover * (1 - through) * haze
    sky = cover[..., 0] < 1
    colours[sky] += (1 - cover[sky]) * _sky(camera, session, sky, rng)
    return _expose(colours, session, rng)


def _mean(samples: NDArray[Any]) -> Light:
    """Average the samples of each pixel."""
    total = samples[::2, ::2].astype(np.float32)
    for i, j in ((0, 1), (1, 0), (1, 1)):
        total += samples[i::2, j::2]
    return total * np.float32(1 / 4)


def encode_jpeg(photo: Image.Image, session: CaptureSession) -> bytes:
    """Encode the photo as JPEG with the session's quality."""
    buffer = io.BytesIO()
    photo.save(buffer, "JPEG", quality=session.quality)
    return buffer.getvalue()


def _directions(camera: Camera, shown: NDArray[np.bool_]) -> Light:
    """Return the (n, 3) directions of the pixels that a mask selects, one metre deep."""
    rows, columns = (index + np.float64(0.5) for index in shown.nonzero())
    return camera.rays(columns, rows).astype(np.float32)


def _lamplight(camera: Camera, nearness: Light, lamps: Sequence[Floats]) -> Light:
    """Return the light of the street lamps on each pixel."""
    shown = nearness > 0
    points = _directions(camera, shown) / nearness[shown][:, None]
    light = np.zeros(len(points), np.float32)
    for lamp in lamps:
        away = points - (lamp - camera.position).astype(np.float32)
        light += 1 / (1 + (away * away).sum(axis=1) / np.float32(LAMP_REACH_M**2))
    found = np.zeros_like(nearness)
    found[shown] = light
    return found


@cache
def _clouds() -> GreyImage:
    """Return seamless (degrees of elevation, of azimuth) noise."""
    rng = random_stream("clouds")
    shape = (256, round(360 * CLOUDS_PER_DEGREE))
    return np.asarray(
        0.6 * smooth_noise(rng, shape, 64) + 0.3 * smooth_noise(rng, shape, 24), np.float32
    )


def _sky(
    camera: Camera, session: CaptureSession, shown: NDArray[np.bool_], rng: np.random.Generator
) -> Light:
    """Return the (n, 3) colours of the pixels of the sky: a gradient by elevation, and clouds."""
    east, north, up = _directions(camera, shown).T
    elevation = np.clip(np.arctan2(up, np.hypot(east, north)), 0, None)
    share = (1 - np.exp(-2.2 * elevation))[:, None]
    clear = share * session.sky_top + (1 - share) * session.sky_horizon
    clouds = _clouds()
    row, column = (
        (np.degrees(angle) * CLOUDS_PER_DEGREE + rng.integers(size)).astype(int) % size
        for angle, size in zip((elevation, np.arctan2(east, north)), clouds.shape, strict=True)
    )
    cover = np.clip((clouds[row, column] + 2 * session.clouds - 0.9) * 2, 0, 1)[:, None]
    cloud = np.minimum(1.0, np.array(session.sky_horizon) * 1.05 + 0.02)
    return np.asarray(clear + cover * (0.35 + 0.5 * share) * (cloud - clear), np.float32)


def _expose(colours: Light, session: CaptureSession, rng: np.random.Generator) -> Image.Image:
    """Apply exposure, white balance, contrast, vignette, blur and grain to (h, w, 3) colours."""
    height, width, _ = colours.shape
    exposure = exp(rng.normal(0, session.exposure_spread))
    balance = np.array(session.gain) * rng.normal(1, 0.01, 3) * exposure * 255 * session.contrast
    across, down = np.linspace(-1, 1, width) ** 2, np.linspace(-1, 1, height) ** 2
    vignette = (1 - 0.09 * (across + down[:, None])).astype(np.float32)
    grey = colours @ np.full((3, 3), 1 / 3, np.float32)
    colours += np.float32(session.mixing) * (grey - colours)
    colours *= vignette[..., None] * balance.astype(np.float32)
    colours += np.float32(118 * (1 - session.contrast))
    if session.blur:  # of the lens, whereas grain is of the sensor
        image = Image.fromarray(np.clip(colours, 0, 255).astype(np.uint8))
        colours = np.array(image.filter(ImageFilter.BoxBlur(session.blur)), np.float32)
    grain = rng.standard_normal(colours.shape, np.float32)
    colours += np.float32(session.noise) * grain
    return Image.fromarray(np.clip(colours, 0, 255).astype(np.uint8))
