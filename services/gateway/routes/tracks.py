"""Routes of tracks: begin one, add its frames, read its states, delete it."""

from __future__ import annotations

import contextlib
import time
from datetime import timedelta
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import JSONResponse
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from services.gateway.admission import (
    ADMIT_QUERY,
    CHECK_DISK,
    CHECK_PHOTO_QUOTA,
    AdmissionDep,
    reserve_photo_quota,
)
from services.gateway.authentication import READ, WRITE, get_caller
from services.gateway.dependencies import (
    FrameId,
    GatewayContext,
    GatewayDep,
    MapParams,
    MapQuery,
    PageQuery,
    TrackId,
    parse_prefer_wait,
    wait_for_job,
)
from services.gateway.idempotency import IdempotentDep, IdempotentFormDep, IdempotentRequest
from services.gateway.responses import accepted_headers, job_url, url_in_map
from services.gateway.similarity.search_params import SearchParams
from services.gateway.tracks.apply_frames import apply_pending_frames, smooth_states
from services.gateway.tracks.schemas import FRAME_FIELDS, FrameForm, TrackParams
from services.gateway.uploads.multipart import FormFile, multipart_schema, parse_form
from services.gateway.uploads.query_photo import describe_query_job, receive_query_photo
from shared.catalog.database.base import insert_row
from shared.catalog.database.session import Catalog
from shared.catalog.jobs import QUERY_TTL_SECONDS
from shared.catalog.maps import get_map
from shared.catalog.reconstructions import gives_coordinates
from shared.catalog.tracks import (
    MAX_SMOOTHED_FRAMES,
    RETENTION_DAYS,
    Track,
    TrackFrame,
    add_frame,
    delete_tracks,
    get_frame,
    get_track,
    latest_states,
    select_frames,
)
from shared.errors import Conflict
from shared.imaging.photo_header import read_photo_header
from shared.jobs.wakeups import JobMessage
from shared.responses import ResponseModel
from shared.responses.tracks import (
    DeletedTrackResponse,
    TrackDetailResponse,
    TrackFrameResponse,
    TrackResponse,
    TrackStateResponse,
)

router = APIRouter(tags=["tracks"])

APPLY_SECONDS = 5.0  # of one read; frames that remain pending are applied by the next one


class TracksResponse(ResponseModel):
    tracks: list[TrackResponse]
    next_cursor: str | None


class TrackReadParams(MapParams):
    smoothed: bool = Field(
        False,
        description="Return the states given all frames, also the later ones (forward-backward), "
        "instead of the states that were known at each frame.",
    )


FRAME_PENDING: dict[int | str, dict[str, Any]] = {
    202: {
        "model": TrackFrameResponse,
        "description": "The frame is stored, but not applied yet. Poll `frame_url`.",
    }
}


@router.post("/tracks", status_code=201, dependencies=[READ, CHECK_DISK])
def begin_track(
    request: Request,
    gateway: GatewayDep,
    idempotent: IdempotentDep,
    query: MapQuery,
    body: TrackParams,
) -> TrackResponse:
    """Begin a track in the map. Then add frames in the order of their times."""
    with reserve_photo_quota(request, gateway.settings), gateway.catalog.write() as session:
        track = Track(
            map_id=get_map(session, query.map).id,
            params=body.model_dump(mode="json", exclude_none=True),
            key_id=get_caller(request).key_id,
        )
        session.refresh(insert_row(session, track))
        response = TrackResponse.of_row(track, **_track_fields(track, None))
        idempotent.store_response(session, 201, response)
    return response


@router.get("/tracks", dependencies=[READ])
def list_tracks(gateway: GatewayDep, page: PageQuery) -> TracksResponse:
    """List the tracks of the map, newest first, each with the state of its last applied frame."""
    with gateway.catalog.read() as session:
        is_of_map = Track.map_id == get_map(session, page.map).id
        tracks, next_cursor = page.read(session, Track, is_of_map)
        last = latest_states(session, [track.id for track in tracks])
    responses = [
        TrackResponse.of_row(each, **_track_fields(each, last.get(each.id))) for each in tracks
    ]
    return TracksResponse(tracks=responses, next_cursor=next_cursor)


@router.get(
    "/tracks/{track_id}",
    operation_id="get_track",
    response_model=TrackDetailResponse,
    dependencies=[READ],
)
async def read_track(
    request: Request,
    gateway: GatewayDep,
    admission: AdmissionDep,
    track_id: TrackId,
    query: Annotated[TrackReadParams, Query()],
) -> Any:
    """Get a track with all frames; `smoothed=true` also uses the later frames for each state.

    Frames whose photos have been described since are applied first. `pending` counts those that
    remain. 409 (`track_too_long`) if more than 3,000 frames are to be smoothed. A gateway smooths
    one track of a caller at a time, and two of all (429, `too_many_smoothed_tracks`, beyond).
    """
    limit = admission.smoothed_tracks.hold(request) if query.smoothed else contextlib.nullcontext()
    with limit:
        return await run_in_threadpool(_read_track, gateway, track_id, query)


def _read_track(gateway: GatewayContext, track_id: UUID, query: TrackReadParams) -> Response:
    _check_track(gateway.catalog, query.map, track_id)
    apply_pending_frames(gateway, track_id, APPLY_SECONDS)
    with gateway.catalog.read() as session:
        track = get_track(session, get_map(session, query.map).id, track_id)
        if query.smoothed and track.version > MAX_SMOOTHED_FRAMES:
            raise Conflict(
                "track_too_long",
                f"The track has {track.version} frames; up to {MAX_SMOOTHED_FRAMES} can be "
                "smoothed. Read it without `smoothed`.",
            )
        frames = list(session.scalars(select_frames(track_id, with_evidence=query.smoothed)))
    last = next((frame for frame in reversed(frames) if frame.state is not None), None)
    smoothed = smooth_states(gateway, track, frames) if query.smoothed else {}
    body = TrackDetailResponse.of_row(
        track,
        **_track_fields(track, last),
        smoothed=query.smoothed,
        frames=[_frame_response(frame, query.map, smoothed.get(frame.id)) for frame in frames],
    )
    # Not by FastAPI, which would serialize up to 10,000 frames on the event loop.
    return Response(body.model_dump_json(), media_type="application/json")


@router.delete("/tracks/{track_id}", dependencies=[WRITE])
def delete_track(gateway: GatewayDep, track_id: TrackId, query: MapQuery) -> DeletedTrackResponse:
    """Delete a track with its frames."""
    with gateway.catalog.write() as session:
        get_track(session, get_map(session, query.map).id, track_id, lock=True)
        delete_tracks(session, Track.id == track_id)
    return DeletedTrackResponse(
        success=True, message="The track is deleted.", deleted_track_id=track_id
    )


@router.post(
    "/tracks/{track_id}/frames",
    response_model=TrackFrameResponse,
    responses=FRAME_PENDING,
    openapi_extra=multipart_schema("the frame's photo", ["captured_at"], **FRAME_FIELDS),
    dependencies=[READ, CHECK_PHOTO_QUOTA, CHECK_DISK, ADMIT_QUERY],
)
async def add_track_frame(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    idempotent: IdempotentFormDep,
    admission: AdmissionDep,
    track_id: TrackId,
    query: MapQuery,
) -> Any:
    """Add a frame to a track: a photo with its time, and optionally odometry or a GPS fix.

    The response is 202 once the frame is stored: poll `frame_url`. With `Prefer: wait=N` it is 200
    with the state if that takes at most N seconds. The same photo with the same time again is the
    same frame. The photo is not added to the map, and is deleted once it is described.

    A frame may arrive late: it is inserted by its time, and the states of up to 50 later frames
    are computed again (409, `frame_too_late`, beyond).
    """
    await run_in_threadpool(_check_track, gateway.catalog, query.map, track_id)
    async with receive_query_photo(request, gateway, admission) as (job_id, file):
        frame = await run_in_threadpool(
            _accept_frame, request, gateway, query.map, track_id, job_id, file, idempotent
        )
    wait = parse_prefer_wait(request)
    if wait:
        response.headers["Preference-Applied"] = f"wait={wait:g}"
    return await _wait_until_applied(gateway, response, query.map, track_id, frame.id, wait)


@router.get(
    "/tracks/{track_id}/frames/{frame_id}",
    response_model=TrackFrameResponse,
    responses=FRAME_PENDING,
    dependencies=[READ],
)
async def get_track_frame(
    request: Request,
    response: Response,
    gateway: GatewayDep,
    track_id: TrackId,
    frame_id: FrameId,
    query: MapQuery,
) -> Any:
    """Get a frame; 202 while it is pending. `Prefer: wait=N` waits until it is applied."""
    await run_in_threadpool(_check_track, gateway.catalog, query.map, track_id)
    await run_in_threadpool(apply_pending_frames, gateway, track_id, APPLY_SECONDS)
    wait = parse_prefer_wait(request)
    return await _wait_until_applied(gateway, response, query.map, track_id, frame_id, wait)


def _check_track(catalog: Catalog, map_name: str, track_id: UUID) -> None:
    """Raise NotFound before the body of a request is read."""
    with catalog.read() as session:
        get_track(session, get_map(session, map_name).id, track_id)


def _accept_frame(
    request: Request,
    gateway: GatewayContext,
    map_name: str,
    track_id: UUID,
    job_id: UUID,
    file: FormFile,
    idempotent: IdempotentRequest,
) -> TrackFrame:
    """Store the frame with its job, or return the frame that it repeats."""
    received = file.complete()
    with idempotent.begin_form(received, QUERY_TTL_SECONDS):
        form = parse_form(FrameForm, received.fields)
        with received.open(gateway.store) as photo:
            header = read_photo_header(photo, gateway.settings.max_image_pixels)
        with reserve_photo_quota(request, gateway.settings), gateway.catalog.write() as session:
            track = get_track(session, get_map(session, map_name).id, track_id, lock=True)
            frame = TrackFrame(
                track_id=track.id,
                captured_at=form.captured_at,
                job_id=job_id,
                filename=received.filename,
                sha256=received.sha256,
                measurements=form.model_dump(
                    mode="json", exclude={"expected_version"}, exclude_none=True
                ),
                key_id=get_caller(request).key_id,
            )
            stored = add_frame(session, track, frame, form.expected_version)
            if stored is frame:
                # A pose without coordinates says nothing to the filter.
                posed = SearchParams(matches=0, pose=gives_coordinates(session, track.map_id))
                job = describe_query_job(job_id, track.map_id, received.filename, posed, header)
                session.add(job)
            response = _frame_response(stored, map_name)
            headers = accepted_headers(response.frame_url)
            idempotent.store_response(session, 202, response, headers)
    if stored is frame:
        gateway.wakeups.send(JobMessage.of(job, map_name))
    else:
        gateway.store.delete(received.key)
    return stored


async def _wait_until_applied(
    gateway: GatewayContext,
    response: Response,
    map_name: str,
    track_id: UUID,
    frame_id: UUID,
    wait_seconds: float,
) -> TrackFrameResponse | JSONResponse:
    """Apply frames until this one is applied; 202 when time is up."""

    def load() -> TrackFrame:
        with gateway.catalog.read() as session:
            return get_frame(session, track_id, frame_id)

    deadline = time.monotonic() + wait_seconds
    while True:
        frame = await run_in_threadpool(load)
        remaining = deadline - time.monotonic()
        body = _frame_response(frame, map_name)
        if not frame.pending:
            return body
        if remaining <= 0:
            headers = {**response.headers, **accepted_headers(body.frame_url)}
            # An explicit response, because the response model of the route is that of the 200.
            return JSONResponse(body.model_dump(mode="json"), 202, headers)
        job_id = await run_in_threadpool(apply_pending_frames, gateway, track_id, remaining)
        remaining = deadline - time.monotonic()
        if job_id is not None and remaining > 0:
            await wait_for_job(gateway, job_id, remaining)


def _track_fields(track: Track, last: TrackFrame | None) -> dict[str, Any]:
    """Return the fields of `TrackResponse` that are not the row's; `last` is the last applied."""
    params = TrackParams.model_validate(track.params)
    return {
        "track_id": track.id,
        "motion": params.motion,
        "max_speed_mps": params.max_speed_mps,
        "pending": track.version - track.revision,
        "state": None if last is None else last.state,
        "expires_at": track.updated_at + timedelta(days=RETENTION_DAYS),
    }


def _frame_response(
    frame: TrackFrame, map_name: str, smoothed: TrackStateResponse | None = None
) -> TrackFrameResponse:
    return TrackFrameResponse.of_row(
        frame,
        frame_id=frame.id,
        status="pending" if frame.pending else "failed" if frame.state is None else "applied",
        state=smoothed or frame.state,
        job_url=job_url(frame.job_id, map_name),
        frame_url=url_in_map(f"/tracks/{frame.track_id}/frames/{frame.id}", map_name),
    )
