"""Answers of the API: bodies of those that succeed, and errors by RFC 9457 with a stable code."""

from __future__ import annotations

from typing import Any

import httpx2


def got(answer: httpx2.Response, status: int = 200) -> Any:
    """The body of an answer with this status."""
    assert answer.status_code == status, answer.text
    return answer.json()


def problem(answer: httpx2.Response, status: int, code: str) -> dict[str, Any]:
    """The problem document of a refusal, checked whole."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = answer.json()
    assert set(body) >= {"type", "title", "status", "detail", "code", "instance"}
    assert body["code"] == code, body
    assert body["type"] == f"urn:placewise:problem:{code}"
    assert body["status"] == status
    assert body["title"]
    assert body["detail"]
    assert body["instance"] == answer.request.url.path
    return body


def field_refused(answer: httpx2.Response, field: str) -> None:
    """The answer is a 422 that names the field, for people and for programs."""
    body = problem(answer, 422, "invalid_field")
    assert [error["field"] for error in body["errors"]] == [field], body
    assert field in body["detail"]
