"""Routes of reconstructions: make one of the map's photos or of a COLMAP model, read, export it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any
from uuid import UUID

from fastapi import APIRouter
from fastapi.responses import StreamingResponse
from pydantic import Field
from sqlalchemy import select
from sqlalchemy.orm import Session

from services.gateway.admission import ADMIT_JOB
from services.gateway.authentication import READ, WRITE
from services.gateway.dependencies import GatewayContext, GatewayDep, MapQuery, ReconstructionId
from services.gateway.idempotency import IdempotentDep, IdempotentRequest
from services.gateway.responses import JobAcceptedResponse, describe_tar, tar_response
from shared.catalog.database.base import get_in_map
from shared.catalog.jobs import UNFINISHED_STATES
from shared.catalog.maps import get_map, lock_map
from shared.catalog.photos import Photo
from shared.catalog.reconstructions import (
    ReconstructedComponent,
    Reconstruction,
    check_reconstructable,
    get_reconstruction,
)
from shared.errors import Conflict, NotFound
from shared.geodesy import distance_m
from shared.geometry.colmap_model import ColmapModel, rename_images
from shared.http.request_model import RequestModel
from shared.jobs import Job, JobKind
from shared.jobs.wakeups import JobMessage
from shared.responses import ResponseModel
from shared.responses.reconstructions import (
    ComponentResponse,
    CoordinateProposalResponse,
    ReconstructionResponse,
)
from shared.storage.keys import new_checkpoint_key

router = APIRouter(tags=["reconstructions"])

IMPORT_PATH = "/reconstructions/import"
MAX_MODEL_BYTES = 16_000_000
"""Of cameras and poses as JSON; a pose takes about 300 bytes"""
COORDINATE_TOLERANCE_M = 0.02


class ReconstructRequest(RequestModel):
    from_scratch: bool = Field(
        False,
        description="Reconstruct all photos again. By default, new photos are registered into the "
        "map's reconstruction.",
    )


FIT = {"agreeing", "located", "is_on_line"}


def _component_response(component: ReconstructedComponent) -> ComponentResponse:
    alignment = component.alignment
    latitude, longitude, altitude = alignment.origin if alignment else (None, None, None)
    similarity = alignment.similarity if alignment else {}
    return ComponentResponse.of_row(
        component,
        latitude=latitude,
        longitude=longitude,
        altitude_m=altitude if similarity.get("knows_altitude") else None,
        metres_per_unit=similarity.get("scale"),
        alignment_rms_m=alignment and alignment.rms_m,
        **(alignment.model_dump(include=FIT) if alignment else dict.fromkeys(FIT)),
    )


class CoordinateProposalsResponse(ResponseModel):
    proposals: list[CoordinateProposalResponse] = Field(description="largest distance first")


@router.post("/reconstructions", status_code=202, dependencies=[WRITE, ADMIT_JOB])
def reconstruct(
    gateway: GatewayDep,
    idempotent: IdempotentDep,
    query: MapQuery,
    options: ReconstructRequest | None = None,
) -> JobAcceptedResponse:
    """Reconstruct the map's photos: poses of their cameras, and points in space.

    Each component, photos that were reconstructed together, is aligned to the coordinates of its
    photos. Queries with `pose=true` then have a pose. The job's `result` counts photos and
    components, and lists photos in no component with the reasons (`left_out_photos`). A job that is
    interrupted continues from its last step.
    """
    from_scratch = options is not None and options.from_scratch
    return _queue(
        gateway, query.map, idempotent, {"object_key": None, "from_scratch": from_scratch}
    )


@router.post(IMPORT_PATH, status_code=202, dependencies=[WRITE, ADMIT_JOB])
def import_reconstruction(
    gateway: GatewayDep, idempotent: IdempotentDep, query: MapQuery, model: ColmapModel
) -> JobAcceptedResponse:
    """Use the cameras and poses of an existing COLMAP model, such as hloc's, for the map's photos.

    Upload its images first. Each name in the model is compared with the path and the file name of
    the photos; the job's `result` lists the names that no photo or several photos have. Points are
    triangulated from the map's local features.
    """
    key = new_checkpoint_key()
    gateway.store.put(key, model.model_dump_json().encode())
    return _queue(gateway, query.map, idempotent, {"object_key": key, "from_scratch": True})


def _queue(
    gateway: GatewayContext, map_name: str, idempotent: IdempotentRequest, params: dict[str, Any]
) -> JobAcceptedResponse:
    with gateway.catalog.write() as session:
        map_id = lock_map(session, get_map(session, map_name).id).id
        _check_not_running(session, map_id, map_name)
        check_reconstructable(session, map_id)
        job = Job(map_id=map_id, kind=JobKind.RECONSTRUCT, params=params)
        accepted = idempotent.accept_job(session, job)
    gateway.wakeups.send(JobMessage.of(job, map_name))
    return accepted


def _check_not_running(session: Session, map_id: UUID, map_name: str) -> None:
    running = session.scalar(
        select(Job.id).where(
            Job.map_id == map_id,
            Job.kind == JobKind.RECONSTRUCT,
            Job.state.in_(UNFINISHED_STATES),
        )
    )
    if running is not None:
        raise Conflict(
            "reconstruction_running",
            f"The map is being reconstructed already (job {running}). Wait for it, or cancel it: "
            f"POST /api/v1/jobs/{running}/cancel?map={map_name}.",
            job_id=str(running),
        )


@router.get("/reconstructions", operation_id="get_reconstruction", dependencies=[READ])
def read_reconstruction(gateway: GatewayDep, query: MapQuery) -> ReconstructionResponse:
    """Get the reconstruction in which queries of the map find their pose now.

    404 (`no_reconstruction`) if there is none, or if it is of other local features than the map
    has now.
    """
    with gateway.catalog.read() as session:
        found = get_reconstruction(session, get_map(session, query.map).id)
        return ReconstructionResponse.of_row(
            found,
            components=list(map(_component_response, found.list_components())),
            proposals=sum(not each.accepted for each in _list_proposals(session, found)),
        )


@router.get("/reconstructions/{reconstruction_id}/proposals", dependencies=[READ])
def list_coordinate_proposals(
    gateway: GatewayDep, reconstruction_id: ReconstructionId, query: MapQuery
) -> CoordinateProposalsResponse:
    """List the photos whose coordinates disagree with the reconstruction, with proposed ones.

    Nothing is changed: `PATCH /uploads/{file_id}` accepts one, and undoes that. A photo that has
    other coordinates by now is not listed.
    """
    with gateway.catalog.read() as session:
        found = _get_finished(session, query.map, reconstruction_id)
        return CoordinateProposalsResponse(proposals=_list_proposals(session, found))


def _list_proposals(
    session: Session, reconstruction: Reconstruction
) -> list[CoordinateProposalResponse]:
    by_id = {UUID(each["photo_id"]): each for each in reconstruction.proposals}
    photos = session.scalars(select(Photo).where(Photo.id.in_(by_id), Photo.deleted_at.is_(None)))
    found = []
    for photo in photos:
        proposal = by_id[photo.id]
        is_as_before, is_accepted = (
            photo.latitude is not None
            and photo.longitude is not None
            and distance_m(photo.latitude, photo.longitude, *place) < COORDINATE_TOLERANCE_M
            for place in (
                (proposal["latitude"], proposal["longitude"]),
                (proposal["proposed_latitude"], proposal["proposed_longitude"]),
            )
        )
        if is_as_before or is_accepted:
            found.append(
                CoordinateProposalResponse(
                    image_id=photo.id,
                    original_filename=photo.filename,
                    relative_path=photo.relative_path,
                    accepted=is_accepted,
                    **{name: value for name, value in proposal.items() if name != "photo_id"},
                )
            )
    return sorted(found, key=lambda each: -each.distance_m)


def _get_finished(session: Session, map_name: str, reconstruction_id: UUID) -> Reconstruction:
    map_id = get_map(session, map_name).id
    found = get_in_map(session, Reconstruction, map_id, reconstruction_id)
    if found.finished_at is None:
        raise NotFound(
            "reconstruction_not_found",
            f"The reconstruction {reconstruction_id} is still being made.",
            reconstruction_id=str(reconstruction_id),
        )
    return found


@router.get(
    "/reconstructions/{reconstruction_id}/colmap",
    dependencies=[READ],
    response_class=StreamingResponse,
    responses=describe_tar(
        "A tar with a folder for each component: `0/cameras.bin`, `0/images.bin`, "
        "`0/points3D.bin`, `0/frames.bin`, `0/rigs.bin`, `1/...`."
    ),
)
def export_colmap(
    gateway: GatewayDep, reconstruction_id: ReconstructionId, query: MapQuery
) -> StreamingResponse:
    """Download the COLMAP models of the components as a tar archive.

    Images have the path or the file name of their photo; where two photos share it, and for deleted
    photos, they have the photo's id.
    """
    with gateway.catalog.read() as session:
        found = _get_finished(session, query.map, reconstruction_id)
        of_map = select(Photo.id, Photo.relative_path, Photo.filename).where(
            Photo.map_id == found.map_id, Photo.deleted_at.is_(None)
        )
        names = {str(row[0]): row[1] or row[2] for row in session.execute(of_map)}
        keys = [key for key in found.list_object_keys(gateway.store) if key.endswith(".bin")]
        made_at = found.created_at
    shared = Counter(names.values())

    def image_name(photo_id: str) -> str:
        name = names.get(photo_id, photo_id)
        return name if shared[name] == 1 and name.isprintable() else photo_id

    def members() -> Iterator[tuple[str, int, list[bytes]]]:
        for key in sorted(keys):
            data = gateway.store.get(key)
            if key.endswith("/images.bin"):
                data = rename_images(data, image_name)
            yield "/".join(key.split("/")[-2:]), len(data), [data]

    return tar_response(f"reconstruction-{found.id}.tar", made_at, members())
