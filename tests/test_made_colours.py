"""Colours that were made of a mosaic or of YUV are stored as what they were made of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

import mp4ds
import reader
from compare import compare
from mp4ds.messages.encodings import ENCODINGS, LayoutParameters
from mp4ds.messages.layouts import bind
from mp4ds.messages.sources import MOSAICS
from pixel_kinds import made_of
from round_trips import unpacked
from scenes import raw_image, raw_scene
from sources import SOURCES

RGB = ENCODINGS["rgb8"]

# ---------------------------------------------------------------- the rules

MOSAIC = [[171, 206, 5, 206], [120, 131, 161, 73], [250, 13, 71, 98], [146, 104, 33, 11]]
# the four pixels inside, as OpenCV 5.0 gives them
DEMOSAICED = {
    "rggb": [[[124, 125, 131], [38, 161, 102]], [[161, 13, 118], [71, 76, 80]]],
    "bggr": [[[131, 125, 124], [102, 161, 38]], [[118, 13, 161], [80, 76, 71]]],
    "gbrg": [[[141, 131, 110], [161, 70, 131]], [[115, 139, 13], [97, 71, 56]]],
    "grbg": [[[110, 131, 141], [131, 70, 161]], [[13, 139, 115], [56, 71, 97]]],
}


@pytest.mark.parametrize("mosaic", MOSAICS)
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8"])
def test_colours_of_a_mosaic_are_those_of_opencv(encoding: str, mosaic: str) -> None:
    layout = bind("from_mosaic8", ENCODINGS[encoding], LayoutParameters(mosaic=mosaic))
    tiles = bind("mosaic8", ENCODINGS["bayer_rggb8"]).to_picture(np.array(MOSAIC, np.uint8))
    out = np.empty((4, 4, 3), np.uint8)
    layout.to_pixels(tiles, out)
    rgb = out if encoding == "rgb8" else out[..., ::-1]
    assert rgb[1:3, 1:3].tolist() == DEMOSAICED[mosaic]
    assert np.array_equal(rgb, rgb[np.ix_([1, 1, 2, 2], [1, 1, 2, 2])])


YUV = [
    *((0, 128, 128), (15, 90, 240), (126, 128, 128), (200, 30, 160)),
    *((235, 240, 16), (81, 90, 240), (255, 0, 255)),
]
# as OpenCV 5.0, and libswscale of FFmpeg 8 on x86, give them
CONVERTED = {
    "opencv": [
        *([0, 0, 0], [179, 0, 0], [128, 128, 128], [255, 226, 16]),
        *([76, 255, 255], [254, 0, 0], [255, 225, 20]),
    ],
    "swscale": [
        *([0, 0, 0], [176, 0, 0], [128, 128, 128], [255, 225, 16]),
        *([76, 255, 255], [253, 0, 0], [255, 224, 19]),
    ],
}


@pytest.mark.parametrize("rule", CONVERTED)
def test_colours_of_yuv_are_those_of_the_library(rule: str) -> None:
    layout = bind("from_yuv422", RGB, LayoutParameters(rule=rule))
    luma, u, v = (np.array([row], np.uint8) for row in zip(*YUV, strict=True))
    out = np.empty((1, 2 * len(YUV), 3), np.uint8)
    layout.to_pixels((luma.repeat(2, axis=1), u, v), out)
    assert out[0, ::2].tolist() == out[0, 1::2].tolist() == CONVERTED[rule]


# ---------------------------------------------------------------- and back


def shades(kind: str, width: int, height: int, seed: int) -> tuple[NDArray[Any], ...]:
    """Y, U and V of 4:2:2, or a mosaic: dark, bright, or of all values and more colour."""
    rng = np.random.default_rng(seed)
    low, high = {"dark": (0, 40), "bright": (200, 256), "all": (0, 256)}[kind]
    chroma = (90, 166) if kind == "all" else (112, 144)
    return (
        rng.integers(low, high, (height, width), np.uint8),
        *(rng.integers(*chroma, (height, width // 2), np.uint8) for _ in range(2)),
    )


@pytest.mark.parametrize("kind", ["dark", "bright", "all"])
@pytest.mark.parametrize("mosaic", MOSAICS)
def test_the_edges_of_a_mosaic_are_found(mosaic: str, kind: str) -> None:
    layout = bind("from_mosaic8", RGB, LayoutParameters(mosaic=mosaic))
    tiles = bind("mosaic8", ENCODINGS["bayer_rggb8"])
    for width, height in ((64, 48), (33, 25), (5, 4)):
        made, again = np.empty((2, height, width, 3), np.uint8)
        layout.to_pixels(tiles.to_picture(shades(kind, width, height, 0)[0]), made)
        layout.to_pixels(layout.arrange(layout.values.prove(made)), again)
        assert np.array_equal(made, again)


# ---------------------------------------------------------------- recordings


@pytest.mark.parametrize("source", ["mosaic", "yuv420", "yuv422"])
def test_an_image_with_a_drawing_goes_into_another_stream(source: str, tmp_path: Path) -> None:
    images = [made_of(source, RGB, 64, 48, seed=0) for _ in range(8)]
    images[6][21:26, 31:40] = (255, 0, 1)
    messages = [
        (
            10**9 + n * 10**8,
            *(raw_image(wire, width=64, height=48, encoding="rgb8", data=pixels.tobytes())
            for wire in ("ros1", "cdr")),
        )
        for n, pixels in enumerate(images)
    ]  # fmt: skip
    scene = raw_scene("/cam/image_raw", "sensor_msgs/msg/Image", messages)
    paths = SOURCES["mcap-ros2-none"](tmp_path, scene)
    mp4ds.pack(paths, tmp_path / "dataset")
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(paths, unpacked(tmp_path, "mcap")) == []
    assert reader.main(tmp_path / "dataset") == 0  # the second one, which compares digests
    layouts = {yaml.safe_load(path.read_bytes())["video"]["layout"] for path in streams(tmp_path)}
    assert layouts == {f"from_{source}".replace("mosaic", "mosaic8"), "rgb24"}
    with mp4ds.open(tmp_path / "dataset") as dataset:
        read = dataset["/cam/image_raw"].read(range(len(images)))
        assert np.array_equal(np.stack(list(read)), np.stack(images))


def streams(folder: Path) -> list[Path]:
    return sorted(
        path for path in (folder / "dataset").glob("*.yaml") if path.name != "dataset.yaml"
    )
