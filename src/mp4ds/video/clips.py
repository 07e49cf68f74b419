"""A video of another program as messages: its packets as they are, or its pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from av import Packet, VideoFormat
from av.error import FFmpegError

from mp4ds.errors import FormatError, Refused, SourceError, reason_of
from mp4ds.records import MetadataRecord
from mp4ds.video.codecs import CODECS, COPIED_CODECS
from mp4ds.video.coded import REORDERED, StreamParser
from mp4ds.video.decoder import VideoDecoder, VideoFile, read_video_file
from mp4ds.video.media import Media, raise_if_scarce

_DECODE = "Give `decode`: its pictures then become images, which `quality` visual keeps small."
_KINDS = "Give an mp4, mov, mkv or webm file; `ffmpeg -i FILE -c copy NEW.mkv` makes one."
_SEGMENT, _CLUSTER = "18538067", "1f43b675"
_ELEMENTS = {  # of Matroska: at the top, in a segment, and in a cluster
    *("1a45dfa3", _SEGMENT, "ec", "bf"),
    *("114d9b74", "1549a966", "1654ae6b", _CLUSTER, "1c53bb6b", "1941a469", "1043a770", "1254c367"),
    *("e7", "a3", "a0", "a7", "ab", "5854", "af"),
}
_LONGEST_HEAD = 12
_MOST_DELAY = 16  # frames, by which decoding times may precede those of showing


def open_video(path: Path) -> VideoFile:
    """What is in a video.

    Raises:
        SourceError: It cannot be read; says what to do.
    """
    try:
        file = read_video_file(path)
    except FormatError as error:
        raise SourceError(path, error.problem, _KINDS) from None
    if file.container == "matroska" and (problem := _damage(path)):
        raise SourceError(path, problem, "`ffmpeg -i FILE -c copy NEW.mkv` keeps the rest.")
    return file


def _damage(path: Path) -> str:
    """Why ffmpeg would pass over a part of a Matroska or WebM file (RFC 9559); else empty."""
    place, end = 0, path.stat().st_size
    with path.open("rb") as file:
        while place < end:
            file.seek(place)
            head = file.read(_LONGEST_HEAD)
            after = 9 - head[0].bit_length()
            kind = head[:after].hex()
            sized = 9 - head[after].bit_length() if after < len(head) else 9
            if kind not in _ELEMENTS or sized > 8:
                return f"is damaged at byte {place}"
            unknown = (1 << 7 * sized) - 1
            size = int.from_bytes(head[after : after + sized], "big") & unknown
            place += after + sized
            if kind == _SEGMENT and size != unknown:
                if place + size > end:
                    break
                end = place + size
            if kind not in (_SEGMENT, _CLUSTER):  # what is in these is walked through
                place += size
    return "" if place == end else "was cut short"


class Clip:
    """Consecutive frames of a video, by number.

    Args:
        file: The video.
        pictures: Pixel format of what its frames are decoded to; empty to copy packets.
        numbers: Those of the frames; None: all.

    Attributes:
        file: The video.
        is_decoded: Whether `body` gives pixels.
        numbers: Those of the frames.
        frame_bytes: Bytes of a frame in the file, on average.
        metadata: What its container says about it.
        left_out: What messages do not hold of it: a phrase -> how many.

    Raises:
        SourceError: It cannot be read, or its packets cannot be messages; says what to do.
    """

    def __init__(
        self, file: VideoFile, *, pictures: str = "", numbers: range | None = None
    ) -> None:
        self.file = file
        self.is_decoded, self._pictures = bool(pictures), pictures
        self.numbers = numbers or range(len(file.ticks))
        self.frame_bytes = file.path.stat().st_size // len(self.file.ticks)
        self._bodies: Iterator[bytes] = iter(())
        self._due = -1
        self._parser: type[StreamParser] = StreamParser
        self._units: list[bytes] = []
        # an index that is read has one description of all packets
        self._may_change = not (pictures or file.is_indexed) and file.container == "mp4"
        if not pictures:
            self._check_packets()
        with self._reading(), closing(self.file.open()) as media:
            texts = {str(key): str(value) for key, value in media.container.metadata.items()}
            self.metadata = MetadataRecord("video", {**texts, "file": file.path.name})
            others = [one.type for one in media.container.streams if one is not media.track]
            self.left_out = Counter(f"{kind} tracks" for kind in others)
            if file.hidden:
                self.left_out["frames that its edit list hides"] = file.hidden
            self._count_lost_samples(media)
            with suppress(FFmpegError, StopIteration):  # a damaged one is copied, too
                if turned := next(media.container.decode(media.track)).rotation % 360:
                    self.left_out[f"turn by {turned} degrees, which players apply"] = 1

    def _count_lost_samples(self, media: Media) -> None:
        """Count what neither packets nor pictures hold of the pixels."""
        has_alpha = media.track.metadata.get("alpha_mode") == "1"  # VP9 has it beside its packets
        if self.is_decoded and media.track.codec_context.format:
            own = media.track.codec_context.format.components
            has_alpha = has_alpha or any(one.is_alpha for one in own)
            bits = max(one.bits for one in VideoFormat(self._pictures).components)
            if (lost := max(one.bits for one in own) - bits) > 0:
                self.left_out[f"low bits of each sample, which {bits} bits do not hold"] = lost
        if has_alpha:
            self.left_out["alpha channels"] = 1

    def _check_packets(self) -> None:
        """Refuse a video whose packets cannot be messages."""
        file = self.file
        if file.codec not in COPIED_CODECS:
            raise self._refusal(f"is coded as {file.codec}, not {', '.join(COPIED_CODECS)}")
        if file.is_reordered:
            raise self._refusal(f"cannot be copied: {REORDERED}")
        if self._may_change and not hasattr(Packet, "has_sidedata"):
            raise self._refusal("cannot be copied: what its index is like takes PyAV 16 to follow")
        self._parser = CODECS[file.codec].parser
        with self._reading(), closing(file.open()) as media:
            extradata = bytes(media.track.codec_context.extradata or b"")
            self._units = self._parser.units_of(extradata) if extradata else []
        first = self.numbers[0]
        with self._reading(), closing(self._packets(first)) as packets:
            if not next(packets).is_keyframe:
                raise Refused(f"frame {first} is not a key frame, and earlier ones are left out")

    def _refusal(self, problem: str) -> SourceError:
        return SourceError(self.file.path, problem, _DECODE)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Errors in the terms of a source."""
        try:
            yield
        except FormatError as error:
            raise SourceError(self.file.path, error.problem) from None
        except Refused as reason:
            raise self._refusal(f"cannot be copied: {reason}") from None
        except (FFmpegError, StopIteration) as error:
            raise_if_scarce(error)
            problem = reason_of(error) if error.args else "it ends early"
            raise SourceError(self.file.path, f"is damaged: {problem}") from None

    def body(self, number: int) -> bytes:
        """A frame: its packet as a message has it, or its pixels.

        Args:
            number: Of the frame in the clip; in order is fastest.

        Raises:
            SourceError: The video is damaged.
        """
        if number != self._due:
            self._bodies = self._bodies_from(self.numbers[number])
        self._due = number + 1
        with self._reading():
            return next(self._bodies)

    def _bodies_from(self, number: int) -> Iterator[bytes]:
        if not self.is_decoded:
            for packet in self._packets(number):
                units = self._units if packet.is_keyframe else []
                yield self._parser.stand_alone(bytes(packet), units)
            return
        file = self.file
        maker = file.maker(self._pictures)
        with VideoDecoder(
            file.path, codec=file.codec, frames=len(file.ticks), maker=maker, file=file
        ) as decoder:
            for _, (pixels,) in decoder.pictures_at(range(number, self.numbers[-1] + 1)):
                yield pixels.tobytes()

    def _packets(self, number: int) -> Generator[Any, None, None]:
        """The packets from a frame to the last one; they are in the order of the frames."""
        ticks = self.file.ticks
        with closing(self.file.open()) as media:
            if number:  # without an index, they are read from the first
                with suppress(FFmpegError):
                    before = int(ticks[max(0, number - _MOST_DELAY)])
                    media.container.seek(before, stream=media.track)
            for packet in media.container.demux(media.track):
                if packet.pts is None or packet.is_discard or packet.pts < ticks[number]:
                    continue
                if packet.pts != ticks[number]:
                    raise Refused(f"the packet of frame {number} is not where its index says")
                if self._may_change and packet.has_sidedata("new_extradata"):
                    raise Refused(f"the parameters of its decoder change at frame {number}")
                yield packet
                number += 1
                if number > self.numbers[-1]:
                    return
