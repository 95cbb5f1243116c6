"""Synthetic map as the services store it: catalog, object store, chunks of 1,000 rows, photos.

The descriptors resemble those of VLAD on walks through a city and are generated without photos.

A descriptor has 64 blocks, one per visual word, each of unit length or empty, divided by the square
root of the number of blocks that are not empty. A block lies mostly in a subspace of its own with a
power law of variances; a direction common to all photos, and channels of higher variance, are
added. The photos of a walk are an AR(1) process whose steps are small within a place and large
between places. Walks differ in the number of photos per place: 1, 3 or 30.

The parameters are fitted to measurements at 98,304 dimensions on descriptors of photos' features:
photos of different places have cosines of about 0.09 +- 0.03, a revisited place 0.35 to 0.75, and
the tenth best photo of a query from outside the map less than 0.2.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import insert

from services.search.catalog_sync import MIN_CODED_BYTES
from shared.catalog.chunks import list_live_chunks
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from shared.catalog.generations import RowType
from shared.catalog.maps import Map
from shared.catalog.photos import Photo
from shared.codes.rotation import get_rotation
from shared.config.settings import Settings
from shared.storage import FolderStore
from shared.storage.chunks import Rows
from tests.support.catalog_rows import add_chunk, add_generation, add_map, made_up_photo

CHUNK_ROWS = 1000


@dataclass(slots=True)
class SyntheticMap:
    """A map with one generation of float16 rows in a folder."""

    settings: Settings
    catalog: Catalog
    store: FolderStore
    map_id: UUID
    generation_id: UUID
    dimension: int
    photo_ids: list[UUID] = field(default_factory=list)
    """In the order in which they were added."""

    @property
    def version(self) -> int:
        """Current version of the map."""
        with self.catalog.read() as session:
            return session.get_one(Map, self.map_id).version

    def add(self, rows: Rows) -> None:
        """Publish a chunk of new photos."""
        photos = [made_up_photo(self.map_id) for _ in rows]
        with self.catalog.write() as session:
            session.execute(insert(Photo), photos)
        ids = [photo["id"] for photo in photos]
        stored = rows.astype(RowType.FLOAT16)
        add_chunk(self.catalog, self.store, self.generation_id, ids, stored)
        self.photo_ids += ids

    def chunk_paths(self) -> list[Path]:
        """Return the files of the live chunks."""
        with self.catalog.read() as session:
            keys = [chunk.object_key for chunk in list_live_chunks(session, self.generation_id)]
        return [self.store.path(key) for key in keys]


@contextlib.contextmanager
def create_synthetic_map(
    home: Path, dimension: int, *, search_memory_budget: int
) -> Iterator[SyntheticMap]:
    """Create an empty map in the folder `home`, in a SQLite catalog."""
    settings = Settings(
        _env_file=None, placewise_home=home, search_memory_budget=search_memory_budget
    )
    home.mkdir(parents=True, exist_ok=True)
    with contextlib.closing(Catalog(settings.catalog_url())) as catalog:
        migrate(catalog)
        with catalog.write() as session:
            map_id = add_map(session).id
            generation = add_generation(
                session, map_id, dimension=dimension, row_type=RowType.FLOAT16
            )
        store = FolderStore(home / "objects")
        yield SyntheticMap(settings, catalog, store, map_id, generation.id, dimension)


def required_memory_bytes(photos: int, dimension: int) -> int:
    """Return the SEARCH_MEMORY_BUDGET for the codes of so many photos.

    If search does not use codes, it is that of their rows. Other rows stay memory-mapped.
    """
    return max(photos * get_rotation(dimension).padded // 8, MIN_CODED_BYTES)


BLOCKS = 64
WALK_PHOTOS = 250
PHOTOS_PER_PLACE = (1, 3, 30)
"""Of walk number n: the entry n modulo 3."""

SUBSPACE = 110  # maximum dimension of a block's subspace; otherwise half of the block's width
DECAY = 0.6  # the standard deviation of its i-th direction is i^-DECAY
SHARED = 0.42  # strength of the shared direction relative to the subspace
NOISE = 0.5  # strength of the noise of a single photo
EMPTY_BELOW = -0.583  # threshold of a normal deviate; leaves 28 % of the blocks empty
WORD_COUNT_SPREAD = 0.22  # spread of the number of words per photo
STRONG_CHANNELS = 0.01
STRENGTH = 9.0  # of their noise

SAME_PLACE_CORRELATION = 0.985  # AR(1) coefficients
NEXT_PLACE_CORRELATION = 0.85
MIN_CHANGE, MAX_CHANGE = 0.05, 0.6
"""Of the appearance of a place that is seen again: the share of the latent variance."""

OUT_OF_MAP_WALKS = 1_000_000  # first number of walks that are in no map

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Latents:
    """Latent content of n photos, before noise."""

    looks: Floats
    """(n, BLOCKS, subspace): normal deviates."""
    words: Floats
    """(n, BLOCKS): a block is empty where this is low."""


class SyntheticCity:
    """Generates descriptors of one dimension (a multiple of 64), deterministic for a seed."""

    def __init__(self, dimension: int, seed: int) -> None:
        if dimension % BLOCKS:
            raise ValueError(f"{BLOCKS} blocks do not make {dimension} dimensions")
        self.dimension = dimension
        self.seed = seed
        self._width = dimension // BLOCKS
        self._subspace = min(SUBSPACE, self._width // 2)
        draw = self._draw(OUT_OF_MAP_WALKS, 1)
        self._strengths = _normalise(np.arange(1, self._subspace + 1, dtype=np.float32) ** -DECAY)
        bases = draw.standard_normal((BLOCKS, self._width, self._subspace), np.float32)
        self._bases = np.ascontiguousarray(np.linalg.qr(bases)[0].transpose(0, 2, 1))
        self._common = SHARED * _normalise(draw.standard_normal((BLOCKS, self._width), np.float32))
        strong = draw.random((BLOCKS, self._width)) < STRONG_CHANNELS
        self._channels = NOISE * _normalise(np.where(strong, np.float32(STRENGTH), np.float32(1.0)))

    def chunks(self, photos: int, chunk_rows: int) -> Iterator[Rows]:
        """Yield the map's first `photos` descriptors in pieces of (n, dimension), L2-normalised."""
        waiting: list[Rows] = []
        made = 0
        for walk in range(-(-photos // WALK_PHOTOS)):
            rows = self.describe(self.walk(walk), self._draw(walk, 1))
            waiting.append(rows[: photos - made])
            made += len(waiting[-1])
            while sum(map(len, waiting)) >= chunk_rows:
                together = np.concatenate(waiting)
                yield together[:chunk_rows]
                waiting = [together[chunk_rows:]]
        if waiting and (rest := np.concatenate(waiting)).size:
            yield rest

    def revisits(self, photos: int, count: int) -> Rows:
        """Return (count, dimension) descriptors of revisited places, more or less changed."""
        draw = self._draw(OUT_OF_MAP_WALKS, 2)
        rows = np.empty((count, self.dimension), np.float32)
        walks = photos // WALK_PHOTOS
        for number in range(count):
            if walks < len(PHOTOS_PER_PLACE):
                walk, photo = 0, int(draw.integers(min(photos, WALK_PHOTOS)))
            else:
                kind = number % len(PHOTOS_PER_PLACE)
                kinds = np.arange(kind, walks, len(PHOTOS_PER_PLACE))
                walk, photo = int(draw.choice(kinds)), int(draw.integers(WALK_PHOTOS))
            there = self.walk(walk)
            here = Latents(there.looks[photo : photo + 1], there.words[photo : photo + 1])
            change = draw.uniform(MIN_CHANGE, MAX_CHANGE)
            rows[number] = self.describe(self._changed(here, change, draw), draw)[0]
        return rows

    def out_of_map_rows(self, count: int) -> Rows:
        """Return (count, dimension) descriptors of other walks, whose places are not in the map."""
        rows = np.empty((count, self.dimension), np.float32)
        for number in range(count):
            draw = self._draw(OUT_OF_MAP_WALKS + 1 + number, 0)
            rows[number] = self.describe(self._fresh(1, draw), draw)[0]
        return rows

    def walk(self, number: int) -> Latents:
        """Yield the photos of a walk in order."""
        draw = self._draw(number, 0)
        found = self._fresh(WALK_PHOTOS, draw)
        of_a_place = PHOTOS_PER_PLACE[number % len(PHOTOS_PER_PLACE)]
        for photo in range(1, WALK_PHOTOS):
            keep = SAME_PLACE_CORRELATION if photo % of_a_place else NEXT_PLACE_CORRELATION
            for part in (found.looks, found.words):
                part[photo] = np.float32(keep) * part[photo - 1] + _complement(keep) * part[photo]
        return found

    def describe(self, latents: Latents, draw: np.random.Generator) -> Rows:
        """Return (n, dimension) L2-normalised descriptors."""
        count = len(latents.looks)
        rows = draw.standard_normal((count, BLOCKS, self._width), np.float32)
        rows *= self._channels
        strengths = self._strengths
        for block in range(BLOCKS):
            rows[:, block] += (latents.looks[:, block] * strengths) @ self._bases[block]
            rows[:, block] += self._common[block]
        empty = latents.words < EMPTY_BELOW
        empty[:, 0] &= ~empty.all(axis=1)  # a photo has one word at least
        rows /= np.linalg.norm(rows, axis=2, keepdims=True)
        rows[empty] = 0
        rows /= np.sqrt(BLOCKS - empty.sum(axis=1, dtype=np.float32))[:, np.newaxis, np.newaxis]
        return rows.reshape(count, self.dimension)

    def _fresh(self, count: int, draw: np.random.Generator) -> Latents:
        """Return photos that have nothing in common."""
        looks = draw.standard_normal((count, BLOCKS, self._subspace), np.float32)
        rich = draw.standard_normal((count, 1), np.float32)
        words = draw.standard_normal((count, BLOCKS), np.float32)
        return Latents(
            looks, np.float32(WORD_COUNT_SPREAD) * rich + _complement(WORD_COUNT_SPREAD) * words
        )

    def _changed(self, photos: Latents, share: float, draw: np.random.Generator) -> Latents:
        """Return the same places with the share `share` of their appearance replaced."""
        new = self._fresh(len(photos.looks), draw)
        keep = math.sqrt(1 - share)
        return Latents(
            np.float32(keep) * photos.looks + _complement(keep) * new.looks,
            np.float32(keep) * photos.words + _complement(keep) * new.words,
        )

    def _draw(self, stream: int, part: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, self.dimension, stream, part])


def _complement(keep: float) -> np.float32:
    """Return the factor of new noise that keeps the variance at 1."""
    return np.float32(math.sqrt(1 - keep**2))


def _normalise(rows: Floats) -> Floats:
    """L2-normalise each row."""
    found: Floats = rows / np.linalg.norm(rows, axis=-1, keepdims=True)
    return found
