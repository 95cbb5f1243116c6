"""ROS 2 node: asks Placewise for the pose of each camera frame, and publishes it.

Both messages are handled in their serialised form (CDR): all but `main` runs without ROS.
"""

import json
import math
import struct
import urllib.error
import urllib.parse
import urllib.request

WAIT_SECONDS = 20
UNKNOWN = 1e6  # variance of what is not known
RADIUS_68, ANGLE_68 = 1.51, 0.994  # standard deviations that hold 68 % in a plane, and of an angle


def read_image(message):
    """Return stamp (seconds, nanoseconds), frame id and photo of a serialised CompressedImage."""
    order = "<" if message[1] & 1 else ">"
    data, offset = memoryview(message)[4:], 8
    stamp = struct.unpack_from(f"{order}iI", data)
    parts = []
    for _ in ("frame_id", "format", "data"):
        offset += -offset % 4
        (length,) = struct.unpack_from(f"{order}I", data, offset)
        parts.append(bytes(data[offset + 4 : offset + 4 + length]))
        offset += 4 + length
    return stamp, parts[0].rstrip(b"\0").decode(), parts[2]


def ask(server, photo, key="", **parameters):
    """Return the pose of a photo, or the reason why it has none with coordinates."""
    query = urllib.parse.urlencode({"pose": "true", "top_k": 1, "history": "false", **parameters})
    head = 'Content-Disposition: form-data; name="file"; filename="frame.jpg"\r\n\r\n'
    body = b"--frame\r\n" + head.encode() + photo + b"\r\n--frame--\r\n"
    headers = {
        "Content-Type": "multipart/form-data; boundary=frame",
        "Prefer": f"wait={WAIT_SECONDS}",
        **({"Authorization": f"Bearer {key}"} if key else {}),
    }
    request = urllib.request.Request(f"{server}/api/v1/similarity?{query}", body, headers)
    try:
        with urllib.request.urlopen(request, timeout=2 * WAIT_SECONDS) as response:
            answer = json.load(response)
    except OSError as error:
        return error.read().decode() if isinstance(error, urllib.error.HTTPError) else str(error)
    if not answer.get("pose"):
        return answer.get("no_pose") or "The frame was not described in time."
    return answer["pose"]["reason"] or answer["pose"]


def write_geopose(stamp, frame_id, pose):
    """Return a serialised GeoPoseWithCovarianceStamped of a body: x forward, y left, z up."""
    altitude = pose["altitude_m"]
    place = (pose["latitude"], pose["longitude"], math.nan if altitude is None else altitude)
    w, x, y, z = pose["enu_quaternion"]
    metres = (pose["radius_68_m"] / RADIUS_68) ** 2
    turn = math.radians(pose["heading_68_degrees"] / ANGLE_68) ** 2
    variances = (metres, metres, UNKNOWN if altitude is None else metres, turn, turn, turn)
    covariance = [variances[n // 6] if n % 7 == 0 else 0.0 for n in range(36)]
    name = frame_id.encode() + b"\0"
    head = struct.pack("<iII", *stamp, len(name)) + name
    head += bytes(-len(head) % 8)
    return b"\0\1\0\0" + head + struct.pack("<43d", *place, x, y, z, w, *covariance)


def main():
    import rclpy
    from geographic_msgs.msg import GeoPoseWithCovarianceStamped
    from sensor_msgs.msg import CompressedImage

    rclpy.init()
    node = rclpy.create_node("placewise_pose")
    names = {"server": "http://127.0.0.1:8000", "key": "", "map": "default", "focal_length": 0.0}
    values = {name: node.declare_parameter(name, value).value for name, value in names.items()}
    parameters = {name: value for name, value in values.items() if value}
    publisher = node.create_publisher(GeoPoseWithCovarianceStamped, "geopose", 1)

    def on_image(message):
        stamp, frame_id, photo = read_image(message)
        pose = ask(photo=photo, **parameters)
        if isinstance(pose, str):
            node.get_logger().info(pose)
        else:
            publisher.publish(write_geopose(stamp, frame_id, pose))

    # A queue of one: frames that arrive during a request are dropped, but for the last one.
    node.create_subscription(CompressedImage, "image/compressed", on_image, 1, raw=True)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
