"""Packets of video codecs into an mp4 and out of it, as they are: nothing is encoded or decoded.

What an mp4 holds of a message's body is told by `mp4ds.coded.packets`.
"""

from __future__ import annotations

import io
import struct
from array import array
from collections.abc import Iterator
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
from av.error import FFmpegError

from mp4ds.coded import PACKET_CODECS, Refused, annexb, av1, h264, h265
from mp4ds.coded.packets import plain_body
from mp4ds.errors import VideoError
from mp4ds.stamps import TIMESCALE
from mp4ds.video.media import FFMPEG_NAMES, Media, open_input, pixel_format_of
from mp4ds.video.scarcity import raise_if_scarce

_TIME_BASE = Fraction(1, TIMESCALE)
_LOWEST_RATE, _USUAL_RATE, _HIGHEST_RATE = 0.1, 30.0, 240.0  # Hz
_UNITS = {"h264": h264, "h265": h265}
_IVF = {"av1": b"AV01", "vp9": b"VP90"}


class PacketWriter:
    """One mp4 of coded packets being written. A context manager; leaving it completes the file.

    The first body must be a key frame that `mp4ds.coded.PictureParser` takes.

    Args:
        path: The file to make, by the first body.
        codec: One of `mp4ds.coded.PACKET_CODECS`.
        width: Columns of the pictures.
        height: Rows of the pictures.
        parameters: Parameter sets or sequence header, as `PictureParser.parameters` has them;
            used if the first body is without.
        rate: Frames per second, if known: it gives the last frame its duration.

    Raises:
        ValueError: The codec is another one; lists those.
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
        if codec not in PACKET_CODECS:
            raise ValueError(f"codec {codec!r} is none of {', '.join(PACKET_CODECS)}")
        self.codec = codec
        self.width, self.height = width, height
        self._path = path
        self._parameters = parameters
        rate = min(max(rate or _USUAL_RATE, _LOWEST_RATE), _HIGHEST_RATE)
        self._rate = Fraction(rate).limit_denominator(1000)
        self._container: Any = None
        self._stream: Any = None
        self._ticks = array("q")
        self._sizes = array("q")
        self._first = self._last = b""

    @property
    def frames(self) -> int:
        """Packets written."""
        return len(self._ticks)

    def write(self, body: bytes | memoryview, tick: int, *, keyframe: bool) -> None:
        """Write the next packet.

        Args:
            body: As the message holds it.
            tick: Presentation time in ticks, greater than the last; the first is 0.
            keyframe: Whether decoding can begin here.

        Raises:
            Refused: It is the first, and cannot be decoded or has another size.
            OSError: The disk refused.
        """
        plain = plain_body(self.codec, body)
        if self._container is None:
            self.begin(body)
        if not self._ticks:
            self._first = plain
        packet = av.Packet(len(plain))  # padded, since parsers read on
        packet.update(plain)
        packet.stream = self._stream
        packet.time_base = _TIME_BASE
        packet.pts = packet.dts = tick
        packet.duration = round(TIMESCALE / self._rate)
        packet.is_keyframe = keyframe
        self._container.mux(packet)
        self._ticks.append(tick)
        self._sizes.append(len(plain))
        self._last = plain

    def begin(self, body: bytes | memoryview) -> None:
        """Make the file, for a first body that is yet to be written.

        Args:
            body: As the message holds it.

        Raises:
            Refused: It cannot be decoded, or has another size; no file was made.
        """
        plain = plain_body(self.codec, body)
        if self.codec in ("mjpeg", "png"):
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
        self._stream.time_base = _TIME_BASE

    def close(self) -> None:
        """Finish the file and compare what its index says with what was written.

        Raises:
            VideoError: The file does not hold every packet as it was written.
            OSError: The disk refused.
        """
        if not self._ticks:
            self.abandon()
            return
        self._container.close()
        with PacketReader(self._path, codec=self.codec, frames=self.frames) as reader:
            same = reader.ticks == self._ticks and reader.sizes == self._sizes
            for index, plain in ((0, self._first), (self.frames - 1, self._last)):
                packet = reader.packet(index) if same else b""
                if self.codec in _UNITS and same:
                    packet = annexb.join_plain(annexb.split_length_prefixed(packet))
                if packet != plain:
                    raise VideoError(
                        "decode-failed", self._path, "does not hold the packets as written"
                    )

    def abandon(self) -> None:
        """Close the file as it is; the caller removes it."""
        if self._container is None:
            return
        try:
            self._container.close()
        except (FFmpegError, OSError):
            return

    def __enter__(self) -> PacketWriter:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()


def new_mp4(path: Path) -> Any:
    """An mp4 to write to, its times in ticks of the track."""
    return av.open(
        str(path.absolute()),  # ffmpeg takes a relative name with a colon for an address
        "w",
        format="mp4",
        options={"video_track_timescale": str(TIMESCALE), "movie_timescale": str(TIMESCALE)},
    )


def _probe(codec: str, parameters: bytes, plain: bytes) -> Any:
    """The first body opened as a video of its own, for what an mp4 says about its track."""
    if codec in _UNITS:
        has_parameters = _UNITS[codec].has_parameters(annexb.split(plain)[0])
    else:
        has_parameters = codec != "av1" or bool(av1.sequence_header(plain))
    data = plain if has_parameters else parameters + plain
    container = FFMPEG_NAMES[codec]
    if codec in _IVF:
        container = "ivf"
        # header of the file with rate and count, then size and time of the frame
        data = b"".join(
            (
                struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, _IVF[codec], 0, 0, 30, 1, 1, 0),
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


class PacketReader:
    """The packets of an mp4's video track. A context manager.

    They are read from where the file's index says, which ffmpeg reads; a forged index costs no
    memory beyond the file's size.

    Args:
        path: The video.
        codec: Name in the registry.
        frames: Number of packets that are due, if known.
        coded_size: Width and height that are due, if known.

    Attributes:
        ticks: Decoding times in ticks of the track.
        sizes: Bytes of each packet.
        keyframes: For each packet whether decoding can begin there, as 0 or 1.
        extradata: What the track says about the codec: avcC, hvcC or av1C.
        pixel_format: Of its pictures as ffmpeg calls it; empty where not known.

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
        self._path = path
        with closing(Media(path)) as media:
            media.check(codec, coded_size)
            context = media.track.codec_context
            self.extradata: bytes = bytes(context.extradata or b"")
            self.pixel_format = pixel_format_of(context)
            entries = media.track.index_entries
            if not len(entries):
                raise VideoError("frame-count", path, "has no frames")
            if frames is not None and len(entries) != frames:
                raise VideoError(
                    "frame-count", path, f"has {len(entries)} frames, {frames} are due"
                )
            self.ticks, self.sizes, self._places = array("q"), array("q"), array("q")
            self.keyframes = bytearray()
            for entry in entries:
                self.ticks.append(entry.timestamp)
                self.sizes.append(entry.size)
                self._places.append(entry.pos)
                self.keyframes.append(entry.is_keyframe)
        self._file = path.open("rb")
        self._check_index()

    def _check_index(self) -> None:
        length = self._file.seek(0, io.SEEK_END)
        total = 0
        for place, size in zip(self._places, self.sizes, strict=True):
            total += size
            if place < 0 or size < 0 or place + size > length or total > length:
                self._file.close()
                raise VideoError("video-unreadable", self._path, "has an index that is damaged")

    def __len__(self) -> int:
        return len(self.sizes)

    @property
    def key_numbers(self) -> list[int]:
        """Numbers of the packets at which decoding can begin, increasing."""
        return [number for number, is_key in enumerate(self.keyframes) if is_key]

    def packet(self, index: int) -> bytes:
        """One packet.

        Args:
            index: 0 <= index < len(self).

        Raises:
            VideoError: ``decode-failed``: the file ends before it.
        """
        self._file.seek(self._places[index])
        packet = self._file.read(self.sizes[index])
        if len(packet) != self.sizes[index]:
            raise VideoError("decode-failed", self._path, f"ends before frame {index}")
        return packet

    def packets(self) -> Iterator[bytes]:
        """All packets in order.

        Raises:
            VideoError: As `packet`.
        """
        return map(self.packet, range(len(self)))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> PacketReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
