"""A slice of time: the same messages, whatever it is taken of and whatever it becomes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

import mp4ds
from coded_scenes import CODED
from compare import compare
from in_parts import InlineExecutor, use
from mp4ds.errors import FormatError, OptionError
from mp4ds.format.manifest import Manifest
from mp4ds.format.sidecars import load_manifest
from mp4ds.packing.options import PackOptions
from mp4ds.unpacking.unpack import UnpackOptions
from round_trips import TARGETS, output_of, own_target
from sources import PERIOD, SOURCES, START, TRAITS, odd_scene, scene, write_bag

FRAMES = 40
FIRST, LAST = START + 17 * PERIOD + 5, START + 26 * PERIOD  # of what is taken, and after it
SPAN = {"start": str(FIRST), "end": str(LAST)}
ONLY: dict[str, Any] = {**SPAN, "latched": False}
BETWEEN = {"start": FIRST, "end": LAST}


def manifest(dataset: Path) -> Manifest:
    return load_manifest(dataset / "dataset.yaml")


def unpacked(dataset: Path, target: str, **options: Any) -> Path:
    to, storage = TARGETS[target]
    output = dataset.parent / f"{dataset.name}-{output_of(dataset.parent, target).name}"
    mp4ds.unpack(dataset, to, output, UnpackOptions(storage=storage, **options))
    return output


def hides_frames(dataset: Path) -> bool:
    """Whether a video hides what its first frames refer to."""
    with mp4ds.open(dataset) as opened:
        return any(stream.hides_frames for stream in opened.streams)


# ---------------------------------------------------------------- of recordings and datasets


@pytest.mark.one_in(40)
@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("way", ["one-pass", "parts", "dataset", "dataset-anew", "unpack"])
def test_what_is_taken(
    source: str, way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a recording in one pass and in parts, and of a dataset of it, copied and anew."""
    paths = SOURCES[source](tmp_path, scene("rgb8", frames=FRAMES))
    dataset, whole = tmp_path / "dataset", tmp_path / "whole"
    if way == "one-pass":
        mp4ds.pack(paths, dataset, PackOptions(**ONLY))
    elif way == "parts":
        use(monkeypatch, InlineExecutor())
        mp4ds.pack(paths, dataset, PackOptions(**ONLY, window=4))
    else:
        mp4ds.pack(paths, whole, PackOptions(codec="h264", gop=8))
    if way == "dataset":
        mp4ds.pack(whole, dataset, PackOptions(**ONLY))
        assert hides_frames(dataset)
        with mp4ds.open(dataset) as opened, pytest.raises(mp4ds.OptionError, match="torchcodec"):
            opened.streams[0].frame_mappings()
    elif way == "dataset-anew":
        mp4ds.pack(whole, dataset, PackOptions(**ONLY, codec="ffv1"))
    if way == "unpack":
        output = unpacked(whole, own_target(source), **ONLY)
    else:
        assert mp4ds.validate(dataset, deep=True) == []
        for item in manifest(dataset).sources:
            assert item.excerpt is not None
            assert (item.excerpt.start, item.excerpt.end) == (FIRST, LAST)
            assert (item.sha256 is None) == (way in ("one-pass", "parts"))
        output = unpacked(dataset, own_target(source))
    assert compare(paths, output, **BETWEEN) == []
    assert compare(paths, output) != []


@pytest.mark.one_in(4)
@pytest.mark.parametrize("trait", TRAITS)
def test_of_odd_recordings(trait: str, tmp_path: Path) -> None:
    """Also where log times do not tell the order of messages, and so nothing can be copied."""
    paths = SOURCES["mcap-ros1-zstd"](tmp_path, odd_scene(trait, frames=12))
    start, end = START + 3 * PERIOD, START + 8 * PERIOD
    mp4ds.pack(paths, tmp_path / "whole")
    span = {"start": str(start), "end": str(end)}
    for name, sources in (("dataset", paths), ("again", [tmp_path / "whole"])):
        mp4ds.pack(sources, tmp_path / name, PackOptions(**span))
        output = tmp_path / f"{name}.mcap"
        mp4ds.unpack(tmp_path / name, "mcap", output)
        assert compare(paths, output, start=start, end=end) == []
    output = unpacked(tmp_path / "whole", "mcap", **span)
    assert compare(paths, output, start=start, end=end) == []


def test_messages_of_equal_times_come_as_in_the_whole(tmp_path: Path) -> None:
    """Whichever topic they are of, and whatever attachments stand among them."""
    made = odd_scene("plain", frames=12)
    equal = [replace(one, log_time=one.log_time // PERIOD * PERIOD) for one in made.messages]
    paths = SOURCES["mcap-ros1-zstd"](tmp_path, replace(made, messages=equal))
    mp4ds.pack(paths, tmp_path / "whole")
    orders, start = [], START + 3 * PERIOD
    for name, span in (("all", {}), ("part", {"start": str(start)})):
        output = tmp_path / f"{name}.mcap"
        mp4ds.unpack(tmp_path / "whole", "mcap", output, UnpackOptions(**span))
        with output.open("rb") as file:
            found = make_reader(file).iter_messages(log_time_order=False)
            rows = [(channel.topic, message.log_time) for _, channel, message in found]
        orders.append([row for row in rows if row[1] >= start])
    assert orders[0] == orders[1] == sorted(orders[0], key=lambda row: row[1])
    assert len(set(orders[0])) > len({time for _, time in orders[0]})


def test_equal_times_in_different_files(tmp_path: Path) -> None:
    """Unpacking a slice leaves out what packing it leaves out; what converts says what to do."""
    made = odd_scene("encoding-change")
    equal = [
        replace(record, log_time=START + n // 6 * PERIOD) for n, record in enumerate(made.messages)
    ]
    paths = SOURCES["bag-lz4"](tmp_path, replace(made, messages=equal))
    mp4ds.pack(paths, tmp_path / "whole")
    with mp4ds.open(tmp_path / "whole") as opened:
        assert not opened.is_in_time
    span = {"start": str(START + PERIOD), "end": str(START + 3 * PERIOD)}
    between = {"start": START + PERIOD, "end": START + 3 * PERIOD}
    mp4ds.pack(tmp_path / "whole", tmp_path / "part", PackOptions(**span))
    for output in (unpacked(tmp_path / "part", "bag"), unpacked(tmp_path / "whole", "bag", **span)):
        assert compare(paths, output, **between) == []
    with pytest.raises(OptionError, match=r"cannot be sliced: .* Pack the slice first"):
        mp4ds.export(tmp_path / "whole", "images", tmp_path / "no", mp4ds.ExportOptions(**span))


@pytest.mark.parametrize(
    "kind", ["video-h264", "video-h265", "video-av1", "ffmpeg-libx264", "jpeg-rgb", "png-rgb-cv2"]
)
def test_of_coded_messages(kind: str, tmp_path: Path) -> None:
    paths = SOURCES["mcap-ros2-zstd"](tmp_path, CODED[kind](frames=12))
    start, end = START + 5 * PERIOD, START + 9 * PERIOD
    span = {"start": str(start), "end": str(end)}
    mp4ds.pack(paths, tmp_path / "whole")
    mp4ds.pack(tmp_path / "whole", tmp_path / "dataset", PackOptions(**span))
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(paths, unpacked(tmp_path / "dataset", "mcap"), start=start, end=end) == []


# ---------------------------------------------------------------- what is copied


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("slices") / "drive.bag"
    write_bag(path, scene("rgb8", frames=FRAMES))
    return path


@pytest.mark.parametrize("lossy", ["av1", "h264", "h265"])
def test_no_pixel_of_a_lossy_video_changes(lossy: str, recording: Path, tmp_path: Path) -> None:
    mp4ds.pack(recording, tmp_path / "whole", PackOptions(quality="crf=30", codec=lossy, gop=8))
    mp4ds.pack(tmp_path / "whole", tmp_path / "part", PackOptions(**SPAN))
    mp4ds.pack(tmp_path / "part", tmp_path / "less", PackOptions(start="0.1"))
    with (
        mp4ds.open(tmp_path / "whole") as whole,
        mp4ds.open(tmp_path / "part") as part,
        mp4ds.open(tmp_path / "less") as less,
    ):
        topic = whole.topics[0]
        first = int(np.searchsorted(whole[topic].log_times, FIRST))
        assert len(part[topic]) == 9
        for sliced in (part, less):
            offset = first + len(part[topic]) - len(sliced[topic])
            numbers = [*range(len(sliced[topic]))]
            for chosen in (numbers, numbers[::-2], numbers[3:4]):  # in order, and at random
                ours = sliced[topic].read(chosen)
                assert np.array_equal(ours, whole[topic].read([offset + n for n in chosen]))
            for number, frame in enumerate(sliced[topic]):
                assert np.array_equal(frame.data, whole[topic][offset + number].data)
    assert mp4ds.validate(tmp_path / "less", deep=True) == []
    told = manifest(tmp_path / "less")
    assert [item.name for item in told.derived_from] == ["whole", "part"]
    assert told.profile == "crf=30"


def test_a_score_is_that_of_the_frames_that_are_left(recording: Path, tmp_path: Path) -> None:
    mp4ds.pack(recording, tmp_path / "whole", PackOptions(quality="psnr=38", codec="h264"))
    mp4ds.pack(tmp_path / "whole", tmp_path / "part", PackOptions(**SPAN))
    assert mp4ds.validate(tmp_path / "part", deep=True) == []
    with mp4ds.open(tmp_path / "whole") as whole, mp4ds.open(tmp_path / "part") as part:
        (old,), (new,) = whole.streams, part.streams
        all_scores = old.sidecar.video.quality.decode(len(old))
        first = int(np.searchsorted(old.log_times, FIRST))
        scores = new.sidecar.video.quality.decode(len(new))
        assert np.array_equal(scores, all_scores[first : first + len(new)])


@pytest.mark.parametrize("suffix", [".mp4", ".exact.mp4"])
def test_a_damaged_group_is_not_copied(suffix: str, recording: Path, tmp_path: Path) -> None:
    mp4ds.pack(recording, tmp_path / "whole", PackOptions(codec="h264", gop=8))
    video = tmp_path / "whole" / f"cam_image_raw{suffix}"
    data = bytearray(video.read_bytes())
    middle = data.index(b"mdat") + (len(data) * 45) // 100
    for place in range(middle, min(middle + 3000, data.index(b"moov")), 7):
        data[place] ^= 0x55
    video.write_bytes(data)
    with pytest.raises(FormatError, match="whole"):
        mp4ds.pack(tmp_path / "whole", tmp_path / "part", PackOptions(**SPAN))
    assert not (tmp_path / "part").exists()
    with pytest.raises(FormatError):
        mp4ds.pack(tmp_path / "whole", tmp_path / "part")
    assert not (tmp_path / "part").exists()


def test_a_span_without_frames_keeps_the_rest(tmp_path: Path) -> None:
    """Calibrations whose images are outside are kept as they are."""
    recorded = scene("rgb8", frames=FRAMES)
    kept = [
        message
        for message in recorded.messages
        if "image" not in message.topic or message.log_time < START + 10 * PERIOD
    ]
    write_bag(tmp_path / "drive.bag", replace(recorded, messages=kept))
    mp4ds.pack(tmp_path / "drive.bag", tmp_path / "whole")
    mp4ds.pack(tmp_path / "whole", tmp_path / "part", PackOptions(**ONLY))
    assert manifest(tmp_path / "part").streams == []
    assert mp4ds.validate(tmp_path / "part", deep=True) == []
    output = unpacked(tmp_path / "part", "bag")
    assert compare(tmp_path / "drive.bag", output, **BETWEEN) == []


# ---------------------------------------------------------------- times


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"start": "1", "end": "2", "duration": "3"}, "two of `start`, `end` and `duration`"),
        ({"start": "soon"}, "`start` 'soon' is not a valid time"),
        ({"duration": "-1"}, "`duration`"),
        (
            {"start": "2", "end": "1"},
            "slice is empty: `start` is .*22:13:22Z, `end` is .*22:13:21Z",
        ),
        ({"start": "3.1"}, r"drive.bag: nothing was recorded from \S*23.1Z\. .* 3 seconds"),
        ({"end": "2023-11-14T22:13:20"}, "nothing was recorded until \\S*22:13:20Z"),
        (
            {"start": "2020-01-01T00:00:00", "duration": 1},
            r"nothing was recorded from \S+ until \S+1Z\.",
        ),
        ({"start": "9999999999999999999"}, "is not a valid time"),
        ({"duration": "0"}, "is not a number of seconds"),
    ],
)
def test_what_is_none(asked: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        PackOptions(**asked).slice_times(START, START + 3 * 10**9, "drive.bag")
