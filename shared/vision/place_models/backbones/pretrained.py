"""torchvision's networks with their published ImageNet weights, from the cache or a given file.

Random weights are never a fallback: what can't be had is a Misconfigured that names the ways.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx2
import torch

from shared.errors import Misconfigured
from shared.vision.download import download_file
from shared.vision.tensor_files import TENSOR_READ_ERRORS, first_error_line, load_tensors


def load_torchvision_network(name: str, pretrained: bool, weights: Path | None) -> Any:
    """The network `torchvision.models.NAME`; without `pretrained` its tensors are random.

    `weights`: a `.pth` or `.safetensors` in torchvision's naming instead of its own IMAGENET1K_V1,
    which is looked for in torch.hub's cache and else downloaded. Raises Misconfigured:
    `weights_missing`, `weights_unfit`, `download_corrupt`.
    """
    from torchvision import models  # takes seconds, which not every command need pay

    network = models.get_model(name, weights=None)
    if pretrained:
        url = models.get_model_weights(name)["IMAGENET1K_V1"].url
        path = find_or_download_torchvision_weights(name, url, weights)
        load_state(network, read_tensors(path, name), path, name)
    return network


def find_or_download_torchvision_weights(name: str, url: str, given: Path | None) -> Path:
    """The file of the weights, downloaded to torch.hub's cache if need be."""
    if given is not None:
        return check_weights_file(given, name)
    filename = url.rpartition("/")[2]
    cached = Path(torch.hub.get_dir(), "checkpoints", filename)
    if not cached.exists():
        # By torchvision's custom the name ends with the beginning of the hash.
        sha256 = cached.stem.rpartition("-")[2]
        try:
            download_file(url, cached, sha256=sha256)
        except (OSError, httpx2.HTTPError) as error:
            reason = f"{url} can't be downloaded: {first_error_line(error)}."
            raise _pretrained_missing_error(name, url, reason) from error
    return cached


def check_weights_file(path: Path, name: str) -> Path:
    """`path`, if it is a file; else Misconfigured (`weights_missing`)."""
    if not path.is_file():
        what = "is not a file" if path.exists() else "does not exist"
        raise Misconfigured(
            "weights_missing",
            f"{path} {what}: it was named as the file of the pretrained weights of {name}.",
        )
    return path


def read_tensors(path: Path, name: str) -> dict[str, torch.Tensor]:
    """The tensors of a `.safetensors` or PyTorch file, by name; weights only, no code is run.

    Misconfigured (`weights_unfit`) for what is no such file.
    """
    from safetensors.torch import load_file

    try:
        with path.open("rb") as file:
            begin = file.read(9)
        if begin[8:] == b"{":
            return load_file(path)
        state = load_tensors(path)
    except TENSOR_READ_ERRORS as error:
        reason = f"it can't be read as a file of tensors: {first_error_line(error)}"
        raise pretrained_unfit_error(path, name, reason) from error
    if not isinstance(state, dict) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise pretrained_unfit_error(path, name, "it holds something else than named tensors")
    return state


def load_state(network: Any, state: dict[str, torch.Tensor], path: Path, name: str) -> None:
    """Give the network its tensors; Misconfigured (`weights_unfit`) where they don't fit."""
    own: dict[str, torch.Tensor] = network.state_dict()
    # Files of old releases count no batches, and nothing depends on that count.
    state = {n: t for n, t in own.items() if n.endswith("num_batches_tracked")} | state
    faults = [f"no tensor {n}" for n in own if n not in state]
    faults += [f"a tensor {n} too many" for n in state if n not in own]
    faults += [
        f"{n} of {tuple(t.shape)}, not {tuple(own[n].shape)}"
        for n, t in state.items()
        if n in own and own[n].shape != t.shape
    ]
    if faults:
        more = f" and {len(faults) - 1} faults more" if len(faults) > 1 else ""
        raise pretrained_unfit_error(path, name, f"it has {faults[0]}{more}")
    network.load_state_dict(state)


def pretrained_unfit_error(path: Path, name: str, reason: str) -> Misconfigured:
    return Misconfigured("weights_unfit", f"The weights {path} can't be used for {name}: {reason}.")


def _pretrained_missing_error(name: str, url: str, reason: str) -> Misconfigured:
    folder = Path(torch.hub.get_dir(), "checkpoints")
    return Misconfigured(
        "weights_missing",
        f"{reason} Ways to get the pretrained weights of {name}: (1) with internet access they are "
        f"downloaded on first use; (2) bring {url} from another machine into {folder}; (3) name a "
        "file of them; (4) pretrained=False begins with random weights, which takes far more "
        "photos and epochs.",
    )
