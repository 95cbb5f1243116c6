"""One photo's scene: rays against facade rows, the ground below, things in front, by depth."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from shared.datasets.city.camera import Camera, Floats, RayHits, cast_rays
from shared.datasets.city.canvas import (
    SUPERSAMPLING,
    RenderBuffers,
    choose_mip_level,
    project_row,
    sample_texture,
)
from shared.datasets.city.catalogue import Catalogue
from shared.datasets.city.facade import draw_house
from shared.datasets.city.ground import paint_ground
from shared.datasets.city.sessions import CaptureSession
from shared.datasets.city.streets import Quarter
from shared.datasets.city.texture_memory import TextureCache
from shared.datasets.city.things_in_sight import OBJECT_RANGE_M, VisibleObjects, VisibleSprite
from shared.datasets.city.walls import PIXELS_PER_METRE

FACADE_RANGE_M = 190.0
LAMP_SPACING_M = 25.0


class QuarterRenderer:
    """Paints views of one quarter; keeps the textures and the things it has met."""

    def __init__(self, quarter: Quarter, catalogue: Catalogue, memory: TextureCache) -> None:
        self.quarter = quarter
        self.catalogue = catalogue
        self.memory = memory
        self._things = VisibleObjects(quarter, catalogue)
        self._side_middles = (
            quarter.side_starts + quarter.side_directions * quarter.side_lengths[:, None] / 2
        )

    def view(self, camera: Camera, session: CaptureSession) -> RenderBuffers:
        """What the camera sees on the session's day."""
        width, height = camera.width, camera.height
        view = RenderBuffers(
            canvas=np.zeros((width * SUPERSAMPLING, height * SUPERSAMPLING), np.uint32),
            depth=np.full((width, height), np.inf, np.float32),
            sun=np.ones((width, height), np.float32),
            lamp=np.zeros(width, np.float32),
        )
        near = np.hypot(*(self._side_middles - camera.position).T)
        sides = np.flatnonzero(near < FACADE_RANGE_M)
        slopes = camera.slopes(SUPERSAMPLING)
        hits = cast_rays(
            camera,
            slopes,
            self.quarter.side_starts[sides],
            self.quarter.side_directions[sides],
            self.quarter.side_lengths[sides],
        )
        self._paint_facades(view, camera, session, hits, sides)
        paint_ground(view, camera, hits, self.quarter, sides, self.memory)
        for item in sorted(
            self._things.items(camera, session, sides[near[sides] < OBJECT_RANGE_M], slopes),
            key=lambda item: -item.depth,
        ):
            self._paint_item(view, camera, item, hits.depth)
        return view

    def _paint_facades(
        self,
        view: RenderBuffers,
        camera: Camera,
        session: CaptureSession,
        hits: RayHits,
        sides: NDArray[np.int64],
    ) -> None:
        columns = np.flatnonzero(np.isfinite(hits.depth))
        if not len(columns):
            return
        depth, along = hits.depth[columns], hits.along[columns]
        side = sides[hits.plane[columns]]
        plot = np.empty(len(columns), np.int64)
        for number in np.unique(side):
            here = side == number
            cuts = self.quarter.sides[number].cuts
            found = np.searchsorted(cuts, along[here], side="right") - 1
            plot[here] = np.clip(found, 0, len(cuts) - 2)
        level = choose_mip_level(PIXELS_PER_METRE, depth, camera)
        offset = np.empty(len(columns), np.int64)
        rows = np.empty(len(columns), np.int64)
        top = np.empty(len(columns))
        houses = sorted(set(zip(side.tolist(), plot.tolist(), strict=True)))
        self.memory.reserve(
            {self._key(*house): self.quarter.house(*house).pixels for house in houses}
        )
        for number, lot in houses:
            here = np.flatnonzero((side == number) & (plot == lot))
            house = self.quarter.house(number, lot)
            texture = self.memory.get(
                self._key(number, lot), partial(draw_house, house, self.catalogue), rim=False
            )
            at = level[here]
            scale = PIXELS_PER_METRE / 2.0**at
            across = (along[here] - self.quarter.sides[number].cuts[lot]) * scale
            column = np.clip(across.astype(np.int64), 0, texture.widths[at] - 1)
            offset[here] = texture.offsets[at] + column * texture.heights[at]
            rows[here] = texture.heights[at]
            top[here] = house.top
        bottom = project_row(camera, 0.0, depth, columns)
        last = min(view.canvas.shape[1], int(bottom.max()) + 1)
        scale = PIXELS_PER_METRE / 2.0**level
        block = sample_texture(
            self.memory, camera, columns, depth, top, scale, offset, rows, 0, last
        )
        block *= block >= 1 << 24
        view.canvas[columns, :last] = block
        coarse = np.flatnonzero(columns % SUPERSAMPLING == 0)
        xs = columns[coarse] // SUPERSAMPLING
        solid = block[coarse, ::SUPERSAMPLING] > 0
        region = view.depth[xs, : solid.shape[1]]
        view.depth[xs, : solid.shape[1]] = np.where(solid, depth[coarse, None], region)
        view.sun[xs] = self._sunlit(session, side[coarse])[:, None]
        wave = 0.5 + 0.5 * np.cos(along[coarse] * (2 * np.pi / LAMP_SPACING_M))
        view.lamp[xs] = wave * np.exp(-depth[coarse] / 60.0)

    def _key(self, side: int, plot: int) -> tuple[str, int, int]:
        return (self.quarter.name, side, plot)

    def _sunlit(self, session: CaptureSession, sides: NDArray[np.int64]) -> Floats:
        direction = self.quarter.side_directions[sides]
        azimuth = np.radians(session.sun_azimuth)
        towards = direction[:, 1] * np.sin(azimuth) - direction[:, 0] * np.cos(azimuth)
        return np.asarray(np.maximum(0.0, towards))

    def _paint_item(
        self, view: RenderBuffers, camera: Camera, item: VisibleSprite, walls: Floats
    ) -> None:
        """Paint one picture over what is there; `walls` are the depths of the houses by column."""
        columns = np.arange(item.first, item.first + len(item.depths))
        if not (item.depths < walls[columns] + 0.05).any():
            return
        image = item.picture.image
        texture = self.memory.get(item.key, lambda: image, rim=True)
        finest = image.height / item.picture.height
        level = choose_mip_level(finest, item.depths, camera)
        scale = finest / 2.0**level
        top = item.picture.bottom + item.picture.height
        column = np.clip((item.alongs * scale).astype(np.int64) + 1, 0, texture.widths[level] - 1)
        offset = texture.offsets[level] + column * texture.heights[level]
        rows = texture.heights[level]
        first = max(0, int(project_row(camera, top, item.depths, columns).min()) - 1)
        lowest = int(project_row(camera, item.picture.bottom, item.depths, columns).max())
        last = min(view.canvas.shape[1], lowest + 2)
        if last <= first:
            return
        scales = np.asarray(scale, np.float64)
        tops = np.full(len(columns), top)
        texels = sample_texture(
            self.memory,
            camera,
            columns,
            item.depths,
            tops,
            scales,
            offset,
            rows,
            first,
            last,
            rim=1,
        )
        solid = texels >= 1 << 24
        solid &= (item.depths < walls[columns] + 0.05)[:, None]  # else a house stands before it
        region = view.canvas[item.first : item.first + len(columns), first:last]
        np.copyto(region, texels, where=solid)
        odd_x, odd_y = item.first % SUPERSAMPLING, first % SUPERSAMPLING
        coarse = solid[odd_x::SUPERSAMPLING, odd_y::SUPERSAMPLING]
        x, y = (item.first + odd_x) // SUPERSAMPLING, (first + odd_y) // SUPERSAMPLING
        box = (slice(x, x + coarse.shape[0]), slice(y, y + coarse.shape[1]))
        depths = np.broadcast_to(
            item.depths[odd_x::SUPERSAMPLING, None].astype(np.float32), coarse.shape
        )
        np.copyto(view.depth[box], depths, where=coarse)
        np.copyto(view.sun[box], np.float32(0.5), where=coarse)
