"""TorchScript and ONNX files: the same features as the eager module, and what is refused."""

from __future__ import annotations

import copy
import hashlib
import multiprocessing
import re
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from torch.nn.functional import normalize

from shared.descriptors.backbones import normalise_pixels, probe_photos
from shared.descriptors.backbones.exported import ExportedBackbone, exported_prefix
from shared.descriptors.extractor import Extractor
from shared.descriptors.onnx_process import PASS_SECONDS, PHOTOS_PER_PASS, OnnxProcess, PassFailed
from shared.errors import Misconfigured, Unavailable, Unprocessable
from shared.extractor_config.configs import get_extractor_config
from shared.extractor_config.names import IMAGENET_MEAN, IMAGENET_STD
from tests.support.exported import (
    DIMENSION,
    PATCH_WIDTH,
    SIDE,
    onnx_file,
    tiny_network,
    tiny_onnx,
    tiny_torchscript,
    torchscript_of,
)

pytestmark = pytest.mark.numerics

CPU = torch.device("cpu")
SIZE = f"input.size={SIDE}x{SIDE}"
PHOTOS = probe_photos(SIDE, SIDE)
OPEN: list[ExportedBackbone] = []


def config_of(name: str) -> Any:
    return get_extractor_config(name, allow_test_extractors=False)


def backbone(name: str, data: bytes) -> ExportedBackbone:
    return ExportedBackbone(config_of(name), data, CPU)


def refusal(name: str, data: bytes) -> str:
    with pytest.raises(Unprocessable) as caught:
        backbone(name, data)
    assert caught.value.code == "model_unusable"
    return caught.value.detail


def exported_by_torch(module: torch.nn.Module, path: Path) -> bytes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            (torch.rand(2, 3, SIDE, SIDE),),
            path,
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            external_data=False,
            verbose=False,
            dynamo=True,
        )
    return path.read_bytes()


@pytest.mark.parametrize("kind", ["torchscript", "onnx"])
def test_a_file_computes_what_the_eager_module_computes(kind: str, tmp_path: Path) -> None:
    batch = normalise_pixels(PHOTOS, IMAGENET_MEAN, IMAGENET_STD)
    for patches in (False, True):
        network = tiny_network(patches=patches)
        if kind == "onnx":
            data = exported_by_torch(network, tmp_path / "net.onnx")
        else:
            data = tiny_torchscript(patches=patches)
        name = f"{kind}:tiny:{'aggregator=gem,' if patches else ''}{SIZE}"
        loaded = backbone(name, data)
        expected = network(batch)
        if patches:
            assert loaded.width == PATCH_WIDTH
            expected = expected.flatten(2).transpose(1, 2)
        else:
            assert loaded.width == DIMENSION
            expected = expected.unsqueeze(1)
        found = loaded.features(PHOTOS)
        torch.testing.assert_close(found, normalize(expected, dim=-1), rtol=0, atol=1e-5)
        torch.testing.assert_close(loaded.features(PHOTOS[:1]), found[:1], rtol=0, atol=1e-5)
        assert loaded.fingerprint == hashlib.sha256(data).hexdigest()
        assert loaded.card["size_bytes"] == len(data)


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("input.range=255", lambda pixels: pixels.permute(0, 3, 1, 2).float()),
        ("input.range=1", lambda pixels: pixels.permute(0, 3, 1, 2).float() / 255),
        ("input.layout=nhwc,input.range=255", lambda pixels: pixels.float()),
        (
            "input.mean=0.5/0.5/0.5,input.std=0.5/0.5/0.5",
            lambda pixels: pixels.permute(0, 3, 1, 2).float() / 127.5 - 1,
        ),
    ],
)
def test_a_network_gets_the_range_and_the_layout_that_it_expects(
    option: str, expected: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    shape = ("batch", SIDE, SIDE, 3) if "nhwc" in option else ("batch", 3, SIDE, SIDE)
    data = onnx_file([helper.make_node("Flatten", ["x"], ["y"])], shape=shape)
    found = backbone(f"onnx:flat:{option},{SIZE}", data).features(PHOTOS)[:, 0]
    torch.testing.assert_close(
        found, normalize(expected(PHOTOS).flatten(1), dim=-1), rtol=1e-5, atol=1e-6
    )


def test_a_network_of_bytes_gets_bytes() -> None:
    nodes = [
        helper.make_node("Cast", ["x"], ["f"], to=TensorProto.FLOAT),
        helper.make_node("Flatten", ["f"], ["y"]),
    ]
    data = onnx_file(nodes, kind=TensorProto.UINT8)
    found = backbone(f"onnx:bytes:input.range=uint8,{SIZE}", data).features(PHOTOS)[:, 0]
    expected = PHOTOS.permute(0, 3, 1, 2).flatten(1).float()
    torch.testing.assert_close(found, normalize(expected, dim=-1), rtol=1e-5, atol=1e-6)
    assert "uint8" in refusal(f"onnx:bytes:{SIZE}", data)


def test_an_export_for_one_photo_describes_the_photos_of_a_batch() -> None:
    loaded = backbone(f"onnx:one:{SIZE}", tiny_onnx(batch=1))
    batch = normalise_pixels(PHOTOS, IMAGENET_MEAN, IMAGENET_STD)
    expected = normalize(tiny_network()(batch), dim=-1)
    torch.testing.assert_close(loaded.features(PHOTOS)[:, 0], expected, rtol=0, atol=1e-5)


def test_photos_keep_their_size_for_a_network_that_takes_any(tmp_path: Path) -> None:
    path = tmp_path / "any.onnx"
    path.write_bytes(
        onnx_file(
            [helper.make_node("AveragePool", ["x"], ["y"], kernel_shape=[8, 8], strides=[8, 8])],
            shape=("batch", 3, "h", "w"),
        )
    )
    config = config_of(f"onnx:{path}:aggregator=vlad,input.size=native,input.range=1")
    extractor = Extractor(config, CPU)
    photos = [np.full((64, 80, 3), 9, np.uint8), np.full((40, 24, 3), 200, np.uint8)]
    assert [len(each) for each in extractor.patch_features(photos)] == [80, 15]
    assert extractor.spec(None)["preprocessing"] == {"name": "native1024", "version": 1}


@pytest.mark.parametrize(
    ("name", "file", "reason"),
    [
        (f"onnx:x:aggregator=vlad,{SIZE}", "descriptors", "(2, 24)"),
        (f"onnx:x:{SIZE}", "patches", "(2, 6, 4, 4)"),
        ("onnx:x", "descriptors", "Got: 224 Expected: 64"),
    ],
)
def test_an_output_of_another_shape_is_refused_with_what_was_expected(
    name: str, file: str, reason: str
) -> None:
    detail = refusal(name, tiny_onnx(patches=file == "patches"))
    assert reason in detail
    assert "input.size" in detail


class Wrong(torch.nn.Module):
    def __init__(self, fault: str) -> None:
        super().__init__()
        self.fault = fault

    def forward(self, batch: torch.Tensor) -> torch.Tensor:
        pooled = torch.nn.functional.avg_pool2d(batch, 8).flatten(1)
        if self.fault == "nan":
            return pooled / 0.0 - pooled / 0.0
        if self.fault == "same":
            return pooled * 0 + 1
        return pooled - 0.9 * pooled.mean(dim=0) * (batch.shape[0] > 1)


@pytest.mark.parametrize(
    ("fault", "reason"),
    [("nan", "NaN or infinite"), ("same", "are equal"), ("batch", "other photos of its batch")],
)
def test_descriptors_that_can_not_be_used_are_refused(fault: str, reason: str) -> None:
    assert reason in refusal(f"torchscript:x:{SIZE}", torchscript_of(Wrong(fault)))


@pytest.mark.parametrize("kind", ["torchscript", "onnx"])
def test_a_damaged_file_is_refused(kind: str) -> None:
    data = tiny_torchscript() if kind == "torchscript" else tiny_onnx()
    for damaged in (data[: len(data) // 2], b"", data[::-1]):
        assert "can't be read" in refusal(f"{kind}:x:{SIZE}", damaged)


def test_networks_of_half_precision_describe_as_their_copies_of_float32() -> None:
    script = torchscript_of(copy.deepcopy(tiny_network()).half())
    rows = backbone(f"onnx:whole:{SIZE}", tiny_onnx()).features(PHOTOS)
    for name, data in (("onnx", tiny_onnx(half=True)), ("torchscript", script)):
        found = backbone(f"{name}:half:{SIZE}", data).features(PHOTOS)
        assert (found * rows).sum(dim=-1).min() > 0.999
    integers = [helper.make_node("Flatten", ["x"], ["y"])]
    assert "tensor(int32)" in refusal(f"onnx:x:{SIZE}", onnx_file(integers, [], TensorProto.INT32))


class FixedBatch(torch.nn.Module):
    """As traced code is: with the batch of its example."""

    def forward(self, batch: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(batch, 8).reshape(4, 192)


class FixedDevice(torch.nn.Module):
    """As traced code is: with the device of its example."""

    def forward(self, batch: torch.Tensor) -> torch.Tensor:
        return batch.flatten(1) + torch.zeros(1, device=torch.device("cuda:7"))


def test_a_network_of_a_fixed_batch_or_another_device_is_refused_with_the_cause() -> None:
    assert "fixed batch of 4 photos" in refusal(f"onnx:x:{SIZE}", tiny_onnx(batch=4))
    name = f"torchscript:x:{SIZE}"
    assert "takes batches of 4 only" in refusal(name, torchscript_of(FixedBatch()))
    assert "names the device cuda:7" in refusal(name, torchscript_of(FixedDevice()))
    assert "shapes cannot be multiplied" in refusal("torchscript:x", tiny_torchscript())


def test_an_onnx_file_that_names_other_files_is_refused_with_how_to_save_it_as_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # from which ONNX Runtime would read it
    model = onnx.load_from_string(tiny_onnx())
    onnx.save_model(
        model, "net.onnx", save_as_external_data=True, location="net.onnx.data", size_threshold=0
    )
    assert Path("net.onnx.data").exists()
    assert "external_data=False" in refusal(f"onnx:x:{SIZE}", Path("net.onnx").read_bytes())
    # Hidden in the branch of a condition.
    (tmp_path / "secret").write_bytes(np.ones(1, np.float32).tobytes())
    hidden = helper.make_tensor("w", TensorProto.FLOAT, [1], [1])
    del hidden.float_data[:]
    hidden.data_location = TensorProto.EXTERNAL
    hidden.external_data.add(key="location", value="secret")
    branch = helper.make_graph(
        [helper.make_node("Constant", [], ["b"], value=hidden)],
        "branch",
        [],
        [helper.make_tensor_value_info("b", TensorProto.FLOAT, [1])],
    )
    node = helper.make_node("If", ["c"], ["y"], then_branch=branch, else_branch=branch)
    condition = helper.make_tensor("c", TensorProto.BOOL, [], [True])
    assert "can't be read" in refusal(f"onnx:x:{SIZE}", onnx_file([node], [condition]))
    # As weights, relative and absolute: the file exists, and is not read.
    add = helper.make_node("Add", ["x", "w"], ["y"])
    for location in (str(tmp_path / "secret"), "../" + tmp_path.name + "/secret"):
        hidden.external_data[0].value = location
        assert "can't be read" in refusal(f"onnx:x:{SIZE}", onnx_file([add], [hidden]))


def test_an_onnx_file_that_asks_for_more_memory_than_it_may_have_is_refused() -> None:
    nodes = [
        helper.make_node("ConstantOfShape", ["size"], ["z"]),
        helper.make_node("ReduceMean", ["z"], ["r"], keepdims=0),
        helper.make_node("Add", ["x", "r"], ["y"]),
    ]
    huge = helper.make_tensor("size", TensorProto.INT64, [1], [10**13])
    assert "memory" in refusal(f"onnx:x:{SIZE}", onnx_file(nodes, [huge]))
    declared = helper.make_tensor("r", TensorProto.FLOAT, [1], [1.0])
    declared.dims[0] = 10**12
    add = helper.make_node("Add", ["x", "r"], ["y"])
    assert "can't be read" in refusal(f"onnx:x:{SIZE}", onnx_file([add], [declared]))


def test_an_onnx_file_with_operators_of_its_own_is_refused() -> None:
    own = helper.make_node("Steal", ["x"], ["y"], domain="org.example")
    assert "can't be read" in refusal(f"onnx:x:{SIZE}", onnx_file([own]))


def keep_open(data: bytes) -> None:
    OPEN.append(backbone(f"onnx:x:{SIZE}", data))


def test_a_process_with_an_open_onnx_network_ends() -> None:
    process = multiprocessing.get_context("spawn").Process(target=keep_open, args=[tiny_onnx()])
    process.start()
    process.join(90)
    is_alive = process.is_alive()
    process.kill()
    assert not is_alive


def test_a_file_that_was_replaced_describes_with_another_spec(tmp_path: Path) -> None:
    path = tmp_path / "net.pt"
    specs = []
    for seed in (1, 2):
        path.write_bytes(tiny_torchscript(seed=seed))
        specs.append(Extractor(config_of(f"torchscript:{path}:{SIZE}"), CPU).spec(None))
    assert specs[0]["extractor"] == specs[1]["extractor"]
    assert specs[0]["backbone_fingerprint"] != specs[1]["backbone_fingerprint"]
    with pytest.raises(Misconfigured, match="Check the path"):
        Extractor(config_of("torchscript:/no/file.pt"), CPU)


def test_the_kind_of_a_file_is_known_from_its_content(tmp_path: Path) -> None:
    script, checkpoint, text = (tmp_path / name for name in ("s.ckpt", "c.pt", "t.pt"))
    script.write_bytes(tiny_torchscript())
    torch.save({"state_dict": {}}, checkpoint)
    text.write_text("no archive")
    assert exported_prefix(script, "best.ckpt") == "torchscript:"
    assert exported_prefix(checkpoint, "c.pt") is None
    assert exported_prefix(text, "t.pt") is None
    assert exported_prefix(text, "net.ONNX") == "onnx:"
    # A name in the directory of the archive that is not UTF-8.
    data = tiny_torchscript()
    begin = data.rindex(b"/data.pkl")
    damaged = data[:begin] + b"\xac" + data[begin + 1 :]
    text.write_bytes(damaged)
    assert exported_prefix(text, "t.pt") in (None, "torchscript:")


def test_onnx_without_its_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(Misconfigured, match=re.escape(".[onnx]")) as caught:
        backbone(f"onnx:x:{SIZE}", tiny_onnx())
    assert caught.value.code == "onnx_missing"


def endless_loop() -> bytes:
    """`while True: x = x + 1`."""
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["goes_on"], ["goes_on_again"]),
            helper.make_node("Add", ["sum", "sum"], ["next_sum"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("goes_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("sum", TensorProto.FLOAT, []),
        ],
        [
            helper.make_tensor_value_info("goes_on_again", TensorProto.BOOL, []),
            helper.make_tensor_value_info("next_sum", TensorProto.FLOAT, []),
        ],
    )
    nodes = [
        helper.make_node("Loop", ["", "true", "zero"], ["z"], body=body),
        helper.make_node("ReduceMean", ["x"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("Add", ["mean", "z"], ["y"]),
    ]
    true = helper.make_tensor("true", TensorProto.BOOL, [], [True])
    zero = helper.make_tensor("zero", TensorProto.FLOAT, [], [0.0])
    return onnx_file(nodes, [true, zero])


def nested_functions(levels: int = 40) -> bytes:
    """Each function calls the one before twice: 2^levels operators, when they are inlined."""
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]
    functions = []
    for level in range(levels):
        inner = ("Identity", "") if level == 0 else (f"f{level - 1}", "own")
        calls = [
            helper.make_node(inner[0], [source], [target], domain=inner[1])
            for source, target in (("a", "b"), ("b", "c"))
        ]
        functions.append(helper.make_function("own", f"f{level}", ["a"], ["c"], calls, opsets))
    graph = helper.make_graph(
        [
            helper.make_node("ReduceMean", ["x"], ["mean"], axes=[2, 3], keepdims=0),
            helper.make_node(f"f{levels - 1}", ["mean"], ["y"], domain="own"),
        ],
        "graph",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ("n", 3, SIDE, SIDE))],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
    )
    model = helper.make_model(graph, functions=functions, opset_imports=opsets, ir_version=9)
    data: bytes = model.SerializeToString()
    return data


@pytest.mark.parametrize("make", [endless_loop, nested_functions])
def test_an_onnx_file_that_never_ends_is_refused_after_its_time(
    make: Callable[[], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shared.descriptors.onnx_process.PASS_SECONDS", 1.0)
    assert "more than 1 s" in refusal(f"onnx:x:{SIZE}", make())


def test_numpy_has_no_threads_in_the_process_of_a_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    status = OnnxProcess(tiny_onnx(), 1)._run(eval, "open('/proc/self/status').read()")
    assert "Threads:\t1\n" in status


def test_a_pass_ends_when_the_extractor_stops_and_the_network_goes_on_after_a_failed_pass() -> None:
    asked: list[int] = []

    def is_stopping() -> bool:
        asked.append(1)
        return len(asked) > 3

    started = time.monotonic()
    with pytest.raises(Unavailable) as stopped:
        ExportedBackbone(config_of(f"onnx:x:{SIZE}"), endless_loop(), CPU, is_stopping=is_stopping)
    assert stopped.value.code == "extractor_stopping"
    assert time.monotonic() - started < PASS_SECONDS
    process = OnnxProcess(tiny_onnx(), 1)
    with pytest.raises(PassFailed):
        process(np.zeros((1, 3, 5, 5), np.float32))
    batch = np.random.default_rng(1).random((2 * PHOTOS_PER_PASS + 1, 3, SIDE, SIDE), np.float32)
    expected = tiny_network()(torch.from_numpy(batch))
    np.testing.assert_allclose(process(batch), expected, rtol=1e-4, atol=1e-4)
