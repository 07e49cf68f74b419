"""Views of streams: which ones get one, what it shows, and what is left without the exact video."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

import mp4ds
import reader
from coded_scenes import CODED, FRAMES, ODD
from commands import call, refused, unchanged
from compare import compare
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from in_parts import IN_PARTS, InlineExecutor, use
from mp4ds.errors import FormatError, Mp4dsError, OptionError, SourceError
from mp4ds.format.models import StreamSidecar
from mp4ds.packing.options import PackOptions
from mp4ds.unpacking.unpack import UnpackOptions
from round_trips import journey, unpacked
from sources import SOURCES, scene

ROS2 = "mcap-ros2-zstd"
RAW = "/cam/image_raw"
VISUAL = UnpackOptions(quality="visual")


@pytest.fixture(autouse=True)
def executor(monkeypatch: pytest.MonkeyPatch) -> InlineExecutor:
    return use(monkeypatch, InlineExecutor())


def sidecars(dataset: Path) -> list[StreamSidecar]:
    with mp4ds.open(dataset) as opened:
        return [stream.sidecar for stream in opened.streams]


def codecs(dataset: Path) -> list[str | None]:
    """The codec of each stream's view."""
    return [one.view and one.view.codec for one in sidecars(dataset)]


def remove_exact(dataset: Path) -> int:
    """Leave the views; returns how many files are gone."""
    found = list(dataset.glob("*.exact.mp4"))
    for path in found:
        path.unlink()
    return len(found)


def distances(dataset: Path) -> Iterator[float]:
    """How much the view of each frame that can be decoded differs from it, on average."""
    with mp4ds.open(dataset) as opened:
        for stream in opened.streams:
            exact = dict(pixels_of(stream))
            shown = dict(pixels_of(stream.in_layer("view")))
            assert [*shown] == [*range(len(stream))]
            for index, pixels in exact.items():
                yield float(np.abs(pixels.astype(float) - shown[index]).mean())


def pixels_of(stream: Any) -> Iterator[tuple[int, Any]]:
    for index, picture in stream.decodable_pictures(is_strict=False):
        if picture is not None:
            yield index, stream.recorded_pixels(picture)


# ---------------------------------------------------------------- which streams get one

VIEWED = [
    *("jpeg-rgb", "jpeg-gray", "jpeg-420", "jpeg-422", "jpeg-444", "jpeg-progressive"),
    *("jpeg-no-huffman-tables", "jpeg-mixed-sizes", "jpeg-exif-trailing", "jpeg-corrupt-one"),
    *("video-h265", "video-h264-headers-apart", "video-h264-resized"),
    *("video-h264-mid-gop", "video-h264-lost", "video-av1-lost", "ffmpeg-libx265"),
    *("ffmpeg-hevc-yuv420p-bgr8-rgb8", "ffmpeg-mjpeg-yuvj420p-bgr8-bgr8"),
]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("view", ["av1", "h264"])
@pytest.mark.parametrize("kind", VIEWED)
def test_what_arrives_coded_has_a_view_if_asked(kind: str, view: str, tmp_path: Path) -> None:
    made = journey(tmp_path, SOURCES[ROS2], CODED[kind](), "mcap", view=view)
    own = view if not kind.startswith(f"video-{view}") else None
    assert set(codecs(made.dataset)) == {own}
    if own:
        assert len(list(made.dataset.glob("*.exact.mp4"))) == len(codecs(made.dataset))
        assert max(distances(made.dataset)) < 12
    remade = tmp_path / "without"
    mp4ds.pack(made.sources, remade, PackOptions())
    assert set(codecs(remade)) == {None}
    exact = {path.name: path.read_bytes() for path in remade.glob("*.mp4")}
    kept = made.dataset.glob("*.exact.mp4" if own else "*.mp4")
    # the packets are those without a view
    assert {path.name.replace(".exact", ""): path.read_bytes() for path in kept} == exact


def without_tables(data: bytes) -> bytes:
    """A JPEG whose Huffman tables have more codes than there can be."""
    start = data.index(b"\xff\xc4") + 5
    return data[:start] + b"\xff" * 16 + data[start + 16 :]


@pytest.mark.parametrize("odd", [0, ODD])
def test_what_cannot_be_decoded_shows_the_picture_before(odd: int, tmp_path: Path) -> None:
    recorded = CODED["jpeg-gray"]()
    own = [record for record in recorded.messages if record.topic == f"{RAW}/compressed"]
    own[odd].values["data"] = without_tables(own[odd].values["data"])
    made = journey(tmp_path, SOURCES[ROS2], recorded, "mcap", view="h264")
    with mp4ds.open(made.dataset, layer="view") as opened:
        frames = opened[f"{RAW}/compressed"].read(range(FRAMES)).astype(float)
    before = frames[odd - 1] if odd else 128
    assert np.abs(frames[odd] - before).mean() < 3
    assert np.abs(frames[odd] - frames[odd + 1]).mean() > 5


@pytest.mark.parametrize(
    ("kind", "view"),
    [
        ("video-av1", "av1"),
        ("video-av1-no-delimiter", "av1"),
        ("ffmpeg-libsvtav1", "av1"),
        ("video-h264", "h264"),
        ("ffmpeg-libx264", "h264"),
    ],
)
def test_packets_that_play_need_no_view(kind: str, view: str, tmp_path: Path) -> None:
    made = journey(tmp_path, SOURCES[ROS2], CODED[kind](), "mcap", view=view)
    assert codecs(made.dataset) == [None]
    notes = [note for topic in made.summary.topics for note in topic.notes]
    assert notes == [f"its own packets are {view} that plays: it needs no view"]


@pytest.mark.parametrize("kind", ["jpeg-rgb", "video-h265", "video-av1"])
@pytest.mark.parametrize("source", FOXGLOVE_SOURCES)
def test_foxglove(kind: str, source: str, tmp_path: Path) -> None:
    made = journey(tmp_path, FOXGLOVE_SOURCES[source], FOXGLOVE[kind](), "mcap", view="h264")
    assert codecs(made.dataset) == ["h264"]
    with mp4ds.open(made.dataset) as opened:
        (topic,) = opened.topics
        recorded = opened.streams[0].channel.type_name
        shown = opened[topic].read(range(FRAMES), format="gray", layer="view").astype(float)
    remove_exact(made.dataset)
    mp4ds.unpack(made.dataset, "mcap", tmp_path / "views.mcap", VISUAL)
    types = {name for name, _ in messages(tmp_path / "views.mcap", topic)}
    # packets of another codec are of ROS 2's type, which Foxglove shows as well
    assert types == {recorded if kind.startswith("jpeg") else "foxglove_msgs/msg/CompressedVideo"}
    mp4ds.pack(tmp_path / "views.mcap", tmp_path / "once more", PackOptions())
    with mp4ds.open(tmp_path / "once more") as opened:
        again = opened[topic].read(range(FRAMES), format="gray").astype(float)
    assert np.abs(again - shown).mean() < 2


SINGLE: dict[str, Any] = {"view": "none"}
CAMERAS = {
    "asked": (scene("mono8"), {"view": "av1"}, "av1"),
    "h264": (scene("bgr8"), {"view": "h264"}, "h264"),
    "its codec is of the exact video": (scene("mono8"), {"view": "av1", "codec": "ffv1"}, "av1"),
    "larger": (scene("rgb8", noisy=False), {"view": "av1"}, "av1"),
    "none": (scene("bayer_rggb8"), SINGLE, None),
    "a measurement": (scene("16UC1"), {"view": "av1"}, None),
    "png": (CODED["png-gray-pillow"](), {"view": "av1"}, "av1"),
}


@pytest.mark.parametrize("case", CAMERAS)
def test_pixels_have_a_view_if_asked(case: str, tmp_path: Path) -> None:
    recorded, options, view = CAMERAS[case]
    made = journey(tmp_path, SOURCES[ROS2], recorded, "mcap", **options)
    assert codecs(made.dataset) == [view]
    (sidecar,) = sidecars(made.dataset)
    assert sidecar.video.codec == options.get("codec", sidecar.video.codec)
    if case == "larger":
        notes = [note for topic in made.summary.topics for note in topic.notes]
        assert [note[:15] for note in notes] == ["with its view a"]


@pytest.mark.parametrize(
    ("words", "view"),
    [
        ((), None),
        (("--view",), "av1"),
        (("--view", "h264"), "h264"),
        (("--view=h264",), "h264"),
        (("--view", "none"), None),
        (("--view", "none", "--quality", "visual"), None),
    ],
)
def test_the_command(words: tuple[str, ...], view: str | None, tmp_path: Path) -> None:
    (source,) = SOURCES[ROS2](tmp_path / "source", CODED["jpeg-rgb"](frames=2))
    done = call("pack", *words, source, "-o", tmp_path / "dataset")
    assert done.code == 0, done.err
    assert codecs(tmp_path / "dataset") == [view]


def test_the_command_refuses(tmp_path: Path) -> None:
    (source,) = SOURCES[ROS2](tmp_path / "source", CODED["jpeg-rgb"](frames=2))
    pack = ("pack", source, "-o", tmp_path / "x", "--view")
    refused(call(*pack, "--for", "speed"), 2, "--for speed encodes nothing twice")
    refused(call(*pack[:-1], "--view=mpeg"), 2, "--view 'mpeg' is not known. Use av1, h264, none")
    mp4ds.pack(source, tmp_path / "small", PackOptions(quality="crf=40", transcode=True))
    pack = ("pack", tmp_path / "small", "-o", tmp_path / "x", "--view")
    refused(call(*pack), 2, "of a dataset of crf=40, the videos are what a view would be")


@pytest.mark.parametrize("size", [(2, 2), (8, 8), (64, 2)])
def test_a_view_that_no_encoder_makes_leaves_the_name(
    size: tuple[int, int], tmp_path: Path
) -> None:
    width, height = size
    images = CODED["jpeg-rgb"](frames=2, width=width, height=height)
    (source,) = SOURCES[ROS2](tmp_path / "source", images)
    mp4ds.pack(source, tmp_path / "dataset", PackOptions(view="av1"))
    assert [path.name for path in (tmp_path / "dataset").glob("*.mp4")] == [
        "cam_image_raw_compressed.mp4"
    ]


# ---------------------------------------------------------------- without the exact video

ALONE = {
    "jpeg-rgb": "jpeg",
    "jpeg-gray": "jpeg",
    "ffmpeg-mjpeg-yuvj420p-bgr8-bgr8": "jpeg",
    "video-h265": "packet",
    "video-h264": "packet",
    "ffmpeg-libx265": "packet",
    "png-gray-pillow": "png",
}
"""Kind -> what the bodies of its messages are where only the view is left."""


@pytest.fixture(scope="module")
def viewed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Folders of a recording of a kind and its dataset with a view; not to be changed."""

    @cache
    def make(kind: str) -> Path:
        folder = tmp_path_factory.mktemp(kind)
        sources = SOURCES[ROS2](folder / "source", CODED[kind]())
        mp4ds.pack(sources, folder / "whole", PackOptions(view="av1"))
        return folder

    return make


@pytest.fixture(params=ALONE)
def alone(
    request: pytest.FixtureRequest, viewed: Callable[[str], Path], tmp_path: Path
) -> tuple[Path, str]:
    """A dataset of views alone, and its kind."""
    dataset = Path(shutil.copytree(viewed(request.param) / "whole", tmp_path / "dataset"))
    assert remove_exact(dataset) == 1
    return dataset, request.param


def test_views_alone_are_a_dataset(alone: tuple[Path, str], tmp_path: Path) -> None:
    dataset, kind = alone
    assert mp4ds.validate(dataset, deep=True) == []
    with mp4ds.open(dataset) as opened:
        (stream,) = opened.streams
        assert (stream.layer, stream.sidecar.body) == ("view", ALONE[kind])
        (topic,) = opened
        assert topic.read([0, -1]).shape[0] == 2
        with pytest.raises(OptionError, match=r"missing\. Copy it to .*, or read the layer 'view'"):
            topic.read([0], layer="exact")
    for command in (("info", dataset), ("validate", "--deep", dataset), ("report", dataset)):
        done = call(*command)
        assert done.code == 0, done.err
    for command in (("unpack", dataset), ("pack", dataset, "-o", tmp_path / "x")):
        refused(call(*command), 2, "has views only (exact layer not here: 1 file", "--quality vis")


def test_another_reader(alone: tuple[Path, str], viewed: Callable[[str], Path]) -> None:
    dataset, kind = alone
    (source,) = (viewed(kind) / "source").iterdir()
    (left,), (whole,) = (
        reader.dataset(path)["streams"] for path in (dataset, viewed(kind) / "whole")
    )
    assert (left["profile"], left["body"], left["payloads"]) == ("visual", ALONE[kind], None)
    assert left["packets"] == whole["view"]["packets"]
    made = [message for _, message in messages(source, whole["topic"])]
    assert whole["payloads"] == [hashlib.sha256(message).hexdigest() for message in made]


def messages(recording: Path, topic: str) -> list[Any]:
    with recording.open("rb") as stream:
        found = make_reader(stream).iter_messages(topics=[topic])
        return [(schema.name, message.data) for schema, _, message in found]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("images", [None, "raw", "jpeg", "png", "compressed-video", "ffmpeg"])
def test_views_alone_are_unpacked(
    alone: tuple[Path, str], images: str | None, tmp_path: Path
) -> None:
    dataset, kind = alone
    with mp4ds.open(dataset) as opened:
        (topic,) = opened.topics
        channel = opened.streams[0].channel
        shown = opened[topic].read(range(FRAMES), format="gray").astype(float)
    output = tmp_path / "again.mcap"
    options = UnpackOptions(quality="visual", images=images)
    summary = mp4ds.unpack(dataset, output=output, options=options)
    made = topic if topic not in summary.republished else summary.republished[topic].topic
    found = messages(output, made)
    assert len(found) == FRAMES
    if images is None:
        assert {name for name, _ in found} == {channel.type_name}
        assert not summary.as_recorded
    mp4ds.pack(output, tmp_path / "once more", PackOptions())
    with mp4ds.open(tmp_path / "once more") as opened:
        again = opened[made].read(range(FRAMES), format="gray").astype(float)
        sidecar = opened.streams[0].sidecar
    assert np.abs(again - shown).mean() < 2
    if ALONE[kind] == "packet" and images is None:
        assert sidecar.video.codec == "av1"
        assert all("av1" in str(header.format) for header in sidecar.headers)
        if channel.type_name.endswith("FFMPEGPacket"):
            assert {header.format for header in sidecar.headers} == {"av1;yuv420p;bgr8;rgb8"}


@pytest.mark.parametrize("options", [{"quality": "crf=40"}, {"quality": "psnr=20"}])
def test_views_alone_are_encoded_again(
    alone: tuple[Path, str], options: dict[str, Any], tmp_path: Path
) -> None:
    dataset, kind = alone
    copy, again = tmp_path / "copy", tmp_path / "again"
    with pytest.raises(SourceError, match="has views only"):  # which may be an oversight
        mp4ds.pack(dataset, again, PackOptions(**options))
    mp4ds.pack(dataset, copy, PackOptions(quality="visual"))
    if ALONE[kind] == "packet":
        with unchanged(tmp_path), pytest.raises(OptionError, match=r"packets of /\S+ are not here"):
            mp4ds.pack(copy, again, PackOptions(**options))
        return
    mp4ds.pack(copy, again, PackOptions(**options))
    assert {one.profile for one in sidecars(again)} == {options["quality"]}
    assert mp4ds.validate(again, deep=True) == []


@pytest.mark.parametrize("view", [False, True])
def test_both_videos_are_validated(view: bool, tmp_path: Path) -> None:
    (source,) = SOURCES[ROS2](tmp_path / "source", CODED["jpeg-rgb"]())
    dataset = tmp_path / "dataset"
    mp4ds.pack(source, dataset, PackOptions(view="av1"))
    (video,) = (path for path in dataset.glob("*.mp4") if (".exact" in path.name) is not view)
    data = bytearray(video.read_bytes())
    middle = data.index(b"mdat") + len(data) // 3
    data[middle : middle + 40] = bytes(40)
    video.write_bytes(data)
    told = mp4ds.validate(dataset, deep=True)
    assert {Path(problem.place.split(" ")[0]).name for problem in told} >= {video.name}
    if view:  # what was recorded is there all the same
        assert compare([source], unpacked(tmp_path, "mcap")) == []
    else:
        with pytest.raises(FormatError, match="differs from what was recorded"):
            unpacked(tmp_path, "mcap")


# ---------------------------------------------------------------- packed again

LATER: dict[str, tuple[Any, dict[str, Any]]] = {
    "jpeg": (CODED["jpeg-rgb"], {}),
    "packets": (CODED["video-h265"], {}),
    "recorded fast": (lambda: scene("bgr8"), {"purpose": "speed"}),
    "png": (CODED["png-gray-pillow"], {"view": "none"}),
}


@pytest.mark.parametrize("case", LATER)
def test_views_come_and_go(case: str, tmp_path: Path) -> None:
    make, options = LATER[case]
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    made = journey(first, SOURCES[ROS2], make(), "mcap", **options)
    assert codecs(made.dataset) == [None]
    second.mkdir()
    mp4ds.pack(made.dataset, second / "dataset", PackOptions(view="h264"))
    assert codecs(second / "dataset") == ["h264"]
    assert mp4ds.validate(second / "dataset", deep=True) == []
    assert compare(made.sources, unpacked(second, "mcap")) == []
    mp4ds.pack(second / "dataset", tmp_path / "dataset", PackOptions(view="none"))
    assert mp4ds.pack(tmp_path / "dataset", tmp_path / "copy", PackOptions(view="none")).is_copy
    assert codecs(tmp_path / "dataset") == [None]
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(made.sources, unpacked(tmp_path, "mcap")) == []


@pytest.mark.parametrize("window", [None, 4])
def test_views_are_added_only_where_they_are_missing(window: int | None, tmp_path: Path) -> None:
    (raw,) = SOURCES[ROS2](tmp_path / "raw", scene("bgr8"))
    (jpeg,) = SOURCES[ROS2](tmp_path / "jpeg", CODED["jpeg-rgb"]())
    first = tmp_path / "first"
    mp4ds.pack([raw, jpeg], first, PackOptions(gop=5))  # encoded again, its packets would differ
    assert codecs(first) == [None, "av1"]
    mp4ds.pack(first, tmp_path / "dataset", PackOptions(view="av1", window=window))
    assert codecs(tmp_path / "dataset") == ["av1", "av1"]
    own = [*first.glob("cam_image_raw.*")]
    assert len(own) == 3
    assert all(path.read_bytes() == (tmp_path / "dataset" / path.name).read_bytes() for path in own)
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare([raw, jpeg], unpacked(tmp_path, "mcap")) == []


KEPT: dict[str, tuple[dict[str, Any], list[str | None], int]] = {
    "as it is": ({}, ["av1"], 1),
    "a slice": ({"start": "0.1", "duration": "0.1"}, ["av1"], 1),
    "that view again": ({"view": "av1"}, ["av1"], 1),
    "visual": ({"quality": "visual"}, ["av1"], 1),
    "visual and transcoded": ({"quality": "visual", "transcode": True}, [None], 0),
}
"""Options -> views of the dataset that is made, and files with its exact videos."""


@pytest.mark.parametrize("case", KEPT)
def test_copies(case: str, tmp_path: Path) -> None:
    options, views, exact = KEPT[case]
    (source,) = SOURCES[ROS2](tmp_path / "source", CODED["jpeg-rgb"]())
    mp4ds.pack(source, tmp_path / "first", PackOptions(view="av1"))
    summary = mp4ds.pack(tmp_path / "first", tmp_path / "dataset", PackOptions(**options))
    assert summary.is_copy
    assert codecs(tmp_path / "dataset") == views
    assert len(list((tmp_path / "dataset").glob("*.exact.mp4"))) == exact
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    if exact:
        assert max(distances(tmp_path / "dataset")) < 12


@pytest.mark.parametrize(
    ("options", "view"),
    [({"gop": 5}, "h264"), ({"view": "av1"}, "av1"), ({"purpose": "speed"}, None)],
)
def test_a_dataset_packed_again_keeps_its_views(
    options: dict[str, Any], view: str | None, tmp_path: Path
) -> None:
    (source,) = SOURCES[ROS2](tmp_path / "source", CODED["jpeg-rgb"]())
    mp4ds.pack(source, tmp_path / "first", PackOptions(view="h264"))
    summary = mp4ds.pack(tmp_path / "first", tmp_path / "dataset", PackOptions(**options))
    assert not summary.is_copy
    assert codecs(tmp_path / "dataset") == [view]


def test_views_alone_are_copied_and_sliced(alone: tuple[Path, str], tmp_path: Path) -> None:
    dataset, kind = alone
    for number, times in enumerate(({}, {"duration": "0.1"}, {"start": "0.1"})):
        made = tmp_path / f"copy {number}"
        options = PackOptions(quality="visual", **times)
        assert mp4ds.pack(dataset, made, options).is_copy
        assert [(one.profile, one.body) for one in sidecars(made)] == [("visual", ALONE[kind])]
        assert mp4ds.validate(made, deep=True) == []


@pytest.mark.parametrize("kind", ["jpeg-rgb", "video-h265"])
def test_long_packs(kind: str, executor: InlineExecutor, tmp_path: Path) -> None:
    options = replace(IN_PARTS, view="av1", codec=None)
    sources = SOURCES[ROS2](tmp_path / "source", CODED[kind]())
    target = tmp_path / "dataset"
    stopped = InlineExecutor(lambda name: name == "00002")
    with pytest.MonkeyPatch.context() as patch:
        use(patch, stopped)
        if kind.startswith("jpeg"):  # packets of a video are one piece
            with pytest.raises(Mp4dsError, match="run the same command again"):
                mp4ds.pack(sources, target, options)
    mp4ds.pack(sources, target, options)
    assert "00002" in executor.ran or not kind.startswith("jpeg")
    assert "00000" not in executor.ran or not kind.startswith("jpeg")
    assert codecs(target) == ["av1"]
    assert [one.frames for one in sidecars(target)] == [FRAMES]
    assert mp4ds.validate(target, deep=True) == []
    assert max(distances(target)) < 12
    assert compare(sources, unpacked(tmp_path, "mcap")) == []


def test_a_view_beside_images_that_it_does_not_predict(tmp_path: Path) -> None:
    case = Path(__file__).parents[1] / "conformance/cases/datasets/views-beside"
    mp4ds.unpack(case, "mcap", tmp_path / "drive.mcap")
    mp4ds.pack(tmp_path / "drive.mcap", tmp_path / "dataset", PackOptions(view="av1"))
    (sidecar,) = sidecars(tmp_path / "dataset")
    assert (sidecar.predicted, codecs(tmp_path / "dataset")) == (False, ["av1"])
    assert sidecar.view is not None
    assert sidecar.view.options["preset"] == "9"
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(tmp_path / "drive.mcap", unpacked(tmp_path, "mcap")) == []
    with mp4ds.open(tmp_path / "dataset") as opened:
        (topic,) = opened
        seen = topic.read([2], layer="view")
        assert not np.array_equal(topic.read([2]), seen)
    (tmp_path / "dataset" / sidecar.video.file).unlink()
    with mp4ds.open(tmp_path / "dataset") as opened:
        (topic,) = opened
        assert np.array_equal(topic.read([2]), seen)
