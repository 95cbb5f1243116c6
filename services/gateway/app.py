"""The application: every router, every problem handler, one gateway."""

from __future__ import annotations

from fastapi import Depends, FastAPI
from fastapi.middleware.cors import CORSMiddleware

from services.call_log import RequestLogMiddleware
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
from services.gateway.answer_headers import SecurityHeadersMiddleware
from services.gateway.body_limit import BodySizeLimitMiddleware
from services.gateway.context import API_PREFIX, GatewayContext
from services.gateway.key_check import READ, AuthenticationMiddleware, check_declared_scopes
from services.gateway.last_resort import ExceptionHandlerMiddleware
from services.gateway.metrics import GatewayMetrics
from services.gateway.once import IdempotentReplay, replay_response
from services.gateway.parameters import reject_unknown_query_parameters
from services.gateway.quotas import RateLimiter, RateLimitMiddleware
from services.gateway.room import AdmissionControl
from shared.intake.photo_quota import PhotoQuota
from shared.problems import AUTHENTICATION_RESPONSES, PROBLEM_RESPONSES, install_exception_handlers

DESCRIPTION = """Photo in, place out. Upload geotagged photos, poll their jobs, and ask which known
place a photo shows. Every error is an RFC 9457 problem with a stable `code`."""

# What a trusted page's script may read of an answer, beside its body.
CORS_EXPOSED_HEADERS = (
    "Idempotent-Replayed",
    "Location",
    "Preference-Applied",
    "RateLimit",
    "RateLimit-Policy",
    "Retry-After",
    "X-Request-ID",
)


def create_app(gateway: GatewayContext) -> FastAPI:
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
    app.state.room = AdmissionControl(gateway.catalog, gateway.settings)
    app.state.quotas = RateLimiter(gateway.settings)
    app.state.photo_quota = PhotoQuota(gateway.catalog)
    figures_of_calls = GatewayMetrics(gateway, app.state.room)
    # The last one added is the first one asked.
    app.add_middleware(
        BodySizeLimitMiddleware, exempt_paths={f"{API_PREFIX}{batches.BATCH_UPLOAD_PATH}"}
    )
    app.add_middleware(RateLimitMiddleware, limiter=app.state.quotas)
    app.add_middleware(AuthenticationMiddleware, authenticator=gateway.authenticator)
    app.add_middleware(ExceptionHandlerMiddleware)
    if gateway.settings.allowed_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=gateway.settings.allowed_origins,
            allow_methods=["GET", "HEAD", "POST", "PATCH", "DELETE"],
            allow_headers=["Authorization", "Content-Type", "Idempotency-Key", "Prefer"],
            expose_headers=CORS_EXPOSED_HEADERS,
        )
    app.add_middleware(SecurityHeadersMiddleware, settings=gateway.settings)
    app.add_middleware(
        RequestLogMiddleware,
        on_start=figures_of_calls.on_request_start,
        on_end=figures_of_calls.on_request_end,
    )
    install_exception_handlers(app)
    app.add_exception_handler(IdempotentReplay, replay_response)
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
        check_declared_scopes(module.router)
        app.include_router(
            module.router,
            prefix=API_PREFIX,
            responses=AUTHENTICATION_RESPONSES,
            dependencies=[Depends(reject_unknown_query_parameters)],
        )
    app.include_router(health.probe_router)
    app.include_router(metrics.router, responses=AUTHENTICATION_RESPONSES, dependencies=[READ])
    app.include_router(console.create_web_page_router(gateway.settings))
    return app
