"""What the code calls of PyTorch exists in 2.11, the oldest release that `pyproject.toml` allows.

`torch_2_11_names.txt` lists the names that were found there; add one only after looking it up in
that release. Methods of its private archive reader have no names in the code, so the reader is
replaced by one that has those of 2.11 alone.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from shared.descriptors.backbones.exported import exported_prefix
from shared.descriptors.weight_files import _check_entries

ROOT = Path(__file__).parents[3]
NAMES = Path(__file__).with_name("torch_2_11_names.txt")
READER_METHODS = {
    *("get_all_records", "get_record", "get_record_header_offset", "get_record_offset"),
    *("get_record_offset_no_read", "get_storage_from_record", "has_record", "serialization_id"),
}


def dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def used_names(tree: ast.Module) -> Iterator[str]:
    """Yield what a module imports from torch, and what it takes from that, by full names."""
    imported = {"torch": "torch"}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "torch":
            imported |= {each.name: f"{node.module}.{each.name}" for each in node.names}
    yield from imported.values()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            first, _, rest = dotted(node).partition(".")
            if first in ("torch", "nn") and first in imported:
                yield f"{imported[first]}.{rest}"


def test_every_name_of_torch_in_the_code_is_one_of_its_oldest_release() -> None:
    known = set(NAMES.read_text().split())
    files = [path for part in ("services", "shared", "lab") for path in (ROOT / part).rglob("*.py")]
    used = {name for path in files for name in used_names(ast.parse(path.read_text()))}
    assert "torch.load" in used
    assert sorted(used - known) == []


Reader = torch._C.PyTorchFileReader


class OldReader:
    def __init__(self, path: str) -> None:
        self._reader = Reader(path)

    def __getattr__(self, name: str) -> Any:
        if name not in READER_METHODS:
            raise AttributeError(name)
        return getattr(self._reader, name)


def test_files_are_read_with_the_archive_reader_of_the_oldest_release(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "weights.pt"
    torch.save({"a": torch.ones(3)}, path)
    monkeypatch.setattr("torch._C.PyTorchFileReader", OldReader)
    _check_entries(path)
    assert exported_prefix(path, "weights.pt") is None
