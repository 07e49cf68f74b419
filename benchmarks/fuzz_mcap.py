"""MCAP files taken apart into their records, changed, and put together again; see fuzz_records."""

from __future__ import annotations

import random
import struct
from collections import Counter
from collections.abc import Iterator

import lz4.frame
import zstandard

from fuzz_records import TIMES, odd_number, odd_payload, odd_text, shuffled, shuffled_words

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = (
    range(9, 16)
)
Record = tuple[int, bytes]

_NUMBERS: dict[int, tuple[tuple[int, int], ...]] = {
    FOOTER: ((0, 8), (8, 8), (16, 4)),
    SCHEMA: ((0, 2), (2, 4)),
    CHANNEL: ((0, 2), (2, 2), (4, 4)),
    MESSAGE: ((0, 2), (2, 4), (6, 8), (14, 8)),
    CHUNK: ((0, 8), (8, 8), (16, 8), (24, 4), (28, 4)),
    MESSAGE_INDEX: ((0, 2), (2, 4), (6, 8), (14, 8)),
    CHUNK_INDEX: ((0, 8), (8, 8), (16, 8), (24, 8), (32, 4)),
    ATTACHMENT: ((0, 8), (8, 8), (16, 4)),
    ATTACHMENT_INDEX: ((0, 8), (8, 8), (16, 8), (24, 8)),
    STATISTICS: ((0, 8), (8, 2), (10, 4), (14, 4), (18, 4), (22, 4), (26, 8), (34, 8), (42, 4)),
    METADATA_INDEX: ((0, 8), (8, 8)),
    SUMMARY_OFFSET: ((0, 1), (1, 8), (9, 8)),
    DATA_END: ((0, 4),),
}
"""Place and size of the numbers that a record begins with, by opcode."""

_PLACES = {CHUNK_INDEX: (16,), FOOTER: (0, 8), ATTACHMENT_INDEX: (0,), METADATA_INDEX: (0,)}
"""Where a record holds the places of others."""


def split(data: bytes, at: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    """Place, opcode and body of each record."""
    while at + 9 <= end:
        opcode, size = struct.unpack_from("<BQ", data, at)
        yield at, opcode, data[at + 9 : at + 9 + size]
        at += 9 + size


def _joined(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _unpacked(body: bytes) -> list[Record]:
    """The records of a chunk."""
    size, _, length = struct.unpack_from("<QII", body, 16)
    compression, data = body[32 : 32 + length], body[32 + length + 8 :]
    if compression == b"zstd":
        data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    elif compression == b"lz4":
        data = lz4.frame.decompress(data)
    return [(opcode, part) for _, opcode, part in split(data, 0, len(data))]


def changed_mcap(data: bytes, rng: random.Random) -> bytes:
    """A good file with what it holds changed, and an index that fits, or none."""
    chunks: list[list[Record]] = []
    others: list[Record] = []
    for _, opcode, body in split(data, len(MAGIC), len(data) - len(MAGIC)):
        if opcode == CHUNK:
            chunks.append(_unpacked(body))
        elif opcode in (ATTACHMENT, METADATA):
            others.append((opcode, body))
        elif opcode in (SCHEMA, CHANNEL, MESSAGE):
            if not chunks:
                chunks.append([])
            chunks[-1].append((opcode, body))
        elif opcode == HEADER:
            header = body
        elif opcode == DATA_END:
            break
    options = {"compression": b"", "indexed": True, "counted": True, "chunked": True}
    for _ in range(rng.choice((1, 1, 2))):
        kind = rng.randrange(8)
        number = rng.randrange(len(chunks)) if chunks else 0
        if kind == 0:
            chunks = shuffled(chunks, rng)
        elif kind == 1:
            options["compression"] = rng.choice((b"lz4", b"zstd", b"zst", b"none"))
        elif kind == 2:
            options[rng.choice(("indexed", "counted", "chunked"))] = False
        elif kind == 3 and others:
            at = rng.randrange(len(others))
            others[at] = others[at][0], shuffled_words(others[at][1], rng)
        elif chunks and chunks[number]:
            inside = [*chunks[number]]
            if kind == 4:
                inside = shuffled(inside, rng)
            else:
                at = rng.randrange(len(inside))
                inside[at] = _changed_record(*inside[at], rng)
            chunks[number] = inside
    return build(header, chunks, others, **options)  # type: ignore[arg-type]


def _changed_record(opcode: int, body: bytes, rng: random.Random) -> Record:
    if opcode == MESSAGE and len(body) >= 22:
        if rng.random() < 0.5:
            return opcode, body[:22] + odd_payload(body[22:], rng)
        channel, sequence, log, publish = struct.unpack_from("<HIQQ", body)
        kind = rng.randrange(4)
        if kind == 0:
            channel = rng.randrange(10)
        elif kind == 1:
            sequence = rng.choice((0, 1, 2**31, 2**32 - 1))
        elif kind == 2:
            log = rng.choice((*TIMES, log + 1, log - 1)) % 2**64
        else:
            publish = rng.choice((*TIMES, log, publish + 1)) % 2**64
        return opcode, struct.pack("<HIQQ", channel, sequence, log, publish) + body[22:]
    if rng.random() < 0.4 and len(body) > 4:
        return opcode, struct.pack("<H", rng.randrange(10)) + body[2:]
    return opcode, _odd_strings(opcode, body, rng)


def _odd_strings(opcode: int, body: bytes, rng: random.Random) -> bytes:
    """A definition or channel with another text."""
    at = 2 if opcode == SCHEMA else 4
    texts, place = [], at
    while place + 4 <= len(body) and len(texts) < 3:
        (size,) = struct.unpack_from("<I", body, place)
        texts.append(body[place + 4 : place + 4 + size])
        place += 4 + size
    if not texts:
        return shuffled_words(body, rng)
    one = rng.randrange(len(texts))
    texts[one] = odd_text(texts[one], rng)
    pieces = b"".join(struct.pack("<I", len(text)) + text for text in texts)
    return body[:at] + pieces + body[place:]


def build(
    header: bytes,
    chunks: list[list[Record]],
    others: list[Record],
    *,
    compression: bytes = b"",
    indexed: bool = True,
    counted: bool = True,
    chunked: bool = True,
) -> bytes:
    """A file of these records.

    Args:
        header: Body of the header.
        chunks: The records of each chunk.
        others: Attachments and metadata records.
        compression: Of the chunks; an unknown one is only told.
        indexed: Write indexes of messages and chunks.
        counted: Write statistics.
        chunked: Write chunks, else their records.
    """
    out = MAGIC + _joined(HEADER, header) + b"".join(_joined(*item) for item in others)
    listed: list[bytes] = []
    counts: Counter[int] = Counter()
    times: list[int] = []
    known: dict[tuple[int, int], bytes] = {}
    for inside in chunks:
        content, entries = b"", {}
        for opcode, body in inside:
            if opcode == MESSAGE and len(body) >= 22:
                channel, _, log = struct.unpack_from("<HIQ", body)
                entries.setdefault(channel, []).append((log, len(content)))
                counts[channel] += 1
                times.append(log)
            elif opcode in (SCHEMA, CHANNEL) and len(body) >= 2:
                known.setdefault((opcode, struct.unpack_from("<H", body)[0]), body)
            content += _joined(opcode, body)
        if not chunked:
            out += content
            continue
        span = [log for found in entries.values() for log, _ in found] or [0]
        pack = {b"zstd": zstandard.compress, b"lz4": lz4.frame.compress}.get(compression, bytes)
        packed = pack(content)
        head = struct.pack("<QQQII", min(span), max(span), len(content), 0, len(compression))
        body = head + compression + struct.pack("<Q", len(packed)) + packed
        start = len(out)
        out += _joined(CHUNK, body)
        length, offsets = len(out) - start, b""
        for channel, found in entries.items() if indexed else ():
            offsets += struct.pack("<HQ", channel, len(out))
            pairs = b"".join(struct.pack("<QQ", *pair) for pair in found)
            out += _joined(MESSAGE_INDEX, struct.pack("<HI", channel, len(pairs)) + pairs)
        listed.append(
            struct.pack("<QQQQI", min(span), max(span), start, length, len(offsets))
            + offsets
            + struct.pack("<QI", len(out) - start - length, len(compression))
            + compression
            + struct.pack("<QQ", len(packed), len(content))
        )
    out += _joined(DATA_END, bytes(4))
    summary = b"".join(_joined(opcode, body) for (opcode, _), body in sorted(known.items()))
    if counted:
        kinds = Counter(opcode for opcode, _ in [*others, *known])
        head = struct.pack("<QHI", sum(counts.values()), kinds[SCHEMA], kinds[CHANNEL])
        head += struct.pack("<III", kinds[ATTACHMENT], kinds[METADATA], len(listed))
        head += struct.pack("<QQI", min(times or [0]), max(times or [0]), 10 * len(counts))
        summary += _joined(
            STATISTICS, head + b"".join(struct.pack("<HQ", *pair) for pair in counts.items())
        )
    if indexed:
        summary += b"".join(_joined(CHUNK_INDEX, body) for body in listed)
    footer = struct.pack("<QQI", len(out) if summary else 0, 0, 0)
    return out + summary + _joined(FOOTER, footer) + MAGIC


def changed_mcap_records(data: bytes, rng: random.Random) -> bytes:
    """A file with one of its records gone, twice, elsewhere, or with another number."""
    records = [*split(data, len(MAGIC), len(data) - len(MAGIC))]
    kind = rng.random()
    one = rng.randrange(len(records))
    at, opcode, body = records[one]
    if kind < 0.35:
        records = shuffled(records, rng)
    elif kind < 0.45:
        records[one] = at, rng.choice((*range(17), 0x80, 0xFF)), body
    else:
        # the few records of the index tell most
        later = [n for n, record in enumerate(records) if record[1] not in (CHANNEL, SCHEMA)]
        one = rng.choice(later)
        at, opcode, body = records[one]
        records[one] = at, opcode, _odd_field(opcode, body, rng)
    return _refitted(records, rng)


def _odd_field(opcode: int, body: bytes, rng: random.Random) -> bytes:
    numbers = [item for item in _NUMBERS.get(opcode, ()) if sum(item) <= len(body)]
    if not numbers or rng.random() < 0.2:
        return shuffled_words(body, rng)
    place, size = rng.choice(numbers)
    old = int.from_bytes(body[place : place + size], "little")
    return body[:place] + odd_number(old, size, rng) + body[place + size :]


def _refitted(records: list[tuple[int, int, bytes]], rng: random.Random) -> bytes:
    """Join records, so that places fit where they are now, most of the times."""
    starts, place = {}, len(MAGIC)
    for at, _, body in records:
        starts.setdefault(at, place)
        place += 9 + len(body)
    refit = rng.random() < 0.7
    out = MAGIC
    for _, opcode, body in records:
        for place in _PLACES.get(opcode, ()) if refit else ():
            if place + 8 <= len(body):
                (old,) = struct.unpack_from("<Q", body, place)
                new = struct.pack("<Q", starts.get(old, old))
                body = body[:place] + new + body[place + 8 :]
        out += _joined(opcode, body)
    return out + MAGIC
