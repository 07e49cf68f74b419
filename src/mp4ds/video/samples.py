"""The index of an mp4: where each coded frame lies, and when it is decoded and shown.

It is read with numpy alone, so that hours of video take milliseconds and nothing is decoded.
Names and meanings are those of ISO/IEC 14496-12, 8.5 to 8.7; where files and the standard
differ, times are what ffmpeg makes of them.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import VideoError
from mp4ds.video.boxes import Box, DamagedBoxError, boxes
from mp4ds.video.sample_entry import SampleEntry, parse_descriptions
from mp4ds.video.track_colour import TrackColour, track_colour

Integers = NDArray[np.int64]

_CONFIGURATIONS = ("avcC", "hvcC", "av1C", "vpcC", "glbl")
_LONGEST_INDEX = 1 << 26  # bytes; about two days at 30 Hz
_MOST_ALIKE = 1 << 22  # samples of one size: all that bounds the memory for them
_LARGEST_TIMESCALE = 1 << 31  # negative to some readers
_LONGEST_STEP = 1 << 31  # ticks; negative to some readers
_LONGEST_DELAY = 1 << 28  # ticks between decoding and showing; ffmpeg ignores longer ones
_LATEST = 1 << 62  # ticks
_NO_EDITS = 8  # bytes of a list
_MOST_EDITS = 16
_NORMAL_SPEED = 0x10000
_IN_THIS_FILE = 1

_NUMBER = np.dtype(">u4")
_LONG_NUMBER = np.dtype(">u8")
_STEPS = np.dtype([("count", ">u4"), ("value", ">u4")])
_DELAYS = np.dtype([("count", ">u4"), ("value", ">i4")])
_CHUNKS = np.dtype([("first", ">u4"), ("samples", ">u4"), ("description", ">u4")])
_EDITS = np.dtype([("duration", ">u4"), ("start", ">i4"), ("speed", ">i4")])
_LONG_EDITS = np.dtype([("duration", ">u8"), ("start", ">i8"), ("speed", ">i4")])


class Unindexed(ValueError):  # noqa: N818 - no failure: such a file is read in order
    """A sound file whose index this module does not read; the text says why."""


@dataclass(frozen=True, eq=False, slots=True)
class SampleTable:
    """What the index says of a video track's samples, which are its coded frames.

    Attributes:
        codec: Four letters of the sample entry: ``avc1``, ``hev1``, ``hvc1``, ``av01``,
            ``vp09``, ``FFV1``, ``mp4v``, ...
        width: Columns, as the sample entry says.
        height: Rows, as the sample entry says.
        colour: What the track says of its colours, if anything.
        configuration: Contents of avcC, hvcC, av1C, vpcC or glbl; empty if there is none.
        timescale: Ticks per second.
        places: Byte of the file where each sample begins, in decoding order. All arrays but
            `sync` are int64.
        sizes: Bytes of each.
        decoding: Ticks at which each is decoded, none later than it is shown.
        presentation: Ticks at which each is shown, the edit list applied.
        sync: For each whether it is a sync sample, at which decoding can begin; bool.
        order: Numbers of the samples that the edit list shows, in the order of their showing:
            frame ``n`` of the video is sample ``order[n]``.
    """

    codec: str
    width: int
    height: int
    colour: TrackColour | None
    configuration: bytes
    timescale: int
    places: Integers
    sizes: Integers
    decoding: Integers
    presentation: Integers
    sync: NDArray[np.bool_]
    order: Integers


@dataclass(frozen=True, slots=True)
class _Edit:
    """What is shown of a track, in ticks of the track."""

    delay: int
    start: int
    duration: int


class _Movie:
    """The movie box, held in memory."""

    def __init__(self, data: bytes) -> None:
        self.file = io.BytesIO(data)  # shares the bytes
        self._data = memoryview(data)
        self.box = Box(b"moov", 0, len(data))

    def inside(self, box: Box) -> dict[bytes, Box]:
        """The first box of each kind in a box."""
        found: dict[bytes, Box] = {}
        for part in boxes(self.file, box.start, box.end):
            found.setdefault(part.kind, part)
        return found

    def path(self, box: Box, *kinds: bytes) -> Box:
        """A box by the kinds of those that it is in, and its own."""
        for kind in kinds:
            box = _required(self.inside(box), kind)
        return box

    def tracks(self) -> list[Box]:
        """Its video tracks."""
        tracks = [box for box in boxes(self.file, 0, self.box.end) if box.kind == b"trak"]
        handlers = [(track, self.path(track, b"mdia", b"hdlr")) for track in tracks]
        return [
            track
            for track, handler in handlers
            if bytes(self._data[handler.start : handler.end][8:12]) == b"vide"
        ]

    def number(self, box: Box, at: int) -> int:
        """The 32-bit number at a byte of a box."""
        (value,) = self._array(box, at, _NUMBER, 1)
        return int(value)

    def version(self, box: Box) -> int:
        """Version of a full box."""
        return self.number(box, 0) >> 24

    def timescale(self, header: Box) -> int:
        """Ticks per second of ``mvhd`` or ``mdhd``."""
        value = self.number(header, 20 if self.version(header) == 1 else 12)
        if not 0 < value < _LARGEST_TIMESCALE:
            raise DamagedBoxError(f"a second has {value} ticks")
        return value

    def table(self, box: Box, row: np.dtype[Any], at: int = 4) -> NDArray[Any]:
        """A table of as many rows as the number at a byte of its box says."""
        return self._array(box, at + 4, row, self.number(box, at))

    def _array(self, box: Box, at: int, row: np.dtype[Any], count: int) -> NDArray[Any]:
        if at + count * row.itemsize > box.size:
            raise DamagedBoxError(f"box {box.kind.decode('latin-1')} is too short")
        return np.frombuffer(self._data, row, count, box.start + at)


def read_sample_table(stream: BinaryIO, size: int, place: str) -> SampleTable:
    """Read the index of an mp4 with one video track.

    Only the headers of its outermost boxes and its movie box are read, the latter at once.

    Args:
        stream: The file, of which nothing needs to be true. The memory that is needed is at most
            some twenty times its movie box, of no more than 64 MiB, or 400 MiB where all frames
            have one size.
        size: Its bytes.
        place: Its name, for errors.

    Raises:
        VideoError: ``video-unreadable``: there is no index, it contradicts itself or the file's
            size, or there is not just one video track.
        Unindexed: The index says something that this module does not read: fragments, several
            edits or descriptions, compact sizes, another file, too many frames or none.
        OSError, RemoteError: The file cannot be read.
    """
    try:
        movie = _read_movie(stream, size)
        tracks = movie.tracks()
        if len(tracks) != 1:
            raise VideoError("video-unreadable", place, f"has {len(tracks)} video tracks, not one")
        return _parse_track(movie, tracks[0], size)
    except DamagedBoxError as error:
        raise VideoError(
            "video-unreadable", place, f"has no index that can be read: {error}"
        ) from None


def _read_movie(stream: BinaryIO, size: int) -> _Movie:
    for box in boxes(stream, 0, size, outermost=True):
        if box.kind == b"moof":
            raise Unindexed("its frames are in fragments")
        if box.kind == b"moov":
            if box.size > _LONGEST_INDEX:
                raise Unindexed("its index is too long")
            stream.seek(box.start)
            data = stream.read(box.size)
            if len(data) != box.size:
                raise DamagedBoxError("the file ends before its index")
            movie = _Movie(data)
            if movie.inside(movie.box).keys() & {b"mvex", b"cmov"}:
                raise Unindexed("its frames are in fragments, or its index is compressed")
            return movie
    raise DamagedBoxError("box moov is missing")


def _parse_track(movie: _Movie, track: Box, file_size: int) -> SampleTable:
    media = movie.inside(movie.path(track, b"mdia"))
    timescale = movie.timescale(_required(media, b"mdhd"))
    information = _required(media, b"minf")
    _check_references(movie, information)
    tables = movie.inside(movie.path(information, b"stbl"))
    entry = _description(movie, _required(tables, b"stsd"))
    sizes = _sizes(movie, tables, file_size)
    places = _places(movie, tables, sizes, file_size)
    decoding, presentation = _times(movie, tables, len(sizes))
    edit = _edit(movie, track, timescale)
    order = np.arange(len(sizes), dtype=np.int64)
    if edit:
        order = _shown(presentation, edit, order)
        shift = edit.delay - int(presentation[order].min())
        decoding += shift
        presentation += shift
    times = presentation[order]
    if np.any(times[1:] < times[:-1]):
        order = order[np.argsort(times, kind="stable")]
    return SampleTable(
        codec=entry.codec,
        width=entry.width,
        height=entry.height,
        colour=track_colour(entry),
        configuration=_configuration(entry),
        timescale=timescale,
        places=places,
        sizes=sizes,
        decoding=decoding,
        presentation=presentation,
        sync=_sync(movie, tables, len(sizes)),
        order=order,
    )


def _required(found: dict[bytes, Box], kind: bytes) -> Box:
    if kind not in found:
        raise DamagedBoxError(f"box {kind.decode('latin-1')} is missing")
    return found[kind]


def _check_references(movie: _Movie, information: Box) -> None:
    """Refuse frames that are in other files, as QuickTime may have them."""
    references = movie.inside(information).get(b"dinf")
    dref = movie.inside(references).get(b"dref") if references else None
    if dref is None:
        return
    for reference in boxes(movie.file, dref.start + 8, dref.end):
        if not movie.number(reference, 0) & _IN_THIS_FILE:
            raise Unindexed("its frames are in another file")


def _description(movie: _Movie, stsd: Box) -> SampleEntry:
    if movie.number(stsd, 4) > 1:
        raise Unindexed("its frames have several descriptions")
    return parse_descriptions(movie.file, stsd)


def _configuration(entry: SampleEntry) -> bytes:
    return next((body for kind, body in entry.boxes if kind in _CONFIGURATIONS), b"")


def _sizes(movie: _Movie, tables: dict[bytes, Box], file_size: int) -> Integers:
    if b"stsz" not in tables and b"stz2" in tables:
        raise Unindexed("the sizes of its frames are compact")
    stsz = _required(tables, b"stsz")
    common, count = movie.number(stsz, 4), movie.number(stsz, 8)
    if not count:
        raise Unindexed("its index lists no frames")
    if not common:
        return movie.table(stsz, _NUMBER, at=8).astype(np.int64)
    if count * common > file_size:
        raise DamagedBoxError("its frames are larger than the file")
    if count > _MOST_ALIKE:
        raise Unindexed("its index is too long")
    return np.full(count, common, np.int64)


def _places(movie: _Movie, tables: dict[bytes, Box], sizes: Integers, file_size: int) -> Integers:
    """Samples lie in chunks, one after the other; what a chunk holds is told where it changes."""
    if b"co64" in tables:
        chunks = movie.table(tables[b"co64"], _LONG_NUMBER)
    else:
        chunks = movie.table(_required(tables, b"stco"), _NUMBER)
    if np.any(chunks > file_size):
        raise DamagedBoxError("frames lie beyond the end of the file")
    runs = movie.table(_required(tables, b"stsc"), _CHUNKS)
    if np.any(runs["description"] != 1):
        raise Unindexed("its frames have several descriptions")
    edges = np.append(runs["first"].astype(np.int64) - 1, len(chunks))
    if edges[0] != 0 or np.any(np.diff(edges) <= 0) or np.any(runs["samples"] == 0):
        raise DamagedBoxError("box stsc contradicts the number of chunks")
    counts = np.repeat(runs["samples"].astype(np.int64), np.diff(edges))
    if counts.sum() != len(sizes):
        raise DamagedBoxError("box stsc contradicts the number of frames")
    before = np.cumsum(sizes) - sizes
    firsts = np.cumsum(counts) - counts
    places: Integers = before + np.repeat(chunks.astype(np.int64) - before[firsts], counts)
    if np.any(places + sizes > file_size):
        raise DamagedBoxError("frames lie beyond the end of the file")
    return places


def _times(movie: _Movie, tables: dict[bytes, Box], count: int) -> tuple[Integers, Integers]:
    """Ticks of decoding and of showing, without the edit list; two arrays."""
    steps = _repeated(movie.table(_required(tables, b"stts"), _STEPS), count, "stts")
    if np.any(steps >= _LONGEST_STEP):
        raise Unindexed("a frame lasts too long")
    decoding = np.cumsum(steps) - steps
    if b"ctts" not in tables:
        return decoding, decoding.copy()
    delays = _repeated(movie.table(tables[b"ctts"], _DELAYS), count, "ctts")
    if np.any(np.abs(delays) > _LONGEST_DELAY):
        raise Unindexed("a frame is shown too long after its decoding")
    # where delays are negative, decoding has to begin earlier
    return decoding + min(int(delays.min()), 0), decoding + delays


def _repeated(rows: NDArray[Any], count: int, kind: str) -> Integers:
    counts = rows["count"].astype(np.int64)
    if counts.sum() != count:
        raise DamagedBoxError(f"box {kind} contradicts the number of frames")
    values: Integers = np.repeat(rows["value"].astype(np.int64), counts)
    return values


def _sync(movie: _Movie, tables: dict[bytes, Box], count: int) -> NDArray[np.bool_]:
    if b"stss" not in tables:
        return np.ones(count, np.bool_)
    numbers = movie.table(tables[b"stss"], _NUMBER).astype(np.int64)
    if np.any((numbers < 1) | (numbers > count)):
        raise DamagedBoxError("box stss contradicts the number of frames")
    sync = np.zeros(count, np.bool_)
    sync[numbers - 1] = True
    return sync


def _edit(movie: _Movie, track: Box, timescale: int) -> _Edit | None:
    """The edit list, where it only delays the track and cuts its ends; None without one.

    Raises:
        Unindexed: It says more.
    """
    parts = movie.inside(track)
    elst = movie.inside(parts[b"edts"]).get(b"elst") if b"edts" in parts else None
    if elst is None or elst.size == _NO_EDITS:
        return None
    rows = movie.table(elst, _LONG_EDITS if movie.version(elst) == 1 else _EDITS)
    if len(rows) > _MOST_EDITS:
        raise Unindexed("it has several edits")
    if elst.size != _NO_EDITS + rows.nbytes or not len(rows):
        raise Unindexed("its edits are not as many as it says")  # ffmpeg goes by their size
    movie_scale = movie.timescale(movie.path(movie.box, b"mvhd"))
    # durations are in ticks of the movie, rounded to the nearest of the track
    durations = [
        (2 * duration * timescale + movie_scale) // (2 * movie_scale)
        for duration in rows["duration"].tolist()
    ]
    starts = rows["start"].tolist()
    if any(start != -1 for start in starts[:-1]) or starts[-1] < 0:
        raise Unindexed("it has several edits")
    if rows["speed"][-1] != _NORMAL_SPEED or not durations[-1]:
        raise Unindexed("it has an edit that stands still or has no end")
    edit = _Edit(sum(durations[:-1]), starts[-1], durations[-1])
    if max(edit.delay, edit.start + edit.duration) > _LATEST:
        raise DamagedBoxError("an edit is too late")
    return edit


def _shown(presentation: Integers, edit: _Edit, order: Integers) -> Integers:
    shown = (presentation >= edit.start) & (presentation < edit.start + edit.duration)
    if not shown.any():
        raise Unindexed("its edit list shows no frames")
    return order if shown.all() else order[shown]
