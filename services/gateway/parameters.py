"""A misspelt parameter is refused: as a filter it would silently let everything pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fastapi import Request
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute

from shared.errors import invalid_field_error

# Clients send it with every call, also with the few that mean no map.
ALWAYS_ALLOWED = frozenset({"map"})

# By function and method: to describe a call takes some ten milliseconds.
_documented_by_route: dict[tuple[Callable[..., Any], str], frozenset[str] | None] = {}


async def reject_unknown_query_parameters(request: Request) -> None:
    """422 (`invalid_field_error`) names a query parameter that the call's description does not."""
    if not request.query_params:
        return
    route: APIRoute = request.scope["route"]
    call = route.endpoint, request.method.lower()
    if call not in _documented_by_route:
        _documented_by_route[call] = _documented_parameters(route, request.method.lower())
    known = _documented_by_route[call]
    if known is None:  # such as HEAD, which the description leaves out
        return
    for name in request.query_params:
        if name not in known:
            raise invalid_field_error(name, f"is unknown; known are {', '.join(sorted(known))}")


def _documented_parameters(route: APIRoute, method: str) -> frozenset[str] | None:
    """What the route takes after the question mark; None for a method without a description."""
    described = get_openapi(title="", version="", routes=[route])["paths"]
    call = described.get(route.path_format, {}).get(method)
    if call is None:
        return None
    return ALWAYS_ALLOWED | {
        parameter["name"] for parameter in call.get("parameters", ()) if parameter["in"] == "query"
    }
