"""Models that are added, from the checkpoint to the map that is described with them."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable
from typing import Any
from uuid import UUID

import httpx2
import numpy as np
import pytest
import torch
from sqlalchemy import select, update

from services.extractor import model_changes
from services.extractor.worker import ExtractorWorker
from services.steward.tasks.garbage_collection import collect_checkpoints
from services.steward.tasks.orphans import collect_orphans
from shared.catalog.generations import Generation, active_generation
from shared.catalog.maps import get_map
from shared.catalog.models import Model, remove_model
from shared.descriptors.backbones import normalise_pixels
from shared.descriptors.backbones.torchhub import module_fingerprint
from shared.imaging.decode import decode_photo
from shared.imaging.preprocessing import get_preprocessing
from shared.storage.keys import CHECKPOINTS, MODELS
from tests.integration.in_process_api import Service
from tests.support.catalog_rows import end_pauses, stored_rows
from tests.support.checkpoints import (
    MEAN,
    SIDES,
    STD,
    checkpoint_of,
    own_output,
    some_checkpoint,
    untrained,
)
from tests.support.exported import (
    DIMENSION,
    PATCH_WIDTH,
    SIDE,
    code_name,
    tiny_network,
    tiny_onnx,
    tiny_torchscript,
)
from tests.support.photos import photo_bytes
from tests.support.problems import field_refused, problem

PHOTOS = 3


def send(service: Service, data: bytes, name: str = "walks", **fields: str) -> httpx2.Response:
    return service(
        "POST", "/models", files={"file": ("best.ckpt", data)}, data={"name": name, **fields}
    )


def failed(service: Service, answer: httpx2.Response, code: str) -> str:
    """The reason for which the job has failed."""
    assert answer.status_code == 202, answer.text
    job = service.ended(answer.json()["job_id"])
    assert (job["state"], job["error"]["code"]) == ("failed", code), job
    return str(job["error"]["detail"])


def switch(service: Service, map_name: str = "default", **params: Any) -> httpx2.Response:
    return service("POST", "/generations", params={"map": map_name}, json=params)


def keys(service: Service, prefix: str) -> list[str]:
    return [info.key for info in service.store.list(prefix)]


def active(service: Service, map_name: str = "default") -> Generation:
    with service.catalog.read() as session:
        found = active_generation(session, get_map(session, map_name).id)
    assert found is not None
    return found


@pytest.fixture
def walks(service: Service) -> Service:
    """With the model `walks`, and PHOTOS photos in the map `default`, which another describes."""
    service.done(send(service, some_checkpoint(), licence="CC BY 4.0", note="of spring"))
    service.indexed(*range(PHOTOS))
    return service


# --- adding ----------------------------------------------------------------------------------


def test_a_checkpoint_becomes_a_model_without_what_training_goes_on_with(service: Service) -> None:
    model = untrained()
    data = checkpoint_of(model, city="Genova", rate=float("nan"), long_text="a\x00b")
    result = service.done(send(service, data, licence="CC BY 4.0"))
    body = service.json("GET", "/models/walks")
    (stored,) = keys(service, MODELS)
    assert result == {
        "name": "walks",
        "extractor": "gsv:walks",
        "fingerprint": body["fingerprint"],
        "dimension": 128,
        "size_bytes": len(service.store.get(stored)),
        "already_there": False,
    }
    assert stored.startswith(f"{MODELS}{body['sha256']}/")
    weights = module_fingerprint(model)[1]
    assert weights <= result["size_bytes"] < weights + 20_000 < len(data)
    assert (body["licence"], body["note"], body["maps"]) == ("CC BY 4.0", None, [])
    assert (body["image_size"], body["dimension"]) == (list(SIDES), 128)
    assert body["config"]["agg_arch"] == "GeM"
    assert body["about"] == {
        "source": "best.ckpt",
        "lr": 0.0001,
        "city": "Genova",
        "rate": "nan",
        "long_text": "ab",
        "epoch": 3,
        "global_step": 120,
    }
    assert service.json("GET", "/models")["models"] == [body]


def test_the_same_weights_again_are_fine_and_others_under_the_name_are_refused(
    walks: Service,
) -> None:
    before = walks.json("GET", "/models/walks")
    trained_on = checkpoint_of(untrained(), lr_of_the_day=1)  # another file, the same weights
    assert walks.done(send(walks, trained_on, note="once more"))["already_there"]
    after = walks.json("GET", "/models/walks")
    assert {**after, "note": "of spring"} == before
    assert after["note"] == "once more"

    reason = failed(walks, send(walks, some_checkpoint(1)), "model_name_taken")
    assert before["fingerprint"][:12] in reason
    assert walks.json("GET", "/models/walks") == after
    assert (
        walks.done(send(walks, some_checkpoint(1), "other"))["fingerprint"] != before["fingerprint"]
    )
    assert [m["name"] for m in walks.json("GET", "/models")["models"]] == ["other", "walks"]


class Code:
    """What a pickle executes when it is read without care."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("executed",)


def saved(value: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def with_code() -> bytes:
    state = torch.load(io.BytesIO(some_checkpoint()), weights_only=True)
    return saved({**state, "callbacks": {"hook": Code()}})


def with_nan() -> bytes:
    model = untrained()
    next(model.parameters()).data[0] = torch.nan
    return checkpoint_of(model)


def of_zeros() -> bytes:
    model = untrained()
    for tensor in model.state_dict().values():
        tensor.zero_()
    return checkpoint_of(model)


def without_a_layer() -> bytes:
    state = torch.load(io.BytesIO(some_checkpoint()), weights_only=True)
    state["state_dict"].popitem()
    return saved(state)


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda: some_checkpoint()[:5000], "checkpoint_unreadable"),
        (with_code, "checkpoint_unreadable"),
        (without_a_layer, "checkpoint_unusable"),
        (with_nan, "model_unusable"),
        (of_zeros, "model_unusable"),
    ],
    ids=["torn", "code", "layer", "nan", "zeros"],
)
def test_a_checkpoint_that_can_not_be_used_fails_with_the_reason_and_leaves_nothing(
    service: Service,
    make: Callable[[], bytes],
    code: str,
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    started = send(service, make())
    assert len(keys(service, CHECKPOINTS)) == 1
    failed(service, started, code)
    assert not (tmp_path / "executed").exists()
    assert service.json("GET", "/models")["models"] == []
    collect_checkpoints(service.catalog, service.store)
    assert keys(service, CHECKPOINTS) == keys(service, MODELS) == []
    again = service("POST", f"/jobs/{started.json()['job_id']}/retry")
    assert "POST /api/v1/models" in problem(again, 409, "job_not_retryable")["detail"]


def test_an_uploaded_checkpoint_is_kept_until_its_job_has_ended(service: Service) -> None:
    started = send(service, some_checkpoint())
    collect_checkpoints(service.catalog, service.store)
    collect_orphans(service.catalog, service.store, 0)
    assert len(keys(service, CHECKPOINTS)) == 1
    service.done(started)
    collect_orphans(service.catalog, service.store, 0)
    assert (len(keys(service, CHECKPOINTS)), len(keys(service, MODELS))) == (0, 1)


@pytest.mark.parametrize(
    ("field", "value"),
    [("name", "a/b"), ("licence", "x" * 1001), ("note", "nul \x00"), ("tags", "spring")],
)
def test_metadata_of_a_model_is_validated(service: Service, field: str, value: str) -> None:
    fields = {"name": "walks", field: value}
    name = fields.pop("name")
    field_refused(send(service, b"whatever", name, **fields), field)
    assert keys(service, CHECKPOINTS) == []


def test_a_checkpoint_over_the_limit_is_refused_while_it_comes(service: Service) -> None:
    form = {"data": {"name": "walks"}, "files": {"file": ("best.ckpt", b"whatever")}}
    answer = service("POST", "/models", **form, headers={"Content-Length": "7000000000"})
    assert "--save_weights_only" in problem(answer, 413, "file_too_large")["detail"]
    assert keys(service, CHECKPOINTS) == []


# --- describing ------------------------------------------------------------------------------


def test_a_map_is_described_as_the_model_itself_describes(walks: Service) -> None:
    walks.json("POST", "/maps", 201, json={"name": "new", "extractor": "gsv:walks"})
    walks.indexed(*range(PHOTOS), map_name="new")
    generation = active(walks, "new")
    body = walks.json("GET", "/models/walks")
    assert generation.spec["backbone_fingerprint"] == body["fingerprint"]
    assert generation.spec["preprocessing"] == {"name": "resize48x64", "version": 1}
    assert generation.spec["image_size"] == list(SIDES)
    assert generation.spec["normalisation"] == {"mean": list(MEAN), "std": list(STD)}
    assert (generation.dimension, generation.spec["extractor"]) == (128, "gsv:walks")
    rows = stored_rows(walks.catalog, walks.store, generation.id)
    model = untrained()
    expected = [own_output(model, photo_bytes(number)) for number in range(PHOTOS)]
    for row in rows.values():
        assert any(np.allclose(row, one, rtol=2**-10, atol=1e-5) for one in expected)
    assert (
        len(
            {
                min(range(PHOTOS), key=lambda n: float(abs(row - expected[n]).max()))
                for row in rows.values()
            }
        )
        == PHOTOS
    )
    assert body["maps"] == ["new"]


def test_a_map_that_has_no_photo_yet_takes_the_model_at_once(walks: Service) -> None:
    walks.json("POST", "/maps", 201, json={"name": "empty", "extractor": "test-tiny-vlad"})
    walks.done(switch(walks, "empty", extractor="gsv:walks"), "empty")
    assert walks.json("GET", "/maps/empty")["extractor"] == "gsv:walks"
    walks.indexed(1, map_name="empty")
    assert active(walks, "empty").dimension == 128


def test_a_switch_says_what_is_wrong_before_it_begins(walks: Service) -> None:
    missing = problem(switch(walks, extractor="gsv:nights"), 404, "model_missing")
    assert "placewise models add" in missing["detail"]
    field_refused(switch(walks, extractor="gsv:/etc/passwd"), "extractor")
    field_refused(switch(walks, extractor="gsv:no/name"), "extractor")
    field_refused(switch(walks, extractor="nobody-knows"), "extractor")
    field_refused(switch(walks, extractor="gsv:walks", pca=8), "pca")
    field_refused(switch(walks, extractor="test-tiny-vlad"), "vocabulary_id")
    unused = {"extractor": "gsv:walks", "vocabulary_id": "01a1fca4-c1a2-7356-bf32-75e1cb64beb1"}
    field_refused(switch(walks, **unused), "vocabulary_id")
    answer = walks("POST", "/maps", json={"name": "new", "extractor": "gsv:nights"})
    problem(answer, 404, "model_missing")


def test_photos_wait_for_a_model_that_is_not_there_yet(walks: Service) -> None:
    with walks.catalog.write() as session:  # as with EXTRACTOR=gsv:nights from the first start on
        get_map(session, "default").extractor = "gsv:nights"
        session.execute(update(Generation).values(state="retired"))
    job_id = walks.upload(photo_bytes(9))["job_id"]
    response = walks.ask(photo_bytes(8))
    walks.drain()
    waits = walks.json("GET", f"/jobs/{job_id}")
    assert (waits["state"], waits["error"]["code"]) == ("queued", "model_missing")
    body = walks.json("GET", f"/jobs/{response}")
    assert (body["state"], body["error"]["code"]) == ("failed", "model_missing")
    assert walks.worker.state()["errors"] == {"gsv:nights": "model_missing"}

    walks.done(send(walks, some_checkpoint(1), "nights"))
    end_pauses(walks.catalog)
    walks.drain()
    assert walks.json("GET", f"/jobs/{job_id}")["state"] == "succeeded"
    assert active(walks).extractor == "gsv:nights"
    assert walks.worker.state()["errors"] == {}


def test_a_model_file_with_another_hash_describes_nothing(walks: Service) -> None:
    with walks.catalog.read() as session:
        key = session.scalars(select(Model.object_key).where(Model.added_name == "walks")).one()
    assert key is not None
    data = bytearray(walks.store.get(key))
    data[-1] ^= 1
    walks.store.put(key, bytes(data))
    job = switch(walks, extractor="gsv:walks")
    walks.drain()
    waits = walks.json("GET", f"/jobs/{job.json()['job_id']}")
    assert (waits["state"], waits["error"]["code"]) == ("running", "model_corrupt")

    # As the reason says: the same checkpoint again repairs it.
    walks.done(send(walks, some_checkpoint()))
    end_pauses(walks.catalog)
    assert walks.done(job)["dimension"] == 128


# --- removing --------------------------------------------------------------------------------


def test_a_model_that_a_map_or_the_settings_use_is_not_removed(walks: Service) -> None:
    settings = walks.settings.model_copy(update={"extractor": "gsv:walks"})
    other = Service(walks.catalog, walks.store, settings, walks.make_worker)
    body = problem(other("DELETE", "/models/walks"), 409, "model_in_use")
    assert "EXTRACTOR" in body["detail"]
    walks.json("POST", "/maps", 201, json={"name": "empty", "extractor": "gsv:walks"})
    assert problem(walks("DELETE", "/models/walks"), 409, "model_in_use")["maps"] == ["empty"]
    walks.json("DELETE", "/maps/empty")
    started = switch(walks, extractor="gsv:walks")
    walks.drain()  # its generation is being built
    assert problem(walks("DELETE", "/models/walks"), 409, "model_in_use")["maps"] == ["default"]
    walks.done(started)
    assert problem(walks("DELETE", "/models/walks"), 409, "model_in_use")["maps"] == ["default"]


def test_a_removed_model_goes_with_its_bytes_and_its_name_means_no_other(walks: Service) -> None:
    walks.done(switch(walks, extractor="gsv:walks"))
    walks.done(switch(walks, extractor="test-tiny-avg"))
    assert walks.json("DELETE", "/models/walks")["removed_model"] == "walks"
    problem(walks("GET", "/models/walks"), 404, "model_missing")
    problem(walks("DELETE", "/models/walks"), 404, "model_missing")
    assert walks.json("GET", "/models")["models"] == []
    collect_orphans(walks.catalog, walks.store, 0)
    assert keys(walks, MODELS) == []

    reason = failed(walks, send(walks, some_checkpoint(1)), "model_name_taken")
    assert "names are not reused" in reason
    assert not walks.done(send(walks, some_checkpoint()))["already_there"]
    assert walks.done(switch(walks, extractor="gsv:walks"))["dimension"] == 128


def test_a_model_that_is_removed_at_the_last_moment_begins_no_generation(
    walks: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = active(walks).id
    real = model_changes.start_generation

    def remove_first(*arguments: Any) -> None:
        with walks.catalog.write() as session:
            remove_model(session, "walks", "test-tiny-avg")
        real(*arguments)

    monkeypatch.setattr(model_changes, "start_generation", remove_first)
    failed(walks, switch(walks, extractor="gsv:walks"), "model_missing")
    assert active(walks).id == before


# --- exported networks -----------------------------------------------------------------------

SIZE = f"input.size={SIDE}x{SIDE}"


def send_exported(
    service: Service, data: bytes, file: str, name: str = "tiny", options: str = SIZE
) -> httpx2.Response:
    fields = {"name": name, "options": options}
    return service("POST", "/models", files={"file": (file, data)}, data=fields)


@pytest.fixture
def allowing(service: Service, make_worker: Callable[..., ExtractorWorker]) -> Service:
    """With an extractor that may execute the code of the tiny TorchScript files."""
    code = code_name(tiny_torchscript())
    return Service(
        service.catalog,
        service.store,
        service.settings,
        lambda: make_worker(code_allowed=code),
    )


def test_torchscript_code_runs_only_where_its_hash_is_allowed(
    service: Service, allowing: Service
) -> None:
    data = tiny_torchscript()
    reason = failed(service, send_exported(service, data, "net.pt"), "code_not_allowed")
    assert code_name(data) in reason
    added = allowing.done(send_exported(allowing, data, "net.pt"))
    assert added["extractor"] == f"torchscript:tiny:{SIZE}"
    assert added["fingerprint"] == hashlib.sha256(data).hexdigest()
    # Another worker may have been started without it.
    service.json("POST", "/maps", 201, json={"name": "new", "extractor": added["extractor"]})
    job_id = service.upload(photo_bytes(1), "new")["job_id"]
    service.drain()
    waits = service.json("GET", f"/jobs/{job_id}", params={"map": "new"})
    assert (waits["state"], waits["error"]["code"]) == ("queued", "code_not_allowed")
    other = tiny_torchscript(seed=8)
    failed(allowing, send_exported(allowing, other, "net.pt", "other"), "code_not_allowed")


def test_an_exported_network_is_listed_used_kept_and_removed(allowing: Service) -> None:
    data = tiny_onnx()
    extractor = allowing.done(send_exported(allowing, data, "net.onnx"))["extractor"]
    (body,) = allowing.json("GET", "/models")["models"]
    assert (body["name"], body["extractor"]) == ("tiny", extractor)
    assert (body["dimension"], body["image_size"]) == (DIMENSION, [SIDE, SIDE])
    assert body["about"] == {"source": "net.onnx"}
    # Its name means this file only, whatever the kind.
    script = tiny_torchscript()
    failed(allowing, send_exported(allowing, script, "net.pt"), "model_name_taken")
    problem(switch(allowing, extractor=f"torchscript:tiny:{SIZE}"), 404, "model_missing")
    problem(switch(allowing, extractor="gsv:tiny"), 404, "model_missing")
    ids = allowing.indexed(*range(PHOTOS))
    allowing.done(switch(allowing, extractor=extractor))
    generation = active(allowing)
    assert generation.spec["backbone_fingerprint"] == hashlib.sha256(data).hexdigest()
    rows = stored_rows(allowing.catalog, allowing.store, generation.id)
    preprocessing = get_preprocessing(f"resize{SIDE}x{SIDE}")
    for number, photo_id in enumerate(ids):
        pixels = decode_photo(photo_bytes(number), preprocessing, 10**9).pixels
        batch = normalise_pixels(torch.from_numpy(pixels[None].copy()), MEAN, STD)
        expected = torch.nn.functional.normalize(tiny_network()(batch), dim=-1)[0]
        np.testing.assert_allclose(rows[UUID(photo_id)], expected, rtol=2**-10, atol=1e-5)
    used = problem(allowing("DELETE", "/models/tiny"), 409, "model_in_use")
    assert used["maps"] == ["default"]
    allowing.done(switch(allowing, extractor="test-tiny-avg"))
    allowing.json("DELETE", "/models/tiny")


def test_patches_of_an_exported_network_get_a_vocabulary_of_the_map(allowing: Service) -> None:
    options = f"aggregator=vlad,clusters=4,{SIZE}"
    data = tiny_onnx(patches=True)
    started = send_exported(allowing, data, "net.onnx", "town", options)
    extractor = allowing.done(started)["extractor"]
    allowing.json("POST", "/maps", 201, json={"name": "town", "extractor": extractor})
    allowing.indexed(*range(3 * PHOTOS), map_name="town")
    pooled = active(allowing, "town")
    assert (pooled.extractor, pooled.dimension) == (
        f"onnx:town:aggregator=gem,{SIZE}",
        PATCH_WIDTH,
    )
    fitted = allowing("POST", "/vocabularies", params={"map": "town"}, json={})
    clusters = allowing.done(fitted, "town")["clusters"]
    generation = active(allowing, "town")
    assert clusters > 1
    assert (generation.extractor, generation.dimension) == (extractor, clusters * PATCH_WIDTH)
    assert allowing.json("GET", "/models/town")["maps"] == ["town"]


def test_options_that_no_network_has_fail_with_those_that_exist(service: Service) -> None:
    sent = send_exported(service, b"any", "net.onnx", options="input.size=9")
    assert "input.size, input.mean" in failed(service, sent, "bad_extractor_option")
    field_refused(send_exported(service, b"any", "net.onnx", options="x" * 201), "options")
    field_refused(switch(service, extractor=f"onnx:/etc/passwd:{SIZE}"), "extractor")
