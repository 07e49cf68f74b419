"""Any camera messages at all: what is packed comes back, byte for byte.

Hypothesis makes up headers, geometries, bytes and their order; tools/compare.py, which shares no
code with the package, tells whether they are equal.
"""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from definitions import COMPRESSED, IMAGE
from encoders import compressed_depth, cv, pillow
from pictures import ENCODINGS, YUV, picture, rows_of, sample_format
from round_trips import journey, own_target
from scenes import START, Record, Scene, image_cdr, image_ros1, odd_scene
from sources import SOURCES

steady = settings(
    max_examples=30,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
BOTH = pytest.mark.parametrize(
    "source", ["bag-none", pytest.param("mcap-ros2-none", marks=pytest.mark.slow)]
)

# text that UTF-8 can hold; ROS 1 counts its bytes, CDR ends it with one of zero
Texts = st.sampled_from(["cam", "", "/cam/optical"]) | st.text(
    st.characters(exclude_categories=["Cs"]), max_size=20
)
Word = st.integers(0, 2**32 - 1)
Stamps = st.tuples(Word, st.integers(0, 10**9 - 1) | Word) | st.integers(START, START + 10**12).map(
    lambda stamp: divmod(stamp, 10**9)
)
# a bag counts seconds in 32 bits
LogTimes = st.integers(0, 2**32 * 10**9 - 1) | st.integers(START, START + 10**10)


def check_return(source: str, records: list[Record]) -> None:
    """Messages beside a plain topic make a round trip."""
    recorded = Scene([*records, *odd_scene("plain", frames=2).messages])
    with tempfile.TemporaryDirectory() as folder:
        done = journey(Path(folder), SOURCES[source], recorded, own_target(source))
        messages, frames = done.frames(records[0].topic)
        event(f"in videos: {'all' if frames == messages else 'some' if frames else 'none'}")


# ---------------------------------------------------------------- raw images


@dataclass(frozen=True)
class Geometry:
    """What a stream's images have in common.

    Attributes:
        pad: Bytes after each row.
    """

    encoding: str
    width: int
    height: int
    pad: int
    is_bigendian: int


@st.composite
def geometries(draw: st.DrawFn) -> Geometry:
    encoding = draw(st.sampled_from(ENCODINGS))
    sides = st.integers(24, 48) | st.integers(1, 16)
    width, height = draw(sides), draw(sides)
    if encoding in YUV and draw(st.integers(0, 9)) < 9:  # else odd sides, which YUV cannot have
        width, height = width + width % 2, height + height % 2
    pad = draw(st.sampled_from([0, 0, 0, 1, 7, 64]))
    return Geometry(encoding, width, height, pad, draw(st.sampled_from([0, 0, 1, 255])))


@st.composite
def pixel_bytes(draw: st.DrawFn, geometry: Geometry) -> bytes:
    """All rows of an image, padding included."""
    encoding, width, height = geometry.encoding, geometry.width, geometry.height
    dtype, samples = sample_format(encoding)
    rows, row_bytes = rows_of(encoding, height), width * samples * dtype.itemsize
    kinds = ["picture", "picture", "picture", "still", "random", "constant", "few"]
    kind = draw(st.sampled_from(kinds))
    seed = draw(st.integers(0, 2**16))
    rng = np.random.default_rng(seed)
    if kind in ("picture", "still") and not (encoding in YUV and (width % 2 or height % 2)):
        frame, noise = (seed % 50, rng) if kind == "picture" else (3, None)
        made = picture(encoding, frame=frame, width=width, height=height, rng=noise)
        made = made.byteswap() if geometry.is_bigendian and dtype.itemsize > 1 else made
        body = np.ascontiguousarray(made).view(np.uint8).reshape(rows, row_bytes)
    elif kind == "constant":
        body = np.full((rows, row_bytes), seed % 256, np.uint8)
    elif kind == "few":
        values = rng.integers(0, 256, (3, dtype.itemsize), np.uint8)
        chosen = values[rng.integers(0, 3, (rows, row_bytes // dtype.itemsize))]
        body = chosen.reshape(rows, row_bytes)
    else:
        body = rng.integers(0, 256, (rows, row_bytes), np.uint8)
    filler = draw(st.sampled_from([*[b"\0"] * 5, b"\xa5"]))
    return b"".join(row.tobytes() + filler * geometry.pad for row in body)


@st.composite
def raw_images(draw: st.DrawFn) -> list[Record]:
    """One to ten images on a topic, whose geometry, frame and serialization may change."""
    records = []
    geometry, frame_id = draw(geometries()), draw(Texts)
    for seq in range(draw(st.integers(1, 10))):
        if draw(st.integers(0, 5)) == 5:
            geometry = draw(geometries())
        if draw(st.integers(0, 5)) == 5:
            frame_id = draw(Texts)
        data = draw(pixel_bytes(geometry))
        if draw(st.integers(0, 15)) == 15:
            data = draw(st.sampled_from([b"", data[:-1], data + b"\0"]))
        _, samples = sample_format(geometry.encoding)
        itemsize = sample_format(geometry.encoding)[0].itemsize
        common: dict[str, Any] = {
            "width": geometry.width,
            "height": geometry.height,
            "encoding": geometry.encoding,
            "step": geometry.width * samples * itemsize + geometry.pad,
            "is_bigendian": geometry.is_bigendian,
            "data": data,
            "stamp": draw(Stamps),
            "frame_id": frame_id,
            "tail": draw(st.sampled_from([*[b""] * 8, b"\0", b"tail"])),
        }
        in_cdr: Mapping[str, Any] = {
            "little_endian": draw(st.sampled_from([True, True, True, False])),
            "padding": draw(st.sampled_from([b"\0", b"\0", b"\x61"])),
            "options": draw(st.sampled_from([b"\0\0", b"\0\0", b"\0\3"])),
        }
        ros1 = image_ros1(**common, seq=draw(st.just(seq) | Word))
        cdr = image_cdr(**common, **in_cdr)
        records.append(Record("/cam", IMAGE, draw(LogTimes), ros1=ros1, cdr=cdr))
    return records


@BOTH
@steady
@given(raw_images())
def test_any_raw_images_return(source: str, records: list[Record]) -> None:
    check_return(source, records)


# ---------------------------------------------------------------- coded images


@st.composite
def coded_bodies(draw: st.DrawFn) -> bytes:
    """A file of one of several encoders, or what is left of it."""
    width, height = draw(st.integers(1, 48)), draw(st.integers(1, 48))
    rng = np.random.default_rng(draw(st.integers(0, 2**16)))

    def made(encoding: str) -> Any:
        return picture(encoding, frame=1, width=width, height=height, rng=rng)

    encoding = draw(st.sampled_from(["mono8", "rgb8"]))
    kind = draw(st.sampled_from(["jpeg", "png", "cv-png", "depth-png", "depth-rvl", "garbage"]))
    if kind == "jpeg":
        options = draw(
            st.fixed_dictionaries(
                {"quality": st.integers(1, 100), "progressive": st.booleans()},
                optional={
                    "subsampling": st.sampled_from([0, 1, 2]),
                    "restart_marker_blocks": st.integers(1, 5),
                    "comment": st.binary(max_size=9),
                },
            )
        )
        data = pillow(made(encoding), "JPEG", **options)
    elif kind == "png":
        data = pillow(made(encoding), "PNG", compress_level=draw(st.integers(0, 9)))
    elif kind == "cv-png":
        kinds = ["mono8", "bgr8", "bgra8", "mono16", "rgb16", "rgba16"]
        level = draw(st.integers(0, 9))
        pixels = made(draw(st.sampled_from(kinds)))
        data = cv(pixels, ".png", cv2.IMWRITE_PNG_COMPRESSION, level)
    elif kind == "garbage":
        data = draw(st.binary(max_size=100))
    else:
        parameters = draw(st.binary(min_size=8, max_size=8))
        depth = made("16UC1") >> draw(st.integers(0, 8))
        data = compressed_depth(depth, kind[6:], parameters)
    change = draw(st.sampled_from([*["none"] * 9, "cut", "flip", "append"]))
    if change == "cut":
        return data[: draw(st.integers(0, len(data)))]
    if change == "append":
        return data + draw(st.binary(max_size=9))
    if change == "flip" and data:
        place = draw(st.integers(0, len(data) - 1))
        return data[:place] + bytes([data[place] ^ 255]) + data[place + 1 :]
    return data


def coded_ros1(
    seq: int, stamp: tuple[int, int], frame_id: bytes, told: bytes, data: bytes
) -> bytes:
    """A ROS 1 ``sensor_msgs/CompressedImage``."""
    texts = (struct.pack("<I", len(raw)) + raw for raw in (frame_id, told, data))
    return struct.pack("<III", seq, *stamp) + b"".join(texts)


def coded_cdr(stamp: tuple[int, int], frame_id: bytes, told: bytes, data: bytes) -> bytes:
    """A ROS 2 ``sensor_msgs/msg/CompressedImage``."""
    made = struct.pack("<II", *stamp)
    for raw in (frame_id + b"\0", told + b"\0", data):
        made += b"\0" * (-len(made) % 4) + struct.pack("<I", len(raw)) + raw
    return b"\0\1\0\0" + made


@st.composite
def coded_images(draw: st.DrawFn) -> list[Record]:
    """One to ten coded images on a topic."""
    records = []
    told = draw(st.sampled_from(["jpeg", "png", "16UC1; compressedDepth"]) | Texts).encode()
    frame_id, body = draw(Texts).encode(), draw(coded_bodies())
    for _ in range(draw(st.integers(1, 10))):
        if draw(st.booleans()):
            body = draw(coded_bodies())
        stamp = draw(Stamps)
        ros1 = coded_ros1(draw(Word), stamp, frame_id, told, body)
        cdr = coded_cdr(stamp, frame_id, told, body)
        records.append(Record("/cam/compressed", COMPRESSED, draw(LogTimes), ros1=ros1, cdr=cdr))
    return records


@BOTH
@steady
@given(coded_images())
def test_any_coded_images_return(source: str, records: list[Record]) -> None:
    check_return(source, records)
