"""COLMAP models as files: what pycolmap writes is read, and damage is refused with the reason."""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
from pathlib import Path
from typing import Any

import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shared.errors import InvalidRequest
from shared.geometry.colmap_model import CAMERA_MODELS, read_colmap_model, rename_images

NAMES = ["day 1/first photo.jpg", "\N{LATIN SMALL LETTER E WITH ACUTE}.jpg", "c.jpg"]


@pytest.fixture(scope="module")
def model() -> Any:
    """Three photos by two cameras, as pycolmap holds them."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, 2, 20
    made = pycolmap.synthesize_dataset(options)
    made.deregister_frame(made.images[max(made.images)].frame_id)
    for number, name in zip(made.reg_image_ids(), NAMES, strict=True):
        made.image(number).name = name
    return made


@pytest.fixture(scope="module", params=["bin", "txt"])
def folder(
    request: pytest.FixtureRequest, model: Any, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    path = tmp_path_factory.mktemp(request.param)
    (model.write_binary if request.param == "bin" else model.write_text)(str(path))
    return path


def test_cameras_and_poses_are_those_that_pycolmap_wrote(model: Any, folder: Path) -> None:
    read = read_colmap_model(folder)
    assert {photo.name for photo in read.photos} == set(NAMES)
    for photo in read.photos:
        image = next(i for i in model.images.values() if i.name == photo.name)
        camera = read.cameras[photo.camera]
        assert (camera.model, camera.width, camera.height) == (
            image.camera.model_name,
            image.camera.width,
            image.camera.height,
        )
        assert camera.params == pytest.approx(image.camera.params.tolist())
        pose = image.cam_from_world()
        x, y, z, w = pose.rotation.quat
        assert photo.rotation == pytest.approx((w, x, y, z))
        assert photo.translation == pytest.approx(tuple(pose.translation))


def test_model_that_is_written_is_one_for_pycolmap_too(folder: Path, tmp_path: Path) -> None:
    read = read_colmap_model(folder)
    named = [
        photo.model_copy(update={"name": f"{number}.jpg"})
        for number, photo in enumerate(read.photos)
    ]
    read.model_copy(update={"photos": named}).write(tmp_path)
    again = pycolmap.Reconstruction(str(tmp_path))
    assert {image.name for image in again.images.values()} == {photo.name for photo in named}
    assert read_colmap_model(tmp_path).cameras == read.cameras


def test_every_camera_model_has_the_number_of_parameters_that_pycolmap_says() -> None:
    known = set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"}
    assert known == {name for name, _ in CAMERA_MODELS.values()}
    for number, (name, parameters) in CAMERA_MODELS.items():
        camera = pycolmap.Camera.create_from_model_name(1, name, 100.0, 100, 80)
        assert (int(camera.model.value), len(camera.params)) == (number, parameters)


def test_binary_files_are_read_where_stale_text_is_beside_them(model: Any, tmp_path: Path) -> None:
    model.write_text(str(tmp_path))
    text = tmp_path / "images.txt"
    text.write_text(text.read_text().replace(NAMES[2], "stale.jpg"))
    assert {photo.name for photo in read_colmap_model(tmp_path).photos} == {*NAMES[:2], "stale.jpg"}
    model.write_binary(str(tmp_path))
    (tmp_path / "points3D.bin").unlink()  # without which COLMAP would read the text
    assert {photo.name for photo in read_colmap_model(tmp_path).photos} == set(NAMES)
    (tmp_path / "images.bin").unlink()
    assert "images.bin" in refused(tmp_path)


def test_poses_of_rigs_are_those_of_their_cameras(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 3, 2
    rigs = pycolmap.synthesize_dataset(options)
    rigs.write_binary(str(tmp_path))
    found = {photo.name: photo for photo in read_colmap_model(tmp_path).photos}
    assert len(found) == 12
    for image in rigs.images.values():
        translation = image.cam_from_world().translation.tolist()
        assert found[image.name].translation == pytest.approx(translation)


@pytest.mark.parametrize("emptied", [{0}, {0, 1, 2}, {1}, {2}])
def test_images_text_without_lines_of_points_is_refused(
    model: Any, tmp_path: Path, emptied: set[int]
) -> None:
    """COLMAP takes each second line for points, and so would lose every second photo."""
    model.write_text(str(tmp_path))
    path = tmp_path / "images.txt"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    photos = [[pose] + [""] * (n not in emptied) for n, pose in enumerate(lines[::2])]
    path.write_text("# no points\n" + "\n".join(line for photo in photos for line in photo) + "\n")
    if emptied == {2}:
        assert len(read_colmap_model(tmp_path).photos) == 3
    else:
        assert "is not its list of points" in refused(tmp_path)


def test_renamed_images_keep_everything_else(model: Any, tmp_path: Path) -> None:
    model.write_binary(str(tmp_path))
    file = tmp_path / "images.bin"
    file.write_bytes(rename_images(file.read_bytes(), lambda name: f"longer/{name}"))
    again = pycolmap.Reconstruction(str(tmp_path))
    for number in model.reg_image_ids():
        before, after = model.image(number), again.image(number)
        assert after.name == f"longer/{before.name}"
        assert after.num_points3D == before.num_points3D
        assert after.cam_from_world().matrix() == pytest.approx(before.cam_from_world().matrix())


def refused(folder: Path) -> str:
    with pytest.raises(InvalidRequest) as caught:
        read_colmap_model(folder)
    assert caught.value.code == "bad_colmap_model"
    return caught.value.detail


def test_folder_without_a_model_is_refused_and_names_the_models_in_it(
    folder: Path, tmp_path: Path
) -> None:
    assert "no images.bin" in refused(tmp_path)
    shutil.copytree(folder, tmp_path / "0")
    assert f"such as {tmp_path / '0'}" in refused(tmp_path)


def test_camera_of_an_unknown_model_is_refused(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    binary, text = tmp_path / "cameras.bin", tmp_path / "cameras.txt"
    if binary.exists():
        data = bytearray(binary.read_bytes())
        struct.pack_into("<i", data, 12, 99)
        binary.write_bytes(data)
    else:
        text.write_text(text.read_text().replace("SIMPLE_RADIAL", "PERIDOT"))
    assert "99" in refused(tmp_path) or "PERIDOT" in refused(tmp_path)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_read_or_refused_and_nothing_else(
    folder: Path, tmp_path: Path, data: st.DataObject
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    name = data.draw(st.sampled_from(sorted(f.name for f in folder.iterdir() if "im" in f.name)))
    content = bytearray((folder / name).read_bytes())
    begin = data.draw(st.integers(0, len(content)))
    content[begin : begin + data.draw(st.integers(0, 30))] = data.draw(st.binary(max_size=30))
    (tmp_path / name).write_bytes(content)
    with contextlib.suppress(InvalidRequest):
        read_colmap_model(tmp_path)


@pytest.mark.parametrize("kind", ["fifo", "endless device", "folder"])
def test_what_is_no_regular_file_is_not_read(folder: Path, tmp_path: Path, kind: str) -> None:
    for name in ("cameras", "images"):
        model = shutil.copytree(folder, tmp_path / name)
        file = next(model.glob(f"{name}.*"))
        file.unlink()
        if kind == "fifo":
            os.mkfifo(file)
        elif kind == "folder":
            file.mkdir()
        else:
            file.symlink_to("/dev/zero")
        with pytest.raises(InvalidRequest) as caught:
            read_colmap_model(model)
        assert caught.value.code == "bad_colmap_model"
