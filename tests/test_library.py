"""``mp4ds.open``: frames by number, their times and calibrations, and pairs on their own."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

import mp4ds
from coded_scenes import CODED
from definitions import PICTURES
from mp4ds.unpacking.unpack import UnpackOptions
from pictures import CAREFUL
from round_trips import packed
from sources import (
    INFO,
    PERIOD,
    START,
    Scene,
    odd_scene,
    scene,
    write_bag,
    write_mcap,
)

TOPIC = "/cam/image_raw"


def images(source: Scene, topic: str = TOPIC) -> list[Any]:
    return [message for message in source.messages if message.topic == topic]


def expected_pixels(values: Any) -> np.ndarray[Any, Any]:
    """What numpy sees in an image message, in native byte order."""
    encoding, height, width = values["encoding"], values["height"], values["width"]
    rows = np.asarray(values["data"], np.uint8).reshape(height, values["step"])
    if encoding in ("mono16", "16UC1"):
        dtype = np.dtype(">u2" if values["is_bigendian"] else "<u2")
        pixels = np.ascontiguousarray(rows[:, : 2 * width]).view(dtype)
        return pixels.astype(np.uint16)
    if encoding in ("rgb8", "bgr8"):
        return rows[:, : 3 * width].reshape(height, width, 3)
    return rows[:, :width]


@pytest.fixture(scope="module")
def colour(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    """A dataset of rgb8 images, not to be changed, and what was recorded."""
    source = scene("rgb8", frames=12)
    return packed(tmp_path_factory.mktemp("colour"), source, gop=5), source


# ---------------------------------------------------------------- frames of coded messages


def camera(source: Scene) -> list[Any]:
    return [message for message in source.messages if message.msgtype in PICTURES]


def as_rgb(frame: av.VideoFrame) -> np.ndarray[Any, Any]:
    """Converted with care; by default, PyAV takes the nearest sample of chroma."""
    rgb = frame.reformat(format="rgb24", src_colorspace="itu601", interpolation=CAREFUL)
    return rgb.to_ndarray()


DECODERS = {"av1": "libdav1d", "h265": "hevc"}
PACKETS = [
    *("video-h264", "video-h264-slices", "video-h264-headers-once", "video-h264-mid-gop"),
    *("video-h265", "video-av1", "video-av1-no-delimiter", "ffmpeg-libx265"),
]


@pytest.mark.parametrize("name", PACKETS)
def test_frames_of_packets(name: str, tmp_path: Path) -> None:
    source = CODED[name](frames=12)
    codec = "h265" if "265" in name else name.split("-")[1]
    context: Any = av.CodecContext.create(DECODERS.get(codec, codec), "r")
    with mp4ds.open(packed(tmp_path, source)) as dataset:
        (stream,) = dataset
        recorded = camera(source)[-len(stream) :]
        decoded = [
            frame
            for message in recorded
            for frame in context.decode(av.Packet(bytes(message.values["data"])))
        ]
        decoded += context.decode(None)
        assert len(stream) == len(decoded) == (8 if "mid" in name else 12)
        frames = list(stream)
        for frame, expected, message in zip(frames, decoded, recorded, strict=True):
            values = message.values
            stamp = values["header"]["stamp"] if "header" in values else values["timestamp"]
            assert frame.stamp_ns == stamp
            assert np.abs(frame.data.astype(int) - as_rgb(expected)).max() <= 1
        for number in (9, 0, 5, 4, 7, 1, -1):
            number %= len(stream)
            assert np.array_equal(stream[number].data, frames[number].data)


# ---------------------------------------------------------------- opening


@pytest.mark.parametrize(
    "place",
    [".", "dataset.yaml", "cam_image_raw.mp4", "cam_image_raw.yaml"],
)
@pytest.mark.parametrize("kind", [str, Path, os.path.relpath])
def test_all_that_can_be_opened(
    place: str, kind: Callable[[Path], Any], colour: tuple[Path, Scene]
) -> None:
    recorded = images(colour[1])
    with mp4ds.open(kind(colour[0] / place)) as dataset:
        assert isinstance(dataset, mp4ds.Dataset)
        assert dataset.topics == [TOPIC]
        assert [type(stream) for stream in dataset.streams] == [mp4ds.Stream]
        assert type(dataset[TOPIC]) is mp4ds.Topic
        assert isinstance(dataset[TOPIC][0], mp4ds.Frame)
        topic = dataset["cam_image_raw"]
        assert topic is dataset[TOPIC]
        assert topic.topic == TOPIC
        assert topic.stamps.dtype == np.int64
        assert topic.stamps.tolist() == [m.values["header"]["stamp"] for m in recorded]
        assert topic.log_times.tolist() == [m.log_time for m in recorded]
        assert topic.streams[0].path.samefile(colour[0] / "cam_image_raw.yaml")


@pytest.mark.parametrize("topic", ["/imu", "/cam", "", "cam/image_raw", "/cam/camera_info"])
def test_a_wrong_topic_lists_the_right_ones(topic: str, colour: tuple[Path, Scene]) -> None:
    with mp4ds.open(colour[0]) as dataset, pytest.raises(KeyError, match="there are: /cam/image_r"):
        dataset[topic]


def test_what_cannot_be_opened(tmp_path: Path, colour: tuple[Path, Scene]) -> None:
    with pytest.raises(mp4ds.SourceNotFoundError) as missing:
        mp4ds.open(tmp_path / "none")
    assert isinstance(missing.value, FileNotFoundError)
    with pytest.raises(mp4ds.SourceError, match="is not a dataset"):
        mp4ds.open(tmp_path)
    video = tmp_path / "clip.MKV"
    video.write_bytes(bytes(99))
    with pytest.raises(mp4ds.SourceError, match=r"is a video, not a dataset.*\.mp4 or \.mov"):
        mp4ds.open(video)
    with pytest.raises(mp4ds.SourceError, match=r"is a video, not a recording. Give a ROS 1"):
        mp4ds.pack(video, tmp_path / "packed")
    shutil.copy(colour[0] / "cam_image_raw.mp4", tmp_path / "alone.mp4")
    with pytest.raises(mp4ds.FormatError, match=r"without its sidecar, alone\.yaml"):
        mp4ds.Dataset(tmp_path / "alone.mp4")
    (tmp_path / "drive.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(range(256)))
    with pytest.raises(mp4ds.Mp4dsError):
        mp4ds.open(tmp_path / "drive.bag")


# ---------------------------------------------------------------- closing


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_closing_closes_all_files(colour: tuple[Path, Scene]) -> None:
    def open_files() -> list[str]:
        folder = "/proc/self/fd"
        links = (os.path.realpath(f"{folder}/{name}") for name in os.listdir(folder))  # noqa: PTH208
        return [link for link in links if link.startswith(str(colour[0]))]

    assert open_files() == []
    dataset = mp4ds.open(colour[0])
    stream = dataset[TOPIC]
    assert stream[3].index == 3
    assert open_files() == [str(path) for path, _ in stream.streams[0].videos]
    iterator = iter(stream)
    next(iterator)
    iterator.close()  # type: ignore[attr-defined]
    assert len(open_files()) == len(stream.streams[0].videos)
    dataset.close()
    assert open_files() == []
    assert len(stream.stamps) == 12  # they are still known, and the video is opened once more
    assert stream[3].index == 3
    dataset.close()
    assert open_files() == []


# ---------------------------------------------------------------- calibrations


def recalibrated(first_new: int, *, frames: int = 8, delay: int = 90_000) -> Scene:
    """A camera whose calibration changes with its message of that number, twice.

    Each is logged `delay` nanoseconds after its image.
    """
    source = scene("mono8", frames=frames)
    number = 0
    for place, message in enumerate(source.messages):
        if message.msgtype != INFO:
            continue
        if first_new <= number < frames - 2:
            new = {"k": [70.0, 0, 30, 0, 70, 20, 0, 0, 1], "distortion_model": "equidistant"}
            message = replace(message, values={**message.values, **new})
        source.messages[place] = replace(message, log_time=message.log_time - 90_000 + delay)
        number += 1
    source.messages.sort(key=lambda message: message.log_time)
    return source


@pytest.mark.one_in(4)
@pytest.mark.parametrize("first_new", [0, 3, 5])
@pytest.mark.parametrize("delay", [90_000, 0, -1, 40_000_000])
@pytest.mark.parametrize("variant", ["bag-none", "mcap-ros2-lz4"])
def test_the_calibration_that_held(
    first_new: int, delay: int, variant: str, tmp_path: Path
) -> None:
    source = recalibrated(first_new, delay=delay)
    infos = images(source, "/cam/camera_info")
    with mp4ds.open(packed(tmp_path, source, variant)) as dataset:
        stream = dataset[TOPIC]
        models = [info.values["distortion_model"] for info in infos]
        assert [c.distortion_model for c in stream.calibrations] == list(dict.fromkeys(models))
        for number, message in enumerate(images(source)):
            earlier = [info for info in infos if info.log_time <= message.log_time] or infos[:1]
            calibration = stream.intrinsics_at(number)
            assert calibration is not None
            assert calibration.distortion_model == earlier[-1].values["distortion_model"]
            assert calibration.k == [float(value) for value in earlier[-1].values["k"]]
            assert stream[number].intrinsics is calibration


# ---------------------------------------------------------------- several geometries


@pytest.mark.parametrize("variant", ["bag-none", "mcap-ros2-none"])
def test_a_topic_that_changes_its_size(variant: str, tmp_path: Path) -> None:
    with mp4ds.open(packed(tmp_path, odd_scene("size-change"), variant)) as dataset:
        assert dataset.topics == ["/odd/image"]
        assert len(dataset.streams) == 2
        large, small = dataset["odd_image"], dataset["odd_image-2"]
        assert [len(large), len(small)] == [4, 4]
        assert large[0].data.shape == (24, 32)
        assert small[0].data.shape == (12, 32)
        assert large.topic == small.topic == "/odd/image"
        assert max(large.stamps) < min(small.stamps)

        whole = dataset["/odd/image"]
        assert isinstance(whole, mp4ds.Topic)
        assert whole is dataset["/odd/image"]
        assert whole.encoding == "mono8", "all have it in common"
        for name in ("image_size", "shape"):
            with pytest.raises(mp4ds.OptionError, match=r"32x24 mono8, 32x12 mono8.*odd_image-2"):
                getattr(whole, name)
        with pytest.raises(mp4ds.OptionError, match=r"resize=\(width, height\)"):
            whole.read([0, 1])
        with pytest.raises(mp4ds.OptionError, match="changes its size"):
            whole.read([0, 5], resize=0.5)
        with pytest.raises(mp4ds.OptionError, match="32x12 images of /odd/image"):
            whole.get([6], crop=(0, 0, 32, 24))
        halves = whole.get([0, 7], resize=0.5)
        assert [frame.data.shape for frame in halves] == [(12, 16), (6, 16)]
        assert [frame.data.shape for frame in whole.get([0], crop=(0, 0, 32, 24))] == [(24, 32)]

        out = np.empty((3, 6, 8, 3), np.uint8)
        assert whole.read([7, 0, 7], resize=(8, 6), out=out) is out
        expected = [small.read([3], resize=(8, 6))[0], large.read([0], resize=(8, 6))[0]]
        assert np.array_equal(out, [expected[0], expected[1], expected[0]])


@pytest.mark.parametrize("publishers", [1, 2])
def test_frames_of_a_topic_that_changes_come_as_recorded(publishers: int, tmp_path: Path) -> None:
    """In all ways of asking; of one publisher where the times do not tell the order."""
    messages = [
        replace(record, publisher=number // 2 % publishers)
        if publishers > 1
        else replace(record, log_time=START)
        for number, record in enumerate(odd_scene("encoding-change").messages)
    ]
    recorded = [record.ros1 or b"" for record in messages if record.topic == "/odd/image"]
    encodings = ["bayer_rggb8" if number % 3 == 2 else "mono8" for number in range(8)]
    with mp4ds.open(packed(tmp_path, Scene(messages))) as dataset:
        found = {stream.encoding: 0 for stream in dataset.streams}
        for stream in dataset.streams:
            found[stream.encoding] += len(stream)
        assert found == {"mono8": 6, "bayer_rggb8": 2}
        whole = dataset["/odd/image"]
        stamps = [START + number * PERIOD for number in range(8)]
        assert whole.stamps.tolist() == stamps
        every = list(whole)
        for frame, payload in zip(every, recorded, strict=True):
            assert payload.endswith(frame.data.tobytes())
        assert [frame.encoding for frame in every] == encodings
        assert [frame.index for frame in every] == list(range(8))

        asked = [5, 0, -1, 5, 2]
        for frame, number in zip(whole.get(asked), asked, strict=True):
            assert (frame.index, frame.stamp_ns) == (number % 8, stamps[number])
            assert np.array_equal(frame.data, every[number].data)
        some = list(whole.between(stamps[1], stamps[6], format="gray"))
        assert [frame.stamp_ns for frame in some] == stamps[1:6]
        assert {frame.encoding for frame in some} == {"mono8"}
        assert whole.at(stamps[2] + 1).index == 2
        assert [frame.frame_id for frame in every] == [whole[n].frame_id for n in range(8)]

        assert (whole.image_size, len(whole)) == ((32, 24), 8)
        grey = whole.read(range(8), format="gray")
        assert all(np.array_equal(grey[n], every[n].data) for n in (0, 1, 3, 4, 6, 7))
        for ask in (lambda: whole.encoding, lambda: whole.read([0], format="native")):
            with pytest.raises(mp4ds.OptionError, match="mono8, 32x24 bayer_rggb8"):
                ask()


# ---------------------------------------------------------------- pairs on their own


def payloads(path: Path, topics: set[str]) -> list[tuple[str, int, bytes]]:
    """What a recording holds on some topics, read by rosbags."""
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic in topics]
        return sorted(
            (connection.topic, time, bytes(raw))
            for connection, time, raw in reader.messages(connections)
        )


@pytest.mark.parametrize("encoding", ["bayer_gbrg8", "rgb8", "mono16"])
def test_a_pair_alone(encoding: str, tmp_path: Path) -> None:
    source = scene(encoding)
    dataset = packed(tmp_path, source)
    alone = tmp_path / "a mail"
    alone.mkdir()
    for path in dataset.glob("cam_image_raw.*"):
        shutil.copy(path, alone)
    video, sidecar = alone / "cam_image_raw.mp4", alone / "cam_image_raw.yaml"
    for path in (video, sidecar, str(video)):
        assert mp4ds.validate(path, deep=True) == []
    with mp4ds.open(video) as pair:
        assert pair.manifest is None
        assert pair.topics == [TOPIC]
        assert pair.profile == "ros1"
        for frame, message in zip(pair[TOPIC], images(source), strict=True):
            assert np.array_equal(frame.data, expected_pixels(message.values))
    summary = mp4ds.unpack(sidecar, "bag", tmp_path / "again.bag")
    assert summary.messages == {TOPIC: 8, "/cam/camera_info": 8}
    topics = {TOPIC, "/cam/camera_info"}
    again = payloads(tmp_path / "again.bag", topics)
    assert len(again) == 16
    assert again == payloads(tmp_path / "source" / "drive.bag", topics)
    part = mp4ds.unpack(video, "bag", tmp_path / "part.bag", UnpackOptions(start=0.1))
    assert 0 < part.messages[TOPIC] < 8
    assert set(payloads(part.output, topics)) < set(again)
    assert mp4ds.export(video, "images", tmp_path / "images").messages == {TOPIC: 8}
    assert mp4ds.unpack(video).output == alone / "cam_image_raw_unpacked.mcap"
    own = mp4ds.unpack(dataset).output
    assert own == dataset.with_name(f"{dataset.name}_unpacked.bag")
    assert payloads(own, topics) == again


def test_a_pair_without_its_video(tmp_path: Path, colour: tuple[Path, Scene]) -> None:
    shutil.copy(colour[0] / "cam_image_raw.yaml", tmp_path)
    problems = mp4ds.validate(tmp_path / "cam_image_raw.yaml")
    assert [problem.code for problem in problems] == ["file-missing"]
    with mp4ds.open(tmp_path / "cam_image_raw.yaml") as pair:
        assert len(pair[TOPIC]) == 12
        with pytest.raises(mp4ds.FormatError, match=r"cam_image_raw\.mp4"):
            pair[TOPIC][0]


@pytest.mark.parametrize("kind", [str, Path])
def test_strings_and_paths_for_everything(kind: Callable[[Path], Any], tmp_path: Path) -> None:
    write_bag(tmp_path / "drive.bag", scene("mono8"))
    summary = mp4ds.pack(kind(tmp_path / "drive.bag"), kind(tmp_path / "set"))
    assert summary.dataset == tmp_path / "set"
    assert mp4ds.validate(kind(tmp_path / "set")) == []
    assert mp4ds.unpack(kind(tmp_path / "set"), "bag").output == tmp_path / "set_unpacked.bag"
    write_mcap(tmp_path / "one.mcap", scene("mono8"))
    mp4ds.pack([kind(tmp_path / "one.mcap")], kind(tmp_path / "other"))
    assert mp4ds.validate(kind(tmp_path)) == []


@pytest.mark.parametrize(
    ("name", "magic"), [("a.mcap", b"\x89MCAP0"), ("a.bag", b"#ROSBAG"), ("a", b"#ROSBAG")]
)
def test_the_name_of_an_output_says_its_format(name: str, magic: bytes, tmp_path: Path) -> None:
    write_bag(tmp_path / "drive.bag", scene("mono8"))
    mp4ds.pack(tmp_path / "drive.bag", tmp_path / "set")
    mp4ds.unpack(tmp_path / "set", output=tmp_path / name)
    assert (tmp_path / name).read_bytes().startswith(magic)
