"""What `unpack --images` made, read and decoded by public libraries alone.

`read` reads a recording, `shown` gives the pictures of its camera messages, and `truth` those of
the messages of a scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.video.reformatter import VideoReformatter
from mcap.reader import make_reader
from mcap.records import Schema
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype

from definitions import CODED_IMAGE, CODED_VIDEO, COMPRESSED, IMAGE, PACKET, RAW_IMAGE
from pictures import pixels
from scenes import Record

Array = NDArray[Any]
CAMERAS = (IMAGE, COMPRESSED, PACKET, RAW_IMAGE, CODED_IMAGE, CODED_VIDEO)
# libswscale's flags: bicubic, full chroma in and out, accurate rounding, bit-exact
SMOOTH = 0x4 | 0x2000 | 0x4000 | 0x40000 | 0x80000


@dataclass(frozen=True)
class Read:
    """A message of a recording.

    Attributes:
        type_name: With ``/msg/``.
        value: The decoded message; None for what is not of ROS.
        metadata: Of its channel; the connection header of a bag.
    """

    topic: str
    type_name: str
    encoding: str
    log_time: int
    publish_time: int
    sequence: int
    payload: bytes
    value: Any
    metadata: dict[str, Any]

    @property
    def stamp(self) -> int:
        """Nanoseconds."""
        time = self.value.header.stamp if hasattr(self.value, "header") else self.value.timestamp
        return int(time.sec * 10**9 + time.nanosec)

    @property
    def frame_id(self) -> str:
        """Coordinate frame."""
        owner = self.value.header if hasattr(self.value, "header") else self.value
        return str(owner.frame_id)


def read(path: Path) -> list[Read]:
    """All messages in order, each decoded by the definition that the recording has of it."""
    return _read_mcap(path) if path.suffix == ".mcap" else _read_ros(path)


def _read_mcap(path: Path) -> list[Read]:
    found = []
    decoders: dict[int, Callable[[bytes], Any]] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(schema, channel.message_encoding)
            found.append(
                Read(
                    channel.topic,
                    normalize_msgtype(schema.name) if schema and "/" in schema.name else "",
                    channel.message_encoding,
                    message.log_time,
                    message.publish_time,
                    message.sequence,
                    message.data,
                    decoders[channel.id](message.data),
                    dict(channel.metadata),
                )
            )
    return found


def _decoder(schema: Schema | None, encoding: str) -> Callable[[bytes], Any]:
    if schema is None or encoding not in ("ros1", "cdr"):
        return lambda data: None
    name = normalize_msgtype(schema.name)
    store = get_typestore(Stores.EMPTY if encoding == "ros1" else Stores.ROS2_HUMBLE)
    types = get_types_from_msg(schema.data.decode(), name)
    store.register({key: known for key, known in types.items() if key not in store.types})
    decode = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda data: decode(data, name)


def _read_ros(path: Path) -> list[Read]:
    found = []
    with AnyReader([path]) as reader:
        for connection, time, payload in reader.messages():
            value = reader.deserialize(payload, connection.msgtype)
            extra: Any = connection.ext
            metadata: dict[str, Any] = {"digest": connection.digest}
            for name in ("callerid", "latching", "offered_qos_profiles"):
                metadata[name] = getattr(extra, name, None)
            encoding = "ros1" if path.suffix == ".bag" else "cdr"
            found.append(
                Read(
                    connection.topic,
                    connection.msgtype,
                    encoding,
                    time,
                    time,
                    0,
                    bytes(payload),
                    value,
                    metadata,
                )
            )
    return found


# ---------------------------------------------------------------- pictures


def truth(records: Sequence[Record]) -> list[Array]:
    """The pictures of a scene's camera messages: grey (H, W), or red, green, blue (and alpha)."""
    records = [record for record in records if record.msgtype in CAMERAS]
    if records[0].msgtype in (IMAGE, RAW_IMAGE):
        return [_in_rgb_order(pixels(r.values), r.values["encoding"]) for r in records]
    told = records[0].values.get("format") or records[0].values.get("encoding")
    if records[0].msgtype in (CODED_VIDEO, PACKET):
        return decoded(_decoder_of(told), _data(records))
    if "compressedDepth" in told:
        return [_depth(record.values["data"], told) for record in records]
    return [file_picture(data) for data in _data(records)]


def _decoder_of(told: str) -> str:
    """The decoder for what a message calls its codec, or the encoder that made it."""
    names = {"libx264": "h264", "libx265": "hevc", "h265": "hevc", "av1": "libdav1d"}
    name = told.partition(";")[0].partition("_")[0]
    return {"libsvtav1": "av1"}.get(name, names.get(name, name))


def _data(records: Sequence[Record]) -> list[bytes]:
    return [record.values["data"] for record in records]


def _depth(data: bytes, told: str) -> Array:
    coded = cv2.imdecode(np.frombuffer(data[12:], np.uint8), cv2.IMREAD_UNCHANGED)
    assert coded is not None
    if not told.startswith("32FC1"):
        return coded
    a, b = (float(value) for value in np.frombuffer(data[4:12], "<f4"))
    return np.where(coded == 0, np.nan, a / (np.maximum(coded, 1).astype(float) - b))


def _in_rgb_order(image: Array, encoding: str) -> Array:
    if encoding.startswith("bgr") or encoding[-2:] in ("C3", "C4"):
        return image[..., [2, 1, 0, 3][: image.shape[2]]]
    return image


def file_picture(data: bytes) -> Array:
    """What OpenCV sees in a file: grey, or red, green, blue (and alpha)."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image if image.ndim == 2 else image[..., [2, 1, 0, 3][: image.shape[2]]]


def decoded(codec: str, packets: Sequence[bytes]) -> list[Array]:
    """The pictures of packets, each of which must give one, in red, green and blue."""
    context: Any = av.CodecContext.create(codec, "r")
    context.thread_count = 1
    if codec == "h264":
        context.flags |= av.codec.context.Flags.low_delay
    frames = []
    for number, packet in enumerate(packets):
        given = av.Packet(packet)
        given.pts = given.dts = number
        frames += context.decode(given)
    frames += context.decode(None)
    assert [frame.pts for frame in frames] == list(range(len(packets)))
    convert = VideoReformatter().reformat
    smooth: Any = SMOOTH
    made = (convert(frame, format="rgb24", interpolation=smooth) for frame in frames)
    return [frame.to_ndarray() for frame in made]


def shown(messages: Sequence[Read]) -> list[Array]:
    """The pictures of messages of one type, as `truth` has them."""
    name = messages[0].type_name
    assert {message.type_name for message in messages} == {name}
    if name == IMAGE:
        found = []
        for message in messages:
            values = vars(message.value)
            found.append(_in_rgb_order(pixels(values), values["encoding"]))
        return found
    data = [message.value.data.tobytes() for message in messages]
    if name == COMPRESSED:
        return [file_picture(file) for file in data]
    assert name in (CODED_VIDEO, PACKET)
    value = messages[0].value
    return decoded(_decoder_of(value.format if name == CODED_VIDEO else value.encoding), data)


def subscribed(told: str, data: bytes) -> tuple[str, Array]:
    """Encoding and pixels that a subscriber of compressed_image_transport is given."""
    encoding, _, rest = told.partition(";")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    if encoding.startswith(("rgb", "bgr")):
        assert "compressed bgr" in rest
        if encoding.startswith(("rgba", "bgra")) and image.shape[2] == 3:
            opaque = np.full((*image.shape[:2], 1), np.iinfo(image.dtype).max, image.dtype)
            image = np.concatenate([image, opaque], axis=2)
        if encoding.startswith("rgb"):
            image = image[..., [2, 1, 0, 3][: image.shape[2]]]
    return encoding, image


def image_of(message: Read) -> Array:
    """The pixels in the order in which the message has them; those of a file as OpenCV has them."""
    if message.type_name == IMAGE:
        return pixels(vars(message.value))
    image = cv2.imdecode(message.value.data, cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def halved(image: Array) -> Array:
    """The mean of 2 x 2 pixels: decoders have chroma of half the resolution grow in their ways."""
    height, width = (side // 2 for side in image.shape[:2])
    blocks = image[: 2 * height, : 2 * width].astype(float)
    return blocks.reshape(height, 2, width, 2, -1).mean(axis=(1, 3))


def psnr(a: Array, b: Array, peak: float = 255) -> float:
    """Of pictures, grey ones as colours."""
    a, b = (x if x.ndim == 3 else np.repeat(x[..., None], 3, axis=2) for x in (a, b))
    error = np.mean((a[..., :3].astype(float) - b[..., :3].astype(float)) ** 2)
    return float(10 * np.log10(peak**2 / max(error, 1e-12)))
