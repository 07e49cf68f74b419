"""What the recordings of `sources` hold: messages by field values, and odd images byte by byte.

Nothing here uses mp4ds, so that its tests have an independent source.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from definitions import IMAGE, INFO, TF, definitions
from pictures import ENCODINGS, YUV, picture

START = 1_700_000_000_000_000_000
PERIOD = 33_333_333


# ---------------------------------------------------------------- scenes


@dataclass(frozen=True)
class Record:
    """One message.

    Attributes:
        values: Field values; fields that are not named are zero or empty, times are nanoseconds.
        publisher: Several publishers of one topic are channels of their own.
        ros1: Ready payload for ROS 1, instead of the values.
        cdr: Ready payload for ROS 2, instead of the values.
    """

    topic: str
    msgtype: str
    log_time: int
    values: Mapping[str, Any] = field(default_factory=dict)
    publisher: int = 0
    ros1: bytes | None = None
    cdr: bytes | None = None

    def payload(self, encoding: str) -> bytes:
        """The message serialised as ``ros1`` or ``cdr``."""
        ready = self.ros1 if encoding == "ros1" else self.cdr
        if ready is not None:
            return ready
        store, message = typestore(encoding), build(encoding, self.msgtype, self.values)
        if encoding == "ros1":
            return bytes(store.serialize_ros1(message, self.msgtype))
        return bytes(store.serialize_cdr(message, self.msgtype, little_endian=True))


@dataclass
class Scene:
    """Messages in the order in which a recorder writes them.

    Attributes:
        silent: Topic -> type of topics that are known but on which nothing is published.
    """

    messages: list[Record]
    silent: dict[str, str] = field(default_factory=dict)

    def channels(self) -> dict[tuple[str, int], str]:
        """Type by topic and publisher, in order of appearance."""
        return {(m.topic, m.publisher): m.msgtype for m in self.messages}


@cache
def typestore(encoding: str) -> Any:
    """The standard types of ROS 1 (``ros1``) or ROS 2 (``cdr``), and those of `definitions`."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for msgtype, text in definitions(encoding).items():
        if msgtype not in store.types:
            store.register(get_types_from_msg(text, msgtype))
    return store


def build(encoding: str, msgtype: str, values: Mapping[str, Any]) -> Any:
    """A message object of rosbags; names are lower case in `values`."""
    store = typestore(encoding)
    fields = {}
    for name, (kind, detail) in store.fielddefs[msgtype][1]:
        given = values.get(name.lower())
        if kind == Nodetype.NAME:
            if isinstance(given, int):
                given = {"sec": given // 10**9, "nanosec": given % 10**9}
            fields[name] = build(encoding, detail, given or {})
        elif kind == Nodetype.BASE:
            fields[name] = given if given is not None else "" if detail[0] == "string" else 0
        else:
            (inner, inner_detail), count = detail
            if inner == Nodetype.NAME:
                fields[name] = [build(encoding, inner_detail, item) for item in given or ()]
            elif inner_detail[0] == "string":
                fields[name] = [*(given or ())]
            else:
                size = count if kind == Nodetype.ARRAY else 0
                if isinstance(given, bytes):
                    given = np.frombuffer(given, np.uint8)
                given = np.zeros(size) if given is None else np.asarray(given)
                fields[name] = given.astype(inner_detail[0])
    return store.types[msgtype](**fields)


def scene(
    encoding: str,
    *,
    frames: int = 8,
    width: int = 64,
    height: int = 48,
    seed: int = 0,
    frame_id: str = "cam",
    noisy: bool = True,
    with_info: bool = True,
    big_endian: bool = False,
    pad: int = 0,
    content: str = "full",
) -> Scene:
    """A camera with its calibration amid other topics; the same arguments give the same bytes.

    Topics are ``/cam/image_raw``, ``/cam/camera_info``, and those of `together`.

    Args:
        encoding: One of `ENCODINGS`.
        frames: Number of images.
        width: Image width, pixels; the next even number for YUV.
        height: Image height, pixels; the next even number for YUV.
        seed: Of the noise and the jitter of the times.
        frame_id: Of image and calibration.
        noisy: Add sensor noise.
        with_info: Publish a calibration with each image.
        big_endian: Set ``is_bigendian``, and swap the bytes of samples that have several.
        pad: Zero bytes after each row.
        content: One of `CONTENTS`.
    """
    rng = np.random.default_rng([seed, ENCODINGS.index(encoding)])
    if encoding in YUV:
        width, height = width + width % 2, height + height % 2
    made = partial(picture, encoding, width=width, height=height, content=content)
    groups = []
    for n in range(frames):
        stamp, log = instant(n, rng)
        pixels = made(frame=n, rng=rng if noisy else None)
        pixels = pixels.byteswap() if big_endian else pixels
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        head = {"seq": n + 7, "stamp": stamp, "frame_id": frame_id}
        size = {"header": head, "height": height, "width": width}
        image = size | {"encoding": encoding, "is_bigendian": int(big_endian)}
        image |= {"step": rows.shape[1], "data": rows.ravel()}
        group = [Record("/cam/image_raw", IMAGE, log, image)]
        if with_info:
            info = size | calibration(width, height)
            group.append(Record("/cam/camera_info", INFO, log + 90_000, info))
        groups.append(group)
    return together(groups)


def instant(n: int, rng: np.random.Generator) -> tuple[int, int]:
    """Header stamp and log time of a camera's n-th image, nanoseconds, with jitter."""
    stamp = START + n * PERIOD + int(rng.integers(-200_000, 200_000))
    return stamp, stamp + 4_000_000 + int(rng.integers(0, 500_000))


def together(groups: Iterable[Sequence[Record]]) -> Scene:
    """What a camera publishes for each image, amid the messages of other topics.

    These are ``/imu``, ``/tf`` and ``/chatter``, the last of three publishers. Two messages have
    the same log time, and two of ``/imu`` stand out of order in the file.
    """
    messages: list[Record] = []
    for n, group in enumerate(groups):
        messages += [*group, *_others(n, group[0].log_time)]
    messages.sort(key=lambda message: message.log_time)
    imu = [i for i, message in enumerate(messages) if message.topic == "/imu"]
    if len(imu) > 3:
        messages[imu[2]], messages[imu[3]] = messages[imu[3]], messages[imu[2]]
    return Scene(messages, {"/diagnostics": "std_msgs/msg/String"})


def calibration(width: int, height: int) -> dict[str, Any]:
    """Fields of a calibration that have the same names in ROS and Foxglove."""
    fx, cx, cy = 0.9 * width, width / 2 - 0.5, height / 2 - 0.5
    return {
        "distortion_model": "plumb_bob",
        "d": [-0.3, 0.1, 1e-3, -2e-4, 0.0],
        "k": [fx, 0, cx, 0, fx, cy, 0, 0, 1],
        "r": np.eye(3).ravel(),
        "p": [fx, 0, cx, 0, 0, fx, cy, 0, 0, 0, 1, 0],
    }


def _others(n: int, log: int) -> list[Record]:
    """What else is published around the n-th image, logged at `log` nanoseconds."""
    imu = [
        Record(
            "/imu",
            "sensor_msgs/msg/Imu",
            log + k * PERIOD // 4,
            {
                "header": {"seq": 4 * n + k, "stamp": log + k * PERIOD // 4, "frame_id": "imu"},
                "orientation": {"w": 1.0},
                "angular_velocity": {"x": 0.01 * n, "y": 0.02 * k, "z": -0.5},
                "linear_acceleration": {"z": 9.81},
            },
        )
        for k in range(4)
    ]
    link = {
        "header": {"seq": 0, "stamp": log, "frame_id": "map"},
        "child_frame_id": "base",
        "transform": {"translation": {"x": 0.1 * n}, "rotation": {"w": 1.0}},
    }
    tf = Record("/tf", TF, log + 1_000, {"transforms": [link]})
    # The same log time as /tf and, for two publishers, the same payload.
    words = {"data": f"frame {n // 3}"}
    said = Record("/chatter", "std_msgs/msg/String", log + 1_000, words, publisher=n % 3)
    return [*imu, tf, said]


# ---------------------------------------------------------------- raw messages


def raw_image(
    serialization: str,
    *,
    width: int,
    height: int,
    encoding: str,
    data: bytes,
    stamp: int | tuple[int, int] = START,
    seq: int = 0,
    frame_id: str = "cam",
    is_bigendian: int = 0,
    step: int | None = None,
    tail: bytes = b"",
    little_endian: bool = True,
    padding: bytes = b"\0",
    options: bytes = b"\0\0",
) -> bytes:
    """A ``sensor_msgs/Image`` of ROS 1 (``ros1``) or 2 (``cdr``), which need not be a sensible one.

    Args:
        serialization: Which has what it can hold of the following.
        width: Pixels.
        height: Pixels.
        encoding: Any string.
        data: Of any length, whatever step and height say.
        stamp: Nanoseconds, or (seconds, nanoseconds) to give an impossible one.
        seq: Sequence number of the header; of ROS 1.
        frame_id: Any string.
        is_bigendian: Any byte.
        step: Bytes a row; by default what `data` and `height` give.
        tail: Bytes after the message.
        little_endian: Byte order of the serialisation; of ROS 2, as what follows.
        padding: The byte that fills alignment gaps; real writers leave garbage there.
        options: Bytes 2 and 3 of the encapsulation header.
    """
    is_cdr = serialization == "cdr"
    step = len(data) // max(1, height) if step is None else step
    seconds, nanoseconds = divmod(stamp, 10**9) if isinstance(stamp, int) else stamp
    order, body = "<" if little_endian or not is_cdr else ">", bytearray()

    def numbers(*values: int) -> None:
        body.extend(padding * (-len(body) % 4 if is_cdr else 0))
        body.extend(struct.pack(f"{order}{len(values)}I", *(value % 2**32 for value in values)))

    def text(value: str) -> None:
        raw = value.encode() + b"\0" * is_cdr
        numbers(len(raw))
        body.extend(raw)

    numbers(*([] if is_cdr else [seq]), seconds, nanoseconds)
    text(frame_id)
    numbers(height, width)
    text(encoding)
    body.append(is_bigendian)
    numbers(step, len(data))
    head = bytes((0, little_endian)) + options if is_cdr else b""
    return head + bytes(body) + data + tail


image_ros1 = partial(raw_image, "ros1")
image_cdr = partial(raw_image, "cdr")

Trait = Callable[[int, bytes], Mapping[str, Any]]
# What changes in frame n of a plain 32 x 24 mono8 image whose pixels are given; `log` is the log
# time in nanoseconds. Each trait was seen in real recordings.
TRAITS: dict[str, Trait] = {
    "plain": lambda n, pixels: {},
    "cdr-padding-garbage": lambda n, pixels: {"padding": b"\x61"},
    "cdr-big-endian": lambda n, pixels: {"little_endian": False},
    "cdr-options": lambda n, pixels: {"options": b"\x00\x03"},
    "tail-bytes": lambda n, pixels: {"tail": b"\x00\xff\x00" if n % 2 else b"four"},
    "row-padding-zero": lambda n, pixels: {"data": _padded(pixels, b"\0\0\0\0"), "step": 36},
    "row-padding-garbage": lambda n, pixels: {"data": _padded(pixels, b"junk"), "step": 36},
    "row-padding-varied": lambda n, pixels: {
        "data": _padded(pixels, bytes([n % 3, 0, 255, n])),
        "step": 36,
    },
    "row-padding-not-last": lambda n, pixels: {
        "data": _padded(pixels, b"\xcd" * 4 if n % 2 else bytes(4))[:-4],
        "step": 36,
    },
    "data-short": lambda n, pixels: {"data": pixels[:-5], "step": 32},
    "data-long": lambda n, pixels: {"data": pixels + b"more", "step": 32},
    "data-empty": lambda n, pixels: {"data": b"" if n == 3 else pixels},
    "step-wrong": lambda n, pixels: {"step": 7},
    "size-zero": lambda n, pixels: {"width": 0, "height": 0, "data": b""},
    "size-odd": lambda n, pixels: {"width": 31, "height": 23, "data": pixels[: 31 * 23]},
    "size-change": lambda n, pixels: {"height": 12, "data": pixels[:384]} if n > 3 else {},
    "encoding-change": lambda n, pixels: {"encoding": "bayer_rggb8"} if n % 3 == 2 else {},
    "encoding-unknown": lambda n, pixels: {"encoding": "vendor 8 bit; v2 "},
    "mono8-bigendian-flag": lambda n, pixels: {"is_bigendian": 1},
    "frame-id-change": lambda n, pixels: {"frame_id": "" if n % 2 else "/cam/optical \u00e4"},
    "stamp-zero": lambda n, pixels: {"stamp": 0},
    "stamp-repeated": lambda n, pixels: {"stamp": START + n // 2 * PERIOD},
    "stamp-backward": lambda n, pixels: {"stamp": START - n * PERIOD},
    "stamp-impossible": lambda n, pixels: {"stamp": (2**32 - 1 - n, 3_999_999_999)},
    "seq-jumps": lambda n, pixels: {"seq": (2**32 - 3 + 5 * n) % 2**32},
    "log-equal": lambda n, pixels: {"log": START},
    "log-backward": lambda n, pixels: {"log": START - n * PERIOD},
    "log-tiny": lambda n, pixels: {"log": n + 1},
    "log-gap": lambda n, pixels: {"log": START + n * PERIOD + (n > 3) * 3_600 * 10**9},
}


def _padded(pixels: bytes, filler: bytes) -> bytes:
    return b"".join(pixels[i : i + 32] + filler for i in range(0, len(pixels), 32))


def odd_scene(trait: str, *, frames: int = 8) -> Scene:
    """Images on ``/odd/image`` with one trait of `TRAITS`, beside a plain topic."""
    rng = np.random.default_rng(1)
    messages = []
    for n in range(frames):
        pixels = picture("mono8", frame=n, width=32, height=24, rng=rng).tobytes()
        base = {"width": 32, "height": 24, "encoding": "mono8", "data": pixels}
        stamp = START + n * PERIOD
        values = {**base, "stamp": stamp, "seq": n, **TRAITS[trait](n, pixels)}
        log = values.pop("log", stamp + 5_000_000)
        ready = {name: raw_image(name, **values) for name in ("ros1", "cdr")}
        messages.append(Record("/odd/image", IMAGE, log, **ready))
        words = {"data": f"{n}"}
        messages.append(Record("/chatter", "std_msgs/msg/String", stamp, words))
    return Scene(messages)


def raw_scene(topic: str, msgtype: str, messages: Iterable[tuple[int, bytes, bytes]]) -> Scene:
    """A scene of ready payloads: log time (nanoseconds), ROS 1 bytes and CDR bytes of each."""
    return Scene([Record(topic, msgtype, t, ros1=ros1, cdr=cdr) for t, ros1, cdr in messages])
