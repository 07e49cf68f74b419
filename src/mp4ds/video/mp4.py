"""The index of an mp4: its boxes, its track and the places of coded frames (ISO/IEC 14496-12)."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused, VideoError

_HEADER, _LONG_HEADER = 8, 16
_OUTERMOST = (b"ftyp", b"styp", b"pnot", b"wide", b"free", b"skip", b"uuid", b"meta", b"sidx",
              b"moov", b"moof", b"mdat", b"mfra")  # fmt: skip
_MOST_BOXES = 1_000  # siblings; no video has a tenth of that


class DamagedBoxError(ValueError):
    """A box is missing or contradicts those around it; the text says which."""


class EditedError(Refused):
    """What is shown depends on edits or several descriptions, which a copy by ffmpeg loses."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box's place.

    Attributes:
        kind: Its four letters.
        start: Byte of the file where its contents begin.
        end: Byte after them.
    """

    kind: bytes
    start: int
    end: int

    @property
    def size(self) -> int:
        """Bytes of its contents."""
        return self.end - self.start


def boxes(file: BinaryIO, start: int, end: int, *, outermost: bool = False) -> Iterator[Box]:
    """The boxes in a range, one after another; only their headers are read.

    Args:
        file: The file.
        start: Byte where the first begins.
        end: Byte after the last. Fewer than 8 bytes before it are not a box, as in QuickTime.
        outermost: Whether they are top-level, so that the last may have no size.

    Raises:
        DamagedBoxError: One is not within `start` and `end`, or there are too many.
    """
    for _ in range(_MOST_BOXES):
        if end - start < _HEADER:
            return
        file.seek(start)
        header = file.read(min(_LONG_HEADER, end - start))
        if len(header) < _HEADER:
            raise DamagedBoxError("the file ends in the middle of a box")
        size, kind = struct.unpack_from(">I4s", header)
        head = _HEADER
        if size == 1 and len(header) == _LONG_HEADER:
            (size,) = struct.unpack_from(">Q", header, _HEADER)
            head = _LONG_HEADER
        elif size == 0 and outermost:
            size = end - start
        if outermost and kind in _OUTERMOST and size > end - start:
            raise DamagedBoxError("the file ends in the middle of a box")
        if not head <= size <= end - start:
            raise DamagedBoxError("a box is damaged")
        yield Box(kind, start + head, start + size)
        start += size
    raise DamagedBoxError(f"there are more than {_MOST_BOXES} boxes in one")


def why_unreadable(path: Path) -> str:
    """Why a file is no readable mp4, as a phrase; empty if its outermost boxes do not tell."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            if not size:
                return "is empty"
            if file.read(_HEADER)[4:] not in _OUTERMOST:
                return "is not an mp4"
            kinds = {box.kind for box in boxes(file, 0, size, outermost=True)}
    except DamagedBoxError as error:
        return f"was cut short or damaged: {error}"
    except OSError:
        return ""
    return "" if b"moov" in kinds else "was cut short: it has no index (moov)"


# ---------------------------------------------------------------- sample entry

_ENTRY_BYTES = 78  # of a video's sample entry, between its header and the boxes in it
_LONGEST_ENTRY = 1 << 20
_CONFIGURATIONS = ("avcC", "hvcC", "av1C", "vpcC", "glbl")

_UNSPECIFIED = 2
_LIMITED, _FULL = 1, 2  # ffmpeg's AVColorRange
_WORDS = 6  # bytes of three numbers, behind the four letters of the box's kind
# what PyAV calls the numbers of the box colr, and those of ITU-T H.273 that ffmpeg knows
_COLOURS = {
    "color_primaries": frozenset((1, *range(4, 13), 22)),
    "color_trc": frozenset((1, *range(4, 19))),
    "colorspace": frozenset((0, 1, *range(4, 18))),
}


@dataclass(frozen=True, slots=True)
class SampleEntry:
    """The description of all packets of a track (ISO/IEC 14496-12, 8.5.2).

    Bit rates are left out: they are of the packets, not of the codec.

    Attributes:
        codec: Its four letters: ``avc1``, ``hev1``, ``hvc1``, ``av01``, ``vp09``, ``FFV1``,
            ``mp4v``, ...
        values: Size, resolution and depth, as stored.
        boxes: What follows: parameter sets, colour, aspect ratio, ...
    """

    codec: str
    values: bytes
    boxes: tuple[tuple[str, bytes], ...]

    @property
    def aspect_ratio(self) -> Fraction:
        """Width to height of a pixel; 0 if not stated."""
        pasp = dict(self.boxes).get("pasp", b"")
        across, down = struct.unpack(">II", pasp) if len(pasp) == 8 else (0, 1)
        return Fraction(across, down) if down else Fraction(0)

    @property
    def width(self) -> int:
        """Columns."""
        return int.from_bytes(self.values[24:26], "big")

    @property
    def height(self) -> int:
        """Rows."""
        return int.from_bytes(self.values[26:28], "big")

    @property
    def configuration(self) -> bytes:
        """Contents of avcC, hvcC, av1C, vpcC or glbl; empty if there is none."""
        return next((body for kind, body in self.boxes if kind in _CONFIGURATIONS), b"")

    @property
    def colour(self) -> dict[str, int]:
        """The colours of the track (12.1.5), as attributes of PyAV's decoder; none if not stated.

        QuickTime's ``nclc`` has no range. Undefined values count as unspecified; profiles are
        ignored. The packets' own values take precedence.
        """
        found: dict[str, int] = {}
        for kind, body in self.boxes:
            if kind == "colr" and body[:4] in (b"nclx", b"nclc") and len(body) >= 4 + _WORDS:
                numbers = struct.unpack_from(">3H", body, 4)
                found = {
                    name: number if number in known else _UNSPECIFIED
                    for (name, known), number in zip(_COLOURS.items(), numbers, strict=True)
                }
                if body[:4] == b"nclx" and len(body) > 10:
                    found["color_range"] = _FULL if body[10] & 0x80 else _LIMITED
        return found

    def differences(self, other: SampleEntry) -> str:
        """What differs, in words; empty if nothing does."""
        if self == other:
            return ""
        if self.codec != other.codec:
            return f"their codec ({self.codec} and {other.codec})"
        sizes = [f"{entry.width}x{entry.height}" for entry in (self, other)]
        if sizes[0] != sizes[1]:
            return f"their size ({' and '.join(sizes)})"
        kinds = sorted({kind for kind, _ in set(self.boxes) ^ set(other.boxes)})
        return f"their codec configuration ({', '.join(kinds) or 'order or depth'})"


def _parse_description(file: BinaryIO, stsd: Box) -> SampleEntry:
    """The only entry of a track's ``stsd``.

    Raises:
        DamagedBoxError: It is too long, or contradicts itself.
        Refused: There are several.
    """
    if stsd.size > _LONGEST_ENTRY:
        raise DamagedBoxError("it is too long")
    file.seek(stsd.start)
    data = file.read(stsd.size)
    count = int.from_bytes(data[4:8], "big")
    if count > 1:
        raise EditedError("its frames have several descriptions")
    file = io.BytesIO(data)
    entry = next(boxes(file, 8, len(data)), None) if count else None
    if entry is None or entry.size < _ENTRY_BYTES:
        raise DamagedBoxError("a box is damaged")
    values_end = entry.start + _ENTRY_BYTES
    parts = []
    for box in boxes(file, values_end, entry.end):
        if box.kind == b"btrt":
            continue
        body = data[box.start : box.end]
        # an elementary stream descriptor as ffmpeg writes it, whose size of a buffer and rates are
        # left out (ISO/IEC 14496-1, 7.2.6.5 and 7.2.6.6): tags, each with a length of four bytes,
        # an ES_ID and flags of three bytes, and two bytes that tell the codec
        if box.kind == b"esds" and body[4:5] == b"\3" and body[12:13] == b"\4" and len(body) >= 30:
            body = body[:19] + bytes(11) + body[30:]
        parts.append((box.kind.decode("latin-1"), body))
    return SampleEntry(entry.kind.decode("latin-1"), data[entry.start : values_end], tuple(parts))


# ---------------------------------------------------------------- samples

Integers = NDArray[np.int64]

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


@dataclass(frozen=True, eq=False, slots=True)
class SampleTable:
    """The index of a video track's samples, which are its coded frames.

    Attributes:
        entry: Their description.
        timescale: Ticks per second.
        places: Byte of the file where each sample begins, in decoding order. All arrays but
            `sync` are int64.
        sizes: Bytes of each.
        decoding: Ticks at which each is decoded, never later than it is shown.
        presentation: Ticks at which each is shown, with the edit list applied.
        sync: Whether each is a sync sample, at which decoding can begin; bool.
        order: Numbers of the samples that the edit list shows, in presentation order:
            frame ``n`` of the video is sample ``order[n]``.
    """

    entry: SampleEntry
    timescale: int
    places: Integers
    sizes: Integers
    decoding: Integers
    presentation: Integers
    sync: NDArray[np.bool_]
    order: Integers


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
        """A box by its path of kinds."""
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


def sample_table_of(path: Path) -> SampleTable:
    """The index of the video track of a file: see `read_sample_table`."""
    with path.open("rb") as file:
        return read_sample_table(file, path.stat().st_size, str(path))


def read_sample_table(stream: BinaryIO, size: int, place: str) -> SampleTable:
    """Read the index of the video track of an mp4.

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
        Refused: The index says something that this module does not read: fragments, several
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
        raise VideoError("video-unreadable", place, f"has no readable index: {error}") from None


def _read_movie(stream: BinaryIO, size: int) -> _Movie:
    for box in boxes(stream, 0, size, outermost=True):
        if box.kind == b"moof":
            raise Refused("its frames are in fragments")
        if box.kind == b"moov":
            if box.size > _LONGEST_INDEX:
                raise Refused("its index is too long")
            stream.seek(box.start)
            data = stream.read(box.size)
            if len(data) != box.size:
                raise DamagedBoxError("the file ends before its index")
            movie = _Movie(data)
            if movie.inside(movie.box).keys() & {b"mvex", b"cmov"}:
                raise Refused("its frames are in fragments, or its index is compressed")
            return movie
    raise DamagedBoxError("box moov is missing")


def _parse_track(movie: _Movie, track: Box, file_size: int) -> SampleTable:
    media = movie.inside(movie.path(track, b"mdia"))
    timescale = movie.timescale(_required(media, b"mdhd"))
    information = _required(media, b"minf")
    _check_references(movie, information)
    tables = movie.inside(movie.path(information, b"stbl"))
    entry = _parse_description(movie.file, _required(tables, b"stsd"))
    sizes = _sizes(movie, tables, file_size)
    places = _places(movie, tables, sizes, file_size)
    decoding, presentation = _times(movie, tables, len(sizes))
    edit = _edit(movie, track, timescale)
    order: Integers = np.arange(len(sizes), dtype=np.int64)
    if edit:
        delay, start, end = edit
        shown = (presentation >= start) & (presentation < end)
        if not shown.any():
            raise EditedError("its edit list shows no frames")
        order = order[shown]
        shift = delay - int(presentation[order].min())
        decoding += shift
        presentation += shift
    times = presentation[order]
    if np.any(times[1:] < times[:-1]):
        order = order[np.argsort(times, kind="stable")]
    return SampleTable(
        entry=entry,
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
    """Refuse frames that are in other files, which QuickTime allows."""
    references = movie.inside(information).get(b"dinf")
    dref = movie.inside(references).get(b"dref") if references else None
    if dref is None:
        return
    for reference in boxes(movie.file, dref.start + 8, dref.end):
        if not movie.number(reference, 0) & _IN_THIS_FILE:
            raise Refused("its frames are in another file")


def _sizes(movie: _Movie, tables: dict[bytes, Box], file_size: int) -> Integers:
    if b"stsz" not in tables and b"stz2" in tables:
        raise Refused("the sizes of its frames are compact")
    stsz = _required(tables, b"stsz")
    common, count = movie.number(stsz, 4), movie.number(stsz, 8)
    if not count:
        raise Refused("its index lists no frames")
    if not common:
        return movie.table(stsz, _NUMBER, at=8).astype(np.int64)
    if count * common > file_size:
        raise DamagedBoxError("its frames are larger than the file")
    if count > _MOST_ALIKE:
        raise Refused("its index is too long")
    return np.full(count, common, np.int64)


def _places(movie: _Movie, tables: dict[bytes, Box], sizes: Integers, file_size: int) -> Integers:
    """Samples are stored in chunks, one after another, described only where chunks change."""
    if b"co64" in tables:
        chunks = movie.table(tables[b"co64"], _LONG_NUMBER)
    else:
        chunks = movie.table(_required(tables, b"stco"), _NUMBER)
    if np.any(chunks > file_size):
        raise DamagedBoxError("frames lie beyond the end of the file")
    runs = movie.table(_required(tables, b"stsc"), _CHUNKS)
    if np.any(runs["description"] != 1):
        raise EditedError("its frames have several descriptions")
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
    """Ticks of decoding and of presentation, without the edit list; two arrays."""
    steps = _repeated(movie.table(_required(tables, b"stts"), _STEPS), count, "stts")
    if np.any(steps >= _LONGEST_STEP):
        raise Refused("a frame lasts too long")
    decoding = np.cumsum(steps) - steps
    if b"ctts" not in tables:
        return decoding, decoding.copy()
    delays = _repeated(movie.table(tables[b"ctts"], _DELAYS), count, "ctts")
    if np.any(np.abs(delays) > _LONGEST_DELAY):
        raise Refused("a frame is shown too long after its decoding")
    # where delays are negative, decoding must begin earlier
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


def _edit(movie: _Movie, track: Box, timescale: int) -> tuple[int, int, int] | None:
    """The edit list, if it only delays the track and trims its ends; None without one.

    Returns:
        Delay, start and end of what is shown, in ticks of the track.

    Raises:
        Refused: It does more than that.
    """
    parts = movie.inside(track)
    elst = movie.inside(parts[b"edts"]).get(b"elst") if b"edts" in parts else None
    if elst is None or elst.size == _NO_EDITS:
        return None
    rows = movie.table(elst, _LONG_EDITS if movie.version(elst) == 1 else _EDITS)
    if len(rows) > _MOST_EDITS:
        raise EditedError("it has several edits")
    if elst.size != _NO_EDITS + rows.nbytes or not len(rows):
        raise EditedError("its edits are not as many as it says")  # ffmpeg goes by their size
    movie_scale = movie.timescale(movie.path(movie.box, b"mvhd"))
    # durations are in ticks of the movie, rounded to the nearest of the track
    durations = [
        (2 * duration * timescale + movie_scale) // (2 * movie_scale)
        for duration in rows["duration"].tolist()
    ]
    starts = rows["start"].tolist()
    if any(start != -1 for start in starts[:-1]) or starts[-1] < 0:
        raise EditedError("it has several edits")
    if rows["speed"][-1] != _NORMAL_SPEED or not durations[-1]:
        raise EditedError("it has an edit that freezes a frame or has no end")
    delay, end = sum(durations[:-1]), starts[-1] + durations[-1]
    if max(delay, end) > _LATEST:
        raise DamagedBoxError("an edit is too late")
    return delay, starts[-1], end
