"""Settings of descriptor extraction: the extractor of new maps, device, precision, decoding."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator
from pydantic_settings import BaseSettings

from shared.errors import Misconfigured
from shared.extractor_config.configs import (
    EXTRACTOR_CONFIGS,
    ExtractorConfig,
    add_extractor_options,
    get_extractor_config,
)
from shared.extractor_config.names import TORCHHUB_PREFIX, TORCHSCRIPT_PREFIX, parse_torchhub_name

EXTRACTORS_BY_DINO_MODEL = {
    name.replace("anyloc-", "dinov2_"): name
    for name in EXTRACTOR_CONFIGS
    if name.startswith("anyloc-")
}

MAX_DECODE_PROCESSES = 64


class ExtractorSettings(BaseSettings):
    """Which extractors maps may use, and how an extractor worker runs them."""

    extractor: str = Field(
        "efficientnet-lite0-vlad128",
        description="extractor of new maps, with options: "
        "anyloc-vitb14:layer=9,preprocessing=demo1024",
    )
    descriptor_rows: Literal["float32", "float16"] = Field(
        "float16",
        description="type of the stored descriptors of new maps: float16 takes half the space of "
        "float32, and changes a score by 0.00001 at 7,168 dimensions",
    )
    dino_model: str | None = Field(
        None,
        description="extractor of new maps by its DINOv2 backbone, instead of EXTRACTOR: "
        "dinov2_vits14|vitb14|vitl14|vitg14",
    )
    desc_layer: int | None = Field(
        None,
        description="transformer block of DINO_MODEL, from 0; unset: 10, 10, 20 or 31 by its size",
    )
    desc_facet: str | None = Field(
        None, description="facet of that block: query, key, value or token; unset: value"
    )
    vlad_clusters: int | None = Field(
        None, description="VLAD centres of a vocabulary fitted with DINO_MODEL; unset: 64"
    )
    vlad_desc_dim: int | None = Field(
        None, description="width of DINO_MODEL's features, checked against the model"
    )
    allow_test_extractors: bool = Field(
        False, description="let maps use the tiny extractors that exist for tests"
    )
    code_allowed: str | None = Field(
        None,
        description="code of others that is executed, separated by blanks: exact names of "
        "torch.hub extractors, torchhub:OWNER/NAME@COMMIT:ENTRY, and TorchScript files, "
        "torchscript:SHA256; unset: none but EXTRACTOR, if that is of torch.hub",
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="device of the extractor; auto: CUDA where it is available"
    )
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto",
        description="precision of new generations; auto: bfloat16 for DINOv2 on CUDA, float32 "
        "otherwise",
    )
    dino_weights: Path | None = Field(
        None,
        description="DINOv2's weights: a .pth, .pt or .safetensors file; unset: timm's, downloaded "
        "from the Hugging Face hub",
    )
    batch_photos: int = Field(
        16,
        ge=1,
        le=1024,
        description="maximum photos of an inference batch, unless set 64 on a GPU; batch uploads "
        "wait while 32 times as many are queued",
    )
    decode_processes: int = Field(
        2,
        ge=1,
        le=MAX_DECODE_PROCESSES,
        description="number of decoding processes, unless set a quarter of the processors, at "
        "least 2; with a GPU, all but two of them; with S3, which they wait for, twice as many",
    )

    @field_validator("code_allowed")
    @classmethod
    def _check_allowed_code(cls, value: str | None) -> str | None:
        for name in (value or "").split():
            if re.fullmatch(TORCHSCRIPT_PREFIX + "[0-9a-f]{64}", name):
                continue
            if not name.startswith(TORCHHUB_PREFIX):
                raise ValueError(
                    f"{name!r} is neither a torch.hub extractor, whose name begins with "
                    f"{TORCHHUB_PREFIX}, nor {TORCHSCRIPT_PREFIX} and the SHA-256 of a file"
                )
            try:
                parse_torchhub_name(name)
            except Misconfigured as error:
                raise ValueError(error.detail) from error
        return value

    @field_validator("dino_weights")
    @classmethod
    def _resolve_weights_path(cls, value: Path | None) -> Path | None:
        # Not resolved: a link in a Hugging Face cache has a better name than its target.
        return None if value is None else value.expanduser().absolute()

    @model_validator(mode="after")
    def _check_dino_model(self) -> Self:
        for name in ("desc_layer", "desc_facet", "vlad_clusters", "vlad_desc_dim"):
            value = getattr(self, name)
            if value is not None and self.dino_model is None:
                raise ValueError(
                    f"{name.upper()}={value} configures DINO_MODEL, which is not set. "
                    "Set DINO_MODEL, or use the options of EXTRACTOR instead: "
                    "anyloc-vitb14:layer=9,facet=key,clusters=32"
                )
        return self

    @model_validator(mode="after")
    def _check_one_extractor(self) -> Self:
        try:
            config = get_extractor_config(
                self.extractor, allow_test_extractors=self.allow_test_extractors
            )
            _check_extractor_is_shared(config)
        except Misconfigured as error:
            raise ValueError(f"EXTRACTOR={self.extractor}: {error.detail}") from error
        selected = self.new_map_extractor
        if "extractor" in self.model_fields_set and config.name != selected:
            raise ValueError(
                f"EXTRACTOR={self.extractor} contradicts DINO_MODEL={self.dino_model}, which "
                f"means {selected}. Unset one of them"
            )
        return self

    @property
    def new_map_extractor(self) -> str:
        """The canonical name of the extractor that EXTRACTOR or DINO_MODEL selects."""
        if self.dino_model is None:
            return get_extractor_config(
                self.extractor, allow_test_extractors=self.allow_test_extractors
            ).name
        return self._dino_extractor(self.dino_model)

    def _dino_extractor(self, dino_model: str) -> str:
        """Return the canonical name of what AnyLoc's environment variables describe."""
        base = EXTRACTORS_BY_DINO_MODEL.get(dino_model)
        if base is None:
            raise ValueError(
                f"DINO_MODEL={dino_model} is unknown. Known: {', '.join(EXTRACTORS_BY_DINO_MODEL)}"
            )
        options = {
            "layer": self.desc_layer,
            "facet": self.desc_facet,
            "clusters": self.vlad_clusters,
        }
        for variable, (option, value) in zip(
            ("DESC_LAYER", "DESC_FACET", "VLAD_CLUSTERS"), options.items(), strict=True
        ):
            try:
                name = add_extractor_options(base, {option: value})
                get_extractor_config(name, allow_test_extractors=False)
            except Misconfigured as error:
                raise ValueError(
                    f"{variable}={value} with DINO_MODEL={dino_model}: {error.detail}"
                ) from error
        name = add_extractor_options(base, options)
        config = get_extractor_config(name, allow_test_extractors=False)
        if self.vlad_desc_dim not in (None, config.width):
            raise ValueError(
                f"VLAD_DESC_DIM={self.vlad_desc_dim} contradicts DINO_MODEL={dino_model}, whose "
                f"features have {config.width} dimensions. Unset VLAD_DESC_DIM, or choose another "
                "model"
            )
        return config.name

    def stored_bytes(self, dimension: int) -> int:
        """Return the size in bytes of one stored descriptor of a new map."""
        return dimension * {"float32": 4, "float16": 2}[self.descriptor_rows]

    def extractor_config(self, name: str) -> ExtractorConfig:
        """Return the configuration of an extractor that this installation may load.

        Raises:
            Misconfigured: as `get_extractor_config`; `code_not_allowed` for torch.hub code
                that CODE_ALLOWED does not list; `model_not_added` for a checkpoint file of
                one machine.
        """
        config = get_extractor_config(name, allow_test_extractors=self.allow_test_extractors)
        _check_extractor_is_shared(config)
        if config.hub is not None and config.name not in self.allowed_hub_extractors:
            raise Misconfigured(
                "code_not_allowed",
                f"The extractor {config.name} executes code of {config.hub.source}, which is not "
                "allowed here. To allow it, the operator adds that exact name to CODE_ALLOWED "
                "of the gateway and the extractors, and restarts them.",
            )
        return config

    def check_torchscript_allowed(self, name: str, sha256: str) -> None:
        """Raise Misconfigured (`code_not_allowed`) unless CODE_ALLOWED lists the file's hash."""
        code = f"{TORCHSCRIPT_PREFIX}{sha256}"
        if code not in (self.code_allowed or "").split():
            raise Misconfigured(
                "code_not_allowed",
                f"The TorchScript file of {name} holds code, which is not allowed here. If you "
                f"trust where the file comes from, add {code} to CODE_ALLOWED where it is to run, "
                "restart the extractors, and try again.",
            )

    @property
    def allowed_hub_extractors(self) -> tuple[str, ...]:
        """Canonical names of the torch.hub extractors that may be loaded."""
        allowed = [
            parse_torchhub_name(name).name
            for name in (self.code_allowed or "").split()
            if name.startswith(TORCHHUB_PREFIX)
        ]
        configured = get_extractor_config(self.new_map_extractor, allow_test_extractors=True)
        allowed += [configured.name] if configured.hub else []
        return tuple(dict.fromkeys(allowed))


def _check_extractor_is_shared(config: ExtractorConfig) -> None:
    """Raise Misconfigured (`model_not_added`) for a checkpoint that is a file of one machine."""
    if config.model is not None and config.model.file is not None:
        raise Misconfigured(
            "model_not_added",
            f"{config.model.file} is a file of one machine, but any extractor worker may "
            "describe a map's photos. Add it with `placewise models add "
            f"{config.model.file} --name NAME`, and use {config.model.prefix}NAME.",
        )
