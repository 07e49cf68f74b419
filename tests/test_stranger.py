"""What is packed is read again by a reader that knows spec/ alone: the text says it all."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xxhash
from mcap.reader import make_reader
from numpy.typing import NDArray

import stranger
from coded_scenes import CODED
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from mp4ds.messages.encodings import ENCODINGS, Encoding
from mp4ds.messages.layouts import LAYOUTS, fit
from mp4ds.packing.pack import pack
from scenes import Scene, odd_scene, scene
from sources import SOURCES
from stranger_messages import Stream

CONTENTS = ("random", "12 bits", "12 bits, high", "few values", "many values", "metres", "opaque")


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
        yield found.astype(f"u{size}").view(encoding.dtype)


def test_every_exact_layout_is_what_the_spec_says() -> None:
    seen = set()
    for seed, (width, height) in enumerate([(8, 6), (7, 5), (40, 31)]):
        for name, encoding in ENCODINGS.items():
            across, down = encoding.even
            size = width + -width % across, height + -height % down
            for pixels in contents(encoding, *size, seed):
                patterns = pixels.view(f"u{encoding.bytes_per_sample}")
                for layout_name in encoding.exact:
                    layout = fit(layout_name, encoding, [pixels])
                    if layout is None:
                        continue
                    seen.add(layout_name)
                    found = stranger.pixels(
                        layout_name,
                        layout.parameters.to_values(),
                        name,
                        size,
                        layout.to_picture(pixels),
                    )
                    expected = patterns.reshape(*pixels.shape[:2], -1)
                    assert np.array_equal(found, expected), f"{layout_name} of {name}"
    assert seen == {name for name, kind in LAYOUTS.items() if kind.is_exact}


def padded(trait: str, *, frames: int, **_: int) -> Scene:
    return odd_scene(trait, frames=frames)


Case = tuple[Callable[..., Scene], Callable[[Path, Scene], list[Path]]]
ROS1, ROS2 = SOURCES["mcap-ros1-zstd"], SOURCES["mcap-ros2-none"]
CASES: dict[str, Case] = {
    **{
        f"{trait}-{world}": (partial(padded, trait), write)
        for trait in ("row-padding-varied", "row-padding-not-last")
        for world, write in (("ros1", ROS1), ("ros2", ROS2))
    },
    **{
        f"{encoding}-{world}": (partial(scene, encoding, pad=5, big_endian=world == "ros2"), write)
        for encoding in ("mono8", "bgr8", "rgba8", "bayer_rggb8", "rgb16", "16SC1", "32FC1", "nv21")
        for world, write in (("ros1", ROS1), ("ros2", ROS2))
    },
    **{
        f"{content}-{encoding}": (partial(scene, encoding, content=content), ROS2)
        for content, encoding in (
            *(("12-bit", "mono16"), ("12-bit-high", "bayer_grbg16"), ("few-values", "16UC1")),
            *(("millimetres", "32FC1"), ("millimetres-product", "32FC1"), ("full", "yuyv")),
        )
    },
    **{
        f"{name}-{world}": (CODED[name], write)
        for name in (
            *("jpeg-rgb", "jpeg-exif-trailing", "png-rgb-cv2", "png-gray-pillow", "png-rgba-cv2-9"),
            *("png-16-bit-cv2", "depth-16UC1-png", "depth-16UC1-rvl", "depth-32FC1-rvl"),
            *("video-h264-aud-sei", "video-h264-3-byte", "video-h265", "video-av1"),
            *("video-av1-no-delimiter", "video-vp9", "ffmpeg-libx264", "ffmpeg-libsvtav1"),
        )
        for world, write in (("ros1", ROS1), ("ros2", ROS2))
    },
    **{
        f"{name}-{source}": (FOXGLOVE[name], FOXGLOVE_SOURCES[source])
        for name in ("raw-padded", "jpeg-rgb", "video-h264")
        for source in FOXGLOVE_SOURCES
        if name == "raw-padded" or source == "mcap-foxglove-ros2"
    },
}


@pytest.mark.one_in(6)
@pytest.mark.parametrize("case", CASES)
def test_a_reader_that_knows_the_spec_alone_gives_every_message(case: str, tmp_path: Path) -> None:
    make, write = CASES[case]
    (source,) = write(tmp_path, make(frames=8, width=192, height=128))
    pack(source, tmp_path / "packed")
    recorded: dict[str, list[bytes]] = {}
    with source.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            recorded.setdefault(channel.topic, []).append(message.data)
    sidecars = sorted((tmp_path / "packed").glob("*.yaml"))
    streams = [Stream(path) for path in sidecars if path.name != "dataset.yaml"]
    assert streams, "nothing became a stream"
    for stream in streams:
        payloads = list(stream.payloads())
        assert [f"{xxhash.xxh64_intdigest(p):016x}" for p in payloads] == stream.digests()
        assert set(payloads) <= set(recorded[stream.sidecar["channel"]["topic"]])
        assert len(payloads) == stream.sidecar["frames"]
        infos = list(stream.calibrations())
        if infos:
            assert infos == recorded[stream.sidecar["camera_info"]["channel"]["topic"]]
