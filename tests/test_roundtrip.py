"""Recording -> dataset -> recording: every message equal, for every source, encoding and target.

The comparison is tools/compare.py, which reads with the public libraries and shares no code
with the package.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

import mp4ds
from coded_scenes import CODED
from compare import compare
from conftest import DATA, real
from definitions import PICTURES
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from mp4ds.bags.formats import open_reader
from mp4ds.records import Message
from round_trips import (
    TARGETS,
    journey,
    output_of,
    own_target,
    unpacked,
)
from scenes import Scene
from sources import SOURCES, TRAITS, odd_scene, scene


@pytest.mark.one_in(4)
@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("encoding", ["bayer_gbrg8", "mono16"])
def test_every_source_returns_to_its_own_format(source: str, encoding: str, tmp_path: Path) -> None:
    journey(tmp_path, SOURCES[source], scene(encoding), own_target(source))
    assert list((tmp_path / "dataset").glob("*.mp4"))


# ---------------------------------------------------------------- from any middleware to any

ROS_SOURCES = [
    *("bag-none", "rosbag2-sqlite3-v9", "rosbag2-mcap-v9", "mcap-ros1-zstd", "mcap-ros2-zstd"),
]
CAMERAS: dict[str, Callable[[], Scene]] = {
    "raw": lambda: scene("bgr8", pad=2),
    "yuv": lambda: scene("nv12"),
    **{
        name: CODED[name]
        for name in ("jpeg-rgb", "png-gray-cv2", "depth-32FC1-rvl", "video-h265", "ffmpeg-libx264")
    },
}
CROSSED = [
    pytest.param(camera, source, target, marks=[pytest.mark.slow] if (n + k + m) % 3 else [])
    for n, camera in enumerate(CAMERAS)
    for k, source in enumerate(ROS_SOURCES)
    for m, target in enumerate([*TARGETS][:4])
]


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("camera", "source", "target"), CROSSED)
def test_from_any_ros_to_any_other(camera: str, source: str, target: str, tmp_path: Path) -> None:
    recorded = CAMERAS[camera]()
    done = journey(tmp_path, SOURCES[source], recorded, target)
    cameras = {m.topic for m in recorded.messages if m.msgtype in PICTURES}
    assert {done.frames(topic) for topic in cameras} <= {(8, 8), (10, 10)}


FOXGLOVE_CAMERAS = ["raw-bgr8", "jpeg-rgb", "video-h264"]


@pytest.mark.parametrize("camera", FOXGLOVE_CAMERAS)
@pytest.mark.parametrize("target", [*TARGETS][:4])
def test_foxglove_messages_of_ros_go_to_any_other(camera: str, target: str, tmp_path: Path) -> None:
    write = FOXGLOVE_SOURCES["mcap-foxglove-ros2"]
    done = journey(tmp_path, write, FOXGLOVE[camera](), target)
    assert done.frames("/camera/image") == (10, 10)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("camera", [*FOXGLOVE_CAMERAS, "webp"])
@pytest.mark.parametrize("target", [*TARGETS][:3])
def test_what_no_ros_can_hold_is_refused(target: str, camera: str, tmp_path: Path) -> None:
    done = journey(tmp_path, FOXGLOVE_SOURCES["mcap-protobuf"], FOXGLOVE[camera](), "mcap")
    done.output.unlink()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(mp4ds.ConversionError) as caught:
        unpacked(tmp_path, target)
    assert caught.value.topic in FOXGLOVE_TOPICS
    for word in (f"topic {caught.value.topic}:", "protobuf", "`exclude`", "mcap"):
        assert word in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before
    # what it names all at once is all there is to leave out
    excluded = re.findall(r"`exclude` (\S+?)(?=[ ,])", str(caught.value))
    to, storage = TARGETS[target]
    output = output_of(tmp_path, target)
    options = mp4ds.UnpackOptions(storage=storage, exclude=excluded)
    assert not mp4ds.unpack(tmp_path / "dataset", to, output, options).unconvertible
    options = mp4ds.UnpackOptions(storage=storage, skip_unconvertible=True, force=True)
    skipped = mp4ds.unpack(tmp_path / "dataset", to, output, options).unconvertible
    assert set(skipped) == set(excluded)
    with mp4ds.open(tmp_path / "dataset") as dataset:
        due = Counter(
            message.channel.topic
            for message in dataset.records()
            if isinstance(message, Message) and message.channel.topic in excluded
        )
    assert {topic: sum(why.values()) for topic, why in skipped.items()} == {
        topic: due[topic] for topic in excluded
    }


FOXGLOVE_TOPICS = {"/camera/image", "/camera/calibration", "/tf", "/pose", "/log"}


@pytest.mark.parametrize("target", [*TARGETS][:3])
def test_what_ros_can_hold_of_the_rest(target: str, tmp_path: Path) -> None:
    """The remedy that the refusal names."""
    recorded = scene("rgb8")
    sources = SOURCES["mcap-none-profile"](tmp_path / "source", recorded)
    mp4ds.pack(sources, tmp_path / "dataset")
    to, storage = TARGETS[target]
    others = sorted({message.topic for message in recorded.messages} - {"/cam/image_raw"})
    options = mp4ds.UnpackOptions(storage=storage, exclude=[*others, "/diagnostics"])
    output = output_of(tmp_path, target)
    summary = mp4ds.unpack(tmp_path / "dataset", to, output, options)
    assert summary.messages == {"/cam/image_raw": 8}
    assert all("/cam/image_raw" not in line for line in compare(sources, output))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("trait", TRAITS)
@pytest.mark.parametrize("source", ["bag-none", "mcap-ros2-none"])
def test_odd_messages_return(trait: str, source: str, tmp_path: Path) -> None:
    journey(tmp_path, SOURCES[source], odd_scene(trait), own_target(source))


REAL = sorted(
    str(path.relative_to(DATA))
    for pattern in (
        "bags/**/*.bag",
        "mcap/*.mcap",
        "corrupt/sample_ok.*",
        "rosbag2/**/*.db3",
        "rosbag2/**/*.mcap",
        "mcap/conformance/**/*.mcap",
    )
    for path in DATA.glob(pattern)
)
REAL_FOLDERS = sorted(
    str(path.parent.relative_to(DATA)) for path in DATA.glob("rosbag2/**/metadata.yaml")
)


@pytest.mark.one_in(8)
@pytest.mark.parametrize("name", [*REAL, *REAL_FOLDERS] or ["bags"])
def test_real_recordings_return(name: str, tmp_path: Path) -> None:
    path = real(name)
    target = "rosbag2" if path.is_dir() or path.suffix == ".db3" else path.suffix[1:]
    mp4ds.pack(path, tmp_path / "dataset")
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    output = unpacked(tmp_path, target)
    assert compare(path, output) == []
    with open_reader(path) as before, open_reader(output) as after:
        # it does not compare them; an index may list a schema, but not the channel that uses it
        used = {channel.schema for channel in after.channels}
        assert set(before.unused_schemas) <= {*after.unused_schemas, *used}
