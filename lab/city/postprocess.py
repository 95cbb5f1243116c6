"""Postprocessing of a rendered view: the session's light, weather, sky and camera effects."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from lab.city.camera import SUPERSAMPLING, Camera, RenderBuffers
from lab.city.sessions import CaptureSession
from lab.city.textures import (
    CODE_FLAT,
    GreyImage,
    emission_table,
    random_stream,
    smooth_noise,
)

CLOUD_SHAPE = (256, 1024)
GRAIN_SPARE = 256
"""Pixels per axis by which the grain exceeds a photo, so that each photo has another crop"""
SKY_COARSE = 4
LAMPLIGHT = (0.62, 0.46, 0.24)
GLOW = (1.5, 1.2, 0.75)

Light = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class SkyAndGrain:
    """Cloud and grain textures that all photos of a city are cropped from."""

    clouds: GreyImage
    grain: Light
    """(3, width + GRAIN_SPARE, height + GRAIN_SPARE) of standard deviation 1"""

    @classmethod
    def generate(cls, seed: int, width: int, height: int) -> SkyAndGrain:
        """Generate textures for photos of `width` x `height` pixels."""
        rng = random_stream(seed, "film")
        clouds = (
            0.6 * smooth_noise(rng, CLOUD_SHAPE, 64)
            + 0.3 * smooth_noise(rng, CLOUD_SHAPE, 24)
            + 0.15 * smooth_noise(rng, CLOUD_SHAPE, 8)
        )
        shape = (3, width + GRAIN_SPARE, height + GRAIN_SPARE)
        grain = rng.standard_normal(shape, dtype=np.float32)
        return cls(np.asarray(clouds, np.float32), grain)


def postprocess(
    view: RenderBuffers,
    camera: Camera,
    session: CaptureSession,
    sky_and_grain: SkyAndGrain,
    rng: np.random.Generator,
) -> Image.Image:
    """Apply light, weather, sky and camera effects; returns the RGB photo.

    `rng`: the random stream of this photo.
    """
    light = _light(view, session)
    colours = _mean_colours(view)  # one plane per channel: much faster than interleaved channels
    solid = (view.canvas >= 1 << 24).view(np.uint8)
    cover = _mean(solid).astype(np.float32)
    if session.snow or session.wet:
        _weather(colours, view, camera, session)
    through = np.exp(-session.haze_per_m * np.minimum(view.depth, 1000.0)).astype(np.float32)
    veil = cover * (1 - through)
    gap = None if cover.all() else 1 - cover
    sky = None if gap is None else _sky(camera, session, sky_and_grain, rng)
    for plane in range(3):
        # cover is 0 for sky; pixels on edges mix both.
        colours[plane] *= light[plane]
        colours[plane] *= through
        colours[plane] += veil * np.float32(session.haze[plane])
        if sky is not None:
            colours[plane] += gap * sky[plane]
    return _expose(colours, session, sky_and_grain, rng)


def _mean(fine: NDArray[np.uint8] | Light) -> Light:
    """(SUPERSAMPLING * w, SUPERSAMPLING * h) -> (w, h) means."""
    total = fine[::SUPERSAMPLING, ::SUPERSAMPLING].astype(np.float32)
    for i, j in ((0, 1), (1, 0), (1, 1)):
        total += fine[i::SUPERSAMPLING, j::SUPERSAMPLING]
    return total * np.float32(1 / SUPERSAMPLING**2)


def _mean_colours(view: RenderBuffers) -> Light:
    """Return (3, width, height) fractions of full brightness; transparent pixels are black."""
    wide, high = view.canvas.shape
    packed = Image.frombuffer("RGBX", (high, wide), view.canvas, "raw", "RGBX", 0, 1)
    small = np.asarray(packed.reduce(SUPERSAMPLING))
    planes = np.empty((3, *small.shape[:2]), np.float32)
    for plane in range(3):
        np.multiply(small[..., plane], np.float32(1 / 255), out=planes[plane])
    return planes


def _light(view: RenderBuffers, session: CaptureSession) -> Light:
    """Return (3, width, height): the light on each pixel plus its emission."""
    light = np.empty((3, *view.sun.shape), np.float32)
    shine = None
    if session.glow:
        codes = view.canvas >> 24
        shine = _mean(emission_table(session.lit_panes, session.glow).take(codes))
    for plane in range(3):
        np.multiply(view.sun, np.float32(session.sun[plane]), out=light[plane])
        light[plane] += np.float32(session.ambient[plane])
        if session.lamps:
            light[plane] += view.lamp[:, None] * np.float32(session.lamps * LAMPLIGHT[plane])
        if shine is not None:
            light[plane] += shine * np.float32(GLOW[plane])
    return light


def _weather(colours: Light, view: RenderBuffers, camera: Camera, session: CaptureSession) -> None:
    """Apply snow to surfaces open to the sky, and rain to the ground, which reflects the sky."""
    flat = (view.canvas[::SUPERSAMPLING, ::SUPERSAMPLING] >> 24) == CODE_FLAT
    if session.snow:
        share = flat * np.float32(session.snow)
        for plane in colours:
            plane += share * (np.float32(0.48) + np.float32(0.53) * plane - plane)
    if session.wet:
        below = np.arange(camera.height) > camera.horizon * camera.height
        share = (flat & below) * np.float32(session.wet)
        for plane, gleam in zip(colours, session.sky_horizon, strict=True):
            plane += share * (np.float32(0.18 * gleam) - np.float32(0.45) * plane)


def _sky(
    camera: Camera, session: CaptureSession, sky_and_grain: SkyAndGrain, rng: np.random.Generator
) -> Light:
    """Return (3, width, height): a gradient by elevation with clouds, upsampled."""
    width, height = camera.width // SKY_COARSE, camera.height // SKY_COARSE
    rows = np.arange(height, dtype=np.float32) * SKY_COARSE
    elevation = np.clip((camera.horizon * camera.height - rows) / camera.focal, 0, 1.2)
    share = (1 - np.exp(-elevation * 2.2))[:, None]
    wide = max(8, int(camera.fov / 360 * CLOUD_SHAPE[1]))
    x0 = int(camera.yaw / 360 * CLOUD_SHAPE[1] / 2) + int(rng.integers(64))
    x0 %= CLOUD_SHAPE[1] - wide
    y0 = int(rng.integers(CLOUD_SHAPE[0] - 128))
    clouds = Image.fromarray(sky_and_grain.clouds).resize(
        (width, height), Image.Resampling.BILINEAR, box=(x0, y0, x0 + wide, y0 + 128)
    )
    mask = np.clip((np.asarray(clouds) + 2 * session.clouds - 0.9) * 2.0, 0, 1)
    mask *= 0.35 + 0.5 * share
    planes = np.empty((3, camera.width, camera.height), np.float32)
    for plane, (top, horizon) in enumerate(zip(session.sky_top, session.sky_horizon, strict=True)):
        clear = share * top + (1 - share) * horizon
        coarse = clear + mask * (min(1.0, horizon * 1.05 + 0.02) - clear)
        image = Image.fromarray(coarse.astype(np.float32))
        smooth = image.resize((camera.width, camera.height), Image.Resampling.BILINEAR)
        planes[plane] = np.asarray(smooth).T
    return planes


def _expose(
    colours: Light, session: CaptureSession, sky_and_grain: SkyAndGrain, rng: np.random.Generator
) -> Image.Image:
    """Apply exposure, white balance, contrast, vignette, blur and grain."""
    exposure = math.exp(rng.normal(0, session.exposure_spread))
    balance = np.asarray(session.gain) * rng.normal(1, 0.01, 3) * exposure * 255
    _, width, height = colours.shape
    across = np.linspace(-1, 1, width, dtype=np.float32)[:, None] ** 2
    down = np.linspace(-1, 1, height, dtype=np.float32)[None] ** 2
    vignette = (1 - np.float32(0.09) * (across + down)) * np.float32(session.contrast)
    if session.mixing:
        grey = (colours[0] + colours[1] + colours[2]) * np.float32(session.mixing / 3)
        colours *= np.float32(1 - session.mixing)
        colours += grey
    x, y = (int(offset) for offset in rng.integers(GRAIN_SPARE, size=2))
    photo = np.empty((height, width, 3), np.uint8)
    for plane in range(3):
        colours[plane] *= vignette * np.float32(balance[plane])
        colours[plane] += np.float32(118 * (1 - session.contrast))
        if not session.blur:
            grain = sky_and_grain.grain[plane, x : x + width, y : y + height]
            colours[plane] += np.float32(session.noise) * grain
        np.clip(colours[plane], 0, 255, out=colours[plane])
        photo[..., plane] = colours[plane].T
    image = Image.fromarray(photo)
    if session.blur:  # blur is of the lens, grain of the sensor: grain is not blurred
        image = image.filter(ImageFilter.BoxBlur(session.blur))
        grain = sky_and_grain.grain[:, x : x + width, y : y + height].transpose(2, 1, 0)
        noisy = np.asarray(image) + np.float32(session.noise) * grain
        image = Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8))
    return image


def encode_jpeg(photo: Image.Image, session: CaptureSession) -> bytes:
    """Encode the photo as JPEG with the session's quality."""
    buffer = io.BytesIO()
    photo.save(buffer, "JPEG", quality=session.quality)
    return buffer.getvalue()
