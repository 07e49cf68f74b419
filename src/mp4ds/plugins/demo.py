"""A small recording to try mp4ds with: a drive past coloured discs, seen by two cameras.

Generated, so that the first command of the README needs only the package: a ROS 2 recording with a
Bayer and an RGB camera, their calibrations, IMU and transforms. The same on every machine.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.writer import serialize_dynamic
from numpy.typing import NDArray

from mp4ds.bags.convert import Converter, ros2_channel
from mp4ds.bags.formats import open_writer, recording_names
from mp4ds.bags.latched import DEFAULT_QOS, LATCHED_QOS
from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.protocols import BagWriter
from mp4ds.errors import OptionError
from mp4ds.files.outputs import local_target, staged
from mp4ds.records import Message

START_NS = 1_712_647_128_027_473_200
WIDTH, HEIGHT = 480, 360
CAMERA_HZ = 15
IMU_HZ = 100
TF_HZ = 20
_NOISE = 2.0  # standard deviation, grey levels: like an indoor camera
_DISCS = 12
_KINDS = {".mcap": "mcap", "": "rosbag2", ".bag": "bag"}
"""Suffix of the output -> format."""


@dataclass(frozen=True)
class _Camera:
    name: str
    encoding: str
    channels: int
    offset: float  # metres beside the middle of the car


_CAMERAS = (_Camera("left", "bayer_rggb8", 1, 0.1), _Camera("right", "rgb8", 3, -0.1))
_LATCHED = "/tf_static"
# topic -> type, and the node that publishes it
_TOPICS = {
    _LATCHED: ("tf2_msgs/msg/TFMessage", "/robot_state_publisher"),
    "/imu": ("sensor_msgs/msg/Imu", "/imu_driver"),
    "/tf": ("tf2_msgs/msg/TFMessage", "/odometry"),
    **{
        f"/{camera.name}/{name}": (f"sensor_msgs/msg/{kind}", f"/{camera.name}_driver")
        for camera in _CAMERAS
        for name, kind in (("image_raw", "Image"), ("camera_info", "CameraInfo"))
    },
}


def demo(output: Path | str = "demo.mcap", *, seconds: float = 3.0, force: bool = False) -> int:
    """Make the recording.

    Args:
        output: An .mcap file, a ROS 1 .bag, or, if the name has no suffix, a rosbag2 folder.
        seconds: Length of the recording, from 0.1 to 3600.
        force: Replace an existing recording.

    Returns:
        Number of messages.

    Raises:
        OptionError: The name has another suffix, or the length is out of bounds.
        TargetError: The recording cannot be written there.
    """
    if not 0.1 <= seconds <= 3600:  # not a number, too: older typers let it pass
        raise OptionError(f"A demo lasts from 0.1 to 3600 seconds, not {seconds:g}.")
    target = local_target(output)
    if target.suffix not in _KINDS:
        raise OptionError(
            f"The demo cannot be a {target.suffix} file. Name it .mcap, .bag (ROS 1), or "
            "without a suffix for a rosbag2 folder."
        )
    kind = _KINDS[target.suffix]
    with staged(target, force=force, owned=recording_names) as path:
        if kind == "mcap":  # rosbag2 does not compress, either
            writer: BagWriter = McapWriter(path, profile="ros2", compression="none")
        else:
            writer = open_writer(
                path, kind, name=target.name, profile="", library="", storage="mcap"
            )
        with writer:
            return _record(writer, seconds, is_ros1=kind == "bag")


def _record(writer: BagWriter, seconds: float, *, is_ros1: bool) -> int:
    converter, topics = Converter("ros1" if is_ros1 else None), {}
    for number, (topic, (type_name, node)) in enumerate(_TOPICS.items()):
        qos = LATCHED_QOS if topic == _LATCHED else DEFAULT_QOS
        channel = ros2_channel(number, topic, type_name, qos)
        definition = channel.schema.data.decode() if channel.schema else ""
        made = converter.channel(channel)
        if is_ros1:
            made = replace(made, metadata={**made.metadata, "callerid": node})
        writer.add_channel(made)
        topics[topic] = channel, serialize_dynamic(type_name, definition)[type_name], made
    messages = sorted(_messages(seconds), key=lambda item: item[:2])
    for time, topic, seq, make in messages:
        channel, encode, made = topics[topic]
        data = bytes(converter.payload(channel, encode(make())))
        if is_ros1 and not topic.startswith("/tf"):
            data = struct.pack("<I", seq) + data[4:]  # of the header
        writer.write(Message(made, time, time, seq, data))
    return len(messages)


# ---------------------------------------------------------------- messages

_Made = tuple[int, str, int, Callable[[], dict[str, Any]]]
"""Log time, topic, sequence number, and what makes the message."""


def _messages(seconds: float) -> Iterator[_Made]:
    rng = np.random.default_rng(1)
    yield START_NS, _LATCHED, 0, _mounts
    # images are made as they are written: only one is in memory at a time
    for hertz, topic, make in ((IMU_HZ, "/imu", _imu), (TF_HZ, "/tf", _odometry)):
        for seq in range(max(1, int(seconds * hertz))):
            stamp = START_NS + seq * 10**9 // hertz
            yield stamp + int(rng.integers(50_000, 400_000)), topic, seq, partial(make, stamp)
    for camera in _CAMERAS:
        for seq in range(max(1, int(seconds * CAMERA_HZ))):
            # a shutter that is sometimes a little late, and a driver that is later still
            stamp = START_NS + seq * 10**9 // CAMERA_HZ + int(rng.integers(0, 200_000))
            log_time = stamp + int(rng.integers(4_000_000, 9_000_000))
            image = partial(_image, camera, seq, stamp)
            yield log_time, f"/{camera.name}/image_raw", seq, image
            info = partial(_camera_info, camera, stamp)
            yield log_time + 20_000, f"/{camera.name}/camera_info", seq, info


def _header(stamp: int, frame_id: str) -> dict[str, Any]:
    sec, nanosec = divmod(stamp, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}


def _image(camera: _Camera, seq: int, stamp: int) -> dict[str, Any]:
    rgb = _view(camera, (stamp - START_NS) / 1e9)
    generator = np.random.default_rng((seq, camera.channels))
    noise = _NOISE * generator.standard_normal(rgb.shape, np.float32)
    pixels = np.clip(rgb + noise, 0, 255).astype(np.uint8)
    if camera.channels == 1:
        mosaic = np.empty((HEIGHT, WIDTH), np.uint8)
        for row, column, color in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):  # rggb
            mosaic[row::2, column::2] = pixels[row::2, column::2, color]
        pixels = mosaic
    return {
        "header": _header(stamp, f"{camera.name}_optical"),
        "height": HEIGHT,
        "width": WIDTH,
        "encoding": camera.encoding,
        "is_bigendian": 0,
        "step": WIDTH * camera.channels,
        "data": pixels.tobytes(),
    }


def _view(camera: _Camera, time: float) -> NDArray[np.float32]:
    """A camera's view: a floor, a wall, approaching discs. Shape (H, W, 3), 0 to 255."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    shade = 90 + 60 * (y / HEIGHT) + 12 * np.sin(x / 9 + time) * (y > HEIGHT / 2)
    picture: NDArray[np.float32] = np.stack([shade, shade * 0.95, shade * 0.85], axis=-1)
    rng = np.random.default_rng(7)
    depths = rng.uniform(2, 9, _DISCS)
    places, colors = rng.uniform(-2, 2, (_DISCS, 2)), rng.uniform(30, 230, (_DISCS, 3))
    distances = 1.0 + (depths - 1.0 - 0.8 * time) % 8.0
    for index in np.argsort(-distances):
        depth, radius = distances[index], 120 / distances[index]
        center_x = WIDTH / 2 + 300 * (places[index, 0] - camera.offset) / depth
        center_y = HEIGHT / 2 + 150 * places[index, 1] / depth
        rows = slice(max(0, int(center_y - radius)), max(0, int(center_y + radius) + 2))
        columns = slice(max(0, int(center_x - radius)), max(0, int(center_x + radius) + 2))
        away = np.hypot(x[rows, columns] - center_x, y[rows, columns] - center_y)[..., None]
        cover = np.clip(radius - away, 0, 1)
        disc = colors[index] * (1 + 0.15 * np.sin(away / 3))
        picture[rows, columns] += (disc - picture[rows, columns]) * cover
    return picture


def _camera_info(camera: _Camera, stamp: int) -> dict[str, Any]:
    fx, cx, cy = 300.0, WIDTH / 2, HEIGHT / 2
    return {
        "header": _header(stamp, f"{camera.name}_optical"),
        "height": HEIGHT,
        "width": WIDTH,
        "distortion_model": "plumb_bob",
        "d": [-0.31389, 0.088223, -0.000123, -0.001852, 0.0],
        "k": [fx, 0.0, cx, 0.0, fx, cy, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [fx, 0.0, cx, -fx * camera.offset, 0.0, fx, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }


def _imu(stamp: int) -> dict[str, Any]:
    time = (stamp - START_NS) / 1e9
    covariance = [0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01]
    return {
        "header": _header(stamp, "imu"),
        "orientation": {"w": 1.0},
        "orientation_covariance": covariance,
        "angular_velocity": {"z": 0.05 * float(np.sin(time))},
        "angular_velocity_covariance": covariance,
        "linear_acceleration": {"x": 0.1 * float(np.cos(time)), "z": 9.81},
        "linear_acceleration_covariance": covariance,
    }


def _odometry(stamp: int) -> dict[str, Any]:
    position = {"x": 0.8 * (stamp - START_NS) / 1e9}
    return {"transforms": [_transform(stamp, "odom", "base_link", position, {"w": 1.0})]}


def _mounts() -> dict[str, Any]:
    forward = {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}  # an optical frame's z axis
    mounts = [
        (f"{camera.name}_optical", {"x": 0.3, "y": camera.offset, "z": 0.4}, forward)
        for camera in _CAMERAS
    ]
    mounts.append(("imu", {}, {"w": 1.0}))
    return {"transforms": [_transform(START_NS, "base_link", *mount) for mount in mounts]}


def _transform(
    stamp: int, parent: str, child: str, position: dict[str, float], rotation: dict[str, float]
) -> dict[str, Any]:
    return {
        "header": _header(stamp, parent),
        "child_frame_id": child,
        "transform": {"translation": position, "rotation": rotation},
    }
