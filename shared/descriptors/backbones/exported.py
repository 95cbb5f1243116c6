"""Backbone of exported networks: TorchScript (PyTorch's `torch.jit`) and ONNX.

The network's first output is a descriptor, (B, D), or a map of patches: (B, D, h, w), (B, h, w, D)
with the layout `nhwc`, or (B, patches, D). The name's options say which, and what it expects
(`NetworkInput`). The fingerprint is the hash of the file, and the bytes that were hashed are those
that are loaded, so that a file that is replaced never continues rows of another one.

A TorchScript file holds code, which runs with the rights of this process: callers have decided that
it may. An ONNX file holds operators and numbers. It may name other files for its numbers, which is
refused, ask for any amount of memory, or loop for ever: it runs in an `OnnxProcess`.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import io
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from shared.descriptors.backbones import NetworkBackbone, find_descriptor_fault, probe_photos
from shared.descriptors.onnx_process import OnnxProcess, UnsuitableInput
from shared.descriptors.weight_files import first_error_line
from shared.errors import Misconfigured, PlacewiseError, Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.extractor_config.names import INPUT_OPTIONS, ONNX_PREFIX, TORCHSCRIPT_PREFIX
from shared.imaging.preprocessing import get_preprocessing

FIXED_BATCHES = (4, 8, 16, 32, 64)
"""Tried with a network that fails with two photos and one"""

Network = Callable[[torch.Tensor], Any]


class ExportedBackbone(NetworkBackbone):
    """Backbone that runs a TorchScript or ONNX file of others."""

    def __init__(
        self,
        config: ExtractorConfig,
        data: bytes,
        device: torch.device,
        *,
        licence: str = "not stated",
        card: dict[str, Any] | None = None,
        is_stopping: Callable[[], bool] = lambda: False,
    ) -> None:
        """Load the content of a file, and check it on two images of noise.

        Args:
            config: Configuration of a `torchscript:` or `onnx:` name.
            data: Content of the file. TorchScript code in it is executed.
            device: Where TorchScript computes; ONNX computes on the CPU.
            licence: Licence of the weights, as its user states it.
            card: Model card: where the file comes from.
            is_stopping: Whether to end a pass of an ONNX file, because this process is to stop.

        Raises:
            Unprocessable: `model_unusable`, with what was expected and what came.
            Misconfigured: `onnx_missing`.
            Unavailable: `extractor_stopping`.
        """
        assert config.model is not None
        assert config.input is not None
        self._config = config
        self.expected = config.input
        self.name = ":".join(
            filter(None, [config.model.extractor, ",".join(self.expected.options)])
        )
        self.fingerprint = hashlib.sha256(data).hexdigest()
        self.layer = "descriptor" if config.aggregator == "none" else "patches"
        self.licence = licence
        self.card = {**(card or {}), "size_bytes": len(data)}
        self.device = device
        try:
            if config.model.prefix == ONNX_PREFIX:
                self.network = _open_onnx(data, is_stopping)
            else:
                self.network = _open_torchscript(data, device)
        except PlacewiseError:
            raise
        except UnsuitableInput as error:
            raise self._unusable_error(str(error)) from error
        except Exception as error:  # what is wrong with a file may be anything
            raise self._unusable_error(
                f"it can't be read ({first_error_line(error)}). Weights of an ONNX file that are "
                "in another file are never read: export it with external_data=False"
            ) from error
        self.width = self._check()

    @classmethod
    def load(
        cls, config: ExtractorConfig, device: torch.device, weights: Path | None
    ) -> ExportedBackbone:
        """Load a file of this machine; raises Misconfigured (`weights_missing`), too."""
        assert config.model is not None
        assert config.model.file is not None, "a registered model is loaded through the catalog"
        path = Path(config.model.file)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise Misconfigured(
                "weights_missing", f"{path} can't be read: {error.strerror}. Check the path."
            ) from error
        return cls(config, data, device, card={"source": path.name})

    def _forward(self, pixels: torch.Tensor) -> Any:
        """Return (B, D), or (B, patches, D) of a map; anything else as it comes."""
        out = super()._forward(pixels)
        if not isinstance(out, torch.Tensor):
            return out
        if self.layer == "patches" and out.ndim == 4:
            is_last = self.expected.layout == "nhwc"
            out = (out if is_last else out.permute(0, 2, 3, 1)).flatten(1, 2)
        return out.to(self.device)

    def _check(self) -> int:
        """Return the width of a feature; raise `model_unusable` if the output can't be used."""
        size = get_preprocessing(self.expected.preprocessing).typical_size
        try:
            both, alone = self.probe(*size)
        except ValueError as error:
            reason = str(error) + self._find_cause(probe_photos(*size))
            raise self._unusable_error(reason) from error
        fault = None
        if self.layer == "patches":
            shape = tuple(getattr(both, "shape", ()))
            if len(shape) == 3 and shape[0] == 2:
                both, alone = both.float().mean(dim=1), alone.float().mean(dim=1)
            else:
                fault = (
                    f"for 2 photos it returns the shape {shape}, and this aggregator needs "
                    "patches: (2, D, h, w), (2, h, w, D) with input.layout=nhwc, or (2, patches, D)"
                )
        fault = fault or find_descriptor_fault(both, alone)
        if fault is None and torch.equal(both[0], both[1]):
            fault = "its descriptors of two different photos are equal"
        if fault is not None:
            raise self._unusable_error(fault)
        return int(both.shape[1])

    @torch.inference_mode()
    def _find_cause(self, photos: torch.Tensor) -> str:
        """Return, as part of a sentence, why the network fails with two photos and one.

        An ONNX file names its batch itself, and each of its passes may take a minute.
        """
        assert self._config.model is not None
        if self._config.model.prefix == ONNX_PREFIX:
            return ""
        graph = getattr(self.network, "inlined_graph", "")
        if device := re.search(r'"(cuda(:\d+)?)"', str(graph)):
            return f". Its code names the device {device[1]}: trace or script it on the CPU"
        for count in FIXED_BATCHES:
            with contextlib.suppress(Exception):  # networks of others may raise anything
                self._forward(photos[:1].expand(count, -1, -1, -1))
                return f". It takes batches of {count} only: export it for any number of photos"
        return ""

    def _unusable_error(self, reason: str) -> Unprocessable:
        return Unprocessable(
            "model_unusable",
            f"The extractor {self._config.name} can't be used: {reason}. Set what its network "
            f"expects with {INPUT_OPTIONS}; for a map of patches, aggregator=vlad.",
        )


def exported_prefix(path: Path, filename: str) -> str | None:
    """Return the prefix of the extractor of a file by its content; None if it is neither kind.

    A file that is called `.onnx` is taken for one: its content has no mark.
    """
    if filename.lower().endswith(".onnx"):
        return ONNX_PREFIX
    try:
        records = torch._C.PyTorchFileReader(str(path)).get_all_records()
    except (RuntimeError, ValueError):  # ValueError: names that are not UTF-8
        return None  # not an archive of PyTorch
    return TORCHSCRIPT_PREFIX if "constants.pkl" in records else None


def _open_torchscript(data: bytes, device: torch.device) -> Network:
    """Load a TorchScript module, which executes its code."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a format that others go on publishing
        module = torch.jit.load(io.BytesIO(data), map_location=device)  # type: ignore[no-untyped-call]
    network: Network = module.eval()
    stored = next((each.dtype for each in module.parameters()), torch.float32)
    if stored == torch.float32 or not stored.is_floating_point:
        return network
    return lambda batch: network(batch.to(stored) if batch.is_floating_point() else batch)


def _open_onnx(data: bytes, is_stopping: Callable[[], bool]) -> Network:
    """Open the file in a process of its own; raises Misconfigured (`onnx_missing`), PassFailed."""
    if importlib.util.find_spec("onnxruntime") is None:
        raise Misconfigured(
            "onnx_missing",
            "ONNX files need the package onnxruntime, which is not installed. Install the extra "
            "`onnx` where the extractor runs: uv pip install '.[onnx]' in the repository.",
        )
    process = OnnxProcess(data, torch.get_num_threads(), is_stopping)
    process.open()
    return lambda batch: torch.from_numpy(process(np.ascontiguousarray(batch.cpu().numpy())))
