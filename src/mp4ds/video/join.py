"""Joining the videos of consecutive parts of a stream into one: packets are copied, not coded."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
from av.error import FFmpegError

from mp4ds.errors import Mp4dsError, VideoError
from mp4ds.stamps import TIMESCALE
from mp4ds.video.media import Media
from mp4ds.video.packets import PacketReader, new_mp4
from mp4ds.video.sample_entry import SampleEntry, read_sample_entry

_TIME_BASE = Fraction(1, TIMESCALE)


class SegmentsDifferError(Mp4dsError):
    """Videos that cannot be one: their track could not describe the packets of both.

    Args:
        first: The segment that the others are compared with.
        other: The segment that differs from it.
        differences: What differs, and how.
    """

    def __init__(self, first: Path, other: Path, differences: str) -> None:
        self.first, self.other = first, other
        super().__init__(
            f"{other}: cannot be joined to {first}, since they differ in {differences}. "
            "Encode both with the same options, or keep them as two streams."
        )


def join_segments(segments: Sequence[Path], ticks: Iterable[int], target: Path) -> int:
    """Write the packets of videos one after the other into one file.

    The file is as one `VideoEncoder` or `PacketWriter` would have made it of the same packets:
    its track describes them in the same words, and its last frame lasts as long as that of the
    last segment. Of the segments' own times nothing else is used. Memory is one packet, and the
    indexes of a segment and of the result.

    Args:
        segments: Files of `VideoEncoder` or `PacketWriter`, at least one, in order. Those of an
            encoder need the same recipe, gop and rate, while threads and machine may differ.
        ticks: Presentation times of all frames, in ticks of 1 / `TIMESCALE` s, strictly
            increasing.
        target: The file to make, none of the segments. It is removed if it cannot be finished.

    Returns:
        The number of packets written.

    Raises:
        SegmentsDifferError: A segment has another codec, size, colour or parameter sets than the
            first.
        VideoError: A segment cannot be read, there are not as many ticks as frames, or the
            result does not hold every packet as it was.
        ValueError: There are no segments, or the ticks do not increase.
        OSError: The disk refused.
    """
    if not segments:
        raise ValueError("there are no segments to join")
    entry = _common_entry(segments)
    try:
        written = _copy(segments, iter(ticks), target, entry)
        written.check(target, entry)
    except BaseException:
        target.unlink(missing_ok=True)
        raise
    return len(written.ticks)


class _Written:
    """What the index of the file that is made has to say."""

    def __init__(self, codec: str) -> None:
        self.codec = codec
        self.ticks, self.sizes = array("q"), array("q")
        self.keyframes = bytearray()

    def check(self, path: Path, entry: SampleEntry) -> None:
        """Compare it with what it says.

        Raises:
            VideoError: It says something else.
        """
        if not self._is_in(path):
            raise VideoError(
                "decode-failed", path, "would not hold the packets as they are: one is damaged"
            )
        if difference := entry.differences(read_sample_entry(path)):
            raise VideoError(
                "decode-failed", path, f"differs from the segments it was made of in {difference}"
            )

    def _is_in(self, path: Path) -> bool:
        try:
            with PacketReader(path, codec=self.codec, frames=len(self.ticks)) as reader:
                found = (reader.ticks, reader.sizes, reader.keyframes)
                return found == (self.ticks, self.sizes, self.keyframes)
        except VideoError:
            return False  # the muxer goes on after some damages, and the index is wrong then


def _copy(
    segments: Sequence[Path], ticks: Iterator[int], target: Path, entry: SampleEntry
) -> _Written:
    duration = _last_duration(segments[-1])
    with closing(Media(segments[0])) as source, closing(new_mp4(target)) as container:
        written = _Written(source.track.codec_context.codec.canonical_name)
        stream = _new_stream(container, source.track, entry)
        try:
            for segment in segments:
                _copy_segment(segment, ticks, container, stream, duration, written)
            if next(ticks, None) is not None:
                raise VideoError(
                    "frame-count", target, f"would have {len(written.ticks)} frames, more are due"
                )
        except BaseException:
            # closing completes the file, which may fail, too; the first error tells more
            with suppress(FFmpegError, OSError):
                container.close()
            raise
        _finish(container, target)
    return written


def _new_stream(container: Any, template: Any, entry: SampleEntry) -> Any:
    """A track described as the segments' tracks are.

    The template has bit rates of its segment, and from its first packets ffmpeg may have found
    an aspect ratio of which the segment's track says nothing.
    """
    stream = container.add_stream_from_template(template, opaque=True)
    stream.time_base = _TIME_BASE
    stream.codec_context.bit_rate = 0
    stream.codec_context.sample_aspect_ratio = entry.aspect_ratio
    return stream


def _last_duration(path: Path) -> int:
    """How long the last frame lasts, in ticks; all others last until the next one."""
    with closing(Media(path)) as source:
        entries = source.track.index_entries
        if not len(entries):
            raise VideoError("frame-count", path, "has no frames")
        elapsed = entries[len(entries) - 1].timestamp - entries[0].timestamp
        return max(int(source.track.duration or 0) - int(elapsed), 1)


def _copy_segment(
    path: Path,
    ticks: Iterator[int],
    container: Any,
    stream: Any,
    duration: int,
    written: _Written,
) -> None:
    with PacketReader(path, codec=written.codec) as reader:
        for index, data in enumerate(reader.packets()):
            tick = next(ticks, None)
            if tick is None:
                raise VideoError(
                    "frame-count", path, f"has {len(reader)} frames, {index} of them are due"
                )
            if written.ticks and tick <= written.ticks[-1]:
                raise ValueError(f"tick {tick} does not follow {written.ticks[-1]}")
            packet = av.Packet(data)
            packet.stream = stream
            packet.time_base = _TIME_BASE
            packet.pts = packet.dts = tick
            packet.duration = duration
            packet.is_keyframe = bool(reader.keyframes[index])
            with _damage_told(path, f"packet {index} is damaged"):
                container.mux(packet)
            written.ticks.append(tick)
            written.sizes.append(len(data))
            written.keyframes.append(reader.keyframes[index])


def _finish(container: Any, target: Path) -> None:
    with _damage_told(target, "cannot be completed"):
        container.close()


@contextmanager
def _damage_told(path: Path, problem: str) -> Iterator[None]:
    """Turns what the muxer refuses into a `VideoError`, but not what the disk refuses."""
    try:
        yield
    except FFmpegError as error:
        if isinstance(error, OSError):
            raise
        raise VideoError("decode-failed", path, f"{problem}: {error}") from None


def _common_entry(segments: Sequence[Path]) -> SampleEntry:
    first = read_sample_entry(segments[0])
    for segment in segments[1:]:
        if difference := first.differences(read_sample_entry(segment)):
            raise SegmentsDifferError(segments[0], segment, difference)
    return first
