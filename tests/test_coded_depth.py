"""compressedDepth: RVL against a plain reference from the paper, and what is refused."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray

from coded_tools import mutations, refusal
from encoders import rvl, rvl_nibbles, rvl_words
from mp4ds.errors import Refused
from mp4ds.messages import png
from mp4ds.messages.depth import decode_depth, decode_rvl, encode_rvl

Depth = NDArray[np.uint16]


def reference(depth: Depth) -> bytes:
    """Header and words by a coder that goes pixel by pixel."""
    return struct.pack("<II", *depth.shape[::-1]) + rvl(depth)


def coded(columns: int, rows: int, *numbers: int) -> bytes:
    nibbles = [nibble for number in numbers for nibble in rvl_nibbles(number)]
    return struct.pack("<II", columns, rows) + rvl_words(nibbles)


def random_depth(shape: tuple[int, int], filled: float, top: int) -> Depth:
    rng = np.random.default_rng([*shape, top])
    values = rng.integers(0, top, shape, endpoint=True) * (rng.random(shape) < filled)
    return values.astype(np.uint16)


SHAPES = [(1, 1), (1, 7), (7, 1), (3, 5), (48, 64)]


@pytest.mark.parametrize("top", [1, 7, 300, 65535])
def test_like_the_reference(top: int) -> None:
    for shape in SHAPES:
        for filled in [0.0, 0.1, 0.5, 0.9, 1.0]:
            depth = random_depth(shape, filled, top)
            data = reference(depth)
            assert encode_rvl(depth) == data
            found = decode_rvl(memoryview(data))
            assert found.dtype == np.uint16
            assert np.array_equal(found, depth)


SMALL: Any = arrays(
    np.uint16,
    array_shapes(min_dims=2, max_dims=2, max_side=9),
    elements=st.sampled_from([0, 0, 0, 1, 2, 8, 4000, 32767, 32768, 65535]),
)


@settings(deadline=None)
@given(SMALL)
def test_any_image_comes_back(depth: Depth) -> None:
    assert encode_rvl(depth) == reference(depth)
    assert np.array_equal(decode_rvl(encode_rvl(depth)), depth)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "whole number"),
        (struct.pack("<II", 4, 4), "no number"),
        (coded(0, 2, 0, 0), "0x2"),
        (coded(16384, 16384, 16384 * 16384, 0), "16384x16384"),
        (coded(3, 3, 0, 9, 2, 2), "cut short|another number"),
        (coded(2, 2, 3), "cut short|another number"),
        (coded(2, 2, 5, 0), "another number"),
        (coded(2, 2, 2**36, 0), "32 bits"),
        (coded(2, 1, 0, 2, 2, 1), "16 bits"),  # a pixel that is zero among those that are not
        (coded(2, 1, 0, 2, 2, 2), ""),
        (coded(2, 1, 0, 2, 2**17, 2), "16 bits"),
    ],
)
def test_refusals(data: bytes, reason: str) -> None:
    if not reason:
        assert decode_rvl(data).tolist() == [[1, 2]]
        return
    with pytest.raises(Refused, match=reason):
        decode_rvl(data)


def test_what_decodes_alike_is_not_the_same_bytes() -> None:
    """So a decoded image is encoded again and compared before it is trusted."""
    for data in (
        coded(3, 1, 1, 0, 0, 2, 2, 2),  # a run cut in two
        coded(2, 1, 0, 2, 2, 2) + bytes(4),  # words after the end
        struct.pack("<II", 1, 1) + rvl_words([0, 9, 0, 2]),  # a number with a group of nothing
    ):
        assert encode_rvl(decode_rvl(data)) != data


# ---------------------------------------------------------------- whole images

HEADER = struct.pack("<iff", 0, 10100.0, 9.99e-1)


def room() -> Depth:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:48, :64]
    values = 2000 + 9 * x + 5 * y + rng.integers(0, 9, x.shape)
    return np.where(rng.random(x.shape) < 0.1, 0, values).astype(np.uint16)


def rebuilt(header: bytes, pixels: Depth, recipe: png.PngRecipe | None) -> bytes:
    return header + (encode_rvl(pixels) if recipe is None else png.rebuild(pixels, recipe))


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
def test_images_refused(data: bytes, reason: str) -> None:
    found = refusal(decode_depth, data)
    assert found
    assert any(part in found for part in reason.split("|"))


@pytest.mark.parametrize(
    "body", [cv2.imencode(".png", room())[1].tobytes(), encode_rvl(room())], ids=["png", "rvl"]
)
def test_damaged_images_are_refused_or_come_back(body: bytes) -> None:
    for damaged in mutations(HEADER + body, 300):
        if not refusal(decode_depth, damaged):
            assert rebuilt(*decode_depth(damaged)) == damaged
