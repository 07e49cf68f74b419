"""Latched messages from before a slice are in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import mp4ds
from mp4ds.bags import latched
from mp4ds.bags.formats import open_writer
from mp4ds.cli import commands
from mp4ds.format.sidecars import load_manifest
from mp4ds.packing.options import PackOptions
from mp4ds.plugins.info import info
from mp4ds.plugins.playing.options import PlayOptions
from mp4ds.plugins.playing.player import open_player
from mp4ds.records import Message
from mp4ds.unpacking.unpack import UnpackOptions
from player_scenes import (
    MS,
    START,
    STEP,
    Recorded,
    RecordingPublisher,
    make_drive,
    make_ros2,
    recorded,
    ros2_channel,
    static_transform,
)

FIRST = START + 10 * STEP
SPAN: dict[str, Any] = {"start": str(FIRST), "end": str(START + 15 * STEP)}
WAYS = ["one-pass", "parts", "dataset", "dataset-anew", "unpack"]
TOPICS = {
    "bag": {"/tf_static": 2},
    "mcap": {"/tf_static": 4, "/map": 2},
}


def made(kind: str, folder: Path) -> Path:
    path = folder / f"drive.{kind}"
    return make_drive(path) if kind == "bag" else make_ros2(path)


def due(path: Path) -> list[Recorded]:
    """What a slice has to hold: all latched messages of these recordings are sent at the start."""
    return [
        (topic, data, time)
        for topic, data, time in recorded(path)
        if FIRST <= time < START + 15 * STEP or (time < FIRST and topic in ("/tf_static", "/map"))
    ]


def sliced(way: str, source: Path, folder: Path, **options: Any) -> tuple[Any, Path]:
    """The summary of how a slice was made, and it as a recording."""
    output, dataset = folder / f"slice{source.suffix}", folder / "slice"
    asked = {**SPAN, **options}
    if way in ("one-pass", "parts"):
        window: dict[str, Any] = {"window": 2, "jobs": 2} if way == "parts" else {}
        summary: Any = mp4ds.pack(source, dataset, PackOptions(**asked, **window))
    else:
        mp4ds.pack(source, folder / "whole", PackOptions())
        if way == "unpack":
            unpacking = UnpackOptions(**asked)
            return mp4ds.unpack(folder / "whole", None, output, unpacking), output
        anew: dict[str, Any] = {"codec": "ffv1"} if way == "dataset-anew" else {}
        summary = mp4ds.pack(folder / "whole", dataset, PackOptions(**asked, **anew))
    mp4ds.unpack(dataset, None, output)
    return summary, output


@pytest.mark.one_in(3)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", TOPICS)
def test_it_begins_with_them(way: str, kind: str, tmp_path: Path) -> None:
    source = made(kind, tmp_path)
    summary, output = sliced(way, source, tmp_path)
    assert recorded(output) == due(source)
    assert summary.latched == TOPICS[kind]
    if way == "unpack":
        return
    dataset = tmp_path / "slice"
    assert mp4ds.validate(dataset, deep=True) == []
    manifest = load_manifest(dataset / "dataset.yaml")
    assert manifest.sources[0].excerpt is not None
    assert manifest.sources[0].excerpt.start == FIRST
    assert manifest.messages == len(due(source))
    total = sum(TOPICS[kind].values())
    words = f"{total} latched messages from before the start: "
    assert [note for note in info(dataset).notes if words in note]


def test_a_slice_of_a_slice_and_its_beginning(tmp_path: Path) -> None:
    """Seconds count from where the slice begins, not from a latched message, which stay in it."""
    source = made("bag", tmp_path)
    mp4ds.pack(source, tmp_path / "slice", PackOptions(start=str(FIRST)))
    mp4ds.pack(tmp_path / "slice", tmp_path / "copied", PackOptions(start=0.25))
    mp4ds.pack(tmp_path / "slice", tmp_path / "anew", PackOptions(start=0.25, codec="ffv1"))
    start = FIRST + STEP * 5
    for name in ("copied", "anew"):
        assert load_manifest(tmp_path / name / "dataset.yaml").sources[0].excerpt is not None
        mp4ds.unpack(tmp_path / name, None, tmp_path / f"{name}.bag")
        found = recorded(tmp_path / f"{name}.bag")
        assert [topic for topic, _, time in found if time < start] == ["/tf_static"] * 2
        assert found[2:] == [row for row in recorded(source) if row[2] >= start]


def test_it_is_played_from_its_beginning(tmp_path: Path) -> None:
    mp4ds.pack(made("bag", tmp_path), tmp_path / "slice", PackOptions(**SPAN))
    publisher = RecordingPublisher(world="ros1")
    with open_player(tmp_path / "slice", PlayOptions(immediate=True), node=publisher) as one:
        one.run()
    topics = [sent.topic for sent in publisher.sent]
    assert topics[:2] == ["/tf_static"] * 2
    assert topics.count("/tf_static") == 2
    assert topics.count("/camera/image_raw") == 5


def test_static_transforms_count_as_latched(tmp_path: Path) -> None:
    """Recorded without their profile; and not those that a later message replaces."""
    static = ros2_channel(1, "/robot/tf_static", "tf2_msgs/msg/TFMessage")
    chatter = ros2_channel(2, "/chatter", "std_msgs/msg/String")
    with open_writer(
        tmp_path / "a.mcap", "mcap", name="a", profile="ros2", library="", storage="mcap"
    ) as writer:
        for channel in (static, chatter):
            writer.add_channel(channel)
        for number, child in enumerate(("base", "arm", "base")):
            time = START + number * MS
            writer.write(Message(static, time, time, 0, static_transform(child, number)))
        for number in range(4):
            time = START + number * STEP
            writer.write(Message(chatter, time, time, 0, static_transform("any")))
    _, output = sliced("one-pass", tmp_path / "a.mcap", tmp_path, start=str(START + STEP))
    assert [row[2] - START for row in recorded(output)[:2]] == [MS, 2 * MS]
    assert len(recorded(output)) == 2 + 3


def test_what_is_too_large_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = made("mcap", tmp_path)
    monkeypatch.setattr(latched, "MOST_BYTES", 100)
    summary, output = sliced("one-pass", source, tmp_path)
    assert summary.latched == {"/map": 2}
    assert summary.latched_left_out == ["/tf_static"]
    assert "/tf_static" not in {row[0] for row in recorded(output)}


@pytest.mark.parametrize("way", ["one-pass", "dataset", "unpack"])
def test_what_is_not_selected_takes_no_room(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latched, "MOST_BYTES", 395)  # those of /tf_static alone take less
    summary, output = sliced(way, made("mcap", tmp_path), tmp_path, exclude=["/map"])
    assert summary.latched == {"/tf_static": 4}
    assert summary.latched_left_out == []
    assert "/tf_static" in {row[0] for row in recorded(output)}


def test_what_is_printed(tmp_path: Path) -> None:
    source = made("mcap", tmp_path)
    for command in (
        ["pack", str(source), "-o", str(tmp_path / "part"), "--start", str(FIRST)],
        ["info", str(tmp_path / "part")],
        ["pack", str(source), "-o", str(tmp_path / "whole")],
        ["unpack", str(tmp_path / "whole"), "--start", str(FIRST)],
    ):
        result = CliRunner().invoke(commands, command)
        assert result.exit_code == 0, result.output
        has_any = command[0] == "info" or "--start" in command
        assert (
            "6 latched messages from before the start: /tf_static, /map" in result.output
        ) == has_any, result.output
