"""Messages of a dataset from a place on, and chosen ones: the same bytes, nothing decoded twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from coded_scenes import CODED
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import FormatError
from mp4ds.format.fields import DecodedColumns
from mp4ds.records import Message, Record
from round_trips import packed
from scenes import TRAITS, Scene, odd_scene, scene

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
