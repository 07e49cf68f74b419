"""messages.mcap of a dataset, and recorded messages for users."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.mcap import McapReader
from mp4ds.bags.protocols import Format, times_of
from mp4ds.bags.rosbag2_metadata import RECORD
from mp4ds.bags.salvage.mcap import McapSalvage
from mp4ds.errors import FormatError, SourceError
from mp4ds.format.manifest import Manifest
from mp4ds.format.sidecars import verify_file
from mp4ds.messages.wire import WireError
from mp4ds.records import (
    EVERYTHING,
    Channel,
    Excerpt,
    Loss,
    Message,
    MetadataRecord,
    Record,
    Schema,
)

_Item = TypeVar("_Item")


class MessagesFile:
    """messages.mcap of a dataset; empty for a single video with its sidecar, which has none.

    Args:
        path: The file; None if there is none.
        salvage: Whether to read what can be read if it is damaged.
    """

    def __init__(self, path: Path | None, *, salvage: bool = False) -> None:
        self.path = path
        self.is_salvaged = salvage

    def verify(self, manifest: Manifest) -> None:
        """Check it against its SHA-256: not all of its contents have their own checksum.

        Raises:
            FormatError: See `verify_file`.
        """
        if self.path is not None:
            verify_file(self.path, manifest.file(self.path.name))

    @cached_property
    def _reader(self) -> McapReader | McapSalvage | None:
        """The reader; keeps no file open between passes.

        Raises:
            FormatError: ``file-missing``, or ``messages-unreadable``: it is damaged, or does not
                list all its messages; if it is salvaged, nothing of it can be read.
        """
        if self.path is None:
            return None
        if not self.path.is_file():
            raise FormatError("file-missing", self.path, "does not exist")
        with _damage_told():
            if self.is_salvaged:
                return McapSalvage(self.path)
            reader = McapReader(self.path)
        if not reader.has_whole_index:
            raise FormatError(
                "messages-unreadable",
                self.path,
                "has no complete index; copy it again, or run `mcap recover`",
            )
        return reader

    @property
    def channels(self) -> Sequence[Channel]:
        """Its channels."""
        return self._reader.channels if self._reader else ()

    @property
    def profile(self) -> str:
        """MCAP profile of the recording."""
        return self._reader.profile if self._reader else ""

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Definitions that no channel refers to."""
        return self._reader.unused_schemas if self._reader else ()

    @property
    def losses(self) -> Sequence[Loss]:
        """What is lost of it if it is salvaged, once its messages are counted."""
        return self._reader.losses if self._reader else ()

    @cached_property
    def counts(self) -> Mapping[int, int]:
        """Number of messages that can be read by channel id."""
        if self.is_salvaged:  # its index may list more
            return {key: len(times) for key, times in self.times().items()}
        stats = self._reader.stats() if self._reader else {}
        return {key: item.count for key, item in stats.items()}

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """Sorted log times of the messages that can be read, nanoseconds, by channel id."""
        if self.is_salvaged:
            return self._salvaged_times
        with _damage_told():
            return self._reader.times() if self._reader else {}

    @cached_property
    def _salvaged_times(self) -> Mapping[int, NDArray[np.int64]]:
        with _damage_told():
            return times_of(self._reader.records() if self._reader else ())

    def in_file_order(self) -> Iterator[Record]:
        """All its records, in file order."""
        if isinstance(self._reader, McapReader):
            return _intact(self._reader.as_it_stands())
        return self._records(EVERYTHING)

    def others(self) -> Iterator[Record]:
        """The attachments and metadata records in it."""
        return self._records(Excerpt(start=0, end=0))

    def in_time(self, excerpt: Excerpt) -> Iterator[Message]:
        """The messages of an excerpt, by log time."""
        records = self._records(replace(excerpt, others=False))
        return (record for record in records if isinstance(record, Message))

    def _records(self, excerpt: Excerpt) -> Iterator[Record]:
        reader = self._reader
        if isinstance(reader, McapSalvage):
            reader = McapSalvage(reader.path)  # one reads once at a time
        return _intact(reader.records(excerpt) if reader else ())


@contextmanager
def _damage_told() -> Iterator[None]:
    """Turn the error of a damaged recording into that of a damaged dataset."""
    try:
        yield
    except SourceError as error:
        raise FormatError("messages-unreadable", error.path, error.problem) from None


def _intact(items: Iterable[_Item]) -> Iterator[_Item]:
    with _damage_told():
        yield from items


def recorded_format(file: MessagesFile) -> Format:
    """The likely format of the recording that a messages.mcap is of."""
    if any(isinstance(item, MetadataRecord) and item.name == RECORD for item in file.others()):
        return "rosbag2"
    return "bag" if file.profile == "ros1" else "mcap"


def recorded_storage(records: Iterable[Record]) -> str:
    """The storage of a rosbag2 source; mcap, the default of ROS 2, if unknown.

    Args:
        records: All records of messages.mcap; the folder's own record precedes its messages.
    """
    for record in records:
        if isinstance(record, Message):
            break
        if isinstance(record, MetadataRecord) and record.name == RECORD:
            return "sqlite3" if record.metadata.get("storage") == "sqlite3" else "mcap"
    return "mcap"


@dataclass(frozen=True)
class RecordedMessage:
    """One message as recorded.

    Attributes:
        topic: Its topic.
        type_name: Its type as the recording spells it; empty if unknown.
        log_time_ns: When it was recorded, nanoseconds.
        publish_time_ns: When it was published, nanoseconds; the log time if unknown.
        raw: Its bytes, read-only.
        decode: Called by `decoded`.
    """

    topic: str
    type_name: str
    log_time_ns: int
    publish_time_ns: int
    raw: memoryview
    decode: Callable[[memoryview], Any] = field(repr=False, compare=False)

    @cached_property
    def decoded(self) -> Any:
        """The message as an object, decoded on first access.

        ROS 1 and ROS 2 messages become objects with the message's fields as attributes and numeric
        arrays as numpy arrays; protobuf gives a protobuf message; JSON gives dicts and lists.

        Raises:
            OptionError: No message of the topic can be decoded.
            SourceError: This one does not match its topic's type.
        """
        return self.decode(self.raw)


def as_recorded(messages: Iterable[Message], path: Path) -> Iterator[RecordedMessage]:
    """Messages for users.

    Args:
        messages: Of any channels.
        path: Where they are from, for errors.
    """
    decoders: dict[int, Callable[[memoryview], Any]] = {}
    for message in messages:
        channel = message.channel
        decode = decoders.setdefault(channel.id, _decoder(channel, path))
        yield RecordedMessage(
            topic=channel.topic,
            type_name=channel.type_name,
            log_time_ns=message.log_time,
            publish_time_ns=message.publish_time,
            raw=memoryview(message.data).toreadonly(),
            decode=decode,
        )


def _decoder(channel: Channel, path: Path) -> Callable[[memoryview], Any]:
    """Decodes the messages of a channel; the library's decoder is made for the first one."""

    @cache
    def made() -> Callable[[memoryview], Any]:
        # rosbags is slow to import, and not everyone decodes messages
        from mp4ds.bags.convert import decoder_of

        return decoder_of(channel)

    def decode(raw: memoryview) -> Any:
        try:
            return made()(raw)
        except WireError as error:
            problem = f"a message of {channel.topic} cannot be decoded: {error}"
            raise SourceError(path, problem) from None

    return decode
