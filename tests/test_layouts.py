"""Pixels into pictures and back, and which images have a layout at all."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from mp4ds.messages.encodings import (
    ENCODINGS,
    MAX_ROW_PADDING,
    MAX_SIDE,
    NO_PARAMETERS,
    LayoutParameters,
    add_prediction,
    difference,
    pixel_view,
)
from mp4ds.messages.layouts import (
    CHROMA_SHIFTS,
    LAYOUTS,
    Layout,
    bind,
    fit,
    layout_for,
    why_not,
)
from mp4ds.messages.numbers import SCALES
from mp4ds.messages.wire import ImageFields
from mp4ds.video.encoder import difference_layouts
from pixel_kinds import KINDS, PAIRS, as_message, bits_of, bound, rounded, suited, values

SIZES = [(w, h) for w in (1, 2, 3, 4, 7, 8) for h in (1, 2, 3, 5, 6)]
WITH_PARAMETERS = [pair for pair in PAIRS if LAYOUTS[pair[1]].parameters]
GENERAL = [(e.name, e.general) for e in ENCODINGS.values()]
CHANNELS = {"rgb24": 3, "bgr24": 3, "rgba": 4, "bgra": 4}


def through(layout: Layout, pixels: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """The pixels, into a picture and back; checks that the picture is what the layout says."""
    encoding = layout.encoding
    picture = layout.to_picture(pixels)
    width, height = pixels.shape[1], int(len(pixels) / encoding.rows)
    columns, rows = layout.picture_size(width, height)
    across, down = CHROMA_SHIFTS.get(layout.pixel_format, (0, 0))
    if layout.pixel_format in CHANNELS:
        shapes = [(rows, columns, CHANNELS[layout.pixel_format])]
    elif layout.pixel_format.startswith(("gray", "bayer")):
        shapes = [(rows, columns)]
    else:
        planes = 4 if layout.pixel_format.startswith("gbra") else 3
        chroma = (-(-rows >> down), -(-columns >> across))
        shapes = [(rows, columns), *[chroma] * (planes - 1)]
    assert [plane.shape for plane in picture] == shapes
    sample = np.dtype(np.uint16 if layout.pixel_format.endswith("le") else np.uint8)
    assert {plane.dtype for plane in picture} == {sample}
    if out is None:
        out = np.empty(pixels.shape, encoding.dtype)
    # as a decoder gives them: its own memory, read-only, of no more bits than the format has
    depth = re.search(r"gray(9|1\d)le|gbra?p(1\d)le", layout.pixel_format)
    bits = int(depth[1] or depth[2]) if depth else 8
    copies = tuple(plane & sample.type(2**bits - 1) for plane in picture)
    for plane in copies:
        plane.flags.writeable = False
    layout.to_pixels(copies, out)
    return out


# ---------------------------------------------------------------- exact layouts


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("name", "layout"), GENERAL)
def test_the_general_layout_gives_all_pixels_back(name: str, layout: str) -> None:
    for kind in KINDS:
        encoding = ENCODINGS[name]
        general = bind(layout, encoding)
        assert general == layout_for(encoding, lossless=True)
        for width, height in {rounded(encoding, *size) for size in SIZES}:
            pixels = values(encoding, kind, width, height)
            for big in (False, True):
                for pad in (0, 1, 6):
                    view = as_message(pixels, encoding, pad=pad, is_bigendian=big)
                    assert general.values.refuses(view) is None
                    assert bits_of(through(general, view)) == bits_of(pixels)
                    target = np.ndarray(
                        view.shape, view.dtype, bytearray(len(view) * view.strides[0]),
                        strides=view.strides,
                    )  # fmt: skip
                    assert bits_of(through(general, view, target)) == bits_of(pixels)


def refused_or_returned(layout: Layout, pixels: np.ndarray) -> bool:
    """Exactly one of both; the picture of folded bits has room for some that are refused."""
    refused = layout.values.refuses(pixels) is not None
    returned = bits_of(through(layout, pixels)) == bits_of(pixels)
    return refused != returned or (refused and layout.name.endswith("fold"))


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("name", "layout"), WITH_PARAMETERS)
def test_what_is_not_refused_comes_back(name: str, layout: str) -> None:
    """And what does not come back is refused: for every kind of pixels, some changed."""
    for kind in KINDS:
        encoding = ENCODINGS[name]
        for seed in range(4):
            fitted = bound(layout, encoding, 16, 12, seed)
            pixels = suited(layout, encoding, 16, 12, seed)
            assert fitted.values.refuses(pixels) is None
            other = values(encoding, kind, 16, 12, seed)
            for y, x in ((0, 0), (11, 15), (5, 7)):
                changed = pixels.copy()
                changed[y, x] = other[y, x]
                assert refused_or_returned(fitted, changed)
            assert refused_or_returned(fitted, other)


@pytest.mark.parametrize("dtype", ["u2", "i2"])
def test_every_word_comes_back(dtype: str) -> None:
    pixels = np.arange(65536, dtype=np.uint16).reshape(256, 256).view(dtype)
    encoding = ENCODINGS["16UC1" if dtype == "u2" else "16SC1"]
    folds = [LayoutParameters(bits=16, shift=0, low=low) for low in (6, 7, 8)]
    for name, parameters in [("gray16", NO_PARAMETERS), *(("fold", p) for p in folds)]:
        layout = bind(name, encoding, parameters)
        assert layout.values.refuses(pixels) is None
        assert bits_of(through(layout, pixels)) == bits_of(pixels)


# ---------------------------------------------------------------- single layouts

# Where each layout puts its samples is compared with the spec in test_second_reader.py.


# ---------------------------------------------------------------- parameters


def parameters_of(layout: str, encoding: str, *samples: Any) -> LayoutParameters | None:
    known = ENCODINGS[encoding]
    arrays = [np.asarray(sample, known.dtype) for sample in samples]
    fitted = fit(layout, known, arrays)
    return fitted.parameters if fitted else None


@pytest.mark.parametrize(
    ("encoding", "samples", "expected"),
    [
        ("mono16", [[0, 4095]], (12, 0)),
        ("mono16", [[1, 900]], (12, 0)),
        ("mono16", [[1, 255]], (8, 0)),
        ("mono16", [[4, 1020]], (8, 2)),
        ("mono16", [[0, 4096 + 1]], None),
        ("mono16", [[0, 0]], None),
        ("mono16", [[0x0040, 0x8000]], (10, 6)),
        ("mono16", [[0xFF00, 0x0100]], (8, 8)),
        ("mono16", [[4, 0x8000]], (14, 2)),
        ("16SC1", [[-2048, 2047]], (12, 0)),
        ("16SC1", [[-32768, 16]], (12, 4)),
    ],
)
def test_bits_that_are_fitted(
    encoding: str, samples: Any, expected: tuple[int, int] | None
) -> None:
    found = parameters_of("gray_bits", encoding, samples)
    assert (found and (found.bits, found.shift)) == expected


COUNTS = np.arange(1, 65536, dtype=np.float32).reshape(255, 257)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("hole", [0x00000000, 0x7FC00000, 0xFFC00000, 0x7F800000])
@pytest.mark.parametrize("name", ["metres16", "metres_fold"])
def test_all_millimetres_come_back(name: str, hole: int, scale: str) -> None:
    pixels = COUNTS * np.float32(0.001) if scale == "product" else COUNTS / np.float32(1000)
    pixels[::7, ::5] = np.array(hole, np.uint32).view(np.float32)
    layout = fit(name, ENCODINGS["32FC1"], [pixels])
    assert layout is not None
    assert layout.parameters == LayoutParameters(hole=hole, scale=scale)
    assert layout.values.refuses(pixels) is None
    assert bits_of(through(layout, pixels)) == bits_of(pixels)


# ---------------------------------------------------------------- tones

TONED = [name for name, encoding in ENCODINGS.items() if encoding.lossy == "tone"]


def tone(bits: int, shift: int = 0, table: list[int] | None = None) -> dict[str, Any]:
    """LayoutParameters, whose levels are the smallest values unless told otherwise."""
    return {"bits": bits, "shift": shift, "table": [*range(256)] if table is None else table}


def ramp(low: int, high: int, shift: int = 0) -> np.ndarray:
    """A picture in which values up to some are equally frequent."""
    return (np.linspace(low, high, 96 * 64).astype(np.uint16) << shift).reshape(64, 96)


@pytest.mark.parametrize("name", TONED)
@pytest.mark.parametrize(("bits", "shift"), [(8, 0), (10, 6), (12, 0), (12, 4), (14, 2), (16, 0)])
def test_a_tone_shows_the_nearest_level(name: str, bits: int, shift: int) -> None:
    encoding = ENCODINGS[name]
    plane = ramp(0, 2**bits - 1, shift)
    pixels = (
        plane
        if encoding.channels == 1
        else np.dstack([plane, plane[::-1], plane.T.reshape(64, 96)])
    )
    layout = fit("tone", encoding, [pixels])
    assert layout is not None
    assert layout.used_bits == bits + shift
    table = np.array(layout.parameters.table)
    assert (table[0], table[-1]) == (0, (2**bits - 1) << shift)
    for big in (False, True):
        view = as_message(pixels, encoding, pad=6, is_bigendian=big)
        assert layout.values.refuses(view) is None
        shown = through(layout, view)
        nearest = np.abs(table - pixels.reshape(-1, 1).astype(int)).min(axis=1)
        assert np.array_equal(np.abs(shown.astype(int) - pixels).ravel(), nearest)
    if bits + shift < 16:
        pixels[3, 5] = 2 ** (bits + shift)
        assert f"does not fit into {bits} bits" in str(layout.values.refuses(pixels))
    if shift:
        pixels[3, 5] = 1
        assert f"above {shift} zero bits" in str(layout.values.refuses(pixels))


VIEWS = [
    *((e.name, e.lossy, {}) for e in ENCODINGS.values() if e.lossy in ("gray8", "rgb24", "bgr24")),
    *((f"{order}a8", "opaque", {"alpha": 200}) for order in ("rgb", "bgr")),
    *(
        (name, "tone", tone(bits, shift, [level << shift for level in range(256)]))
        for name in TONED
        for bits, shift in ((8, 0), (8, 8), (10, 0), (12, 0), (12, 4), (13, 0), (14, 2), (16, 0))
    ),
]


@pytest.mark.parametrize(("name", "layout", "parameters"), VIEWS)
def test_all_differences_to_a_view_fit(name: str, layout: str, parameters: dict[str, Any]) -> None:
    """Whatever it shows, each layout of the video beside it holds them exactly."""
    encoding = ENCODINGS[name]
    view = bind(layout, encoding, LayoutParameters.model_validate(parameters))
    mask = 2**view.used_bits - 2 ** parameters.get("shift", 0)
    pixels, shown = (
        values(encoding, kind, 40, 30) & np.array(mask, encoding.dtype)
        for kind in ("random", "extreme")
    )
    if layout == "opaque":
        pixels[..., 3] = shown[..., 3] = 200
    assert view.values.refuses(pixels) is view.values.refuses(shown) is None
    different = difference(pixels, shown, view.used_bits)
    found = difference_layouts(view)
    assert encoding.general in [one.name for one in found]
    assert len(found) > 1 or parameters.get("bits") not in (10, 12, 14)
    for one in found:
        assert one.values.refuses(different) is None
        again = through(one, different)
        add_prediction(again, shown, view.used_bits)
        assert bits_of(again) == bits_of(pixels)


@pytest.mark.parametrize(
    ("encoding", "layout", "parameters", "words"),
    [
        ("mono8", "gray16", {}, "does not carry mono8"),
        ("mono16", "gray_bits", {}, "needs the parameters bits, shift"),
        ("mono16", "gray_bits", {"bits": 11, "shift": 0}, "11 bits above 0"),
        ("mono16", "fold", {"bits": 12, "shift": 0, "low": 1}, "no layout has 1 low bits of 12"),
        ("mono16", "palette", {"entries": 300}, "no power of two"),
        ("mono16", "palette", {"entries": 128}, "no power of two from 256 on"),
        ("rgba8", "opaque", {"alpha": 256}, "alpha\n.*less than or equal to 255"),
        ("mono16", "table", {"table": []}, "table of 0 values"),
        ("mono16", "table", {"table": [1, 2.0]}, "table.1\n.*valid integer"),
        (
            "32FC1",
            "metres16",
            {"hole": 2**32, "scale": "product"},
            "hole\n.*equal to 4294967295",
        ),
        ("32FC1", "metres16", {"hole": 0, "scale": "sum"}, "scale 'sum'"),
        ("mono16", "tone", tone(17), "bits\n.*less than or equal to 16"),
        ("mono16", "tone", tone(12, table=[*range(257)]), "table of 257 values"),
        ("mono16", "tone", tone(12, table=[*range(255), 4096]), "does not fit into 12 bits"),
        ("mono16", "tone", tone(12, table=[0, *range(255)]), "does not increase"),
    ],
)
def test_layouts_that_cannot_be(
    encoding: str, layout: str, parameters: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        bind(layout, ENCODINGS[encoding], LayoutParameters.model_validate(parameters))


# ---------------------------------------------------------------- views


@pytest.mark.parametrize("name", ENCODINGS)
def test_a_view_is_the_message_itself(name: str) -> None:
    for pad in [0, 1, 3, 8]:
        for big in [False, True]:
            encoding = ENCODINGS[name]
            width, height = rounded(encoding, 5, 3)
            step = width * encoding.pixel_bytes + pad
            count = encoding.size(step, height)
            data = bytearray(np.random.default_rng(0).integers(0, 256, count, np.uint8).tobytes())
            view = pixel_view(data, ImageFields(name, width, height, step, int(big)))
            order, size = "big" if big else "little", encoding.bytes_per_sample
            assert view.shape == encoding.shape(width, height)
            assert len(view) * step == count
            for y, x, c in np.ndindex(len(view), width, encoding.channels):
                at = y * step + x * encoding.pixel_bytes + c * size
                sample = view[y, x] if encoding.channels == 1 else view[y, x, c]
                assert sample.astype(encoding.dtype).tobytes() == int.from_bytes(
                    data[at : at + size], order
                ).to_bytes(size, "little")
            before = bytes(data)
            view[...] = 0
            assert view.flags.writeable
            for y in range(len(view)):  # the padding is not touched
                start = y * step + width * encoding.pixel_bytes
                assert data[start : start + pad] == before[start : start + pad]
                assert not any(data[y * step : start])


# ---------------------------------------------------------------- what has no layout


@pytest.mark.parametrize(
    ("encoding", "width", "height", "step", "size", "words"),
    [
        *((name, 4, 4, 16, 64, f"no layout for encoding {name!r}") for name in (
            "", "MONO8", "mono8 ", "rgb32", "8UC5", "8UC0", "8UC", "32UC1", "CV_8UC1",
            "bayer_rgbg8", "yuv420", "jpeg",
        )),
        ("mono8", 0, 4, 0, 0, "0x4 pixels"),
        ("mono8", 4, 4, 3, 12, "shorter than a row"),
        ("mono8", 4, 4, 4, 15, "15 bytes of pixels where step x height says 16"),
        ("nv12", 4, 4, 4, 16, "step x height x 3/2 says 24"),
        *((name, 3, 4, 6, 36, f"where {name} needs even sides") for name in (
            "yuv422", "uyvy", "yuyv", "yuv422_yuy2", "nv12", "nv21",
        )),
        *((name, 4, 3, 4, 18, "even sides") for name in ("nv12", "nv21")),
        ("mono8", MAX_SIDE + 1, 1, MAX_SIDE + 1, MAX_SIDE + 1, "beyond 16384"),
        ("64FC1", 5000, 1, 40000, 40000, "whose picture of 20000x2 is beyond 16384"),
        ("mono8", 4, 1, 5 + MAX_ROW_PADDING, 5 + MAX_ROW_PADDING, "4096 bytes of padding"),
        ("mono8", 2**32 - 1, 2**32 - 1, 2**32 - 1, 16, "bytes of pixels"),
    ],
)  # fmt: skip
def test_others_have_none_and_say_why(
    encoding: str, width: int, height: int, step: int, size: int, words: str
) -> None:
    reason = why_not(ImageFields(encoding, width, height, step), size)
    assert reason is not None
    assert words in reason
