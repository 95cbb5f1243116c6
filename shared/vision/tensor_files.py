"""Files of tensors: read without running their code, or inflating more than they have bytes."""

from __future__ import annotations

import pickle
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError

TENSOR_READ_ERRORS = (
    OSError,
    EOFError,
    RuntimeError,
    AssertionError,
    KeyError,
    ValueError,
    TypeError,
    SafetensorError,
    pickle.UnpicklingError,
)
"""What `load_tensors` and safetensors raise for damaged and for other files."""

ZIP = b"PK\x03\x04"  # how a file of PyTorch 1.6 or newer begins


def load_tensors(path: Path) -> Any:
    """What a file of `torch.save` holds: tensors and plain values, on the CPU.

    Tensors are mapped from the file, so copy those that are to outlive a change of it. Nothing is
    executed. Of an archive, no entry is read before the sizes that all of them declare were
    compared with the file's: PyTorch does not compress them, so they are never larger.

    Raises:
        One of UNREADABLE.
    """
    with path.open("rb") as file:
        is_archive = file.read(len(ZIP)) == ZIP
    if is_archive:
        _check_entries(path)
    # Files of older releases hold storages one after the other, uncompressed, and can't be mapped.
    return torch.load(path, map_location="cpu", weights_only=True, mmap=is_archive)


def check_promise(tensors: Iterable[torch.Tensor], path: Path) -> None:
    """ValueError when the tensors have more bytes than their file.

    Tensors of any shape can be made of a few bytes: repeated views, sparse and empty ones.
    """
    promised, size = sum(one.numel() * one.element_size() for one in tensors), path.stat().st_size
    if promised > size:
        raise ValueError(
            f"its tensors have {promised} bytes by their shapes, and the file has {size}"
        )


def _check_entries(path: Path) -> None:
    # PyTorch's own reader: what another one finds in a hostile archive may be other entries.
    archive = torch._C.PyTorchFileReader(str(path))
    declared = sum(archive.get_record_size(name) for name in archive.get_all_records())
    size = path.stat().st_size
    if declared > size:
        raise ValueError(
            f"its entries declare {declared} bytes, and the file has {size}: they are compressed "
            "or overlap. torch.save writes neither; save the file again with it"
        )


def first_error_line(error: BaseException) -> str:
    """What an error says, in one line; its name where it says nothing."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
