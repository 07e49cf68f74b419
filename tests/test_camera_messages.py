"""Every kind of camera message: recording -> dataset -> recording, equal, and in videos.

Each test says how many messages are frames of videos, so that it does not pass because they
were stored verbatim. The ordinary run goes through every kind once, each from another source
and in another shape; the slow one through all sources and shapes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mp4ds
from coded_scenes import CODED, VERBATIM
from compare import compare
from definitions import PICTURES
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from pictures import BAYER, CONTENTS, ENCODINGS
from republished import Read, image_of, psnr, read
from round_trips import Journey, journey, own_target
from scenes import Scene
from sources import SOURCES, scene

TOPIC = "/cam/image_raw"
FRAMES = 8


def share(cases: list[Any], every: int) -> list[Any]:
    """The cases, of which all but every n-th are slow; each kind begins at another of them."""
    return [
        pytest.param(*case, id="-".join(map(str, case)), marks=[pytest.mark.slow] if skip else [])
        for number, case in enumerate(cases)
        for skip in [(number + number // every) % every]
    ]


def image_topic(recorded: Scene) -> str:
    (topic,) = {message.topic for message in recorded.messages if message.msgtype in PICTURES}
    return topic


# ---------------------------------------------------------------- raw images

RAW_SOURCES = ["bag-lz4", "rosbag2-sqlite3-v9", "mcap-ros2-zstd"]
SHAPES: dict[str, dict[str, Any]] = {
    "odd": {"width": 63, "height": 47},
    "padded": {"width": 66, "height": 45, "pad": 5},
    "big-endian": {"width": 64, "height": 49, "big_endian": True},
}
KINDS = [(content, encoding) for content, names in CONTENTS.items() for encoding in names]
RAW = [
    (content, encoding, source, list(SHAPES)[(k + n) % 3])
    for n, (content, encoding) in enumerate(KINDS)
    for k, source in enumerate(RAW_SOURCES)
]
NOT_SMALLER = {(m, f"64FC{n}") for m in ("millimetres", "millimetres-product") for n in "1234"}
"""Of few digits, which zstd finds better than any codec of pictures."""

EVEN = {("few-values", f"bayer_{name[6:10]}16") for name in BAYER}
EVEN |= {("few-values", f"{name}16") for name in ("rgb", "bgr", "rgba", "bgra")}
EVEN |= {("few-values", f"16UC{channels}") for channels in "34"}
EVEN |= {("full", "32FC1")}
"""Where the two are of about one size, so that either may be taken."""


@pytest.mark.one_in(12)
@pytest.mark.parametrize(("content", "encoding", "source", "shape"), share(RAW, 6))
def test_raw_images(content: str, encoding: str, source: str, shape: str, tmp_path: Path) -> None:
    recorded = scene(encoding, frames=FRAMES, content=content, **SHAPES[shape])
    done = journey(tmp_path, SOURCES[source], recorded, own_target(source))
    messages, frames = done.frames(TOPIC)
    assert messages == FRAMES
    if (content, encoding) in NOT_SMALLER:
        assert frames == 0
        assert [reason.split(":")[0] for reason in done.reasons(TOPIC)] == [
            "a video would not be smaller"
        ]
    elif (content, encoding) in EVEN:
        assert frames in (0, FRAMES)
    else:
        assert frames == FRAMES
        assert done.frames("/cam/camera_info") == (FRAMES, FRAMES)


# ---------------------------------------------------------------- values that come later

LATER = {
    "13 bits after 12": ("mono16", "12-bit", "full"),
    "low bits after none": ("bayer_rggb16", "12-bit-high", "full"),
    "new values after few": ("16UC1", "few-values", "full"),
    "metres after millimetres": ("32FC1", "millimetres", "full"),
    "a product after quotients": ("32FC1", "millimetres", "millimetres-product"),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", LATER)
@pytest.mark.parametrize("source", ["bag-none", "mcap-ros2-lz4"])
def test_images_that_do_not_fit_what_the_first_were_like(
    name: str, source: str, tmp_path: Path
) -> None:
    """A second stream takes them, message by message, and both merge again."""
    encoding, first, then = LATER[name]
    size = {"frames": 16, "width": 64, "height": 48}
    early, late = (scene(encoding, content=content, **size) for content in (first, then))
    images = 0
    for place, message in enumerate(early.messages):
        if message.topic != TOPIC:
            continue
        if images in (9, 12, 13):
            early.messages[place] = late.messages[place]
        images += 1
    done = journey(tmp_path, SOURCES[source], early, own_target(source))
    assert done.frames(TOPIC) == (16, 16)
    with mp4ds.open(done.dataset) as dataset:
        counts = [len(stream) for stream in dataset.streams]
        assert counts == [13, 3]
        assert [s.sidecar.video.parameters is None for s in dataset.streams] == [False, True]


# ---------------------------------------------------------------- coded pictures and packets

CODED_SOURCES = ["bag-lz4", "rosbag2-mcap-v9", "mcap-ros2-zstd"]
EXPECTED: dict[str, tuple[int, int]] = {
    **dict.fromkeys(CODED, (10, 10)),
    **dict.fromkeys(VERBATIM, (10, 0)),
    "jpeg-cut-one": (10, 9),
    "jpeg-empty-one": (10, 9),
    "png-palette": (10, 0),
    "png-1-bit": (10, 0),
    "video-h264-headers-apart": (13, 10),
    # from the next key frame on
    **{f"video-{codec}-mid-gop": (8, 6) for codec in ("h264", "h265", "av1")},
    # what is there is carried: that one was lost is another matter
    **{f"video-{codec}-lost": (9, 9) for codec in ("h264", "h265", "av1")},
    # up to the first that is shown before the one sent before it
    **{f"video-{codec}-bframes": (10, 2) for codec in ("h264", "h265")},
    "ffmpeg-libx264-bframes": (10, 2),
}
"""Messages of each scene, and how many of them are frames of videos."""

EVEN_PNG = {f"png-{name}" for name in ("rgb-cv2", "rgb-cv2-9", "rgb-pillow", "rgba-pillow")}
EVEN_PNG |= {"png-called-jpeg"}
"""Noise in colours, of which a video is about as large: see below for others."""

STREAMS = {"jpeg-mixed-sizes": 2, "video-h264-resized": 2}


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("name", "source"), share([(name, s) for name in CODED for s in CODED_SOURCES], 6)
)
def test_coded_pictures(name: str, source: str, tmp_path: Path) -> None:
    recorded = CODED[name]()
    topic = image_topic(recorded)
    done = journey(tmp_path, SOURCES[source], recorded, own_target(source))
    messages, frames = done.frames(topic)
    if name in EVEN_PNG:
        assert (messages, frames) in ((10, 0), (10, 10))
    else:
        assert (messages, frames) == EXPECTED[name]
    assert sum(done.reasons(topic).values()) == messages - frames
    with mp4ds.open(done.dataset) as dataset:
        assert len(dataset.streams) == (STREAMS.get(name, 1) if frames else 0)
        for stream in dataset.streams:
            assert stream.sidecar.profile == "lossless"
            assert stream.sidecar.body == body_of(name)


def body_of(name: str) -> str:
    if name.startswith("png-"):
        return "png"
    if name.startswith("depth-"):
        return "rvl" if name.endswith("rvl") else "png"
    return "packet"


# ---------------------------------------------------------------- Foxglove's schemas

FOXGLOVE_EXPECTED: Mapping[str, tuple[int, int]] = {
    **dict.fromkeys(FOXGLOVE, (10, 10)),
    **dict.fromkeys(("webp", "video-empty"), (10, 0)),
    "png-rgb-pillow": (10, 0),
    "jpeg-cut-one": (10, 9),
    "video-h264-mid-gop": (8, 6),
    "video-h264-bframes": (10, 2),
}
FOXGLOVE_CASES = [(name, source) for name in FOXGLOVE for source in FOXGLOVE_SOURCES]


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("name", "source"), share(FOXGLOVE_CASES, len(FOXGLOVE_SOURCES)))
def test_foxglove_messages(name: str, source: str, tmp_path: Path) -> None:
    done = journey(tmp_path, FOXGLOVE_SOURCES[source], FOXGLOVE[name](), "mcap")
    messages, frames = FOXGLOVE_EXPECTED[name]
    assert done.frames("/camera/image") == (messages, frames)
    calibrations = done.frames("/camera/calibration")
    assert calibrations == (messages, messages if frames else 0)
    if frames:
        with mp4ds.open(done.dataset) as dataset:
            assert dataset.streams[0].sidecar.wire == wire_of(source)


def wire_of(source: str) -> str:
    return "cdr-le" if "ros2" in source else source.split("-")[1]


# ---------------------------------------------------------------- profiles


def of_topic(path: Path, topic: str) -> list[Read]:
    return [message for message in read(path) if message.topic == topic]


def least_psnr(done: Journey, topic: str) -> float:
    """Of all messages of a topic: what came out against what was recorded."""
    recorded, found = (of_topic(path, topic) for path in (done.sources[0], done.output))
    assert len(recorded) == len(found) > 0
    pairs = [(image_of(a), image_of(b)) for a, b in zip(recorded, found, strict=True)]
    return min(psnr(a, b, np.iinfo(a.dtype).max) for a, b in pairs)


LOSSY: dict[str, float] = {
    **dict.fromkeys(["mono8", "8UC1"], 43),
    **dict.fromkeys(["nv12", "nv21"], 41),
    # colours whose edges are finer than a video's
    **dict.fromkeys(["yuv422", "uyvy", "yuyv", "yuv422_yuy2"], 34),
    "nv24": 30,
    **dict.fromkeys(["rgb8", "bgr8", "8UC3", "rgb16", "bgr16"], 25),
    **dict.fromkeys([*BAYER, *(f"{name[:-1]}16" for name in BAYER)], 27),
}
"""Encoding -> dB that lossy videos reach at least, of small pictures full of edges."""

QUALITIES: dict[str, dict[str, Any]] = {
    "visual": {"quality": "visual"},
    "crf": {"quality": "crf=12", "codec": "h264", "preset": "veryfast"},
    "crf-h265": {"quality": "crf=12", "codec": "h265", "preset": "veryfast"},
    "crf-10bit": {"quality": "crf=12", "codec": "av1-10bit", "preset": "8"},
}


@pytest.mark.one_in(8)
@pytest.mark.parametrize(
    ("quality", "encoding"),
    share([(quality, name) for name in ENCODINGS for quality in QUALITIES], len(QUALITIES)),
)
def test_raw_images_in_a_lossy_profile(quality: str, encoding: str, tmp_path: Path) -> None:
    """All but the pixels is exact, and the pixels are where loss would harm their meaning."""
    is_lossy = encoding in LOSSY
    recorded = scene(encoding, frames=6, width=94, height=62, pad=2, noisy=not is_lossy)
    ignored = [TOPIC] if is_lossy else []
    done = journey(tmp_path, SOURCES["bag-none"], recorded, "bag", ignored, **QUALITIES[quality])
    assert done.frames(TOPIC) == (6, 6)
    with mp4ds.open(done.dataset) as dataset:
        (stream,) = dataset.streams
    if is_lossy:
        assert stream.sidecar.profile == QUALITIES[quality]["quality"]
        assert LOSSY[encoding] <= least_psnr(done, TOPIC) < 90
        differences = compare(done.sources, done.output, limit=99)
        assert differences == [f"{TOPIC} message {n}: payload differs" for n in range(6)]
    else:
        assert stream.sidecar.profile == "lossless"


@pytest.mark.one_in(3)
@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("size", [(16, 16), (34, 18), (48, 32), (48, 200), (62, 62), (64, 16)])
def test_narrow_images_in_a_lossy_profile(
    size: tuple[int, int], quality: str, tmp_path: Path
) -> None:
    """x265 damages pictures, or the memory, where there are up to 48 columns: it is not asked."""
    recorded = scene("mono8", frames=12, width=size[0], height=size[1], noisy=False)
    done = journey(tmp_path, SOURCES["bag-none"], recorded, "bag", [TOPIC], **QUALITIES[quality])
    if quality == "crf-h265" and size[0] < 64:
        assert done.frames(TOPIC) == (12, 0)
        assert list(done.reasons(TOPIC)) == [
            f"libx265 does not take pictures of {size[0]}x{size[1]}"
        ]
        return
    assert done.frames(TOPIC) == (12, 12)
    assert 37 < least_psnr(done, TOPIC) < 90  # 37.3 of 10 bits by the SVT-AV1 of PyAV 19


TRANSCODED = [
    name
    for name in CODED
    if name.startswith("jpeg-") and EXPECTED[name] == (10, 10) and name != "jpeg-corrupt-one"
]
LEAST = {
    **dict.fromkeys(("jpeg-gray", "jpeg-pillow-gray", "jpeg-format-mono8"), 38),
    "jpeg-mixed-sizes": 31,
    "jpeg-422": 28,
    "jpeg-444": 25,
}
"""dB, of a lossy video and a JPEG file of quality 95; 33 for others, whose colours are halved."""


@pytest.mark.one_in(8)
@pytest.mark.parametrize(
    ("name", "quality"),
    share([(name, quality) for name in TRANSCODED for quality in QUALITIES], len(QUALITIES)),
)
def test_jpeg_files_that_are_transcoded(name: str, quality: str, tmp_path: Path) -> None:
    recorded = CODED[name](frames=8, width=96, height=64)
    topic = image_topic(recorded)
    options = QUALITIES[quality] | {"transcode": True}
    done = journey(tmp_path, SOURCES["bag-none"], recorded, "bag", [topic], **options)
    # the smaller of the two sizes is narrower than x265 is asked for
    narrow = (name, quality) == ("jpeg-mixed-sizes", "crf-h265")
    assert done.frames(topic) == (8, 6 if narrow else 8)
    with mp4ds.open(done.dataset) as dataset:
        assert {stream.sidecar.body for stream in dataset.streams} == {"jpeg"}
        assert {stream.sidecar.profile for stream in dataset.streams} == {
            QUALITIES[quality]["quality"]
        }
    assert compare(done.sources, done.output) != []
    assert LEAST.get(name, 33) <= least_psnr(done, topic) < 90


@pytest.mark.parametrize("quality", QUALITIES)
def test_jpeg_packets_that_are_transcoded(quality: str, tmp_path: Path) -> None:
    recorded = CODED["ffmpeg-mjpeg-yuvj420p-bgr8-bgr8"](width=96, height=64)
    topic = image_topic(recorded)
    options = QUALITIES[quality] | {"transcode": True}
    done = journey(tmp_path, SOURCES["bag-none"], recorded, "bag", [topic], **options)
    assert done.frames(topic) == (10, 10)
    assert 29 <= least_psnr(done, topic) < 90
    differences = compare(done.sources, done.output, limit=99)
    assert differences == [f"{topic} message {n}: payload differs" for n in range(10)]


OTHERS = [
    name
    for name in CODED
    if name.startswith(("depth-", "video-", "ffmpeg-"))
    and "mjpeg" not in name
    and name not in VERBATIM
]


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("name", "quality"),
    share([(name, quality) for name in OTHERS for quality in QUALITIES], 2 * len(QUALITIES)),
)
def test_what_else_is_coded_stays_exact_in_every_profile(
    name: str, quality: str, tmp_path: Path
) -> None:
    """Depth and packets: there is nothing to transcode."""
    recorded = CODED[name]()
    options = QUALITIES[quality] | {"transcode": True}
    done = journey(tmp_path, SOURCES["bag-none"], recorded, "bag", **options)
    assert done.frames(image_topic(recorded)) == EXPECTED[name]


@pytest.mark.parametrize("quality", QUALITIES)
def test_jpeg_files_are_kept_unless_asked(quality: str, tmp_path: Path) -> None:
    recorded = CODED["jpeg-rgb"]()
    done = journey(tmp_path, SOURCES["bag-none"], recorded, "bag", **QUALITIES[quality])
    (summary,) = (t for t in done.summary.topics if t.topic == image_topic(recorded))
    assert summary.frames == 10
    assert any("--transcode" in note for note in summary.notes)


# ---------------------------------------------------------------- all of it at once


@pytest.mark.one_in(3)
@pytest.mark.parametrize("source", ["bag-bz2", "rosbag2-mcap-v9", "mcap-ros2-zstd"])
def test_a_robot_with_many_cameras(source: str, tmp_path: Path) -> None:
    """Several topics and kinds in one recording, in several threads."""
    names = ["jpeg-rgb", "png-gray-cv2", "depth-16UC1-rvl", "video-h264", "ffmpeg-libx265"]
    scenes = [CODED[name](seed=n) for n, name in enumerate(names)]
    scenes += [scene(encoding, frames=10, seed=9) for encoding in ("bgra8", "32FC1", "uyvy")]
    messages = [
        replace(message, topic=f"/robot{n}{message.topic}")
        for n, one in enumerate(scenes)
        for message in one.messages
        if message.topic.startswith("/cam")
    ]
    others = [m for m in islice(chain(scenes[0].messages), 60) if not m.topic.startswith("/cam")]
    recorded = Scene(sorted(messages + others, key=lambda message: message.log_time))
    done = journey(tmp_path, SOURCES[source], recorded, own_target(source), jobs=2)
    cameras = {message.topic for message in messages if message.msgtype in PICTURES}
    assert len(cameras) == len(scenes)
    for topic in cameras:
        assert done.frames(topic) == (10, 10)
    with mp4ds.open(done.dataset) as dataset:
        assert len(dataset.streams) == len(scenes)
        assert all(stream.sidecar.camera_info for stream in dataset.streams)
