"""Smaller and fewer images in a dataset: ``pack --resize``, ``--crop``, ``--every`` ..."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mp4ds
from coded_scenes import CODED
from commands import call
from definitions import COMPRESSED, IMAGE, INFO
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from mp4ds.format.manifest import Manifest
from mp4ds.format.sidecars import load_manifest
from mp4ds.packing.options import PackOptions
from mp4ds.packing.planning import open_recording
from mp4ds.plugins.info import info
from mp4ds.records import Message
from mp4ds.times import at_most
from republished import psnr
from scenes import Scene, scene
from sources import SOURCES, write_bag

RAW = (
    "mono8",
    "8UC1",
    "rgb8",
    "bgra8",
    "mono16",
    "16UC1",
    "rgb16",
    "bayer_grbg8",
    "yuv422",
    "32FC1",
)
SCENES: dict[str, Callable[[], Scene]] = {
    **{name: partial(scene, name, noisy=False) for name in RAW},
    "padded": partial(scene, "mono8", pad=5),
    "big-endian": partial(scene, "mono16", big_endian=True),
    **{
        name: CODED[name]
        for name in (
            *("jpeg-rgb", "jpeg-gray", "png-rgba-cv2", "png-palette"),
            *("depth-16UC1-png", "depth-32FC1-rvl", "video-h264", "video-av1", "ffmpeg-libx265"),
        )
    },
}


def manifest(dataset: Path) -> Manifest:
    return load_manifest(dataset / "dataset.yaml")


def messages(dataset: Path) -> list[Message]:
    with open_recording([dataset]) as reader:
        return [one for one in reader.records() if isinstance(one, Message)]


def rows(dataset: Path) -> list[tuple[Any, ...]]:
    """All messages, to be compared."""
    found = [
        (one.channel.topic, one.log_time, one.channel.type_name, bytes(one.data))
        for one in messages(dataset)
    ]
    return sorted(found)


def others(dataset: Path, *left_out: str) -> list[tuple[Any, ...]]:
    return [row for row in rows(dataset) if row[0] not in left_out and "Info" not in row[2]]


@pytest.mark.one_in(8)
@pytest.mark.parametrize("name", SCENES)
def test_what_becomes_of_images(name: str, tmp_path: Path) -> None:
    sources = SOURCES["mcap-ros2-zstd"](tmp_path, SCENES[name]())
    mp4ds.pack(sources, tmp_path / "whole")
    options = PackOptions(crop=(8, 4, 48, 40), resize=(30, 22))
    mp4ds.pack(sources, tmp_path / "small", options)
    mp4ds.pack(tmp_path / "whole", tmp_path / "again", options)
    assert rows(tmp_path / "small") == rows(tmp_path / "again")
    assert mp4ds.validate(tmp_path / "small", deep=True) == []
    whole = mp4ds.open(tmp_path / "whole", layer="exact")
    small = mp4ds.open(tmp_path / "small", layer="exact")
    with whole, small:
        (topic,) = (name for name in small.all_topics if name in small)
        assert [name for name in whole.all_topics if name in whole] == [topic]
        before, after = whole[topic], small[topic]
        assert others(tmp_path / "small", topic) == others(tmp_path / "whole", topic)
        assert (after.stamps == before.stamps).all()
        form = "native"
        if before.encoding != after.encoding:
            form = "depth_m" if after.encoding == "32FC1" else "rgb"
        numbers = range(len(before))
        due = before.get(numbers, crop=(8, 4, 48, 40), resize=(30, 22), format=form)
        for frame, wanted in zip(after.get(numbers), due, strict=True):
            assert frame.data.shape == wanted.data.shape
            if small.streams:
                assert frame.intrinsics == wanted.intrinsics
            assert frame.frame_id == wanted.frame_id
            if frame.data.shape[2:] == (3,) and frame.data.dtype == np.uint8:
                assert psnr(frame.data, wanted.data) > 35
            else:
                np.testing.assert_array_equal(frame.data, wanted.data)
        (told,) = manifest(tmp_path / "small").reductions
        (original,) = told.images
        assert (told.crop, told.size) == ([8, 4, 48, 40], [30, 22])
        assert (original.topic, original.width, original.height) == (topic, *before.image_size)


# ---------------------------------------------------------------- fewer, and in parts

TOPIC, INFO_TOPIC = "/cam/image_raw", "/cam/camera_info"


@pytest.mark.parametrize("name", ["mono8", "jpeg-cut-one"])
def test_in_parts(name: str, tmp_path: Path) -> None:
    made = CODED[name](frames=30) if name in CODED else scene(name, frames=30)
    sources = SOURCES["mcap-ros2-zstd"](tmp_path, made)
    options = PackOptions(resize=0.5, every=3)
    mp4ds.pack(sources, tmp_path / "whole", options)
    summary = mp4ds.pack(sources, tmp_path / "parts", replace(options, window=4))
    assert rows(tmp_path / "parts") == rows(tmp_path / "whole")
    assert mp4ds.validate(tmp_path / "parts", deep=True) == []
    assert manifest(tmp_path / "parts").reductions == manifest(tmp_path / "whole").reductions
    mp4ds.pack(sources, tmp_path / "all")
    with mp4ds.open(tmp_path / "all") as whole:
        (topic,) = whole.topics
    before, after = (
        [row for row in rows(tmp_path / folder) if row[0] == topic] for folder in ("all", "parts")
    )
    assert [row[1] for row in after] == [row[1] for row in before][::3]
    assert {row[2] for row in after} == ({IMAGE, COMPRESSED} if name in CODED else {IMAGE})
    (camera,) = (one for one in summary.topics if one.topic == topic)
    assert camera.messages == 10


@pytest.mark.parametrize("name", ["video-h264", "video-h264-mid-gop", "video-av1-lost"])
def test_packets_of_which_some_are_left_out(name: str, tmp_path: Path) -> None:
    sources = SOURCES["mcap-ros2-zstd"](tmp_path, CODED[name]())
    mp4ds.pack(sources, tmp_path / "all")
    mp4ds.pack(sources, tmp_path / "half", PackOptions(every=2))
    with mp4ds.open(tmp_path / "all") as whole:
        (topic,) = whole.topics
    before = [row for row in rows(tmp_path / "all") if row[0] == topic]
    after = [row for row in rows(tmp_path / "half") if row[0] == topic]
    assert [row[1] for row in after] == [row[1] for row in before][::2]
    kinds = [row[2] for row in after]
    assert kinds.count(IMAGE) >= len(kinds) - 3
    if name == "video-h264":
        assert set(kinds) == {IMAGE}
    for row, recorded in zip(after, before[::2], strict=True):
        assert row[2] == IMAGE or row == recorded


def test_a_slice_that_does_not_begin_with_a_key_frame(tmp_path: Path) -> None:
    sources = SOURCES["mcap-ros2-zstd"](tmp_path, CODED["video-h264"]())
    mp4ds.pack(sources, tmp_path / "all")
    small = PackOptions(resize=0.5)
    mp4ds.pack(sources, tmp_path / "small", small)
    with mp4ds.open(tmp_path / "small") as dataset:
        (topic,) = dataset.topics
    due = [row for row in rows(tmp_path / "small") if row[0] == topic]
    assert {row[2] for row in due} == {IMAGE}
    start = due[2][1]
    for number, source in enumerate((sources, tmp_path / "all")):
        part = tmp_path / f"part{number}"
        mp4ds.pack(source, part, replace(small, start=str(start)))
        assert [row for row in rows(part) if row[0] == topic] == due[2:]


@pytest.mark.parametrize("stamp", [None, 0, 7])
def test_a_maximum_rate_goes_by_stamps(stamp: int | None, tmp_path: Path) -> None:
    """By log times where all stamps are the same."""
    made = scene("mono8", frames=30)
    if stamp is not None:
        head = {"stamp": stamp, "frame_id": "cam"}
        made.messages[:] = [
            replace(one, values={**one.values, "header": head}) if one.topic == TOPIC else one
            for one in made.messages
        ]
    sources = SOURCES["bag-lz4"](tmp_path, made)
    mp4ds.pack(sources, tmp_path / "all")
    mp4ds.pack(tmp_path / "all", tmp_path / "slow", PackOptions(max_rate=10))
    with mp4ds.open(tmp_path / "all") as before, mp4ds.open(tmp_path / "slow") as after:
        times = before[TOPIC].stamps if stamp is None else before[TOPIC].log_times
        kept = before[TOPIC].log_times[at_most(10, times)]
        if stamp == 7:  # the first is by its stamp: one more, as the clock changes after it
            assert len(after[TOPIC]) == len(kept) + 1
        else:
            assert after[TOPIC].log_times.tolist() == kept.tolist()
        assert after[TOPIC].shape == before[TOPIC].shape
    assert others(tmp_path / "slow", TOPIC) == others(tmp_path / "all", TOPIC)


# ---------------------------------------------------------------- what it is read from


@pytest.mark.parametrize("name", ["raw-bgr8", "jpeg-rgb"])
def test_foxglove_in_protobuf_becomes_ros(name: str, tmp_path: Path) -> None:
    sources = FOXGLOVE_SOURCES["mcap-protobuf"](tmp_path, FOXGLOVE[name]())
    mp4ds.pack(sources, tmp_path / "whole")
    mp4ds.pack(sources, tmp_path / "small", PackOptions(resize=0.5))
    with mp4ds.open(tmp_path / "whole") as whole, mp4ds.open(tmp_path / "small") as small:
        (topic,) = small.topics
        before, after = whole[topic].get([0], resize=0.5)[0], small[topic].get([0])[0]
        assert after.intrinsics == before.intrinsics
        assert psnr(after.data, before.data) > 30
    types = {row[0]: row[2] for row in rows(tmp_path / "small")}
    assert types[topic] == IMAGE
    assert types["/camera/calibration"] == INFO


# ---------------------------------------------------------------- what is told


def test_what_was_done_is_told(tmp_path: Path) -> None:
    write_bag(tmp_path / "drive.bag", scene("mono8"))
    mp4ds.pack(tmp_path / "drive.bag", tmp_path / "half", PackOptions(resize=0.5, every=2))
    mp4ds.pack(tmp_path / "half", tmp_path / "copy")
    mp4ds.pack(tmp_path / "copy", tmp_path / "tiny", PackOptions(crop=(4, 2, 20, 10)))
    told = manifest(tmp_path / "tiny")
    first, second = told.reductions
    assert manifest(tmp_path / "copy").reductions == [first]
    assert (first.factor, first.every, second.crop) == (0.5, 2, [4, 2, 20, 10])
    assert [item.name for item in told.derived_from] == ["half", "copy"]
    text = (
        "images were reduced before they were packed: resized by 0.5, one image in 2; then "
        "cropped to 20x10 at [4, 2]"
    )
    assert text in info(tmp_path / "tiny").notes
    assert text in call("validate", tmp_path / "tiny").out
    assert text in mp4ds.unpack(tmp_path / "tiny", "bag").notes
    alone = mp4ds.pack(
        tmp_path / "drive.bag", tmp_path / "alone", PackOptions(resize=0.5, exclude=[TOPIC])
    )
    (calibrations,) = (one for one in alone.topics if one.topic == INFO_TOPIC)
    assert calibrations.notes == []  # no images were resized


@pytest.mark.parametrize(
    "options",
    [{"every": True}, {"every": 1.5}, {"max_rate": True}, {"resize": True}, {"resize": (True, 2)}],
)
def test_what_is_no_number(options: dict[str, Any]) -> None:
    with pytest.raises(mp4ds.OptionError, match=f"^`{next(iter(options))}` .* is not a "):
        PackOptions(**options)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (
            ["--crop", "0,0,65,10"],
            r"crop \(0, 0, 65, 10\) is not inside the 64x48 images",
        ),
        (["--crop", "0,0,9"], "--crop '0,0,9' is not X,Y,W,H in pixels"),
        (["--nearest", "/cam/*"], "--nearest says how images are resized: give --resize, too"),
        (
            ["--resize", "0.5", "--nearest", "/mask"],
            "--nearest '/mask' matches no topic of images. Topics of images: /cam/image_raw",
        ),
        (["--every", "0"], "--every 0 is below 1"),
        (["--resize", "0.5", "--for", "training", "--gop", "2"], "Give --for or --gop, not both"),
    ],
)
def test_what_cannot_be_done(options: list[str], problem: str, tmp_path: Path) -> None:
    write_bag(tmp_path / "drive.bag", scene("mono8", frames=2))
    found = call("pack", tmp_path / "drive.bag", "-o", tmp_path / "small", *options)
    assert found.code == 2
    assert re.search(problem, " ".join(found.err.split()))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.bag"]
