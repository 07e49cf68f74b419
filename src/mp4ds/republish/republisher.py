"""Which topics of a dataset are given in another form, and their messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mp4ds.dataset import Dataset, ImageChannel, Stream
from mp4ds.errors import ConversionError, FormatError, OptionError
from mp4ds.records import Channel, Message
from mp4ds.republish.pictures import AsRecorded, Form, Frames, Kept, frames_of, holds_files
from mp4ds.republish.topics import KINDS, FreeTopics, republished_topic
from mp4ds.republish.types import Types, type_of
from mp4ds.streams.rebuild import message_at
from mp4ds.wire import WireError, is_camera

_NOT_DECODED = "its picture does not decode"
_ALREADY = {
    "raw": "raw images",
    "jpeg": "JPEG files",
    "png": "PNG files",
    "compressed-video": "CompressedVideo",
}


@dataclass(frozen=True)
class Republished:
    """What became of a topic.

    Attributes:
        topic: Where its images are now.
        type_name: Of their messages.
        instead_of: The topic that they would have had, if another one has it.
    """

    topic: str
    type_name: str
    instead_of: str = ""


class Republisher:
    """Gives the images of a dataset in another form: plans when made, works as it is read.

    Args:
        dataset: The dataset.
        kind: One of `KINDS`.
        encoding: Message encoding of the recording to make: ``ros1`` or ``cdr``.
        selected: Whether a topic is wanted.
        jpeg_quality: Of new JPEG files, 1 to 100.

    Attributes:
        channels: The new channels.
        sources: Makes the messages of streams, by the paths of their sidecars; see
            `Dataset.records`.
        republished: What became of each topic.
        as_recorded: Camera topics of which messages stay as recorded: reason -> how many. Grows
            while the messages are read.

    Raises:
        OptionError: There is no such kind.
    """

    def __init__(
        self,
        dataset: Dataset,
        kind: str,
        *,
        encoding: str,
        selected: Callable[[str], bool],
        jpeg_quality: int,
    ) -> None:
        if kind not in KINDS:
            raise OptionError(f"--images {kind!r} is not known. Use {', '.join(KINDS)}.")
        self._form = Form(kind, encoding == "ros1", jpeg_quality)
        self._types = Types(encoding, kind)
        self._omitted: Counter[str] = Counter()
        self.channels: list[Channel] = []
        self.sources: dict[Path, Callable[[Channel], Iterator[tuple[int, Message]]]] = {}
        self.republished: dict[str, Republished] = {}
        self.as_recorded: dict[str, dict[str, int]] = {}
        self._emptied: set[int] = set()
        chosen = [item for item in dataset.image_channels() if selected(item.channel.topic)]
        planned = [(item, self._plan(item)) for item in chosen]
        for item, frames in planned:
            if not item.recorded and len(frames) == len(item.streams):
                self._emptied.add(item.channel.id)
        self._declare(dataset, planned)
        self._count_verbatim(dataset, selected)

    @property
    def omitted(self) -> Mapping[str, int]:
        """What the new messages have no place for: a phrase -> how many."""
        return self._omitted + Counter(self._types.omitted)

    def empties(self, channel: Channel) -> bool:
        """Whether all messages of a channel of the dataset go to new ones, as far as is known."""
        return channel.id in self._emptied

    def _plan(self, item: ImageChannel) -> list[tuple[Stream, Frames]]:
        """The streams of a channel that are given in another form, and how."""
        planned = []
        for stream in item.streams:
            try:
                if self._is_done(stream):
                    raise AsRecorded(f"they are {_ALREADY[self._form.kind]} already")
                planned.append((stream, frames_of(stream, self._form)))
            except AsRecorded as reason:
                self._keep(item.channel.topic, str(reason), len(stream))
        return planned

    def _is_done(self, stream: Stream) -> bool:
        """Whether the messages are of the kind already, in whichever ROS."""
        sidecar, kind = stream.sidecar, self._form.kind
        channel = sidecar.channel.to_record(0)
        name = channel.type_name.replace("/msg/", "/")
        if channel.message_encoding not in ("ros1", "cdr") or name != type_of(kind):
            return False
        if kind in ("jpeg", "png"):
            is_file = holds_files(sidecar, kind) or (kind == "jpeg" and sidecar.body == "jpeg")
            return is_file and not any(header.prefix for header in sidecar.headers)
        return True

    def _declare(
        self, dataset: Dataset, planned: list[tuple[ImageChannel, list[tuple[Stream, Frames]]]]
    ) -> None:
        staying = [channel for channel in dataset.channels if channel.id not in self._emptied]
        free = FreeTopics((channel.topic for channel in staying), self._form.kind)
        next_id = 1 + max((channel.id for channel in dataset.channels), default=0)
        for item, frames in planned:
            if not frames:
                continue
            recorded = item.channel
            if recorded.topic not in self.republished:
                wanted = republished_topic(recorded.topic, recorded.type_name, self._form.kind)
                topic = free.take(wanted)
                instead_of = wanted if topic != wanted else ""
            else:
                topic, instead_of = self.republished[recorded.topic].topic, ""
            channel = self._types.channel(recorded, next_id + len(self.channels), topic)
            self.channels.append(channel)
            self.republished.setdefault(
                recorded.topic, Republished(topic, channel.type_name, instead_of)
            )
            for stream, make in frames:
                self.sources[stream.path] = partial(self._messages, stream, make, channel)

    def _count_verbatim(self, dataset: Dataset, selected: Callable[[str], bool]) -> None:
        cameras = {channel.topic for channel in dataset.channels if is_camera(channel)}
        for entry in dataset.manifest.verbatim if dataset.manifest else []:
            if entry.topic in cameras and selected(entry.topic):
                self._keep(entry.topic, f"stored as it was: {entry.reason}", entry.messages)

    def _keep(self, topic: str, reason: str, count: int) -> None:
        reasons = self.as_recorded.setdefault(topic, {})
        reasons[reason] = reasons.get(reason, 0) + count

    def _messages(
        self, stream: Stream, frames: Frames, made: Channel, recorded: Channel
    ) -> Iterator[tuple[int, Message]]:
        """The messages of a stream, each with its place among those of the recorded channel."""
        columns = stream.rebuilder.columns
        headers = stream.sidecar.headers
        count = 0
        for index, frame in enumerate(frames()):
            count += 1
            if count > len(stream):
                break
            ordinal = int(columns.ordinal[index])
            if isinstance(frame, Kept):
                self._keep(recorded.topic, _NOT_DECODED, 1)
                yield ordinal, message_at(columns, index, recorded, frame.payload)
                continue
            frame_id = headers[int(columns.variant[index])].frame_id
            try:
                slots = columns.slots(index)
                payload = self._types.message(slots, frame_id, frame.fields, frame.body)
            except WireError as error:
                raise ConversionError(recorded.topic, f"message {index}: {error}") from None
            if slots.seq is not None and not self._types.has_seq:
                self._omitted[self._types.no_seq] += 1
            yield ordinal, message_at(columns, index, made, payload)
        if count != len(stream):
            problem = f"has {count} frames or more, {len(stream)} are due"
            raise FormatError("frame-count", stream.video_path, problem)
