"""A misspelt parameter is refused: as a filter it would silently let everything pass."""

from __future__ import annotations

from typing import Any

from fastapi import Request

from services.gateway.context import API
from shared.errors import invalid_field

# Clients send it with every call, also with the few that mean no map.
EVERYWHERE = {"map"}


def no_unknown_parameters(request: Request) -> None:
    """422 (`invalid_field`) names a query parameter that the call's description does not."""
    if not request.query_params:
        return
    paths: dict[str, Any] = request.app.openapi()["paths"]
    path = API + request.scope["route"].path_format  # a route knows nothing of its prefix
    call = paths.get(path, {}).get(request.method.lower())
    if call is None:  # such as HEAD, which the description leaves out
        return
    known = EVERYWHERE | {
        parameter["name"] for parameter in call.get("parameters", ()) if parameter["in"] == "query"
    }
    for name in request.query_params:
        if name not in known:
            raise invalid_field(name, f"is unknown; known are {', '.join(sorted(known))}")
