"""A dataset without the videos that make it exact: every command, and what each says of it."""

from __future__ import annotations

import json
import os
import re
import shutil
import warnings
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

import mp4ds
from commands import call, refused
from mp4ds.errors import size_text
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.playing.player import open_player
from player_scenes import RecordingPublisher

LEFT, RIGHT = "/left/image_raw", "/right/image_raw"
ABSENT = "exact layer not here: 2 files, "
EXACT = ("left_image_raw.exact.mp4", "right_image_raw.exact.mp4")


@pytest.fixture(scope="module")
def views(with_views: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `rsync --exclude '*.exact.mp4'` takes along; not to be changed."""
    return Path(
        shutil.copytree(
            with_views,
            tmp_path_factory.mktemp("views") / "drive",
            ignore=shutil.ignore_patterns("*.exact.mp4"),
        )
    )


@pytest.fixture(scope="module")
def seen(with_views: Path) -> dict[str, Any]:
    """What its views show, by topic, read while everything is there."""
    with mp4ds.open(with_views, layer="view") as dataset:
        return {topic.topic: topic.read(range(len(topic)), format="native") for topic in dataset}


def assert_shows(path: Path, seen: dict[str, Any]) -> None:
    """A recording has the pixels of the views, and all else as it was recorded."""
    with AnyReader([path]) as reader:
        for topic, images in seen.items():
            connections = [c for c in reader.connections if c.topic == topic]
            messages = [
                reader.deserialize(raw, connection.msgtype)
                for connection, _, raw in reader.messages(connections)
            ]
            assert len(messages) == len(images)
            for message, pixels in zip(messages, images, strict=True):
                assert message.data.tobytes() == pixels.tobytes()


# ---------------------------------------------------------------- looking


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("info",), f"{ABSENT}.*; frames are those of the views"),
        (("info", "--checksums"), r"left_image_raw\.exact\.mp4"),
        (("validate",), f"{ABSENT}.*no problems; frames were not decoded"),
        (("validate", "--deep"), f"{ABSENT}.*no problems; every video here was decoded"),
    ],
)
def test_commands_that_look(words: tuple[str, ...], told: str, views: Path) -> None:
    done = call(*words, views)
    assert done.code == 0, done.err
    assert re.search(told, done.out, re.DOTALL)


def test_validate_counts_what_is_missing(with_views: Path, views: Path) -> None:
    size = sum((with_views / name).stat().st_size for name in EXACT)
    told = json.loads(call("validate", views, "--json").out)
    assert told["problems"] == []
    assert told["absent"] == f"{ABSENT}{size_text(size)}"
    assert json.loads(call("validate", with_views, "--json").out)["absent"] == ""


def test_frames_and_the_report_show_the_views(views: Path, tmp_path: Path) -> None:
    still = tmp_path / "still.png"
    assert call("frames", views, "-t", LEFT, "--at", "#3", "-o", still).code == 0
    exact = ("frames", views, "-t", LEFT, "--at", "#3", "--exact", "-o", tmp_path / "exact.png")
    refused(call(*exact), 2, "has no exact frames here")
    done = call("report", views, "-o", tmp_path / "page")
    assert (done.code, done.out.count("plays its video")) == (0, 2)


# ---------------------------------------------------------------- taking along


TAKEN: dict[str, tuple[str, ...]] = {
    "unpack": ("unpack", "-o", "out.mcap"),
    "unpack salvage": ("unpack", "--salvage", "-o", "out.mcap"),
    "unpack slice": ("unpack", "--start", "0.3", "-o", "out.mcap"),
    "unpack packets": ("unpack", "--images", "compressed-video", "-o", "out.mcap"),
    "unpack jpeg": ("unpack", "--images", "jpeg", "-o", "out.mcap"),
    "pack": ("pack", "-o", "out"),
    "pack slice": ("pack", "--start", "0.3", "--duration", "0.4", "-o", "out"),
    "images": ("export", "images", "-o", "out"),
    "euroc": ("export", "euroc", "-o", "out"),
    "tum": ("export", "tum", "-o", "out"),
    "tum slice": ("export", "tum", "--start", "0.3", "-o", "out"),
    "colmap": ("export", "colmap", "-o", "out"),
}
"""Commands that give pixels as recorded, or with --quality visual those of the views."""


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", TAKEN)
def test_pixels_that_differ_are_taken_only_when_asked_for(
    name: str, views: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = (*TAKEN[name], views)
    done = call(*words)
    assert done.code == 2
    assert ABSENT in done.err
    assert "--quality visual" in done.err
    assert os.listdir() == []  # noqa: PTH208
    done = call(*words, "--quality", "visual")
    assert done.code == 0, done.err
    (made,) = tmp_path.iterdir()
    if name.startswith("tum"):  # which takes one of the two
        assert done.out.count("its pixels are those of its view") == 1
    if made.suffix == ".mcap":
        assert done.out.count("its pixels differ from those recorded") == 2


def test_what_is_unpacked_is_what_the_views_show(
    views: Path, seen: dict[str, Any], tmp_path: Path
) -> None:
    mp4ds.unpack(views, "mcap", tmp_path / "out.mcap", mp4ds.UnpackOptions(quality="visual"))
    assert_shows(tmp_path / "out.mcap", seen)
    mp4ds.pack(views, tmp_path / "copy", mp4ds.PackOptions(quality="visual"))
    assert mp4ds.validate(tmp_path / "copy", deep=True) == []
    mp4ds.unpack(tmp_path / "copy", "mcap", tmp_path / "again.mcap")
    assert_shows(tmp_path / "again.mcap", seen)


@pytest.mark.parametrize("quality", ["lossless", "crf=30"])
def test_nothing_else_is_encoded_from_views(quality: str, views: Path, tmp_path: Path) -> None:
    done = call("pack", views, "-o", tmp_path / "out", "--quality", quality)
    assert done.code == 2
    assert ABSENT in done.err
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- using


@pytest.mark.parametrize("options", [{}, {"quality": "visual"}, {"publish_as": "ffmpeg"}])
def test_it_is_played(options: dict[str, Any], views: Path, seen: dict[str, Any]) -> None:
    node = RecordingPublisher("ros2")
    playing = PlayOptions(immediate=True, topics=[LEFT], **options)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with open_player(views, playing, node=node) as player:
            player.run()
    told = [str(item.message) for item in caught if "exact layer" in str(item.message)]
    assert len(told) == ("quality" not in options)
    assert len(node.sent) == len(seen[LEFT])
    if "publish_as" not in options:
        for sent, pixels in zip(node.sent, seen[LEFT], strict=True):
            assert sent.payload.endswith(pixels.tobytes())
