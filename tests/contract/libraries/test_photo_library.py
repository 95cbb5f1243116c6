"""What `locate` relies on, for each library: a folder, and Immich (a stand-in server)."""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from PIL import Image
from PIL.ExifTags import Base

from services.cli.immich import api
from services.cli.immich.library import ImmichLibrary
from services.cli.locate.folder import FolderLibrary
from services.cli.locate.library import LibraryPhoto, LocatedPhoto, PhotoLibrary
from services.cli.locate.sidecars import METHOD
from shared.errors import NotFound
from shared.geotagging.fusion import Proposal
from shared.imaging.xmp import EXIF, RDF
from tests.support.immich_server import KEY, NOON, ImmichServer, running_immich
from tests.support.photos import camera_exif, encoded, photo_bytes, photo_image

TAKEOUT = '{"geoData": {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}}'
HERE, THERE = (45.0691, 7.6853), (45.08, 7.69)


class Case(ABC):
    """A library, and what its owner does to it beside Placewise."""

    library: PhotoLibrary

    @abstractmethod
    def add(self, number: int, seconds: float, position: tuple[float, float] | None) -> str:
        """Add a photo; returns its name."""

    @abstractmethod
    def place(self, name: str, position: tuple[float, float]) -> None:
        """Give a photo coordinates, as another program would."""

    @abstractmethod
    def delete(self, name: str) -> None: ...


class FolderCase(Case):
    def __init__(self, folder: Path) -> None:
        self.folder = folder / "trip"
        self.folder.mkdir()
        self.library = FolderLibrary(self.folder)

    def add(self, number: int, seconds: float, position: tuple[float, float] | None) -> str:
        clock = NOON + timedelta(hours=2, seconds=seconds)
        exif = camera_exif(clock, position, offset="+02:00", model="X100")
        exif[Base.Make] = "Maker"
        data = encoded(photo_image(number), "JPEG", exif=exif)
        (self.folder / f"IMG_{number}.jpg").write_bytes(data)
        # As Google Takeout writes it for a photo without a place; nothing is to be written into it.
        (self.folder / f"IMG_{number}.jpg.json").write_text(TAKEOUT, encoding="utf-8")
        return f"IMG_{number}.jpg"

    def place(self, name: str, position: tuple[float, float]) -> None:
        # As programs do that write all properties of a sidecar anew.
        latitude, longitude = (f"{degrees:.0f},{degrees % 1 * 60:.6f}" for degrees in position)
        (self.folder / f"{name}.xmp").write_text(
            f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="{RDF}"><rdf:Description'
            f' xmlns:exif="{EXIF}" exif:GPSProcessingMethod="{METHOD}"'
            f' exif:GPSLatitude="{latitude}N" exif:GPSLongitude="{longitude}E"/>'
            "</rdf:RDF></x:xmpmeta>"
        )

    def delete(self, name: str) -> None:
        (self.folder / name).unlink()


class ImmichCase(Case):
    def __init__(self, folder: Path, immich: ImmichServer) -> None:
        self.immich = immich
        self.library = ImmichLibrary(api.ImmichApi(immich.url, KEY), folder / "journals")

    def add(self, number: int, seconds: float, position: tuple[float, float] | None) -> str:
        name = f"IMG_{number}.jpg"
        self.immich.add(name, photo_bytes(number), position, seconds)
        return name

    def place(self, name: str, position: tuple[float, float]) -> None:
        self.immich.move(self._id(name), *position)

    def delete(self, name: str) -> None:
        self.immich.delete(self._id(name))

    def _id(self, name: str) -> str:
        return next(k for k, v in self.immich.assets.items() if v["originalFileName"] == name)


@pytest.fixture(params=["folder", "immich"])
def case(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Case]:
    monkeypatch.setattr(api, "WRITE_INTERVAL_SECONDS", 0.0)
    if request.param == "folder":
        yield FolderCase(tmp_path)
        return
    with running_immich() as immich:
        yield ImmichCase(tmp_path, immich)


def listed(case: Case) -> dict[str, LibraryPhoto]:
    return {photo.name: photo for photo in case.library.list_photos()}


def proposed(photo: LibraryPhoto, position: tuple[float, float] = THERE) -> LocatedPhoto:
    return LocatedPhoto(photo, Proposal(*position, 100.0, 0.99, 20.0, "a test"), None, None, None)


def test_photos_have_time_camera_and_coordinates_as_far_as_they_are_known(case: Case) -> None:
    known, unknown = case.add(1, 0, HERE), case.add(2, 20, None)
    photos = listed(case)
    assert (photos[known].latitude, photos[known].longitude) == pytest.approx(HERE, abs=1e-5)
    assert not photos[known].is_unlocated
    assert photos[unknown].is_unlocated
    assert photos[unknown].time == NOON + timedelta(seconds=20)
    assert photos[unknown].time_zone_is_known
    assert photos[unknown].camera == photos[known].camera
    assert len({photo.id for photo in photos.values()}) == 2


def test_a_photo_keeps_id_and_state_until_its_picture_changes(case: Case) -> None:
    name = case.add(1, 0, None)
    before = listed(case)[name]
    assert listed(case)[name] == before
    case.delete(name)
    case.add(7, 0, None)
    assert name not in listed(case)


def test_the_picture_of_a_photo_can_be_fetched_twice(case: Case) -> None:
    name = case.add(3, 0, None)
    photo = listed(case)[name]
    for _ in range(2):
        fetched = case.library.fetch(photo)
        data = fetched.read_bytes() if isinstance(fetched, Path) else fetched.read()
        with Image.open(io.BytesIO(data)) as image:
            assert image.size == photo_image(3).size


def test_accepted_positions_are_written_and_undone(case: Case) -> None:
    names = [case.add(number, 0, None) for number in (1, 2, 3)]
    case.add(4, 0, HERE)
    before = listed(case)
    report = case.library.write([proposed(before[name]) for name in names[:2]])
    assert (len(report.written), report.skipped) == (2, {})
    written = listed(case)
    for name in names[:2]:
        position = (written[name].latitude, written[name].longitude)
        assert position == pytest.approx(THERE, abs=1e-6)
    assert written[names[2]].is_unlocated
    undone = case.library.undo()
    assert len(undone.restored + undone.removed) == 2
    assert undone.changed_since == []
    assert {n: p.latitude for n, p in listed(case).items()} == {
        n: p.latitude for n, p in before.items()
    }
    with pytest.raises(NotFound) as nothing:
        case.library.undo()
    assert nothing.value.code == "nothing_to_undo"


def test_a_photo_that_got_coordinates_or_was_deleted_meanwhile_is_left_alone_and_named(
    case: Case,
) -> None:
    placed, deleted, other = (case.add(number, 0, None) for number in (1, 2, 3))
    photos = listed(case)
    case.place(placed, HERE)
    case.delete(deleted)
    report = case.library.write([proposed(photos[name]) for name in (placed, deleted, other)])
    assert len(report.written) == 1
    assert report.skipped[placed] == "got coordinates meanwhile"
    assert "deleted meanwhile" in report.skipped[deleted]
    assert listed(case)[placed].latitude == pytest.approx(HERE[0], abs=1e-5)


def test_undo_leaves_what_was_changed_since_alone_and_names_it(case: Case) -> None:
    names = [case.add(number, 0, None) for number in (1, 2)]
    photos = listed(case)
    case.library.write([proposed(photos[name]) for name in names])
    case.place(names[0], HERE)
    undone = case.library.undo()
    assert [each.removesuffix(".xmp") for each in undone.changed_since] == names[:1]
    assert len(undone.restored + undone.removed) == 1
    assert listed(case)[names[0]].latitude == pytest.approx(HERE[0], abs=1e-5)
    assert listed(case)[names[1]].is_unlocated
    assert case.library.undo().changed_since == undone.changed_since, "it stays"


def test_undo_restores_the_state_before_several_writes(case: Case) -> None:
    names = [case.add(number, 0, None) for number in (1, 2)]
    photos = listed(case)
    for name in names:
        case.library.write([proposed(photos[name])])
    case.library.undo()
    assert all(listed(case)[name].is_unlocated for name in names)


def test_a_place_without_coordinates_is_not_written(case: Case) -> None:
    name = case.add(1, 0, None)
    photo = listed(case)[name]
    report = case.library.write([LocatedPhoto(photo, None, "tower/floor 7", 0.99, None)])
    assert report.written == []
    assert "has a place only" in report.skipped[photo.name]
