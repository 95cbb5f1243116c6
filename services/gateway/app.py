"""Application factory: registers the middleware, exception handlers and routers of the gateway."""

from __future__ import annotations

import functools
import re

from fastapi import APIRouter, FastAPI
from fastapi.middleware.cors import CORSMiddleware
from fastapi.routing import APIRoute

from services.gateway import metrics
from services.gateway.admission import AdmissionControl
from services.gateway.authentication import READ, AuthenticationMiddleware
from services.gateway.dependencies import ALL_MAPS, API_PREFIX, NO_REPEATS, GatewayContext
from services.gateway.idempotency import IdempotentReplay, replay_response
from services.gateway.metrics import GatewayMetrics
from services.gateway.middleware import (
    BodySizeLimitMiddleware,
    ExceptionHandlerMiddleware,
    SecurityHeadersMiddleware,
)
from services.gateway.rate_limits import RateLimiter, RateLimitMiddleware
from services.gateway.routes import (
    batches,
    evaluations,
    export,
    health,
    jobs,
    keys,
    library_syncs,
    maps,
    model_changes,
    models,
    photos,
    places,
    positions,
    reconstructions,
    similarity,
    stats,
    tracks,
    uploads,
    webhooks,
)
from services.gateway.similarity.geopose import MAX_GEOPOSE_BYTES
from services.gateway.web_page import add_web_page
from services.request_log import RequestLogMiddleware
from shared.http.problem_details import (
    AUTHENTICATION_RESPONSES,
    PROBLEM_RESPONSES,
    install_exception_handlers,
)
from shared.ingest.store_photo import PhotoQuota

DESCRIPTION = """Visual place recognition over HTTP. Upload geotagged photos, poll their jobs, and
find out which known place a photo shows. Errors are RFC 9457 problems with a stable `code`."""

# Response headers that scripts of the allowed origins may read (CORS).
CORS_EXPOSED_HEADERS = (
    "Idempotent-Replayed",
    "Location",
    "Preference-Applied",
    "RateLimit",
    "RateLimit-Policy",
    "Retry-After",
    "X-Request-ID",
)


# In the order of the API's description.
RESOURCES = (
    maps,
    uploads,
    batches,
    library_syncs,
    jobs,
    similarity,
    tracks,
    photos,
    places,
    positions,
    model_changes,
    models,
    evaluations,
    reconstructions,
    export,
    stats,
    keys,
    webhooks,
    health,
)


def create_app(gateway: GatewayContext) -> FastAPI:
    """Create the FastAPI application that uses the stores and clients of `gateway`."""
    app = FastAPI(
        title="Placewise",
        version=health.VERSION,
        description=DESCRIPTION,
        responses=PROBLEM_RESPONSES,
        routes=_create_router().routes,
        docs_url=None,  # web_page.py serves both without a CDN
        redoc_url=None,
    )
    app.state.gateway = gateway
    app.state.admission = AdmissionControl(gateway.catalog, gateway.settings)
    app.state.photo_quota = PhotoQuota(gateway.catalog)
    gateway_metrics = GatewayMetrics(gateway, app.state.admission)
    # Starlette runs the middleware that is added last first.
    app.add_middleware(
        BodySizeLimitMiddleware,
        form_paths=form_paths(),
        limits={
            f"{API_PREFIX}{places.PROPOSALS_PATH}": positions.MAX_BODY_BYTES,
            f"{API_PREFIX}{positions.POSITIONS_PATH}": positions.MAX_BODY_BYTES,
            f"{API_PREFIX}{reconstructions.IMPORT_PATH}": reconstructions.MAX_MODEL_BYTES,
            f"{API_PREFIX}{similarity.GEOPOSE_PATH}": MAX_GEOPOSE_BYTES,
        },
    )
    app.add_middleware(RateLimitMiddleware, limiter=RateLimiter(gateway.settings))
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
        on_start=gateway_metrics.on_request_start,
        on_end=gateway_metrics.on_request_end,
    )
    install_exception_handlers(app)
    app.add_exception_handler(IdempotentReplay, replay_response)
    add_web_page(app, gateway.settings, gateway.lan_url)
    return app


@functools.cache
def _create_router() -> APIRouter:
    """Create the router of all routes but the page's.

    All applications of a process share it: FastAPI derives the parameters of each route at its
    first call, in a tenth of a second for all of them.
    """
    # The id of an operation is the name of its function, unless a route has another one.
    router = APIRouter(
        responses=PROBLEM_RESPONSES,
        generate_unique_id_function=lambda route: route.name,
        dependencies=[NO_REPEATS],
    )
    for module in RESOURCES:
        router.include_router(module.router, prefix=API_PREFIX, responses=AUTHENTICATION_RESPONSES)
    router.include_router(health.probe_router)
    router.include_router(
        metrics.router, responses=AUTHENTICATION_RESPONSES, dependencies=[READ, ALL_MAPS]
    )
    return router


def form_paths() -> re.Pattern[str]:
    """Match the paths of the routes that parse a multipart body as it arrives, and limit it."""
    forms = [
        API_PREFIX + re.sub(r"\{\w+\}", "[^/]+", route.path)
        for module in RESOURCES
        for route in module.router.routes
        if isinstance(route, APIRoute) and "multipart/form-data" in str(route.openapi_extra)
    ]
    return re.compile("|".join(forms))
