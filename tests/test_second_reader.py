"""A reader that knows spec/ alone reads the suite, every layout, and what is packed today."""

from __future__ import annotations

import ast
import hashlib
import itertools
import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray

import images
import mp4ds
import reader
import run
from coded_scenes import CODED
from commands import program
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from mp4ds.messages.encodings import ENCODINGS, Encoding
from mp4ds.messages.layouts import LAYOUTS, fit
from mp4ds.video.colour import MATRICES, samples
from mp4ds.video.pixels import PictureMaker
from pixel_kinds import made_of
from scenes import Scene, odd_scene, scene
from sources import SOURCES

SUITE = Path(__file__).parents[1] / "conformance"
NOT_READ = ("values", "messages")
"""Parts that the reader does not claim; README.md says the same."""
CASES = [
    case
    for case in json.loads((SUITE / "cases" / "cases.json").read_text())["cases"]
    if case["part"] not in NOT_READ
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["path"])
def test_the_suite(case: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    reader.main(SUITE / "cases" / case["path"])
    left_out: set[str] = set()
    found = json.loads(capsys.readouterr().out)
    assert run.wrong_of(case, found, False, left_out) == []
    assert not left_out


@pytest.mark.parametrize("path", sorted(SUITE.glob("*.py")), ids=lambda path: path.name)
def test_it_shares_no_code_with_mp4ds(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            assert "mp4ds" not in {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert (node.module or "").split(".")[0] != "mp4ds"


# ---------------------------------------------------------------- layouts

CONTENTS = (
    *("random", "12 bits", "12 bits, high", "few values", "many values", "metres", "opaque"),
    *("mosaic", "yuv420", "yuv422"),
)


def sources_of(width: int, height: int) -> list[str]:
    """What colours of this size may have been made of."""
    yuv = [] if width % 2 else ["yuv422"] if height % 2 else ["yuv420", "yuv422"]
    return ["mosaic", *yuv]


def contents(encoding: Encoding, width: int, height: int, seed: int) -> Iterator[NDArray[Any]]:
    """Pixels that all layouts of an encoding together hold, in its own type."""
    rng = np.random.default_rng(seed)
    shape, size = encoding.shape(width, height), encoding.bytes_per_sample
    top = 256**size - 1
    for content in CONTENTS:
        found = rng.integers(0, top, shape, f"u{size}", endpoint=True)
        if content.startswith("12 bits") and size == 2:
            found = (found & 4095) << (4 if content.endswith("high") else 0)
            if encoding.is_signed and not content.endswith("high"):
                found -= 2048
        elif content.endswith("values"):
            count = 20 if content.startswith("few") else 600
            found = rng.choice(rng.integers(0, top, count, f"u{size}", endpoint=True), shape)
        elif content == "metres" and encoding.dtype == "f4":
            whole = rng.integers(0, 65536, shape).astype("f4")
            metres = whole / np.float32(1000) if seed % 2 else whole * np.float32(0.001)
            found = np.where(whole < 999, np.float32(np.nan), metres).view("u4")
        elif content == "opaque" and encoding.channels == 4:
            found[..., 3] = 77
        elif content in sources_of(width, height) and encoding.name in ("rgb8", "bgr8"):
            found = made_of(content, encoding, width, height, seed)
        yield found.astype(f"u{size}").view(encoding.dtype)


def planes(picture: list[NDArray[Any]], order: str) -> list[NDArray[Any]]:
    """Those of a picture that is one array, with colours last, or a plane each."""
    if picture[0].ndim == 2:
        return list(picture)
    order = order[: picture[0].shape[2]]
    return [picture[0][..., order.index(name)] for name in "gbra" if name in order]


@pytest.mark.parametrize("size", [(8, 6), (7, 5), (40, 31)], ids=str)
def test_every_exact_layout_is_what_the_spec_says(size: tuple[int, int]) -> None:
    seen = set()
    for name, encoding in ENCODINGS.items():
        across, down = encoding.even
        width, height = size[0] + -size[0] % across, size[1] + -size[1] % down
        image = {"encoding": name, "width": width, "height": height}
        for pixels in contents(encoding, width, height, seed=size[1]):
            patterns = pixels.view(f"u{encoding.bytes_per_sample}")
            for layout_name in encoding.exact:
                layout = fit(layout_name, encoding, [pixels])
                if layout is None:
                    continue
                seen.add(layout_name)
                video = {"layout": layout_name, "parameters": layout.parameters.values}
                order = "rgba" if name.startswith("rgb") else "bgra"
                found = images.pixels(image, video, planes(layout.to_picture(pixels), order))
                expected = patterns.reshape(*pixels.shape[:2], -1)
                assert np.array_equal(found, expected), f"{layout_name} of {name}"
    odd = {f"from_{name}" for name in {"yuv420", "yuv422"} - {*sources_of(*size)}}
    assert seen == {name for name, kind in LAYOUTS.items() if kind.is_exact} - odd


@pytest.mark.parametrize("source", sources_of(40, 30))
@pytest.mark.parametrize("name", ["rgb8", "bgr8"])
def test_what_a_view_predicts_of_a_source_is_what_the_spec_says(name: str, source: str) -> None:
    encoding = ENCODINGS[name]
    image = {"encoding": name, "width": 40, "height": 30}
    rng = np.random.default_rng(3)
    prediction = rng.integers(0, 256, (30, 40, 3), np.uint8)
    pixels = made_of(source, encoding, 40, 30, seed=2)
    layouts = (fit(layout, encoding, [pixels]) for layout in encoding.exact)
    layout = next(filter(None, layouts))
    assert layout.name.removeprefix("from_").rstrip("8") == source
    picture = layout.to_picture(pixels, (prediction, 8))
    video = {"layout": layout.name, "parameters": layout.parameters.values}
    order = "rgba" if name == "rgb8" else "bgra"
    assert np.array_equal(images.pixels(image, video, planes(picture, order), prediction), pixels)
    again = np.empty_like(pixels)
    layout.to_pixels(picture, again, (prediction, 8))
    assert np.array_equal(again, pixels)


LOSSY = [  # by a curve that follows from the images, it is in the cases of the suite
    name
    for name, encoding in ENCODINGS.items()
    if encoding.lossy and not LAYOUTS[encoding.lossy].parameters
]
SIZES = [(2, 2), (7, 5), (40, 31)]


@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv420p10le"])
@pytest.mark.parametrize("matrix", MATRICES)
@pytest.mark.parametrize("color_range", ["full", "limited"])
def test_every_lossy_layout_is_what_the_spec_says(
    pixel_format: str, matrix: str, color_range: str
) -> None:
    """To the bit, since images may be differences to it: of any samples that decoders may give."""
    rng = np.random.default_rng(5)
    for name, (width, height) in itertools.product(LOSSY, SIZES):
        encoding = ENCODINGS[name]
        across, down = encoding.even
        image = {"width": width + -width % across, "height": height + -height % down}
        found = contents(encoding, **image, seed=5)
        layouts = (fit(encoding.lossy or "", encoding, [pixels]) for pixels in found)
        layout = next(layout for layout in layouts if layout)
        picture_size = layout.picture_size(image["width"], image["height"])
        coded = [side + side % 2 for side in picture_size]
        frame = av.VideoFrame(*coded, pixel_format)
        for index in range(3):
            plane = samples(frame, index)
            plane[...] = rng.integers(0, 4 * 256 if plane.itemsize > 1 else 256, plane.shape)
        maker = PictureMaker(
            Path(),
            coded_size=(coded[0], coded[1]),
            picture_format=layout.pixel_format,
            picture_size=picture_size,
            matrix=matrix,
            full_range=color_range == "full",
        )
        own = np.empty(layout.encoding.shape(**image), layout.encoding.dtype)
        layout.to_pixels(maker.make(frame, 0), own)
        video = {"layout": layout.name, "parameters": layout.parameters.values}
        video |= {"pixel_format": pixel_format, "color": {"matrix": matrix, "range": color_range}}
        told = images.pixels({"encoding": name, **image}, video, images.planes_of(frame)[1])
        assert np.array_equal(told, own.reshape(told.shape)), f"{layout.name} of {name}"


SEEN = [
    (case["path"], stream["view"])
    for case in CASES
    if "expected" in case
    for stream in json.loads((SUITE / "cases" / case["expected"]).read_text())["streams"]
    if "view" in stream and stream["view"]["codec"] == "av1"
]


@pytest.mark.one_in(12)
@pytest.mark.parametrize("decoder", ["libaom-av1", "libdav1d"])
@pytest.mark.parametrize(("path", "view"), SEEN, ids=[view["video"] for _, view in SEEN])
def test_other_decoders_of_views_give_the_same_samples(
    path: str, view: dict[str, Any], decoder: str
) -> None:
    """And so the same predictions, as the test above shows. Those of the system's ffmpeg."""
    if not shutil.which("ffmpeg") or decoder not in program("ffmpeg", "-v", "0", "-decoders").out:
        pytest.skip(f"there is no ffmpeg with {decoder}")
    folder = SUITE / "cases" / path
    folder = folder if folder.is_dir() else folder.parent
    name, due = view["planes"]["pixel_format"], view["planes"]["sha256"]
    command = ["ffmpeg", "-v", "error", "-c:v", decoder, "-i", str(folder / view["video"])]
    command += ["-vsync", "passthrough", "-f", "rawvideo", "-pix_fmt", name, "-"]
    found = subprocess.run(command, capture_output=True, check=True).stdout
    width, height = view["coded_size"]
    size = width * height * 3 // 2 * (2 if name.endswith("le") else 1)
    planes = [found[start : start + size] for start in range(0, len(found), size)]
    # with some decoders, ffmpeg also shows what an edit list hides
    hashes = [hashlib.sha256(plane).hexdigest() for plane in planes[-len(due) :]]
    assert hashes == due


# ---------------------------------------------------------------- what is packed today

ROS = {"ros1": "mcap-ros1-zstd", "ros2": "mcap-ros2-none"}


def odd(trait: str, *, frames: int, **_: int) -> Scene:
    return odd_scene(trait, frames=frames)


ROS_SCENES: dict[str, Callable[..., Scene]] = {
    **{
        trait: partial(odd, trait)
        for trait in ("row-padding-varied", "row-padding-not-last", "cdr-big-endian")
    },
    **{
        f"{encoding}-padded": partial(scene, encoding, pad=5)
        for encoding in ("mono8", "bgr8", "rgba8", "bayer_rggb8", "16SC1", "nv21")
    },
    **{
        f"{encoding}-big-endian": partial(scene, encoding, pad=5, big_endian=True)
        for encoding in ("rgb16", "32FC1")
    },
    **{
        f"{encoding}-{content}": partial(scene, encoding, content=content)
        for encoding, content in (
            *(("mono16", "12-bit"), ("bayer_grbg16", "12-bit-high"), ("16UC1", "few-values")),
            *(("32FC1", "millimetres"), ("32FC1", "millimetres-product"), ("yuyv", "full")),
        )
    },
    **{
        name: CODED[name]
        for name in (
            *("jpeg-rgb", "jpeg-exif-trailing", "png-rgb-cv2", "png-gray-pillow", "png-rgba-cv2-9"),
            *("png-16-bit-cv2", "depth-16UC1-png", "depth-16UC1-rvl", "depth-32FC1-rvl"),
            *("video-h264-aud-sei", "video-h264-3-byte", "video-h265", "video-av1"),
            *("video-av1-no-delimiter", "ffmpeg-libx264", "ffmpeg-libsvtav1"),
        )
    },
}
PACKED = {
    **{
        f"{name}-{ros}": (make, SOURCES[ROS[ros]])
        for name, make in ROS_SCENES.items()
        for ros in ROS
    },
    **{
        f"{name}-{source}": (FOXGLOVE[name], FOXGLOVE_SOURCES[source])
        for name in ("raw-padded", "jpeg-rgb", "video-h264")
        for source in FOXGLOVE_SOURCES
        if name == "raw-padded" or source == "mcap-foxglove-ros2"
    },
}


@pytest.mark.one_in(12)
@pytest.mark.parametrize("case", PACKED)
def test_every_message_of_what_is_packed(case: str, tmp_path: Path) -> None:
    make, write = PACKED[case]
    (source,) = write(tmp_path, make(frames=8, width=192, height=128))
    mp4ds.pack(source, tmp_path / "packed")
    recorded: dict[str, list[str]] = {}
    with source.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            digest = hashlib.sha256(message.data).hexdigest()
            recorded.setdefault(channel.topic, []).append(digest)
    streams = reader.dataset(tmp_path / "packed")["streams"]
    assert streams, "nothing became a stream"
    for stream in streams:
        ordinals = map(int, stream["columns"]["ordinal"])
        assert stream["payloads"] == [recorded[stream["topic"]][n] for n in ordinals]
        if info := stream["camera_info"]:
            assert info["payloads"] == recorded[info["topic"]]
