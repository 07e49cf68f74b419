"""The records of an MCAP file as neutral ones, with what the file has declared so far."""

from __future__ import annotations

from collections import Counter

from mcap import records as mcap_records
from mcap.opcode import Opcode

from mp4ds.bags.mcap_records import (
    PRIVATE_OPCODE,
    DamageError,
    MessageHead,
    parse,
    parse_attachment,
)
from mp4ds.records import Attachment, Channel, Message, MetadataRecord, Schema


class Declared:
    """Schemas and channels of one file.

    Attributes:
        channels: By their id in the file, in the order in which they were met.
        skipped: Records that only the application that wrote them understands: name -> count.
    """

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.skipped: Counter[str] = Counter()
        self._schemas: dict[int, mcap_records.Schema] = {}
        self._records: dict[int, mcap_records.Channel] = {}

    @property
    def unused_schemas(self) -> list[Schema]:
        """Schemas that no channel refers to."""
        used = {channel.schema for channel in self.channels.values()}
        unused = (_schema(record) for record in self._schemas.values())
        return list(dict.fromkeys(schema for schema in unused if schema not in used))

    def take(self, opcode: int, body: bytes | memoryview) -> None:
        """Take in a schema or channel, count a private record, pass over any other.

        Raises:
            DamageError: It is damaged, or contradicts what was declared before.
        """
        if opcode == Opcode.SCHEMA:
            self.add_schema(parse(mcap_records.Schema, body))
        elif opcode == Opcode.CHANNEL:
            self.add_channel(parse(mcap_records.Channel, body))
        elif opcode >= PRIVATE_OPCODE:
            self.skip(opcode)

    def add_schema(self, schema: mcap_records.Schema) -> None:
        """Take in a schema. See `take`."""
        if self._schemas.setdefault(schema.id, schema) != schema:
            raise DamageError(f"schema {schema.id} is defined twice and differently")

    def add_channel(self, record: mcap_records.Channel) -> None:
        """Take in a channel. See `take`."""
        if self._records.setdefault(record.id, record) != record:
            raise DamageError(
                f"channel {record.id} ({record.topic}) is defined twice and differently"
            )
        if record.id not in self.channels:
            schema = self._schemas.get(record.schema_id) if record.schema_id else None
            self.channels[record.id] = Channel(
                record.id,
                record.topic,
                record.message_encoding,
                _schema(schema) if schema else None,
                record.metadata,
            )

    def skip(self, opcode: int, count: int = 1) -> None:
        """Count private records."""
        self.skipped[f"private MCAP records (opcode 0x{opcode:02x})"] += count

    def message(self, head: MessageHead, place: str) -> Message:
        """A message, its payload as the file holds it.

        Args:
            head: What the file holds.
            place: Which one it is, for errors.

        Raises:
            DamageError: Its channel is not defined.
        """
        channel = self.channels.get(head.channel_id)
        if channel is None:
            raise DamageError(f"{place} is of channel {head.channel_id}, which is not defined")
        return Message(channel, head.log_time, head.publish_time, head.sequence, head.data)

    def other(self, opcode: int, body: bytes) -> Attachment | MetadataRecord | None:
        """A record that is no message, to pass on; None where there is nothing to pass on.

        Raises:
            DamageError: It is damaged, or contradicts what was declared before.
        """
        if opcode == Opcode.ATTACHMENT:
            found = parse_attachment(body)
            return Attachment(
                found.name, found.media_type, found.create_time, found.log_time, found.data
            )
        if opcode == Opcode.METADATA:
            record = parse(mcap_records.Metadata, body)
            return MetadataRecord(record.name, record.metadata)
        self.take(opcode, body)
        return None


def _schema(record: mcap_records.Schema) -> Schema:
    return Schema(record.name, record.encoding, record.data)
