"""Prove that a redacted recording differs from the original in its boxes alone.

    python tools/compare_redacted.py ORIGINAL REDACTED RULES

ORIGINAL and REDACTED are a .bag, .mcap or folder of rosbag2 each, RULES is the file given to
``mp4ds pack --redact``, with times in seconds from the beginning. Nothing here uses mp4ds:
recordings are read by rosbags and mcap, images by numpy and Pillow. Every message outside the rules
has to be equal to the byte; of the others, topic, times, header and all pixels outside the boxes,
of which at least one inside has to differ. A JPEG file may have become a PNG.
"""

from __future__ import annotations

import fnmatch
import io
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from mcap.reader import make_reader
from numpy.typing import NDArray
from PIL import Image
from rosbags import rosbag1, rosbag2

from compare_digest import Channel, decoded, protobuf_type

_NS = 10**9
_TYPES = {"8U": "u1", "8S": "i1", "16U": "u2", "16S": "i2", "32S": "i4", "32F": "f4", "64F": "f8"}
_COLOURS = {"mono": 1, "rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4}
_YUV = ("yuv422", "uyvy", "yuyv", "yuv422_yuy2")


@dataclass(frozen=True)
class Message:
    """A message as recorded."""

    channel: Channel
    time: int
    data: bytes


def read(path: Path) -> Iterator[Message]:
    """All messages, by log time."""
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                kind = schema.name if schema else ""
                definition = (schema.encoding, schema.data) if schema else None
                own = Channel(channel.topic, kind, channel.message_encoding, definition, ())
                yield Message(own, message.log_time, message.data)
        return
    recording: Any = rosbag1.Reader(path) if path.suffix == ".bag" else rosbag2.Reader(path)
    encoding = "ros1" if path.suffix == ".bag" else "cdr"
    with recording as bag:
        for found, time, data in bag.messages():
            yield Message(
                Channel(found.topic, found.msgtype, encoding, None, ()), time, bytes(data)
            )


def pairs(original: Path, redacted: Path) -> Iterator[tuple[Message | None, Message | None]]:
    """Messages of one topic and log time, in their order; None where one is missing."""
    waiting: tuple[dict[Any, list[Message]], ...] = ({}, {})
    for both in zip_longest(read(original), read(redacted)):
        for one, own, others in zip(both, waiting, waiting[::-1], strict=True):
            if one is None:
                continue
            key = one.channel.topic, one.time
            if key in others:
                other, *rest = others.pop(key)
                if rest:
                    others[key] = rest
                yield (other, one) if own is waiting[1] else (one, other)
            else:
                own.setdefault(key, []).append(one)
    yield from ((one, None) for found in waiting[0].values() for one in found)
    yield from ((None, one) for found in waiting[1].values() for one in found)


def parsed(message: Message) -> Any:
    """The fields of a message."""
    channel = message.channel
    if channel.encoding == "protobuf" and channel.definition:
        return protobuf_type(channel.definition[1], channel.type).FromString(message.data)
    return decoded(channel, message.data)


def header(fields: Any) -> str:
    """What is neither pixels nor tells how they are coded."""
    return str(getattr(fields, "header", None) or (fields.timestamp, fields.frame_id))


def pixels(fields: Any) -> NDArray[Any]:
    """The samples of an image, shape (rows, columns, channels)."""
    data = bytes(fields.data)
    if not hasattr(fields, "format"):
        name = fields.encoding
        kind, _, channels = name.partition("C")
        if name[:5] == "bayer":
            dtype, count = f"u{1 + name.endswith('16')}", 1
        elif name in _YUV:
            dtype, count = "u1", 2
        elif kind in _TYPES:
            dtype, count = _TYPES[kind], int(channels or 1)
        else:
            order = name.rstrip("0123456789")
            dtype, count = f"u{int(name[len(order) :]) // 8}", _COLOURS[order]
        dtype = (">" if fields.is_bigendian else "<") + dtype
        rows = np.frombuffer(data, np.uint8)[: fields.height * fields.step]
        rows = rows.reshape(fields.height, fields.step)
        used = rows[:, : fields.width * count * np.dtype(dtype).itemsize]
        return np.ascontiguousarray(used).view(dtype).reshape(fields.height, fields.width, count)
    start = 12 if "compressedDepth" in fields.format and data[:4] != b"\x89PNG" else 0
    with Image.open(io.BytesIO(data[start:])) as image:
        found = np.asarray(image.convert("RGB") if image.mode == "P" else image)
    return found.reshape(*found.shape[:2], -1)


def compare(original: Path, redacted: Path, rules: Path) -> tuple[list[str], dict[str, int]]:
    """What is not as it should be, and counts of what is."""
    told = yaml.safe_load(rules.read_text())["rules"]
    begin = min(message.time for message in islice(read(original), 1))
    counts = {"equal messages": 0, "changed images": 0, "pixels inside": 0, "pixels outside": 0}
    problems = []
    for old, new in pairs(original, redacted):
        if old is None or new is None:
            one = old or new
            problems.append(f"{one and one.channel.topic} at {one and one.time}: only in one")
            continue
        place = f"{old.channel.topic} at {old.time}"
        boxes = [rule["box"] for rule in told if _applies(rule, old, begin)]
        if not boxes:
            counts["equal messages"] += old.data == new.data
            if old.data != new.data:
                problems.append(f"{place}: the message differs")
            continue
        was, now = parsed(old), parsed(new)
        one, other = pixels(was), pixels(now)
        if header(was) != header(now) or one.shape != other.shape:
            problems.append(f"{place}: its header or size differs")
            continue
        inside = np.zeros(one.shape[:2], bool)
        for x, y, width, height in boxes:
            inside[y : y + height, x : x + width] = True
        differs = (one.view(f"u{one.itemsize}") != other.view(f"u{one.itemsize}")).any(2)
        counts["changed images"] += 1
        counts["pixels inside"] += int((differs & inside).sum())
        counts["pixels outside"] += int((differs & ~inside).sum())
        if (differs & ~inside).any() or not (differs & inside).any():
            problems.append(f"{place}: pixels outside differ, or none inside")
    return problems, counts


def _applies(rule: Any, message: Message, begin: int) -> bool:
    start, end = (Decimal(str(rule.get(name, 10**9))) * _NS for name in ("start", "end"))
    start = start if "start" in rule else Decimal(0)
    has_time = start <= message.time - begin < end
    is_image = "Image" in message.channel.type
    return has_time and is_image and fnmatch.fnmatchcase(message.channel.topic, rule["topic"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print problems and counts; 1 if there are any problems."""
    problems, counts = compare(*map(Path, sys.argv[1:] if arguments is None else arguments))
    for line in problems:
        print(line)
    print(", ".join(f"{what}: {count}" for what, count in counts.items()))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
