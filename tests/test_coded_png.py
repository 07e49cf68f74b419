"""PNG: files of all usual encoders come back byte for byte, or are refused."""

from __future__ import annotations

import dataclasses
import io
import json
import struct
import zlib
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from PIL import Image
from rosbags.rosbag1 import Reader

from coded_tools import mutations, refusal
from conftest import real
from mp4ds.messages import png
from mp4ds.messages.png import unfilter

Pixels = NDArray[Any]
SIZES = [(1, 1), (1, 40), (40, 1), (2, 3), (7, 5), (120, 160)]
KINDS = [(channels, dtype) for channels in (1, 3, 4) for dtype in (np.uint8, np.uint16)]


def picture(height: int, width: int, channels: int, dtype: Any, frame: int = 0) -> Pixels:
    """Waves with a little noise, in RGB order."""
    rng = np.random.default_rng([height, width, channels, frame])
    y, x = np.mgrid[:height, :width]
    waves = (np.sin((x + frame) / 17) + np.cos(y / 23) + 2) * 60 + rng.normal(0, 3, x.shape)
    planes = np.stack([waves + 7 * plane for plane in range(channels)], -1)
    top = np.iinfo(dtype).max
    scaled = (planes * (top // 255)).clip(0, top).astype(dtype)
    return scaled[..., 0] if channels == 1 else scaled


def by_opencv(pixels: Pixels, *flags: int) -> bytes:
    order = [2, 1, 0, 3][: pixels.shape[2]] if pixels.ndim == 3 else slice(None)
    swapped = pixels[..., order] if pixels.ndim == 3 else pixels
    return cv2.imencode(".png", swapped, list(flags))[1].tobytes()


def by_pillow(pixels: Pixels, **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG", **options)
    return file.getvalue()


def by_ffmpeg(pixels: Pixels, **options: str) -> bytes:
    names = {(1, 1): "gray", (1, 3): "rgb24", (1, 4): "rgba", (2, 1): "gray16be"}
    name = names[pixels.itemsize, 1 if pixels.ndim == 2 else pixels.shape[2]]
    context: Any = av.CodecContext.create("png", "w")
    context.height, context.width = pixels.shape[:2]
    context.pix_fmt, context.time_base = name, Fraction(1, 25)
    context.options = options
    frame = av.VideoFrame.from_ndarray(pixels, format=name)
    frame.pts = 0
    return b"".join(map(bytes, [*context.encode(frame), *context.encode(None)]))


def seen_by_opencv(data: bytes) -> Pixels:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels[..., [2, 1, 0, 3][: pixels.shape[2]]] if pixels.ndim == 3 else pixels


def check(data: bytes, hint: png.PngRecipe | None = None) -> png.PngRecipe:
    """Take a file apart and together; returns its recipe."""
    pixels, recipe = png.decode(memoryview(data), hint)
    expected = seen_by_opencv(data)
    assert pixels.dtype == expected.dtype
    assert np.array_equal(pixels, expected)
    assert png.rebuild(pixels, recipe) == data
    assert (
        dataclasses.replace(recipe, **json.loads(json.dumps(dataclasses.asdict(recipe)))) == recipe
    )
    return recipe


# ---------------------------------------------------------------- encoders

LEVELS = range(1, 10)


@pytest.mark.one_in(6)
@pytest.mark.parametrize(("channels", "dtype"), KINDS)
@pytest.mark.parametrize("size", SIZES)
def test_opencv(size: tuple[int, int], channels: int, dtype: Any) -> None:
    pixels = picture(*size, channels, dtype)
    assert check(by_opencv(pixels)).filters == "1" or 1 in size
    for level in LEVELS:
        check(by_opencv(pixels, cv2.IMWRITE_PNG_COMPRESSION, level))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("strategy", range(5))
@pytest.mark.parametrize("filters", [8, 16, 32, 64, 128, 248, 56])
def test_opencv_with_strategies_and_filters(strategy: int, filters: int) -> None:
    pixels = picture(60, 80, 3, np.uint8)
    check(by_opencv(pixels, cv2.IMWRITE_PNG_STRATEGY, strategy, cv2.IMWRITE_PNG_FILTER, filters))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("optimize", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("size", SIZES)
def test_pillow(size: tuple[int, int], channels: int, optimize: bool) -> None:
    check(by_pillow(picture(*size, channels, np.uint8), optimize=optimize))
    if channels == 1 and not optimize:
        check(by_pillow(picture(*size, 1, np.uint16)))


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("channels", "dtype"), [(1, np.uint8), (3, np.uint8), (1, np.uint16)])
@pytest.mark.parametrize("size", SIZES)
def test_ffmpeg(size: tuple[int, int], channels: int, dtype: Any) -> None:
    for pred in ["", "none", "sub", "up", "avg", "paeth", "mixed"]:
        options = {"pred": pred} if pred else {}
        check(by_ffmpeg(picture(*size, channels, dtype), **options))


def test_a_large_picture() -> None:
    """More than one band of rows, and of chunks."""
    for data in (
        by_opencv(picture(480, 640, 3, np.uint8), cv2.IMWRITE_PNG_COMPRESSION, 6),
        by_ffmpeg(picture(480, 640, 3, np.uint8)),
    ):
        recipe = check(data)
        assert data.count(b"IDAT") > 2
        assert recipe.chunk_bytes in (8192, 4096)


ENCODERS: dict[str, Callable[[Pixels], bytes]] = {
    "opencv": by_opencv,
    "opencv-9": lambda pixels: by_opencv(pixels, cv2.IMWRITE_PNG_COMPRESSION, 9),
    "pillow": by_pillow,
    "ffmpeg": by_ffmpeg,
}


@pytest.mark.parametrize("name", ENCODERS)
def test_one_recipe_for_a_topic(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make = ENCODERS[name]
    recipe = check(make(picture(90, 120, 3, np.uint8)))
    monkeypatch.setattr(png, "find_rule", None)  # nothing is searched any more
    for frame in range(1, 5):
        assert check(make(picture(90, 120, 3, np.uint8, frame)), recipe) == recipe
    small = make(picture(6, 8, 3, np.uint8))
    if small[41:43] == bytes.fromhex(recipe.zlib_header):
        assert check(small, recipe) == recipe  # its one chunk is no exception


def test_real_recording() -> None:
    with Reader(real("bags/ros_numpy_test.bag")) as reader:
        topics = [c for c in reader.connections if c.topic == "/compressedimage"]
        payloads = [payload for _, _, payload in reader.messages(connections=topics)]
    for payload in payloads:
        start = payload.index(b"\x89PNG")
        (size,) = struct.unpack_from("<I", payload, start - 4)
        check(payload[start : start + size])


# ---------------------------------------------------------------- filters


def predicted(kind: int, left: int, above: int, corner: int) -> int:
    """The predictor of a filter (PNG, 9.2 and 9.4)."""
    if kind == 4:
        near = left + above - corner
        return min((left, above, corner), key=lambda value: abs(near - value))
    return (0, left, above, (left + above) // 2)[kind]


def filtered_plainly(rows: NDArray[np.uint8], kinds: list[int], step: int) -> NDArray[np.uint8]:
    """Rows filtered byte by byte."""
    out = np.zeros((rows.shape[0], rows.shape[1] + 1), np.uint8)
    values = rows.astype(int)
    for y, kind in enumerate(kinds):
        out[y, 0] = kind
        for x in range(rows.shape[1]):
            left = values[y, x - step] if x >= step else 0
            above = values[y - 1, x] if y else 0
            corner = values[y - 1, x - step] if y and x >= step else 0
            out[y, 1 + x] = (values[y, x] - predicted(kind, left, above, corner)) % 256
    return out


@st.composite
def filtered(draw: st.DrawFn) -> tuple[NDArray[np.uint8], list[int], int]:
    step = draw(st.sampled_from([1, 2, 3, 4, 6, 8]))
    shape = (draw(st.integers(1, 6)), step * draw(st.integers(1, 5)))
    top = draw(st.sampled_from([1, 3, 255]))
    rows = draw(arrays(np.uint8, shape, elements=st.integers(0, top)))
    kinds = draw(st.lists(st.integers(0, 4), min_size=shape[0], max_size=shape[0]))
    return rows, kinds, step


@settings(deadline=None)
@given(filtered())
def test_filters_are_undone(case: tuple[NDArray[np.uint8], list[int], int]) -> None:
    rows, kinds, step = case
    assert np.array_equal(unfilter(filtered_plainly(rows, kinds, step), step), rows)


# ---------------------------------------------------------------- refusals


def chunk(kind: bytes, body: bytes) -> bytes:
    crc = zlib.crc32(kind + body)
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", crc)


def made(
    deflated: bytes = b"",
    *,
    width: int = 4,
    height: int = 3,
    depth: int = 8,
    color: int = 0,
    interlace: int = 0,
    chunks: list[bytes] | None = None,
) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, interlace)
    body = chunks if chunks is not None else [chunk(b"IDAT", deflated)]
    return b"".join((png.SIGNATURE, chunk(b"IHDR", header), *body, chunk(b"IEND", b"")))


ROWS = bytes(15)
GOOD = zlib.compress(ROWS)
BASE = made(GOOD)


def synced(data: bytes) -> bytes:
    compressor = zlib.compressobj()
    return compressor.compress(data) + compressor.flush(zlib.Z_SYNC_FLUSH) + compressor.flush()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "not a PNG"),
        (BASE[:25] + b"\1" + BASE[26:], "wrong checksum"),
        (made(GOOD, width=0), "0x3"),
        (made(GOOD, color=1), "unknown values"),
        (made(GOOD, color=3), "palette"),
        (made(GOOD, depth=4), "4 bits"),
        (made(GOOD, interlace=1), "interlaced"),
        (made(chunks=[]), "no image data"),
        (made(b""), "promises|cut short"),
        (made(b"x" * 20), "damaged"),
        (made(zlib.compress(ROWS[1:])), "cut short"),
        (made(GOOD[:-1]), "cut short"),
        (made(zlib.compress(bytes(10**7))), "more than its header says"),
        (made(GOOD, width=16384, height=16384), "promises"),
        (made(zlib.compress(bytes(2**20), 9), width=16000, height=16000, depth=16), "promises"),
        (made(zlib.compress(b"\5" + ROWS[1:])), "unknown filter 5"),
        (made(zlib.compress(b"".join(bytes([kind, 1, 9, 3, 200]) for kind in (3, 0, 1)))), "rule"),
        (made(synced(ROWS)), "not compressed by zlib"),
        (made(zlib.compress(ROWS, 0)), ""),
        (BASE[:-12], "no end"),
        (BASE[:44] + bytes([BASE[44] ^ 1]) + BASE[45:], "wrong checksum"),
        (
            made(chunks=[chunk(b"IDAT", GOOD[:3]), chunk(b"IDAT", GOOD[3:])]),
            "chunks follow no rule",
        ),
        (made(chunks=[chunk(b"tEXt", bytes(70_000)), chunk(b"IDAT", GOOD)]), "besides the image"),
        (made(chunks=[chunk(b"IDAT", b"")] * 140_000), "no end"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_refusals(data: bytes, reason: str) -> None:
    found = refusal(png.decode, data)
    assert any(part in found for part in reason.split("|"))
    assert found or not reason


def test_damage_is_refused_or_comes_back() -> None:
    data = by_pillow(picture(9, 9, 3, np.uint8))
    for damaged in mutations(data, 600):
        refusal(png.parse, damaged)
        if not refusal(png.decode, damaged):
            assert png.rebuild(*png.decode(damaged)) == damaged
