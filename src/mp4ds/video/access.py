"""What the frames of a video refer to, and frames by number, decoding only what they depend on."""

from __future__ import annotations

import hashlib
from array import array
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mp4ds.errors import FormatError, Refused, VideoError, reason_of
from mp4ds.files.outputs import digest_file
from mp4ds.files.ranges import expect
from mp4ds.messages.encodings import Picture, Pixels
from mp4ds.video.codecs import CODECS
from mp4ds.video.coded import StreamParser, UnknownStructure
from mp4ds.video.decoder import JpegDecoder, VideoDecoder, VideoFile, open_packet_decoder
from mp4ds.video.media import raise_if_scarce
from mp4ds.video.mp4 import SampleTable, read_sample_table, sample_table_of
from mp4ds.video.pixels import PictureMaker, Scale

# ---------------------------------------------------------------- structures

MAX_STRUCTURES = 256
"""Maximum number of distinct ones in a video; one that has more is not described."""

MAX_STRUCTURE_CHARS = 2**16
MAX_CHARS = 2**20
"""Maximum total length of all structures of a video."""

_FRAME = r"(k|[1-9][0-9]{0,5}(,[1-9][0-9]{0,5})*)"
_PACKET = rf"{_FRAME}(\+{_FRAME})*"
STRUCTURE_PATTERN = rf"^k(\+{_FRAME})*( {_PACKET})*$"

_BLOCK = 2**20
_KEY = "k"

Needs = tuple[int, ...]
"""Numbers of the coded frames that a frame refers to, counted from its key frame."""


class StructureError(ValueError):
    """A structure contradicts itself; the text says how."""


@dataclass(frozen=True, eq=False)
class Structures:
    """The structures of a video's groups of pictures.

    Attributes:
        texts: The distinct structures.
        groups: Number of each group's structure, int64, shape (groups,).
    """

    texts: Sequence[str]
    groups: NDArray[np.int64]

    @property
    def is_plain(self) -> bool:
        """Whether every frame needs the one before it, so that none can be skipped."""
        return all(
            frame.startswith("1,") or frame == "1"
            for text in self.texts
            for frame in text.replace("+", " ").split(" ")[1:]
        )

    def check(self) -> None:
        """Refuse a structure that contradicts itself.

        Raises:
            StructureError: One does; see `read_structure`.
        """
        for text in self.texts:
            read_structure(text)

    def mismatch(self, packets: NDArray[np.int64]) -> str:
        """Why these cannot be the structures of a video, in words; empty if they can.

        Args:
            packets: Of each group, shape (groups,).
        """
        if len(self.groups) != len(packets):
            return (
                f"they are of {len(self.groups)} groups of pictures, of which it has {len(packets)}"
            )
        if len(self.groups) and not 0 <= self.groups.min() <= self.groups.max() < len(self.texts):
            return "they name a structure that is not there"
        due = np.array([text.count(" ") + 1 for text in self.texts], np.int64)[self.groups]
        wrong = np.flatnonzero(due != packets)
        if len(wrong):
            first = int(wrong[0])
            return (
                f"they are of {due[first]} packets in group of pictures {first}, "
                f"which has {packets[first]}"
            )
        return ""


def read_structure(text: str) -> list[list[Needs]]:
    """What the coded frames of each packet of a group need.

    Args:
        text: Matches `STRUCTURE_PATTERN`.

    Raises:
        StructureError: A frame needs one before the key frame, or distances do not increase.
    """
    packets: list[list[Needs]] = []
    number = 0
    for packet in text.split(" "):
        frames: list[Needs] = []
        for frame in packet.split("+"):
            distances = () if frame == _KEY else tuple(map(int, frame.split(",")))
            if any(one >= other for one, other in pairwise(distances)):
                raise StructureError(f"the distances {frame[:40]} do not increase")
            if distances and distances[-1] > number:
                raise StructureError(
                    f"packet {len(packets)} refers to {distances[-1]} frames back, "
                    f"before the key frame"
                )
            frames.append(tuple(number - distance for distance in distances))
            number += 1
        packets.append(frames)
    return packets


def find_structures(
    codec: str, configuration: bytes, packets: Iterable[tuple[bytes, bool]]
) -> Structures | None:
    """The structures of a video.

    Memory is bounded by `MAX_CHARS` and eight bytes per group of pictures.

    Args:
        codec: Name in the registry.
        configuration: Of the track, as for its `StreamParser`.
        packets: As the mp4 holds them, each with whether the file says that decoding can begin
            there, in the order coded.

    Returns:
        None if the references of a frame are not known, or there are too many structures, or they
        are too long.
    """
    numbers: dict[str, int] = {}
    groups = array("q")
    try:
        for text in _texts(codec, configuration, packets):
            groups.append(numbers.setdefault(text, len(numbers)))
            if len(numbers) > MAX_STRUCTURES or sum(map(len, numbers)) > MAX_CHARS:
                return None
    except UnknownStructure:
        return None
    return Structures(tuple(numbers), np.array(groups, np.int64)) if groups else None


def _texts(
    codec: str, configuration: bytes, packets: Iterable[tuple[bytes, bool]]
) -> Iterator[str]:
    """The structure of each group."""
    parser: StreamParser | None = None
    texts: list[str] = []
    for packet, is_key in packets:
        if is_key:
            if texts:
                yield " ".join(texts)
            texts, parser = [], CODECS[codec].parser(configuration)
            chars = 0
        if parser is None:
            raise UnknownStructure("it comes before the first key frame")
        frames = parser.frames(packet, key=is_key)
        if [frame.shown for frame in frames] != [False] * (len(frames) - 1) + [True]:
            raise UnknownStructure("it does not end with the only picture that it shows")
        texts.append("+".join(",".join(map(str, f.references)) or _KEY for f in frames))
        chars += len(texts[-1]) + 1
        if chars > MAX_STRUCTURE_CHARS:
            raise UnknownStructure("its structure is too long")
    if texts:
        yield " ".join(texts)


# ---------------------------------------------------------------- digest


def digest_video(path: Path, codec: str) -> tuple[int, str, Structures | None]:
    """Hash a video, and find what its frames refer to.

    Memory is one packet, and the video's index.

    Args:
        path: An mp4.
        codec: Name in the registry.

    Returns:
        Bytes of the file, its SHA-256, and what its frames refer to, if known.

    Raises:
        OSError: It cannot be read.
    """
    table = _table(path, codec)
    if table is None:
        return *digest_file(path), None
    digest = hashlib.sha256()
    with path.open("rb") as file:  # read once: it may be large, and far away
        found = find_structures(
            codec, table.entry.configuration, _packets(file, table, digest.update)
        )
        _pass(file, digest.update)
        return file.tell(), digest.hexdigest(), found


def _table(path: Path, codec: str) -> SampleTable | None:
    if codec not in CODECS or not CODECS[codec].is_free:
        return None
    try:
        table = sample_table_of(path)
    except (VideoError, Refused):
        return None
    if np.any(table.places[1:] < (table.places + table.sizes)[:-1]):
        return None  # a forged index could have the whole file read for each packet
    return table


def _packets(
    file: BinaryIO, table: SampleTable, seen: Callable[[bytes], object]
) -> Iterator[tuple[bytes, bool]]:
    columns = (table.places.tolist(), table.sizes.tolist(), table.sync.tolist())
    for place, size, is_key in zip(*columns, strict=True):
        _pass(file, seen, place)
        packet = file.read(size)
        seen(packet)
        yield packet, is_key


def _pass(file: BinaryIO, seen: Callable[[bytes], object], end: int | None = None) -> None:
    """Show what there is up to a place, or to the end of the file."""
    while block := file.read(_BLOCK if end is None else min(_BLOCK, end - file.tell())):
        seen(block)


def packets_of_groups(table: SampleTable) -> NDArray[np.int64]:
    """How many packets each group of pictures has, shape (groups,)."""
    return np.diff(np.append(np.flatnonzero(table.sync), len(table.sync)))


# ---------------------------------------------------------------- chains

KEPT_FRAMES = 50_000  # coded frames whose references are kept in memory


@dataclass(frozen=True, slots=True)
class Piece:
    """A coded frame: the part of a packet to pass to a decoder.

    Attributes:
        sample: Number of the packet.
        part: Number of the coded frame in it.
        needs: Numbers, within its group, of the pieces that it refers to.
    """

    sample: int
    part: int
    needs: tuple[int, ...]


@dataclass(slots=True)
class Group:
    """The coded frames from one key frame to the next, as far as known.

    Attributes:
        first: Number of the key frame's packet.
        end: Number of the next group's.
        parser: Of its packets; None if nothing needs to be parsed.
        pieces: In the order coded.
        shows: For each known packet, the number of the piece that outputs its picture.
    """

    first: int
    end: int
    parser: StreamParser | None
    pieces: list[Piece] = field(default_factory=list)
    shows: list[int] = field(default_factory=list)

    def chain(self, samples: Iterable[int]) -> list[int]:
        """Numbers of the pieces that output the pictures of packets, and of what they depend on."""
        pending = [self.shows[sample - self.first] for sample in samples]
        found = set(pending)
        while pending:
            for number in self.pieces[pending.pop()].needs:
                if number not in found:
                    found.add(number)
                    pending.append(number)
        return sorted(found)


class Chains:
    """The groups of a video; each is analysed when it is first needed.

    Args:
        table: The video's index.
        codec: Name in the registry.
        read: Gives a packet by its number.
        recorded: What the frames refer to, if that was recorded; it matches the index.

    Raises:
        UnknownStructure: The configuration in the index is malformed.
    """

    def __init__(
        self,
        table: SampleTable,
        codec: str,
        read: Callable[[int], bytes],
        recorded: Structures | None = None,
    ) -> None:
        self._table = table
        self._codec = codec
        self._read = read
        self._recorded = recorded
        self._keys = np.flatnonzero(table.sync)
        self._groups: OrderedDict[int, Group] = OrderedDict()
        self._kept = 0  # coded frames of these
        self._new_parser()  # which refuses a configuration that is malformed

    def group(self, sample: int, last: int) -> Group:
        """The group that a packet is in, known up to another one of it.

        Raises:
            UnknownStructure: What its frames refer to is not known.
            StructureError: The recorded structure contradicts itself.
        """
        place = self._place(sample)
        group = self._groups.pop(place, None)
        if group is None:
            group = self._begin(place)
        else:
            self._kept -= len(group.pieces)
        if group.parser is not None:
            self._parse(group, group.parser, last)
        while self._groups and self._kept + len(group.pieces) > KEPT_FRAMES:
            _, forgotten = self._groups.popitem(last=False)
            self._kept -= len(forgotten.pieces)
        self._groups[place] = group
        self._kept += len(group.pieces)
        return group

    def cut(self, group: Group, piece: Piece, packet: bytes) -> bytes:
        """Extract the bytes of a piece from its packet.

        Raises:
            Refused: It does not hold the coded frames recorded for it.
        """
        last = group.pieces[group.shows[piece.sample - group.first]]
        found = CODECS[self._codec].parser.spans(packet)
        is_recorded = group.parser is None
        if len(found) <= piece.part or (is_recorded and len(found) != last.part + 1):
            raise UnknownStructure(f"it holds {len(found)} coded frames, {last.part + 1} are due")
        header, start, end = found[piece.part]
        return packet[start if piece.needs else header : end]

    def unknown(self, sample: int, last: int) -> range:
        """Numbers of the packets that `group` would have to read."""
        if self._recorded is not None:
            return range(0)
        place = self._place(sample)
        group = self._groups.get(place)
        first = self._first(place) if group is None else group.first + len(group.shows)
        return range(first, last + 1)

    def _place(self, sample: int) -> int:
        return int(np.searchsorted(self._keys, sample, side="right")) - 1

    def _first(self, place: int) -> int:
        return int(self._keys[place]) if place >= 0 else 0

    def split(self, samples: list[int]) -> Iterator[list[int]]:
        """Packets by group; those of a group must be consecutive."""
        if len(samples) == 1:
            yield samples
            return
        places = np.searchsorted(self._keys, np.array(samples, np.int64), side="right")
        bounds = [0, *(np.flatnonzero(np.diff(places)) + 1).tolist(), len(samples)]
        for start, end in pairwise(bounds):
            yield samples[start:end]

    def _new_parser(self) -> StreamParser:
        return CODECS[self._codec].parser(self._table.entry.configuration)

    def _begin(self, place: int) -> Group:
        count = len(self._table.sizes)
        following = self._keys[place + 1] if place + 1 < len(self._keys) else count
        group = Group(self._first(place), int(following), None)
        if self._recorded is None:
            group.parser = self._new_parser()
            return group
        text = self._recorded.texts[int(self._recorded.groups[place])]
        for sample, frames in enumerate(read_structure(text), group.first):
            for part, needs in enumerate(frames):
                group.pieces.append(Piece(sample, part, needs))
            group.shows.append(len(group.pieces) - 1)
        return group

    def _parse(self, group: Group, parser: StreamParser, last: int) -> None:
        for sample in range(group.first + len(group.shows), last + 1):
            frames = parser.frames(self._read(sample), key=sample == group.first)
            shown = -1
            for part, frame in enumerate(frames):
                number = len(group.pieces)
                needs = tuple(number - distance for distance in frame.references)
                group.pieces.append(Piece(sample, part, needs))
                if frame.shown:
                    shown = number
            group.shows.append(shown)


# ---------------------------------------------------------------- access


class FrameReader:
    """Frames of one mp4 by number; others are decoded only if necessary.

    What a frame depends on is recorded or parsed, and a decoder gets only that. Where this is not
    known, or the index cannot be used, frames are decoded from the key frame before: ffmpeg reads
    more videos than we do, and tells what is wrong with the others.

    One thread at a time may use it, in the process that opened it.

    Args:
        path: The video.
        codec: Name in the registry, or ffmpeg's.
        frames: Expected number of frames.
        maker: Makes pictures of its frames.
        references: Decodes what the sidecar says about them, which saves reading packets to find
            out, from the number of packets of each group; ValueError if that is of another video.
        file: What is known of a third-party video.

    Attributes:
        seeking: Decodes from key frames, once that is the only way; else None.

    Raises:
        VideoError: It cannot be read, or does not match what is expected.
        FormatError: ``references-invalid``: what the sidecar says does not fit the video.
    """

    def __init__(
        self,
        path: Path,
        *,
        codec: str,
        frames: int,
        maker: PictureMaker,
        references: Callable[[NDArray[np.int64]], Structures] | None = None,
        file: VideoFile | None = None,
    ) -> None:
        self._path = path
        self._codec = codec
        self._frames = frames
        self._maker = maker
        self._video = file
        self._context: Any = None
        # what the decoder received: numbers of pieces of a group; None: start over
        self._group: Group | None = None
        self._fed: set[int] = set()
        self.seeking: VideoDecoder | None = None
        with suppress(UnknownStructure, VideoError, OSError):
            self._open(references)
            return
        self.seeking = self._open_seeking()

    def _open(self, references: Callable[[NDArray[np.int64]], Structures] | None) -> None:
        self._file: BinaryIO = self._path.open("rb")
        try:
            self.table = self._read_table()
            try:
                recorded = references(packets_of_groups(self.table)) if references else None
            except ValueError as error:
                raise self._unfit(error) from None
            self._chains = Chains(self.table, self._codec, self._packet, recorded)
        except BaseException:
            self._file.close()
            raise
        hidden = len(self.table.sizes) - len(self.table.order)
        self._numbers = np.arange(len(self.table.sizes)) - hidden
        self._numbers[self.table.order] = np.arange(len(self.table.order))

    def _open_seeking(self) -> VideoDecoder:
        return VideoDecoder(
            self._path,
            codec=self._codec,
            frames=self._frames,
            maker=self._maker,
            sequential=False,
            file=self._video,
        )

    def _read_table(self) -> SampleTable:
        try:
            size = self._path.stat().st_size
            table = read_sample_table(self._file, size, str(self._path))
        except Refused as error:
            raise UnknownStructure(f"its index cannot be used: {error}") from None
        known = CODECS.get(self._codec)
        if known is None or table.entry.codec not in known.entries:
            raise UnknownStructure(f"its track is {table.entry.codec!r}")
        if len(table.order) != self._frames:
            raise VideoError(
                "frame-count", self._path, f"has {len(table.order)} frames, not {self._frames}"
            )
        if (table.entry.width, table.entry.height) != self._maker.coded_size:
            raise UnknownStructure("its frames have a different size")
        if int(table.order.min()) + len(table.order) != len(table.sizes) or not table.sync[0]:
            raise UnknownStructure(
                "it has trailing frames that are not shown, or does not start with a key frame"
            )
        return table

    def _unfit(self, error: ValueError) -> FormatError:
        return FormatError(
            "references-invalid",
            self._path,
            f"does not match the references in its sidecar: {error}",
        )

    def pictures_of(
        self,
        numbers: Sequence[int],
        scale: Scale | None = None,
        outs: Mapping[int, Pixels] | None = None,
    ) -> Iterator[tuple[int, Picture]]:
        """Pictures of some frames, each with its number.

        Args:
            numbers: 0 <= number < frames, increasing.
            scale: See `PictureMaker.make`.
            outs: Its `out`, by frame; it may stay unused.

        Yields:
            Views that are valid until the next one is requested.

        Raises:
            VideoError: ``decode-failed``, naming the frame; or see `VideoDecoder.pictures_at`.
            FormatError: ``references-invalid``.
        """
        done = 0
        if self.seeking is None:
            samples = self.table.order[np.asarray(numbers, np.int64)].tolist()
            with suppress(UnknownStructure):
                for wanted in self._chains.split(samples) if samples else ():
                    for pair in self._of_group(wanted, scale, outs or {}):
                        done += 1
                        yield pair
                return
            self.seeking = self._open_seeking()
            self._close_access()
        yield from self.seeking.pictures_at(numbers[done:], scale)

    def _of_group(
        self, wanted: list[int], scale: Scale | None, outs: Mapping[int, Pixels]
    ) -> Iterator[tuple[int, Picture]]:
        self._announce(self._chains.unknown(wanted[0], max(wanted)))
        try:
            group = self._chains.group(wanted[0], max(wanted))
        except StructureError as error:
            raise self._unfit(error) from None
        missing = self._begin(group, wanted)
        due = {sample: int(self._numbers[sample]) for sample in wanted}
        try:
            for frame in self._decoded(group, missing):
                if frame.is_corrupt:
                    self._context = self._group = None
                    raise_if_scarce()
                    raise self._damage(due, "is marked as corrupt")
                number = due.pop(frame.pts, None) if frame.pts is not None else None
                if number is not None:
                    yield number, self._maker.make(frame, number, scale, outs.get(number))
                if not due:
                    return
        except FFmpegError as error:
            raise_if_scarce(error)
            self._context = self._group = None
            raise self._damage(due, f"cannot be decoded: {reason_of(error)}") from None
        raise self._damage(due, "was not found")

    def _damage(self, due: Mapping[int, int], what: str) -> VideoError:
        return VideoError("decode-failed", self._path, what, frame=min(due.values()))

    def _decoded(self, group: Group, missing: list[int]) -> Iterator[av.VideoFrame]:
        self._announce(dict.fromkeys(group.pieces[number].sample for number in missing))
        sample, packet = -1, b""
        for place in missing:
            piece = group.pieces[place]
            if piece.sample != sample:
                sample, packet = piece.sample, self._packet(piece.sample)
            try:
                data = av.Packet(self._chains.cut(group, piece, packet))
            except Refused as error:
                number = int(self._numbers[piece.sample])
                problem = f"is damaged: {error}"
                raise VideoError("decode-failed", self._path, problem, frame=number) from None
            data.pts = data.dts = sample
            # else ffmpeg adds a PNG file to the picture before it
            data.is_keyframe = bool(self.table.sync[sample])
            self._fed.add(place)
            yield from self._context.decode(data)
        # some decoders hold frames back; once they gave them they take nothing more
        self._group = None
        yield from self._context.decode(None)

    def _begin(self, group: Group, wanted: list[int]) -> list[int]:
        """Numbers of the pieces that the decoder is still to be given, in the order coded.

        It goes on if these come after all that it was given, and no picture is wanted that has
        come out already: one comes out once.
        """
        chain = group.chain(wanted)
        if group is self._group:
            shown = {group.shows[sample - group.first] for sample in wanted}
            missing = [number for number in chain if number not in self._fed]
            if self._fed.isdisjoint(shown) and missing[0] > max(self._fed, default=-1):
                return missing
        if self._context is None:
            self._context = self._new_context()
        else:
            self._context.flush_buffers()
        self._group, self._fed = group, set()
        return chain

    def _new_context(self) -> Any:
        entry = self.table.entry
        size = entry.width, entry.height
        if self._codec == "mjpeg":
            return JpegDecoder(self._maker.coded_size)
        context = open_packet_decoder(self._codec, size, entry.configuration)
        for name, value in entry.colour.items():
            setattr(context, name, value)
        if self._codec != "av1":
            # concealed damage would depend on which frames were decoded before
            context.options = {**context.options, "err_detect": "explode"}
        elif self._maker.is_view:
            context.options["export_side_data"] = "film_grain"
        return context

    def _announce(self, samples: Iterable[int]) -> None:
        """Tell a remote file exactly which packets will be read next."""
        places, sizes = self.table.places, self.table.sizes
        ranges = [(int(places[s]), int(places[s] + sizes[s])) for s in samples]
        if ranges:
            expect(self._file, ranges)

    def _packet(self, sample: int) -> bytes:
        self._file.seek(int(self.table.places[sample]))
        size = int(self.table.sizes[sample])
        packet = self._file.read(size)
        if len(packet) != size:
            number = int(self._numbers[sample])
            raise VideoError("decode-failed", self._path, "is cut off", frame=number)
        return packet

    def close(self) -> None:
        """Close the file."""
        if self.seeking is None:
            self._close_access()
        else:
            self.seeking.close()

    def _close_access(self) -> None:
        self._context = self._group = None
        self._file.close()
