"""Extractors by name: which backbone, preprocessing and aggregator make a descriptor.

    get_recipe("anyloc-vitb14", allow_test_extractors=False)
    get_recipe("anyloc-vitb14:clusters=32,facet=key,layer=9", allow_test_extractors=False)
    get_recipe("anyloc-vitg14:preprocessing=paper480x640", allow_test_extractors=False)
    get_recipe("torchhub:/models/mine:my_entry", allow_test_extractors=False)
    get_recipe("gsv:night-walks", allow_test_extractors=False)

A name may carry options. Their canonical order is the alphabet's and what equals the extractor's
own default is left out, so that one extractor has one name wherever it is stored or compared.

Imports no torch: the settings and the gateway choose extractors without loading one.
`shared.descriptors.extractor` turns a recipe into descriptors.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from shared.errors import Misconfigured
from shared.extractor_config.names import (
    DEFAULT_INPUT_SIDE_PIXELS,
    TORCHHUB_PREFIX,
    TorchHubEntry,
    TrainedModelName,
    parse_torchhub_name,
    parse_trained_model_name,
)
from shared.extractor_config.names import TRAINED_MODEL_PREFIX as TRAINED_PREFIX

FACETS = ("query", "key", "value", "token")
EXTRACTOR_AGGREGATORS = ("vlad", "soft-vlad", "gem", "avg")
# Of the network's published figures: rankings with them are to be those of its authors.
ANYLOC_PREPROCESSING_NAMES = ("demo1024", "paper480x640", "round14")
PREPROCESSING_NAMES = ("square224", *ANYLOC_PREPROCESSING_NAMES)
MAX_CLUSTERS = 4096
MAX_PCA_DIMENSION = 1024  # dimensions after PCA: its time and memory grow with the square
TORCHHUB_BACKBONE = "torchhub"  # the backbone that is a torch.hub entry
TRAINED_BACKBONE = "gsv"  # the backbone that is a model of `placewise train`
SLOW_TEST_BACKBONE = "test-slow"  # the backbone whose width and time are options
MAX_WIDTH = 131_072
MAX_MILLISECONDS = 60_000
MAX_TEMPERATURE = 1000


@dataclass(frozen=True, slots=True)
class ExtractorConfig:
    """How the extractor `name` is put together."""

    name: str
    """Canonical, with the options that differ from the extractor's defaults."""
    backbone: str
    """One of `shared.descriptors.extractor.BACKBONES`."""
    width: int | None
    """Length of one local feature; None where only the loaded network tells."""
    parameters: int | None
    """Of the whole backbone, rounded up; each takes 4 bytes. None as above."""
    preprocessing: str | None
    """A name that `shared.imaging.preprocessing.get_preprocessing` knows; None where only the
    loaded
    network tells.
    """
    aggregator: str
    """One of AGGREGATORS. VLAD, hard or soft, needs a vocabulary; GeM and the mean do without. Or
    `none`: the backbone makes one feature of a photo, and that is its descriptor.
    """
    depth: int | None = None
    """Blocks of a transformer; None where neither layer nor facet can be chosen."""
    layer: int | None = None
    """Index of the block that the features come from, counted from 0."""
    facet: str | None = None
    """What is taken from that block: one of FACETS."""
    temperature: float = 1.0
    """Of soft VLAD: by what the cosines are multiplied before the softmax."""
    clusters: int = 64
    """Centres that a fit makes unless it says otherwise; any vocabulary's own number goes first."""
    shipped_vocabulary: str | None = None
    """File below `shared/descriptors/vocabularies/`, learnt on photographs of elsewhere: a new map
    answers with it at once, whatever `clusters` says about later fits.
    """
    hub: TorchHubEntry | None = None
    """The torch.hub entry that makes the descriptors, for `torchhub:` names."""
    trained: TrainedModelName | None = None
    """The model that makes the descriptors, for `gsv:` names."""
    for_tests: bool = False
    milliseconds: int = 0
    """Time that a photo takes, slept, of an extractor for tests."""

    @property
    def needs_vocabulary(self) -> bool:
        return self.aggregator in ("vlad", "soft-vlad")

    @property
    def has_local_features(self) -> bool:
        """Whether the backbone makes local features: several of a photo, each of a patch."""
        return self.aggregator != "none"

    @property
    def dimension(self) -> int | None:
        """Length of a descriptor once a fit has made `clusters` centres; None as for `width`.

        A generation carries its own in any case.
        """
        if self.width is None:
            return None
        return self.width * (self.clusters if self.needs_vocabulary else 1)

    @property
    def local_features(self) -> tuple[int | str | TorchHubEntry | TrainedModelName | None, ...]:
        """Recipes that agree in this can share one loaded backbone."""
        return (
            self.backbone,
            self.width,
            self.layer,
            self.facet,
            self.milliseconds,
            self.hub,
            self.trained,
        )


def _anyloc_config(
    size: str, *, depth: int, width: int, layer: int, parameters: int
) -> ExtractorConfig:
    """AnyLoc (Keetha et al., RA-L 2023): DINOv2 value features and VLAD.

    The layers are those that its authors recommend for each size of the network.
    """
    return ExtractorConfig(
        name=f"anyloc-{size}",
        backbone=f"dinov2-{size}",
        width=width,
        parameters=parameters,
        preprocessing="square224",
        aggregator="vlad",
        depth=depth,
        layer=layer,
        facet="value",
    )


EXTRACTOR_CONFIGS = {
    recipe.name: recipe
    for recipe in (
        ExtractorConfig(
            name="efficientnet-lite0-vlad",
            backbone="efficientnet-lite0",
            width=112,
            parameters=5_000_000,
            preprocessing="square224",
            aggregator="vlad",
            shipped_vocabulary="efficientnet-lite0.npy",
        ),
        _anyloc_config("vits14", depth=12, width=384, layer=10, parameters=22_100_000),
        _anyloc_config("vitb14", depth=12, width=768, layer=10, parameters=86_600_000),
        _anyloc_config("vitl14", depth=24, width=1024, layer=20, parameters=304_400_000),
        _anyloc_config("vitg14", depth=40, width=1536, layer=31, parameters=1_136_500_000),
        ExtractorConfig(
            name="test-tiny-avg",
            backbone="test-tiny",
            width=16,
            parameters=1_000,
            preprocessing="square32",
            aggregator="avg",
            for_tests=True,
        ),
        ExtractorConfig(
            name="test-tiny-vlad",
            backbone="test-tiny",
            width=16,
            parameters=1_000,
            preprocessing="square32",
            aggregator="vlad",
            clusters=8,
            for_tests=True,
        ),
        ExtractorConfig(
            name="test-slow-avg",
            backbone=SLOW_TEST_BACKBONE,
            width=7168,
            parameters=1_000,
            preprocessing="square224",  # so that what is around it does its real work
            aggregator="avg",
            for_tests=True,
        ),
    )
}


def get_extractor_config(name: str, *, allow_test_extractors: bool) -> ExtractorConfig:
    """The recipe that `name` and its options mean; its own name is the canonical one.

    Misconfigured: `unknown_extractor`, `test_extractor` (for tests, and not allowed),
    `bad_extractor_option` (naming the option, its value, and what is allowed), and those of
    `parse_torchhub_name` and `parse_trained_model_name`. Whether a torch.hub entry may be loaded,
    `Settings.recipe` knows; whether a model was added, the catalog.
    """
    if name.startswith(TORCHHUB_PREFIX):
        return _torchhub_config(parse_torchhub_name(name))
    if name.startswith(TRAINED_PREFIX):
        return _trained_config(parse_trained_model_name(name))
    base, colon, written = name.partition(":")
    recipe = EXTRACTOR_CONFIGS.get(base)
    if recipe is None:
        known = ", ".join(sorted(r.name for r in EXTRACTOR_CONFIGS.values() if not r.for_tests))
        raise Misconfigured(
            "unknown_extractor",
            f"There is no extractor {base!r}. Known: {known}, "
            f"{TORCHHUB_PREFIX}OWNER/NAME@COMMIT:ENTRY, and "
            f"{TRAINED_PREFIX}NAME of a model that was added (EXTRACTOR).",
        )
    if recipe.for_tests and not allow_test_extractors:
        raise Misconfigured(
            "test_extractor",
            f"The extractor {base!r} exists for tests and knows nothing of places. "
            "Tests set ALLOW_TEST_EXTRACTORS=true.",
        )
    return _apply_options(recipe, written) if colon else recipe


def _torchhub_config(hub: TorchHubEntry) -> ExtractorConfig:
    usual = hub.height == hub.width == DEFAULT_INPUT_SIDE_PIXELS
    return ExtractorConfig(
        name=hub.name,
        backbone=TORCHHUB_BACKBONE,
        width=None,
        parameters=None,
        preprocessing="square224" if usual else f"resize{hub.height}x{hub.width}",
        aggregator="none",
        hub=hub,
    )


def _trained_config(trained: TrainedModelName) -> ExtractorConfig:
    return ExtractorConfig(
        name=trained.extractor,
        backbone=TRAINED_BACKBONE,
        width=None,
        parameters=None,
        preprocessing=None,
        aggregator="none",
        trained=trained,
    )


def add_extractor_options(name: str, options: Mapping[str, object]) -> str:
    """The name of an extractor, which may carry options, with further ones; None is left out."""
    written = [f"{option}={value}" for option, value in options.items() if value is not None]
    if not written:
        return name
    return name + ("," if ":" in name else ":") + ",".join(written)


def _apply_options(recipe: ExtractorConfig, written: str) -> ExtractorConfig:
    """`recipe` with the options of `option=value,option=value`."""
    own = recipe
    values: dict[str, str] = {}
    for part in written.split(","):
        option, _, value = part.partition("=")
        if option in values:
            raise _bad_option(f"The option {option} of {own.name} is given twice.")
        values[option] = value
    # First: some options are about one aggregator only.
    for option in sorted(values, key=lambda option: option != "aggregator"):
        allowed = _allowed_options(own, recipe)
        if option not in allowed:
            raise _bad_option(
                f"The extractor {own.name} has no option {option!r}"
                + (f" with {recipe.aggregator}" if recipe.aggregator != own.aggregator else "")
                + (f". Its options: {', '.join(sorted(allowed))}." if allowed else ". It has none.")
            )
        read, expected = allowed[option]
        try:
            recipe = replace(recipe, **{option: read(values[option])})
        except ValueError:
            raise _bad_option(
                f"The option {option}={values[option]} of {own.name} can't be used: "
                f"{option} is {expected}."
            ) from None
    differing = {
        option: f"{option}={_text(getattr(recipe, option))}"
        for option in sorted(values)
        if getattr(recipe, option) != getattr(own, option)
    }
    if not differing:
        return own
    return replace(
        recipe,
        name=f"{own.name}:{','.join(differing.values())}",
        shipped_vocabulary=own.shipped_vocabulary if recipe.needs_vocabulary else None,
    )


OptionParser = tuple[Callable[[str], Any], str]


def _allowed_options(own: ExtractorConfig, chosen: ExtractorConfig) -> dict[str, OptionParser]:
    """How options are read, and what a refusal says is allowed: those of the recipe `own`, once
    its aggregator is that of `chosen`.
    """
    allowed: dict[str, OptionParser] = {}
    if own.needs_vocabulary:
        allowed["aggregator"] = _one_of(EXTRACTOR_AGGREGATORS)
        allowed["preprocessing"] = _one_of(PREPROCESSING_NAMES)
    if chosen.needs_vocabulary:
        allowed["clusters"] = (
            _integer_between(1, MAX_CLUSTERS),
            f"a whole number from 1 to {MAX_CLUSTERS}",
        )
    if chosen.aggregator == "soft-vlad":
        allowed["temperature"] = (
            _temperature,
            f"a number above 0 and up to {MAX_TEMPERATURE}, such as 0.5",
        )
    if own.depth is not None:
        last = own.depth - 1
        allowed["facet"] = _one_of(FACETS)
        allowed["layer"] = (
            _integer_between(0, last),
            f"a whole number from 0 to {last} ({own.backbone} has {own.depth} blocks)",
        )
    if own.backbone == SLOW_TEST_BACKBONE:
        allowed["milliseconds"] = (
            _integer_between(0, MAX_MILLISECONDS),
            f"a whole number from 0 to {MAX_MILLISECONDS}, for each photo",
        )
        allowed["width"] = (
            _integer_between(16, MAX_WIDTH),
            f"a whole number from 16 to {MAX_WIDTH}",
        )
    return allowed


def _integer_between(least: int, most: int) -> Callable[[str], int]:
    def read(value: str) -> int:
        # int() would also take "+9", "1_0" and other scripts' digits.
        if not (value.isascii() and value.isdigit()) or not least <= int(value) <= most:
            raise ValueError(value)
        return int(value)

    return read


def _one_of(names: tuple[str, ...]) -> OptionParser:
    def read(value: str) -> str:
        if value not in names:
            raise ValueError(value)
        return value

    return read, f"one of {', '.join(names)}"


def _temperature(value: str) -> float:
    # float() would also take "1e3", "1_0" and "inf"; six digits are written again as they were.
    if not re.fullmatch(r"[0-9]{1,4}(\.[0-9]{1,6})?", value):
        raise ValueError(value)
    if not 0 < float(value) <= MAX_TEMPERATURE:
        raise ValueError(value)
    return float(value)


def _text(value: object) -> str:
    """As the option is written in a canonical name: 2 for 2.0."""
    return f"{value:.6f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def _bad_option(detail: str) -> Misconfigured:
    return Misconfigured("bad_extractor_option", detail)
