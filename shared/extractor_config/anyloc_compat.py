"""AnyLoc's environment variables as an extractor name.

    DINO_MODEL=dinov2_vitg14 DESC_LAYER=31 DESC_FACET=value VLAD_CLUSTERS=32 VLAD_DESC_DIM=1536

means the extractor `anyloc-vitg14:clusters=32`. Contradicting values are rejected.
"""

from __future__ import annotations

from shared.errors import Misconfigured
from shared.extractor_config.configs import EXTRACTOR_CONFIGS, get_extractor_config

EXTRACTORS_BY_DINO_MODEL = {
    name.replace("anyloc-", "dinov2_"): name
    for name in EXTRACTOR_CONFIGS
    if name.startswith("anyloc-")
}


def extractor_from_dino_settings(
    dino_model: str,
    *,
    desc_layer: int | None,
    desc_facet: str | None,
    vlad_clusters: int | None,
    vlad_desc_dim: int | None,
) -> str:
    """Return the canonical name of the extractor that the variables describe.

    None selects the model's default.

    Raises:
        ValueError: with the variable, its value and the allowed ones.
    """
    base = EXTRACTORS_BY_DINO_MODEL.get(dino_model)
    if base is None:
        raise ValueError(
            f"DINO_MODEL={dino_model} is unknown. Known: {', '.join(EXTRACTORS_BY_DINO_MODEL)}"
        )
    options = []
    for variable, option, value in (
        ("DESC_LAYER", "layer", desc_layer),
        ("DESC_FACET", "facet", desc_facet),
        ("VLAD_CLUSTERS", "clusters", vlad_clusters),
    ):
        if value is not None:
            option_text = f"{option}={value}"
            try:
                get_extractor_config(f"{base}:{option_text}", allow_test_extractors=False)
            except Misconfigured as error:
                raise ValueError(
                    f"{variable}={value} with DINO_MODEL={dino_model}: {error.detail}"
                ) from error
            options.append(option_text)
    name = f"{base}:{','.join(options)}" if options else base
    config = get_extractor_config(name, allow_test_extractors=False)
    if vlad_desc_dim not in (None, config.width):
        raise ValueError(
            f"VLAD_DESC_DIM={vlad_desc_dim} contradicts DINO_MODEL={dino_model}, whose features "
            f"have {config.width} dimensions. Unset VLAD_DESC_DIM, or choose another model"
        )
    return config.name
