"""Extractors for the commands that describe photos without a server, those of added models as well.

Imports torch.
"""

from __future__ import annotations

import contextlib

import torch
from sqlalchemy.exc import SQLAlchemyError

from services.extractor.added_models import AddedModelLoader
from shared.catalog.away import to_unavailable
from shared.catalog.open_catalog import open_catalog
from shared.catalog.schema import check_schema
from shared.errors import Misconfigured
from shared.objects.open_store import open_store
from shared.recipes import ExtractorConfig
from shared.settings import Settings
from shared.vision.backbones import Backbone
from shared.vision.extractors import Extractor, choose_device
from shared.vision.precision import choose_precision


def load_extractor(recipe: ExtractorConfig, settings: Settings) -> Extractor:
    """On the device and in the precision that the settings say; raises what loading it does, and as
    `_added_backbone`.
    """
    device = choose_device(settings.device)
    return Extractor(
        recipe,
        device,
        precision=choose_precision(settings.precision, recipe, device),
        dino_weights=settings.dino_weights,
        backbone=_added_backbone(recipe, settings, device),
    )


def _added_backbone(
    recipe: ExtractorConfig, settings: Settings, device: torch.device
) -> Backbone | None:
    """The model that the recipe names, from the catalog and the store of the settings, which a
    server may be using; None for an extractor that is no added model.

    Misconfigured (`model_missing`), and what the catalog, the store and `AddedModels.load` raise.
    """
    name = recipe.trained.registered if recipe.trained else None
    if name is None:
        return None
    catalog_file = settings.placewise_home / "catalog.sqlite"
    if settings.database_url is None and not catalog_file.exists():
        raise Misconfigured(
            "model_missing",
            f"The model {name!r} is looked for in the catalog of PLACEWISE_HOME, and there is none "
            f"in {settings.placewise_home}. Add it there (`placewise models add CHECKPOINT --name "
            f"{name}`), or describe with the checkpoint itself: gsv:/FOLDER/FILE.ckpt.",
            model=name,
        )
    with contextlib.closing(open_catalog(settings, "describe")) as catalog:
        try:
            check_schema(catalog)
            store = open_store(settings, exclusive=False)
            return AddedModelLoader(catalog, store, settings).load(name, device)
        except SQLAlchemyError as error:
            unavailable = to_unavailable(error)
            if unavailable is None:
                raise
            raise unavailable from error
