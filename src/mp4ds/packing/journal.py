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
import threading
from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import xxhash

from mp4ds.errors import SourceError
from mp4ds.files.outputs import lock
from mp4ds.files.sources import JOURNAL_NAME
from mp4ds.format.fields import FORMAT_VERSION, Model
from mp4ds.format.models import ChannelModel, Header
from mp4ds.packing.look import StreamKey
from mp4ds.records import Channel, Message
from mp4ds.video.packets import packet_digest

FRAME_COLUMNS = (
    *("log_time", "publish_time", "sequence", "stamp", "seq", "pts", "variant", "ordinal"),
    *("tick", "size", "digest"),
)
"""What is noted of a frame: columns of its stream, its time in the video, its message's bytes.

``seq`` and ``pts`` are 0 where its messages have none, the digest is 0 where the stream is lossy.
"""

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


@dataclass
class Notes:
    """What a journal says.

    Attributes:
        path: The journal.
        facts: See `Journal`.
        channels: By id.
        streams: In the order in which they began.
        headers: Of each stream, by its stem.
        frames: Of each stream, by its stem: an array for each of `FRAME_COLUMNS`.
        packets: Digests of the packets of each stream, by its stem.
        pairs: Id of a calibration channel -> that of the images.
        verbatim: By channel: ordinal and reason of messages, as they came.
    """

    path: Path
    facts: dict[str, str]
    channels: dict[int, Channel] = field(default_factory=dict)
    streams: list[StreamNote] = field(default_factory=list)
    headers: dict[str, list[Header]] = field(default_factory=lambda: defaultdict(list))
    frames: dict[str, list[array[int]]] = field(default_factory=dict)
    packets: dict[str, array[int]] = field(default_factory=dict)
    pairs: dict[int, int] = field(default_factory=dict)
    verbatim: dict[int, list[tuple[int, str]]] = field(default_factory=lambda: defaultdict(list))

    @classmethod
    def read(cls, path: Path) -> Notes:
        """Read a journal up to its end, or to the line that was being written.

        Raises:
            SourceError: It is being written, is none, or another version's.
        """
        try:
            lines = _lines(path)
            first = next(lines, None)
            if not first or first[0] != "begin" or first[1] != FORMAT_VERSION:
                raise SourceError(
                    path,
                    "is damaged at its beginning, or of another version of mp4ds",
                    "Use the version that made the recording.",
                )
            notes = cls(path, first[2])
            for values in lines:
                notes._take(*values)
            return notes
        except BlockingIOError:
            raise SourceError(path.parent, "is being recorded", "Wait, or stop that.") from None
        except SourceError:
            raise
        except (ValueError, TypeError, LookupError):
            raise SourceError(path, "is damaged") from None

    def calibrations(self) -> Iterator[Message]:
        """The calibrations, in the order in which they came."""
        for kind, *values in _lines(self.path):
            if kind == "calibration":
                number, log_time, publish_time, sequence, data = values
                payload = base64.b64decode(data)
                yield Message(self.channels[number], log_time, publish_time, sequence, payload)

    def _take(self, kind: str, *values: Any) -> None:
        if kind == "frame":
            for column, value in zip(self.frames[values[0]], values[1:], strict=True):
                column.append(value)
        elif kind == "packet":
            self.packets[values[0]].append(values[1])
        elif kind == "header":
            self.headers[values[0]].append(Header.model_validate(values[1]))
        elif kind == "verbatim":
            channel, ordinal, reason = values
            self.verbatim[channel].append((ordinal, reason))
        elif kind == "channel":
            self.channels[values[0]] = ChannelModel.model_validate(values[1]).to_record(values[0])
        elif kind == "stream":
            stem, channel, key, *rest = values
            self.streams.append(StreamNote(stem, channel, StreamKey(**key), *rest))
            self.frames[stem] = [array("Q" if n == "digest" else "q") for n in FRAME_COLUMNS]
            self.packets[stem] = array("Q")
        elif kind == "pairs":
            self.pairs.update(values[0])
        elif kind != "calibration":
            raise ValueError(kind)


def _lines(path: Path) -> Iterator[list[Any]]:
    """What the lines of a journal say, up to the first that is not whole.

    Raises:
        BlockingIOError: It is being written.
    """
    with path.open("r+b") as file:
        lock(file)
        for line in file:
            text = line[_HASH_DIGITS + 1 :].rstrip(b"\n")
            digest = xxhash.xxh32_hexdigest(text).encode()
            if not line.endswith(b"\n") or line[:_HASH_DIGITS] != digest:
                return
            yield json.loads(text)
