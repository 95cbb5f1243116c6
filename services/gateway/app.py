"""The application: every router, every problem handler, one gateway."""

from __future__ import annotations

from fastapi import Depends, FastAPI, Security
from fastapi.security import HTTPBearer

from services.gateway import (
    batches,
    console,
    direct_upload,
    evaluations,
    export,
    figures,
    health,
    history,
    jobs,
    maps,
    model_changes,
    photos,
    similarity,
    upload,
    word_weights,
)
from services.gateway.body_limit import BodyLimit
from services.gateway.context import API, Gateway
from services.gateway.key_check import KeyCheck
from services.gateway.once import Replay, answer_again
from services.gateway.parameters import no_unknown_parameters
from services.gateway.room import Room
from shared.problems import PROBLEM_RESPONSES, install_problem_handlers

DESCRIPTION = """Photo in, place out. Upload geotagged photos, poll their jobs, and ask which known
place a photo shows. Every error is an RFC 9457 problem with a stable `code`."""

# Only describes: `KeyCheck` is what asks for the key, before a route is looked for.
BEARER = HTTPBearer(
    auto_error=False,
    scheme_name="key",
    description="The admin key. A server on loopback without an ADMIN_KEY needs none.",
)


def create_app(gateway: Gateway) -> FastAPI:
    """The HTTP API on the given ports."""
    app = FastAPI(
        title="Placewise",
        version=health.VERSION,
        description=DESCRIPTION,
        responses=PROBLEM_RESPONSES,
        docs_url=None,  # console.py has pages that need no other server
        redoc_url=None,
    )
    app.state.gateway = gateway
    app.state.room = Room(gateway.catalog, gateway.settings)
    app.add_middleware(BodyLimit, streamed={f"{API}{batches.PATH}"})
    app.add_middleware(KeyCheck, keys=gateway.keys)  # the last one added is the first one asked
    install_problem_handlers(app)
    app.add_exception_handler(Replay, answer_again)
    for module in (
        maps,
        upload,
        batches,
        direct_upload,
        jobs,
        similarity,
        photos,
        model_changes,
        evaluations,
        word_weights,
        export,
        history,
        figures,
        health,
    ):
        app.include_router(
            module.router,
            prefix=API,
            dependencies=[Security(BEARER), Depends(no_unknown_parameters)],
        )
    app.include_router(health.probes)
    app.include_router(console.console_router(gateway.settings))
    return app
