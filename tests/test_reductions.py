"""Fewer images: ``unpack --every`` and ``--max-rate``."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mp4ds
from coded_scenes import CODED, MakeScene
from commands import call
from definitions import IMAGE, INFO
from mp4ds.errors import FormatError
from mp4ds.format.sidecars import MANIFEST_NAME
from mp4ds.packing.options import PackOptions
from mp4ds.unpacking.unpack import UnpackOptions
from republished import CAMERAS, Read, file_picture, image_of, psnr, read
from scenes import Scene, scene
from test_republish import Packed

TOPIC = "/cam/image_raw"
RAW = [
    *("mono8", "8UC1", "rgb8", "bgr8", "rgba8", "bgra8", "8UC3", "mono16", "16UC1", "rgb16"),
    *("bayer_rggb8", "bayer_grbg16", "yuv422", "nv21", "8SC1", "32FC1", "64FC1"),
]
SCENES: dict[str, MakeScene | Callable[[], Scene]] = {
    **{f"raw-{name}": partial(scene, name) for name in RAW},
    "raw-padded": partial(scene, "mono8", pad=5),
    "raw-big-endian": partial(scene, "mono16", big_endian=True),
    **CODED,
}


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Packed]]:
    """Packs a scene once: its name, and that of the source."""
    found: dict[tuple[str, str], Packed] = {}

    def pack(name: str, source: str = "mcap-ros2-zstd") -> Packed:
        if (name, source) not in found:
            folder = tmp_path_factory.mktemp("packed")
            found[name, source] = Packed(folder, SCENES[name](), source)
        return found[name, source]

    yield pack
    found.clear()


def rows(messages: Iterable[Read]) -> list[tuple[Any, ...]]:
    """All of the messages, to be compared."""
    return [
        (m.topic, m.type_name, m.log_time, m.publish_time, m.sequence, m.payload, m.metadata)
        for m in messages
    ]


def frames_of(made: Packed) -> list[mp4ds.Frame]:
    """What the library gives for the frames."""
    with mp4ds.open(made.folder / "dataset") as dataset:
        return list(dataset[made.topic])


# ---------------------------------------------------------------- fewer


AS_RECORDED = ["raw-mono8", "raw-padded", "jpeg-rgb", "png-rgba-cv2", "depth-32FC1-rvl"]


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", [*AS_RECORDED, "ffmpeg-mjpeg-yuvj420p-bgr8-bgr8"])
@pytest.mark.parametrize("every", [2, 3, 100])
def test_fewer_messages_are_as_recorded(
    packed: Callable[..., Packed], name: str, every: int
) -> None:
    made = packed(name)
    plain = made.unpack("mcap", None)[1]
    summary, less = made.unpack("mcap", None, every=every)
    stamps = {record.values["header"]["stamp"] for record in made.cameras[::every]}
    paired = [m for m in plain if m.type_name in (*CAMERAS, INFO) and m.stamp not in stamps]
    left_out = {id(message) for message in paired}
    assert rows(less) == rows(message for message in plain if id(message) not in left_out)
    assert summary.thinned == Counter(message.topic for message in paired)
    assert summary.as_recorded == {}
    assert summary.republished == {}


@pytest.mark.parametrize(("rate", "kept"), [(1000.0, 8), (30.0, 8), (15.0, 4), (10.0, 3), (0.1, 1)])
def test_a_rate(packed: Callable[..., Packed], rate: float, kept: int) -> None:
    """Of a camera of 30 Hz whose stamps jitter."""
    made = packed("raw-mono8")
    summary, messages = made.unpack("mcap", None, max_rate=rate)
    found = [message for message in messages if message.type_name == IMAGE]
    assert len(found) == kept
    assert [m.type_name for m in messages].count(INFO) == kept
    assert summary.thinned == ({TOPIC: 8 - kept, "/cam/camera_info": 8 - kept} if kept < 8 else {})


@pytest.mark.parametrize("name", ["video-h264", "ffmpeg-libx264"])
def test_packets_that_refer_to_others_stay(packed: Callable[..., Packed], name: str) -> None:
    made = packed(name)
    summary, messages = made.unpack("mcap", None, every=2)
    assert rows(messages) == rows(made.unpack("mcap", None)[1])
    reason = "video packets depend on each other, so none can be left out; use another form"
    assert summary.as_recorded == {made.topic: {reason: len(made.cameras)}}
    assert summary.thinned == {}
    summary, messages = made.unpack("mcap", "raw", every=2)
    found = [message for message in messages if message.type_name == IMAGE]
    assert len(found) == len(made.cameras) / 2
    for message, frame in zip(found, frames_of(made)[::2], strict=True):
        assert np.array_equal(image_of(message), frame.data)


def test_damage_is_found(tmp_path: Path) -> None:
    """The whole video is compared with its hash where messages have no digests; all are counted."""
    options = PackOptions(quality="visual")
    made = Packed(tmp_path, scene("rgb8"), "mcap-ros2-zstd", options)
    video = next((tmp_path / "dataset").glob("*.mp4"))
    whole = video.read_bytes()
    video.write_bytes(whole + b"\0\0\0\x08free")
    with pytest.raises(FormatError) as caught:
        made.unpack("mcap", None, every=2)
    assert caught.value.code == "hash-mismatch"
    video.write_bytes(whole)
    manifest = tmp_path / "dataset" / MANIFEST_NAME
    text = manifest.read_text("utf-8")
    with mp4ds.open(tmp_path / "dataset") as dataset:
        assert dataset.manifest is not None
        count = dataset.manifest.messages
    assert f"messages: {count}\n" in text
    changed = text.replace(f"messages: {count}\n", f"messages: {count + 1}\n")
    manifest.write_text(changed.partition("checksum:")[0], "utf-8")
    with pytest.raises(FormatError) as caught:
        made.unpack("mcap", None, every=2)
    assert caught.value.code == "message-count"


# ---------------------------------------------------------------- image files


@pytest.mark.parametrize("image_format", ["png", "jpeg"])
@pytest.mark.parametrize("name", ["raw-rgb8", "raw-mono8", "jpeg-rgb", "video-h264"])
def test_folders_of_images(
    packed: Callable[..., Packed], name: str, image_format: str, tmp_path: Path
) -> None:
    made = packed(name)
    options = UnpackOptions(image_format=image_format, every=3, force=True)
    summary = mp4ds.unpack(made.folder / "dataset", "images", tmp_path / "out", options)
    numbers = list(range(0, len(made.cameras), 3))
    assert summary.messages == {made.topic: len(numbers)}
    assert summary.thinned == {made.topic: len(made.cameras) - len(numbers)}
    (folder,) = (tmp_path / "out").iterdir()
    with (folder / "stamps.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["file"].partition(".")[0]) for row in rows] == numbers
    frames = frames_of(made)
    for row, number in zip(rows, numbers, strict=True):
        assert int(row["stamp_ns"]) == frames[number].stamp_ns
        image = file_picture((folder / row["file"]).read_bytes())
        if image_format == "png":
            assert np.array_equal(image, frames[number].data)
        else:
            assert psnr(image, frames[number].data) > 30


# ---------------------------------------------------------------- rates


def camera(rate: float, frames: int = 600, jitter: int = 0, seed: int = 0) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    times = 10**18 + np.round(np.arange(frames) * 1e9 / rate).astype(np.int64)
    return times + rng.integers(-jitter, jitter + 1, frames)


# ---------------------------------------------------------------- options


def test_the_command_line(packed: Callable[..., Packed], tmp_path: Path) -> None:
    dataset = packed("raw-mono8").folder / "dataset"
    command = ["unpack", dataset, "--to", "mcap"]
    command += ["--every", "2", "--max-rate", "1000"]
    output = tmp_path / "a.mcap"
    done = call(*command, "-o", output)
    assert f"{TOPIC}: 4 messages left out" in done.out.splitlines(), done.err
    assert [message.type_name for message in read(output)].count(IMAGE) == 4
    done = call(*command, "-o", tmp_path / "b.mcap", "--json")
    assert json.loads(done.out)["thinned"] == {TOPIC: 4, "/cam/camera_info": 4}
