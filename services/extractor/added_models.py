"""Models that were added, loaded by whoever describes photos with them."""

from __future__ import annotations

from pathlib import Path

import torch

from services.extractor.model_cache import ModelFileCache
from shared.catalog.added_models import get_model_for_loading
from shared.catalog.session import Catalog
from shared.errors import NotFound, Unavailable
from shared.objects import ObjectStore
from shared.settings import Settings
from shared.vision.backbones.trained import TrainedBackbone
from shared.vision.place_models.model_file import read_model_file


def model_cache_folder(settings: Settings) -> Path:
    """Where files of models lie for a while, when objects are no files of this machine."""
    return settings.placewise_home / "model-cache"


class AddedModelLoader:
    """By their names; the catalog says where each lies and what it is."""

    def __init__(self, catalog: Catalog, store: ObjectStore, settings: Settings) -> None:
        self._catalog = catalog
        self._cache = ModelFileCache(
            store, model_cache_folder(settings), settings.model_cache_bytes
        )

    def load(self, name: str, device: torch.device) -> TrainedBackbone:
        """The model `name`, its weights on the device.

        Misconfigured (`model_missing`); Unavailable: `model_lost`, `model_corrupt`,
        `model_unreadable`, and those of the store.
        """
        with self._catalog.read() as session:
            row = get_model_for_loading(session, name)
        assert row.object_key is not None
        assert row.sha256 is not None
        try:
            found = read_model_file(self._cache.local_path(row.object_key, row.sha256))
        except NotFound as error:
            raise Unavailable(
                "model_lost",
                f"The weights of the model {name!r} are gone from the object store "
                f"({row.object_key}). Restore them from a backup, or add the same checkpoint again "
                "under its name.",
                model=name,
            ) from error
        return TrainedBackbone(
            row.name, found.model, row.fingerprint, device, licence=row.licence, card=row.card
        )
