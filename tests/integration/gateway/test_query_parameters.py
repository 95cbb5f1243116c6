"""Query parameters that no endpoint has."""

from __future__ import annotations

import re
from uuid import UUID

from tests.integration.api_with_keys import ADMIN, Door
from tools.make_api_page import openapi_description

API = "/api/v1"


def test_every_endpoint_refuses_an_unknown_parameter_by_its_name(door: Door) -> None:
    calls = [
        (method.upper(), path.removeprefix(API))
        for path, methods in openapi_description()["paths"].items()
        for method in methods
        if path.startswith(API)
    ]
    assert len(calls) > 40
    for method, template in calls:
        path = re.sub(r"{\w+}", str(UUID(int=1)), template)
        response = door(ADMIN, method, path, params={"misspelt": "1"})
        refusal = response.json()
        assert (response.status_code, refusal["code"]) == (422, "invalid_field"), (method, path)
        assert {"field": "misspelt", "detail": "is unknown"} in refusal["errors"], (method, path)


def test_a_parameter_that_is_given_twice_is_refused_unless_it_is_a_list(door: Door) -> None:
    for path in ("/search?tags=a&tags=b", "/search?map=a&map=b", "/tracks?limit=1&limit=2"):
        assert "is given twice" in door(ADMIN, "GET", path).json()["detail"], path
    assert door(ADMIN, "GET", "/jobs", params={"kind": ["index", "fit"]}).status_code == 200


def test_every_endpoint_that_does_not_use_a_map_accepts_the_parameter(door: Door) -> None:
    for path in ("/maps", "/models", "/keys", "/webhooks", "/health"):
        assert door(ADMIN, "GET", path, params={"map": "default"}).status_code == 200, path
