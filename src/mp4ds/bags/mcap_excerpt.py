"""Reading parts of an MCAP file without the rest."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from functools import partial

from mcap.opcode import Opcode

from mp4ds.bags.mcap_between import Between, read_frames
from mp4ds.bags.mcap_chunks import ChunkEntry
from mp4ds.bags.mcap_declared import Declared
from mp4ds.bags.mcap_index import Summary
from mp4ds.bags.mcap_records import (
    PRIVATE_OPCODE,
    DamageError,
    MessageHead,
    RecordStream,
    chunk_records,
    parse_message,
    unpack_chunk,
)
from mp4ds.bags.ordering import HoldBack
from mp4ds.records import Attachment, Excerpt, MetadataRecord, Record

_OTHERS = (Opcode.ATTACHMENT, Opcode.METADATA)


def read_others(stream: RecordStream, declared: Declared) -> Iterator[Record]:
    """The attachments and metadata records of a file, seeking over all else.

    Raises:
        SourceError: The file is damaged or cut short.
    """
    for opcode, place in read_frames(stream):
        if opcode in _OTHERS:
            yield _other_at(stream, place, declared)
        elif opcode >= PRIVATE_OPCODE:
            declared.skip(opcode)


def _other_at(stream: RecordStream, place: int, declared: Declared) -> Attachment | MetadataRecord:
    stream.seek(place)
    try:
        record = declared.other(*stream.next())
    except DamageError as error:
        raise stream.damaged(error) from None
    if record is None:
        raise stream.damaged("it was another one before")
    return record


def read_chunks(
    stream: RecordStream, excerpt: Excerpt, summary: Summary, between: Between, declared: Declared
) -> Iterator[Record]:
    """Read an excerpt from the chunks that it needs, by their starts, whatever their order.

    Args:
        stream: A stream of known size.
        excerpt: What to read.
        summary: The file's summary.
        between: What stands between its chunks.
        declared: What the file declares, from its summary on.

    Yields:
        Messages by log time, ties in file order, payloads as the file holds them; attachments
        and metadata records as they stand among the chunks.

    Raises:
        SourceError: The file is damaged, or holds other messages than its index tells.
    """
    others = deque(between.others if excerpt.others else ())
    if excerpt.others:
        for opcode, count in between.private.items():
            declared.skip(opcode, count)
    known = summary.channels.keys()
    unwanted = {key for key in known if not excerpt.has_topic(declared.channels[key].topic)}
    held = HoldBack()
    select = partial(summary.chunks.select, excerpt, unwanted)
    chunks = select() if excerpt.has_messages else ()
    stream.expect((chunk.offset, chunk.offset + chunk.length) for chunk, _ in select())
    for chunk, following in chunks:
        while others and others[0] < chunk.offset:
            yield _other_at(stream, others.popleft(), declared)
        counts_private = excerpt.has_time(chunk.start)  # by one of several spans
        try:
            for kind, part in _records(stream, chunk):
                if kind == Opcode.MESSAGE:
                    head = parse_message(part)
                    _check(head, chunk, summary)
                    if head.channel_id not in unwanted and excerpt.has_time(head.log_time):
                        held.add(declared.message(head, "it"), chunk.offset)
                elif kind < PRIVATE_OPCODE or counts_private:
                    declared.take(kind, part)
        except DamageError as error:
            raise stream.damaged(error) from None
        # Of messages at the very start of the next chunk, some may stand before this one.
        yield from held.release(None if following is None else following - 1)
    for place in others:
        yield _other_at(stream, place, declared)


def _records(stream: RecordStream, chunk: ChunkEntry) -> Iterator[tuple[int, memoryview]]:
    """Opcode and body of each record in a chunk."""
    stream.seek(chunk.offset)
    opcode, body = stream.next()
    if opcode != Opcode.CHUNK or stream.tell() != chunk.offset + chunk.length:
        raise DamageError("it is not the chunk that the index lists there")
    content = unpack_chunk(body)
    if len(content) > chunk.size:
        raise DamageError(f"it unpacks to {len(content)} bytes, and its index tells of less")
    for _, kind, part in chunk_records(content):
        yield kind, part


def _check(head: MessageHead, chunk: ChunkEntry, summary: Summary) -> None:
    """Refuse a message that an excerpt without this chunk would have lost."""
    if not chunk.start <= head.log_time <= chunk.end:
        problem = f"of log time {head.log_time}"
    elif head.channel_id not in summary.channels or (
        chunk.channels and head.channel_id not in chunk.channels
    ):
        problem = f"of channel {head.channel_id}"
    else:
        return
    raise DamageError(f"it holds a message {problem}, of which its index does not tell")
