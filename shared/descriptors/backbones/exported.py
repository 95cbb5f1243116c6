"""Backbone of exported networks: TorchScript (PyTorch's `torch.jit`) and ONNX.

The network's first output is a descriptor, (B, D), or a map of patches: (B, D, h, w), (B, h, w, D)
with the layout `nhwc`, or (B, patches, D). The name's options say which, and what it expects
(`NetworkInput`). The fingerprint is the hash of the file, and the bytes that were hashed are those
that are loaded, so that a file that is replaced never continues rows of another one.

A TorchScript file holds code, which runs with the rights of this process: callers have decided that
it may. An ONNX file holds operators and numbers. It may name other files for its numbers, or ask
for any amount of memory: both are refused.
"""

from __future__ import annotations

import functools
import hashlib
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from shared.descriptors.backbones import (
    Backbone,
    find_descriptor_fault,
    normalise_features,
    probe_photos,
    to_network_input,
)
from shared.descriptors.weight_files import first_error_line
from shared.errors import Misconfigured, Unprocessable
from shared.extractor_config.configs import ExtractorConfig
from shared.extractor_config.names import INPUT_OPTIONS, ONNX_PREFIX, TORCHSCRIPT_PREFIX
from shared.imaging.preprocessing import get_preprocessing

ONNX_MEMORY_BYTES = 4_000_000_000  # of all ONNX networks of a process, with their weights

Network = Callable[[torch.Tensor], Any]
"""Computes the outputs for a batch in the network's own layout and dtype."""


class ExportedBackbone(Backbone):
    """Backbone that runs a TorchScript or ONNX file of others."""

    def __init__(
        self,
        config: ExtractorConfig,
        data: bytes,
        device: torch.device,
        *,
        licence: str = "not stated",
        card: dict[str, Any] | None = None,
    ) -> None:
        """Load the content of a file, and check it on two images of noise.

        Args:
            config: Configuration of a `torchscript:` or `onnx:` name.
            data: Content of the file. TorchScript code in it is executed.
            device: Where TorchScript computes; ONNX computes on the CPU.
            licence: Licence of the weights, as its user states it.
            card: Model card: where the file comes from.

        Raises:
            Unprocessable: `model_unusable`, with what was expected and what came.
            Misconfigured: `onnx_missing`.
        """
        assert config.model is not None
        assert config.input is not None
        self._config = config
        self._input = config.input
        self.name = ":".join(filter(None, [config.model.extractor, ",".join(self._input.options)]))
        self.fingerprint = hashlib.sha256(data).hexdigest()
        self.layer = "descriptor" if config.aggregator == "none" else "patches"
        self.licence = licence
        self.card = {**(card or {}), "size_bytes": len(data)}
        self.device = device
        try:
            if config.model.prefix == ONNX_PREFIX:
                self._network = _open_onnx(data)
            else:
                self._network = _open_torchscript(data, device)
        except Misconfigured:
            raise
        except Exception as error:  # ONNX Runtime's own types have no other base
            raise self._unusable_error(f"it can't be read ({first_error_line(error)})") from error
        self.width = self._probe()

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

    @torch.inference_mode()
    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        features = normalise_features(self._forward(pixels))
        return features.unsqueeze(1) if features.ndim == 2 else features

    def _forward(self, pixels: torch.Tensor) -> Any:
        """Return (B, D), or (B, patches, D) of a map; anything else as it comes."""
        out = self._network(to_network_input(pixels.to(self.device), self._input))
        out = out[0] if isinstance(out, tuple | list) and out else out
        if not isinstance(out, torch.Tensor) or self.layer == "descriptor":
            return out
        if out.ndim == 4:
            out = out if self._input.layout == "nhwc" else out.permute(0, 2, 3, 1)
            out = out.flatten(1, 2)
        return out.to(self.device)

    @torch.inference_mode()
    def _probe(self) -> int:
        """Return the width of a feature; raise `model_unusable` if the output can't be used."""
        height, width = get_preprocessing(self._input.preprocessing).typical_size
        photos = probe_photos(height, width)
        try:
            both, alone = self._forward(photos), self._forward(photos[:1])
        except Exception as error:  # a network of others may raise anything
            raise self._unusable_error(
                f"with 2 photos of {height} x {width} pixels it fails with "
                f"{type(error).__name__}: {first_error_line(error)}"
            ) from error
        fault = None
        if self.layer == "patches":
            if not isinstance(both, torch.Tensor) or both.ndim != 3 or len(both) != 2:
                came = tuple(both.shape) if isinstance(both, torch.Tensor) else type(both).__name__
                fault = (
                    f"for 2 photos it returns {came}; aggregator={self._config.aggregator} needs "
                    "patches: (2, D, h, w), (2, h, w, D) with input.layout=nhwc, or (2, patches, D)"
                )
            else:
                both, alone = both.float().mean(dim=1), alone.float().mean(dim=1)
        fault = fault or find_descriptor_fault(both, alone)
        if fault is None and torch.equal(both[0], both[1]):
            fault = "its descriptors of two different photos are equal"
        if fault is not None:
            raise self._unusable_error(fault)
        return int(both.shape[1])

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
    except RuntimeError:
        return None  # not an archive of PyTorch
    return TORCHSCRIPT_PREFIX if "constants.pkl" in records else None


def _open_torchscript(data: bytes, device: torch.device) -> Network:
    """Load a TorchScript module, which executes its code."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of a format that others go on publishing
        module = torch.jit.load(io.BytesIO(data), map_location=device)  # type: ignore[no-untyped-call]
    network: Network = module.eval()
    return network


def _open_onnx(data: bytes) -> Network:
    """Open a session; raises Misconfigured (`onnx_missing`), RuntimeError and ValueError."""
    try:
        import onnxruntime
    except ImportError:
        raise Misconfigured(
            "onnx_missing",
            "ONNX files need the package onnxruntime, which is not installed. Install the extra "
            "`onnx` where the extractor runs: uv pip install '.[onnx]' in the repository.",
        ) from None
    if _names_other_files(memoryview(data)):
        raise ValueError(
            "its weights are in another file. Save it as one file: "
            "torch.onnx.export(..., external_data=False), or onnx.save(onnx.load(FILE), OUT)"
        )
    _limit_onnx_memory()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 4  # errors are raised, too
    options.add_session_config_entry("session.use_env_allocators", "1")
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    inputs = session.get_inputs()
    if len(inputs) != 1:
        raise ValueError(f"it has {len(inputs)} inputs, expected photos only")
    output = session.get_outputs()[0].name
    one_by_one = inputs[0].shape[:1] == [1]  # as many exports are

    def run(batch: torch.Tensor) -> torch.Tensor:
        array = np.ascontiguousarray(batch.cpu().numpy())
        parts = np.split(array, len(array)) if one_by_one else [array]
        rows = [session.run([output], {inputs[0].name: part})[0] for part in parts]
        return torch.from_numpy(np.concatenate(rows))

    return run


@functools.cache
def _limit_onnx_memory() -> None:
    """Limit what the sessions of this process can allocate; a session that needs more fails."""
    import onnxruntime

    memory = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    limits = onnxruntime.OrtArenaCfg({"max_mem": ONNX_MEMORY_BYTES, "arena_extend_strategy": 1})
    onnxruntime.create_and_register_allocator(memory, limits)


# Numbers of the fields of onnx.proto3 that hold messages with tensors, by message. ONNX Runtime
# follows the names of files in them, relative to the working directory, and the package `onnx`,
# which could read them, would be needed for nothing else.
ONNX_MESSAGES = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
    "tensor": {13: "external"},
}
FIXED_BYTES = {1: 8, 5: 4}  # by wire type


def _names_other_files(data: memoryview, message: str = "model", depth: int = 0) -> bool:
    """Whether an ONNX message has tensors in other files; raises ValueError if it is damaged."""
    position = 0
    while position < len(data):
        tag, position = _read_varint(data, position)
        field, wire_type = tag >> 3, tag & 7
        if wire_type == 0:
            _, position = _read_varint(data, position)
            continue
        size = FIXED_BYTES.get(wire_type)
        if wire_type == 2:
            size, position = _read_varint(data, position)
        if size is None or position + size > len(data) or depth > 100:
            raise ValueError("it is not an ONNX file, or damaged")
        inner = ONNX_MESSAGES[message].get(field) if wire_type == 2 else None
        if inner == "external" or (
            inner and _names_other_files(data[position : position + size], inner, depth + 1)
        ):
            return True
        position += size
    return False


def _read_varint(data: memoryview, position: int) -> tuple[int, int]:
    """Return a number of 7 bits a byte, and the position after it."""
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(data):
            break
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise ValueError("it is not an ONNX file, or damaged")
