"""A request changes threads only where it may block: each change waits for a busy machine."""

from __future__ import annotations

import inspect

from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute

from services.gateway.admission import ADMIT_JOB, ADMIT_QUERY
from services.gateway.routes.uploads import router as uploads_router

# They read the catalog or the disk at times.
MAY_BLOCK = {ADMIT_JOB.dependency, ADMIT_QUERY.dependency}


def test_dependencies_of_an_upload_that_do_not_block_run_on_the_event_loop() -> None:
    (route,) = (route for route in uploads_router.routes if isinstance(route, APIRoute))
    sync = {
        call
        for dependant in _all_dependants(route.dependant)
        if (call := dependant.call) is not None
        and inspect.isfunction(call)
        and not inspect.iscoroutinefunction(call)
        and not inspect.isasyncgenfunction(call)
    }
    assert sync <= MAY_BLOCK


def _all_dependants(dependant: Dependant) -> list[Dependant]:
    return [
        dependant,
        *(below for child in dependant.dependencies for below in _all_dependants(child)),
    ]
