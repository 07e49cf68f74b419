"""What a reader and a writer of recordings can do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from mp4ds.records import (
    EVERYTHING,
    Attachment,
    Channel,
    ChannelStats,
    Excerpt,
    Message,
    MetadataRecord,
    Record,
    Schema,
)

Format = Literal["bag", "rosbag2", "mcap"]


class BagReader(Protocol):
    """One recording, opened for reading. A context manager; the file is never changed.

    Attributes:
        path: What was opened, a file or a folder.
        profile: ``ros1``, ``ros2`` or any other MCAP profile; empty for none.
        library: The MCAP header's library string; empty for other formats.
        files: All files that the recording consists of, in reading order.
    """

    path: Path
    profile: str
    library: str
    files: Sequence[Path]

    @property
    def format(self) -> Format:
        """``bag``, ``rosbag2`` or ``mcap``."""
        ...

    @property
    def channels(self) -> Sequence[Channel]:
        """All channels known so far.

        Complete once `records` of everything is exhausted, or where the recording `is_indexed`.
        """
        ...

    @property
    def unused_schemas(self) -> Sequence[Schema]:
        """Definitions that no channel refers to.

        Complete once `records` of everything is exhausted, or where the recording `is_indexed`.
        """
        ...

    @property
    def skipped(self) -> Mapping[str, int]:
        """What the source holds and no dataset can: a phrase -> how many; to be told.

        Of what the last `records` came across.
        """
        ...

    @property
    def position(self) -> int:
        """Bytes of `files` that `records` of everything has consumed, for progress and hashing."""
        ...

    @property
    def is_indexed(self) -> bool:
        """Whether an excerpt is read, in log-time order, without reading the rest."""
        ...

    def records(self, excerpt: Excerpt = EVERYTHING) -> Iterator[Record]:
        """Read everything once, or a part of it.

        Messages of one channel come in log-time order, ties in source order; where a file
        has no index (some MCAP files) they come in file order. Attachments and metadata
        records come where the file holds them.

        An excerpt has what is part of it, in the order of the whole. Where the recording
        `is_indexed`, the messages of consecutive spans are, for each channel, those of the whole
        one after the other. What a damaged index hides is told by the counts of `stats` alone:
        let the spans be open at both ends, and count their messages.

        Args:
            excerpt: What to read. Where the recording `is_indexed`, little else is read;
                else all is, and what is not part of it left out.

        Raises:
            SourceError: The file is damaged; names the file and, where known, the topic.
        """
        ...

    def stats(self) -> Mapping[int, ChannelStats]:
        """Counts and time spans by channel id as far as an index tells, without reading on."""
        ...

    def times(self) -> Mapping[int, NDArray[np.int64]]:
        """Log times of every message, nanoseconds, sorted, by channel id.

        Uses the index where there is one, else reads the file.
        """
        ...

    def first(self, channel: Channel) -> Message | None:
        """The channel's first message by log time, or None."""
        ...

    def __enter__(self) -> BagReader: ...

    def __exit__(self, *_: object) -> None: ...


class BagWriter(Protocol):
    """One recording, opened for writing under a temporary name by the caller.

    A context manager: leaving it normally completes the file, leaving it with an exception
    abandons it (the caller removes what is left).
    """

    format: str

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel; every message's channel must have been declared.

        Raises:
            ConversionError: The format cannot hold the channel.
        """
        ...

    def add_schema(self, schema: Schema) -> None:
        """Keep a definition that no channel refers to; formats without such count it."""
        ...

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        ...

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment; formats without attachments count it in `omitted`."""
        ...

    def add_metadata(self, record: MetadataRecord) -> None:
        """Append a metadata record; formats without them count it in `omitted`."""
        ...

    @property
    def omitted(self) -> Mapping[str, int]:
        """What the format cannot hold and was left out: a phrase -> how many."""
        ...

    def __enter__(self) -> BagWriter: ...

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None: ...
