"""Write, read, cut and join packets in mp4 files; nothing is encoded or decoded."""

from __future__ import annotations

import io
import struct
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mp4ds.errors import Mp4dsError, Refused, VideoError, path_text
from mp4ds.times import TIMESCALE
from mp4ds.video.codecs import CODECS
from mp4ds.video.media import (
    TIME_BASE,
    Media,
    Mp4Writer,
    new_mp4,
    open_input,
    pixel_format_of,
    raise_if_scarce,
    rate_hint,
)
from mp4ds.video.mp4 import SampleEntry


class PacketWriter(Mp4Writer):
    """One mp4 of coded packets being written. A context manager; leaving it completes the file.

    The first body must be a key frame that the codec's `StreamParser` accepts.

    Args:
        path: The file to make, by the first body.
        codec: One of `mp4ds.video.codecs.COPIED_CODECS`.
        width: Columns of the pictures.
        height: Rows of the pictures.
        parameters: Parameter sets or sequence header, as in `StreamParser.parameters`; used if the
            first body has none.
        rate: Frames per second, if known: it gives the last frame its duration.
    """

    def __init__(
        self,
        path: Path,
        codec: str,
        *,
        width: int,
        height: int,
        parameters: bytes = b"",
        rate: float | None = None,
    ) -> None:
        self.codec = codec
        self._parser = CODECS[codec].parser
        self.width, self.height = width, height
        self._path = path
        self._parameters = parameters
        self._rate = rate_hint(rate)
        self._stream: Any = None
        self._written = _Written()
        self._first = self._last = b""

    @property
    def frames(self) -> int:
        """Packets written."""
        return len(self._written.ticks)

    def write(self, body: bytes | memoryview, tick: int, *, keyframe: bool) -> None:
        """Write the next packet.

        Args:
            body: As the message holds it.
            tick: Presentation time in ticks, greater than the last; the first is 0.
            keyframe: Whether decoding can begin here.

        Raises:
            Refused: It is the first, and cannot be decoded or has another size.
            OSError: It cannot be written.
        """
        plain = self._parser.plain(body)
        if self._container is None:
            self.begin(body)
        if not self.frames:
            self._first = plain
        duration = round(TIMESCALE / self._rate)
        packet = _packet_at(plain, self._stream, tick, duration, is_key=keyframe)
        self._container.mux(packet)
        self._written.add(tick, len(plain), is_key=keyframe)
        self._last = plain

    def begin(self, body: bytes | memoryview) -> None:
        """Create the file for a first body, which is not written yet.

        Args:
            body: As the message holds it.

        Raises:
            Refused: It cannot be decoded, or has another size; no file was made.
        """
        plain = self._parser.plain(body)
        if self.codec == "mjpeg":
            self._container = new_mp4(self._path)
            self._stream = self._container.add_mux_stream(
                self.codec, rate=self._rate, width=self.width, height=self.height
            )
        else:
            with _probe(self.codec, self._parameters, plain) as probe:
                template = probe.streams.video[0]
                context = template.codec_context
                if (context.width, context.height) != (self.width, self.height):
                    raise Refused("its first picture cannot be decoded")
                self._container = new_mp4(self._path)
                self._stream = self._container.add_stream_from_template(template, opaque=True)
        self._stream.time_base = TIME_BASE

    def close(self) -> None:
        """Finish the file and compare its index with what was written.

        Raises:
            VideoError: The file does not hold every packet as it was written.
            OSError: It cannot be written.
        """
        if not self.frames:
            self.abandon()
            return
        self._container.close()
        with PacketReader(self._path, codec=self.codec, frames=self.frames) as reader:
            is_same = self._written.is_in(reader)
            for index, plain in ((0, self._first), (self.frames - 1, self._last)):
                if not is_same or self._parser.body(reader.packet(index), None) != plain:
                    raise VideoError(
                        "decode-failed", self._path, "does not hold the packets as written"
                    )


def _probe(codec: str, parameters: bytes, plain: bytes) -> Any:
    """The first body opened as a video, for what an mp4 says about its track."""
    data = plain if CODECS[codec].parser.has_parameters(plain) else parameters + plain
    container = CODECS[codec].ffmpeg
    if codec == "av1":
        container = "ivf"
        # header of the file with rate and count, then size and time of the frame
        data = b"".join(
            (
                struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, b"AV01", 0, 0, 30, 1, 1, 0),
                struct.pack("<IQ", len(data), 0),
                data,
            )
        )
    try:
        probe = open_input(io.BytesIO(data), container)
    except (FFmpegError, OSError) as error:
        raise_if_scarce(error)
        raise Refused("its first picture cannot be decoded") from None
    if not probe.streams.video or probe.streams.video[0].codec_context is None:
        probe.close()
        raise Refused("its first picture cannot be decoded")
    return probe


def packet_format(codec: str, parameters: bytes, body: bytes | memoryview) -> str:
    """The pixel format of what packets show, by ffmpeg's name; empty if that is unknown.

    Args:
        codec: As for `PacketWriter`.
        parameters: As for `PacketWriter`.
        body: The first message's packet, a key frame.
    """
    try:
        with _probe(codec, parameters, CODECS[codec].parser.plain(body)) as probe:
            return pixel_format_of(probe.streams.video[0].codec_context)
    except Refused:
        return ""


class PacketReader:
    """The packets of an mp4's video track. A context manager.

    They are read from where the file's index says. A forged index costs no memory beyond the
    file's size. Packet 0 is the first that is shown; those that an edit list hides before it have
    negative numbers.

    Args:
        path: The video.
        codec: Name in the registry.
        frames: Expected number of packets, if known.
        coded_size: Expected width and height, if known.

    Attributes:
        path: The video.
        hidden: How many packets are hidden, to which the first that are shown refer.
        ticks: Decoding times of the shown packets in ticks of the track.
        sizes: Bytes of each shown packet.
        keyframes: Whether decoding can begin at each shown packet, as 0 or 1.
        extradata: The track's codec configuration: avcC, hvcC or av1C.
        pixel_format: Of its pictures, by ffmpeg's name; empty if unknown.

    Raises:
        VideoError: ``file-missing``, ``video-unreadable``, ``codec-mismatch``,
            ``geometry-mismatch`` or ``frame-count``.
    """

    def __init__(
        self,
        path: Path,
        *,
        codec: str,
        frames: int | None = None,
        coded_size: tuple[int, int] | None = None,
    ) -> None:
        self.path = path
        self._codec = codec
        with closing(Media(path, size=coded_size)) as media:
            media.check(codec, coded_size)
            context = media.track.codec_context
            self.extradata: bytes = bytes(context.extradata or b"")
            self.pixel_format = pixel_format_of(context)
            table = media.table
        count = len(table.order)
        if frames is not None and count != frames:
            raise VideoError("frame-count", path, f"has {count} frames, not {frames}")
        if table.sizes.sum() > path.stat().st_size:
            raise VideoError("video-unreadable", path, "has an index that is damaged")
        self.hidden = int(table.order.min())
        shown = slice(self.hidden, self.hidden + count)
        self._places, self._sizes = _integers(table.places), _integers(table.sizes)
        self._keyframes = bytearray(table.sync.tobytes())
        self.ticks, self.sizes = _integers(table.decoding)[shown], self._sizes[shown]
        self.keyframes = self._keyframes[shown]
        self._file = path.open("rb")

    def __len__(self) -> int:
        return len(self.sizes)

    @property
    def key_numbers(self) -> list[int]:
        """Numbers of the packets at which decoding can begin, increasing."""
        return [number for number, is_key in enumerate(self.keyframes) if is_key]

    def is_key(self, index: int) -> bool:
        """Whether decoding can begin at a packet, which may be hidden."""
        return bool(self._keyframes[self.hidden + index])

    def key_before(self, index: int) -> int:
        """Number of the packet at which decoding must begin to get a shown one.

        Raises:
            VideoError: ``video-unreadable``: there is none.
        """
        key = self._keyframes.rfind(1, 0, self.hidden + index + 1)
        if key < 0:
            raise VideoError("video-unreadable", self.path, "does not start with a key frame")
        return key - self.hidden

    def packet(self, index: int) -> bytes:
        """One packet.

        Args:
            index: -hidden <= index < len(self).

        Raises:
            VideoError: ``decode-failed``: the file ends before it.
        """
        size = self._sizes[self.hidden + index]
        self._file.seek(self._places[self.hidden + index])
        packet = self._file.read(size)
        if len(packet) != size:
            raise VideoError("decode-failed", self.path, "is cut off", frame=index)
        return packet

    def stand_alone(self, index: int) -> bytes:
        """One packet in self-contained form, for decoding without the mp4.

        H.264 and H.265 come as Annex B with start codes of four bytes, AV1 as temporal units that
        begin with a delimiter; all with the parameters of the stream before each key frame. Others
        come as they are.

        Args:
            index: 0 <= index < len(self); of a video without B-frames, such as mp4ds writes.

        Raises:
            VideoError: As for `packet`, or it or the codec's parameters are damaged.
        """
        packet, parser = self.packet(index), CODECS[self._codec].parser
        try:
            units = parser.units_of(self.extradata) if self.keyframes[index] else []
            return parser.stand_alone(packet, units)
        except Refused as error:
            problem = f"has a damaged packet: {error}"
            raise VideoError("decode-failed", self.path, problem, frame=index) from None

    def packets(self) -> Iterator[bytes]:
        """All packets in order.

        Raises:
            VideoError: As for `packet`.
        """
        return map(self.packet, range(len(self)))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> PacketReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _integers(numbers: NDArray[np.int64]) -> array[int]:
    return array("q", numbers.tobytes())


# ---------------------------------------------------------------- cut, join


def cut_segment(source: Path, numbers: range, ticks: Sequence[int], target: Path) -> None:
    """Write consecutive frames of a video to a separate file.

    The frames from the preceding key frame on are included, since they are referred to; an edit
    list hides them.

    Args:
        source: A file of `VideoEncoder` or `PacketWriter`, of which frames may be cut off already.
        numbers: Numbers of the frames, at least one.
        ticks: Their presentation times, in ticks of 1 / `TIMESCALE` s, strictly increasing from 0.
        target: The file to make. It is removed if it cannot be finished.

    Raises:
        VideoError: The source cannot be read, or the result does not hold every packet as it was.
        OSError: It cannot be written.
    """
    duration = max(1, ticks[-1] - ticks[-2]) if len(ticks) > 1 else _last_duration(source)
    _write([source], iter(ticks), target, duration, numbers)


def join_segments(segments: Sequence[Path], ticks: Iterable[int], target: Path) -> None:
    """Concatenate the packets of videos into one file.

    The file is as one `VideoEncoder` or `PacketWriter` would have made it of the same packets:
    its track has the same description, and its last frame lasts as long as that of the last
    segment. The segments' own times are otherwise ignored. Memory is one packet, and the indexes of
    a segment and of the result.

    Args:
        segments: Files of `VideoEncoder` or `PacketWriter`, at least one, in order. Those of an
            encoder need the same recipe, gop and rate, while threads and machine may differ.
        ticks: Presentation times of all frames, in ticks of 1 / `TIMESCALE` s, strictly
            increasing.
        target: The file to make, not one of the segments. It is removed if it cannot be finished.

    Raises:
        Mp4dsError: A segment has another codec, size, colour or parameter sets than the
            first.
        VideoError: A segment cannot be read, there are not as many ticks as frames, or the
            result does not hold every packet as it was.
        ValueError: There are no segments, or the ticks do not increase.
        OSError: It cannot be written.
    """
    if not segments:
        raise ValueError("there are no segments to join")
    _write(segments, iter(ticks), target, _last_duration(segments[-1]))


def _write(
    segments: Sequence[Path],
    ticks: Iterator[int],
    target: Path,
    duration: int,
    numbers: range | None = None,
) -> None:
    """Write frames of videos to a new file, which is removed if it cannot be finished.

    Args:
        segments: The videos.
        ticks: Presentation times of the frames.
        target: The file.
        duration: Of the last frame, in ticks.
        numbers: Those of the frames of the only video; None: all.
    """
    entry, written = _common_entry(segments), _Written()
    try:
        with closing(Media(segments[0])) as source, closing(new_mp4(target)) as container:
            codec = source.track.codec_context.codec.canonical_name
            stream = container.add_stream_from_template(source.track, opaque=True)
            stream.time_base = TIME_BASE
            # the segment's bit rates, and what ffmpeg may have found of an aspect ratio in its
            # first packets that its track does not state
            stream.codec_context.bit_rate = 0
            stream.codec_context.sample_aspect_ratio = entry.aspect_ratio
            try:
                for segment in segments:
                    with PacketReader(segment, codec=codec) as reader:
                        _copy(reader, numbers, ticks, container, stream, duration, written)
                if next(ticks, None) is not None:
                    raise VideoError(
                        "frame-count", target, f"would have only {len(written.ticks)} frames"
                    )
            except BaseException:
                # closing completes the file, which may fail, too; the first error tells more
                with suppress(FFmpegError, OSError):
                    container.close()
                raise
            with _damage_told(target, "cannot be completed"):
                container.close()
        place = segments[0] if len(segments) == 1 else target  # what the user knows of
        _check(target, codec, written, entry, place)
    except BaseException:
        target.unlink(missing_ok=True)
        raise


class _Written:
    """The expected index of a new file."""

    def __init__(self) -> None:
        self.ticks, self.sizes = array("q"), array("q")
        self.keyframes = bytearray()

    def add(self, tick: int, size: int, *, is_key: bool) -> None:
        """Add a packet."""
        self.ticks.append(tick)
        self.sizes.append(size)
        self.keyframes.append(is_key)

    def is_in(self, reader: PacketReader) -> bool:
        """Whether a file has that index."""
        found = reader.ticks, reader.sizes, reader.keyframes
        return found == (self.ticks, self.sizes, self.keyframes)


def _check(path: Path, codec: str, written: _Written, entry: SampleEntry, place: Path) -> None:
    """Compare a file with what was written, and with the segments' description.

    Raises:
        VideoError: It differs; the place is what is to blame.
    """
    try:
        with PacketReader(path, codec=codec, frames=len(written.ticks)) as reader:
            is_whole = written.is_in(reader)
    except VideoError:
        is_whole = False  # the muxer continues after some damages, and the index is wrong then
    if not is_whole:
        problem = "could not be copied unchanged: a packet is damaged"
        raise VideoError("decode-failed", place, problem)
    if difference := entry.differences(entry_of(path)):
        problem = f"differs from the segments it was made of in {difference}"
        raise VideoError("decode-failed", place, problem)


def _last_duration(path: Path) -> int:
    """How long the last frame lasts, in ticks; all others last until the next one."""
    with closing(Media(path)) as source:
        ticks = source.table.decoding
        return max(int(source.track.duration or 0) - int(ticks[-1] - ticks[0]), 1)


def _copy(
    reader: PacketReader,
    numbers: range | None,
    ticks: Iterator[int],
    container: Any,
    stream: Any,
    duration: int,
    written: _Written,
) -> None:
    first, end = (numbers[0], numbers[-1] + 1) if numbers else (0, len(reader))
    for number in range(reader.key_before(first) if numbers else 0, end):
        data, is_key = reader.packet(number), reader.is_key(number)
        # of what nobody sees, any time that increases does
        tick = next(ticks, None) if number >= first else number - first
        if tick is None:
            raise VideoError(
                "frame-count", reader.path, f"has {len(reader)} frames, but {number} are needed"
            )
        if number >= first:
            if written.ticks and tick <= written.ticks[-1]:
                raise ValueError(f"tick {tick} does not follow {written.ticks[-1]}")
            written.add(tick, len(data), is_key=is_key)
        packet = _packet_at(data, stream, tick, duration, is_key=is_key)
        with _damage_told(reader.path, f"packet {number} is damaged"):
            container.mux(packet)


def _packet_at(data: bytes, stream: Any, tick: int, duration: int, *, is_key: bool) -> Any:
    """A packet to mux, shown from a tick on."""
    packet = av.Packet(len(data))  # padded, since parsers read on
    packet.update(data)
    packet.stream = stream
    packet.time_base = TIME_BASE
    packet.pts = packet.dts = tick
    packet.duration = duration
    packet.is_keyframe = is_key
    return packet


@contextmanager
def _damage_told(path: Path, problem: str) -> Iterator[None]:
    """Turns the muxer's errors into a `VideoError`, but not those of the disk."""
    try:
        yield
    except FFmpegError as error:
        if isinstance(error, OSError):
            raise
        raise VideoError("decode-failed", path, f"{problem}: {error}") from None


def _common_entry(segments: Sequence[Path]) -> SampleEntry:
    first = entry_of(segments[0])
    for segment in segments[1:]:
        if difference := first.differences(entry_of(segment)):
            raise Mp4dsError(
                f"{path_text(segment)}: cannot be joined to {path_text(segments[0])}: they differ "
                f"in {difference}. Encode both with the same options, or keep them as two streams."
            )
    return first


def entry_of(path: Path) -> SampleEntry:
    """The description of a video's packets.

    Raises:
        VideoError: ``file-missing`` or ``video-unreadable``.
    """
    with closing(Media(path)) as media:
        return media.table.entry
