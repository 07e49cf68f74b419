"""Pixels into pictures and back, and which images have a layout at all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mp4ds.errors import OptionError
from mp4ds.layouts import (
    ENCODINGS,
    LAYOUTS,
    MAX_ROW_PADDING,
    MAX_SIDE,
    Encoding,
    layout_for,
    padding_is_zero,
    pixel_view,
    why_not,
)

steady = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])

SIZES = [(w, h) for w in (1, 2, 3, 4, 7, 8) for h in (1, 2, 3, 5, 6)]


def random_pixels(encoding: Encoding, width: int, height: int) -> np.ndarray:
    dtype = np.uint8 if encoding.bytes_per_sample == 1 else np.uint16
    shape = (height, width) if encoding.channels == 1 else (height, width, encoding.channels)
    rng = np.random.default_rng([width, height])
    return rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


@pytest.mark.parametrize("name", ENCODINGS)
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_every_layout_gives_the_pixels_back(name: str, width: int, height: int) -> None:
    encoding = ENCODINGS[name]
    pixels = random_pixels(encoding, width, height)
    for layout_name in {encoding.exact, encoding.lossy} - {None}:
        layout = LAYOUTS[str(layout_name)]
        picture = layout.to_picture(pixels)
        assert picture.shape[1::-1] == layout.picture_size(width, height)
        out = np.empty_like(pixels)
        layout.to_pixels(picture, out)
        assert np.array_equal(out, pixels)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_tiles_are_where_the_spec_says(width: int, height: int) -> None:
    """spec/index.md, Layouts, mosaic8."""
    pixels = np.arange(width * height, dtype=np.uint16).reshape(height, width)
    picture = LAYOUTS["mosaic8"].to_picture(pixels)
    h, w = -(-height // 2), -(-width // 2)
    assert picture.shape == (2 * h, 2 * w)
    for y in range(height):
        for x in range(width):
            assert picture[(y % 2) * h + y // 2, (x % 2) * w + x // 2] == pixels[y, x]
    assert set(picture.ravel().tolist()) == set(pixels.ravel().tolist())  # no stray samples


def test_tiles_hold_one_colour_each() -> None:
    mosaic = np.array([[10, 20] * 3, [30, 40] * 3] * 2, np.uint8)
    picture = LAYOUTS["mosaic8"].to_picture(mosaic)
    quarters = (picture[:2, :3], picture[:2, 3:], picture[2:, :3], picture[2:, 3:])
    assert [np.unique(quarter).tolist() for quarter in quarters] == [[10], [20], [30], [40]]


def test_layouts_of_encodings() -> None:
    assert {name: (e.exact, e.lossy) for name, e in ENCODINGS.items()} == {
        "mono8": ("gray8", "gray8"),
        "rgb8": ("rgb24", "rgb24"),
        "bgr8": ("bgr24", "bgr24"),
        **{f"bayer_{m}8": ("mosaic8", "demosaic8") for m in ("rggb", "bggr", "gbrg", "grbg")},
        "mono16": ("gray16", None),
        "16UC1": ("gray16", None),
    }
    for name, encoding in ENCODINGS.items():
        assert layout_for(encoding, lossless=True).name == encoding.exact
        if encoding.lossy:
            assert layout_for(encoding, lossless=False).name == encoding.lossy
        else:
            with pytest.raises(OptionError, match=name):
                layout_for(encoding, lossless=False)
        if encoding.mosaic:
            assert name == f"bayer_{encoding.mosaic}8"


# ---------------------------------------------------------------- views


@pytest.mark.parametrize("name", ENCODINGS)
@pytest.mark.parametrize("pad", [0, 1, 3, 8])
@pytest.mark.parametrize("big", [False, True])
def test_a_view_is_the_message_itself(name: str, pad: int, big: bool) -> None:
    encoding = ENCODINGS[name]
    width, height = 5, 3
    step = width * encoding.pixel_bytes + pad
    data = bytearray(np.random.default_rng(0).integers(0, 256, step * height, np.uint8).tobytes())
    view = pixel_view(data, encoding, width=width, height=height, step=step, is_bigendian=big)
    order = "big" if big else "little"
    for y, x, c in np.ndindex(height, width, encoding.channels):
        size = encoding.bytes_per_sample
        at = y * step + x * encoding.pixel_bytes + c * size
        sample = view[y, x] if encoding.channels == 1 else view[y, x, c]
        assert sample == int.from_bytes(data[at : at + size], order)
    before = bytes(data)
    view[...] = 0
    assert view.flags.writeable
    for y in range(height):  # the padding is not touched
        start = y * step + width * encoding.pixel_bytes
        assert data[start : start + pad] == before[start : start + pad]
        assert not any(data[y * step : start])


def test_a_view_of_bytes_is_read_only_and_not_a_copy() -> None:
    data = memoryview(bytes(range(12)))
    view = pixel_view(data, ENCODINGS["mono8"], width=4, height=3, step=4, is_bigendian=True)
    assert not view.flags.writeable
    assert np.shares_memory(view, np.frombuffer(data, np.uint8))


@steady
@given(st.integers(1, 6), st.integers(0, 4), st.integers(1, 5), st.data())
@example(3, 0, 2, None)
def test_padding(row_bytes: int, pad: int, height: int, data: st.DataObject | None) -> None:
    step = row_bytes + pad
    rows = np.full((height, step), 7, np.uint8)
    rows[:, row_bytes:] = 0
    assert padding_is_zero(
        memoryview(rows.tobytes()), row_bytes=row_bytes, step=step, height=height
    )
    if pad and data:
        y, x = data.draw(st.integers(0, height - 1)), data.draw(st.integers(row_bytes, step - 1))
        rows[y, x] = data.draw(st.integers(1, 255))
        assert not padding_is_zero(
            memoryview(rows.tobytes()), row_bytes=row_bytes, step=step, height=height
        )


# ---------------------------------------------------------------- what has no layout


@pytest.mark.parametrize("name", ENCODINGS)
@pytest.mark.parametrize(("width", "height"), [(1, 1), (640, 480), (MAX_SIDE, MAX_SIDE)])
@pytest.mark.parametrize("pad", [0, 5, MAX_ROW_PADDING])
def test_ordinary_images_have_one(name: str, width: int, height: int, pad: int) -> None:
    step = width * ENCODINGS[name].pixel_bytes + pad
    assert why_not(name, width=width, height=height, step=step, size=step * height) is None


@pytest.mark.parametrize(
    ("encoding", "width", "height", "step", "size", "words"),
    [
        ("rgba8", 4, 4, 16, 64, "no layout for encoding 'rgba8'"),
        ("", 4, 4, 4, 16, "no layout for encoding ''"),
        ("MONO8", 4, 4, 4, 16, "no layout"),
        ("mono8 ", 4, 4, 4, 16, "no layout"),
        ("mono8", 0, 4, 0, 0, "0x4 pixels"),
        ("mono8", 4, 0, 4, 0, "4x0 pixels"),
        ("mono8", 4, 4, 3, 12, "shorter than a row"),
        ("rgb8", 4, 4, 11, 44, "shorter than a row"),
        ("mono16", 4, 4, 7, 28, "shorter than a row"),
        ("mono8", 4, 4, 0, 0, "shorter than a row"),
        ("mono8", 4, 4, 4, 15, "15 bytes of pixels where step x height says 16"),
        ("mono8", 4, 4, 4, 17, "17 bytes"),
        ("mono8", 4, 4, 4, 0, "0 bytes"),
        ("mono8", MAX_SIDE + 1, 1, MAX_SIDE + 1, MAX_SIDE + 1, "beyond 16384"),
        ("mono8", 1, MAX_SIDE + 1, 1, MAX_SIDE + 1, "beyond 16384"),
        ("mono8", 4, 1, 5 + MAX_ROW_PADDING, 5 + MAX_ROW_PADDING, "4096 bytes of padding"),
        ("mono8", 2**32 - 1, 2**32 - 1, 2**32 - 1, 16, "bytes of pixels"),
    ],
)
def test_others_have_none_and_say_why(
    encoding: str, width: int, height: int, step: int, size: int, words: str
) -> None:
    reason = why_not(encoding, width=width, height=height, step=step, size=size)
    assert reason is not None
    assert words in reason
