"""Extractor configurations by name: backbone, preprocessing and aggregator of a global descriptor.

    get_extractor_config("anyloc-vitb14", allow_test_extractors=False)
    get_extractor_config("anyloc-vitb14:clusters=32,facet=key,layer=9", ...)
    get_extractor_config("anyloc-vitg14:preprocessing=paper480x640", ...)
    get_extractor_config("torchhub:/models/mine:my_entry", ...)
    get_extractor_config("gsv:night-walks", ...)
    get_extractor_config("onnx:town:aggregator=vlad,input.size=288x384", ...)

A name may carry options. In the canonical name, options are in alphabetical order and options with
the extractor's default are left out, so that each configuration has one name wherever it is stored
or compared.

Imports no torch: the settings and the gateway validate extractors without loading one.
`shared.descriptors.extractor` builds the extractor of a configuration.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from shared.errors import Misconfigured
from shared.extractor_config.names import (
    EXPORT_PREFIXES,
    MAX_NAME_CHARACTERS,
    TORCHHUB_PREFIX,
    ModelName,
    NetworkInput,
    TorchHubEntry,
    parse_exported_name,
    parse_model_name,
    parse_torchhub_name,
)
from shared.extractor_config.names import TRAINED_MODEL_PREFIX as TRAINED_PREFIX

FACETS = ("query", "key", "value", "token")
EXTRACTOR_AGGREGATORS = ("vlad", "soft-vlad", "gem", "avg")
# The preprocessing of AnyLoc's published results, which these names reproduce.
ANYLOC_PREPROCESSING_NAMES = ("demo1024", "paper480x640", "round14")
# Keeps the aspect ratio; for convolutional backbones, because its sides are not whole patches.
AREA_PREPROCESSING_NAME = "area288x384"
PREPROCESSING_NAMES = ("square224", *ANYLOC_PREPROCESSING_NAMES, AREA_PREPROCESSING_NAME)
MAX_CLUSTERS = 4096
MIN_PHOTOS_TO_FIT = 50  # a vocabulary that was fitted on fewer photos of a map is provisional
# Photos of the map that a vocabulary is fitted on. 1,000 gave no better recall on real photos.
DEFAULT_SAMPLE_PHOTOS = 500
MAX_PCA_DIMENSION = 1024  # dimensions after PCA, whose time and memory grow quadratically
SLOW_TEST_BACKBONE = "test-slow"  # the backbone whose width and time are options
MAX_WIDTH = 131_072
MAX_MILLISECONDS = 60_000
MAX_TEMPERATURE = 1000


@dataclass(frozen=True, slots=True)
class ExtractorConfig:
    """Configuration of one extractor."""

    name: str
    """Canonical name, with the options that differ from the extractor's defaults."""
    backbone: str
    """Name of the network."""
    implementation: str
    """Its `Backbone`, `module:class` of `shared.descriptors.backbones`."""
    width: int | None = None
    """Dimension of a local feature; None where only the loaded network determines it."""
    parameters: int | None = None
    """Number of parameters of the backbone, rounded up, 4 bytes each; None as for `width`."""
    preprocessing: str | None = None
    """A name of `shared.imaging.preprocessing.get_preprocessing`; None as for `width`."""
    aggregator: str = "none"
    """One of EXTRACTOR_AGGREGATORS, or `none` where the backbone computes the global descriptor.

    Hard and soft VLAD need a vocabulary; GeM and average pooling don't.
    """
    depth: int | None = None
    """Number of transformer blocks; None where layer and facet can't be chosen."""
    layer: int | None = None
    """Index of the block whose features are used, from 0."""
    facet: str | None = None
    """Facet of that block: one of FACETS."""
    temperature: float = 1.0
    """Temperature of soft VLAD: factor of the cosines before the softmax."""
    clusters: int = 64
    """Default number of centres of a fit; the number of an existing vocabulary takes precedence."""
    shipped_vocabulary: str | None = None
    """File in `shared/descriptors/vocabularies/`, fitted on photos of other places.

    A new map uses it immediately, whatever `clusters` is for later fits.
    """
    hub: TorchHubEntry | None = None
    """The torch.hub entry that computes the descriptors, for `torchhub:` names."""
    model: ModelName | None = None
    """The model that computes the descriptors, for `gsv:`, `torchscript:` and `onnx:` names."""
    input: NetworkInput | None = None
    """What an exported network expects; None for other extractors."""
    for_tests: bool = False
    milliseconds: int = 0
    """Simulated time per photo (a sleep), of an extractor for tests."""

    @property
    def needs_vocabulary(self) -> bool:
        """Whether the aggregator is VLAD, hard or soft."""
        return self.aggregator in ("vlad", "soft-vlad")

    @property
    def dimension(self) -> int | None:
        """Dimension of the descriptor with a vocabulary of `clusters` centres; None as for `width`.

        A generation has its own, which depends on its vocabulary.
        """
        if self.width is None:
            return None
        return self.width * (self.clusters if self.needs_vocabulary else 1)

    @property
    def added_model(self) -> ModelName | None:
        """The model that has to be added before the extractor can be used."""
        return self.model if self.model is not None and self.model.registered else None

    @property
    def backbone_key(self) -> tuple[object, ...]:
        """Cache key of the backbone: configurations with an equal key can share a loaded one."""
        return (
            self.backbone,
            self.width,
            self.layer,
            self.facet,
            self.milliseconds,
            self.hub,
            self.model,
            self.input and (self.input, self.aggregator == "none"),
        )


def _anyloc_config(
    size: str, *, depth: int, width: int, layer: int, parameters: int
) -> ExtractorConfig:
    """AnyLoc (Keetha et al., RA-L 2023): DINOv2 value features and VLAD.

    The layers are those that the authors recommend for each size of the network.
    """
    return ExtractorConfig(
        name=f"anyloc-{size}",
        backbone=f"dinov2-{size}",
        implementation="dinov2:Dinov2",
        width=width,
        parameters=parameters,
        preprocessing="square224",
        aggregator="vlad",
        depth=depth,
        layer=layer,
        facet="value",
    )


_EFFICIENTNET = ExtractorConfig(
    name="efficientnet-lite0-vlad",
    backbone="efficientnet-lite0",
    implementation="efficientnet_lite0:EfficientNetLite0",
    width=112,
    parameters=5_000_000,
    preprocessing="square224",
    aggregator="vlad",
    shipped_vocabulary="efficientnet-lite0.npy",
)
_TINY = ExtractorConfig(
    name="test-tiny-avg",
    backbone="test-tiny",
    implementation="synthetic:TinyBackbone",
    width=16,
    parameters=1_000,
    preprocessing="square32",
    aggregator="avg",
    for_tests=True,
)
EXTRACTOR_CONFIGS = {
    config.name: config
    for config in (
        _EFFICIENTNET,
        replace(
            _EFFICIENTNET,
            name="efficientnet-lite0-vlad128",
            preprocessing=AREA_PREPROCESSING_NAME,
            clusters=128,
            shipped_vocabulary="efficientnet-lite0-128.npy",
        ),
        _anyloc_config("vits14", depth=12, width=384, layer=10, parameters=22_100_000),
        _anyloc_config("vitb14", depth=12, width=768, layer=10, parameters=86_600_000),
        _anyloc_config("vitl14", depth=24, width=1024, layer=20, parameters=304_400_000),
        _anyloc_config("vitg14", depth=40, width=1536, layer=31, parameters=1_136_500_000),
        ExtractorConfig(
            name="patchnorm",
            backbone="patchnorm",
            implementation="patch_norm:PatchNorm",
            width=64 * 32,
            parameters=0,
            preprocessing="resize32x64",
        ),
        _TINY,
        replace(_TINY, name="test-tiny-vlad", aggregator="vlad", clusters=8),
        ExtractorConfig(
            name="test-slow-avg",
            backbone=SLOW_TEST_BACKBONE,
            implementation="synthetic:SlowBackbone",
            width=7168,
            parameters=1_000,
            preprocessing="square224",  # decoding and resizing do their real work
            aggregator="avg",
            for_tests=True,
        ),
    )
}


def get_extractor_config(name: str, *, allow_test_extractors: bool) -> ExtractorConfig:
    """Parse an extractor name with options into its configuration.

    Whether a torch.hub entry may be loaded is up to `Settings.extractor_config`; whether a trained
    model was added, up to the catalog.

    Returns:
        The configuration; its `name` is the canonical one.

    Raises:
        Misconfigured: `unknown_extractor`; `test_extractor` where extractors for tests are not
            allowed; `bad_extractor_option` with the option, its value and the allowed ones; those
            of `parse_torchhub_name`, `parse_model_name` and `parse_exported_name`.
    """
    if name.startswith(TORCHHUB_PREFIX):
        return _torchhub_config(parse_torchhub_name(name))
    if name.startswith(TRAINED_PREFIX):
        return _trained_config(parse_model_name(name))
    if name.startswith(EXPORT_PREFIXES):
        return _exported_config(name)
    base, colon, options = name.partition(":")
    config = EXTRACTOR_CONFIGS.get(base)
    if config is None:
        known = ", ".join(sorted(c.name for c in EXTRACTOR_CONFIGS.values() if not c.for_tests))
        raise Misconfigured(
            "unknown_extractor",
            f"There is no extractor {base!r}. Available: {known}, "
            f"{TORCHHUB_PREFIX}OWNER/NAME@COMMIT:ENTRY, and for models that were added "
            f"{TRAINED_PREFIX}NAME, {'NAME and '.join(EXPORT_PREFIXES)}NAME.",
        )
    if config.for_tests and not allow_test_extractors:
        raise Misconfigured(
            "test_extractor",
            f"The extractor {base!r} is only for tests and can't recognise places. "
            "Set ALLOW_TEST_EXTRACTORS=true in tests, or choose another one.",
        )
    return _apply_options(config, options) if colon else config


def pooled_config(config: ExtractorConfig) -> ExtractorConfig:
    """Return the configuration of a VLAD extractor with GeM pooling instead.

    It has the same patch features and preprocessing, and needs no vocabulary.
    """
    base = config.model.extractor if config.model else config.name.partition(":")[0]
    options = config.name[len(base) + 1 :].split(",")
    kept = ("facet=", "layer=", "preprocessing=", "input.")
    shared = [option for option in options if option.startswith(kept)]
    return get_extractor_config(
        f"{base}:{','.join([*shared, 'aggregator=gem'])}", allow_test_extractors=config.for_tests
    )


def _torchhub_config(hub: TorchHubEntry) -> ExtractorConfig:
    return ExtractorConfig(
        name=hub.name,
        backbone="torchhub",
        implementation="torchhub:TorchHubBackbone",
        preprocessing=hub.input.preprocessing,
        hub=hub,
    )


def _exported_config(name: str) -> ExtractorConfig:
    model, network_input, options = parse_exported_name(name)
    config = ExtractorConfig(
        name=model.extractor,
        backbone=model.prefix.removesuffix(":"),
        implementation="exported:ExportedBackbone",
        preprocessing=network_input.preprocessing,
        model=model,
        input=network_input,
    )
    if options:
        config = _apply_options(config, options)
    changed = config.name[len(model.extractor) + 1 :].split(",")
    texts = sorted(filter(None, [*changed, *network_input.options]))
    name = ":".join(filter(None, [model.extractor, ",".join(texts)]))
    return replace(config, name=_checked_length(name))


def _checked_length(name: str) -> str:
    if len(name) > MAX_NAME_CHARACTERS:
        raise _bad_option_error(
            f"The name {name} has {len(name)} characters, the maximum is {MAX_NAME_CHARACTERS}."
        )
    return name


def _trained_config(model: ModelName) -> ExtractorConfig:
    return ExtractorConfig(
        name=model.extractor,
        backbone="gsv",
        implementation="trained:TrainedBackbone",
        model=model,
    )


def add_extractor_options(name: str, options: Mapping[str, object]) -> str:
    """Append options to an extractor name, which may have options; None values are left out."""
    texts = [f"{option}={value}" for option, value in options.items() if value is not None]
    if not texts:
        return name
    return name + ("," if ":" in name else ":") + ",".join(texts)


def _apply_options(base: ExtractorConfig, options: str) -> ExtractorConfig:
    """Return `base` with the options of `option=value,option=value`."""
    config = base
    values: dict[str, str] = {}
    for part in options.split(","):
        option, _, value = part.partition("=")
        if option in values:
            raise _bad_option_error(f"The option {option} of {base.name} is given twice.")
        values[option] = value
    # The aggregator first: some options exist for one aggregator only.
    for option in sorted(values, key=lambda option: option != "aggregator"):
        allowed = _allowed_options(base, config)
        if option not in allowed:
            raise _bad_option_error(
                f"The extractor {base.name} has no option {option!r}"
                + (f" with {config.aggregator}" if config.aggregator != base.aggregator else "")
                + (f". Its options: {', '.join(sorted(allowed))}." if allowed else ". It has none.")
            )
        parse, expected = allowed[option]
        try:
            config = replace(config, **{option: parse(values[option])})
        except ValueError:
            raise _bad_option_error(
                f"The option {option}={values[option]} of {base.name} can't be used: "
                f"{option} is {expected}."
            ) from None
    changed = {
        option: f"{option}={_format_value(getattr(config, option))}"
        for option in sorted(values)
        if getattr(config, option) != getattr(base, option)
    }
    if not changed:
        return base
    return replace(
        config,
        name=f"{base.name}:{','.join(changed.values())}",
        shipped_vocabulary=base.shipped_vocabulary if config.needs_vocabulary else None,
    )


OptionParser = tuple[Callable[[str], Any], str]


def _allowed_options(base: ExtractorConfig, config: ExtractorConfig) -> dict[str, OptionParser]:
    """Return parser and description of the options of `base`, with the aggregator of `config`."""
    allowed: dict[str, OptionParser] = {}
    if base.input is not None:
        allowed["aggregator"] = _one_of(("none", *EXTRACTOR_AGGREGATORS))
    if base.needs_vocabulary:
        allowed["aggregator"] = _one_of(EXTRACTOR_AGGREGATORS)
        allowed["preprocessing"] = _one_of(
            tuple(
                name
                for name in PREPROCESSING_NAMES
                if base.depth is None or name != AREA_PREPROCESSING_NAME
            )
        )
    if config.needs_vocabulary:
        allowed["clusters"] = (
            _integer_between(1, MAX_CLUSTERS),
            f"a whole number from 1 to {MAX_CLUSTERS}",
        )
    if config.aggregator == "soft-vlad":
        allowed["temperature"] = (
            _parse_temperature,
            f"a number above 0 and up to {MAX_TEMPERATURE}, such as 0.5",
        )
    if base.depth is not None:
        last = base.depth - 1
        allowed["facet"] = _one_of(FACETS)
        allowed["layer"] = (
            _integer_between(0, last),
            f"a whole number from 0 to {last} ({base.backbone} has {base.depth} blocks)",
        )
    if base.backbone == SLOW_TEST_BACKBONE:
        allowed["milliseconds"] = (
            _integer_between(0, MAX_MILLISECONDS),
            f"a whole number from 0 to {MAX_MILLISECONDS}, for each photo",
        )
        allowed["width"] = (
            _integer_between(16, MAX_WIDTH),
            f"a whole number from 16 to {MAX_WIDTH}",
        )
    return allowed


def _integer_between(minimum: int, maximum: int) -> Callable[[str], int]:
    def parse(value: str) -> int:
        # int() would also accept "+9", "1_0" and the digits of other scripts.
        if not (value.isascii() and value.isdigit()) or not minimum <= int(value) <= maximum:
            raise ValueError(value)
        return int(value)

    return parse


def _one_of(names: tuple[str, ...]) -> OptionParser:
    def parse(value: str) -> str:
        if value not in names:
            raise ValueError(value)
        return value

    return parse, f"one of {', '.join(names)}"


def _parse_temperature(value: str) -> float:
    # float() would also accept "1e3", "1_0" and "inf". Up to six decimals are reproduced exactly.
    if not re.fullmatch(r"[0-9]{1,4}(\.[0-9]{1,6})?", value):
        raise ValueError(value)
    if not 0 < float(value) <= MAX_TEMPERATURE:
        raise ValueError(value)
    return float(value)


def _format_value(value: object) -> str:
    """Format an option's value as in a canonical name: 2 for 2.0."""
    return f"{value:.6f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def _bad_option_error(detail: str) -> Misconfigured:
    return Misconfigured("bad_extractor_option", detail)
