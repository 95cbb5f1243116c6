"""Loads an extractor for a command that runs without a server. Imports torch."""

from __future__ import annotations

import contextlib
from pathlib import Path

import torch
from sqlalchemy.exc import SQLAlchemyError

from placewise.protocol import open_file
from services.extractor.added_models import AddedModelLoader
from shared.catalog.database.errors import explain_outage
from shared.catalog.database.schema import check_schema
from shared.catalog.tables import open_catalog
from shared.config.settings import Settings
from shared.descriptors.backbones import Backbone
from shared.descriptors.extractor import Extractor, choose_device
from shared.descriptors.inference import choose_precision
from shared.errors import Misconfigured
from shared.extractor_config.configs import ExtractorConfig
from shared.extractor_config.names import TORCHSCRIPT_PREFIX
from shared.storage.copying import hash_file
from shared.storage.open_store import open_store


def load_extractor(config: ExtractorConfig, settings: Settings) -> Extractor:
    """Load an extractor on the device and in the precision of the settings.

    Raises:
        Misconfigured: The weights are missing or don't fit; `model_missing`, `code_not_allowed`.
    """
    device = choose_device(settings.device)
    return Extractor(
        config,
        device,
        precision=choose_precision(settings.precision, config, device),
        dino_weights=settings.dino_weights,
        backbone=_added_backbone(config, settings, device),
    )


def _added_backbone(
    config: ExtractorConfig, settings: Settings, device: torch.device
) -> Backbone | None:
    """Load an added model from the catalog and store, which may be in use; None for others.

    Raises Misconfigured (`code_not_allowed`) for any TorchScript file that CODE_ALLOWED lacks.
    """
    if config.model is None:
        return None
    if config.model.file is not None and config.model.prefix == TORCHSCRIPT_PREFIX:
        with open_file(Path(config.model.file)) as file:
            settings.check_torchscript_allowed(config.model.extractor, hash_file(file)[1])
    if config.model.registered is None:
        return None
    name, prefix = config.model.registered, config.model.prefix
    catalog_file = settings.placewise_home / "catalog.sqlite"
    if settings.database_url is None and not catalog_file.exists():
        raise Misconfigured(
            "model_missing",
            f"Can't load the model {name!r}: there is no catalog in PLACEWISE_HOME "
            f"({settings.placewise_home}). Add the model there (`placewise models add FILE --name "
            f"{name}`), or use the file itself: {prefix}/FOLDER/FILE.",
            model=name,
        )
    with contextlib.closing(open_catalog(settings, "describe")) as catalog:
        try:
            check_schema(catalog)
            store = open_store(settings, exclusive=False)
            return AddedModelLoader(catalog, store, settings).load(config, device)
        except SQLAlchemyError as error:
            unavailable = explain_outage(error)
            if unavailable is None:
                raise
            raise unavailable from error
