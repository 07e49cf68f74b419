"""Videos of parts of a stream joined into one: as if they had never been apart."""

from __future__ import annotations

import itertools
import os
import shutil
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from chromium import Tab, played, video_player
from coded_tools import ENCODINGS, IN_ORDER, hide, jpeg
from coded_tools import encode as encode_packets
from coded_tools import scene as packet_scene
from commands import ROOT, program
from mp4ds.errors import Mp4dsError, VideoError
from mp4ds.video.codecs import Recipe, recipe_for
from mp4ds.video.packets import PacketReader, PacketWriter, entry_of, join_segments
from pictures import blocks as means_of_blocks
from test_packets import write as write_packets
from test_video import LOSSLESS, LOSSY, decode, encode, noise, same, scene_pictures, video_decoder

GOP = 4
WIDTH, HEIGHT = 66, 50  # x265 takes no fewer than 64 columns
LENGTHS = (6, 1, 5)
TOTAL = sum(LENGTHS)
THREADS = (1, 3, 2)
STEP = 33_333
KINDS = [
    *((codec, picture_format, True) for codec, picture_format in LOSSLESS),
    *((codec, picture_format, False) for codec in LOSSY for picture_format in ("rgb24", "yuv420p")),
]
IDS = [f"{kind[0]}-{kind[1]}-{'lossless' if kind[2] else 'lossy'}" for kind in KINDS]
TESTS = Path(__file__).parent


def recipe_of(kind: tuple[str, str, bool]) -> Recipe:
    codec, picture_format, lossless = kind
    return recipe_for(picture_format, lossless=lossless, codec=codec, crf=25)


@cache
def pictures_of(kind: tuple[str, str, bool]) -> list[Any]:
    """Noise where it comes back, a moving scene where it is only to look alike."""
    _, picture_format, lossless = kind
    if lossless:
        return noise(picture_format, WIDTH, HEIGHT, TOTAL)
    if picture_format == "rgb24":
        return scene_pictures("rgb8", WIDTH, HEIGHT, TOTAL)
    colours = scene_pictures("nv12", WIDTH, HEIGHT, TOTAL)
    return [(p[:HEIGHT], p[HEIGHT:, ::2].copy(), p[HEIGHT:, 1::2].copy()) for p in colours]


def edges() -> list[tuple[int, int]]:
    """First and last frame of each segment, half-open."""
    ends = list(itertools.accumulate(LENGTHS))
    return list(zip([0, *ends[:-1]], ends, strict=True))


def make_segment(path: Path, kind: tuple[str, str, bool], number: int) -> dict[str, Any]:
    """Encode one segment, each with other threads and from another time on."""
    begin, end = edges()[number]
    return encode(
        path,
        recipe_of(kind),
        pictures_of(kind)[begin:end],
        kind[1],
        ticks=[n * STEP for n in range(begin, end)],
        gop=GOP,
        threads=THREADS[number],
    )


def make_elsewhere(folder: str) -> None:
    """The middle segment of every kind; called in a process of its own."""
    for kind, name in zip(KINDS, IDS, strict=True):
        make_segment(Path(folder) / f"{name}.mp4", kind, 1)


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Segments that another process has encoded."""
    folder = tmp_path_factory.mktemp("elsewhere")
    code = f"import test_join; test_join.make_elsewhere({str(folder)!r})"
    path = os.pathsep.join(map(str, (ROOT, TESTS.parent / "conformance")))
    program("-c", code, cwd=TESTS, env={"PYTHONPATH": path})
    return folder


def told_of(kind: tuple[str, str, bool], told: dict[str, Any], frames: int) -> dict[str, Any]:
    recipe = recipe_of(kind)
    return {**told, "frames": frames, "matrix": recipe.matrix, "full_range": recipe.full_range}


# ---------------------------------------------------------------- boxes

CONTAINERS = ("moov", "trak", "edts", "mdia", "minf", "stbl", "dinf", "udta")


def boxes(data: bytes, place: str = "") -> Iterator[tuple[str, bytes]]:
    """Leaves of the tree of boxes, by their paths, and of the sample entry its parts."""
    at = 0
    while at < len(data):
        size, name = struct.unpack_from(">I4s", data, at)
        if size == 1:
            (size,) = struct.unpack_from(">Q", data, at + 8)
        body, path = data[at + 8 : at + size], f"{place}/{name.decode()}"
        if name.decode() in CONTAINERS:
            yield from boxes(body, path)
        elif name == b"stsd":
            yield path, body[8:94]
            yield from boxes(body[94:], path)
        else:
            yield path, body
        at += size


def tree(path: Path) -> dict[str, bytes]:
    found = list(boxes(path.read_bytes()))
    assert len(found) == len(dict(found))
    return dict(found)


def differing(a: Path, b: Path) -> set[str]:
    """Names of the boxes that only one has, or that differ."""
    of_a, of_b = tree(a), tree(b)
    kinds = {kind for kind in of_a.keys() | of_b.keys() if of_a.get(kind) != of_b.get(kind)}
    return {kind.rpartition("/")[2] for kind in kinds}


# ---------------------------------------------------------------- videos that are encoded here


Kind = tuple[str, str, bool]
Joined = Callable[[Kind], tuple[Path, list[Path], dict[str, Any]]]
every_kind = pytest.mark.parametrize("kind", KINDS, ids=IDS)


@pytest.fixture(scope="module")
def joined(elsewhere: Path, tmp_path_factory: pytest.TempPathFactory) -> Joined:
    """A joined video of a kind, its segments, and what a decoder is told; made once."""

    @cache
    def make(kind: Kind) -> tuple[Path, list[Path], dict[str, Any]]:
        folder = tmp_path_factory.mktemp("joined")
        segments = [folder / f"{number}.mp4" for number in range(3)]
        told = make_segment(segments[0], kind, 0)
        make_segment(segments[2], kind, 2)
        segments[1] = elsewhere / f"{IDS[KINDS.index(kind)]}.mp4"
        ticks = (number * STEP for number in range(TOTAL))
        join_segments(segments, ticks, folder / "joined.mp4")
        return folder / "joined.mp4", segments, told

    return make


@pytest.mark.one_in(4)
@every_kind
def test_pictures_are_those_of_the_segments(kind: Kind, joined: Joined) -> None:
    target, segments, told = joined(kind)
    expected = [
        picture
        for path, length in zip(segments, LENGTHS, strict=True)
        for picture in decode(path, told_of(kind, told, length))
    ]
    if kind[2]:
        assert all(map(same, expected, pictures_of(kind)))
    all_told = told_of(kind, told, TOTAL)
    found = decode(target, all_told)
    assert len(found) == TOTAL
    assert all(map(same, found, expected))
    with video_decoder(target, **all_told, sequential=False) as decoder:
        for number in (*range(TOTAL), *reversed(range(TOTAL))):
            ((_, picture),) = decoder.pictures_at([number])
            planes = tuple(plane.copy() for plane in picture)
            assert same(planes if len(planes) > 1 else planes[0], expected[number]), number


@pytest.mark.one_in(4)
@every_kind
def test_the_file_is_as_one_encoder_writes_it(kind: Kind, joined: Joined, tmp_path: Path) -> None:
    target, segments, _ = joined(kind)
    uncut = tmp_path / "uncut.mp4"
    ticks = [number * STEP for number in range(TOTAL)]
    encode(uncut, recipe_of(kind), pictures_of(kind), kind[1], ticks=ticks, gop=GOP, threads=2)
    # the packets are others, and of AV1 the index has a box more
    assert differing(uncut, target) <= {"mdat", "stsz", "stss", "stco", "stsc", "btrt", "sdtp"}
    assert entry_of(target) == entry_of(uncut)
    found = tree(target)
    parts = [tree(segment) for segment in segments]
    assert found["/mdat"] == b"".join(part["/mdat"] for part in parts)
    with PacketReader(target, codec=recipe_of(kind).codec, frames=TOTAL) as reader:
        assert list(reader.ticks) == ticks
        keys = [number for number in range(TOTAL) if reader.keyframes[number]]
    expected = [n for begin, end in edges() for n in range(begin, end, GOP)]
    assert keys == expected


# ---------------------------------------------------------------- packets that are copied


def bodies_of(name: str) -> list[tuple[bytes, bool]]:
    """Packets of an encoder and whether each is a key frame, every fourth at least."""
    packets = encode_packets(ENCODINGS[name], frames=14, gop=4)
    codec = ENCODINGS[name].codec
    return [(packet.data, packet.is_key or codec in ("mjpeg", "png")) for packet in packets]


def cut_at_keys(bodies: Sequence[tuple[bytes, bool]]) -> list[list[bytes]]:
    """The bodies in three parts or more, each of which begins with a key frame."""
    parts: list[list[bytes]] = []
    for body, is_key in bodies:
        if is_key and (not parts or len(parts[-1]) > 2):
            parts.append([])
        parts[-1].append(body)
    return parts


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", IN_ORDER)
def test_copied_packets_give_the_uncut_file(name: str, tmp_path: Path) -> None:
    codec = ENCODINGS[name].codec
    bodies = bodies_of(name)
    parts = cut_at_keys(bodies)
    assert len(parts) > 2
    ticks = [number * STEP + number**3 for number in range(len(bodies))]
    segments, at = [], 0
    for number, part in enumerate(parts):
        segments.append(tmp_path / f"{number}.mp4")
        own = [tick - ticks[at] for tick in ticks[at : at + len(part)]]
        write_packets(segments[-1], codec, part, own)
        at += len(part)
    write_packets(tmp_path / "uncut.mp4", codec, [body for body, _ in bodies], ticks)
    target = tmp_path / "joined.mp4"
    join_segments(segments, ticks, target)
    assert target.read_bytes() == (tmp_path / "uncut.mp4").read_bytes()
    with av.open(str(target)) as container:
        frames = list(container.decode(video=0))
    assert [frame.pts for frame in frames] == ticks
    assert not any(frame.is_corrupt for frame in frames)


# ---------------------------------------------------------------- refusals and faults


def small(path: Path, **changes: Any) -> Path:
    """Five frames of noise; returns the path."""
    options: dict[str, Any] = {"codec": "h264", "format": "gray", "size": (64, 48), "gop": 4}
    options |= {"lossless": True, "matrix": None, **changes}
    recipe = recipe_for(
        options["format"], lossless=options["lossless"], codec=options["codec"], crf=20
    )
    if options["matrix"]:
        recipe = Recipe(
            recipe.codec, recipe.encoder, recipe.pixel_format, recipe.lossless, recipe.options,
            options["matrix"], recipe.full_range,
        )  # fmt: skip
    encode(path, recipe, noise(options["format"], *options["size"], 5), options["format"],
           gop=options["gop"])  # fmt: skip
    return path


DIFFERENCES: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "codec": ({}, {"codec": "ffv1"}, r"their codec \(avc1 and FFV1\)"),
    "size": ({}, {"size": (64, 50)}, r"their size \(64x48 and 64x50\)"),
    "bits": ({}, {"format": "gray10le"}, "avcC"),
    "bits of ffv1": ({"codec": "ffv1"}, {"codec": "ffv1", "format": "gray16le"}, "glbl|FFV1"),
    "chroma": ({"format": "yuv420p"}, {"format": "yuv444p"}, "avcC"),
    "order of colours": ({"format": "rgb24"}, {"format": "yuv444p"}, "avcC"),
    "matrix of grey": ({}, {"matrix": "smpte170m"}, r"\(colr\)"),
    "lossless or not": (
        {"format": "yuv420p"}, {"format": "yuv420p", "lossless": False}, "avcC"
    ),
    "no other frames than key frames": ({"codec": "ffv1"}, {"codec": "ffv1", "gop": 1}, "glbl|F"),
}  # fmt: skip


@pytest.mark.parametrize("name", DIFFERENCES)
def test_videos_that_cannot_be_one(name: str, tmp_path: Path) -> None:
    first, other, problem = DIFFERENCES[name]
    segments = [small(tmp_path / "a.mp4", **first), small(tmp_path / "b.mp4", **other)]
    target = tmp_path / "joined.mp4"
    for paths in (segments, [segments[0], *segments], segments[::-1]):
        with pytest.raises(Mp4dsError, match=f"^{paths[-1]}: .* joined to {paths[0]}:"):
            join_segments(paths, range(100), target)
        assert not target.exists()
    with pytest.raises(Mp4dsError, match=problem) as caught:
        join_segments(segments, range(100), target)
    assert str(caught.value).startswith(f"{segments[1]}: ")
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize(("count", "match"), [(9, "5 frames, but 4 are needed"), (11, "10 frames"),
                                              (0, "5 frames, but 0 are needed")])  # fmt: skip
def test_ticks_for_other_frames(count: int, match: str, tmp_path: Path) -> None:
    segment = small(tmp_path / "a.mp4")
    with pytest.raises(VideoError, match=match) as caught:
        join_segments([segment, segment], iter(range(count)), tmp_path / "j.mp4")
    assert caught.value.code == "frame-count"
    assert not (tmp_path / "j.mp4").exists()


def renamed(data: bytes, name: bytes, new: bytes) -> bytes:
    assert data.count(name) == 1
    return data.replace(name, new)


FAULTS = {
    "empty": lambda data: b"",
    "text": lambda data: b"not a video\n" * 100,
    "half": lambda data: data[: len(data) // 2],
    "cut in the index": lambda data: data[:-100],
    "no track": lambda data: renamed(data, b"trak", b"free"),
    "no entry": lambda data: renamed(data, b"stsd", b"free"),
    "no index": lambda data: renamed(data, b"stsz", b"free"),
    "unknown codec": lambda data: renamed(data, b"avc1\0\0\0", b"zzzz\0\0\0"),
    "an entry of no size": lambda data: data.replace(
        data[data.index(b"avcC") - 4 : data.index(b"avcC")], bytes(4)
    ),
    "a box of no size": lambda data: renamed(
        data, data[data.index(b"mdat") - 4 :][:8], b"\0\0\0\7mdat"
    ),
    "several entries": lambda data: renamed(data, b"stsd\0\0\0\0\0\0\0\1", b"stsd\0\0\0\0\0\0\0\2"),
    "no frames": lambda data: empty_index(data),
}


def empty_index(data: bytes) -> bytes:
    at = data.index(b"stsz") + 12
    return data[:at] + bytes(4) + data[at + 4 :]


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_segment_that_cannot_be_read(fault: str, place: int, tmp_path: Path) -> None:
    segments = [small(tmp_path / "a.mp4"), small(tmp_path / "b.mp4")]
    segments[place].write_bytes(FAULTS[fault](segments[place].read_bytes()))
    with pytest.raises(Mp4dsError) as caught:
        join_segments(segments, range(10), tmp_path / "j.mp4")
    if fault != "unknown codec":
        assert isinstance(caught.value, VideoError)
        assert caught.value.place == str(segments[place])
    assert not (tmp_path / "j.mp4").exists()
    if fault == "unknown codec":
        with pytest.raises(VideoError, match="known codec"):
            join_segments([segments[place]], range(5), tmp_path / "j.mp4")


def rewrite(path: Path, codec: str, number: int, damaged: bytes) -> None:
    """Change a packet where it stands."""
    with PacketReader(path, codec=codec) as reader:
        packet = reader.packet(number)
    assert len(damaged) == len(packet)
    path.write_bytes(renamed(path.read_bytes(), packet, damaged))


def test_packets_that_the_muxer_refuses(tmp_path: Path) -> None:
    """VP9 frames that are not shown wait for one that is, but no more than eight."""
    case = TESTS.parent / "conformance/cases/datasets/packets"
    path = Path(shutil.copy(case / "video_vp9_cam_video.mp4", tmp_path))
    with PacketReader(path, codec="vp9") as reader:
        bodies = list(reader.packets())
    for number, body in enumerate(bodies):
        rewrite(path, "vp9", number, hide(body))
    with pytest.raises(VideoError, match=r"packet \d+ is damaged") as caught:
        join_segments([path] * 3, range(3 * len(bodies)), tmp_path / "j.mp4")
    assert caught.value.place == str(path)
    assert not (tmp_path / "j.mp4").exists()


# ---------------------------------------------------------------- large files


def large(path: Path, packets: int, size: int) -> Path:
    """A video of JPEG files with much behind their ends."""
    body = jpeg(next(packet_scene(1)))
    body += bytes(size - len(body))
    with PacketWriter(path, "mjpeg", width=64, height=48, rate=30.0) as writer:
        for number in range(packets):
            writer.write(body, number * STEP, keyframe=True)
    return path


MEASURE = """
import resource, sys
from pathlib import Path
from mp4ds.video.packets import join_segments
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
small, segment, target, count, copies = map(str, sys.argv[1:])
join_segments([Path(small)], range(3), Path(target))
before = peak()
ticks = range(int(count) * int(copies))
join_segments([Path(segment)] * int(copies), ticks, Path(target))
print(peak() - before)
"""


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("packets", "size", "copies", "bound"),
    [(16, 1 << 20, 16, 16 << 20), (15_000, 2_000, 4, 32 << 20)],
    ids=["256 MiB", "60000 packets"],
)
def test_memory_is_bounded(
    packets: int, size: int, copies: int, bound: int, tmp_path: Path
) -> None:
    small = large(tmp_path / "small.mp4", 3, 2_000)
    segment = large(tmp_path / "a.mp4", packets, size)
    target = tmp_path / "j.mp4"
    told = program("-c", MEASURE, small, segment, target, packets, copies, cwd=TESTS).out
    assert target.stat().st_size > packets * size * copies
    assert int(told) < bound


# ---------------------------------------------------------------- a browser

PLAYED = [
    ("h264", "gray", True),
    ("h264", "yuv420p", True),
    *((codec, kind, False) for codec in ("h264", "av1") for kind in ("rgb24", "yuv420p")),
]
PLAYED_IDS = [IDS[KINDS.index(kind)] for kind in PLAYED]
PACKETS_PLAYED = ["h264", "av1"]
SOUGHT = (0, 5, 6, 7, 10, 3)  # the last of a segment, the first, ...


@pytest.fixture(scope="module")
def player(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with video_player(tmp_path_factory.mktemp("player")) as tab:
        yield tab


def joined_in_parts(name: str, folder: Path, ticks: list[int]) -> Path:
    """A video of two or more segments, of pictures or of packets."""
    target, segments = folder / "joined.mp4", []
    if name in PLAYED_IDS:
        kind = PLAYED[PLAYED_IDS.index(name)]
        encoding = {"gray": "mono8", "rgb24": "rgb8", "yuv420p": "nv12"}[kind[1]]
        pictures: list[Any] = scene_pictures(encoding, 96, 66, TOTAL)
        if encoding == "nv12":
            pictures = [(p[:66], p[66:, ::2].copy(), p[66:, 1::2].copy()) for p in pictures]
        for begin, end in edges():
            segments.append(folder / f"{begin}.mp4")
            encode(segments[-1], recipe_of(kind), pictures[begin:end], kind[1], gop=GOP)
    else:
        made = ENCODINGS[name.removeprefix("packets-")]
        packets = [p.data for p in encode_packets(made, frames=TOTAL, width=96, height=66, gop=6)]
        for begin in (0, 6):
            segments.append(folder / f"{begin}.mp4")
            write_packets(segments[-1], made.codec, packets[begin : begin + 6])
    join_segments(segments, ticks, target)
    return target


@pytest.mark.browser
@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", [*PLAYED_IDS, *(f"packets-{name}" for name in PACKETS_PLAYED)])
def test_a_browser_plays_across_the_seams(name: str, player: Tab, tmp_path: Path) -> None:
    ticks = [number * 100_000 for number in range(TOTAL)]
    path = joined_in_parts(name, tmp_path, ticks)
    result = played(player, path, [ticks[number] / 1e6 + 0.05 for number in SOUGHT])
    assert result["size"] == [96, 66]
    assert result["decoded"] == TOTAL
    assert result["ended"] == pytest.approx(result["duration"], abs=0.05)
    with av.open(str(path)) as container:
        luma = [
            np.frombuffer(frame.planes[0], np.uint8).reshape(66, -1)[:, :96].astype(float)
            for frame in container.decode(video=0)
        ]
    blocks = [
        means_of_blocks(np.repeat(plane[..., None], 3, axis=2))[..., 0].ravel() for plane in luma
    ]
    for number, found in zip(SOUGHT, result["frames"], strict=True):
        assert found["mediaTime"] == pytest.approx(number / 10, abs=2e-6)
        shown = np.array(found["means"]).reshape(48, 3) @ (0.2126, 0.7152, 0.0722)
        likeness = [np.corrcoef(shown, block)[0, 1] for block in blocks]
        assert int(np.argmax(likeness)) == number
        assert likeness[number] > 0.95
