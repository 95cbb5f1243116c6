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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import torch
from safetensors import safe_open

from shared.descriptors.weight_files import (
    TENSOR_READ_ERRORS,
    OnProgress,
    download_hub_file,
    first_error_line,
    load_tensors,
)
from shared.errors import Misconfigured

HUB_FILE = "model.safetensors"
META_URL = "https://dl.fbaipublicfiles.com/dinov2/dinov2_{size}/dinov2_{size}_pretrain.pth"
# By the width of the network.
SIZES = {384: "vits14", 768: "vitb14", 1024: "vitl14", 1536: "vitg14"}
TIMM_SIZES = {"vits14": "small", "vitb14": "base", "vitl14": "large", "vitg14": "giant"}
MAX_NAMES_IN_ERROR = 3  # tensors that an error lists before it gives the number of the others

Shape = tuple[int, ...]


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


@dataclass(frozen=True, slots=True)
class DinoWeightsFile:
    """The tensors of a weights file by timm's names; each is read on demand."""

    path: Path
    shapes: dict[str, Shape]
    read: Callable[[str], torch.Tensor]
    """Returns the tensor of a name, on the CPU, with its stored dtype."""

    @property
    def registers(self) -> int:
        """Number of register tokens of the network."""
        return self.shapes.get("reg_token", (1, 0))[1]


def find_or_download_weights(
    size: str, given: Path | None, on_progress: OnProgress = lambda _done, _total: None
) -> Path:
    """Return the weights file: `given`, else timm's from the hub, downloaded if not cached.

    Raises Misconfigured: `weights_missing`; `download_corrupt` if the file's hash is not the hub's.
    """
    if given is not None:
        if not given.is_file():
            what = "is not a file" if given.exists() else "does not exist"
            raise _weights_missing_error(f"DINO_WEIGHTS={given} {what}.", size)
        return given
    return _cached_weights(size) or _download(size, on_progress)


def find_local_weights(size: str, given: Path | None) -> Path:
    """As `find_or_download_weights`, without downloading: raises `weights_missing` instead."""
    if given is None:
        cached = _cached_weights(size)
        if cached is None:
            raise _weights_missing_error(
                f"DINO_WEIGHTS is not set, and {hub_repository(size)} is not in the Hugging Face "
                "cache of this machine.",
                size,
            )
        return cached
    return find_or_download_weights(size, given)


def _cached_weights(size: str) -> Path | None:
    """Return timm's file in the local Hugging Face cache, or None; uses no network."""
    import huggingface_hub

    found = huggingface_hub.try_to_load_from_cache(hub_repository(size), HUB_FILE)
    return Path(found) if isinstance(found, str) else None


def _download(size: str, on_progress: OnProgress) -> Path:
    try:
        return download_hub_file(hub_repository(size), HUB_FILE, on_progress)
    except (OSError, RuntimeError, httpx2.HTTPError) as error:
        raise _weights_missing_error(
            f"DINO_WEIGHTS is not set, and {hub_repository(size)} can't be downloaded: "
            f"{first_error_line(error)}",
            size,
        ) from error


def open_weights(path: Path, size: str) -> DinoWeightsFile:
    """Open a `.safetensors` or PyTorch file in either naming; only its index is read.

    Raises Misconfigured (`weights_unusable`) if it is neither, or truncated.
    """
    try:
        with path.open("rb") as file:
            begin = file.read(9)
        # Detected by content: blobs in a Hugging Face cache have no suffix.
        stored = _open_safetensors(path) if begin[8:] == b"{" else _open_torch(path)
        return _under_timms_names(stored)
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
    file: DinoWeightsFile, expected: dict[str, Shape], size: str, registers: int
) -> None:
    """Raise Misconfigured (`weights_unusable`) unless every expected tensor has its shape."""
    if file.registers != registers:
        raise weights_unusable_error(
            file.path,
            f"they are of a network with {file.registers} register tokens, expected {registers}",
            size,
        )
    differing = [
        f"{name} is {file.shapes[name]}, expected {shape}"
        for name, shape in expected.items()
        if name in file.shapes and file.shapes[name] != shape
    ]
    missing = [f"{name} {shape}" for name, shape in expected.items() if name not in file.shapes]
    faults = []
    if missing:
        faults.append("it has no tensor " + _join_some(missing))
    if differing:
        faults.append(_join_some(differing))
    if faults:
        raise weights_unusable_error(file.path, "; ".join(faults) + _guess_size(file, size), size)


def _guess_size(file: DinoWeightsFile, size: str) -> str:
    """Return a hint if the file looks like the weights of another size."""
    shape = file.shapes.get("cls_token", ())
    guess = SIZES.get(shape[-1]) if shape else None
    return f" (these look like the weights of dinov2-{guess})" if guess not in (None, size) else ""


def _open_safetensors(path: Path) -> DinoWeightsFile:
    stored: Any = safe_open(path, framework="pt", device="cpu")  # untyped methods
    names: list[str] = stored.keys()
    shapes = {name: tuple(stored.get_slice(name).get_shape()) for name in names}
    return DinoWeightsFile(path, shapes, stored.get_tensor)


def _open_torch(path: Path) -> DinoWeightsFile:
    """Memory-mapped, so that tensors are read on demand; weights only, no code."""
    state = load_tensors(path)
    if not isinstance(state, dict):
        raise ValueError(f"it holds a {type(state).__name__}, not named tensors")
    tensors = {str(n): t for n, t in state.items() if isinstance(t, torch.Tensor)}
    if not tensors:
        raise ValueError(f"it holds no tensors, only {_join_some([str(name) for name in state])}")
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    return DinoWeightsFile(path, shapes, tensors.__getitem__)


def _under_timms_names(stored: DinoWeightsFile) -> DinoWeightsFile:
    names = {_timms_name(name): name for name in stored.shapes}
    shapes = {timm_name: stored.shapes[stored_name] for timm_name, stored_name in names.items()}

    def read(name: str) -> torch.Tensor:
        return stored.read(names[name])

    folded = {"register_tokens", "cls_token", "pos_embed"}
    if not folded <= stored.shapes.keys():
        return DinoWeightsFile(stored.path, shapes, read)
    # Meta's, with registers. timm has added the position of the class token to it.
    batch, positions, width = shapes["pos_embed"]
    shapes["pos_embed"] = (batch, positions - 1, width)

    def read_folded(name: str) -> torch.Tensor:
        if name == "pos_embed":
            return read(name)[:, 1:]
        if name == "cls_token":
            return read(name) + read("pos_embed")[:, :1]
        return read(name)

    return DinoWeightsFile(stored.path, shapes, read_folded)


def _timms_name(name: str) -> str:
    name = re.sub(r"^blocks\.\d+\.(\d+)\.", r"blocks.\1.", name)
    name = re.sub(r"^(blocks\.\d+\.mlp)\.w12\.", r"\1.fc1.", name)
    name = re.sub(r"^(blocks\.\d+\.mlp)\.w3\.", r"\1.fc2.", name)
    return "reg_token" if name == "register_tokens" else name


def _weights_missing_error(reason: str, size: str) -> Misconfigured:
    return Misconfigured("weights_missing", f"{reason} {_weights_help(size)}")


def _join_some(faults: list[str]) -> str:
    more = len(faults) - MAX_NAMES_IN_ERROR
    return ", ".join(faults[:MAX_NAMES_IN_ERROR]) + (f" and {more} more" if more > 0 else "")
