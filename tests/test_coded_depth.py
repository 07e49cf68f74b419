"""compressedDepth: what is refused of header and image."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from coded_tools import mutations, refusal
from mp4ds.messages import depth, png
from mp4ds.messages.depth import encode_rvl

HEADER = struct.pack("<iff", 0, 10100.0, 9.99e-1)


def room() -> np.ndarray[tuple[int, int], np.dtype[np.uint16]]:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:48, :64]
    values = 2000 + 9 * x + 5 * y + rng.integers(0, 9, x.shape)
    return np.where(rng.random(x.shape) < 0.1, 0, values).astype(np.uint16)


def png_of(values: np.ndarray[tuple[int, int], np.dtype[np.uint16]]) -> bytes:
    return cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


def rebuilt(image: depth.DepthImage) -> bytes:
    if image.recipe is None:
        return image.header + encode_rvl(image.pixels)
    return image.header + png.rebuild(image.pixels, image.recipe)


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
    for damaged in mutations(HEADER + body, 300):
        if not refusal(depth.decode_depth, damaged):
            assert rebuilt(depth.decode_depth(damaged)) == damaged
