"""Recordings of the benchmarks' clips, written with rosbags and mcap alone, as a robot writes them.

One camera: an image and a CameraInfo per frame, with jittered stamps and log times.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
TOPIC = "/camera/image_raw"
TOPICS = {TOPIC: IMAGE, "/camera/camera_info": INFO}
START_NS = 1_712_647_128_027_473_200
HERTZ = 30
CHUNK_BYTES = 1 << 20  # the MCAP libraries' own default
_ROWS = {"nv12": Fraction(3, 2)}  # of the array for each of the image, where not 1
_QOS = """\
- history: 1
  depth: 10
  reliability: 2
  durability: 2
"""


@cache
def _store(ros: int) -> Any:
    return get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)


def times(hertz: float) -> Iterator[tuple[int, int]]:
    """Header stamps and log times of a camera, nanoseconds: shutter and driver are both late."""
    rng = np.random.default_rng(1)
    for number in count():
        stamp = START_NS + int(number * 1e9 / hertz) + int(rng.integers(0, 200_000))
        yield stamp, stamp + int(rng.integers(2_000_000, 6_000_000))


def write_mcap(
    path: Path, frames: Iterable[Any], encoding: str, *, compression: str, hertz: float = HERTZ
) -> None:
    """A ROS 2 recording.

    Args:
        path: The file to write.
        frames: Pixels of each image, taken one by one.
        encoding: ROS image encoding.
        compression: Of the chunks: ``zstd``, ``lz4`` or ``none``.
        hertz: Frames per second.
    """
    store = _store(2)
    with path.open("wb") as stream:
        writer = Writer(
            stream, chunk_size=CHUNK_BYTES, compression=CompressionType[compression.upper()]
        )
        writer.start("ros2", "recorder")
        channels = {}
        for topic, msgtype in TOPICS.items():
            definition = store.generate_msgdef(msgtype, ros_version=2)[0].encode()
            schema = writer.register_schema(msgtype, "ros2msg", definition)
            channels[topic] = writer.register_channel(
                topic, "cdr", schema, {"offered_qos_profiles": _QOS}
            )
        for number, (topic, stamp, time, message) in enumerate(
            _messages(frames, encoding, hertz, ros=2)
        ):
            payload = store.serialize_cdr(message, TOPICS[topic])
            writer.add_message(channels[topic], time, payload, (stamp + time) // 2, number)
        writer.finish()  # type: ignore[no-untyped-call]


def write_bag(path: Path, frames: Iterable[Any], encoding: str, *, hertz: float = HERTZ) -> None:
    """A ROS 1 bag without compression, as ``rosbag record`` writes it."""
    store = _store(1)
    with BagWriter(path) as writer:
        connections = {
            topic: writer.add_connection(topic, msgtype, typestore=store, callerid="/driver")
            for topic, msgtype in TOPICS.items()
        }
        for topic, _, time, message in _messages(frames, encoding, hertz, ros=1):
            payload = store.serialize_ros1(message, TOPICS[topic])
            writer.write(connections[topic], time, payload)


def _messages(
    frames: Iterable[Any], encoding: str, hertz: float, *, ros: int
) -> Iterator[tuple[str, int, int, Any]]:
    """Topic, stamp, log time and message of each, in log-time order."""
    for seq, (pixels, (stamp, time)) in enumerate(zip(frames, times(hertz), strict=False)):
        header = _header(seq, stamp, ros)
        height, width = image_size(pixels, encoding)
        yield TOPIC, stamp, time, _image(header, pixels, encoding, ros)
        yield "/camera/camera_info", stamp, time + 20_000, _info(header, height, width, ros)


def image_size(pixels: NDArray[Any], encoding: str) -> tuple[int, int]:
    """Height and width of the image whose array this is."""
    rows, columns = pixels.shape[:2]
    return int(rows / _ROWS.get(encoding, 1)), columns


def _header(seq: int, stamp: int, ros: int) -> Any:
    types = _store(ros).types
    time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    header = types["std_msgs/msg/Header"]
    frame_id = "camera_optical"
    return header(seq, time, frame_id) if ros == 1 else header(time, frame_id)


def _image(header: Any, pixels: NDArray[Any], encoding: str, ros: int) -> Any:
    data = np.ascontiguousarray(pixels)
    height, width = image_size(data, encoding)
    step = data.nbytes // len(data)
    return _store(ros).types[IMAGE](
        header, height, width, encoding, 0, step, data.reshape(-1).view(np.uint8)
    )


def _info(header: Any, height: int, width: int, ros: int) -> Any:
    types = _store(ros).types
    k = np.array([width, 0, width / 2, 0, width, height / 2, 0, 0, 1.0])
    return types[INFO](
        header,
        height,
        width,
        "plumb_bob",
        np.array([-0.31, 0.088, -0.0001, -0.0018, 0.0]),
        k,
        np.eye(3).reshape(-1),
        np.insert(k.reshape(3, 3), 3, 0.0, axis=1).reshape(-1),
        0,
        0,
        types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    )
