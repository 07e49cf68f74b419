"""Cameras in two videos: any exact video may be away, and is back when its file is; views may not.

The dataset is one of the conformance suite, so that nothing is packed here.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any
from zlib import crc32

import av
import numpy as np
import pytest
from mcap.reader import make_reader

import jail
import mp4ds
from commands import call
from edits import agreed, changed, flip
from mp4ds import FormatError, OptionError, SourceError, UnpackOptions
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.video.media import new_mp4

CASE = Path(__file__).parents[1] / "conformance" / "cases" / "datasets" / "views"
EXPECTED: list[dict[str, Any]] = json.loads((CASE / "expected.json").read_text())["streams"]
STEMS = [stream["sidecar"].removesuffix(".yaml") for stream in EXPECTED]
TOPICS = [stream["topic"] for stream in EXPECTED]
ONE = STEMS[0]
AWAY = [[ONE], STEMS[1:3], STEMS]
VISUAL = UnpackOptions(quality="visual")


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return Path(shutil.copytree(CASE, tmp_path / "dataset"))


def exact(dataset: Path, stem: str) -> Path:
    return dataset / f"{stem}.exact.mp4"


def view(dataset: Path, stem: str) -> Path:
    return dataset / f"{stem}.mp4"


def unpacked(dataset: Path, options: UnpackOptions | None = None) -> dict[str, list[bytes]]:
    """The payloads of each topic, by log time."""
    path = dataset.with_name("again.mcap")
    path.unlink(missing_ok=True)
    mp4ds.unpack(dataset, "mcap", path, options)
    found: dict[str, list[bytes]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append(message.data)
    return found


def hashes(payloads: dict[str, list[bytes]]) -> dict[str, list[str]]:
    return {
        topic: [hashlib.sha256(payload).hexdigest() for payload in found]
        for topic, found in payloads.items()
    }


RECORDED = {stream["topic"]: stream["payloads"] for stream in EXPECTED}


# ---------------------------------------------------------------- exact videos that are away


@pytest.mark.parametrize("stems", AWAY, ids=len)
def test_any_exact_videos_may_be_away(stems: Sequence[str], dataset: Path) -> None:
    size = sum(exact(dataset, stem).stat().st_size for stem in stems)
    for stem in stems:
        exact(dataset, stem).rename(dataset.parent / f"{stem}.exact.mp4")
    absence = f"exact layer not here: {len(stems)} file{'s' * (len(stems) > 1)}, {size / 1000:.1f} "
    for deep in (False, True):
        assert mp4ds.validate(dataset, deep=deep) == []
        assert absence in call("validate", dataset, *(["--deep"] if deep else [])).out
    assert absence in call("info", dataset).out
    with pytest.raises(SourceError, match=absence) as caught:
        mp4ds.unpack(dataset, "mcap", dataset.with_name("refused.mcap"))
    assert "`quality` visual" in str(caught.value)
    assert not dataset.with_name("refused.mcap").exists()
    for stem in stems:
        (dataset.parent / f"{stem}.exact.mp4").rename(exact(dataset, stem))
    assert "exact layer" not in call("validate", dataset).out
    assert hashes(unpacked(dataset)) == RECORDED


@pytest.mark.parametrize("topic", TOPICS)
def test_without_it_a_topic_is_what_its_view_shows(topic: str, dataset: Path) -> None:
    with mp4ds.open(dataset) as whole:
        shown = whole[topic].read(range(3), format="native", layer="view")
        recorded = [frame.data.copy() for frame in whole[topic]]
    exact(dataset, STEMS[TOPICS.index(topic)]).unlink()
    with mp4ds.open(dataset) as rest:
        assert rest.streams[TOPICS.index(topic)].sidecar.profile == "visual"
        seen = [frame.data.copy() for frame in rest[topic]]
        assert all(one.layer == "exact" for one in rest.streams if one.topic != topic)
    assert np.array_equal(seen, shown)
    assert not np.array_equal(seen, recorded)


def test_of_views_everything_but_the_pixels_is_unpacked(dataset: Path) -> None:
    recorded = unpacked(dataset)
    seen = unpacked(dataset, VISUAL)
    for stem in STEMS:
        exact(dataset, stem).unlink()
    assert unpacked(dataset, VISUAL) == seen
    for stream in EXPECTED:
        image, topic = stream["image"], stream["topic"]
        body = ENCODINGS[image["encoding"]].size(image["step"], image["height"])
        for one, other in zip(seen[topic], recorded[topic], strict=True):
            assert one != other
            assert one[:-body] == other[:-body]
            assert len(one) == len(other)


def test_exact_frames_that_are_asked_for_and_away(dataset: Path) -> None:
    exact(dataset, ONE).unlink()
    with mp4ds.open(dataset, layer="exact") as opened:
        opened[TOPICS[1]].read([0])
        with pytest.raises(
            OptionError, match=rf"no exact frames here: {ONE}\.exact\.mp4 is missing"
        ):
            opened[TOPICS[0]].read([0])
    named = f"exact layer not here: 1 file, .*: {ONE}\\.exact\\.mp4"
    with pytest.raises(SourceError, match=named):  # which of several it is
        mp4ds.unpack(dataset, "mcap", dataset.with_name("refused.mcap"))


@pytest.mark.parametrize("place", [view, exact])
def test_frames_of_another_dataset_are_not_read(
    place: Callable[[Path, str], Path], dataset: Path
) -> None:
    """Both decode, and there is no digest of pixels; other sizes tell them apart."""
    whole = place(dataset, ONE)
    with whole.open("ab") as file:
        file.write(bytes([0, 0, 0, 8, *b"free"]))
    with mp4ds.open(dataset) as opened:
        for read in (lambda topic: topic.read([0]), list):
            with pytest.raises(FormatError, match=rf"{whole.name}: has \d+ bytes, but its sidecar"):
                read(opened[TOPICS[0]])


@pytest.mark.parametrize("given", [view, exact])
def test_a_pair_is_found_by_either_video(
    given: Callable[[Path, str], Path], dataset: Path, tmp_path: Path
) -> None:
    for path in (*dataset.glob(f"{ONE}.*"),):
        shutil.copy(path, tmp_path)
    assert mp4ds.validate(given(tmp_path, ONE), deep=True) == []
    with mp4ds.open(given(tmp_path, ONE)) as opened:
        assert [topic.topic for topic in opened] == [TOPICS[0]]
        assert opened.streams[0].layer == "exact"
    exact(tmp_path, ONE).unlink()
    assert mp4ds.validate(view(tmp_path, ONE), deep=True) == []
    with mp4ds.open(view(tmp_path, ONE)) as opened:
        assert opened.streams[0].layer == "view"


# ---------------------------------------------------------------- damage

Damage = Callable[[Path], None]


def lost(dataset: Path) -> None:
    view(dataset, ONE).unlink()


def all_lost(dataset: Path) -> None:
    view(dataset, ONE).unlink()
    exact(dataset, ONE).unlink()


def altered_view(dataset: Path) -> None:
    flip(view(dataset, ONE))


def altered_exact(dataset: Path) -> None:
    flip(exact(dataset, ONE))


def cut_exact(dataset: Path) -> None:
    path = exact(dataset, ONE)
    path.write_bytes(path.read_bytes()[:-100])


def exchanged(dataset: Path) -> None:
    own, other = exact(dataset, ONE), exact(dataset, STEMS[1])
    own.rename(dataset / "other")
    other.rename(own)
    (dataset / "other").rename(other)


def folder_for_exact(dataset: Path) -> None:
    exact(dataset, ONE).unlink()
    exact(dataset, ONE).mkdir()


def pipe_for_exact(dataset: Path) -> None:
    exact(dataset, ONE).unlink()
    os.mkfifo(exact(dataset, ONE))


def view_for_exact(dataset: Path) -> None:
    shutil.copy(view(dataset, ONE), exact(dataset, ONE))


DAMAGES: dict[Damage, tuple[str, str]] = {
    lost: ("file-missing", ".mp4"),
    all_lost: ("file-missing", ".mp4"),
    altered_view: ("hash-mismatch", ".mp4"),
    altered_exact: ("hash-mismatch", ".exact.mp4"),
    cut_exact: ("size-mismatch", ".exact.mp4"),
    exchanged: ("size-mismatch", ".exact.mp4"),
    folder_for_exact: ("file-missing", ".exact.mp4"),
    pipe_for_exact: ("file-missing", ".exact.mp4"),
    view_for_exact: ("size-mismatch", ".exact.mp4"),
}


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_damage_is_found_and_never_unpacked(damage: Damage, dataset: Path) -> None:
    damage(dataset)
    code, suffix = DAMAGES[damage]
    problems = mp4ds.validate(dataset, deep=True)
    assert (code, str(dataset / f"{ONE}{suffix}")) in [(one.code, one.place) for one in problems]
    out = dataset.with_name("again.mcap")
    with pytest.raises((FormatError, SourceError)):
        mp4ds.unpack(dataset, "mcap", out)
    assert not out.exists()
    if suffix == ".exact.mp4":
        unpacked(dataset, VISUAL)  # which needs none of it
    rest = unpacked(dataset, UnpackOptions(exclude=(TOPICS[0], TOPICS[1])))
    assert hashes(rest) == {topic: RECORDED[topic] for topic in TOPICS[2:]}


@pytest.mark.parametrize("damage", [lost, altered_view], ids=lambda damage: damage.__name__)
def test_a_damaged_view_is_not_unpacked_alone(damage: Damage, dataset: Path) -> None:
    damage(dataset)
    exact(dataset, ONE).unlink()
    assert mp4ds.validate(dataset, deep=True) != []
    with pytest.raises(FormatError):
        unpacked(dataset, VISUAL)


def test_an_exact_video_of_another_stream_is_found_by_digests(dataset: Path) -> None:
    """Even if all sizes and hashes of files say that it belongs there."""
    path = dataset / f"{ONE}.yaml"
    shutil.copy(view(dataset, ONE), exact(dataset, ONE))

    def change(document: dict[str, Any]) -> None:
        for key in ("size", "sha256", "references"):
            document["video"].pop(key, None)
        document["video"] |= {"codec": "av1", "pixel_format": "yuv420p"}
        document["video"] |= {key: document["view"][key] for key in ("width", "height")}

    changed(path, change)
    agreed(dataset)
    codes = {problem.code for problem in mp4ds.validate(dataset, deep=True)}
    assert codes <= {"digest-mismatch", "codec-mismatch"}
    assert codes
    with pytest.raises(FormatError):
        unpacked(dataset)


# ---------------------------------------------------------------- larger than it says


def png_file(width: int, height: int, color_type: int, depth: int) -> bytes:
    """A PNG of zeros."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", crc32(name + data))

    row = bytes(1 + width * depth // 8 * {0: 1, 6: 4}[color_type])
    deflate = zlib.compressobj(1)
    data = b"".join(deflate.compress(row) for _ in range(height)) + deflate.flush()
    header = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


@pytest.fixture(scope="module")
def huge() -> bytes:
    return png_file(16000, 8000, 6, 16)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("place", [2, 0])
def test_a_picture_of_a_gigabyte_is_not_made(place: int, huge: bytes, dataset: Path) -> None:
    """Neither when ffmpeg opens the video, nor later, though 4 MB are all that it takes."""
    width, height = EXPECTED[0]["coded_size"]
    files = [png_file(width, height, 0, 8)] * 3
    files[place] = huge
    with new_mp4(exact(dataset, ONE)) as container:
        stream = container.add_mux_stream("png", rate=30, width=width, height=height)
        for number, data in enumerate(files):
            packet = av.Packet(data)
            packet.pts = packet.dts = number
            packet.stream, packet.time_base, packet.is_keyframe = stream, Fraction(1, 30), True
            container.mux(packet)

    def change(document: dict[str, Any]) -> None:
        document["video"] |= {"codec": "png", "pixel_format": "gray"}
        for key in ("size", "sha256", "references"):
            document["video"].pop(key, None)

    changed(dataset / f"{ONE}.yaml", change)
    agreed(dataset)
    for path in (dataset, dataset / f"{ONE}.yaml"):
        found = jail.validate(path)
        assert set(found.codes) <= {"decode-failed", "digest-mismatch", "geometry-mismatch"}
        assert found.codes
        assert jail.read(path).ours
