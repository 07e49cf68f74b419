"""A dataset packed again: what was exact stays so, and the manifest tells where it comes from."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from coded_scenes import CODED
from compare import compare
from mp4ds.errors import SourceError
from mp4ds.format.manifest import Manifest
from mp4ds.format.sidecars import load_manifest
from mp4ds.packing.options import PackOptions
from mp4ds.packing.planning import open_recording
from mp4ds.plugins.info import info
from mp4ds.records import Excerpt, Message
from mp4ds.unpacking.unpack import UnpackOptions
from round_trips import journey, own_target, unpacked
from sources import PERIOD, SOURCES, START, TRAITS, odd_scene, scene, write_bag

ROOT = Path(__file__).parents[1]


def manifest(dataset: Path) -> Manifest:
    return load_manifest(dataset / "dataset.yaml")


def codec(dataset: Path, topic: str = "/camera/image_raw") -> str:
    with mp4ds.open(dataset) as opened:
        return next(one.sidecar.video.codec for one in opened.streams if one.topic == topic)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    write_bag(tmp_path / "drive.bag", scene("rgb8", frames=12))
    return tmp_path / "drive.bag"


def images(dataset: Path) -> list[str]:
    with mp4ds.open(dataset) as opened:
        return opened.topics


@pytest.mark.one_in(8)
@pytest.mark.parametrize("source", SOURCES)
def test_what_was_exact_stays_so(source: str, tmp_path: Path) -> None:
    first = tmp_path / "first"
    first.mkdir()
    before = journey(first, SOURCES[source], scene("mono16"), own_target(source))
    (topic,) = images(before.dataset)
    mp4ds.pack(before.dataset, tmp_path / "dataset", PackOptions(codec="ffv1"))
    assert codec(tmp_path / "dataset", topic) == "ffv1"
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(before.sources, unpacked(tmp_path, own_target(source))) == []
    told, known = manifest(tmp_path / "dataset"), manifest(before.dataset)
    assert told.sources == known.sources
    digest = hashlib.sha256((before.dataset / "dataset.yaml").read_bytes()).hexdigest()
    (earlier,) = told.derived_from
    assert (earlier.name, earlier.profile, earlier.sha256) == ("dataset", "lossless", digest)
    for fact in ("format", "recording_profile", "library", "messages", "time_range", "transforms"):
        assert getattr(told, fact) == getattr(known, fact)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("trait", TRAITS)
def test_odd_recordings(trait: str, tmp_path: Path) -> None:
    first = tmp_path / "first"
    first.mkdir()
    before = journey(first, SOURCES["bag-lz4"], odd_scene(trait), "bag")
    mp4ds.pack(before.dataset, tmp_path / "dataset", PackOptions(codec="ffv1"))
    assert compare(before.sources, unpacked(tmp_path, "bag")) == []


@pytest.mark.one_in(10)
@pytest.mark.parametrize("kind", CODED)
def test_coded_images(kind: str, tmp_path: Path) -> None:
    first = tmp_path / "first"
    first.mkdir()
    before = journey(first, SOURCES["mcap-ros2-zstd"], CODED[kind](frames=6), "mcap")
    mp4ds.pack(before.dataset, tmp_path / "dataset")
    assert compare(before.sources, unpacked(tmp_path, "mcap")) == []


def test_vp9_of_version_1(tmp_path: Path) -> None:
    """Its packets are read, and copied; anew they are stored as messages."""
    case, topic = ROOT / "conformance/cases/datasets/packets", "/video_vp9/cam/video"
    mp4ds.unpack(case, "mcap", tmp_path / "first.mcap")
    for name, source, verbatim in (
        ("copied", case, {}),
        ("anew", tmp_path / "first.mcap", {"its codec 'vp9' is not one that becomes a video": 4}),
    ):
        made = mp4ds.pack(source, tmp_path / name)
        (told,) = (one for one in made.topics if one.topic == topic)
        assert {why: count for why, (count, _) in told.verbatim.items()} == verbatim
        assert mp4ds.validate(tmp_path / name, deep=True) == []
        mp4ds.unpack(tmp_path / name, "mcap", tmp_path / "again.mcap", UnpackOptions(force=True))
        assert compare([tmp_path / "first.mcap"], [tmp_path / "again.mcap"]) == []


def test_log_times_that_do_not_tell_the_order(tmp_path: Path) -> None:
    """Messages of equal times in different files: such a dataset is read as a whole."""
    made = odd_scene("encoding-change")
    equal = [
        replace(record, log_time=START + n // 6 * PERIOD) for n, record in enumerate(made.messages)
    ]
    sources = SOURCES["bag-lz4"](tmp_path, replace(made, messages=equal))
    mp4ds.pack(sources, tmp_path / "first")
    with open_recording([tmp_path / "first"]) as reader:
        assert not reader.is_indexed
    mp4ds.pack(tmp_path / "first", tmp_path / "dataset", PackOptions(window=2))
    assert compare(sources, unpacked(tmp_path, "bag")) == []


def test_a_lossy_one_stays_as_it_was_asked_for(recording: Path, tmp_path: Path) -> None:
    mp4ds.pack(recording, tmp_path / "eye", PackOptions(quality="visual"))
    mp4ds.pack(tmp_path / "eye", tmp_path / "again")
    assert manifest(tmp_path / "again").profile == "visual"
    (topic,) = images(tmp_path / "eye")
    mp4ds.pack(tmp_path / "eye", tmp_path / "kept", PackOptions(quality="lossless"))
    mp4ds.pack(tmp_path / "kept", tmp_path / "fast", PackOptions(purpose="training"))
    told = manifest(tmp_path / "fast")
    assert [(item.name, item.profile) for item in told.derived_from] == [
        ("eye", "visual"),
        ("kept", "lossless"),
    ]
    assert [item.name for item in told.sources] == [recording.name]
    with mp4ds.open(tmp_path / "eye") as eye, mp4ds.open(tmp_path / "fast") as fast:
        numbers = range(len(eye[topic]))
        assert (eye[topic].read(numbers) == fast[topic].read(numbers)).all()
    found = info(tmp_path / "fast")
    assert "repacked from eye (visual), kept (lossless)" in found.notes


def test_views_are_not_taken_for_what_was_recorded(recording: Path, tmp_path: Path) -> None:
    mp4ds.pack(recording, tmp_path / "exact")
    (video,) = (tmp_path / "exact").glob("*.exact.mp4")
    video.unlink()
    for options in ({}, {"codec": "ffv1"}, {"quality": "crf=30"}, {"quality": "psnr=40"}):
        with pytest.raises(SourceError, match=r"has views only .* give `quality` visual to go on"):
            mp4ds.pack(tmp_path / "exact", tmp_path / "again", PackOptions(**options))
        assert not (tmp_path / "again").exists()
    mp4ds.pack(tmp_path / "exact", tmp_path / "again", PackOptions(quality="visual"))
    assert manifest(tmp_path / "again").profile == "visual"
    anew = PackOptions(quality="visual", preset="9", window=5)
    mp4ds.pack(tmp_path / "exact", tmp_path / "anew", anew)
    assert mp4ds.validate(tmp_path / "anew", deep=True) == []
    mp4ds.pack(tmp_path / "exact", tmp_path / "rest", PackOptions(exclude=["/cam/*"]))
    assert manifest(tmp_path / "rest").profile == "lossless"


def edit_sidecar(dataset: Path) -> Path:
    """Change a frame_id as an editor would, without the line that tells of it."""
    path = next(dataset.glob("*image_raw.yaml"))
    lines = path.read_text().replace("frame_id: c", "frame_id: k", 1).splitlines(keepends=True)
    path.write_text("".join(line for line in lines if not line.startswith("checksum: ")))
    with mp4ds.open(dataset) as opened:  # which looks valid
        assert opened.streams[0].sidecar.headers[0].frame_id.startswith("k")
    return path


def edit_messages(dataset: Path) -> Path:
    """Change what no checksum inside of the file protects."""
    path = dataset / "messages.mcap"
    path.write_bytes(path.read_bytes().replace(b"mp4ds", b"mp4dz", 1))
    return path


def edit_video(dataset: Path) -> Path:
    """The same."""
    path = next(dataset.glob("*.mp4"))
    path.write_bytes(path.read_bytes().replace(b"VideoHandler", b"VideoHandles", 1))
    return path


WAYS: dict[str, dict[str, Any]] = {
    "copy": {},
    "slice": {"start": 0.2},
    "topics": {"exclude": ["/imu"]},
    "encode": {"quality": "crf=30"},
    "encode-slice": {"quality": "crf=30", "start": 0.2},
    "encode-parts": {"quality": "crf=30", "window": 4},
    "join": {"quality": "crf=30"},
}


@pytest.fixture(scope="module")
def lossy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset whose frames have no digests; not to be changed."""
    folder = tmp_path_factory.mktemp("lossy")
    write_bag(folder / "drive.bag", scene("rgb8", frames=12))
    mp4ds.pack(folder / "drive.bag", folder / "drive", PackOptions(quality="crf=30", codec="h264"))
    return folder / "drive"


@pytest.mark.parametrize(
    "edit", [edit_sidecar, edit_messages, edit_video], ids=lambda one: one.__name__
)
@pytest.mark.parametrize("way", WAYS)
def test_no_manifest_vouches_for_what_was_changed(
    way: str, edit: Callable[[Path], Path], lossy: Path, tmp_path: Path
) -> None:
    changed = edit(Path(shutil.copytree(lossy, tmp_path / "changed")))
    sources = [tmp_path / "changed", *([lossy] if way == "join" else [])]
    options = PackOptions(codec="h264" if "quality" in WAYS[way] else None, **WAYS[way])
    with pytest.raises(mp4ds.FormatError, match=r"--deep` lists what is damaged") as caught:
        mp4ds.pack(sources, tmp_path / "again", options)
    assert str(changed) in str(caught.value)
    assert caught.value.code in ("size-mismatch", "hash-mismatch")
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    "options", [UnpackOptions(), UnpackOptions(start=0.2)], ids=["whole", "slice"]
)
def test_a_changed_sidecar_is_not_unpacked(
    options: UnpackOptions, lossy: Path, tmp_path: Path
) -> None:
    changed = edit_sidecar(Path(shutil.copytree(lossy, tmp_path / "changed")))
    with pytest.raises(mp4ds.FormatError, match=f"{changed}.*manifest"):
        mp4ds.unpack(tmp_path / "changed", "bag", tmp_path / "again", options)
    with pytest.raises(mp4ds.FormatError, match=f"{changed}.*manifest"):
        mp4ds.export(tmp_path / "changed", "images", tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_who_made_it(recording: Path, tmp_path: Path) -> None:
    told = tmp_path / "about.yaml"
    told.write_text(
        "title: A drive\nlicense: CC0-1.0\nkeywords: [a, b]\nauthors: [{name: A lab}]\n"
    )
    mp4ds.pack(recording, tmp_path / "whole", PackOptions(about=str(told)))
    mp4ds.pack(tmp_path / "whole", tmp_path / "again", PackOptions(window=4))
    for dataset in ("whole", "again"):
        about = manifest(tmp_path / dataset).about
        assert about is not None
        assert (about.title, about.license, about.keywords) == ("A drive", "CC0-1.0", ["a", "b"])
        assert {"title: A drive", "authors: A lab"} <= set(info(tmp_path / dataset).notes)
    mp4ds.pack([tmp_path / "whole", recording], tmp_path / "more")
    assert manifest(tmp_path / "more").about == manifest(tmp_path / "whole").about


def test_excerpts_add_up(recording: Path, tmp_path: Path) -> None:
    mp4ds.pack(recording, tmp_path / "whole")
    with open_recording([tmp_path / "whole" / "dataset.yaml"]) as reader:
        assert reader.is_indexed
        everything = list(reader.records())
        times = sorted(record.log_time for record in everything if isinstance(record, Message))
        middle = times[len(times) // 2]
        parts = [
            record
            for span in (Excerpt(end=middle), Excerpt(start=middle, others=False))
            for record in reader.records(span)
        ]
        by_topic = [
            {
                topic: [bytes(one.data) for one in found if one.channel.topic == topic]
                for topic in {channel.topic for channel in reader.channels}
            }
            for found in (everything, parts)
        ]
        assert by_topic[0] == by_topic[1]
        for channel in filter(lambda channel: by_topic[0][channel.topic], reader.channels):
            first = reader.first(channel)
            assert first is not None
            assert bytes(first.data) == by_topic[0][channel.topic][0]
