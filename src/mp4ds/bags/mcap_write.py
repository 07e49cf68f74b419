"""Writes MCAP files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import mcap
import zstandard
from mcap.writer import CompressionType, Writer

from mp4ds._version import __version__
from mp4ds.bags.files import most_unpacked
from mp4ds.bags.protocols import BagWriter
from mp4ds.errors import ConversionError, Mp4dsError, OptionError
from mp4ds.records import Attachment, Channel, Message, MetadataRecord, Schema

CHUNK_BYTES = 2**20
MAX_CHANNELS = 2**16 - 1
_COMPRESSION = "_Writer__compression"  # no public name lets one chunk be compressed otherwise

_COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}


class McapWriter(BagWriter):
    """Writes an MCAP file with chunks, indexes and checksums.

    Memory is bounded by one chunk, or by one message if that is larger.

    Args:
        path: The file, which is replaced.
        profile: Profile of the header.
        library: Library string of the header; if empty, this library's own.
        compression: Of the chunks: ``zstd``, ``lz4`` or ``none``.
        chunk_size: Bytes of messages after which a chunk is closed.

    Raises:
        OptionError: The compression is unknown.
        Mp4dsError: The installed mcap is too new.
        OSError: It cannot be written.
    """

    format = "mcap"

    def __init__(
        self,
        path: Path,
        *,
        profile: str,
        library: str = "",
        compression: str = "zstd",
        chunk_size: int = CHUNK_BYTES,
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise OptionError(
                f"compression {compression!r} is not known. Use {', '.join(_COMPRESSIONS)}."
            )
        super().__init__()
        self.path = path
        self._compresses = compression != "none"
        self._channel_ids: dict[int, int] = {}
        self._schema_ids: dict[Schema, int] = {}
        self._file = path.open("wb")
        try:
            self._writer: Any = Writer(
                self._file, chunk_size=chunk_size, compression=_COMPRESSIONS[compression]
            )
            if not hasattr(self._writer, _COMPRESSION):  # else noticed at the first large message
                raise Mp4dsError(
                    f"{path}: mcap {mcap.__version__} is newer than this mp4ds supports. Install "
                    f"an older one: pip install 'mcap<{mcap.__version__}'"
                )
            self._writer.start(profile=profile, library=library or f"mp4ds {__version__}")
        except BaseException:
            self.abandon()
            raise

    @staticmethod
    def check_message(message: Message) -> None:
        """Refuse a message that MCAP cannot hold.

        Raises:
            ConversionError: A time is negative or beyond 64 bits, or the sequence number beyond 32.
        """
        times = message.log_time, message.publish_time
        if not (min(times) >= 0 and max(times) < 2**64 and 0 <= message.sequence < 2**32):
            raise ConversionError(
                message.channel.topic, "has a time or sequence number that MCAP cannot hold"
            )

    def add_schema(self, schema: Schema) -> None:
        """Write a definition, whether a channel refers to it or not."""
        self._schema_id(schema)

    def _schema_id(self, schema: Schema) -> int:
        if schema not in self._schema_ids:
            if len(self._schema_ids) >= MAX_CHANNELS:
                raise ConversionError(schema.name, f"MCAP holds at most {MAX_CHANNELS} schemas")
            self._schema_ids[schema] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        return self._schema_ids[schema]

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel, with its schema."""
        if channel.id in self._channel_ids:
            return
        if len(self._channel_ids) >= MAX_CHANNELS:
            raise ConversionError(channel.topic, f"MCAP holds at most {MAX_CHANNELS} channels")
        schema_id = self._schema_id(channel.schema) if channel.schema else 0
        self._channel_ids[channel.id] = self._writer.register_channel(
            channel.topic, channel.message_encoding, schema_id, dict(channel.metadata)
        )

    def write(self, message: Message) -> None:
        """Append a message, payload verbatim."""
        self.check_message(message)
        is_large = self._compresses and 2 * len(message.data) > most_unpacked(0)
        if is_large and self._compresses_too_well(message.data):
            with self._uncompressed():
                self._add(message)
        else:
            self._add(message)

    @staticmethod
    def _compresses_too_well(data: bytes | memoryview) -> bool:
        """Whether readers could suspect its chunk of claiming more than it holds."""
        return 2 * len(data) > most_unpacked(compressed_size([data]))

    @contextmanager
    def _uncompressed(self) -> Iterator[None]:
        """Turn compression off for the chunk that a message larger than a chunk completes."""
        before = getattr(self._writer, _COMPRESSION)
        setattr(self._writer, _COMPRESSION, CompressionType.NONE)
        try:
            yield
        finally:
            setattr(self._writer, _COMPRESSION, before)

    def _add(self, message: Message) -> None:
        self._writer.add_message(
            self._channel_ids[message.channel.id],
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )

    def flush(self) -> None:
        """Give the system all that was written, so that a reader of damaged files has it."""
        self._writer.flush()

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment."""
        self._writer.add_attachment(
            attachment.create_time,
            attachment.log_time,
            attachment.name,
            attachment.media_type,
            attachment.data,
        )

    def add_metadata(self, record: MetadataRecord) -> None:
        """Append a metadata record."""
        self._writer.add_metadata(record.name, dict(record.metadata))

    def finish(self) -> None:
        """Write the last chunk and the summary, and close the file."""
        self._writer.finish()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        with suppress(OSError):
            self._file.close()


def compressed_size(payloads: Iterable[bytes | memoryview]) -> int:
    """Approximate size of messages in the chunks of an MCAP file, in bytes.

    Args:
        payloads: Of the messages, each as large as a chunk or nearly so.
    """
    return sum(len(zstandard.compress(bytes(payload))) for payload in payloads)
