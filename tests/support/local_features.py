"""Local features of made-up scenes, without a detector, and files of them."""

from __future__ import annotations

from collections.abc import Mapping
from uuid import UUID

import numpy as np
from sqlalchemy import select

from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.session import Catalog
from shared.ids import new_id
from shared.matching.features import LocalFeatures
from shared.search_api.protocol import FeatureReference
from shared.storage import ObjectStore
from shared.storage.chunks import features_key
from shared.storage.feature_files import FeatureRows, encode_feature_file

MODEL = "xfeat@0123456789ab"
SIZE = (1280, 960)
SCENE_POINTS = 120


def scene_features(scene: int, view: float = 0.0, points: int = SCENE_POINTS) -> LocalFeatures:
    """The features of a photo of a scene by a camera that stands `view` metres to the right."""
    random = np.random.default_rng(scene)
    spots = random.uniform((-1, -1, 4), (1, 1, 8), (points, 3)) - (view, 0, 0)
    parts = 0.5 + spots[:, :2] / spots[:, 2:]
    descriptors = random.standard_normal((points, 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    pixels = parts * SIZE - 0.5
    return LocalFeatures.quantise(
        SIZE, SIZE, pixels.astype(np.float32), descriptors.astype(np.float32)
    )


def put_features(
    store: ObjectStore,
    *photos: LocalFeatures | None,
    model: str = MODEL,
    key: str | None = None,
) -> list[FeatureReference]:
    """Store a feature file of these photos; None is a row without features."""
    key = key or f"chunks/{new_id()}/{new_id()}.features"
    store.put(key, encode_feature_file(feature_rows(*photos, model=model), key))
    return [FeatureReference(object_key=key, row=row) for row in range(len(photos))]


def feature_rows(*photos: LocalFeatures | None, model: str = MODEL) -> FeatureRows:
    """Return the rows of a feature file; None is one without features."""
    rows = [b"" if features is None else features.encode() for features in photos]
    return FeatureRows(model, rows)


def add_features(
    catalog: Catalog, store: ObjectStore, photos: Mapping[UUID, LocalFeatures]
) -> None:
    """Store features of described photos beside their chunks; other photos have none."""
    with catalog.write() as session:
        for chunk in session.scalars(select(Chunk)):
            rows: list[LocalFeatures | None] = [None] * chunk.rows
            described = select(Descriptor).where(Descriptor.chunk_id == chunk.id)
            for descriptor in session.scalars(described):
                rows[descriptor.row] = photos.get(descriptor.photo_id)
            put_features(store, *rows, key=features_key(chunk.object_key))
            chunk.features_model = MODEL
