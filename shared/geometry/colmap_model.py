"""COLMAP models as files: cameras and poses to import, and images that are renamed for export.

A model is a folder with `cameras`, `images` and `points3D`, as `.bin` or `.txt`
(colmap.github.io/format.html). Only the first two are read here: the points of a map are those of
its own local features. pycolmap is not needed.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Self

from pydantic import ConfigDict, Field, model_validator

from shared.errors import InvalidRequest
from shared.http.request_model import FailFastList, RequestModel

MAX_CAMERAS = 10_000
MAX_PHOTOS = 50_000
MAX_NAME_CHARACTERS = 1000
MAX_FILE_BYTES = 2_000_000_000
"""Of `images.bin`, which also has the keypoints"""
# Name and number of parameters, by the number of the model (src/colmap/sensor/models.h). The next
# one, EQUIRECTANGULAR, is not read: the points around a panorama serve no query.
CAMERA_MODELS = dict(
    enumerate(
        [
            *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5)),
            *(("OPENCV", 8), ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5)),
            *(("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12)),
            *(("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5)),
            *(("SIMPLE_FISHEYE", 3), ("FISHEYE", 4), ("EUCM", 6)),
        ]
    )
)
PARAMETERS = dict(CAMERA_MODELS.values())
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, rotation w x y z, translation, camera
_POINT_BYTES = 24  # of an image: x, y, number of the point

Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Origin = tuple[Latitude, Longitude, Number]


class _Part(RequestModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ColmapCamera(_Part):
    """A camera of one of COLMAP's models; lengths in pixels."""

    model: str = Field(
        max_length=MAX_NAME_CHARACTERS, description=f"one of {', '.join(PARAMETERS)}"
    )
    width: int = Field(ge=1, le=1_000_000)
    height: int = Field(ge=1, le=1_000_000)
    params: list[Number] = Field(description="as COLMAP orders them", max_length=16)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.model not in PARAMETERS:
            raise ValueError(f"{self.model!r:.50} is not one of {', '.join(PARAMETERS)}")
        if len(self.params) != PARAMETERS[self.model] or self.params[0] <= 0:
            raise ValueError(
                f"{self.model} has {PARAMETERS[self.model]} parameters, the first above 0"
            )
        return self


class ColmapPhoto(_Part):
    """The pose of a photo."""

    name: str = Field(
        min_length=1,
        max_length=MAX_NAME_CHARACTERS,
        pattern=r"^[^\x00\n\r]*$",
        description="file name or path of a photo of the map",
    )
    camera: int = Field(ge=0, description="its number in `cameras`, from 0")
    rotation: tuple[Number, Number, Number, Number] = Field(
        description="unit quaternion (w, x, y, z) from the model to the camera's axes: x right, "
        "y down, z forward"
    )
    translation: tuple[Number, Number, Number] = Field(
        description="a point X of the model is at rotation * X + translation in these axes"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if abs(sum(part * part for part in self.rotation) - 1) > 1e-3:
            raise ValueError("`rotation` is not of unit length")
        return self


class ColmapModel(_Part):
    """Cameras and poses of a COLMAP model."""

    cameras: FailFastList[ColmapCamera] = Field(min_length=1, max_length=MAX_CAMERAS)
    photos: FailFastList[ColmapPhoto] = Field(min_length=3, max_length=MAX_PHOTOS)
    origin: Origin | None = Field(
        None,
        description="latitude, longitude (degrees) and altitude (metres) of the model's zero, if "
        "its axes are east, north and up in metres. Without it, the model is aligned to the "
        "coordinates of its photos",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if max(photo.camera for photo in self.photos) >= len(self.cameras):
            raise ValueError("a photo has the number of a camera that is not there")
        if len({photo.name for photo in self.photos}) < len(self.photos):
            raise ValueError("two photos have the same name")
        return self

    def names(self) -> set[str]:
        """Return the names of the photos."""
        return {photo.name for photo in self.photos}

    def write(self, folder: Path) -> None:
        """Write the model as text files without points, as pycolmap reads them."""
        cameras = (
            f"{number} {camera.model} {camera.width} {camera.height} {_join(camera.params)}\n"
            for number, camera in enumerate(self.cameras, start=1)
        )
        photos = (
            f"{number} {_join(photo.rotation)} {_join(photo.translation)} {photo.camera + 1} "
            f"{photo.name}\n\n"
            for number, photo in enumerate(self.photos, start=1)
        )
        (folder / "cameras.txt").write_text("".join(cameras))
        (folder / "images.txt").write_text("".join(photos))
        (folder / "points3D.txt").write_text("")


def _join(numbers: list[float] | tuple[float, ...]) -> str:
    return " ".join(map(repr, numbers))


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read cameras and poses of a COLMAP model, such as hloc's.

    As COLMAP does, it reads the text files only if there are no binary ones. Files of COLMAP 3.12
    and later have the poses of rigs and frames in `images`, too. pycolmap would end names at a
    blank, and skip the last image of a text file without a line of points.

    Raises:
        InvalidRequest: `bad_colmap_model`, with what is wrong and where.
    """
    files = [name + suffix for suffix in (".bin", ".txt") for name in ("images", "cameras")]
    suffix = next((file[-4:] for file in files if (folder / file).is_file()), None)
    if suffix is None:
        inside = sorted(path.parent.name for path in folder.glob("*/images.*"))
        raise InvalidRequest(
            "bad_colmap_model",
            f"{folder} has no images.bin or images.txt"
            + (f". It has several models: name one, such as {folder / inside[0]}" if inside else "")
            + ".",
        )
    read = _read_binary if suffix == ".bin" else _read_text
    try:
        numbers, cameras, photos = read(
            *(_read_limited(folder / f"{name}{suffix}") for name in ("cameras", "images"))
        )
        return ColmapModel(
            cameras=cameras,
            photos=[
                ColmapPhoto(
                    name=name, camera=numbers[camera], rotation=pose[:4], translation=pose[4:]
                )
                for name, camera, pose in photos
            ],
        )
    except (OSError, struct.error, LookupError, ValueError) as error:
        raise InvalidRequest(
            "bad_colmap_model", f"The COLMAP model in {folder} can't be read: {error}"
        ) from error


def _read_limited(path: Path) -> bytes:
    if not path.is_file():  # a FIFO would wait for a writer, and /dev/zero has no end
        raise ValueError(f"{path.name} is missing, or no regular file")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ValueError(f"{path.name} has more than {MAX_FILE_BYTES} bytes")
    return path.read_bytes()


_Photo = tuple[str, int, tuple[float, ...]]
"""Name, number of its camera, rotation and translation"""


def _read_binary(
    camera_file: bytes, image_file: bytes
) -> tuple[dict[int, int], list[ColmapCamera], list[_Photo]]:
    numbers: dict[int, int] = {}
    cameras: list[ColmapCamera] = []
    offset = _COUNT.size
    for _ in range(min(_COUNT.unpack_from(camera_file)[0], MAX_CAMERAS)):
        camera_id, model, width, height = _CAMERA.unpack_from(camera_file, offset)
        if model not in CAMERA_MODELS:
            names = ", ".join(PARAMETERS)
            raise ValueError(f"camera {camera_id} is of COLMAP's model {model}, not one of {names}")
        name, count = CAMERA_MODELS[model]
        params = struct.unpack_from(f"<{count}d", camera_file, offset + _CAMERA.size)
        numbers[camera_id] = len(cameras)
        cameras.append(ColmapCamera(model=name, width=width, height=height, params=list(params)))
        offset += _CAMERA.size + 8 * count
    photos = [
        (image_file[begin + _IMAGE.size : end].decode(), camera, tuple(pose))
        for begin, end, _ in _find_images(image_file)
        for _, *pose, camera in [_IMAGE.unpack_from(image_file, begin)]
    ]
    return numbers, cameras, photos


def _find_images(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield for each image where it begins, where its name ends, and where it ends."""
    begin = _COUNT.size
    for _ in range(_COUNT.unpack_from(data)[0]):
        name_end = data.index(b"\0", begin + _IMAGE.size)
        (points,) = _COUNT.unpack_from(data, name_end + 1)
        end = name_end + 1 + _COUNT.size + _POINT_BYTES * points
        if end > len(data):
            raise ValueError("images.bin is truncated")
        yield begin, name_end, end
        begin = end


def _read_text(
    camera_file: bytes, image_file: bytes
) -> tuple[dict[int, int], list[ColmapCamera], list[_Photo]]:
    numbers: dict[int, int] = {}
    cameras: list[ColmapCamera] = []
    for line in camera_file.decode().splitlines():
        if line.strip() and not line.startswith("#"):
            camera_id, model, width, height, *params = line.split()
            numbers[int(camera_id)] = len(cameras)
            cameras.append(
                ColmapCamera(
                    model=model,
                    width=int(width),
                    height=int(height),
                    params=list(map(float, params)),
                )
            )
    photos: list[_Photo] = []
    lines = iter(image_file.decode().splitlines())
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        parts = line.split(maxsplit=9)
        photos.append((parts[9].strip(), int(parts[8]), tuple(map(float, parts[1:8]))))
        points = next(lines, "").split()  # the line may be empty
        if len(points) % 3 or not all(each.lstrip("-").isdigit() for each in points[2::3]):
            raise ValueError(
                f"the line after image {parts[0]:.20} is not its list of points (x, y, number of "
                "a point, ...). Write an empty line after each image without points"
            )
    return numbers, cameras, photos


def rename_images(image_file: bytes, new_name: Callable[[str], str]) -> bytes:
    """Return `images.bin` with other names; ValueError or struct.error if it is damaged."""
    parts = [image_file[: _COUNT.size]]
    for begin, name_end, end in _find_images(image_file):
        name = image_file[begin + _IMAGE.size : name_end].decode()
        parts += [
            image_file[begin : begin + _IMAGE.size],
            new_name(name).encode(),
            image_file[name_end:end],
        ]
    return b"".join(parts)
