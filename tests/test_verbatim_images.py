"""Images that no video could hold: they are written, and read, in their place among the others."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import mp4ds
from coded_scenes import CODED
from definitions import COMPRESSED, IMAGE
from mp4ds import ExportOptions
from mp4ds.messages.depth import encode_rvl
from scenes import Record, Scene
from sources import SOURCES, scene

TOPIC = "/cam/image_raw"
FRAMES = 12


def packed(folder: Path, made: Scene, **options: Any) -> Path:
    paths = SOURCES["mcap-ros2-zstd"](folder / "source", made)
    mp4ds.pack(paths, folder / "dataset", mp4ds.PackOptions(**options))
    return folder / "dataset"


def mixed(encoding: str = "mono8", *, odd: tuple[int, ...] = (0, 4, 5, 11)) -> Scene:
    """A camera of whose images some have bytes after their rows, so that no video holds them."""
    made = scene(encoding, frames=FRAMES)
    places = [n for n, item in enumerate(made.messages) if item.topic == TOPIC]
    for number in odd:
        item = made.messages[places[number]]
        data = np.concatenate([item.values["data"], np.arange(7, dtype=np.uint8)])
        made.messages[places[number]] = replace(item, values={**item.values, "data": data})
    return made


def pictures(made: Scene) -> list[NDArray[np.uint8]]:
    """The pixels of a scene's grey images."""
    images = [item.values for item in made.messages if item.topic == TOPIC]
    return [
        np.asarray(item["data"])[: item["height"] * item["width"]].reshape(item["height"], -1)
        for item in images
    ]


def rows_of(folder: Path) -> list[list[str]]:
    with (folder / "stamps.csv").open(newline="") as file:
        return [*csv.reader(file)][1:]


# ---------------------------------------------------------------- as files


def test_all_images_are_written(tmp_path: Path) -> None:
    made = mixed()
    dataset = packed(tmp_path, made)
    together = ExportOptions(tolerance_ns=0)  # a single camera, wherever its images are
    summary = mp4ds.export(dataset, "images", tmp_path / "images", together)
    assert summary.messages == {TOPIC: FRAMES}
    assert TOPIC not in summary.left_out
    folder = tmp_path / "images" / "cam_image_raw"
    names = {path.name for path in (tmp_path / "images").iterdir()}
    assert names == {folder.name, "mp4ds_export.json"}
    expected = pictures(made)
    for number, pixels in enumerate(expected):
        found = cv2.imread(str(folder / f"{number:02d}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(found, pixels), number
    stamps = [item.values["header"]["stamp"] for item in made.messages if item.topic == TOPIC]
    assert [int(row[1]) for row in rows_of(folder)] == stamps
    assert [row[0] for row in rows_of(folder)] == [f"{n:02d}.png" for n in range(FRAMES)]
    assert {row[3] for row in rows_of(folder)} == {"cam"}


def png(pixels: NDArray[Any], *flags: int) -> bytes:
    ok, data = cv2.imencode(".png", pixels, flags)
    assert ok
    return bytes(data)


def palette() -> bytes:
    """A picture with a palette, of which no stream is made."""
    file = io.BytesIO()
    image = Image.fromarray(np.arange(48 * 64, dtype=np.uint32).view(np.uint8).reshape(48, 64, 4))
    image.convert("RGB").quantize(16).save(file, "PNG")
    return file.getvalue()


def depths(seed: int) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(0, 2**16, (48, 64), np.uint16)


# format, what makes the data, encoding, and the bytes before the file as which it is written
CODED_FILES: dict[str, tuple[str, Callable[[int], bytes], str, int | None]] = {
    "palette": ("png", lambda _: palette(), "rgb8", 0),
    "depth-png": ("16UC1; compressedDepth png", lambda n: bytes(12) + png(depths(n)), "16UC1", 12),
    "depth-rvl": (
        "16UC1; compressedDepth rvl",
        lambda n: bytes(12) + encode_rvl(depths(n)) + bytes(4),
        "16UC1",
        None,
    ),
    "webp": ("webp", lambda _: webp(), "rgb8", None),
}


def webp() -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.full((48, 64, 3), 90, np.uint8)).save(file, "WEBP")
    return file.getvalue()


@pytest.mark.parametrize("name", CODED_FILES)
def test_files_that_no_video_holds(name: str, tmp_path: Path) -> None:
    told, make, encoding, start = CODED_FILES[name]
    made = scene("mono8", frames=3, with_info=False)
    for place, item in enumerate(made.messages):
        if item.topic == TOPIC:
            fields = {"header": item.values["header"], "format": told}
            fields["data"] = np.frombuffer(make(place), np.uint8)
            made.messages[place] = Record("/cam/coded", COMPRESSED, item.log_time, fields)
    dataset = packed(tmp_path, made)
    assert [entry.messages for entry in mp4ds.open(dataset).manifest.verbatim] == [3]
    summary = mp4ds.export(dataset, "images", tmp_path / "images")
    assert summary.messages == {"/cam/coded": 3}
    assert {path.suffix for path in (tmp_path / "images").rglob("[0-9]*")} == {".png"}
    with mp4ds.open(dataset) as opened:
        frames = opened["/cam/coded"]
        assert (len(frames), frames.encoding, frames.image_size) == (3, encoding, (64, 48))
        pixels = frames[1].data
    files = sorted((tmp_path / "images" / "cam_coded").glob("*.png"))
    if start is not None:
        sent = [bytes(m.values["data"])[start:] for m in made.messages if m.topic == "/cam/coded"]
        assert [path.read_bytes() for path in files] == sent
    if encoding == "16UC1":
        expected = depths([n for n, item in enumerate(made.messages) if "coded" in item.topic][1])
        assert np.array_equal(pixels, expected)
        assert np.array_equal(cv2.imread(str(files[1]), cv2.IMREAD_UNCHANGED), expected)


@pytest.mark.parametrize("name", ["jpeg-cmyk", "jpeg-cut-one", "garbage", "video-h264-mid-gop"])
def test_what_has_no_picture_is_counted(name: str, tmp_path: Path) -> None:
    made = CODED[name](frames=5)
    dataset = packed(tmp_path, made)
    images = [item for item in made.messages if item.msgtype != IMAGE and "cam" in item.topic]
    (topic,) = {item.topic for item in images if "camera_info" not in item.topic}
    total = sum(item.topic == topic for item in made.messages)
    if name == "garbage":
        with pytest.raises(mp4ds.OptionError, match=f"cannot hold any topic.*{topic}: "):
            mp4ds.export(dataset, "images", tmp_path / "images")
        return
    summary = mp4ds.export(dataset, "images", tmp_path / "images")
    written = len([*(tmp_path / "images").glob("*/[0-9]*")])
    assert summary.messages[topic] == written
    without = summary.left_out.get(topic, {})
    assert written + sum(without.values()) == total
    assert all(reason.startswith("no picture: ") for reason in without)
    if name == "jpeg-cmyk":
        (first, *_) = (item for item in images if item.topic == topic)
        (path, *_) = sorted((tmp_path / "images").glob("*/[0-9]*"))
        assert path.suffix == ".jpg"
        assert path.read_bytes() == first.values["data"]
    else:
        assert without


# ---------------------------------------------------------------- as frames


def test_all_frames_are_there_in_their_place(tmp_path: Path) -> None:
    made = mixed()
    expected = pictures(made)
    with mp4ds.open(packed(tmp_path, made)) as dataset:
        frames = dataset[TOPIC]
        assert len(frames) == FRAMES
        for number, frame in enumerate(frames):
            assert np.array_equal(frame.data, expected[number])
            assert (frame.index, frame.encoding, frame.frame_id) == (number, "mono8", "cam")
        stamps = [item.values["header"]["stamp"] for item in made.messages if item.topic == TOPIC]
        assert frames.stamps.tolist() == stamps
        assert [item.index for item in frames.get([11, 0, 4, 4])] == [11, 0, 4, 4]
        assert np.array_equal(frames.read([5, 1], format="gray"), np.array(expected)[[5, 1]])
        assert np.array_equal(frames.at(stamps[4]).data, expected[4])
        found = frames.between(stamps[3], stamps[6])
        assert [np.array_equal(f.data, expected[n]) for n, f in enumerate(found, 3)] == [True] * 3
        assert frames[0].intrinsics == frames[1].intrinsics is not None
        # the stream alone, by its file name, has those of its video
        assert len(dataset["cam_image_raw"]) == FRAMES - 4
        assert dataset.topics == [TOPIC]
        assert TOPIC in dataset


def test_verbatim_images_of_a_damaged_dataset(tmp_path: Path) -> None:
    folder = packed(tmp_path, mixed())
    path = folder / "messages.mcap"
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(data)
    with pytest.raises(mp4ds.FormatError, match=r"messages\.mcap: .*unpack --salvage` restores"):
        mp4ds.export(folder, "images", tmp_path / "images")
    assert not (tmp_path / "images").exists()
