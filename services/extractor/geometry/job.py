"""Job that reconstructs the photos of a map, step by step.

    match pairs ──> matches.npz ──> reconstruct ──> components ──> align, calibrate ──> finished row

Each step ends with what it stores: the matches as an object, the components as objects and in the
row of the reconstruction, the rest in the row alone. A job that was interrupted continues after the
last one. All but the reading runs in child processes of low priority.
"""

from __future__ import annotations

import hashlib
import sys
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.orm import Session

from services.extractor.child_process import run_in_child
from services.extractor.geometry.calibrate import (
    ComponentPhotos,
    calibrate_components,
    propose_coordinates,
)
from services.extractor.geometry.evidence import explain_left_out
from services.extractor.geometry.imported_models import import_model, match_names
from services.extractor.geometry.mapping import MappedComponent, map_photos
from services.extractor.geometry.matching import VerifiedMatches, match_pairs
from services.extractor.geometry.pairs import choose_pairs
from services.extractor.geometry.pycolmap_models import PhotoToMap, require_pycolmap
from services.extractor.handlers import ExtractorContext
from shared.catalog.chunks import Chunk, Descriptor
from shared.catalog.database.base import db_now
from shared.catalog.maps import Map, decide_label_paths
from shared.catalog.photos import Photo, PhotoRole
from shared.catalog.reconstructions import (
    MIN_PHOTOS,
    ComponentAlignment,
    ReconstructedComponent,
    Reconstruction,
    check_reconstructable,
    find_reconstruction,
)
from shared.errors import NotFound, Unprocessable
from shared.geometry.cameras import Floats, Rays, hash_camera_key
from shared.geometry.colmap_model import ColmapModel
from shared.geometry.component import Component
from shared.geometry.frames import GPS_SIGMA_M, Alignment, EastNorthUp, align, align_at, plane_at
from shared.geometry.radius import PoseCalibration
from shared.ids import new_id
from shared.imaging.photo_header import read_photo_header
from shared.jobs import Job
from shared.jobs.leases import lock_leased_job
from shared.jobs.progress import JobProgress
from shared.jobs.runner import JobInterrupted
from shared.jobs.transitions import succeed_job
from shared.matching.features import LocalFeatures
from shared.place_paths import label_levels
from shared.storage.chunks import features_key, read_chunk
from shared.storage.feature_files import read_feature_index, read_feature_rows
from shared.storage.keys import component_key, matches_key, reconstruction_prefix

PROGRESS_UNITS = 100
MATCHED, MAPPED = 40, 80  # units of progress after these steps
MAX_NAMES_REPORTED = 100  # photos in no component, names of an imported model without a photo
NOT_NAMED = "The imported model does not name them"
OTHER_SHAPE = "Their camera has another shape than the photo, or EXIF mirrors it"
ADDED_MEANWHILE = "They were added while the photos were matched"


@dataclass(frozen=True, slots=True, eq=False)
class MapPhoto:
    """A photo of the map with what the steps need of it."""

    row: Photo
    features: LocalFeatures
    descriptor: NDArray[np.floating[Any]]

    def to_map(self, position: Floats | None) -> PhotoToMap:
        size = self.features.width, self.features.height
        pixels = self.features.pixels().astype(np.float32)
        return PhotoToMap(self.row.id, *size, pixels, self.row.focal_length, position)


class ReconstructionJob:
    """One run of a claimed job; `run` continues after the step that the last run ended with."""

    def __init__(self, context: ExtractorContext, job: Job, stop: threading.Event) -> None:
        self._catalog, self._store = context.catalog, context.store
        self._job = job
        self._progress = JobProgress(context.catalog, job, stop, total=PROGRESS_UNITS)

    def run(self) -> None:
        """Reconstruct the map, and mark the job as succeeded.

        Raises:
            Misconfigured: `pose_missing` without the extra `pose`.
            Conflict: `too_few_photos`, `too_many_photos`, `no_local_features`.
            Unprocessable: `empty_model`: the photos have too few matches.
        """
        require_pycolmap()
        made = self._begin()
        photos = self._read_photos(made)
        result: dict[str, Any] = {"reconstruction_id": str(made.id), "photos": len(photos)}
        model, of_map = None, photos
        if self._job.params["object_key"] is not None:
            model, unmatched = self._read_model(photos)
            names = model.names()
            photos = {id_: photo for id_, photo in photos.items() if str(id_) in names}
            result |= {
                "unmatched": len(unmatched),
                "unmatched_names": unmatched[:MAX_NAMES_REPORTED],
            }
        matches = self._match(made, photos)
        to_map = [
            photo.to_map(position)
            for photo, position in zip(photos.values(), _positions(photos.values()), strict=True)
        ]
        components = self._load_components(made, photos)
        if components is None:
            made, components = self._map(made, photos, to_map, matches, model)
        if model is None:
            reasons = explain_left_out(to_map, matches)
        else:
            reasons = dict.fromkeys(of_map, NOT_NAMED) | dict.fromkeys(photos, OTHER_SHAPE)
        result |= _left_out_result(of_map, components, reasons)
        origin = EastNorthUp(*model.origin) if model and model.origin else None
        self._finish(made, components, photos, result, origin)

    def _begin(self) -> Reconstruction:
        """Return the reconstruction of an earlier run of the job, or a new one."""
        with self._catalog.write() as session:
            active, model = check_reconstructable(session, self._job.map_id)
            begun = session.scalar(
                select(Reconstruction).where(
                    Reconstruction.job_id == self._job.id,
                    Reconstruction.finished_at.is_(None),
                    Reconstruction.features_model == model,
                )
            )
            if begun is None:
                begun = Reconstruction(
                    id=new_id(),
                    map_id=self._job.map_id,
                    job_id=self._job.id,
                    generation_id=active.id,
                    map_version=session.get_one(Map, self._job.map_id).version,
                    features_model=model,
                    imported=self._job.params["object_key"] is not None,
                )
                session.add(begun)
                session.flush()
            return begun

    def _read_photos(self, made: Reconstruction) -> dict[UUID, MapPhoto]:
        """Read the searchable photos that have local features of the reconstruction's model."""
        self._progress.update(0, "pairs")
        chunks = (
            select(Chunk, Descriptor.row, Photo)
            .join(Descriptor, Descriptor.chunk_id == Chunk.id)
            .join(Photo, Photo.id == Descriptor.photo_id)
            .where(
                Descriptor.generation_id == made.generation_id,
                Chunk.features_model == made.features_model,
                Photo.deleted_at.is_(None),
                Photo.role == PhotoRole.DATABASE,
            )
            .order_by(Chunk.id, Descriptor.row)
        )
        with self._catalog.read() as session:
            located = session.execute(chunks).all()
        photos = {}
        for chunk, rows in groupby(located, lambda row: row[0]):
            self._progress.check()
            of_chunk = {row: photo for _, row, photo in rows}
            descriptors = read_chunk(self._store, chunk.object_key, chunk.sha256)
            key = features_key(chunk.object_key)
            index = read_feature_index(self._store, key)
            for row, data in read_feature_rows(self._store, key, index, of_chunk).items():
                photo = of_chunk[row]
                features = LocalFeatures.decode(data)
                photos[photo.id] = MapPhoto(photo, features, descriptors[row])
        return dict(sorted(photos.items()))

    def _match(self, made: Reconstruction, photos: dict[UUID, MapPhoto]) -> VerifiedMatches:
        """Match the photos, unless an earlier run has; pairs of the present model are known."""
        key = matches_key(made.id)
        if (stored := self._load_matches(key)) is not None:
            return stored
        current = self._find_extendable(photos)
        known = self._load_matches(matches_key(current.id)) if current else None
        pairs = choose_pairs(
            np.array([photo.descriptor for photo in photos.values()], np.float32),
            _seconds(photos.values()),
            *_coordinates([photo.row for photo in photos.values()]),
            self._read_sections(photos),
        )
        ids = list(photos)
        if known is not None:
            was_there = np.isin([str(id_) for id_ in ids], [str(id_) for id_ in known.photo_ids])
            pairs = pairs[~was_there[pairs].all(axis=1)]

        def report(done: int) -> None:
            self._progress.update(MATCHED * done // max(1, len(pairs)), "match")

        matches = run_in_child(
            match_pairs,
            {id_: photo.features for id_, photo in photos.items()},
            pairs,
            on_progress=report,
            check=self._progress.check,
        )
        if known is not None:
            matches = matches.joined(known)
        self._store.put(key, matches.encode())
        with self._catalog.write() as session:
            self._end_step(session)
        return matches

    def _read_sections(self, photos: dict[UUID, MapPhoto]) -> list[str | None]:
        """Return the level above the place label of each photo; None where there is none."""
        with self._catalog.read() as session:
            are_paths = decide_label_paths(session, session.get_one(Map, self._job.map_id))
        levels = (label_levels(photo.row.place, are_paths) for photo in photos.values())
        return [found[1] if len(found) > 1 else None for found in levels]

    def _load_matches(self, key: str) -> VerifiedMatches | None:
        try:
            return VerifiedMatches.decode(self._store.get(key))
        except NotFound:
            return None

    def _find_extendable(self, photos: dict[UUID, MapPhoto]) -> Reconstruction | None:
        """Return the reconstruction to extend by new photos; None to start from scratch.

        It can't be extended after one of its photos was deleted, or has got other keypoints.
        """
        if self._job.params["from_scratch"]:
            return None
        with self._catalog.read() as session:
            current = find_reconstruction(session, self._job.map_id)
        if current is None:
            return None
        for stored in current.list_components():
            component = Component.decode(self._store.get(stored.object_key))
            for id_, numbers in zip(component.photo_ids, component.point_numbers, strict=True):
                photo = photos.get(id_)
                if photo is None or len(photo.features.positions) != len(numbers):
                    return None
        return current

    def _map(
        self,
        made: Reconstruction,
        photos: dict[UUID, MapPhoto],
        to_map: list[PhotoToMap],
        matches: VerifiedMatches,
        model: ColmapModel | None,
    ) -> tuple[Reconstruction, list[Component]]:
        """Reconstruct, and store the components."""
        known: dict[UUID, Rays] = {}
        self._progress.update(MATCHED, "map")

        def report(tried: int) -> None:
            share = min(1.0, tried / len(to_map))
            self._progress.update(MATCHED + int(share * (MAPPED - MATCHED)), "map")

        with TemporaryDirectory(prefix="placewise-reconstruct-") as scratch:
            folder = Path(scratch, "made")
            folder.mkdir()
            if model is None:
                current = self._find_extendable(photos)
                existing = self._fetch_models(Path(scratch), current) if current else []
                for each in current.list_components() if current else []:
                    known |= Component.decode(self._store.get(each.object_key)).rays()
                found = map_photos(to_map, matches, folder, report, self._progress.check, existing)
            else:
                source = Path(scratch, "model")
                source.mkdir()
                model.write(source)
                names = {name: UUID(name) for name in model.names()}
                to_map = [self._with_header(photo, photos[photo.id].row) for photo in to_map]
                found = import_model(to_map, names, matches, folder, source, self._progress.check)
            if known:
                found = [replace(one, component=one.component.with_rays(known)) for one in found]
            stored = [
                self._store_component(made.id, number, each) for number, each in enumerate(found)
            ]
        with self._catalog.write() as session:
            self._end_step(session)
            made = session.get_one(Reconstruction, made.id)
            made.components = [each.model_dump(mode="json") for each in stored]
        return made, [each.component for each in found]

    def _with_header(self, to_map: PhotoToMap, photo: Photo) -> PhotoToMap:
        """Return a photo of an imported model with what its file says about its camera."""
        with self._store.open(photo.object_key) as file:
            header = read_photo_header(file, sys.maxsize)
        camera = hash_camera_key(header.camera_key) if header.camera_key else to_map.camera
        return replace(to_map, quarter_turns=header.quarter_turns, camera=camera)

    def _fetch_models(self, scratch: Path, current: Reconstruction) -> list[Path]:
        """Write the COLMAP models of a reconstruction into folders."""
        folders = []
        for component in current.list_components():
            folder = scratch / f"existing-{component.number}"
            folder.mkdir()
            for key in component.sha256.keys() - {component.object_key}:
                (folder / key.rpartition("/")[2]).write_bytes(self._store.get(key))
            folders.append(folder)
        return folders

    def _read_model(self, photos: dict[UUID, MapPhoto]) -> tuple[ColmapModel, list[str]]:
        """Return the imported model with photo ids as names, and the names without a photo."""
        sent = ColmapModel.model_validate_json(self._store.get(self._job.params["object_key"]))
        rows = [photo.row for photo in photos.values()]
        paths = {row.id: row.relative_path or row.filename for row in rows}
        ids = match_names([photo.name for photo in sent.photos], paths)
        if len(ids) < MIN_PHOTOS:
            raise Unprocessable(
                "names_unmatched",
                f"{len(ids)} of the {len(sent.photos)} names in the model are those of exactly one "
                f"photo of the map, for example not {sent.photos[0].name!r:.200}. Upload the "
                "model's images first: `placewise index DIR`.",
            )
        named = [
            photo.model_copy(update={"name": str(ids[photo.name])})
            for photo in sent.photos
            if photo.name in ids
        ]
        unmatched = [photo.name for photo in sent.photos if photo.name not in ids]
        return sent.model_copy(update={"photos": named}), unmatched

    def _store_component(
        self, made_id: UUID, number: int, mapped: MappedComponent
    ) -> ReconstructedComponent:
        key = component_key(made_id, number)
        objects = {key: mapped.component.encode()}
        for file in sorted(mapped.folder.iterdir()):
            objects[f"{reconstruction_prefix(made_id)}{number}/{file.name}"] = file.read_bytes()
        for name, data in objects.items():
            self._store.put(name, data)
        return ReconstructedComponent(
            number=number,
            object_key=key,
            sha256={name: hashlib.sha256(data).hexdigest() for name, data in objects.items()},
            photos=len(mapped.component.photo_ids),
            points=len(mapped.component.points),
            mean_reprojection_error_pixels=mapped.mean_reprojection_error_pixels,
        )

    def _load_components(
        self, made: Reconstruction, photos: dict[UUID, MapPhoto]
    ) -> list[Component] | None:
        """Return the stored components; None without, or if one of their photos is gone."""
        stored = [
            Component.decode(self._store.get(each.object_key)) for each in made.list_components()
        ]
        is_complete = all(photos.keys() >= set(component.photo_ids) for component in stored)
        return stored if stored and is_complete else None

    def _finish(
        self,
        made: Reconstruction,
        components: list[Component],
        photos: dict[UUID, MapPhoto],
        result: dict[str, Any],
        origin: EastNorthUp | None,
    ) -> None:
        """Align and calibrate the components, and finish row and job in one transaction."""
        self._progress.update(MAPPED, "align")
        alignments, not_aligned = list[Alignment | None](), list[str | None]()
        for component in components:
            try:
                alignments.append(_align(component, photos, origin))
                not_aligned.append(None)
            except Unprocessable as error:
                alignments.append(None)
                not_aligned.append(error.detail)
        calibrations = self._calibrate(made, components, alignments, photos)
        stored, proposals = [], list[dict[str, Any]]()
        for about, component, alignment, reason, calibration in zip(
            made.list_components(), components, alignments, not_aligned, calibrations, strict=True
        ):
            update = {"calibration": calibration.model_dump(), "not_aligned": reason}
            about = about.model_copy(update=update)
            if alignment is None:
                stored.append(about)
                continue
            origin = alignment.origin
            aligned = ComponentAlignment(
                origin=(origin.latitude, origin.longitude, origin.altitude_m),
                similarity=alignment.similarity.as_json(),
                rms_m=alignment.rms_m,
                agreeing=int(alignment.is_inlier.sum()),
                located=int(np.isfinite(alignment.residuals_m).sum()),
                is_on_line=alignment.is_on_line,
            )
            stored.append(about.model_copy(update={"alignment": aligned}))
            rows = [photos[id_].row for id_ in component.photo_ids]
            proposed = propose_coordinates(component, alignment, *_coordinates(rows))
            proposals += map(asdict, proposed)
        result |= {
            "components": len(stored),
            "aligned": sum(each.alignment is not None for each in stored),
            "proposals": len(proposals),
        }
        with self._catalog.write() as session:
            leased = self._lock(session)
            made = session.get_one(Reconstruction, made.id)
            made.components = [each.model_dump(mode="json") for each in stored]
            made.proposals = proposals
            made.finished_at = session.scalar(select(db_now()))
            leased.progress_total = PROGRESS_UNITS
            succeed_job(leased, result)

    def _calibrate(
        self,
        made: Reconstruction,
        components: list[Component],
        alignments: list[Alignment | None],
        photos: dict[UUID, MapPhoto],
    ) -> list[PoseCalibration]:
        def report(share: float) -> None:
            units = MAPPED + int((PROGRESS_UNITS - MAPPED) * share)
            self._progress.update(units, "calibrate")

        parts = []
        for component, alignment in zip(components, alignments, strict=True):
            of_component = [photos[id_] for id_ in component.photo_ids]
            part = ComponentPhotos(
                component,
                {photo.row.id: photo.features for photo in of_component},
                np.array([photo.descriptor for photo in of_component], np.float32),
                _seconds(of_component),
                [photo.row.focal_length for photo in of_component],
                None if alignment is None else alignment.similarity,
            )
            parts.append(part)
        return run_in_child(
            calibrate_components, parts, on_progress=report, check=self._progress.check
        )

    def _end_step(self, session: Session) -> None:
        """Note that a step is stored: workers that died before it do not count any more."""
        self._lock(session).attempts = 0

    def _lock(self, session: Session) -> Job:
        leased = lock_leased_job(session, self._job)
        if leased is None:
            raise JobInterrupted
        return leased


def _align(
    component: Component, photos: Mapping[UUID, MapPhoto], origin: EastNorthUp | None
) -> Alignment:
    """Return the alignment of a component to its photos' coordinates; raises as `align` does.

    The fit takes the photos in the order in which they were taken; the alignment has them in the
    component's.

    Args:
        origin: of an imported model, whose axes are then east, north and up.
    """
    of_component = [photos[id_] for id_ in component.photo_ids]
    if origin is not None:
        places = _coordinates([photo.row for photo in of_component])
        return align_at(origin, component.centres(), *places)
    order = np.argsort(_seconds(of_component), kind="stable")  # those without a time come last
    rows = [of_component[i].row for i in order]
    found = align(
        component.centres()[order],
        [component.rotation(i) for i in order],
        *_coordinates(rows),
        _numbers(row.altitude for row in rows),
        np.full(len(rows), GPS_SIGMA_M),
    )
    back = np.argsort(order)
    return replace(found, residuals_m=found.residuals_m[back], is_inlier=found.is_inlier[back])


def _coordinates(rows: Sequence[Photo]) -> tuple[Floats, Floats]:
    """Return latitudes and longitudes, NaN where one is missing."""
    return _numbers(row.latitude for row in rows), _numbers(row.longitude for row in rows)


def _positions(photos: Iterable[MapPhoto]) -> list[Floats | None]:
    """Return the photos' coordinates in metres east, north and up in one plane."""
    rows = [photo.row for photo in photos]
    latitudes, longitudes = _coordinates(rows)
    known = np.isfinite(latitudes) & np.isfinite(longitudes)
    if not known.any():
        return [None] * len(rows)
    plane = plane_at(latitudes[known], longitudes[known], 0.0)
    altitudes = _numbers(row.altitude for row in rows)
    metres = plane.from_geographic(latitudes, longitudes, np.nan_to_num(altitudes))
    metres[np.isnan(altitudes), 2] = np.nan
    return [place if is_known else None for place, is_known in zip(metres, known, strict=True)]


def _seconds(photos: Iterable[MapPhoto]) -> Floats:
    """Return when the photos were taken; NaN where that is unknown."""
    times = (photo.row.captured_at for photo in photos)
    return _numbers(None if time is None else time.timestamp() for time in times)


def _numbers(values: Iterable[float | None]) -> Floats:
    return np.array([np.nan if value is None else value for value in values], float)


def _left_out_result(
    photos: Mapping[UUID, MapPhoto], components: Sequence[Component], reasons: Mapping[UUID, str]
) -> dict[str, Any]:
    """Return the fields of a job's result for photos in no component."""
    left_out = photos.keys() - {id_ for each in components for id_ in each.photo_ids}
    listed = [
        {
            "image_id": str(id_),
            "name": photos[id_].row.relative_path or photos[id_].row.filename,
            "reason": reasons.get(id_, ADDED_MEANWHILE),
        }
        for id_ in left_out
    ]
    listed.sort(key=lambda each: each["name"])
    return {
        "reconstructed": len(photos) - len(listed),
        "left_out": len(listed),
        "left_out_photos": listed[:MAX_NAMES_REPORTED],
    }
