"""Extractors with their vocabularies, for commands that run without a server. Imports torch."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lab.training.describing import PhotoDecoder, PhotoDescriber
from shared.config.settings import Settings
from shared.descriptors.extractor import Extractor
from shared.descriptors.pca_whitening import PcaProjection
from shared.descriptors.vocabulary import ClusterCentres
from shared.descriptors.vocabulary_file import (
    VocabularyFile,
    check_vocabulary_fits,
    check_vocabulary_width,
    read_vocabulary,
)
from shared.errors import Misconfigured, Unprocessable
from shared.extractor_config.configs import ExtractorConfig


def photo_decoder(
    extractor: Extractor, settings: Settings, read: Callable[[Any], bytes] = Path.read_bytes
) -> PhotoDecoder:
    """Return a decoder for an extractor, with the limits of the settings."""
    return PhotoDecoder(
        extractor.preprocessing,
        settings.batch_photos,
        settings.max_image_pixels,
        read=read,
        ahead=extractor.backbone.device.type != "cpu",
    )


def photo_describer(
    extractor: Extractor,
    centres: ClusterCentres | None,
    settings: Settings,
    projection: PcaProjection | None = None,
    read: Callable[[Any], bytes] = Path.read_bytes,
) -> PhotoDescriber:
    """Return a describer of photos with an extractor."""
    return PhotoDescriber(
        lambda pixels: extractor.describe(pixels, centres, projection),
        photo_decoder(extractor, settings, read),
        extractor.backbone.device,
    )


def load_own_vocabulary(config: ExtractorConfig, vocabulary: Path | None) -> VocabularyFile | None:
    """Read the vocabulary file that the user has named; None if there is none and none is required.

    An extractor that uses no vocabulary, or ships one, requires none.

    Raises:
        Unprocessable: `vocabulary_unusable` if it does not match the extractor.
        Misconfigured: `vocabulary_missing` if the extractor needs one and none is given.
    """
    if vocabulary is not None:
        if not config.needs_vocabulary:
            raise Unprocessable(
                "vocabulary_unusable", f"The extractor {config.name} does not use a vocabulary."
            )
        own = read_vocabulary(vocabulary)
        check_vocabulary_width(own.centres, config, config.width)  # before the weights are loaded
        return own
    if config.needs_vocabulary and config.shipped_vocabulary is None:
        raise Misconfigured(
            "vocabulary_missing",
            f"The extractor {config.name} requires a vocabulary and ships none. Pass --vocabulary "
            "FILE, or the option aggregator=gem, which needs none.",
        )
    return None


def resolve_centres(extractor: Extractor, own: VocabularyFile | None) -> ClusterCentres | None:
    """The cluster centres of the file, or else the shipped ones; None if none are needed.

    Raises:
        Unprocessable: `vocabulary_unusable` if the file's vocabulary does not match the extractor.
    """
    if own is not None:
        check_vocabulary_fits(own.provenance, own.centres, extractor)
        return own.centres
    if not extractor.config.needs_vocabulary:
        return None
    shipped = extractor.shipped_vocabulary()
    assert shipped is not None, "load_own_vocabulary checked that one is shipped"
    return shipped[0]
