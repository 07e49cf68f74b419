"""Messages of a dataset from a place on, and chosen ones: the same bytes, nothing decoded twice."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from coded_scenes import CODED
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import FormatError
from mp4ds.format.fields import DecodedColumns, everything
from mp4ds.plugins.playing.timeline import ReadAhead
from mp4ds.records import Message, Record
from mp4ds.video.mp4 import read_sample_table
from round_trips import packed
from scenes import TRAITS, Scene, odd_scene, scene

T = TypeVar("T")
Row = tuple[str, int, int, int, bytes]
TOPIC = "/cam/image_raw"
SCENES: dict[str, Callable[[], Scene]] = {
    **{name: lambda name=name: CODED[name]() for name in CODED},  # type: ignore[misc]
    **{
        f"raw-{encoding}": lambda encoding=encoding: scene(encoding, frames=14)  # type: ignore[misc]
        for encoding in ("mono8", "mono16", "rgb8", "bayer_rggb8", "32FC1")
    },
    **{f"odd-{name}": lambda name=name: odd_scene(name) for name in TRAITS},  # type: ignore[misc]
}


def row(message: Message) -> Row:
    channel = message.channel
    return (
        channel.topic,
        channel.id,
        message.log_time,
        message.sequence,
        bytes(message.data),
    )


def rows(records: Iterator[Record]) -> list[Row]:
    return [row(record) for record in records if isinstance(record, Message)]


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One camera with a key frame in 8 frames, of 200."""
    folder = tmp_path_factory.mktemp("long")
    made = scene("rgb8", frames=200, width=32, height=16)
    return packed(folder, made, codec="h264", gop=8)


# ---------------------------------------------------------------- from a time on


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", SCENES)
def test_from_every_kind_of_place(name: str, tmp_path: Path) -> None:
    """What comes from a time on is what has come before, however it was stored."""
    source = "mcap-ros2-zstd" if name.startswith("cdr") else "bag-none"
    with Dataset(packed(tmp_path, SCENES[name](), source, gop=4)) as dataset:
        whole = rows(dataset.records())
        assert dataset.manifest
        assert len(whole) == dataset.manifest.messages
        times = sorted({time for _, _, time, _, _ in whole})
        for start in (0, times[0], times[len(times) // 2], times[-1], times[-1] + 1):
            found = rows(dataset.records(start=start))
            wanted = [item for item in whole if item[2] >= start]
            assert Counter(found) == Counter(wanted)
            if [item[2] for item in wanted] == sorted(item[2] for item in wanted):
                assert [item[2] for item in found] == [item[2] for item in wanted]


def test_only_messages_from_a_time_on(tmp_path: Path) -> None:
    folder = packed(tmp_path, scene("mono8"), "mcap-ros2-zstd")
    with Dataset(folder) as dataset:
        kinds = {type(record) for record in dataset.records(start=0)}
        assert kinds == {Message} < {type(record) for record in dataset.records()}


def without_packets(long: Path, folder: Path, first: int, end: int) -> Path:
    """The dataset with zeros for some packets, which do not decode: in whole groups of pictures."""
    shutil.copytree(long, folder)
    for video in folder.glob("*.mp4"):
        data = bytearray(video.read_bytes())
        with video.open("rb") as file:
            table = read_sample_table(file, len(data), "")
        keys = [key for key in np.flatnonzero(table.sync).tolist() if first <= key <= end]
        groups = slice(keys[0], keys[-1])
        for place, size in zip(table.places[groups], table.sizes[groups], strict=True):
            data[place : place + size] = bytes(size)
        video.write_bytes(data)
    return folder


def test_nothing_before_the_key_frame_is_decoded(long: Path, tmp_path: Path) -> None:
    with Dataset(without_packets(long, tmp_path / "cut", 0, 96)) as dataset:
        start = int(dataset[TOPIC].log_times[101])
        assert len(rows(dataset.records(start=start, topics=[TOPIC]))) == 99
        with pytest.raises(FormatError):
            rows(dataset.records(topics=[TOPIC]))


def test_some_topics(long: Path) -> None:
    with Dataset(long) as dataset:
        whole = rows(dataset.records())
        start = whole[300][2]
        for topics in ([TOPIC], ["/imu", TOPIC], {"/cam/camera_info"}, ["/none"], []):
            wanted = [item for item in whole if item[0] in topics]
            assert rows(dataset.records(topics=topics)) == wanted
            wanted = [item for item in wanted if item[2] >= start]
            assert Counter(rows(dataset.records(topics=topics, start=start))) == Counter(wanted)


def test_one_video_alone(long: Path) -> None:
    sidecar = next(path for path in long.glob("*.yaml") if path.with_suffix(".mp4").exists())
    with Dataset(sidecar) as pair:
        whole = rows(pair.records())
        start = whole[100][2]
        assert rows(pair.records(start=start)) == [item for item in whole if item[2] >= start]


# ---------------------------------------------------------------- chosen ones


def every(step: int) -> Callable[[DecodedColumns], Iterator[int]]:
    return lambda columns: iter(range(0, len(columns.log_time), step))


@pytest.mark.parametrize("start", [None, 0])
@pytest.mark.parametrize("trait", ["size-change", "encoding-change", "plain", "data-empty"])
def test_chosen_messages_keep_their_places(trait: str, start: int | None, tmp_path: Path) -> None:
    """A channel of which some messages are in messages.mcap."""
    with Dataset(packed(tmp_path, odd_scene(trait), "mcap-ros2-zstd")) as dataset:
        whole = rows(dataset.records())
        (group,) = dataset._groups
        chosen = {
            int(part.columns.log_time[index])
            for part in group.parts
            for index in every(2)(part.columns)
        }
        in_videos = {int(time) for part in group.parts for time in part.columns.log_time}
        wanted = [
            item
            for item in whole
            if item[0] != "/odd/image" or item[2] in chosen or item[2] not in in_videos
        ]
        assert len(wanted) < len(whole)
        found = rows(dataset.records(choose=every(2), start=start))
        assert Counter(found) == Counter(wanted)
        if start is None:
            assert found == wanted
        else:
            assert [item[2] for item in found] == sorted(item[2] for item in wanted)


def test_a_choice_is_asked_when_the_message_before_was_made(long: Path) -> None:
    """So that frames can be left out for which it is too late by then."""
    events: list[tuple[str, int]] = []

    def choose(columns: DecodedColumns) -> Iterator[int]:
        index = 0
        while index < len(columns.log_time):
            events.append(("asked", index))
            yield index
            index += 1 if index < 10 else 40

    with Dataset(long) as dataset:
        stream = dataset[TOPIC]
        times = {int(time): index for index, time in enumerate(stream.log_times)}
        for record in dataset.records(choose=choose, topics=[TOPIC]):
            if isinstance(record, Message):
                events.append(("made", times[record.log_time]))
    numbers = [*range(10), *range(10, 200, 40)]
    assert events == [(what, number) for number in numbers for what in ("asked", "made")]


@pytest.mark.parametrize("name", ["video-h264", "jpeg-rgb"])
def test_chosen_packets(name: str, tmp_path: Path) -> None:
    with Dataset(packed(tmp_path, CODED[name](frames=30))) as dataset:
        (stream,) = dataset.streams
        payloads = dict(stream.payloads())
        chosen = dict(stream.payloads(every(7)))
        refers = not name.startswith("jpeg")
        assert chosen.keys() >= set(every(7)(stream.columns))
        assert (len(chosen) > 5) == refers
        assert all(payloads[index] == payload for index, payload in chosen.items())


# ---------------------------------------------------------------- of a decoder


@pytest.mark.one_in(4)
@pytest.mark.parametrize("codec", ["h264", "h265", "av1", "ffv1"])
def test_pictures_of_any_frames(codec: str, tmp_path: Path) -> None:
    options = {"quality": "visual"} if codec == "av1" else {}
    made = scene("mono8", frames=90, width=32, height=16)
    folder = packed(tmp_path, made, codec=codec, gop=6, **options)
    rng = np.random.default_rng(1)
    with Dataset(folder) as dataset:
        (stream,) = dataset.streams
        with stream.open_video(sequential=True) as decoder:
            whole = [picture[0].copy() for _, picture in decoder.pictures_at(range(90))]
            chances = (0.02, 0.1, 0.3, 0.9, 1.0)
            choices = [np.flatnonzero(rng.random(90) < chance).tolist() for chance in chances]
            for chosen in ([], [89], [0, 89], [5, 6, 47, 48], *choices):
                found = [(i, picture[0].copy()) for i, picture in decoder.pictures_at(chosen)]
                assert [index for index, _ in found] == chosen
                assert all(np.array_equal(picture, whole[i]) for i, picture in found)
                both = [(i, p[0].copy()) for i, p in decoder.decodable_pictures(chosen) if p]
                assert len(both) == len(chosen)
                assert all(np.array_equal(picture, whole[i]) for i, picture in both)


@pytest.mark.parametrize(
    ("chosen", "harmless"), [(range(20, 60), (0, 16)), ([3, 9, 60, 62, 199], (64, 192))]
)
def test_far_key_frames_are_sought(
    chosen: Sequence[int],
    harmless: tuple[int, int],
    long: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is far from any chosen frame is not decoded."""
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    with (
        Dataset(without_packets(long, tmp_path / "cut", *harmless)) as dataset,
        dataset.streams[0].open_video(sequential=True) as decoder,
    ):
        assert len(list(decoder.pictures_at(chosen))) == len(chosen)


# ---------------------------------------------------------------- what is checked


def test_digests_are_compared_from_a_time_on(long: Path, tmp_path: Path) -> None:
    with Dataset(long) as dataset:
        (stream,) = dataset.streams
        assert stream.rebuilder._digests
        stream.rebuilder._digests[150] ^= 1
        times = stream.log_times
        assert rows(dataset.records(start=int(times[151]), topics=[TOPIC]))
        with pytest.raises(FormatError) as caught:
            rows(dataset.records(start=int(times[149]), topics=[TOPIC]))
        assert caught.value.code == "digest-mismatch"


def test_the_whole_video_is_hashed_for_everything_alone(tmp_path: Path) -> None:
    folder = packed(tmp_path, scene("rgb8"), quality="visual")
    video = next(folder.glob("*.mp4"))
    video.write_bytes(video.read_bytes().replace(b"VideoHandler", b"videoHandler"))
    with Dataset(folder) as dataset:
        frames = len(dataset[TOPIC])
        assert len(rows(dataset.records(start=0, topics=[TOPIC]))) == frames
        assert len(rows(dataset.records(choose=every(2), topics=[TOPIC]))) == frames / 2
        with pytest.raises(FormatError) as caught:
            rows(dataset.records(topics=[TOPIC]))
        assert caught.value.code == "hash-mismatch"


@pytest.mark.parametrize("choose", [everything, every(2)])
def test_messages_that_are_in_no_file(choose: Any, long: Path) -> None:
    with Dataset(long) as dataset:
        ordinal = dataset.streams[0].columns.ordinal
        ordinal[100:] += 1
        with pytest.raises(FormatError, match=rf"message 100 of topic {TOPIC}") as caught:
            rows(dataset.records(choose=choose))
        assert caught.value.code == "messages-missing"
        assert rows(dataset.records(start=0))


# ---------------------------------------------------------------- ahead


@pytest.mark.parametrize("start", [None, 0])
@pytest.mark.parametrize("trait", ["size-change", "plain"])
def test_sources_are_read_by_threads(trait: str, start: int | None, tmp_path: Path) -> None:
    with Dataset(packed(tmp_path, odd_scene(trait))) as dataset:
        threads: list[ReadAhead[Any]] = []

        def ahead(items: Iterator[T]) -> Iterator[T]:
            threads.append(ReadAhead(items, 4))
            return threads[-1]

        wanted = rows(dataset.records(start=start))
        assert rows(dataset.records(start=start, ahead=ahead)) == wanted
        sources = [len(group.parts) + bool(group.recorded_ids) for group in dataset._groups]
        assert len(threads) == 1 + sum(sources)
        for thread in threads:
            thread.close()
