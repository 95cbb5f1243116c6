"""The API is what its description says, whatever is sent: schemathesis makes the calls.

`make test-api-fuzz` makes many more of them than `make test` does.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Iterable
from typing import Any

import hypothesis
import pytest
import schemathesis
from hypothesis import HealthCheck, Phase
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from services.extractor.worker import ExtractorWorker
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.storage import FolderStore
from tests.integration.api_with_keys import ADMIN, Door
from tests.support.photos import photo_bytes

EXAMPLES = int(os.environ.get("PLACEWISE_FUZZ_EXAMPLES", "2"))  # of calls; a sixth: of sequences
PROMISED = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]
# 503 is an answer of these, too: on a busy machine jobs wait long.
HEALTH = {"GET /readyz", "GET /api/v1/health"}
NOTHING_TO_GET_WRONG = {"GET /", "GET /livez", "GET /readyz"}  # calls without a parameter
STRANGERS: tuple[tuple[dict[str, str], str], ...] = (
    ({}, "key_missing"),
    ({"Authorization": "Bearer pw_guessed"}, "key_unknown"),
    ({"Authorization": "Basic YTpi"}, "key_missing"),
)
KEY = {"Authorization": f"Bearer {ADMIN}"}


def settings_of(examples: int, **more: Any) -> hypothesis.settings:
    return hypothesis.settings(
        max_examples=examples,
        database=None,
        derandomize=EXAMPLES <= 2,
        suppress_health_check=list(HealthCheck),
        # Failures are reported as found: shrinking them takes minutes.
        phases=(Phase.explicit, Phase.generate),
        **more,
    )


@pytest.fixture
def fuzzed(
    catalog: Catalog,
    store: FolderStore,
    settings: Settings,
    make_worker: Callable[[], ExtractorWorker],
    monkeypatch: pytest.MonkeyPatch,
) -> Door:
    """A service that waits for nothing, with photos that can be found."""
    monkeypatch.setattr("services.gateway.dependencies.MAX_WAIT_SECONDS", 0.0)
    monkeypatch.setattr("services.gateway.routes.jobs.MAX_WAIT_SECONDS", 0.0)
    door = Door(catalog, store, settings)
    for number in (1, 2, 3):
        assert door.put(ADMIN, number).status_code == 202
    make_worker().drain(threading.Event())
    return door


def described(door: Door) -> Any:
    return schemathesis.openapi.from_asgi("/openapi.json", door.app)


def each_call(
    door: Door,
    check: Callable[[Any], None],
    examples: int,
    only: Callable[[Any], bool] = lambda operation: True,
    modes: Iterable[GenerationMode] = GenerationMode,
) -> None:
    """`check` on made-up cases of every call of the description; all failures are reported."""
    failures: list[str] = []
    operations = [result.ok() for result in described(door).get_all_operations()]
    assert len(operations) > 40
    for operation, mode in itertools.product(filter(only, operations), modes):
        if mode == GenerationMode.NEGATIVE and operation.label in NOTHING_TO_GET_WRONG:
            continue
        cases = operation.as_strategy(generation_mode=mode)
        run = hypothesis.given(case=cases)(lambda case: check(case))
        try:
            settings_of(examples)(run)()
        except (BaseExceptionGroup, AssertionError, Unsatisfiable) as error:
            failures.append(f"{operation.label} ({mode.value}): {error!r}")
    assert not failures, "\n\n".join(failures)


def test_every_call_with_a_key_conforms_to_its_openapi_description(fuzzed: Door) -> None:
    def check(case: Any) -> None:
        checks = PROMISED[case.operation.label in HEALTH :]
        case.call_and_validate(headers=KEY, checks=checks)

    each_call(fuzzed, check, EXAMPLES)


def followed(door: Door) -> dict[str, str]:
    """A new track with a frame; their ids."""
    track = door(ADMIN, "POST", "/tracks", json={}).json()
    frame = door(
        ADMIN,
        "POST",
        f"/tracks/{track['track_id']}/frames",
        data={"captured_at": "2026-05-01T12:00:00Z"},
        files={"file": ("frame.jpg", photo_bytes(1))},
    ).json()
    return {"track_id": track["track_id"], "frame_id": frame["frame_id"]}


def test_calls_about_stored_photos_jobs_and_tracks_conform_to_their_description(
    fuzzed: Door,
) -> None:
    def check(case: Any) -> None:
        there = fuzzed.put(ADMIN, 1).json()  # the same one again, unless a call has deleted it
        if "track_id" in case.path_parameters:
            there |= followed(fuzzed)
        known = case.path_parameters.keys() & there.keys()
        case.path_parameters.update({name: there[name] for name in known})
        case.query = {**case.query, "map": "default"}
        case.call_and_validate(headers=KEY, checks=PROMISED)

    def is_about_one(operation: Any) -> bool:
        return any(name in operation.path for name in ("{file_id}", "{job_id}", "{track_id}"))

    each_call(fuzzed, check, EXAMPLES, is_about_one)


def test_every_call_of_the_api_without_a_known_key_is_refused(fuzzed: Door) -> None:
    def check(case: Any) -> None:
        made_up = dict(case.headers or {}).items()
        others = {name: value for name, value in made_up if name.lower() != "authorization"}
        for headers, code in STRANGERS:
            case.headers = {**others, **headers}
            answer = case.call()
            case.validate_response(answer, checks=PROMISED)
            if case.path.startswith("/api/"):
                assert answer.status_code == 401, case.path
                assert answer.json()["code"] == code

    each_call(fuzzed, check, 1, modes=[GenerationMode.POSITIVE])


def test_sequences_of_linked_calls_conform_to_their_description(fuzzed: Door) -> None:
    machine = described(fuzzed).as_state_machine()

    class Sequences(machine):  # type: ignore[misc, valid-type]
        def get_call_kwargs(self, case: Any) -> dict[str, Any]:
            return {"headers": KEY}

        def validate_response(self, response: Any, case: Any, **options: Any) -> None:
            case.validate_response(response, checks=PROMISED)

    Sequences.run(settings=settings_of(max(1, EXAMPLES // 6), stateful_step_count=12))
    assert fuzzed.put(ADMIN, 4).status_code == 202, "and the service is still there"
    assert fuzzed(ADMIN, "GET", "/health").status_code == 200


def test_the_fuzz_reports_a_server_error(fuzzed: Door, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*args: Any) -> Any:
        raise ZeroDivisionError

    monkeypatch.setattr("services.gateway.routes.maps.list_maps", broken, raising=False)
    operation = described(fuzzed)["/api/v1/maps"]["GET"]
    run = hypothesis.given(case=operation.as_strategy())(
        lambda case: case.call_and_validate(headers=KEY, checks=PROMISED)
    )
    with pytest.raises(BaseException, match=r"[Ss]erver error"):
        settings_of(1)(run)()
