"""compressedDepth: header and image, apart and together again."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Reader

from coded_tools import mutations, refusal
from conftest import real
from mp4ds.messages import depth, png
from mp4ds.messages.depth import encode_rvl

HEADERS = {
    "millimetres": bytes.fromhex("0000000038a9e04ea17f0000"),  # floats that nobody set
    "metres": struct.pack("<iff", 0, 10100.0, 9.99e-1),
    "nan": struct.pack("<iff", 0, float("nan"), float("-inf")),
    "none": b"",
}


def room(frame: int = 0) -> np.ndarray[tuple[int, int], np.dtype[np.uint16]]:
    rng = np.random.default_rng(frame)
    y, x = np.mgrid[:48, :64]
    values = 2000 + 9 * x + 5 * y + rng.integers(0, 9, x.shape) + 100 * frame
    return np.where(rng.random(x.shape) < 0.1, 0, values).astype(np.uint16)


def png_of(values: np.ndarray[tuple[int, int], np.dtype[np.uint16]], level: int = 9) -> bytes:
    return cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, level])[1].tobytes()


def rebuilt(image: depth.DepthImage) -> bytes:
    if image.recipe is None:
        return image.header + encode_rvl(image.pixels)
    return image.header + png.rebuild(image.pixels, image.recipe)


@pytest.mark.parametrize("header", [name for name in HEADERS if HEADERS[name]])
@pytest.mark.parametrize("coding", ["png", "rvl"])
def test_comes_back(header: str, coding: str) -> None:
    hint = None
    for frame in range(3):
        body = png_of(room(frame)) if coding == "png" else encode_rvl(room(frame))
        data = HEADERS[header] + body
        image = depth.decode_depth(memoryview(data), hint)
        assert image.header == HEADERS[header]
        assert np.array_equal(image.pixels, room(frame))
        assert image.pixels.dtype == np.uint16
        assert (image.recipe is None) == (coding == "rvl")
        assert rebuilt(image) == data
        assert hint is None or image.recipe == hint
        hint = image.recipe


def test_a_png_without_the_header() -> None:
    image = depth.decode_depth(png_of(room()))
    assert image.header == b""
    assert rebuilt(image) == png_of(room())


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "not RVL"),
        (bytes(11), "not RVL"),
        (bytes(12) + b"\x89PNG\r\n\x1a\n", "not a PNG"),
        (bytes(12) + cv2.imencode(".png", room().astype(np.uint8))[1].tobytes(), "16 bits"),
        (
            bytes(12) + cv2.imencode(".png", np.dstack([room()] * 3))[1].tobytes(),
            "not grey",
        ),
        (bytes(12) + encode_rvl(room()) + bytes(4), "RVL does not rebuild"),
        (bytes(12) + encode_rvl(room())[:-4], "cut short|another number"),
        (bytes(12) + cv2.imencode(".jpg", room().astype(np.uint8))[1].tobytes(), ""),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_refusals(data: bytes, reason: str) -> None:
    found = refusal(depth.decode_depth, data)
    assert found
    assert any(part in found for part in reason.split("|"))


@pytest.mark.parametrize("body", [png_of(room()), encode_rvl(room())], ids=["png", "rvl"])
def test_damage_is_refused_or_comes_back(body: bytes) -> None:
    for damaged in mutations(HEADERS["metres"] + body, 300):
        if not refusal(depth.decode_depth, damaged):
            assert rebuilt(depth.decode_depth(damaged)) == damaged


def test_real_recording() -> None:
    with Reader(real("bags/spot_compressedDepth.bag")) as reader:
        topics = [c for c in reader.connections if c.msgtype.endswith("CompressedImage")]
        payloads = [payload for _, _, payload in reader.messages(connections=topics)]
    assert payloads
    for payload in payloads:
        start = payload.index(b"\x89PNG") - depth.HEADER_BYTES
        (size,) = struct.unpack_from("<I", payload, start - 4)
        data = payload[start : start + size]
        image = depth.decode_depth(data)
        assert image.pixels.shape == (240, 424)
        assert rebuilt(image) == data
        expected = cv2.imdecode(np.frombuffer(data[12:], np.uint8), cv2.IMREAD_UNCHANGED)
        assert expected is not None
        assert np.array_equal(image.pixels, expected)
