"""The file of an added model: everything that describes a photo, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save

from shared.descriptors.vpr_models.checkpoint import (
    METADATA_KEY,
    Checkpoint,
    encode_model_file,
    load_checkpoint,
    read_model_file,
)
from shared.errors import Unavailable
from tests.support.checkpoints import SIDES, write_checkpoint


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Checkpoint:
    return load_checkpoint(write_checkpoint(tmp_path_factory.mktemp("run") / "best.ckpt"))


def test_model_file_describes_as_the_checkpoint_and_names_its_network(
    checkpoint: Checkpoint, tmp_path: Path
) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(encode_model_file(checkpoint))
    assert encode_model_file(checkpoint) == path.read_bytes()
    model = read_model_file(path)
    assert model.config == checkpoint.config
    assert not model.training
    assert not any(parameter.requires_grad for parameter in model.parameters())
    photos = torch.rand(2, 3, *SIDES, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        assert torch.equal(model(photos), checkpoint.model(photos))
    with safe_open(path, framework="pt") as file:
        assert set(file.keys()) == checkpoint.model.state_dict().keys()
        about = json.loads(file.metadata()[METADATA_KEY])
    assert (about["format"], about["fingerprint"]) == (1, checkpoint.fingerprint)
    assert about["config"]["image_size"] == list(SIDES)


def test_a_file_that_this_release_does_not_understand_is_refused(
    checkpoint: Checkpoint, tmp_path: Path
) -> None:
    path = tmp_path / "model.safetensors"
    tensors = {name: t.clone() for name, t in checkpoint.model.state_dict().items()}
    config = checkpoint.config.model_dump(mode="json")
    fields = {"format": 1, "config": config, "fingerprint": checkpoint.fingerprint}
    for metadata, weights in (
        ({}, tensors),
        ({METADATA_KEY: json.dumps({**fields, "format": 2})}, tensors),
        ({METADATA_KEY: json.dumps({**fields, "config": {**config, "agg_arch": "New"}})}, tensors),
        ({METADATA_KEY: json.dumps(fields)}, {"one": torch.zeros(1)}),
    ):
        path.write_bytes(save(weights, metadata))
        with pytest.raises(Unavailable) as caught:
            read_model_file(path)
        assert caught.value.code == "model_unreadable"
    path.write_bytes(b"not at all")
    with pytest.raises(Unavailable):
        read_model_file(path)
