"""What is noted of a recording while it is made, so that a power cut costs no more than its end.

Videos hold pictures, and `messages.mcap` whole messages. The rest of a dataset is written when it
is complete; until then each line of the journal has what a sidecar or the manifest will say: a
checksum, a space and a list in JSON whose first item is its kind. A line is written before the
frame or message that it is about.
"""

from __future__ import annotations

import base64
import json
import os
import re
import threading
from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import xxhash

from mp4ds.bags.protocols import Format
from mp4ds.errors import Refused, SourceError
from mp4ds.files.outputs import lock
from mp4ds.files.sources import JOURNAL_NAME
from mp4ds.format.fields import (
    FORMAT_VERSION,
    Base64,
    Int64,
    Model,
    Profile,
    Size,
    Uint32,
    Uint64,
    decode_base64,
    json_parser,
)
from mp4ds.format.models import ChannelModel, Header
from mp4ds.packing.look import StreamKey
from mp4ds.plan import FileNames
from mp4ds.records import Channel, Message
from mp4ds.video.codecs import CODECS
from mp4ds.video.packets import packet_digest

FRAME_COLUMNS = (
    *("log_time", "publish_time", "sequence", "stamp", "seq", "pts", "variant", "ordinal"),
    *("tick", "size", "digest"),
)
"""What is noted of a frame: columns of its stream, its time in the video, its message's bytes.

``seq`` and ``pts`` are 0 where its messages have none, the digest is 0 where the stream is lossy.
"""

_ORDINAL = FRAME_COLUMNS.index("ordinal")
_HASH_DIGITS = 8


class StreamNote(NamedTuple):
    """How a stream is made.

    Attributes:
        stem: File name of its video and sidecar, without ending.
        channel: Id of its channel.
        key: What its messages have in common.
        profile: What its sidecar calls it.
        exact: Whether messages come back to the byte.
        has_seq: Whether they have a sequence number of ROS 1.
        has_pts: Whether they have a presentation time of their own.
        video: What the sidecar says of the video, but for the file.
    """

    stem: str
    channel: int
    key: StreamKey
    profile: str
    exact: bool
    has_seq: bool
    has_pts: bool
    video: Mapping[str, Any]


class Journal:
    """The journal of a recording that is being made; lines may come from any thread.

    It is locked for as long as it is open: nobody takes the recording for one that was cut off.

    Args:
        folder: Of the recording.
        facts: ``format``, ``profile`` and ``quality`` of the recording.
    """

    def __init__(self, folder: Path, facts: Mapping[str, str]) -> None:
        self.path = folder / JOURNAL_NAME
        # unbuffered: what is noted outlives the process
        self._file = self.path.open("xb", buffering=0)
        lock(self._file)
        self._writing = threading.Lock()
        self._add("begin", FORMAT_VERSION, dict(facts))

    def _add(self, *values: Any) -> None:
        text = json.dumps(values, separators=(",", ":"), default=_dumped).encode()
        line = b"%b %b\n" % (xxhash.xxh32_hexdigest(text).encode(), text)
        with self._writing:
            os.write(self._file.fileno(), line)

    def channel(self, channel: Channel) -> None:
        """Note a channel of which messages come."""
        self._add("channel", channel.id, ChannelModel.from_record(channel))

    def stream(self, note: StreamNote) -> None:
        """Note a stream that begins."""
        self._add("stream", *note[:2], asdict(note.key), *note[3:])

    def header(self, stem: str, header: Header) -> None:
        """Note a new header of a stream's messages."""
        self._add("header", stem, header)

    def frame(self, stem: str, values: Sequence[int]) -> None:
        """Note a frame of a stream, by `FRAME_COLUMNS`."""
        self._add("frame", stem, *values)

    def packet(self, stem: str, codec: str, packet: bytes) -> None:
        """Note the digest of a packet of a stream's video."""
        self._add("packet", stem, packet_digest(codec, packet, is_stored=False))

    def calibration(self, message: Message) -> None:
        """Keep a calibration, whose stream has it in its sidecar at the end."""
        data = base64.b64encode(message.data).decode()
        times = message.log_time, message.publish_time, message.sequence
        self._add("calibration", message.channel.id, *times, data)

    def pairs(self, pairs: Mapping[int, int]) -> None:
        """Note which calibrations belong to which images, as far as stamps tell."""
        self._add("pairs", list(pairs.items()))

    def verbatim(self, channel: Channel, ordinal: int, reason: str) -> None:
        """Note why a camera message is kept in `messages.mcap`.

        Args:
            channel: Its channel.
            ordinal: Its place among the channel's messages.
            reason: In words.
        """
        self._add("verbatim", channel.id, ordinal, reason)

    def close(self) -> None:
        """Let go of it."""
        self._file.close()


def _dumped(model: Model) -> Any:
    return model.model_dump(mode="json", by_alias=True)


# ---------------------------------------------------------------- reading

_Moment = Size
_SHAPES: Mapping[str, Any] = {
    "begin": tuple[str, str, dict[str, str]],
    "channel": tuple[str, int, ChannelModel],
    "stream": tuple[str, str, int, StreamKey, Profile, bool, bool, bool, dict[str, Any]],
    "header": tuple[str, str, Header],
    "frame": tuple[
        str, str, _Moment, _Moment, Uint32, Int64, Uint32, Int64, Size, Size, Int64, Size, Uint64
    ],
    "packet": tuple[str, str, Uint64],
    "calibration": tuple[str, int, _Moment, _Moment, Uint32, Base64],
    "pairs": tuple[str, list[tuple[int, int]]],
    "verbatim": tuple[str, int, Size, str],
}
_PARSERS = {kind: json_parser(shape) for kind, shape in _SHAPES.items()}
"""What the lines of a journal hold: whoever wrote it may have given them a checksum."""

_KIND = re.compile(rb'\["([a-z]+)"')
_MAX_LINE = 2**26


class _Facts(Model):
    """What the first line says of the recording."""

    format: Format
    profile: Literal["ros1", "ros2"]
    quality: Profile


@dataclass
class Notes:
    """What a journal says, as far as it can be read.

    Attributes:
        path: The journal.
        facts: See `Journal`.
        end: Where reading stopped, bytes.
        is_damaged: Whether there are more lines after that: then it was not just cut off.
        channels: By id.
        streams: In the order in which they began.
        headers: Of each stream, by its stem.
        frames: Of each stream, by its stem: an array for each of `FRAME_COLUMNS`.
        packets: Digests of the packets of each stream, by its stem.
        pairs: Id of a calibration channel -> that of the images.
        verbatim: By channel: ordinal and reason of messages, as they came.
    """

    path: Path
    facts: _Facts
    end: int = 0
    is_damaged: bool = False
    channels: dict[int, Channel] = field(default_factory=dict)
    streams: list[StreamNote] = field(default_factory=list)
    headers: dict[str, list[Header]] = field(default_factory=dict)
    frames: dict[str, list[array[int]]] = field(default_factory=dict)
    packets: dict[str, array[int]] = field(default_factory=dict)
    pairs: dict[int, int] = field(default_factory=dict)
    verbatim: dict[int, list[tuple[int, str]]] = field(default_factory=lambda: defaultdict(list))
    _names: FileNames = field(default_factory=FileNames)

    @classmethod
    def read(cls, path: Path) -> Notes:
        """Read a journal up to its end, or to the first line that is damaged or incomplete.

        Raises:
            SourceError: It is being written, is not a journal, or of another version, or a line
                makes no sense.
        """
        try:
            lines = _lines(path)
            _, first = next(lines, (0, None))
            if not first or first[0] != "begin" or first[1] != FORMAT_VERSION:
                raise SourceError(
                    path,
                    "is damaged at its beginning, or of another version of mp4ds",
                    "Use the version that made the recording.",
                )
            notes = cls(path, _Facts.model_validate(first[2]))
            for end, values in lines:
                if values is None:
                    break
                notes._take(*values)
                notes.end = end
            notes.is_damaged = any(values is not None for _, values in lines)
            return notes
        except BlockingIOError:
            raise SourceError(
                path.parent, "is being recorded", "Wait, or stop the recorder."
            ) from None
        except SourceError:
            raise
        except Refused as reason:
            raise SourceError(path, f"is damaged: {reason}") from None
        except (ValueError, TypeError, LookupError):
            raise SourceError(path, "is damaged") from None

    def calibrations(self) -> Iterator[Message]:
        """The calibrations, in the order in which they came."""
        for _, values in _lines(self.path):
            if values is None:
                return
            if values[0] == "calibration":
                yield self._calibration(*values[1:])

    def _calibration(
        self, channel: int, log_time: int, publish_time: int, sequence: int, data: str
    ) -> Message:
        payload = decode_base64(data)
        return Message(self.channels[channel], log_time, publish_time, sequence, payload)

    def _take(self, kind: str, *values: Any) -> None:
        if kind == "frame":
            stem, *columns = values
            *_, variant, ordinal, _, _, _ = columns
            earlier = self.frames[stem][_ORDINAL]
            if variant >= len(self.headers[stem]) or (earlier and ordinal <= earlier[-1]):
                raise ValueError(kind)
            for column, value in zip(self.frames[stem], columns, strict=True):
                column.append(value)
        elif kind == "packet":
            self.packets[values[0]].append(values[1])
        elif kind == "header":
            self.headers[values[0]].append(values[1])
        elif kind == "verbatim":
            channel, ordinal, reason = values
            self.verbatim[self.channels[channel].id].append((ordinal, reason))
        elif kind == "channel":
            self.channels[values[0]] = values[1].to_record(values[0])
        elif kind == "stream":
            note = StreamNote(*values)
            self._names.claim(note.stem)
            if note.channel not in self.channels or note.video["codec"] not in CODECS:
                raise ValueError(kind)
            self.streams.append(note)
            self.headers[note.stem] = []
            self.frames[note.stem] = [array("Q" if n == "digest" else "q") for n in FRAME_COLUMNS]
            self.packets[note.stem] = array("Q")
        elif kind == "pairs":
            self.pairs.update(values[0])
        elif kind == "calibration":
            self._calibration(*values)  # it is read again when it is needed: there may be many
        else:
            raise ValueError(kind)


def _lines(path: Path) -> Iterator[tuple[int, tuple[Any, ...] | None]]:
    """Where each line of a journal ends, and what it says; None for one that is not whole.

    Raises:
        BlockingIOError: It is being written.
        ValueError: A line is whole, and makes no sense.
    """
    end = 0
    with path.open("r+b") as file:
        lock(file)
        while line := file.readline(_MAX_LINE):
            end += len(line)
            text = line[_HASH_DIGITS + 1 :].rstrip(b"\n")
            digest = xxhash.xxh32_hexdigest(text).encode()
            if not line.endswith(b"\n") or line[:_HASH_DIGITS] != digest:
                yield end, None
            elif match := _KIND.match(text):
                yield end, _PARSERS[match[1].decode()](text)
            else:
                raise ValueError(text[:20])
