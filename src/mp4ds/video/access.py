"""Frames of a video by number, decoding only what they depend on."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mp4ds.errors import FormatError, Refused, VideoError, reason_of
from mp4ds.files.ranges import expect
from mp4ds.messages.encodings import Picture, Pixels
from mp4ds.video.codecs import CODECS
from mp4ds.video.coded import StreamParser, UnknownStructure
from mp4ds.video.decoder import JpegDecoder
from mp4ds.video.media import raise_if_scarce
from mp4ds.video.mp4 import SampleTable, read_sample_table
from mp4ds.video.pixels import PictureMaker, Scale
from mp4ds.video.references import (
    StructureError,
    Structures,
    packets_of_groups,
    read_structure,
)

# ---------------------------------------------------------------- chains

KEPT_FRAMES = 50_000  # coded frames whose references are kept in memory


@dataclass(frozen=True, slots=True)
class Piece:
    """A coded frame: the part of a packet to pass to a decoder.

    Attributes:
        sample: Number of the packet.
        part: Number of the coded frame in it.
        needs: Numbers, within its group, of the pieces that it refers to.
        span: Its first byte in the packet and the one after its last; None until it is read.
    """

    sample: int
    part: int
    needs: tuple[int, ...]
    span: tuple[int, int] | None


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
        if piece.span is not None:
            start, end = piece.span
            return packet if (start, end) == (0, len(packet)) else packet[start:end]
        last = group.pieces[group.shows[piece.sample - group.first]]
        found = CODECS[self._codec].parser.spans(packet)
        if len(found) != last.part + 1:
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
                group.pieces.append(Piece(sample, part, needs, None))
            group.shows.append(len(group.pieces) - 1)
        return group

    def _parse(self, group: Group, parser: StreamParser, last: int) -> None:
        for sample in range(group.first + len(group.shows), last + 1):
            frames = parser.frames(self._read(sample), key=sample == group.first)
            shown = -1
            for part, frame in enumerate(frames):
                number = len(group.pieces)
                needs = tuple(number - distance for distance in frame.references)
                group.pieces.append(Piece(sample, part, needs, (frame.start, frame.end)))
                if frame.shown:
                    shown = number
            group.shows.append(shown)


# ---------------------------------------------------------------- access


class FrameAccess:
    """Random access to the frames of one mp4. A context manager.

    One thread at a time may use it, in the process that opened it.

    Args:
        path: The video.
        codec: Name in the registry.
        frames: Expected number of frames; None to take it from the video.
        maker: Makes pictures of its frames.
        threads: Of the decoder. One takes the least CPU time; with more, one frame comes sooner.
        references: Decodes what the sidecar says about them, which saves reading packets to find
            out, from the number of packets of each group; ValueError if that is of another video.
        track: See `read_sample_table`.

    Raises:
        UnknownStructure: Its frames cannot be decoded one by one.
        VideoError: ``video-unreadable`` or ``frame-count``.
        FormatError: ``references-invalid``: what the sidecar says does not fit the video.
    """

    def __init__(
        self,
        path: Path,
        *,
        codec: str,
        frames: int | None,
        maker: PictureMaker,
        threads: int = 1,
        references: Callable[[NDArray[np.int64]], Structures] | None = None,
        track: int | None = None,
    ) -> None:
        self._path = path
        self._track = track
        self._codec = codec
        self._maker = maker
        self._threads = threads
        self._file: BinaryIO = path.open("rb")
        try:
            self.table = self._read_table(frames)
            recorded = self._recorded(references) if references else None
            self._chains = Chains(self.table, codec, self._packet, recorded)
        except BaseException:
            self._file.close()
            raise
        hidden = len(self.table.sizes) - len(self.table.order)
        self._numbers = np.arange(len(self.table.sizes)) - hidden
        self._numbers[self.table.order] = np.arange(len(self.table.order))
        self._context: Any = None
        self._session: _Session | None = None

    def _read_table(self, frames: int | None) -> SampleTable:
        try:
            size = self._path.stat().st_size
            table = read_sample_table(self._file, size, str(self._path), self._track)
        except Refused as error:
            raise UnknownStructure(f"its index cannot be used: {error}") from None
        known = CODECS.get(self._codec)
        if known is None or table.entry.codec not in known.entries:
            raise UnknownStructure(f"its track is {table.entry.codec!r}")
        if frames is not None and len(table.order) != frames:
            raise VideoError(
                "frame-count", self._path, f"has {len(table.order)} frames, not {frames}"
            )
        if (table.entry.width, table.entry.height) != self._maker.coded_size:
            raise UnknownStructure("its frames have a different size")
        if int(table.order.min()) + len(table.order) != len(table.sizes) or not table.sync[0]:
            raise UnknownStructure(
                "it has trailing frames that are not shown, or does not start with a key frame"
            )
        return table

    def _recorded(self, references: Callable[[NDArray[np.int64]], Structures]) -> Structures:
        try:
            return references(packets_of_groups(self.table))
        except ValueError as error:
            raise self._unfit(error) from None

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
            outs: Its `out`, by frame.

        Yields:
            Views that are valid until the next one is requested.

        Raises:
            UnknownStructure: What the frames refer to is not known; the remaining frames were not
                yielded.
            VideoError: ``decode-failed``, naming the frame.
            FormatError: ``references-invalid``.
        """
        samples = self.table.order[np.asarray(numbers, np.int64)].tolist()
        for wanted in self._chains.split(samples) if samples else ():
            yield from self._of_group(wanted, scale, outs or {})

    def _of_group(
        self, wanted: list[int], scale: Scale | None, outs: Mapping[int, Pixels]
    ) -> Iterator[tuple[int, Picture]]:
        self._announce(self._chains.unknown(wanted[0], max(wanted)))
        group = self._group(wanted)
        chain = group.chain(wanted)
        shown = {group.shows[sample - group.first] for sample in wanted}
        if self._session is None or not self._session.goes_on(group, chain, shown):
            self._begin(group)
        due = {sample: int(self._numbers[sample]) for sample in wanted}
        try:
            for frame in self._decoded(chain):
                if frame.is_corrupt:
                    self._context = self._session = None
                    raise_if_scarce()
                    raise self._damage(due, "is marked as corrupt")
                number = due.pop(frame.pts, None) if frame.pts is not None else None
                if number is not None:
                    yield number, self._maker.make(frame, number, scale, outs.get(number))
                if not due:
                    return
        except FFmpegError as error:
            raise_if_scarce(error)
            self._context = self._session = None
            raise self._damage(due, f"cannot be decoded: {reason_of(error)}") from None
        raise self._damage(due, "was not found")

    def _group(self, wanted: list[int]) -> Group:
        try:
            return self._chains.group(wanted[0], max(wanted))
        except StructureError as error:
            raise self._unfit(error) from None

    def _damage(self, due: Mapping[int, int], what: str) -> VideoError:
        return VideoError("decode-failed", self._path, what, frame=min(due.values()))

    def _decoded(self, chain: list[int]) -> Iterator[av.VideoFrame]:
        session = self._session
        if session is None:
            return
        missing = [number for number in chain if number not in session.fed]
        self._announce(dict.fromkeys(session.group.pieces[number].sample for number in missing))
        sample, packet = -1, b""
        for number in missing:
            piece = session.group.pieces[number]
            if piece.sample != sample:
                sample, packet = piece.sample, self._packet(piece.sample)
            data = av.Packet(self._cut(session.group, piece, packet))
            data.pts = data.dts = sample
            session.fed.add(number)
            session.last = number
            yield from self._context.decode(data)
        # some decoders hold frames back; once they gave them they take nothing more
        self._session = None
        yield from self._context.decode(None)

    def _cut(self, group: Group, piece: Piece, packet: bytes) -> bytes:
        try:
            return self._chains.cut(group, piece, packet)
        except Refused as error:
            number = int(self._numbers[piece.sample])
            problem = f"is damaged: {error}"
            raise VideoError("decode-failed", self._path, problem, frame=number) from None

    def _begin(self, group: Group) -> None:
        if self._context is None:
            self._context = self._new_context()
        else:
            self._context.flush_buffers()
        self._session = _Session(group)

    def _new_context(self) -> Any:
        if self._codec == "mjpeg":
            return JpegDecoder(self._maker.coded_size)
        context: Any = av.CodecContext.create(CODECS[self._codec].decoder, "r")
        entry = self.table.entry
        if entry.configuration:
            context.extradata = entry.configuration
        context.width, context.height = entry.width, entry.height
        if entry.colour:
            entry.colour.apply(context)
        context.thread_count = self._threads
        context.thread_type = "SLICE"
        # concealed damage would depend on which frames were decoded before
        context.options = {"err_detect": "explode"}
        if self._codec == "av1":
            context.options = {"max_frame_delay": "1"}
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
        self._context = self._session = None
        self._file.close()

    def __enter__(self) -> FrameAccess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(slots=True)
class _Session:
    """A decoder's progress through a group.

    Attributes:
        group: Which it is.
        fed: Numbers of the pieces it has received.
        last: The last of them.
    """

    group: Group
    fed: set[int] = field(default_factory=set)
    last: int = -1

    def goes_on(self, group: Group, chain: list[int], shown: set[int]) -> bool:
        """Whether all that is still needed comes after what it was given.

        Args:
            group: The group of what is wanted.
            chain: Numbers of the pieces that are needed.
            shown: Those of them that make pictures come out: a picture comes out once.
        """
        if group is not self.group or not self.fed.isdisjoint(shown):
            return False
        return all(number > self.last for number in chain if number not in self.fed)


# ---------------------------------------------------------------- reader


class Seeking(Protocol):
    """A decoder that reaches a frame by decoding from the key frame before it."""

    def picture(self, index: int, scale: Scale | None = None) -> Picture:
        """The picture of a frame; see `PictureMaker.make`."""

    def close(self) -> None:
        """Close the file."""


class FrameReader:
    """Gives frames by number; others are decoded only if necessary.

    A context manager. One thread at a time may use it, in the process that opened it.

    Args:
        open_access: Opens the decoder of single frames and their references; None if there is none.
        open_decoder: Opens the decoder from key frames, used where that is impossible.

    Raises:
        VideoError: Neither can be opened; the error of the latter.
    """

    def __init__(
        self, open_access: Callable[[], FrameAccess] | None, open_decoder: Callable[[], Seeking]
    ) -> None:
        self._open_decoder = open_decoder
        self._access: FrameAccess | None = None
        self._decoder: Seeking | None = None
        if open_access is not None:
            # ffmpeg reads more, and tells what it does not
            with suppress(UnknownStructure, VideoError, OSError):
                self._access = open_access()
        if self._access is None:
            self._decoder = open_decoder()

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
            VideoError: One cannot be decoded.
        """
        done = 0
        if self._access is not None:
            try:
                for pair in self._access.pictures_of(numbers, scale, outs):
                    done += 1
                    yield pair
                return
            except UnknownStructure:
                self._access.close()
                self._access = None
        if self._decoder is None:
            self._decoder = self._open_decoder()
        for number in numbers[done:]:
            yield number, self._decoder.picture(number, scale)

    def close(self) -> None:
        """Close the file."""
        for part in (self._access, self._decoder):
            if part is not None:
                part.close()

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
