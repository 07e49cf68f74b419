"""Colours of lossy videos: the same bits by either way, and near what the numbers mean."""

from __future__ import annotations

import itertools
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from mp4ds.video import colour
from mp4ds.video.colour import BITS, MATRICES, rgb, samples

SIZES = [(1, 1), (2, 3), (3, 2), (5, 6), (16, 37), (33, 4), (66, 130), (640, 70)]


def frame_of(width: int, height: int, pixel_format: str, seed: int = 1) -> av.VideoFrame:
    """Noise that is often at the ends of its range."""
    rng = np.random.default_rng(seed)
    frame = av.VideoFrame(width, height, pixel_format)
    top = 2 ** BITS[pixel_format] - 1
    for index in range(3):
        plane = samples(frame, index)
        noise = rng.integers(0, top + 1, plane.shape)
        ends = rng.choice([0, 1, (top + 1) // 2, top - 1, top], plane.shape)
        plane[...] = np.where(rng.random(plane.shape) < 0.5, noise, ends)
    return frame


def smooth(width: int, height: int, pixel_format: str) -> av.VideoFrame:
    """Slopes, so that all ways of interpolating agree."""
    frame = av.VideoFrame(width, height, pixel_format)
    top = 2 ** BITS[pixel_format] - 1
    for index in range(3):
        plane = samples(frame, index)
        rows, columns = np.indices(plane.shape)
        slope = rows / plane.shape[0] + (index + 1) * columns / plane.shape[1] / 3
        plane[...] = (0.2 + 0.3 * slope) * top
    return frame


def as_numpy(monkeypatch: pytest.MonkeyPatch, *arguments: Any, **options: Any) -> NDArray[np.uint8]:
    with monkeypatch.context() as patch:
        patch.setattr(colour, "compiled", lambda: None)
        return rgb(*arguments, **options)


@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv420p10le"])
def test_compiled_or_not(pixel_format: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if colour.compiled() is None:
        pytest.skip("it was not compiled here")
    options = itertools.product(SIZES, MATRICES, (False, True), (False, True))
    for (width, height), matrix, full_range, is_bgr in options:
        frame = frame_of(width, height, pixel_format)
        wanted = as_numpy(monkeypatch, frame, matrix, full_range=full_range, is_bgr=is_bgr)
        found = rgb(frame, matrix, full_range=full_range, is_bgr=is_bgr)
        assert np.array_equal(found, wanted), (width, height, matrix, full_range, is_bgr)


@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv420p10le"])
@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize("matrix", MATRICES)
def test_they_are_what_the_matrix_says(pixel_format: str, full_range: bool, matrix: str) -> None:
    """Within a level of the formula in floats, where chroma hardly differs between pixels."""
    frame = smooth(320, 240, pixel_format)
    scale = 2 ** (BITS[pixel_format] - 8)
    y, u, v = (samples(frame, index).astype(float) / scale for index in range(3))
    if full_range:
        top = (2 ** BITS[pixel_format] - 1) / scale
        y, u, v = y * 255 / top, (u - 128) * 255 / top, (v - 128) * 255 / top
    else:
        y, u, v = (y - 16) * 255 / 219, (u - 128) * 255 / 224, (v - 128) * 255 / 224
    u, v = (plane.repeat(2, 0).repeat(2, 1) for plane in (u, v))
    red, blue = MATRICES[matrix]
    r, b = y + 2 * (1 - red) * v, y + 2 * (1 - blue) * u
    wanted = np.stack([r, (y - red * r - blue * b) / (1 - red - blue), b], -1).clip(0, 255)
    found = rgb(frame, matrix, full_range=full_range)
    inside = np.s_[8:-8, 8:-8]
    assert np.abs(found[inside] - wanted[inside]).max() < 3
    assert abs((found[inside] - wanted[inside]).mean()) < 0.1
