"""JSON bodies: the caller's rights and the map are checked before one is read."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import Request, Response
from fastapi.params import Security as SecurityParameter
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool

from services.gateway.authentication import check_scopes
from services.gateway.dependencies import GatewayContext, MapParams, get_map_name
from shared.catalog.maps import get_map


class JsonRoute(APIRoute):
    """A route that reads a body only for a caller with its scope, and for a map that exists.

    FastAPI itself reads and parses the body before it runs the dependencies.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()
        scopes = [
            scope
            for dependency in self.dependencies
            if isinstance(dependency, SecurityParameter)
            for scope in dependency.scopes or ()
        ]
        has_body = self.body_field is not None
        uses_map = any(
            isinstance(annotation := field.field_info.annotation, type)
            and issubclass(annotation, MapParams)
            for field in self.dependant.query_params
        )

        async def check_and_handle(request: Request) -> Response:
            if has_body:
                check_scopes(request, scopes)
                if uses_map:
                    await run_in_threadpool(_check_map, request)
            return await handle(request)

        return check_and_handle


def _check_map(request: Request) -> None:
    gateway: GatewayContext = request.app.state.gateway
    with gateway.catalog.read() as session:
        get_map(session, get_map_name(request))
