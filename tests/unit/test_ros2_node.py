"""The ROS 2 node of the documentation, on serialised messages and without ROS."""

from __future__ import annotations

import importlib.util
import math
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from tests.support.api_responses import POSE, SIMILAR
from tests.support.fake_server import FakeServer

NODE = Path(__file__).parents[2] / "docs" / "ros2" / "placewise_pose.py"
MAX_LINES = 100
STAMP = (1_780_000_000, 123_456_789)


@pytest.fixture
def node() -> ModuleType:
    found = importlib.util.spec_from_file_location("placewise_pose", NODE)
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def image_message(photo: bytes, frame_id: str, order: str = "<") -> bytes:
    """A serialised sensor_msgs/CompressedImage: CDR, aligned after the four bytes of its header."""
    data = struct.pack(f"{order}iI", *STAMP)
    for text in (frame_id, "jpeg"):
        data += bytes(-len(data) % 4)
        data += struct.pack(f"{order}I", len(text) + 1) + text.encode() + b"\0"
    data += bytes(-len(data) % 4)
    data += struct.pack(f"{order}I", len(photo)) + photo
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + data


def read_geopose(message: bytes) -> tuple[tuple[int, int], str, tuple[float, ...]]:
    """Stamp, frame id and 43 numbers of a serialised GeoPoseWithCovarianceStamped."""
    assert message[:4] == b"\0\1\0\0"
    body = message[4:]
    second, nanosecond, length = struct.unpack_from("<iII", body)
    end = 12 + length
    assert body[end - 1] == 0
    offset = end + -end % 8
    assert len(body) == offset + 43 * 8
    numbers = struct.unpack_from("<43d", body, offset)
    return (second, nanosecond), body[12 : end - 1].decode(), numbers


def test_the_node_has_at_most_a_hundred_lines() -> None:
    assert len(NODE.read_text().splitlines()) <= MAX_LINES


@pytest.mark.parametrize("frame_id", ["", "cam", "camera", "camera_left_optical"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_images_of_both_byte_orders_are_read(node: ModuleType, frame_id: str, order: str) -> None:
    message = image_message(b"\xff\xd8photo", frame_id, order)
    assert node.read_image(message) == (STAMP, frame_id, b"\xff\xd8photo")


def test_the_message_has_the_place_the_orientation_and_the_variances(node: ModuleType) -> None:
    stamp, frame_id, numbers = read_geopose(node.write_geopose(STAMP, "camera", POSE))
    assert (stamp, frame_id) == (STAMP, "camera")
    assert numbers[:3] == (POSE["latitude"], POSE["longitude"], POSE["altitude_m"])
    x, y, z, w = numbers[3:7]
    assert [w, x, y, z] == POSE["enu_quaternion"]
    covariance = np.reshape(numbers[7:], (6, 6))
    assert np.count_nonzero(covariance) == 6
    east, height, turn = covariance[0, 0], covariance[2, 2], covariance[5, 5]
    assert math.sqrt(-2 * math.log(0.32) * east) == pytest.approx(POSE["radius_68_m"], rel=0.01)
    assert height == east
    assert math.degrees(math.sqrt(turn)) == pytest.approx(POSE["heading_68_degrees"], rel=0.01)


def test_a_height_that_is_not_known_is_nan(node: ModuleType) -> None:
    message = node.write_geopose(STAMP, "", {**POSE, "altitude_m": None})
    numbers = read_geopose(message)[2]
    assert math.isnan(numbers[2])
    assert np.reshape(numbers[7:], (6, 6))[2, 2] == node.UNKNOWN


def run_node(
    node: ModuleType, monkeypatch: pytest.MonkeyPatch, values: dict[str, Any], *messages: bytes
) -> tuple[list[bytes], list[str]]:
    """What the node publishes and logs for these messages, on a ROS that only passes them on."""
    published: list[bytes] = []
    logged: list[str] = []
    subscriptions: list[Callable[[bytes], None]] = []

    def subscribe(kind: str, topic: str, callback: Any, depth: int, *, raw: bool) -> None:
        assert (kind, topic, depth, raw) == ("image", "image/compressed", 1, True)
        subscriptions.append(callback)

    ros_node = SimpleNamespace(
        declare_parameter=lambda name, value: SimpleNamespace(value=values.get(name, value)),
        create_publisher=lambda kind, topic, depth: SimpleNamespace(publish=published.append),
        create_subscription=subscribe,
        get_logger=lambda: SimpleNamespace(info=logged.append),
    )

    def spin(_: object) -> None:
        for message in messages:
            subscriptions[0](message)

    rclpy = SimpleNamespace(init=lambda: None, create_node=lambda name: ros_node, spin=spin)
    geographic = SimpleNamespace(GeoPoseWithCovarianceStamped="geopose")
    sensor = SimpleNamespace(CompressedImage="image")
    for name, module in (
        ("rclpy", rclpy),
        ("geographic_msgs", SimpleNamespace(msg=geographic)),
        ("geographic_msgs.msg", geographic),
        ("sensor_msgs", SimpleNamespace(msg=sensor)),
        ("sensor_msgs.msg", sensor),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    node.main()
    return published, logged


def test_frames_are_asked_for_and_poses_with_coordinates_are_published(
    node: ModuleType, monkeypatch: pytest.MonkeyPatch, server: FakeServer
) -> None:
    no_coordinates = {**POSE, "radius_68_m": None, "reason": "All photos are on a line."}
    server.will_answer(200, {**SIMILAR, "pose": POSE, "no_pose": None})
    server.will_answer(200, {**SIMILAR, "pose": no_coordinates, "no_pose": None})
    server.will_answer(200, {**SIMILAR, "pose": None, "no_pose": "Too little texture."})
    server.will_answer(202, {"job_id": "1"})
    server.will_answer(401, {"detail": "The key is missing."})
    values = {"server": server.url, "map": "lab", "key": "secret", "focal_length": 0.8}
    messages = [image_message(b"\xff\xd8photo", "camera")] * 5
    published, logged = run_node(node, monkeypatch, values, *messages)
    assert [read_geopose(message)[:2] for message in published] == [(STAMP, "camera")]
    assert logged[:3] == [
        "All photos are on a line.",
        "Too little texture.",
        "The frame was not described in time.",
    ]
    assert "The key is missing." in logged[3]
    _, path, body = server.requests[0]
    assert urlsplit(path).path == "/api/v1/similarity"
    assert parse_qs(urlsplit(path).query) == {
        "pose": ["true"],
        "top_k": ["1"],
        "history": ["false"],
        "map": ["lab"],
        "focal_length": ["0.8"],
    }
    assert b"\xff\xd8photo" in body
    assert server.headers[0]["Authorization"] == "Bearer secret"


def test_a_server_that_is_gone_does_not_end_the_node(
    node: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = image_message(b"photo", "camera")
    values = {"server": "http://127.0.0.1:9"}
    assert run_node(node, monkeypatch, values, message)[0] == []
