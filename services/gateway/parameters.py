"""A misspelt parameter is refused: as a filter it would silently let everything pass."""

from __future__ import annotations

from fastapi import Request
from fastapi.dependencies.utils import get_flat_dependant
from fastapi.routing import APIRoute

from shared.errors import invalid_field

# Clients send it with every call, also with the few that mean no map.
EVERYWHERE = {"map"}


def no_unknown_parameters(request: Request) -> None:
    """422 (`invalid_field`) names a query parameter that the call does not know."""
    route = request.scope["route"]
    assert isinstance(route, APIRoute), "every call under the prefix is one"
    known = EVERYWHERE | {
        parameter.alias for parameter in get_flat_dependant(route.dependant).query_params
    }
    for name in request.query_params:
        if name not in known:
            raise invalid_field(name, f"is unknown; known are {', '.join(sorted(known))}")
