"""Frames of a video by number: a decoder is given only what they need.

To show a frame, a decoder needs the key frame before it and the frames that it refers to, over as
many steps as it takes. All others in between are left out (`mp4ds.video.chains`); what comes out
is the same. Where nothing is known of the references, `mp4ds.video.reader` decodes them all.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np
from av.error import FFmpegError

from mp4ds.coded import Refused
from mp4ds.coded.references import UnknownStructure
from mp4ds.coded.structure import StructureError, Structures
from mp4ds.errors import FormatError, VideoError
from mp4ds.layouts import Picture
from mp4ds.remote import expect
from mp4ds.sidecar import References
from mp4ds.video.chains import Chains, Group, Piece
from mp4ds.video.digest import packets_of_groups
from mp4ds.video.jpeg import JpegDecoder
from mp4ds.video.pictures import PictureMaker
from mp4ds.video.samples import SampleTable, Unindexed, read_sample_table
from mp4ds.video.scarcity import raise_if_scarce

_DECODERS = {
    "h264": "h264",
    "h265": "hevc",
    "av1": "libdav1d",
    "vp9": "vp9",
    "ffv1": "ffv1",
}
CODECS_OF_ENTRIES = {  # codecs by the four letters of their sample entry
    **dict.fromkeys(("avc1", "avc3"), "h264"),
    **dict.fromkeys(("hvc1", "hev1"), "h265"),
    "av01": "av1",
    "vp09": "vp9",
    "FFV1": "ffv1",
    **dict.fromkeys(("mp4v", "jpeg"), "mjpeg"),
}


class FrameAccess:
    """Random access to the frames of one mp4. A context manager.

    Not to be shared between threads or over a fork.

    Args:
        path: The video.
        codec: Name in the registry.
        frames: Number of frames that are due; None where only the video tells.
        maker: Makes pictures of its frames.
        threads: Of the decoder. One takes the least CPU time; with more, one frame comes sooner.
        references: What the sidecar says of them, so that no packets are read to find out.

    Raises:
        UnknownStructure: Its frames cannot be had one by one.
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
        references: References | None = None,
    ) -> None:
        self._path = path
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
        self._numbers = np.empty_like(self.table.order)
        self._numbers[self.table.order] = np.arange(len(self.table.order))
        self._context: Any = None
        self._session: _Session | None = None

    def _read_table(self, frames: int | None) -> SampleTable:
        try:
            table = read_sample_table(self._file, self._path.stat().st_size, str(self._path))
        except Unindexed as error:
            raise UnknownStructure(f"its index is not read: {error}") from None
        if CODECS_OF_ENTRIES.get(table.codec) != self._codec:
            raise UnknownStructure(f"its track is {table.codec!r}")
        if frames is not None and len(table.order) != frames:
            raise VideoError(
                "frame-count", self._path, f"has {len(table.order)} frames, {frames} are due"
            )
        if (table.width, table.height) != self._maker.coded_size:
            raise UnknownStructure("its frames have another size")
        if len(table.order) != len(table.sizes) or not table.sync[:1].all():
            raise UnknownStructure(
                "it has frames that are not shown, or begins without a key frame"
            )
        return table

    def _recorded(self, references: References) -> Structures:
        try:
            return references.decode(packets_of_groups(self.table))
        except ValueError as error:
            raise self._unfit(error) from None

    def _unfit(self, error: ValueError) -> FormatError:
        return FormatError(
            "references-invalid", self._path, f"does not fit the references in its sidecar: {error}"
        )

    def pictures_of(self, numbers: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """Pictures of some frames, each with its number.

        Args:
            numbers: 0 <= number < frames, increasing.

        Yields:
            Views that hold until the next one is asked for.

        Raises:
            UnknownStructure: What the frames refer to is not known; nothing was given of those that
                follow.
            VideoError: ``decode-failed``, naming the frame.
            FormatError: ``references-invalid``.
        """
        samples = self.table.order[np.asarray(numbers, np.int64)].tolist()
        for wanted in self._chains.split(samples) if samples else ():
            yield from self._of_group(wanted)

    def _of_group(self, wanted: list[int]) -> Iterator[tuple[int, Picture]]:
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
                    yield number, self._maker.make(frame, number)
                if not due:
                    return
        except FFmpegError as error:
            raise_if_scarce(error)
            self._context = self._session = None
            raise self._damage(due, f"cannot be decoded: {error}") from None
        raise self._damage(due, "was not found")

    def _group(self, wanted: list[int]) -> Group:
        try:
            return self._chains.group(wanted[0], max(wanted))
        except StructureError as error:
            raise self._unfit(error) from None

    def _damage(self, due: Mapping[int, int], what: str) -> VideoError:
        return VideoError("decode-failed", self._path, f"frame {min(due.values())} {what}")

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
            raise VideoError(
                "decode-failed", self._path, f"frame {number} is damaged: {error}"
            ) from None

    def _begin(self, group: Group) -> None:
        if self._context is None:
            self._context = self._new_context()
        else:
            self._context.flush_buffers()
        self._session = _Session(group)

    def _new_context(self) -> Any:
        if self._codec == "mjpeg":
            return JpegDecoder(self._maker.coded_size)
        context: Any = av.CodecContext.create(_DECODERS[self._codec], "r")
        if self.table.configuration:
            context.extradata = self.table.configuration
        context.width, context.height = self.table.width, self.table.height
        if self.table.colour:
            self.table.colour.apply(context)
        context.thread_count = self._threads
        context.thread_type = "SLICE"
        # concealed damage would depend on which frames were decoded before
        context.options = {"err_detect": "explode"}
        if self._codec == "av1":
            context.options = {"max_frame_delay": "1"}
        return context

    def _announce(self, samples: Iterable[int]) -> None:
        """Tell a remote file which packets are read next, and that no others are."""
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
            raise VideoError("decode-failed", self._path, f"ends before frame {number}")
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
    """A decoder's way through a group.

    Attributes:
        group: Which it is.
        fed: Numbers of the pieces that it was given.
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
