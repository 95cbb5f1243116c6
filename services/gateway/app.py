"""The application: every router, every problem handler, one gateway."""

from __future__ import annotations

from fastapi import Depends, FastAPI
from fastapi.middleware.cors import CORSMiddleware

from services.call_log import CallLog
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
    key_calls,
    maps,
    metrics,
    model_changes,
    models,
    photos,
    similarity,
    upload,
    webhook_calls,
    word_weights,
)
from services.gateway.answer_headers import AnswerHeaders
from services.gateway.body_limit import BodyLimit
from services.gateway.context import API, Gateway
from services.gateway.key_check import READ, KeyCheck, check_scopes
from services.gateway.last_resort import LastResort
from services.gateway.metrics import GatewayMetrics
from services.gateway.once import Replay, answer_again
from services.gateway.parameters import no_unknown_parameters
from services.gateway.quotas import Metered, Quotas
from services.gateway.room import Room
from shared.intake.photo_quota import PhotoQuota
from shared.problems import KEY_RESPONSES, PROBLEM_RESPONSES, install_problem_handlers

DESCRIPTION = """Photo in, place out. Upload geotagged photos, poll their jobs, and ask which known
place a photo shows. Every error is an RFC 9457 problem with a stable `code`."""

# What a trusted page's script may read of an answer, beside its body.
EXPOSED = (
    "Idempotent-Replayed",
    "Location",
    "Preference-Applied",
    "RateLimit",
    "RateLimit-Policy",
    "Retry-After",
    "X-Request-ID",
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
    app.state.quotas = Quotas(gateway.settings)
    app.state.photo_quota = PhotoQuota(gateway.catalog)
    figures_of_calls = GatewayMetrics(gateway, app.state.room)
    # The last one added is the first one asked.
    app.add_middleware(BodyLimit, streamed={f"{API}{batches.PATH}"})
    app.add_middleware(Metered, quotas=app.state.quotas)
    app.add_middleware(KeyCheck, keys=gateway.keys)
    app.add_middleware(LastResort)
    if gateway.settings.trusted_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=gateway.settings.trusted_origins,
            allow_methods=["GET", "HEAD", "POST", "PATCH", "DELETE"],
            allow_headers=["Authorization", "Content-Type", "Idempotency-Key", "Prefer"],
            expose_headers=EXPOSED,
        )
    app.add_middleware(AnswerHeaders, settings=gateway.settings)
    app.add_middleware(CallLog, on_begin=figures_of_calls.begun, on_end=figures_of_calls.ended)
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
        models,
        evaluations,
        word_weights,
        export,
        history,
        figures,
        key_calls,
        webhook_calls,
        health,
    ):
        check_scopes(module.router)
        app.include_router(
            module.router,
            prefix=API,
            responses=KEY_RESPONSES,
            dependencies=[Depends(no_unknown_parameters)],
        )
    app.include_router(health.probes)
    app.include_router(metrics.router, responses=KEY_RESPONSES, dependencies=[READ])
    app.include_router(console.console_router(gateway.settings))
    return app
