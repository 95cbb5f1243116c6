"""Passes through a network: what happens when the GPU's memory does not suffice for one."""

from __future__ import annotations

import gc
import threading
import time
import weakref
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from services.extractor import model_registry
from services.extractor.model_registry import ModelRegistry
from shared.config.settings import Settings
from shared.descriptors.backbones import Backbone
from shared.descriptors.backbones.synthetic import TinyBackbone
from shared.descriptors.extractor import Extractor
from shared.descriptors.inference import BatchSizeLimit, PhotoTooLargeForGpu, run_in_batches
from shared.errors import Misconfigured
from shared.extractor_config.configs import get_extractor_config
from shared.storage import FolderStore
from tests.support.checkpoints import none_added

pytestmark = pytest.mark.numerics

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
SIDE = 224  # pixels: as large as what passes are counted by


class SmallGpu(TinyBackbone):
    """Has memory for so many pixels at once, as a GPU has."""

    def __init__(self, most_pixels: int) -> None:
        super().__init__(CPU)
        self.most_pixels = most_pixels
        self.passes: list[int] = []

    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        self.passes.append(len(pixels))
        if pixels.shape[0] * pixels.shape[1] * pixels.shape[2] > self.most_pixels:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return super().features(pixels)


def on(backbone: SmallGpu, limit: BatchSizeLimit | None = None) -> Extractor:
    config = get_extractor_config(
        "test-tiny-vlad:aggregator=avg,preprocessing=square224", allow_test_extractors=True
    )
    return Extractor(config, CPU, backbone=backbone, limit=limit or BatchSizeLimit(CUDA))


def photos(count: int, side: int = SIDE) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(side)
    return list(rng.integers(0, 256, (count, side, side, 3), dtype=np.uint8))


def test_pass_that_does_not_fit_is_halved_and_that_is_remembered() -> None:
    backbone = SmallGpu(3 * SIDE * SIDE)
    made, many = on(backbone), photos(10)
    rows = made.describe(many, None)
    assert backbone.passes == [10, 5, 2, 2, 2, 2, 2]
    np.testing.assert_allclose(
        rows, on(SmallGpu(10**9)).describe(many, None), atol=1e-6, err_msg="rows lost their places"
    )
    backbone.passes.clear()
    made.describe(many, None)
    made.with_precision("bfloat16").describe(many[:3], None)
    assert backbone.passes == [2] * 5 + [2, 1]


def test_larger_photos_go_through_in_fewer_once_memory_ran_out() -> None:
    backbone = SmallGpu(5 * SIDE * SIDE)
    made = on(backbone)
    made.describe(photos(8), None)
    backbone.passes.clear()
    made.describe([*photos(4), *photos(3, 2 * SIDE)], None)
    assert backbone.passes == [4, 1, 1, 1]


def test_photo_that_does_not_fit_alone_is_an_error_that_names_it() -> None:
    backbone = SmallGpu(SIDE * SIDE)
    mixed = [*photos(2), *photos(1, 2 * SIDE), *photos(1)]
    with pytest.raises(PhotoTooLargeForGpu, match="448 x 448 pixels") as described:
        on(backbone).describe(mixed, None)
    with pytest.raises(PhotoTooLargeForGpu, match="448 x 448 pixels") as sampled:
        on(backbone).patch_features(mixed)
    for caught in (described.value, sampled.value):
        assert (caught.code, caught.place) == ("gpu_out_of_memory", 2)
        assert caught.as_problem()["status"] == 422


def test_warming_up_is_a_pass_of_the_largest_size_and_finds_what_fits() -> None:
    backbone = SmallGpu(5 * SIDE * SIDE)
    made = on(backbone)
    made.warm_up(16)
    assert backbone.passes == [16, 8, 4, 4, 4, 4]
    backbone.passes.clear()
    made.describe(photos(16), None)
    assert backbone.passes == [4] * 4


def test_model_that_leaves_no_room_for_one_photo_is_refused_when_it_is_loaded() -> None:
    with pytest.raises(Misconfigured, match="does not hold the weights") as caught:
        on(SmallGpu(0)).warm_up(16)
    assert caught.value.code == "gpu_out_of_memory"


def test_weights_that_do_not_fit_are_refused_by_the_same_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def load(*_: object) -> Backbone:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB.")

    monkeypatch.setattr(TinyBackbone, "load", load)
    config = get_extractor_config("test-tiny-vlad", allow_test_extractors=True)
    with pytest.raises(Misconfigured, match="does not hold the weights") as caught:
        Extractor(config, CPU)
    assert caught.value.code == "gpu_out_of_memory"


@pytest.fixture
def models(settings: Settings, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> ModelRegistry:
    """With room for one extractor at a time."""
    monkeypatch.setattr(model_registry, "MAX_EXTRACTORS", 1)
    return ModelRegistry(
        FolderStore(tmp_path), settings.model_copy(update={"device": "cpu"}), none_added
    )


def test_the_fitting_batch_size_is_kept_when_the_model_is_loaded_again(
    models: ModelRegistry,
) -> None:
    models.extractor("test-tiny-avg").limit.record_out_of_memory(2, SIDE * SIDE)
    first_backbone = weakref.ref(models.extractor("test-tiny-avg").backbone)
    other = models.extractor("test-slow-avg")
    gc.collect()
    assert first_backbone() is None, "its memory is free"
    again = models.extractor("test-tiny-avg")
    assert again.limit.photos(16, SIDE * SIDE) == 1
    assert other.limit.photos(16, SIDE * SIDE) == 2


@pytest.mark.parametrize(("device", "warmed"), [(CPU, []), (CUDA, [7])])
def test_models_are_warmed_up_on_a_gpu_when_they_are_loaded(
    models: ModelRegistry, monkeypatch: pytest.MonkeyPatch, device: torch.device, warmed: list[int]
) -> None:
    batch_sizes: list[int] = []

    class Loaded(Extractor):
        def __init__(self, config: Any, _device: torch.device, **options: Any) -> None:
            super().__init__(config, CPU, **options)

        def warm_up(self, photos: int) -> None:
            batch_sizes.append(photos)

    monkeypatch.setattr(model_registry, "Extractor", Loaded)
    monkeypatch.setattr(models, "_device", device)
    monkeypatch.setattr(
        models, "_settings", models._settings.model_copy(update={"batch_photos": 7})
    )
    models.extractor("test-tiny-avg")
    models.extractor("test-tiny-avg")
    assert batch_sizes == warmed


@pytest.mark.parametrize(("device", "most"), [(CPU, 2), (CUDA, 1)])
def test_threads_share_a_gpu_one_pass_at_a_time(device: torch.device, most: int) -> None:
    inside, seen = [0], [0]
    meeting = threading.Barrier(2)

    def run(_pixels: Any) -> torch.Tensor:
        inside[0] += 1
        seen[0] = max(seen[0], inside[0])
        deadline = time.monotonic() + (10 if most == 2 else 0.1)
        while seen[0] < 2 and time.monotonic() < deadline:
            time.sleep(0.005)
        inside[0] -= 1
        return torch.empty(1)

    def work() -> None:
        meeting.wait()
        list(run_in_batches(photos(1), run, BatchSizeLimit(device), device))

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [most]
