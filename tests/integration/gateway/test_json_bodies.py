"""What a request body may contain."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from shared.catalog.database.base import db_now
from shared.catalog.maps import get_map
from shared.catalog.models import Model
from shared.geometry.colmap_model import MAX_PHOTOS
from shared.ids import new_id
from tests.integration.api_with_keys import ADMIN, Door
from tests.support.problems import problem
from tools.make_api_page import openapi_description

IMPORT = "/reconstructions/import"
PHOTO = "/uploads/01a1fca4-c1a2-7356-bf32-75e1cb64beb1"
BOUNDED_FORMATS = {"binary", "date-time", "duration", "uuid"}
CAMERA = {"model": "PINHOLE", "width": 9, "height": 9, "params": [9, 9, 4, 4]}
POSE = {"camera": 0, "rotation": [1, 0, 0, 0], "translation": [0, 0, 0]}


def unbounded(schema: dict[str, Any], path: str, schemas: dict[str, Any]) -> Iterator[str]:
    """The paths of lists, texts and free objects without a limit."""
    if reference := schema.get("$ref"):
        yield from unbounded(schemas[reference.rpartition("/")[2]], path, schemas)
        return
    for name in ("anyOf", "oneOf", "allOf", "prefixItems"):
        for inner in schema.get(name, []):
            yield from unbounded(inner, path, schemas)
    kind = schema.get("type")
    if kind == "array":
        if "maxItems" not in schema:
            yield f"{path}: list"
        yield from unbounded(schema.get("items") or {}, f"{path}[]", schemas)
    is_text = kind == "string" and not {"enum", "const", "maxLength"} & schema.keys()
    if is_text and schema.get("format") not in BOUNDED_FORMATS:
        fixed = schema.get("pattern", "").endswith("}$")
        if not fixed and "contentMediaType" not in schema:
            yield f"{path}: text"
    if kind == "object" and "properties" not in schema and "maxProperties" not in schema:
        yield f"{path}: object"
    for name, inner in schema.get("properties", {}).items():
        yield from unbounded(inner, f"{path}.{name}", schemas)


def test_no_list_text_or_object_of_a_request_body_is_without_a_limit() -> None:
    api = openapi_description()
    found: list[str] = []
    bodies = 0
    for path, methods in api["paths"].items():
        for method, operation in methods.items():
            for media in operation.get("requestBody", {}).get("content", {}).values():
                bodies += 1
                where = f"{method} {path} "
                found += unbounded(media["schema"], where, api["components"]["schemas"])
    assert bodies > 15
    assert not found
    assert list(unbounded({"type": "array", "items": {"type": "string"}}, "", {})) == [
        ": list",
        "[]: text",
    ]


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", IMPORT, {"cameras": [CAMERA], "photos": [{}] * 40_000}),
        ("POST", IMPORT, {"cameras": [{}] * 40_000, "photos": []}),
        ("POST", IMPORT, {f"field{number}": 0 for number in range(50_000)}),
        ("POST", IMPORT, {"cameras": [CAMERA], "photos": [{**POSE, "x" * 90_000: 1}] * 3}),
        ("POST", "/positions", {"photos": [{}] * 9_000, "track": [{}] * 9_000}),
        ("PATCH", PHOTO, {"tags": [1] * 50_000}),
        ("PATCH", PHOTO, {"metadata": {str(number): 0 for number in range(20_000)}}),
        ("POST", "/maps", {f"field{number}": 0 for number in range(90)}),
    ],
)
def test_the_answer_to_an_invalid_body_stays_small(
    door: Door, method: str, path: str, body: Any
) -> None:
    answer = door(ADMIN, method, path, json=body)
    assert problem(answer, 422, "invalid_field")["errors"]
    assert len(answer.content) < 10_000


def test_a_body_of_more_values_than_its_size_needs_is_refused_before_it_is_parsed(
    door: Door,
) -> None:
    for body in (b"[" * 70_000, b'{"tags":[' + b"1," * 70_000 + b"1]}", b"{}," * 40_000):
        answer = door(ADMIN, "PATCH", PHOTO, content=body)
        problem(answer, 413, "too_many_values")


def test_a_body_without_its_content_type_is_refused_with_the_header_to_send(door: Door) -> None:
    refused = problem(door(ADMIN, "PATCH", PHOTO, content=b"{}"), 400, "malformed_body")
    assert "`Content-Type: application/json`" in refused["detail"]


def test_the_largest_model_that_is_allowed_can_be_imported(door: Door) -> None:
    photos = [{**POSE, "name": f"folder/DJI_2026_{number:06}.JPG"} for number in range(MAX_PHOTOS)]
    body = {"cameras": [CAMERA] * 1000, "photos": photos}
    assert door(ADMIN, "POST", IMPORT, json=body).status_code in (202, 409)
    body["photos"].append({**POSE, "name": "one more"})
    refused = problem(door(ADMIN, "POST", IMPORT, json=body), 422, "invalid_field")
    assert str(MAX_PHOTOS) in refused["detail"]


def test_a_manifest_is_read_line_by_line_up_to_its_limits(door: Door) -> None:
    def send(data: bytes) -> Any:
        return door(ADMIN, "POST", "/upload/batch", files={"manifest": ("m.jsonl", data)})

    one_line = b'{"key": "imports/a", "tags": [' + b"{}," * 400_000 + b"{}]}"
    assert "line 1" in problem(send(one_line), 400, "bad_manifest")["detail"]
    long_field = json.dumps({"key": "imports/a", "x" * 900_000: 1}).encode()
    assert len(send(long_field).content) < 10_000


def test_an_extractor_name_that_can_not_be_read_hides_no_model(door: Door) -> None:
    name = "onnx:tiny@0"  # as a release without the check stored it
    with door.catalog.write() as session:
        get_map(session, "default").extractor = name
        common = {"fingerprint": "0" * 64, "licence": "own", "dimension": 3, "size_bytes": 1}
        session.add_all(
            Model(
                id=new_id(),
                name=f"onnx:{added}",
                added_name=added,
                config=config,
                card={},
                object_key="models/1",
                sha256="0" * 64,
                added_at=db_now(),
                **common,
            )
            for added, config in (("tiny", {}), ("other", {"image_size": [2, 2]}))
        )
    listed = {each["name"]: each for each in door(ADMIN, "GET", "/models").json()["models"]}
    assert {added: each["maps"] for added, each in listed.items()} == {
        "tiny": ["default"],
        "other": [],
    }
    assert door(ADMIN, "DELETE", "/models/tiny").status_code == 409
    refused = door(ADMIN, "POST", "/maps", json={"name": "a", "extractor": name})
    assert "a model name has" in problem(refused, 422, "invalid_field")["detail"]
