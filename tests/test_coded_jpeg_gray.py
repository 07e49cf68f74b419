"""Grey JPEG files: decoders agree, and they are as good and as large as libjpeg's."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from mp4ds.coded import Refused, jpeg, jpeg_gray
from pictures import picture

Grey = NDArray[np.uint8]


def decoded(data: bytes) -> Grey:
    """By Pillow and by OpenCV, which must agree."""
    image = Image.open(io.BytesIO(data))
    assert image.format == "JPEG"
    assert image.mode == "L"
    found = np.asarray(image)
    other = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert other is not None
    assert np.array_equal(found, other)
    return found


def libjpeg(pixels: Grey, quality: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def error(a: Grey, b: Grey) -> float:
    return float(np.mean((a.astype(float) - b) ** 2))


def noise(height: int, width: int, seed: int = 0) -> Grey:
    return np.random.default_rng([seed, height, width]).integers(0, 256, (height, width), np.uint8)


CONTENTS = {
    "scene": lambda h, w: picture("mono8", frame=1, width=w, height=h, rng=None),
    "noise": noise,
    "black and white": lambda h, w: (noise(h, w) & 128) // 128 * np.uint8(255),
    "black": lambda h, w: np.zeros((h, w), np.uint8),
    "white": lambda h, w: np.full((h, w), 255, np.uint8),
    "checks": lambda h, w: (np.indices((h, w)).sum(axis=0) % 2 * 255).astype(np.uint8),
    "dots": lambda h, w: ((np.indices((h, w)) % 37 == 5).all(axis=0) * 255).astype(np.uint8),
}


@pytest.mark.parametrize("quality", [1, 10, 49, 50, 75, 95, 100])
@pytest.mark.parametrize("content", CONTENTS)
def test_a_file_is_as_good_as_that_of_libjpeg(content: str, quality: int) -> None:
    pixels = CONTENTS[content](61, 83)
    data, reference = jpeg_gray.encode(pixels, quality), libjpeg(pixels, quality)
    found, expected = decoded(data), decoded(reference)
    assert found.shape == pixels.shape
    assert Image.open(io.BytesIO(data)).quantization == (
        Image.open(io.BytesIO(reference)).quantization
    )
    assert error(found, pixels) <= 1.1 * error(expected, pixels) + 1
    assert abs(len(data) - len(reference)) <= 0.02 * len(reference) + 8


@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    quality=st.integers(1, 100),
    seed=st.integers(0, 2**32),
    top=st.sampled_from([0, 1, 7, 255]),
)
def test_every_size_and_quality_decodes(
    height: int, width: int, quality: int, seed: int, top: int
) -> None:
    pixels = np.minimum(noise(height, width, seed), np.uint8(top))
    data = jpeg_gray.encode(pixels, quality)
    info = jpeg.parse(data)
    assert (info.width, info.height, info.sampling, info.trailing) == (width, height, "gray", 0)
    reference = decoded(libjpeg(pixels, quality))
    assert error(decoded(data), pixels) <= 1.2 * error(reference, pixels) + 1


def test_rows_may_be_apart() -> None:
    wide = noise(24, 60)
    assert jpeg_gray.encode(wide[::2, 5:50], 90) == jpeg_gray.encode(wide[::2, 5:50].copy(), 90)


@pytest.mark.parametrize("quality", [0, 101, -1])
def test_there_is_no_such_quality(quality: int) -> None:
    with pytest.raises(ValueError, match="1 to 100"):
        jpeg_gray.encode(noise(8, 8), quality)


def test_a_side_beyond_what_videos_have_is_refused() -> None:
    with pytest.raises(Refused, match="16385"):
        jpeg_gray.encode(np.zeros((1, 16385), np.uint8), 90)
