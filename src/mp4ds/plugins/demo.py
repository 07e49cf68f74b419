"""A small recording to try mp4ds with: a drive past coloured discs, seen by two cameras.

Generated, so that the first command of the README needs only the package: a ROS 1 bag with a Bayer
and an RGB camera, their calibrations, IMU and tf. The same on every machine.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.convert import ros1_channel
from mp4ds.bags.formats import open_writer, recording_names
from mp4ds.errors import OptionError
from mp4ds.files.outputs import staged
from mp4ds.messages.serializations import plain_message
from mp4ds.messages.wire import CalibrationFields, Fields, ImageFields, Slots
from mp4ds.records import Channel, Message

START_NS = 1_712_647_128_027_473_200
WIDTH, HEIGHT = 480, 360
CAMERA_HZ = 15
IMU_HZ = 100
TF_HZ = 20
_NOISE = 2.0  # standard deviation, grey levels: like an indoor camera
_DISCS = 12
_IMAGE_TYPE = "sensor_msgs/Image"
_INFO_TYPE = "sensor_msgs/CameraInfo"


@dataclass(frozen=True)
class _Camera:
    name: str
    encoding: str
    channels: int
    offset: float  # metres beside the middle of the car


_CAMERAS = (_Camera("left", "bayer_rggb8", 1, 0.1), _Camera("right", "rgb8", 3, -0.1))


def demo(output: Path | str = "demo.bag", *, seconds: float = 3.0, force: bool = False) -> int:
    """Make the recording.

    Args:
        output: The .bag file to make.
        seconds: Length of the recording, from 0.1 to 3600.
        force: Replace an existing file.

    Returns:
        Number of messages.

    Raises:
        OptionError: The file is not a .bag, or the length is out of bounds.
        TargetError: The file cannot be written there.
    """
    if not 0.1 <= seconds <= 3600:  # not a number, too: older typers let it pass
        raise OptionError(f"A demo lasts from 0.1 to 3600 seconds, not {seconds:g}.")
    target = Path(os.path.abspath(output))  # noqa: PTH100 - keeps links, unlike resolve()
    if target.suffix != ".bag":
        raise OptionError(f"The demo is a ROS 1 bag, and {target.name!r} does not end in .bag.")
    channels = _channels()
    count = 0
    with (
        staged(target, force=force, owned=recording_names) as path,
        open_writer(
            path, "bag", name=target.name, profile="ros1", library="", storage=""
        ) as writer,
    ):
        for channel in channels.values():
            writer.add_channel(channel)
        for time, topic, payload in sorted(_messages(seconds), key=lambda item: item[:2]):
            writer.write(Message(channels[topic], time, time, 0, payload()))
            count += 1
    return count


def _channels() -> dict[str, Channel]:
    topics = {
        "/imu": ("sensor_msgs/Imu", "/imu_driver"),
        "/tf": ("tf2_msgs/TFMessage", "/odometry"),
    }
    for camera in _CAMERAS:
        topics[f"/{camera.name}/image_raw"] = (_IMAGE_TYPE, f"/{camera.name}_driver")
        topics[f"/{camera.name}/camera_info"] = (_INFO_TYPE, f"/{camera.name}_driver")
    return {
        topic: ros1_channel(number, topic, type_name, callerid)
        for number, (topic, (type_name, callerid)) in enumerate(topics.items())
    }


def _messages(seconds: float) -> Iterator[tuple[int, str, Callable[[], bytes]]]:
    rng = np.random.default_rng(1)
    # images are made as they are written: only one is in memory at a time
    for hertz, topic, make in ((IMU_HZ, "/imu", _imu), (TF_HZ, "/tf", _transform)):
        for seq in range(max(1, int(seconds * hertz))):
            stamp = START_NS + seq * 10**9 // hertz
            yield stamp + int(rng.integers(50_000, 400_000)), topic, partial(make, seq, stamp)
    for camera in _CAMERAS:
        for seq in range(max(1, int(seconds * CAMERA_HZ))):
            # a shutter that is sometimes a little late, and a driver that is later still
            stamp = START_NS + seq * 10**9 // CAMERA_HZ + int(rng.integers(0, 200_000))
            log_time = stamp + int(rng.integers(4_000_000, 9_000_000))
            yield log_time, f"/{camera.name}/image_raw", partial(_image, camera, seq, stamp)
            info = partial(_camera_info, camera, seq, stamp)
            yield log_time + 20_000, f"/{camera.name}/camera_info", info


def _image(camera: _Camera, seq: int, stamp: int) -> bytes:
    rgb = _view(camera, (stamp - START_NS) / 1e9)
    generator = np.random.default_rng((seq, camera.channels))
    noise = _NOISE * generator.standard_normal(rgb.shape, np.float32)
    pixels = np.clip(rgb + noise, 0, 255).astype(np.uint8)
    if camera.channels == 1:
        mosaic = np.empty((HEIGHT, WIDTH), np.uint8)
        for row, column, color in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):  # rggb
            mosaic[row::2, column::2] = pixels[row::2, column::2, color]
        pixels = mosaic
    fields = ImageFields(
        encoding=camera.encoding,
        width=WIDTH,
        height=HEIGHT,
        step=WIDTH * camera.channels,
        is_bigendian=0,
    )
    return _ros1(_IMAGE_TYPE, f"{camera.name}_optical", fields, Slots(stamp, seq), pixels.tobytes())


def _ros1(type_name: str, frame_id: str, fields: Fields, slots: Slots, body: bytes = b"") -> bytes:
    return plain_message("ros1", type_name, frame_id, fields, slots, body)


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


def _camera_info(camera: _Camera, seq: int, stamp: int) -> bytes:
    fx, cx, cy = 300.0, WIDTH / 2, HEIGHT / 2
    fields = CalibrationFields(
        height=HEIGHT,
        width=WIDTH,
        distortion_model="plumb_bob",
        d=(-0.31389, 0.088223, -0.000123, -0.001852, 0.0),
        k=(fx, 0.0, cx, 0.0, fx, cy, 0.0, 0.0, 1.0),
        r=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        p=(fx, 0.0, cx, -fx * camera.offset, 0.0, fx, cy, 0.0, 0.0, 0.0, 1.0, 0.0),
    )
    return _ros1(_INFO_TYPE, f"{camera.name}_optical", fields, Slots(stamp, seq))


def _header(seq: int, stamp: int, frame_id: str) -> bytes:
    name = frame_id.encode()
    return struct.pack(f"<IIII{len(name)}s", seq, *divmod(stamp, 10**9), len(name), name)


def _imu(seq: int, stamp: int) -> bytes:
    time = (stamp - START_NS) / 1e9
    orientation = (0.0, 0.0, 0.0, 1.0)
    turn = (0.0, 0.0, 0.05 * float(np.sin(time)))
    acceleration = (0.1 * float(np.cos(time)), 0.0, 9.81)
    covariance = (0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01)
    values = (*orientation, *covariance, *turn, *covariance, *acceleration, *covariance)
    return _header(seq, stamp, "imu") + struct.pack("<37d", *values)


def _transform(seq: int, stamp: int) -> bytes:
    child = b"base_link"
    position = (0.8 * (stamp - START_NS) / 1e9, 0.0, 0.0)
    return (
        struct.pack("<I", 1)
        + _header(seq, stamp, "odom")
        + struct.pack(f"<I{len(child)}s", len(child), child)
        + struct.pack("<7d", *position, 0.0, 0.0, 0.0, 1.0)
    )
