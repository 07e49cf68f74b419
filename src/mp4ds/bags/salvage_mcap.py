"""Reads what is left of a damaged MCAP file."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
from mcap import records as mcap_records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from mp4ds.bags.files import DamageError, recover
from mp4ds.bags.mcap_records import (
    FOOTER_BYTES,
    FRAME,
    MAGIC,
    MAX_RECORD_BYTES,
    MESSAGE_HEAD,
    PRIVATE_OPCODE,
    Declared,
    McapSummary,
    RecordStream,
    chunk_records,
    parse,
    read_summary,
    summary_place,
    unpack_chunk,
)
from mp4ds.bags.salvage_scan import BLOCK, FileSalvage, Lose, RecordFrame, Scan, Window
from mp4ds.errors import SourceError
from mp4ds.records import Attachment, ChannelStats, Message, MetadataRecord

# ---------------------------------------------------------------- finding records

_HEAD = FRAME.size
_MAX_LENGTH = 2**40
_COMPRESSIONS = (b"", b"lz4", b"zstd")

# Bytes of the fields in the bodies of records, a string or map as the format of its length.
_LAYOUTS: Mapping[int, tuple[int | str, ...]] = {
    Opcode.SCHEMA: (2, "<I", "<I", "<I"),
    Opcode.CHANNEL: (4, "<I", "<I", "<I"),
    Opcode.CHUNK: (28, "<I", "<Q"),
    Opcode.MESSAGE_INDEX: (2, "<I"),
    Opcode.ATTACHMENT: (16, "<I", "<I", "<Q", 4),
    Opcode.METADATA: ("<I", "<I"),
}
_SHORTEST = {
    Opcode.FOOTER: 20,
    Opcode.MESSAGE: 22,
    Opcode.DATA_END: 4,
    **{
        kind: sum(struct.calcsize(part) if isinstance(part, str) else part for part in layout)
        for kind, layout in _LAYOUTS.items()
    },
}


def _table(known: Mapping[int, int], other: int) -> NDArray[np.int64]:
    table = np.full(256, other, np.int64)
    for opcode, value in known.items():
        table[opcode] = value
    return table


# Records that are not searched for have no possible length.
_SHORTEST_OF = _table(_SHORTEST, _MAX_LENGTH)
_LONGEST_OF = _table(
    {**dict.fromkeys(_SHORTEST, _MAX_LENGTH), Opcode.DATA_END: 4, Opcode.FOOTER: 20}, 0
)


def _fields_end(kind: int, body: memoryview) -> int | None:
    """Bytes of a record's body by its fields; None if they are not those of its kind."""
    at = 0
    ends = []
    try:
        for part in _LAYOUTS[kind]:
            at += part if isinstance(part, int) else 0
            if isinstance(part, str):
                at += struct.calcsize(part) + int(struct.unpack_from(part, body, at)[0])
            ends.append(at)
    except (KeyError, struct.error):
        return None
    if kind == Opcode.MESSAGE_INDEX and (at - _SHORTEST[kind]) % 16:
        return None
    if kind == Opcode.CHUNK and bytes(body[32 : ends[1]]) not in _COMPRESSIONS:
        return None
    return at


class _Scan(Scan):
    """Finds records by opcode and length; MCAP has no sync markers.

    In sequence, anything the format allows is a record. After damage, it must be of a kind whose
    fields match the length of its frame, or a message of a known channel followed by another
    record.

    Args:
        window: What to read.
        lose: Called with what is skipped.
        channels: Ids of the known channels; may grow.
        longest: Bytes of a record are fewer.
    """

    lookahead = 2**16
    outer = (
        *(Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT),
        *(Opcode.METADATA, Opcode.DATA_END, Opcode.FOOTER),
    )

    def __init__(self, window: Window, lose: Lose, channels: Collection[int], longest: int) -> None:
        super().__init__(window, lose)
        self._channels = channels
        self._longest = longest

    def frame(self, view: memoryview) -> RecordFrame | None:
        """The record at the start of these bytes: any that the format allows."""
        if len(view) < _HEAD:
            return None
        opcode, length = FRAME.unpack_from(view)
        if length >= self._longest or length < _SHORTEST.get(opcode, 0):
            return None
        if not 1 <= opcode <= Opcode.DATA_END and opcode < PRIVATE_OPCODE:
            return None
        if opcode == Opcode.CHUNK:
            needed = _fields_end(opcode, view[_HEAD:])
            if needed is None or needed > length:
                return None
        return RecordFrame(opcode, _HEAD, _HEAD + length)

    def find(
        self, view: memoryview, end: int, ahead: int = 0, kinds: Collection[int] | None = None
    ) -> int | None:
        """The start of the first certain record."""
        for start in self._candidates(view, end):
            if kinds is not None and view[start] not in kinds:
                continue
            size = self._sure_size(view[start:])
            if size == 0 or (size and self.is_followed(ahead + start + size)):
                return start
        return None

    def _candidates(self, view: memoryview, end: int) -> list[int]:
        """Places of an opcode followed by a plausible length."""
        data = np.frombuffer(view, np.uint8)[: end + _HEAD]
        if len(data) < _HEAD:
            return []
        kinds = data[: -_HEAD + 1]
        mask = (data[7 : len(data) - 1] == 0) & (data[8:] == 0)
        mask &= (kinds - np.uint8(Opcode.FOOTER)) <= Opcode.DATA_END - Opcode.FOOTER
        places = np.flatnonzero(mask)
        if not len(places):
            return []
        lengths = np.zeros(len(places), np.int64)
        for byte in range(6):
            lengths |= data[places + 1 + byte].astype(np.int64) << (8 * byte)
        found = kinds[places]
        keep = (lengths >= _SHORTEST_OF[found]) & (lengths <= _LONGEST_OF[found])
        keep[found == Opcode.MESSAGE] &= self._is_known(data, places[found == Opcode.MESSAGE])
        result: list[int] = places[keep & (places < end)].tolist()
        return result

    def _is_known(self, data: NDArray[np.uint8], places: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether messages at these places are of known channels."""
        low = np.minimum(places + _HEAD, len(data) - 1)
        high = np.minimum(places + _HEAD + 1, len(data) - 1)
        ids = data[low].astype(np.int64) | data[high].astype(np.int64) << 8
        # the last few may extend beyond the view: the strict check decides
        return np.isin(ids, list(self._channels)) | (places + _HEAD + 1 >= len(data))

    def _sure_size(self, view: memoryview) -> int | None:
        """0 for a certain record, its size if another must follow, None for no record."""
        frame = self.frame(view)
        if frame is None:
            return None
        body, length = view[_HEAD:], frame.size - _HEAD
        if frame.kind == Opcode.MESSAGE:
            is_known = int.from_bytes(body[:2], "little") in self._channels
            return frame.size if is_known else None
        if frame.kind == Opcode.FOOTER:
            return 0 if bytes(body[20 : 20 + len(MAGIC)]) == MAGIC else None
        if frame.kind == Opcode.DATA_END:
            return frame.size
        return 0 if _fields_end(frame.kind, body) == length else None


# ---------------------------------------------------------------- the summary


def _read_summary(path: Path) -> tuple[McapSummary, McapSummary]:
    """The summary of a file: where it matches its checksum, and as far as it can be read otherwise.

    Returns:
        The summary; only its place if it is damaged, and nothing if that is unknown. And a damaged
        one up to the damage; empty for a sound one.

    Raises:
        SourceError: The file cannot be read.
    """
    place, read, stream = 0, McapSummary(), RecordStream(path, MAX_RECORD_BYTES)
    with closing(stream), suppress(SourceError, DamageError):
        found, checksum = summary_place(stream)
        if len(MAGIC) < found < stream.size - FOOTER_BYTES:
            place = found
            is_sound = checksum in (0, _checksum(stream, place))
            is_found = read_summary(stream, read) is not None
            if is_sound:
                return (read if is_found else McapSummary()), McapSummary()
    return McapSummary(place), read


def _checksum(stream: RecordStream, start: int) -> int:
    """That of a summary and the footer, but for the checksum in it."""
    stream.seek(start)
    found, left = 0, stream.size - len(MAGIC) - 4 - start
    while left:
        piece = stream.read(min(left, BLOCK))
        found, left = zlib.crc32(piece, found), left - len(piece)
    return found


# ---------------------------------------------------------------- a pass

_CHUNK_HEAD = struct.Struct("<QQQII")
_MARGIN = 600 * 10**9  # ns; a damaged chunk may seem to end where the next one does
_Found = Message | Attachment | MetadataRecord | None


def _recovered(
    compression: str, data: memoryview, size: int, crc: int
) -> tuple[bytes, int, str, bool]:
    """What can be recovered from the records of a chunk, of which the checksum is `crc` or 0.

    Returns:
        The records; bytes of the data that were used, as far as known; what is wrong, a phrase,
        empty if nothing is; and whether the records may differ from what was recorded.
    """
    content, used, damage, is_sound = recover(compression, data, min(size, MAX_RECORD_BYTES))
    problem = damage
    if crc and zlib.crc32(content) == crc:
        problem = ""
    elif crc and not problem:
        problem = "a chunk does not match its checksum: what could be read of it may be altered"
    return content, used, problem, bool(problem) and (not is_sound or not damage)


def _message_count(statistics: mcap_records.Statistics | None) -> int | None:
    """How many messages a file has; None if its statistics contradict themselves."""
    if statistics is None:
        return None
    counts, total = statistics.channel_message_counts, int(statistics.message_count)
    return total if total == sum(counts.values()) else None


# ---------------------------------------------------------------- the reader


class McapSalvage(FileSalvage):
    """Reads what is left of an MCAP file.

    Args:
        path: The file.
        most: Bytes that a record may have.
        is_alone: Whether it is an error, not just a loss, if nothing can be read.

    Raises:
        SourceError: The file is missing, empty, or unreadable.
    """

    format = "mcap"
    magic = MAGIC
    kind = "an MCAP file"

    def __init__(self, path: Path, *, most: int = _MAX_LENGTH, is_alone: bool = True) -> None:
        super().__init__(path, is_alone=is_alone)
        self._declared = declared = Declared()
        self._channels = declared.channels
        self._schemas = declared.schemas.values()
        self._skipped = declared.skipped
        self._summary, self._doubtful = _read_summary(path)
        self._index_offset = self._summary.offset or None
        self._is_timed = self._summary.chunks.has_messages
        self._longest = most
        declared.add_summary(self._summary)
        with closing(RecordStream(path, BLOCK)) as stream, suppress(SourceError, DamageError):
            stream.seek(len(MAGIC))
            opcode, body = stream.next()
            if opcode == Opcode.HEADER:
                header = parse(mcap_records.Header, body)
                self.profile, self.library = header.profile, header.library

    def _scan_of(self, window: Window, lose: Lose) -> Scan:
        return _Scan(window, lose, self._declared.channels, self._longest)

    @property
    def span(self) -> tuple[int, int] | None:
        """Earliest and latest log time from the summary, ns; None if unknown."""
        return self._summary.span()

    def _stats(self) -> Mapping[int, ChannelStats]:
        """Counts and spans from the summary, including lost messages; otherwise empty."""
        return self._summary.stats()

    def _scanned(self) -> Iterator[_Found]:
        """All records in the order of the file; None after each of the file's own records."""
        summary = self._summary
        self._declared.skipped.clear()
        self._count = _message_count(summary.statistics)
        self._defined = set(summary.schemas)
        self._undefined: dict[int, int] = {}
        # a damaged uncompressed chunk: where it begins and ends, and what is wrong
        self._plain: tuple[int, int, str] | None = None
        if self._begins():
            self._read_header()
        ended = False
        while frame := self._scan.next():
            self._found += 1
            self._earliest = summary.chunks.later(self._window.offset)
            if frame.kind == Opcode.FOOTER:
                ended = True
                self._end(frame)
            else:
                ended = False
                yield from self._record(frame)
            if not self._tally.held:
                yield None
        self._leave_plain(Opcode.FOOTER)
        yield from self._tally.settle()
        if not ended:
            self._tally.skipped(self._window.offset, None, "the file ends before its footer")
        self._tally.close()
        for channel_id, schema_id in self._undefined.items():
            topic = self._topic_of(channel_id)
            if schema_id not in self._defined and topic is not None:
                problem = f"the definition of its messages, schema {schema_id}, is missing"
                self._tally.lost(None, None, problem).add(0, [topic])

    def _read_header(self) -> None:
        window, frame = self._window, self._scan.here()
        if frame is None or frame.kind != Opcode.HEADER or not self._scan.is_followed(frame.size):
            self._scan.resync(window.offset, "the header is damaged", passed=0)
            return
        self._found += 1
        body = self._scan.body(frame)
        try:
            parse(mcap_records.Header, body or b"")
        except DamageError:
            self._lose(len(MAGIC), frame.size, "the header is damaged")

    def _end(self, frame: RecordFrame) -> None:
        self._scan.body(frame)
        window = self._window
        if bytes(window.peek(len(MAGIC))) == MAGIC:
            window.skip(len(MAGIC))
        else:
            start = window.offset
            window.skip(len(MAGIC))
            self._lose(start, window.offset - start, "the last bytes are not those of an MCAP file")

    def _record(self, frame: RecordFrame) -> Iterator[_Found]:
        self._leave_plain(frame.kind)
        if frame.kind != Opcode.MESSAGE_INDEX and self._plain is None:
            yield from self._tally.settle()
        if frame.kind == Opcode.CHUNK:
            yield from self._chunk(frame)
            return
        offset = self._window.offset
        body = self._scan.body(frame)
        if body is None:
            return
        try:
            if frame.kind == Opcode.MESSAGE:
                yield from self._take(body, offset, is_doubtful=self._plain is not None)
            elif frame.kind == Opcode.MESSAGE_INDEX:
                self._listed(body, offset)
            else:
                yield self._other(frame.kind, body)
        except DamageError as error:
            self._lose(offset, frame.size, str(error))

    def _other(self, opcode: int, body: bytes | memoryview) -> _Found:
        """Process a record that is neither message nor chunk.

        Raises:
            DamageError: It is damaged, or contradicts another one.
        """
        if opcode == Opcode.STATISTICS:
            self._count = _message_count(parse(mcap_records.Statistics, body))
        elif opcode == Opcode.SCHEMA:
            self._defined.add(parse(mcap_records.Schema, body).id)
        elif opcode == Opcode.CHANNEL:
            channel = parse(mcap_records.Channel, body)
            if channel.schema_id and channel.schema_id not in self._defined:
                self._undefined[channel.id] = channel.schema_id
        return self._declared.other(opcode, body)

    def _take(
        self, body: bytes | memoryview, offset: int, *, is_doubtful: bool
    ) -> Sequence[Message]:
        """A message, unless it is lost, or held until an index confirms it.

        Raises:
            DamageError: It is shorter than its fields.
        """
        channel_id = int.from_bytes(body[:2], "little")
        if is_doubtful and channel_id not in self._declared.channels:
            return ()
        if not self._has_channel(channel_id) and len(body) >= MESSAGE_HEAD.size:
            problem = f"messages of channel {channel_id}, whose record is missing"
            self._tally.stray(channel_id, offset, problem)
            return ()
        return self._tally.take(channel_id, self._declared.message(body), is_doubtful=is_doubtful)

    def _has_channel(self, channel_id: int) -> bool:
        """Whether a channel is known; from a damaged summary as a last resort."""
        record = self._doubtful.channels.get(channel_id)
        if channel_id not in self._declared.channels and record is not None:
            schema = self._doubtful.schemas.get(record.schema_id)
            if schema is not None and schema.id not in self._defined:
                self._defined.add(schema.id)
                self._declared.add_schema(schema)
            self._declared.add_channel(record)
        return channel_id in self._declared.channels

    def _chunk(self, frame: RecordFrame) -> Iterator[_Found]:
        """The messages of a chunk, as far as it can be decompressed."""
        offset = self._window.offset
        have, proven = self._peek_chunk(frame)
        body = have[frame.head :]  # with all fields before its records, or it would be no frame
        start, end, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
        head = _CHUNK_HEAD.size + name_length + 8
        compression = bytes(body[_CHUNK_HEAD.size : head - 8]).decode()
        used = int.from_bytes(body[head - 8 : head], "little")
        content, records, problem, is_doubtful = b"", None, "", False
        if crc:
            with suppress(DamageError):
                records = list(chunk_records(unpack_chunk(body)))
        if records is None:
            found = _recovered(compression, body[head:][:used], size, crc)
            content, used, problem, is_doubtful = found
        margin = 0 if compression else _MARGIN
        self._tally.open(None, offset + frame.size, (start - margin, end + margin))
        if problem and not compression:
            # Its records are in the file like any other: damage to one does not hide the others.
            if is_doubtful:
                self._plain = offset, offset + frame.size, problem
            self._window.skip(frame.head + head)
            return
        problems = [problem] if problem else []
        scanned = ((part.kind, data) for part, data in self._inside(content, problems))
        for kind, data in scanned if records is None else records:
            try:
                if kind != Opcode.MESSAGE:
                    self._other(kind, data)
                else:
                    yield from self._take(data, offset, is_doubtful=is_doubtful)
            except DamageError as error:
                problems.append(f"in a chunk, {error}")
        used = frame.head + head + used if used or records is not None else frame.head
        self._leave_chunk(frame, used, problems, proven=proven, whole=not problem)

    def _leave_plain(self, kind: int) -> None:
        """At the end of a damaged uncompressed chunk, record the damage if nothing else did."""
        if self._plain is None:
            return
        start, end, problem = self._plain
        offset = self._window.offset
        if offset < end and kind not in self._scan.outer:
            return
        self._plain = None
        if not self._tally.losses:
            self._lose(start, min(offset, end) - start, problem)

    def _listed(self, body: bytes, offset: int) -> None:
        """Process a message index: what it lists was read, or is lost."""
        channel_id, length = struct.unpack_from("<HI", body)
        pairs = np.frombuffer(body, "<u8", count=min(length, len(body) - 6) // 8, offset=6)
        self._tally.listed(channel_id, pairs[::2], offset)
