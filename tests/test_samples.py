"""The index of an mp4 as it is read here, and as ffmpeg reads it."""

from __future__ import annotations

import io
import os
import random
import struct
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from coded_tools import scene
from conftest import DATA, real
from mp4ds.errors import Refused, VideoError
from mp4ds.times import MAX_GAP_NS, NS_PER_TICK
from mp4ds.video.codecs import recipe_for
from mp4ds.video.mp4 import SampleTable, read_sample_table, sample_table_of
from test_video import LOSSLESS, LOSSY, encode, noise

Change = Callable[[bytes], bytes]
STEP = 33_333
TABLES = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
EDITS = (b"moov", b"trak", b"edts", b"elst")


def read_bytes(data: bytes) -> SampleTable:
    return read_sample_table(io.BytesIO(data), len(data), "a.mp4")


# ---------------------------------------------------------------- what ffmpeg says


def check(path: Path) -> SampleTable:
    """Compare with the packets that ffmpeg finds, and with the frames that it shows."""
    table = sample_table_of(path)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        packets = [packet for packet in container.demux(stream) if packet.size]
        assert table.timescale == 1 / stream.time_base
        context: Any = stream.codec_context
        if table.entry.codec in ("avc1", "hev1", "hvc1", "av01", "FFV1"):
            assert table.entry.configuration == bytes(context.extradata)
        assert (table.entry.width, table.entry.height) == (context.width, context.height)
    is_shown = np.zeros(len(table.sizes), bool)
    is_shown[table.order] = True
    found = [table.places, table.sizes, table.presentation, table.decoding, table.sync, is_shown]
    assert [values.dtype for values in found] == [np.int64] * 4 + [np.bool_] * 2
    rows = list(zip(*(values.tolist() for values in found), strict=True))
    # behind the end of an edit ffmpeg lists no more than it needs
    assert rows[: len(packets)] == [
        (p.pos, p.size, p.pts, p.dts, p.is_keyframe, not p.is_discard) for p in packets
    ]
    assert not is_shown[len(packets) :].any()
    check_frames(path, table)
    return table


def check_frames(path: Path, table: SampleTable) -> None:
    with av.open(str(path)) as container:
        frames = [frame.pts for frame in container.decode(video=0)]
    assert table.presentation[table.order].tolist() == frames


def written(path: Path, codec: str, picture_format: str, *, lossless: bool, frames: int) -> Path:
    recipe = recipe_for(picture_format, lossless=lossless, codec=codec, crf=30)
    gaps = [0, 1, 2, 70_000, MAX_GAP_NS // NS_PER_TICK]
    ticks = np.cumsum([gaps[n % len(gaps)] or STEP for n in range(frames)]) - STEP
    pictures = noise(picture_format, 66, 50, frames)
    encode(path, recipe, pictures, picture_format, ticks=ticks.tolist(), gop=4)
    return path


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("codec", "picture_format", "lossless"),
    [(*pair, True) for pair in LOSSLESS]
    + [(codec, kind, False) for codec in LOSSY for kind in ("rgb24", "yuv420p")],
)
def test_what_is_encoded_here(
    codec: str, picture_format: str, lossless: bool, tmp_path: Path
) -> None:
    table = check(written(tmp_path / "a.mp4", codec, picture_format, lossless=lossless, frames=11))
    assert table.presentation[0] == 0
    assert table.order.tolist() == list(range(11))
    assert table.sync[::4].all()  # and where the encoder sees another scene
    assert not lossless or table.sync.sum() == 3
    entries = {"h264": "avc1", "h265": "hev1", "av1": "av01", "av1-10bit": "av01", "ffv1": "FFV1"}
    assert table.entry.codec == entries[codec]
    assert table.entry.configuration


B_FRAMES = {
    "h264-3": ("libx264", {"bf": "3", "b_strategy": "0"}),
    "h264-7": ("libx264", {"x264-params": "bframes=7:b-adapt=0:b-pyramid=none"}),
    "h264-pyramid": ("libx264", {"x264-params": "bframes=7:b-adapt=0:b-pyramid=normal"}),
    "h264-open-gop": ("libx264", {"x264-params": "bframes=3:open-gop=1:b-adapt=0"}),
    "h265": ("libx265", {"x265-params": "bframes=3:b-adapt=0:log-level=none"}),
    "h265-pyramid": ("libx265", {"x265-params": "bframes=7:b-pyramid=1:log-level=none"}),
    "av1": ("libsvtav1", {"preset": "12"}),
    "mpeg4": ("mpeg4", {"bf": "2"}),
}
MUXED: dict[str, dict[str, str]] = {
    "plain": {},
    "faststart": {"movflags": "faststart"},
    "negative": {"movflags": "negative_cts_offsets"},
    "no-edits": {"use_editlist": "0"},
    "seconds": {"movie_timescale": "1"},
}


def muxed(
    path: Path, encoder: str = "libx264", options: dict[str, str] | None = None,
    *, mux: dict[str, str] | None = None, frames: int = 31, first: int = 0,
) -> Path:  # fmt: skip
    """A video as ffmpeg writes it, of frames that last one, two or three ticks."""
    os.environ.setdefault("SVT_LOG", "0")
    with av.open(str(path), "w", options=mux or {}) as container:
        stream: Any = container.add_stream(encoder, rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 30)
        stream.codec_context.thread_count = 1
        stream.options = {"g": "12", **(options or {})}
        for number, pixels in enumerate(scene(frames)):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts = first + 2 * number + (number % 3 == 1)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.one_in(5)
@pytest.mark.parametrize("mux", MUXED)
@pytest.mark.parametrize(
    ("name", "extension"),
    [
        (name, kind)
        for name in B_FRAMES
        for kind in ("mp4", "mov")
        if (name, kind) != ("av1", "mov")
    ],
)
def test_frames_that_are_shown_in_another_order(
    name: str, mux: str, extension: str, tmp_path: Path
) -> None:
    path = muxed(tmp_path / f"a.{extension}", *B_FRAMES[name], mux=MUXED[mux])
    table = check(path)
    assert len(table.order) == 31
    if name != "av1":
        assert table.order.tolist() != sorted(table.order.tolist())
    assert np.all(table.decoding <= table.presentation)


# an index with two tracks is refused, others are no mp4
UNREADABLE = {
    "nasa_13013.mp4": "has 2 video tracks, not one",
    "av1_video.mkv": "no readable index",
    "vtest.avi": "no readable index",
}
FILES = sorted(path.name for path in (DATA / "video").glob("*.*"))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", FILES or [pytest.param("", marks=pytest.mark.skip)])
def test_files_of_others(name: str) -> None:
    path = real(f"video/{name}")
    if name in UNREADABLE:
        with pytest.raises(VideoError, match=UNREADABLE[name]) as caught:
            sample_table_of(path)
        assert caught.value.code == "video-unreadable"
        assert caught.value.place == str(path)
    else:
        check(path)


# ---------------------------------------------------------------- boxes that are changed


def box(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(body), kind) + body


def split(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        yield kind, data[at + 8 : at + size]
        at += size


def changed(data: bytes, path: Sequence[bytes], change: Change) -> bytes:
    """Boxes with another body for one of them; each of its kind is changed."""
    kinds = [kind for kind, _ in split(data)]
    assert path[0] in kinds
    return b"".join(
        box(kind, body if kind != path[0] else
            changed(body, path[1:], change) if path[1:] else change(body))
        for kind, body in split(data)
    )  # fmt: skip


def body_of(data: bytes, *path: bytes) -> bytes:
    for kind in path:
        data = dict(split(data))[kind]
    return data


def without(*path: bytes) -> Change:
    """A change that hides a box."""
    return lambda data: changed(data, path[:-1], lambda body: body.replace(path[-1], b"free", 1))


def packed(*values: int) -> bytes:
    return struct.pack(f">{len(values)}I", *values)


@pytest.fixture(scope="module")
def b_frames(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """An mp4 with B-frames; its movie box is its last, so that no place changes with it."""
    data = muxed(tmp_path_factory.mktemp("b") / "a.mp4", *B_FRAMES["h264-3"]).read_bytes()
    assert [kind for kind, _ in split(data)] == [b"ftyp", b"free", b"mdat", b"moov"]
    return data


DELAY = 2048  # ticks of the track from a frame's decoding to its showing
FIRST = [0, 1536, 2048, 3072, 4608, 5120, 6144, 7680]  # frames, in ticks from the first one
TICKS, MOVIE_TICKS = 15_360, 1_000  # per second, of the track and of the movie


def edit_list(*edits: tuple[int, int], version: int = 0, speed: int = 0x10000) -> bytes:
    row = ">Qqi" if version else ">Iii"
    rows = b"".join(struct.pack(row, duration, start, speed) for duration, start in edits)
    return packed(version << 24, len(edits)) + rows


ALL = (5_000, DELAY)  # ticks of the movie that an edit lasts, of the track where it begins
EDIT_LISTS: dict[str, tuple[bytes, int, int]] = {
    # and the time of the first frame, and how many are not shown before and after the others
    "none": (edit_list(), DELAY, 0),
    "all": (edit_list(ALL), 0, 0),
    "long": (edit_list(ALL, version=1), 0, 0),
    "delayed": (edit_list((1_000, -1), ALL), TICKS, 0),
    "delayed twice": (edit_list((333, -1), (335, -1), ALL), 5_115 + 5_146, 0),
    "delayed for hours": (edit_list((2**33, -1), ALL, version=1), 2**33 * TICKS // MOVIE_TICKS, 0),
    "from before the first frame": (edit_list((5_000, 0)), 0, 0),
    "from behind the first frame": (edit_list((5_000, DELAY + 1)), 0, 1),
    "from a frame": (edit_list((5_000, DELAY + FIRST[2])), 0, 2),
    "from between frames": (edit_list((5_000, DELAY + FIRST[2] + 1)), 0, 3),
    "from before a key frame": (edit_list((5_000, DELAY + 22 * 512)), 0, 11),
    "from a key frame": (edit_list((5_000, DELAY + 24 * 512)), 0, 12),
    "to a frame": (edit_list((FIRST[4] * MOVIE_TICKS // TICKS, DELAY)), 0, 27),
    "to behind a frame": (edit_list((FIRST[4] * MOVIE_TICKS // TICKS + 1, DELAY)), 0, 26),
    "one frame": (edit_list((100, DELAY)), 0, 30),
    "a second": (edit_list((1_000, DELAY)), 0, 16),
    "a part": (edit_list((400, DELAY + 9_000)), 0, 25),
    "a part, later": (edit_list((1_000, -1), (400, DELAY + 9_000)), TICKS, 25),
}


@pytest.mark.parametrize("name", EDIT_LISTS)
def test_edit_lists(name: str, b_frames: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    edits, first, hidden = EDIT_LISTS[name]
    path.write_bytes(changed(b_frames, EDITS, lambda _: edits))
    table = sample_table_of(path)
    check_frames(path, table)  # of what is not shown, ffmpeg makes up the times
    if not hidden:
        check(path)
    assert table.presentation[table.order[0]] == first
    assert len(table.order) == len(table.sizes) - hidden


def to_long_places(tables: bytes, shift: int = 0) -> bytes:
    chunks = struct.unpack(
        f">{len(body_of(tables, b'stco')) // 4 - 2}I", body_of(tables, b"stco")[8:]
    )
    places = struct.pack(f">{len(chunks)}Q", *(place + shift for place in chunks))
    return b"".join(
        box(b"co64", packed(0, len(chunks)) + places) if kind == b"stco" else box(kind, body)
        for kind, body in split(tables)
    )


def same(a: SampleTable, b: SampleTable, shift: int = 0) -> bool:
    arrays = ("sizes", "decoding", "presentation", "sync", "order")
    return np.array_equal(a.places + shift, b.places) and all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in arrays
    )


@pytest.mark.parametrize("at_end", [True, False])
def test_more_than_four_gigabytes(at_end: bool, b_frames: bytes, tmp_path: Path) -> None:
    """The frames behind a large box, which takes no room on the disk."""
    path, hole = tmp_path / "a.mp4", 5 << 30
    parts = dict(split(b_frames))
    movie = box(b"moov", parts[b"moov"])
    head = box(b"ftyp", parts[b"ftyp"])
    long_head = struct.pack(">I4sQ", 1, b"free", hole)
    old = b_frames.index(parts[b"mdat"])
    size = len(changed(movie, TABLES, to_long_places))  # whatever the places
    new = len(head) + (0 if at_end else size) + hole + 16
    moved = changed(movie, TABLES, lambda tables: to_long_places(tables, new - old))
    with path.open("wb") as file:
        file.write(head if at_end else head + moved)
        file.write(long_head)
        file.seek(hole - len(long_head), os.SEEK_CUR)
        file.write(struct.pack(">I4sQ", 1, b"mdat", 16 + len(parts[b"mdat"])) + parts[b"mdat"])
        if at_end:
            file.write(moved)
    table = check(path)
    assert same(read_bytes(b_frames), table, new - old)
    assert table.places.min() > 5 << 30


# ---------------------------------------------------------------- what is refused


def test_fragments(tmp_path: Path) -> None:
    for flags in ("frag_keyframe+empty_moov", "frag_keyframe", "frag_keyframe+dash"):
        path = muxed(tmp_path / "a.mp4", mux={"movflags": flags})
        with pytest.raises(Refused, match="fragments"):
            sample_table_of(path)
    data = box(b"ftyp", b"isom") + box(b"moof", bytes(8))
    with pytest.raises(Refused, match="fragments"):
        read_bytes(data)


def in_table(kind: bytes, change: Change) -> Change:
    return lambda data: changed(data, (*TABLES, kind), change)


def put(at: int, new: bytes) -> Change:
    return lambda body: body[:at] + new + body[at + len(new) :]


def edits(*rows: tuple[int, int], **more: int) -> Change:
    return lambda data: changed(data, EDITS, lambda _: edit_list(*rows, **more))


UNINDEXED: dict[str, tuple[Change, str]] = {
    "extensions": (
        lambda data: changed(data, (b"moov",), lambda body: body + box(b"mvex", b"")), "fragments"
    ),
    "no frames": (in_table(b"stsz", put(8, packed(0))), "no frames"),
    "compact sizes": (
        lambda data: changed(data, TABLES, lambda body: body.replace(b"stsz", b"stz2")), "compact"
    ),
    "descriptions": (in_table(b"stsd", put(4, packed(2))), "several descriptions"),
    "another description": (in_table(b"stsc", put(16, packed(2))), "several descriptions"),
    "step": (in_table(b"stts", put(12, packed(2**31))), "lasts too long"),
    "delay": (in_table(b"ctts", put(12, packed(2**28 + 1))), "too long after"),
    "two edits": (edits((500, 0), (500, 9000)), "several edits"),
    "many edits": (edits(*[(1, -1)] * 16, (500, 0)), "several edits"),
    "standing still": (edits((500, 0), speed=0), "freezes a frame"),
    "nothing": (edits((500, 2**30)), "shows no frames"),
    "edits that are not counted": (
        lambda data: changed(data, EDITS, put(4, packed(0))), "not as many"
    ),
    "another file": (
        lambda data: changed(data, (*TABLES[:4], b"dinf", b"dref"), put(16, packed(0))),
        "another file",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", UNINDEXED)
def test_what_is_not_read(name: str, b_frames: bytes) -> None:
    change, reason = UNINDEXED[name]
    with pytest.raises(Refused, match=reason) as caught:
        read_bytes(change(b_frames))
    assert not isinstance(caught.value, VideoError)


HUGE = packed(2**32 - 1)
DAMAGES: dict[str, tuple[Change, str]] = {
    "empty": (lambda data: b"", "moov is missing"),
    "half": (lambda data: data[: len(data) // 2], "in the middle of a box"),
    "no track": (without(b"moov", b"trak"), "has 0 video tracks"),
    "no media": (without(b"moov", b"trak", b"mdia"), "mdia is missing"),
    "no media header": (without(*TABLES[:3], b"mdhd"), "mdhd is missing"),
    "no information": (without(*TABLES[:4]), "minf is missing"),
    "no tables": (without(*TABLES), "stbl is missing"),
    **{
        f"no {kind.decode()}": (without(*TABLES, kind), f"{kind.decode()} is missing")
        for kind in (b"stts", b"stsc", b"stsz", b"stco")
    },
    **{
        f"{kind.decode()} with many rows": (
            in_table(kind, put(at, HUGE)), "too short|descriptions"
        )
        for kind, at in [(b"stts", 4), (b"ctts", 4), (b"stss", 4), (b"stsc", 4), (b"stco", 4),
                         (b"stsz", 8)]
    },
    **{
        f"{kind.decode()} of nothing": (in_table(kind, lambda _: b""), "too short")
        for kind in (b"stts", b"ctts", b"stss", b"stsc", b"stsz", b"stco")
    },
    "stsd of nothing": (in_table(b"stsd", lambda _: b""), "damaged"),
    "no description": (in_table(b"stsd", put(4, packed(0))), "several|damaged"),
    "a short description": (in_table(b"stsd", lambda body: body[:60]), "damaged"),
    "a long description": (in_table(b"stsd", lambda body: body + bytes(1 << 20)), "too long"),
    "many steps": (in_table(b"stts", put(8, HUGE)), "stts contradicts"),
    "many delays": (in_table(b"ctts", put(8, HUGE)), "ctts contradicts"),
    "key frame 0": (in_table(b"stss", put(8, packed(0))), "stss contradicts"),
    "key frame beyond": (in_table(b"stss", put(8, packed(32))), "stss contradicts"),
    "large chunk": (in_table(b"stsc", put(12, HUGE)), "stsc contradicts"),
    "empty chunk": (in_table(b"stsc", put(12, packed(0))), "stsc contradicts"),
    "chunk beyond": (
        in_table(b"stsc", lambda _: packed(0, 2, 1, 15, 1, 9, 16, 1)), "stsc contradicts"
    ),
    "no places": (in_table(b"stco", put(4, packed(0))), "stsc contradicts"),
    "place beyond": (in_table(b"stco", put(8, HUGE)), "beyond the end"),
    "size beyond": (in_table(b"stsz", put(12, HUGE)), "beyond the end"),
    "one size and many frames": (in_table(b"stsz", put(4, packed(1) + HUGE)), "larger than"),
    "no ticks": (
        lambda data: changed(data, (*TABLES[:3], b"mdhd"), put(12, packed(0))), "has 0 ticks"
    ),
    "no ticks of the movie": (
        lambda data: changed(data, (b"moov", b"mvhd"), put(12, HUGE)), "ticks"
    ),
    "late delay": (edits((2**64 - 1, -1), (5_000, 0), version=1), "too late"),
    "many boxes": (
        lambda data: changed(data, (b"moov",), lambda body: body + box(b"free", b"") * 1000),
        "more than 1000",
    ),
    "two tracks": (
        lambda data: changed(
            data, (b"moov",), lambda body: body + box(b"trak", body_of(body, b"trak"))
        ),
        "has 2 video tracks, not one",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_what_is_damaged(name: str, b_frames: bytes) -> None:
    change, problem = DAMAGES[name]
    with pytest.raises(VideoError, match=problem) as caught:
        read_bytes(change(b_frames))
    assert caught.value.code == "video-unreadable"
    assert caught.value.place == "a.mp4"


def peak_of(data: bytes, size: int) -> int:
    """Bytes that reading takes at most, whether or not it succeeds."""
    file = io.BytesIO(data)
    tracemalloc.start()
    try:
        read_sample_table(file, size, "a.mp4")
    except (VideoError, Refused):
        pass
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak


def test_memory_is_bounded_by_the_index(b_frames: bytes) -> None:
    # of a file that is said to be large, frames of one size cost nothing in the index
    for frames in (2**22 + 1, 2**32 - 1):
        alike = in_table(b"stsz", put(4, packed(1, frames)))(b_frames)
        assert peak_of(alike, len(alike)) < 1 << 20
        with pytest.raises(Refused, match="too long"):
            read_sample_table(io.BytesIO(alike + bytes(8)), 1 << 40, "a.mp4")


def mutated(data: bytes, start: int, rng: random.Random) -> bytes:
    """Bytes of the movie box changed: any, or those that count and measure."""
    new = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(start, len(new))
        kind = rng.randrange(4)
        if kind == 0:
            new[at] = rng.randrange(256)
        elif kind == 1:
            new[at] ^= 1 << rng.randrange(8)
        elif kind == 2:
            number = rng.choice([0, 1, 2, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1])
            new[at : at + 4] = packed(number)
        else:
            end = at + rng.randint(1, 16)
            new[at:end] = new[at:end][::-1]
    return bytes(new)


def is_sound(table: SampleTable, size: int) -> bool:
    count = len(table.sizes)
    lengths = {len(a) for a in (table.places, table.decoding, table.presentation, table.sync)}
    times = table.presentation[table.order]
    return (
        lengths == {count}
        and bool(np.all(table.places >= 0) and np.all(table.places + table.sizes <= size))
        and len(set(table.order.tolist())) == len(table.order) > 0
        and bool(np.all(np.diff(times) >= 0))
        and bool(np.all(table.decoding <= table.presentation))
        and table.timescale > 0
    )


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(4))
def test_damage_anywhere_in_the_index(seed: int, b_frames: bytes) -> None:
    rng = random.Random(seed)
    start = b_frames.index(b"moov") - 4
    outcomes = {"read": 0, "damaged": 0, "unindexed": 0}
    largest = 0
    for number in range(1_500):
        data = mutated(b_frames, start, rng)
        if number % 10 == 0:
            largest = max(largest, peak_of(data, len(data)))
        try:
            assert is_sound(read_bytes(data), len(data))
            outcomes["read"] += 1
        except VideoError:
            outcomes["damaged"] += 1
        except Refused:
            outcomes["unindexed"] += 1
    assert all(outcomes.values()), outcomes
    assert largest < 1 << 20
