"""Errors cross processes and become problem documents."""

from __future__ import annotations

import copy
import pickle

import pytest

from shared import errors
from shared.errors import PlacewiseError, Unprocessable, invalid_field_error

KINDS = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, PlacewiseError)
]


@pytest.mark.parametrize("kind", KINDS)
def test_errors_survive_pickling_with_all_attributes(kind: type[PlacewiseError]) -> None:
    error = kind("some_code", "Some detail.", limit=3, key="a")
    for back in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert type(back) is kind
        assert (back.code, back.detail, back.extra) == (error.code, error.detail, error.extra)
        assert str(back) == "Some detail."


@pytest.mark.parametrize("kind", KINDS)
def test_problem_has_the_members_of_rfc_9457(kind: type[PlacewiseError]) -> None:
    problem = kind("some_code", "Some detail.", limit=3).as_problem()
    assert problem == {
        "type": "urn:placewise:problem:some_code",
        "title": kind.title,
        "status": kind.status,
        "detail": "Some detail.",
        "code": "some_code",
        "limit": 3,
    }


def test_each_status_has_one_error_class() -> None:
    statuses = sorted(kind.status for kind in KINDS if kind.status != 500)
    assert statuses == [400, 401, 403, 404, 408, 409, 410, 413, 415, 422, 429, 503, 507]


def test_invalid_field_names_the_field_for_people_and_for_programs() -> None:
    error = invalid_field_error("latitude", "is missing")
    assert isinstance(error, Unprocessable)
    assert error.detail == "latitude: is missing"
    assert error.extra["errors"] == [{"field": "latitude", "detail": "is missing"}]
