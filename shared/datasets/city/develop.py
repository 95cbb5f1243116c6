"""From a view to a photo: the session's light, weather, sky, camera and JPEG."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from shared.datasets.city.camera import Camera
from shared.datasets.city.codes import FLAT, light_table
from shared.datasets.city.random_streams import stream
from shared.datasets.city.render import FINE, View
from shared.datasets.city.sessions import Session
from shared.datasets.city.walls import Grey, smooth_noise

CLOUD_SHAPE = (256, 1024)
GRAIN_SHAPE = (1200, 1200)
LAMPLIGHT = np.array([0.62, 0.46, 0.24], np.float32)

Light = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Film:
    """What every photo of a city shares: clouds to cut from, and grain."""

    clouds: Grey
    grain: Light

    @classmethod
    def of(cls, seed: int) -> Film:
        rng = stream(seed, "film")
        clouds = (
            0.6 * smooth_noise(rng, CLOUD_SHAPE, 64)
            + 0.3 * smooth_noise(rng, CLOUD_SHAPE, 24)
            + 0.15 * smooth_noise(rng, CLOUD_SHAPE, 8)
        )
        grain = rng.standard_normal((*GRAIN_SHAPE, 3), dtype=np.float32)
        return cls(np.asarray(clouds, np.float32), grain)


def develop(
    view: View, camera: Camera, session: Session, film: Film, rng: np.random.Generator
) -> Image.Image:
    """The RGB photo; `rng` is the photo's own."""
    texels = view.canvas.view(np.uint8).reshape(
        camera.width, FINE, camera.height, FINE, 4
    )  # x, fine x, y, fine y, channel
    colours = np.zeros((camera.width, camera.height, 3), np.float32)
    cover = np.zeros((camera.width, camera.height), np.float32)
    shine = np.zeros((camera.width, camera.height), np.float32)
    table = light_table(session.lit_panes, session.glow)
    for i in range(FINE):
        for j in range(FINE):
            part = texels[:, i, :, j]
            colours += part[..., :3]
            cover += part[..., 3] > 0
            if session.glow:
                shine += table[part[..., 3]]
    colours *= np.float32(1 / (255 * FINE**2))
    cover *= np.float32(1 / FINE**2)
    shine *= np.float32(1 / FINE**2)
    if session.snow or session.wet:
        _weather(colours, texels[:, 0, :, 0, 3] == FLAT, view, camera, session)
    light = view.sun[..., None] * np.asarray(session.sun, np.float32)
    light += np.asarray(session.ambient, np.float32)
    if session.glow > 0.9:
        light += view.lamp[:, None, None] * LAMPLIGHT
    if session.glow:
        light += shine[..., None] * np.array([1.5, 1.2, 0.75], np.float32)
    colours *= light
    through = np.exp(-session.haze_per_m * np.minimum(view.depth, 1000.0))[..., None]
    haze = np.asarray(session.haze, np.float32)
    # Where only sky is, cover is 0; a rim pixel takes its share of both.
    colours *= through
    colours += cover[..., None] * (1 - through) * haze
    colours += (1 - cover)[..., None] * _sky(camera, session, film, rng)
    return _expose(colours, session, film, rng)


def _weather(
    colours: Light,
    flat: NDArray[np.bool_],
    view: View,
    camera: Camera,
    session: Session,
) -> None:
    """Snow whitens what lies open to the sky; rain darkens the ground and lets it mirror."""
    if session.snow:
        trodden = session.snow * (0.75 + 0.25 * np.cos(np.arange(camera.width) * 0.07))
        share = (flat * trodden[:, None])[..., None].astype(np.float32)
        colours += share * (np.float32(0.80) * (0.6 + 0.4 * colours / 0.6) - colours)
    if session.wet:
        ground = flat & (np.arange(camera.height) > camera.horizon * camera.height)
        gleam = np.asarray(session.sky_horizon, np.float32) * np.float32(0.35)
        share = (ground * np.float32(session.wet))[..., None]
        colours += share * (colours * 0.55 + gleam * 0.5 - colours)


def _sky(camera: Camera, session: Session, film: Film, rng: np.random.Generator) -> Light:
    """(width, height, 3): a gradient by elevation, with clouds."""
    rows = np.arange(camera.height, dtype=np.float32)
    elevation = np.clip((camera.horizon * camera.height - rows) / camera.focal, 0, 1.2)
    share = (1 - np.exp(-elevation * 2.2))[:, None]
    gradient = share * np.asarray(session.sky_top) + (1 - share) * np.asarray(session.sky_horizon)
    x0 = int(camera.yaw % 360 / 360 * (CLOUD_SHAPE[1] // 2)) + int(rng.integers(64))
    wide = max(8, int(camera.fov / 360 * CLOUD_SHAPE[1]))
    x0 %= CLOUD_SHAPE[1] - wide
    y0 = int(rng.integers(CLOUD_SHAPE[0] - 128))
    clouds = Image.fromarray(film.clouds).resize(
        (camera.width, camera.height), Image.Resampling.BILINEAR, box=(x0, y0, x0 + wide, y0 + 128)
    )
    mask = np.clip((np.asarray(clouds).T + 2 * session.clouds - 0.9) * 2.0, 0, 1)[..., None]
    white = np.minimum(1.0, np.asarray(session.sky_horizon) * 1.05 + 0.02)
    mask = mask * (0.35 + 0.5 * share[None])
    sky = gradient[None] * (1 - mask) + white * mask
    return np.asarray(sky, np.float32)


def _expose(colours: Light, session: Session, film: Film, rng: np.random.Generator) -> Image.Image:
    """Exposure, white balance, contrast, vignette, blur and grain."""
    gain = np.asarray(session.gain) * math.exp(rng.normal(0, session.exposure_spread))
    if session.mixing:
        grey = colours.mean(axis=2, keepdims=True)
        colours += np.float32(session.mixing) * (grey - colours)
    colours *= (gain * 255 * rng.normal(1, 0.01, 3)).astype(np.float32)
    if session.contrast != 1:
        colours -= 118
        colours *= np.float32(session.contrast)
        colours += 118
    width, height = colours.shape[:2]
    across = np.linspace(-1, 1, width, dtype=np.float32)[:, None] ** 2
    down = np.linspace(-1, 1, height, dtype=np.float32)[None] ** 2
    colours *= (1 - 0.09 * (across + down))[..., None]
    x, y = (int(rng.integers(max(1, GRAIN_SHAPE[k] - (width, height)[k]))) for k in (0, 1))
    grain = film.grain[x : x + width, y : y + height]
    if session.blur:
        np.clip(colours, 0, 255, out=colours)
        soft = Image.fromarray(colours.astype(np.uint8).transpose(1, 0, 2)).filter(
            ImageFilter.BoxBlur(session.blur)
        )
        colours = np.asarray(soft).transpose(1, 0, 2).astype(np.float32)
    colours += np.float32(session.noise) * grain
    np.clip(colours, 0, 255, out=colours)
    return Image.fromarray(np.ascontiguousarray(colours.astype(np.uint8).transpose(1, 0, 2)))


def encode(photo: Image.Image, session: Session) -> bytes:
    """The photo as the bytes of a JPEG file."""
    buffer = io.BytesIO()
    photo.save(buffer, "JPEG", quality=session.quality)
    return buffer.getvalue()
