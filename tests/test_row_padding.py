"""What stands after the pixels of rows: in the sidecar, exact in every profile."""

from __future__ import annotations

import base64
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mp4ds
from compare import compare
from in_parts import InlineExecutor, use
from mp4ds import yamlio
from mp4ds.bags.formats import open_reader
from mp4ds.packing.options import PackOptions
from mp4ds.records import Message
from round_trips import unpacked
from sources import SOURCES, odd_scene
from test_structure import ROOT

TOPIC = "/odd/image"
WIDTH, STEP = 32, 36


@pytest.fixture(autouse=True)
def executor(monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, InlineExecutor())


def recording(folder: Path, trait: str, source: str = "mcap-ros2-none", **options: Any) -> Any:
    return SOURCES[source](folder / "source", odd_scene(trait, **options))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("quality", ["lossless", "crf=20", "psnr=30"])
@pytest.mark.parametrize(
    "trait", ["row-padding-garbage", "row-padding-varied", "row-padding-not-last"]
)
@pytest.mark.parametrize("source", ["bag-none", "mcap-ros2-none"])
def test_padded_images_are_a_video(trait: str, quality: str, source: str, tmp_path: Path) -> None:
    paths = recording(tmp_path, trait, source)
    options = PackOptions(quality=quality, codec=None if quality == "lossless" else "h264")
    summary = mp4ds.pack(paths, tmp_path / "dataset", options)
    (topic,) = (topic for topic in summary.topics if topic.topic == TOPIC)
    assert (topic.frames, topic.verbatim) == (8, {})
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    back = unpacked(tmp_path, "bag" if source == "bag-none" else "mcap")
    if quality == "lossless":
        assert compare(paths, back) == []
        return
    for before, after in zip(payloads(paths[0]), payloads(back), strict=True):
        changed = np.flatnonzero(differs(before, after))
        place = changed - len(before) + bodies_size(before)
        assert (place >= 0).all()
        assert (place % STEP < WIDTH).all()


def payloads(path: Path) -> list[bytes]:
    with open_reader(path) as reader:
        return [
            bytes(record.data)
            for record in reader.records()
            if isinstance(record, Message) and record.channel.topic == TOPIC
        ]


def differs(before: bytes, after: bytes) -> NDArray[np.bool_]:
    assert len(before) == len(after)
    return np.frombuffer(before, np.uint8) != np.frombuffer(after, np.uint8)


def bodies_size(payload: bytes) -> int:
    """Bytes of the image, whose length stands before it."""
    for size in (24 * STEP, 24 * STEP - 4):
        if payload[: len(payload) - size].endswith(size.to_bytes(4, "little")):
            return size
    raise AssertionError("no image")


@pytest.mark.parametrize("window", [None, 4])
def test_padding_beyond_a_bound_is_verbatim(
    window: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of parts, those with too much of it together become two streams."""
    monkeypatch.setattr("mp4ds.format.fields.MAX_PADDING", 150)
    paths = recording(tmp_path, "row-padding-varied")
    summary = mp4ds.pack(paths, tmp_path / "dataset", PackOptions(window=window))
    (topic,) = (topic for topic in summary.topics if topic.topic == TOPIC)
    if window is None:
        assert "too much padding between rows, different in each image" in topic.verbatim
    assert 0 < topic.frames <= 8
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(paths, unpacked(tmp_path, "mcap")) == []


def deflated(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data)).decode()


@pytest.mark.parametrize(
    "text",
    [
        deflated(bytes(95)),
        deflated(bytes(97)),
        deflated(bytes(10**7)),
        base64.b64encode(zlib.compress(b"junk" * 24)[:-5]).decode(),
        base64.b64encode(zlib.compress(b"junk" * 24) + b"more").decode(),
        base64.b64encode(b"junk").decode(),
        "A",
    ],
)
def test_a_wrong_padding_is_told(text: str, tmp_path: Path) -> None:
    paths = recording(tmp_path, "row-padding-garbage")
    mp4ds.pack(paths, tmp_path / "dataset")
    path = tmp_path / "dataset" / "odd_image.yaml"
    document = yamlio.load(path.read_bytes(), "it")
    document["headers"][0]["padding"] = text
    path.write_bytes(yamlio.dump(document))
    (problem,) = mp4ds.validate(path, deep=True)
    assert problem.code == "header-mismatch"
    assert "headers.0.padding" in str(problem)


# ---------------------------------------------------------------- version 1.0


def test_datasets_of_version_1_0_are_read() -> None:
    """``fixtures/v1.0`` was packed when that was the version, and is never packed again."""
    folder = ROOT / "tests" / "fixtures" / "v1.0"
    assert all(b'mp4ds: "1.0"' in path.read_bytes() for path in folder.glob("*.yaml"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert mp4ds.validate(folder, deep=True) == []
    with mp4ds.open(folder) as dataset:
        assert sum(len(stream) for stream in dataset.streams) > 0
