"""Poses: how far they are off, how honest their radii are, what is refused, and what they cost.

    placewise bench pose [FOLDER] [--queries 400] [--floors 11]

- Synthetic scenes of pycolmap with 1 px of noise and 30 % of wrong pairs: how many poses are within
  three standard deviations, and within the regions of 68 and 95 %.
- Coverage of radii is that of queries by other lenses, each of which is a little off its middle and
  distorts, as those of telephones and cameras do.
- Streets whose facades repeat, 56 photos each with exact coordinates, beside plain pycolmap with
  SIFT: horizontal distance of cameras and left-out queries from the truth.
- A generated city (`lab/city/round_trip.py`), whose camera poses are known: a drive of one summer
  day is the map; queries of a spring and an autumn day, of winter and night are localised without
  knowing their focal length. Coverage is also that with coordinates that are 3 m off.
- The floors of a building: each floor of FOLDER, by default the folder `tower` of
  PLACEWISE_TEST_DATA, is a map of its database photos, which are frames of one walk a second apart.
  It has no coordinates, so the errors of left-out photos are shares of the length of the path.
- What has no pose in the map, or a wrong camera: another quarter, other floors, mirrored photos, a
  panorama, a photo of noise, wrong focal lengths; and photos of which a part shows something else.

Candidates are ranked by a VLAD of the local features themselves, as descriptors would rank them.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any
from uuid import UUID

import faiss
import numpy as np
import torch
import typer
from numpy.typing import NDArray
from PIL import Image
from rich.progress import Progress
from scipy.stats import binomtest

from lab.benchmarks.matches import detect_all
from lab.benchmarks.pose_peer import PeerModel, cpu_seconds
from lab.benchmarks.report import Report, printed_report
from lab.city.camera import Camera as CityCamera
from lab.city.plan import PlannedPhoto
from lab.city.round_trip import plan_round_trip
from lab.city.sessions import AUTUMN, NIGHT, SPRING, WINTER
from lab.city.write import write_city
from services.cli.output import JsonOption, Table
from services.extractor.geometry.calibrate import ComponentPhotos, calibrate, localise_left_out
from services.extractor.geometry.evidence import fit_to_positions
from services.extractor.geometry.mapping import map_photos
from services.extractor.geometry.matching import match_pairs
from services.extractor.geometry.pairs import choose_pairs
from services.extractor.geometry.pycolmap_models import PhotoToMap, require_pycolmap
from shared.errors import Unprocessable
from shared.geometry.absolute_pose import estimate_absolute_pose
from shared.geometry.cameras import Camera, CameraSource, Floats
from shared.geometry.frames import Alignment, EastNorthUp, align
from shared.geometry.localise import LocalPose, localise
from shared.geometry.radius import PoseCalibration, geo_pose
from shared.matching.features import LocalFeatures
from shared.matching.xfeat import load_detector

WORDS = 32
CANDIDATES = 10
SYNTHETIC_POSES = 1000
CHI_SQUARED = (3.506, 7.815, 14.156)
"""Quantiles at 68, 95 and 99.73 % in three dimensions: the last is that of three deviations"""
COVERAGE_68, COVERAGE_95 = (63.0, 73.0), (92.0, 98.0)
COORDINATE_NOISE_M, NOISES = 3.0, 20
STREETS = (11, 12, 3)
"""Seeds of round trips"""
STREET_PHOTOS, STREET_REACH_M, FAR_M = 56, 2.5, 3.0
PLANE = EastNorthUp(44.07, 8.75)
WRONG_RADII = 3.0
"""A pose is wrong if it is farther off than so many of its radii of 95 %"""

Outcome = LocalPose | None


class Vlad:
    """Ranks photos by their local features (Jégou et al., CVPR 2010)."""

    def __init__(self, features: Sequence[LocalFeatures]) -> None:
        sample = np.concatenate([f.descriptors[::5] for f in features]).astype(np.float32)
        kmeans = faiss.Kmeans(sample.shape[1], WORDS, niter=15, seed=0)
        kmeans.train(sample)
        self.words = np.asarray(kmeans.centroids, np.float32)
        self.rows = np.array([self.describe(f) for f in features])

    def describe(self, features: LocalFeatures) -> NDArray[np.float32]:
        found = features.descriptors.astype(np.float32)
        vlad = np.zeros_like(self.words)
        if len(found):
            nearest = (found @ self.words.T - 0.5 * np.sum(self.words**2, axis=1)).argmax(axis=1)
            np.add.at(vlad, nearest, found - self.words[nearest])
        vlad = vlad / np.maximum(1e-9, np.linalg.norm(vlad, axis=1, keepdims=True))
        row = vlad.ravel() / max(1e-9, float(np.linalg.norm(vlad)))
        return np.asarray(row, np.float32)


class MappedPhotos:
    """A model of some photos, as the service makes it.

    `positions` (n, 3) are metres in PLANE, if the photos have coordinates.
    """

    def __init__(
        self,
        features: Sequence[LocalFeatures],
        seconds: Floats,
        positions: Floats | None = None,
    ) -> None:
        self.ids = [UUID(int=number + 1) for number in range(len(features))]
        self.features = dict(zip(self.ids, features, strict=True))
        self.vlad = Vlad(features)
        self.seconds = seconds
        latitudes, longitudes, _ = _coordinates(
            np.full((len(features), 3), np.nan) if positions is None else positions
        )
        started, started_cpu = time.perf_counter(), cpu_seconds()
        self.pairs = choose_pairs(self.vlad.rows, seconds, latitudes, longitudes)
        matches = match_pairs(self.features, self.pairs, lambda _: None)
        self.match_seconds = time.perf_counter() - started
        photos = [
            PhotoToMap(
                photo,
                f.width,
                f.height,
                f.pixels().astype(np.float32),
                position=None if positions is None else positions[row],
            )
            for row, (photo, f) in enumerate(self.features.items())
        ]
        with TemporaryDirectory(prefix="placewise-bench-") as folder:
            mapped = map_photos(photos, matches, Path(folder), lambda _: None, lambda: None)
        self.seconds_taken = time.perf_counter() - started
        self.cpu_seconds = cpu_seconds() - started_cpu
        self.components = [each.component for each in mapped]
        self.pose_seconds: list[float] = []

    def best(self, query: LocalFeatures) -> list[int]:
        """Return the numbers of the most similar photos."""
        similarities = self.vlad.rows @ self.vlad.describe(query)
        return [int(row) for row in np.argsort(-similarities, kind="stable")[:CANDIDATES]]

    def localise(self, query: LocalFeatures, focal_length: float | None = None) -> Outcome:
        """Localise a photo by its best candidates."""
        candidates = [(self.ids[i], self.features[self.ids[i]]) for i in self.best(query)]
        camera = focal_length and Camera.of_focal_length(query.width, query.height, focal_length)
        source = CameraSource.GIVEN if camera else CameraSource.ESTIMATED
        started = time.perf_counter()
        try:
            return localise(query, candidates, self.components, camera or None, source)
        except Unprocessable:
            return None
        finally:
            self.pose_seconds.append(time.perf_counter() - started)

    def localise_by_another_lens(self, query: LocalFeatures, camera: CityCamera) -> Outcome:
        """Localise a photo of an ideal camera as a real lens would have taken it."""
        rng = np.random.default_rng(len(self.pose_seconds))
        second, fourth = rng.normal((-0.03, 0.0), (0.06, 0.03))
        size = np.array([query.width, query.height])
        focal = camera.focal * query.width / camera.width
        offsets = query.pixels() - size / 2
        squares = np.sum(offsets**2, axis=1, keepdims=True) / focal**2
        bent = offsets * (1 + second * squares + fourth * squares**2)
        pixels = bent + size / 2 + rng.normal(0, 0.005 * max(size), 2)
        return self.localise(query.moved_to(pixels))

    def calibrate(self, component: int, alignment: Alignment | None) -> PoseCalibration:
        """Localise the component's photos without themselves."""
        return calibrate(self.left_out(component, alignment))

    def left_out(self, component: int, alignment: Alignment | None) -> list[Any]:
        """See `localise_left_out`."""
        photos = self.components[component].photo_ids
        rows = [self.ids.index(photo) for photo in photos]
        left_out = ComponentPhotos(
            self.components[component],
            self.features,
            self.vlad.rows[rows],
            self.seconds[rows],
            [None] * len(rows),
            alignment.similarity if alignment else None,
        )
        return localise_left_out(left_out, lambda _: None)


def bench(
    folder: Annotated[
        Path | None, typer.Argument(help="Photos of floors. Default: tower.", exists=True)
    ] = None,
    queries: Annotated[int, typer.Option(min=0, help="City queries by day.")] = 400,
    floors: Annotated[int, typer.Option(min=0, help="Floors that are mapped.")] = 11,
    streets: Annotated[int, typer.Option(min=0, max=len(STREETS), help="Streets.")] = len(STREETS),
    as_json: JsonOption = False,
) -> None:
    """Measure errors, radii, refusals and times of poses."""
    folder = folder or Path(os.environ.get("PLACEWISE_TEST_DATA", ".")) / "tower"
    with printed_report("poses", as_json) as (report, progress):
        wrong: list[tuple[str, int, int]] = []
        measure_synthetic(report)
        if streets:
            wrong += measure_streets(report, streets, progress)
        if queries:
            wrong += measure_city(report, queries, progress)
        if floors and (folder / "database").is_dir():
            wrong += measure_floors(report, folder, floors, progress)
        table = Table("queries", "accepted", "of", title="wrong poses")
        for what, accepted, tried in wrong:
            table.add_row(what, str(accepted), str(tried))
        report.tables.append(table)


def measure_synthetic(report: Report) -> None:
    """Report the poses of synthetic scenes, whose truth is exact."""
    pycolmap = require_pycolmap()
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 10, 1, 400
    rng = np.random.default_rng(0)
    squares: list[float] = []
    while len(squares) < SYNTHETIC_POSES:
        scene = pycolmap.synthesize_dataset(options)
        for image in scene.images.values():
            seen = [scene.point3D(p.point3D_id).xyz for p in image.get_observation_points2D()]
            points, pose = np.array(seen), image.cam_from_world()
            focal, _, _, radial = image.camera.params
            camera = Camera(image.camera.width, image.camera.height, focal, radial)
            pixels = camera.project(points @ pose.rotation.matrix().T + pose.translation)
            pixels += rng.normal(0, 1, pixels.shape)
            is_wrong = rng.uniform(size=len(pixels)) < 0.3
            pixels[is_wrong] = rng.uniform((0, 0), (1024, 768), (int(is_wrong.sum()), 2))
            found = estimate_absolute_pose(pixels, points, camera, 1e-4)
            square = np.inf
            if found:
                error = found.position - image.projection_center()
                square = float(error @ np.linalg.solve(found.covariance[:3, :3], error))
            squares.append(square)
    within_3 = 100 * float(np.mean(np.array(squares) < CHI_SQUARED[2]))
    report.add("synthetic scenes: within 3 deviations", within_3, "%", at_least=99)
    _add_coverage(report, "synthetic scenes", np.array(squares), *CHI_SQUARED[:2])


def measure_streets(report: Report, count: int, progress: Progress) -> list[tuple[str, int, int]]:
    """Report streets whose facades repeat, beside plain pycolmap with SIFT; return wrong poses."""
    columns = ("street", "photos", "m", "over 3 m", "poses", "m", "CPU s")
    table, detector = Table(*columns, title="streets"), load_detector(torch.device("cpu"))
    wrong = tried = 0
    for seed in STREETS[:count]:
        plan = plan_round_trip(seed, [(SPRING, 120)])
        photos = [photo for photo in plan.photos if photo.role == "database"][:STREET_PHOTOS]
        truth = np.array([photo.camera.position for photo in photos])
        queries = [
            photo
            for photo in plan.photos
            if _is_query_of(photo, "spring")
            and np.linalg.norm(truth - photo.camera.position, axis=1).min() < STREET_REACH_M
        ]
        middle = truth.mean(axis=0) * (1, 1, 0)
        true_queries = np.array([photo.camera.position for photo in queries]) - middle
        truth = truth - middle
        bar = progress.add_task(f"street {seed}", total=2 * len(photos + queries))
        with TemporaryDirectory(prefix="placewise-street-") as name:
            folder = Path(name, "city")
            write_city(
                replace(plan, photos=photos + queries), folder, partial(progress.advance, bar)
            )
            paths = [photo.path(folder) for photo in photos + queries]
            features, _ = detect_all(detector, paths, partial(progress.advance, bar))
            seconds = 2.0 * np.arange(len(photos), dtype=np.float64)
            mapped = MappedPhotos(features[: len(photos)], seconds, truth)
            names = [str(path.relative_to(folder)) for path in paths]
            asked = features[len(photos) :]
            best = zip(names[len(photos) :], map(mapped.best, asked), strict=True)
            peer = PeerModel(folder, names[: len(photos)], mapped.pairs, list(best))
        alignment, component = _align(mapped, truth), mapped.components[0]
        calibration = mapped.calibrate(0, alignment)
        outcomes = [mapped.localise(query) for query in asked]
        posed = [
            p.position if isinstance(p, LocalPose) and not p.component else None for p in outcomes
        ]
        judged = np.array(
            [
                _judge(pose, alignment, calibration, place, query.camera.yaw)
                for photo, place, query in zip(asked, true_queries, queries, strict=True)
                for pose in [mapped.localise_by_another_lens(photo, query.camera)]
                if isinstance(pose, LocalPose) and not pose.component
            ]
        )
        rows = [mapped.ids.index(photo) for photo in component.photo_ids]
        turns = [component.rotation(row) for row in range(len(rows))]
        ours = (rows, component.centres(), turns, posed, mapped.cpu_seconds)
        theirs = (peer.rows, peer.centres, peer.rotations, peer.positions, peer.cpu_seconds)
        for what, (rows, centres, turns, found, cpu) in (
            (str(seed), ours),
            ("pycolmap, SIFT", theirs),
        ):
            fitted = fit_to_positions(centres, turns, truth[rows])
            assert fitted is not None
            has_pose = [n for n, position in enumerate(found) if position is not None]
            places = np.array([found[n] for n in has_pose]).reshape(-1, 3)
            off, errors = (
                np.linalg.norm((fitted.apply(own) - true)[:, :2], axis=1)
                for own, true in ((centres, truth[rows]), (places, true_queries[has_pose]))
            )
            counts = f"{len(rows)} of {len(photos)}", f"{len(has_pose)} of {len(queries)}"
            middles = f"{np.median(off):.2f}", f"{np.median(errors):.2f}"
            far = int(np.sum(off > FAR_M))
            table.add_row(
                what, counts[0], middles[0], str(far), counts[1], middles[1], f"{cpu:.0f}"
            )
            if what == str(seed):
                report.add(f"street {seed}: photos at a wrong place", far, at_most=0)
        _add_coverage(report, f"street {seed}", *judged.T[:3])
        _add_coverage(report, f"street {seed}, heading", *judged.T[3:])
        wrong += int(np.sum(judged[:, 0] > WRONG_RADII * judged[:, 2]))
        tried += len(judged)
    report.tables.append(table)
    return [("photos of streets", wrong, tried)]


def measure_city(report: Report, count: int, progress: Progress) -> list[tuple[str, int, int]]:
    """Report the poses of the generated city; return the poses of what should have none."""
    other = count // 4
    sessions = [(SPRING, count - count // 2), (AUTUMN, count // 2), (WINTER, other), (NIGHT, other)]
    plan = plan_round_trip(3, sessions, outside=other)
    bar = progress.add_task("city", total=2 * len(plan.photos))
    detector = load_detector(torch.device("cpu"))
    with TemporaryDirectory(prefix="placewise-city-") as name:
        folder = Path(name)
        write_city(plan, folder / "city", partial(progress.advance, bar))
        paths = [photo.path(folder / "city") for photo in plan.photos]
        features, _ = detect_all(detector, paths, partial(progress.advance, bar))
        by_day = [n for n, p in enumerate(plan.photos) if _is_query_of(p, "spring", "autumn")]
        mirrored = _detect_changed(detector, [paths[n] for n in by_day[:other]], folder, _mirror)
        noise = _detect_changed(detector, paths[:20], folder, _noise)
        panoramas = _detect_changed(detector, [paths[n] for n in by_day[:40]], folder, _panorama)
    members = [n for n, photo in enumerate(plan.photos) if photo.role == "database"]
    seconds = 2.0 * np.arange(len(members), dtype=np.float64)
    positions = np.array([photo.camera.position for photo in plan.photos])
    middle = positions[members].mean(axis=0) * (1, 1, 0)
    truth = positions - middle
    mapped = MappedPhotos([features[n] for n in members], seconds, truth[members])
    report.add("city: photos", len(members))
    report.add("city: photos in the largest component", len(mapped.components[0].photo_ids))
    per_100 = 100 * mapped.seconds_taken / len(members)
    report.add("city: reconstructed, for each 100 photos", per_100, "s", at_most=300)
    alignment = _align(mapped, truth[members])
    calibration = mapped.calibrate(0, alignment)
    query_numbers = [n for n, photo in enumerate(plan.photos) if photo.role == "query"]
    localised = {n: mapped.localise(features[n]) for n in query_numbers}
    report.add_latency("city: a pose", mapped.pose_seconds, p95_at_most_ms=1500)
    table = Table(
        "queries", "poses %", "median m", "heading", "in 68 %", "in 95 %", "radius m", title="city"
    )
    noisy = list(_noisy_alignments(mapped, truth[members]))
    wrong = tried = 0
    for what, names in (
        ("by day", ("spring", "autumn")),
        ("winter", ("winter",)),
        ("night", ("night",)),
    ):
        numbers = [n for n, p in enumerate(plan.photos) if _is_query_of(p, *names)]
        found = [n for n in numbers if isinstance(localised[n], LocalPose)]
        yaws = {n: plan.photos[n].camera.yaw for n in found}
        judged = np.array(
            [_judge(localised[n], alignment, calibration, truth[n], yaws[n]) for n in found]
        )
        errors, headings = judged[:, 0], judged[:, 3]
        by_others = {
            n: pose
            for n in numbers
            for pose in [mapped.localise_by_another_lens(features[n], plan.photos[n].camera)]
            if isinstance(pose, LocalPose)
        }
        covered = np.array(
            [
                _judge(pose, alignment, calibration, truth[n], plan.photos[n].camera.yaw)
                for n, pose in by_others.items()
            ]
        )
        in_68, in_95 = (100 * float(np.mean(covered[:, 0] <= covered[:, i])) for i in (1, 2))
        radius = float(np.median(covered[:, 1]))
        share = 100 * len(found) / len(numbers)
        values = (share, np.median(errors), np.median(headings), in_68, in_95, radius)
        table.add_row(what, *(f"{value:.2f}" for value in values))
        day = what == "by day"
        limit = partial(report.add, at_least=90) if day else report.add
        limit(f"city, {what}: queries with a pose", share, "%")
        limit = report.add
        limit(f"city, {what}: median error", float(values[1]), "m", at_most=0.5 if day else None)
        limit(f"city, {what}: median heading", float(values[2]), "°", at_most=2 if day else None)
        _add_coverage(report, f"city, {what}", *covered.T[:3])
        _add_coverage(report, f"city, {what}, heading", *covered.T[3:])
        if day:
            covered = np.array(
                [
                    _judge(pose, off, calibration, truth[n], plan.photos[n].camera.yaw)
                    for n, pose in by_others.items()
                    for off in noisy
                ]
            )
            what = f"city, {what}, coordinates {COORDINATE_NOISE_M:.0f} m off"
            report.add(f"{what}: median error", float(np.median(covered[:, 0])), "m")
            _add_coverage(report, what, *covered.T[:3])
        wrong += int(np.sum(errors > WRONG_RADII * judged[:, 2]))
        tried += len(found)
    report.tables.append(table)
    report.add("city: wrong poses of all", 100 * wrong / max(1, tried), "%", at_most=1)
    outside = [n for n, photo in enumerate(plan.photos) if photo.kind == "out_of_map"]
    rng = np.random.default_rng(0)
    rows = [("city: photos of the map's streets", wrong, tried)]
    rows.append(("another quarter", _accepted(localised[n] for n in outside), len(outside)))
    for what, changed in (("mirrored", mirrored), ("noise", noise), ("panoramas", panoramas)):
        rows.append((what, _accepted(map(mapped.localise, changed)), len(changed)))
    for factor in (0.6, 1.6):
        bad = 0
        for n in by_day[:other]:
            focal_length = factor * plan.photos[n].camera.focal / 640
            pose = mapped.localise(features[n], focal_length)
            bad += _is_wrong(pose, alignment, calibration, truth[n])
        rows.append((f"{factor} times the focal length", bad, other))
    bad = 0
    for n in by_day[:other]:
        foreign = features[int(rng.choice(outside))]
        pose = mapped.localise(_covered(features[n], foreign))
        bad += _is_wrong(pose, alignment, calibration, truth[n])
    rows.append(("two fifths show what is not in the map", bad, other))
    return rows


def measure_floors(
    report: Report, folder: Path, floors: int, progress: Progress
) -> list[tuple[str, int, int]]:
    """Report the poses of the floors; return those of the other floors' photos."""
    detector = load_detector(torch.device("cpu"))
    paths = sorted((folder / "database").iterdir())
    queries = sorted((folder / "queries").iterdir())
    names = sorted({_floor(path) for path in paths})[:floors]
    bar = progress.add_task("floors", total=len(paths) + len(queries) + 50 * len(names))
    advance = partial(progress.advance, bar)
    features = dict(zip(paths, detect_all(detector, paths, advance)[0], strict=True))
    of_queries = dict(zip(queries, detect_all(detector, queries, advance)[0], strict=True))
    columns = ("floor", "photos", "in the model", "components", "s", "poses %", "left out %")
    table = Table(*columns, "error, % of the path", title="floors")
    found = tried = others = others_tried = 0
    errors: list[float] = []
    for name in names:
        own = [path for path in paths if _floor(path) == name]
        seconds = np.array([_second(path, paths) for path in own])
        mapped = MappedPhotos([features[path] for path in own], seconds)
        poses = [mapped.localise(of_queries[path]) for path in queries if _floor(path) == name]
        elsewhere = [path for path in queries if _floor(path) != name]
        accepted = _accepted(mapped.localise(of_queries[path]) for path in elsewhere[::6])
        others, others_tried = others + accepted, others_tried + len(elsewhere[::6])
        shares: list[float] = []
        left_out = []
        for number, component in enumerate(mapped.components):
            if len(component.photo_ids) >= CANDIDATES:
                order = np.argsort([mapped.ids.index(photo) for photo in component.photo_ids])
                steps = np.linalg.norm(np.diff(component.centres()[order], axis=0), axis=1)
                some = mapped.left_out(number, None)
                left_out += some
                shares += [100 * pose.distance / steps.sum() for pose in some if pose]
        found, tried = found + len(poses) - _refused(poses), tried + len(poses)
        errors += shares
        table.add_row(
            name,
            str(len(own)),
            str(sum(len(c.photo_ids) for c in mapped.components)),
            str(len(mapped.components)),
            f"{mapped.seconds_taken:.0f}",
            f"{100 * (len(poses) - _refused(poses)) / max(1, len(poses)):.0f}",
            f"{100 * np.mean([pose is not None for pose in left_out] or [False]):.0f}",
            f"{np.median(shares or [np.nan]):.2f}",
        )
        progress.advance(bar, 50)
    report.tables.append(table)
    report.add("floors: queries with a pose", 100 * found / max(1, tried), "%")
    report.add("floors: median error of left-out photos", float(np.median(errors)), "% of the path")
    return [("photos of other floors", others, others_tried)]


def _judge(
    pose: Outcome, alignment: Alignment, calibration: PoseCalibration, truth: Floats, yaw: float
) -> tuple[float, float, float, float, float, float]:
    """Return horizontal error and radii of 68 and 95 % in metres; of the heading, in degrees."""
    assert isinstance(pose, LocalPose)
    found = geo_pose(pose, alignment.origin, alignment.similarity, calibration)
    position = PLANE.from_geographic([found.latitude], [found.longitude], [truth[2]])[0]
    error = float(np.linalg.norm((position - truth)[:2]))
    turn = abs((found.attitude.heading - yaw + 180) % 360 - 180)
    heading = turn, found.heading_68_degrees, found.heading_95_degrees
    return error, found.radius_68_m, found.radius_95_m, *heading


def _is_wrong(
    pose: Outcome, alignment: Alignment, calibration: PoseCalibration, truth: Floats
) -> bool:
    if not isinstance(pose, LocalPose):
        return False
    error, _, radius_95_m, *_ = _judge(pose, alignment, calibration, truth, 0.0)
    return error > WRONG_RADII * radius_95_m


def _align(mapped: MappedPhotos, truth: Floats) -> Alignment:
    component = mapped.components[0]
    rows = sorted(range(len(component.photo_ids)), key=lambda row: component.photo_ids[row])
    numbers = [mapped.ids.index(component.photo_ids[row]) for row in rows]
    return align(
        component.centres()[rows],
        [component.rotation(row) for row in rows],
        *_coordinates(truth[numbers]),
        np.full(len(rows), COORDINATE_NOISE_M),
    )


def _coordinates(metres: Floats) -> tuple[Floats, Floats, Floats]:
    """Return latitudes, longitudes and altitudes of (n, 3) metres in PLANE; NaN of NaN."""
    places = [PLANE.to_geographic(row) for row in metres]
    latitudes, longitudes, altitudes = np.array(
        [(place.latitude, place.longitude, place.altitude_m) for place in places]
    ).T
    return latitudes, longitudes, altitudes


def _noisy_alignments(mapped: MappedPhotos, truth: Floats) -> Iterable[Alignment]:
    rng = np.random.default_rng(0)
    for _ in range(NOISES):
        yield _align(mapped, truth + rng.normal(0, COORDINATE_NOISE_M, truth.shape))


def _add_coverage(report: Report, what: str, errors: Floats, *radii: Any) -> None:
    """Report the shares of errors (n,) within their radii of 68 and 95 %, with 95 % intervals."""
    limits = ("68", COVERAGE_68), ("95", COVERAGE_95)
    for radius, (name, (low, high)) in zip(radii, limits, strict=True):
        within = binomtest(int(np.sum(errors <= radius)), len(errors))
        least, most = (100 * limit for limit in within.proportion_ci(method="wilson"))
        share = f"{what}: within {name} % ({least:.0f} to {most:.0f} of {len(errors)})"
        report.add(share, 100 * within.statistic, "%", at_least=low)
        report.add(
            f"{what}: within {name} %, not too many", 100 * within.statistic, "%", at_most=high
        )


def _is_query_of(photo: PlannedPhoto, *sessions: str) -> bool:
    return photo.role == "query" and photo.kind == "in_map" and photo.session.name in sessions


def _accepted(outcomes: Iterable[Outcome]) -> int:
    return sum(isinstance(outcome, LocalPose) for outcome in outcomes)


def _refused(outcomes: Sequence[Outcome]) -> int:
    return len(outcomes) - _accepted(outcomes)


def _detect_changed(
    detector: Any, paths: Sequence[Path], folder: Path, change: Callable[[Image.Image], Image.Image]
) -> list[LocalFeatures]:
    """Return the local features of changed copies of photos."""
    changed = []
    for number, path in enumerate(paths):
        changed.append(folder / f"{change.__name__}-{number}.png")
        with Image.open(path) as image:
            change(image).save(changed[-1])
    return detect_all(detector, changed, lambda: None)[0]


def _mirror(image: Image.Image) -> Image.Image:
    return image.transpose(Image.Transpose.FLIP_LEFT_RIGHT)


def _noise(image: Image.Image) -> Image.Image:
    rng = np.random.default_rng(int(np.asarray(image).sum()))
    return Image.fromarray(rng.integers(0, 256, (image.height, image.width, 3), np.uint8))


def _panorama(image: Image.Image) -> Image.Image:
    """A strip of a panorama: every column is as wide as the same angle."""
    focal = image.width / 2
    angles = (np.arange(2 * image.height) / (2 * image.height) - 0.5) * np.radians(85)
    columns = np.clip(np.tan(angles) * focal + image.width / 2, 0, image.width - 1).astype(int)
    return Image.fromarray(np.array(image)[:, columns])


def _covered(query: LocalFeatures, foreign: LocalFeatures) -> LocalFeatures:
    """Return the features of a photo whose right two fifths show what another photo shows."""
    border = 0.6 * 65535
    own, added = query.positions[:, 0] < border, foreign.positions[:, 0] >= border
    return LocalFeatures(
        query.width,
        query.height,
        np.concatenate([query.positions[own], foreign.positions[added]]),
        np.concatenate([query.descriptors[own], foreign.descriptors[added]]),
    )


def _floor(path: Path) -> str:
    return path.name.partition("__")[0]


def _second(path: Path, paths: Sequence[Path]) -> float:
    """Return the second of a frame; the walks of a building follow each other after an hour."""
    walk, _, frame = path.stem.rpartition("_")
    return 3600.0 * sorted({p.stem.rpartition("_")[0] for p in paths}).index(walk) + float(frame)
