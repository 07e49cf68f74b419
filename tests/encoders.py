"""Coded pictures and video packets from public encoders, and edits of their bytes.

OpenCV, Pillow and PyAV encode, as the drivers and transports of ROS do. Nothing here uses
mp4ds, so that its tests have an independent source.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from typing import Any

import av
import cv2
import numpy as np
from av.video.frame import PictureType
from numpy.typing import NDArray
from PIL import Image

from mp4ds.video.pixels import ONE_THREAD
from pictures import picture

Pixels = NDArray[Any]


# ---------------------------------------------------------------- single pictures


def cv(pixels: Pixels, extension: str, *options: int) -> bytes:
    """``cv2.imencode``: grey, or colours in the order blue, green, red (, alpha)."""
    done, data = cv2.imencode(extension, pixels, options)
    if not done:
        raise ValueError(f"OpenCV does not encode {extension}")
    return data.tobytes()


def pillow(pixels: Pixels, kind: str, *, mode: str = "", **options: Any) -> bytes:
    """Pillow's ``save``: grey (8 or 16 bits), or colours in the order red, green, blue."""
    image = Image.fromarray(np.ascontiguousarray(pixels))
    stream = io.BytesIO()
    (image.convert(mode) if mode else image).save(stream, kind, **options)
    return stream.getvalue()


def exif() -> bytes:
    """What a camera tells in a JPEG's APP1."""
    told = Image.Exif()
    told[0x010F], told[0x0110], told[0x0112] = "Maker", "Camera 7", 6
    return told.tobytes()


def without_huffman_tables(data: bytes) -> bytes:
    """A baseline JPEG of the standard tables as webcams send it: without the tables."""
    kept, at = data[:2], 2
    while data[at + 1] != 0xDA:  # the first scan
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        kept += data[at:end] if data[at + 1] != 0xC4 else b""
        at = end
    return kept + data[at:]


# ---------------------------------------------------------------- compressedDepth


def rvl(depth: NDArray[np.uint16]) -> bytes:
    """RVL (Wilson, Fast Lossless Depth Image Compression, 2017), a nibble at a time.

    Runs of zeros and of other values alternate; of the latter, differences to the value before
    are zigzag coded. Every number becomes nibbles of three bits, lowest first, with the high bit
    set on all but the last; eight nibbles are a little-endian word, first nibble highest.
    """
    numbers: list[int] = []
    values, at, before = depth.ravel().tolist(), 0, 0
    while at < len(values):
        for zero in (True, False):
            start = at
            while at < len(values) and (values[at] == 0) == zero:
                at += 1
            numbers.append(at - start)
        for value in values[start:at]:
            delta = value - before
            numbers.append(2 * delta if delta >= 0 else -2 * delta - 1)
            before = value
    return rvl_words([nibble for number in numbers for nibble in rvl_nibbles(number)])


def rvl_nibbles(number: int) -> list[int]:
    """A number of RVL in nibbles."""
    nibbles = []
    while number > 7:
        nibbles.append(number & 7 | 8)
        number >>= 3
    return [*nibbles, number]


def rvl_words(nibbles: list[int]) -> bytes:
    """Nibbles of RVL in words, filled up with zeros."""
    nibbles = nibbles + [0] * (-len(nibbles) % 8)
    digits = "".join(f"{nibble:x}" for nibble in nibbles)
    words = [int(digits[i : i + 8], 16) for i in range(0, len(digits), 8)]
    return struct.pack(f"<{len(words)}I", *words)


def quantised(metres: Pixels) -> tuple[Pixels, bytes]:
    """Inverse depth as compressed_depth_image_transport computes it, and its two parameters.

    Returns:
        uint16, 0 where nothing was seen or beyond 10 m; two little-endian float32.
    """
    a = np.float32(100) * np.float32(101)
    b = np.float32(1) - a / np.float32(10)
    seen = metres < 10  # false for NaN
    inverse = np.where(seen, a / np.where(seen, metres, 1) + b, 0)
    return inverse.astype(np.uint16), struct.pack("<2f", a, b)


def compressed_depth(depth: Pixels, codec: str, parameters: bytes) -> bytes:
    """A 12-byte header (int32 format 0, 8 bytes of parameters), then PNG, or size and RVL."""
    head = struct.pack("<i", 0) + parameters
    if codec == "png":
        return head + cv(depth, ".png", cv2.IMWRITE_PNG_COMPRESSION, 9)
    return head + struct.pack("<2I", *depth.shape[::-1]) + rvl(depth)


# ---------------------------------------------------------------- video


@dataclass(frozen=True)
class Packet:
    """One packet of an encoder, in coding order.

    Attributes:
        number: Of the frame that it shows.
    """

    data: bytes
    number: int
    is_key: bool


_LIVE = (("preset", "ultrafast"), ("tune", "zerolatency"))
_QUIET = "log-level=error:pools=none:frame-threads=1:repeat-headers=1"
# Each name is an encoder, its pixel format and options. Key frames come every GOP frames.
RECIPES: dict[str, tuple[str, str, tuple[tuple[str, str], ...]]] = {
    "h264": ("libx264", "yuv420p", _LIVE),
    "h264-slices": ("libx264", "yuv420p", (*_LIVE, ("x264-params", "slices=3:aud=1"))),
    "h264-bframes": (
        "libx264",
        "yuv420p",
        (("preset", "veryfast"), ("x264-params", "bframes=2:b-adapt=0")),
    ),
    "h265": ("libx265", "yuv420p", (*_LIVE, ("x265-params", _QUIET))),
    "h265-bframes": (
        "libx265",
        "yuv420p",
        (("preset", "veryfast"), ("x265-params", f"{_QUIET}:bframes=2:b-adapt=0:aud=1")),
    ),
    "av1": ("libsvtav1", "yuv420p", (("preset", "10"), ("svtav1-params", "pred-struct=1:lp=1"))),
    "vp9": (
        "libvpx-vp9",
        "yuv420p",
        tuple({"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0"}.items()),
    ),
    "mjpeg": ("mjpeg", "yuvj420p", ()),
}
GOP = 4


@cache
def packets(name: str, *, frames: int, width: int, height: int, seed: int = 0) -> list[Packet]:
    """Packets of a moving picture, parameter sets in each key frame; H.26x as Annex B.

    Args:
        name: One of `RECIPES`.
        frames: Number of frames.
        width: Pixels.
        height: Pixels.
        seed: Of the noise.
    """
    encoder, pixel_format, options = RECIPES[name]
    rng = np.random.default_rng(seed)
    pictures = (
        np.ascontiguousarray(picture("rgb8", frame=n, width=width, height=height, rng=rng))
        for n in range(frames)
    )
    return encoded(encoder, pixel_format, {"g": str(GOP), **dict(options)}, pictures)


def encoded(
    encoder: str,
    pixel_format: str,
    options: dict[str, str],
    pictures: Iterable[Pixels],
    *,
    all_p: bool = False,
) -> list[Packet]:
    """Packets of RGB pictures; with `all_p`, without B-frames though they are allowed."""
    os.environ.setdefault("SVT_LOG", "0")
    context: Any = av.CodecContext.create(encoder, "w")
    packets: list[Any] = []
    for number, pixels in enumerate(pictures):
        if not number:
            context.height, context.width = pixels.shape[:2]
            context.pix_fmt, context.thread_count = pixel_format, 1
            context.time_base, context.framerate = Fraction(1, 30), Fraction(30)
            context.options = options
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
        frame = frame.reformat(format=pixel_format, **ONE_THREAD)
        frame.pts = number
        if all_p and number:
            frame.pict_type = PictureType.P
        packets += context.encode(frame)
    packets += context.encode(None)
    return [Packet(bytes(packet), packet.pts, packet.is_keyframe) for packet in packets]


def nal_units(data: bytes) -> list[tuple[int, bytes]]:
    """NAL units of an Annex B packet, each after the length of its start code (3 or 4)."""
    before, *parts = data.split(b"\0\0\1")
    long = [part.endswith(b"\0") for part in (before, *parts[:-1])]
    next_long = [*long[1:], False]
    return [
        (3 + zero, part[:-1] if next_zero else part)
        for part, zero, next_zero in zip(parts, long, next_long, strict=True)
    ]


def annexb(units: Iterable[tuple[int, bytes]]) -> bytes:
    """The packet of NAL units and the lengths of their start codes; inverse of `nal_units`."""
    return b"".join(b"\1".rjust(length, b"\0") + unit for length, unit in units)


def with_start_codes(packet: Packet, length: int) -> Packet:
    """All start codes of one length."""
    return replace(packet, data=annexb((length, unit) for _, unit in nal_units(packet.data)))


def with_aud_and_sei(packet: Packet) -> Packet:
    """H.264 with a delimiter first, and a user's SEI message before the slices."""
    text = bytes(range(16)) + b"exposure %d" % packet.number
    units = nal_units(packet.data)
    first = next(i for i, (_, unit) in enumerate(units) if unit[0] & 31 in (1, 5))
    units.insert(first, (4, bytes((6, 5, len(text))) + text + b"\x80"))
    return replace(packet, data=annexb([(4, b"\x09\xf0"), *units]))


def length_prefixed(packet: Packet) -> Packet:
    """NAL units as MP4 has them, which Annex B is not."""
    units = (unit for _, unit in nal_units(packet.data))
    return replace(packet, data=b"".join(struct.pack(">I", len(unit)) + unit for unit in units))


def without_parameters(packet: Packet) -> Packet:
    """H.264 without SPS and PPS."""
    units = [pair for pair in nal_units(packet.data) if pair[1][0] & 31 not in (7, 8)]
    return replace(packet, data=annexb(units))


def parameters_apart(given: Sequence[Packet]) -> list[Packet]:
    """H.264 with SPS and PPS in packets of their own, as some drivers hand them out."""
    apart: list[Packet] = []
    for packet in given:
        units = nal_units(packet.data)
        if sets := [pair for pair in units if pair[1][0] & 31 in (7, 8)]:
            apart.append(replace(packet, data=annexb(sets)))
        apart.append(without_parameters(packet))
    return apart


def without_delimiter(packet: Packet) -> Packet:
    """An AV1 temporal unit without the delimiter that begins it."""
    if not packet.data.startswith(b"\x12\0"):
        raise ValueError("no temporal delimiter")
    return replace(packet, data=packet.data[2:])
