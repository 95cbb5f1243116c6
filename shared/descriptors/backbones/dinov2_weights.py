"""DINOv2 weights: where to find them, download, and one naming for Meta's and timm's files.

Two publishers name the same tensors differently:

    Meta (dinov2_vitg14_pretrain.pth)             timm (model.safetensors), the names used here
    blocks.7.mlp.w12, .w3 (SwiGLU)                blocks.7.mlp.fc1, .fc2
    blocks.0.7.norm1 (in chunks, 7 is global)     blocks.7.norm1
    mask_token (of the training)                  -
    register_tokens, cls_token, pos_embed         reg_token, cls_token + pos_embed[:, 0],
                                                  pos_embed[:, 1:]   (networks with registers)

Random weights are never a fallback: missing or unsuitable weights raise a Misconfigured that names
the three ways to get them.
"""

from __future__ import annotations

import re
from pathlib import Path

import httpx2
import torch

from shared.descriptors.weight_files import (
    TENSOR_READ_ERRORS,
    OnProgress,
    Shape,
    TensorFile,
    download_hub_file,
    first_error_line,
    ignore_progress,
    open_tensor_file,
    shape_differences,
)
from shared.errors import Misconfigured

HUB_FILE = "model.safetensors"
META_URL = "https://dl.fbaipublicfiles.com/dinov2/dinov2_{size}/dinov2_{size}_pretrain.pth"
# By the width of the network.
SIZES = {384: "vits14", 768: "vitb14", 1024: "vitl14", 1536: "vitg14"}
TIMM_SIZES = {"vits14": "small", "vitb14": "base", "vitl14": "large", "vitg14": "giant"}


def hub_repository(size: str) -> str:
    """Return timm's repository on the Hugging Face hub for a size such as `vitg14`."""
    return f"timm/vit_{TIMM_SIZES[size]}_patch14_dinov2.lvd142m"


def _weights_help(size: str) -> str:
    """Return the three ways to get the weights; the end of each error message."""
    repository = hub_repository(size)
    cache = f"~/.cache/huggingface/hub/models--{repository.replace('/', '--')}"
    return (
        f"Three ways to get the weights of dinov2-{size}: (1) with internet access and "
        f"DINO_WEIGHTS unset, timm's {repository} is downloaded from huggingface.co on first use, "
        f"or in advance by `placewise models fetch anyloc-{size}`; "
        f"(2) download Meta's {META_URL.format(size=size)} and set DINO_WEIGHTS to that file; "
        f"(3) copy {HUB_FILE} of {repository} from another machine ({cache}) and set "
        "DINO_WEIGHTS to the copy. placewise train takes such a file with --weights."
    )


def find_local_weights(size: str, given: Path | None) -> Path:
    """Return the weights file: `given`, else timm's in the Hugging Face cache of this machine.

    Raises Misconfigured (`weights_missing`).
    """
    import huggingface_hub

    if given is None:
        found = huggingface_hub.try_to_load_from_cache(hub_repository(size), HUB_FILE)
        if isinstance(found, str):
            return Path(found)
        reason = (
            f"DINO_WEIGHTS is not set, and {hub_repository(size)} is not in the Hugging Face "
            "cache of this machine."
        )
    elif given.is_file():
        return given
    else:
        what = "is not a file" if given.exists() else "does not exist"
        reason = f"DINO_WEIGHTS={given} {what}."
    raise _weights_missing_error(reason, size)


def find_or_download_weights(
    size: str, given: Path | None, on_progress: OnProgress = ignore_progress
) -> Path:
    """As `find_local_weights`, but downloads timm's file if it is not cached.

    Raises Misconfigured: `weights_missing`; `download_corrupt` if the file's hash is not the hub's.
    """
    try:
        return find_local_weights(size, given)
    except Misconfigured:
        if given is not None:
            raise
    try:
        return download_hub_file(hub_repository(size), HUB_FILE, on_progress)
    except (OSError, RuntimeError, httpx2.HTTPError) as error:
        raise _weights_missing_error(
            f"DINO_WEIGHTS is not set, and {hub_repository(size)} can't be downloaded: "
            f"{first_error_line(error)}.",
            size,
        ) from error


def open_weights(path: Path, size: str) -> TensorFile:
    """Open a file in either naming, under timm's names; only its index is read.

    Raises Misconfigured (`weights_unusable`) if it is not a file of tensors, or truncated.
    """
    try:
        return _under_timms_names(open_tensor_file(path))
    except TENSOR_READ_ERRORS as error:
        reason = f"it can't be read as a file of tensors: {first_error_line(error)}"
        raise weights_unusable_error(path, reason, size) from error


def weights_unusable_error(path: Path, reason: str, size: str) -> Misconfigured:
    """Return the error for a weights file that can't be used."""
    return Misconfigured(
        "weights_unusable",
        f"The weights {path} can't be used for dinov2-{size}: {reason}. {_weights_help(size)}",
    )


def check_tensor_shapes(
    file: TensorFile, expected: dict[str, Shape], size: str, registers: int
) -> None:
    """Raise Misconfigured (`weights_unusable`) unless every expected tensor has its shape."""
    stored_registers = file.shapes.get("reg_token", (1, 0))[1]
    if stored_registers != registers:
        raise weights_unusable_error(
            file.path,
            f"they are of a network with {stored_registers} register tokens, expected {registers}",
            size,
        )
    differences = shape_differences(file.shapes, expected, may_have_more=True)
    if differences:
        raise weights_unusable_error(file.path, differences + _guess_size(file, size), size)


def _guess_size(file: TensorFile, size: str) -> str:
    """Return a hint if the file looks like the weights of another size."""
    shape = file.shapes.get("cls_token", ())
    guess = SIZES.get(shape[-1]) if shape else None
    return f" (these look like the weights of dinov2-{guess})" if guess not in (None, size) else ""


def _under_timms_names(stored: TensorFile) -> TensorFile:
    names = {_timms_name(name): name for name in stored.shapes}
    shapes = {timm_name: stored.shapes[stored_name] for timm_name, stored_name in names.items()}

    def read(name: str) -> torch.Tensor:
        return stored.read(names[name])

    folded = {"register_tokens", "cls_token", "pos_embed"}
    if not folded <= stored.shapes.keys():
        return TensorFile(stored.path, shapes, read)
    # Meta's, with registers. timm has added the position of the class token to it.
    batch, positions, width = shapes["pos_embed"]
    shapes["pos_embed"] = (batch, positions - 1, width)

    def read_folded(name: str) -> torch.Tensor:
        if name == "pos_embed":
            return read(name)[:, 1:]
        if name == "cls_token":
            return read(name) + read("pos_embed")[:, :1]
        return read(name)

    return TensorFile(stored.path, shapes, read_folded)


def _timms_name(name: str) -> str:
    name = re.sub(r"^blocks\.\d+\.(\d+)\.", r"blocks.\1.", name)
    name = re.sub(r"^(blocks\.\d+\.mlp)\.w12\.", r"\1.fc1.", name)
    name = re.sub(r"^(blocks\.\d+\.mlp)\.w3\.", r"\1.fc2.", name)
    return "reg_token" if name == "register_tokens" else name


def _weights_missing_error(reason: str, size: str) -> Misconfigured:
    return Misconfigured("weights_missing", f"{reason} {_weights_help(size)}")
