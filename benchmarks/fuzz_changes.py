"""How the fuzzer changes recordings and datasets; see fuzz.py.

Recordings are taken apart into their records, changed, and put together again. What is changed is
what a reader trusts: lengths, counts, offsets, opcodes, times, definitions, compression, indexes.
Around a change the rest is made to fit again, most of the times, so that it is not refused for its
frame alone. Of datasets a value, a box or a record is changed, and hashes fit again. And bytes of
any file are changed with no regard for what they mean, or little.
"""

from __future__ import annotations

import bz2
import copy
import hashlib
import json
import random
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import lz4.frame
import yaml
import zstandard

import damage
from mp4ds import yamlio

Fields = list[tuple[bytes, bytes]]
Record = tuple[Any, bytes]
"""Of a bag: fields of the header, and data; of an MCAP file: opcode, and body."""
Document = dict[str, Any]

LENGTHS = (0, 1, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
LENGTHS += (2**32 * 10**9 - 1, 2**32 * 10**9)  # and times


def odd_number(old: int, size: int, rng: random.Random) -> bytes:
    """Another little-endian number of so many bytes."""
    near = (old + 1, old - 1, old * 2, old // 2)
    return (rng.choice((*near, *near, *LENGTHS)) % 256**size).to_bytes(size, "little")


def shuffled(items: list[Any], rng: random.Random) -> list[Any]:
    """A list with an item gone, twice, or two exchanged."""
    if not items:
        return items
    items, at, other = [*items], rng.randrange(len(items)), rng.randrange(len(items))
    kind = rng.randrange(4)
    if kind == 0:
        del items[at]
    elif kind == 1:
        items.insert(other, items[at])
    elif kind == 2:
        items[at], items[other] = items[other], items[at]
    else:
        items = items[:at]
    return items


def odd_payload(data: bytes, rng: random.Random) -> bytes:
    """A message with another length, or another number among its first fields."""
    kind = rng.randrange(6)
    if kind == 0:
        return data[: rng.randrange(len(data) + 1)]
    if kind == 1:
        return data + rng.randbytes(rng.choice((1, 3, 4, 8)))
    if kind == 2 or len(data) < 4:
        return b""
    place = min(rng.randrange(0, 80, 1 if kind == 3 else 4), len(data) - 4)
    return with_odd_number(data, place, 4, rng)


def with_odd_number(data: bytes, place: int, size: int, rng: random.Random) -> bytes:
    """Data with another little-endian number at a place."""
    old = int.from_bytes(data[place : place + size], "little")
    return _put(data, place, odd_number(old, size, rng))


def odd_text(text: bytes, rng: random.Random) -> bytes:
    """Another name or definition."""
    odd = (b"", b"\xff\xfe", b"a" * 300, text + b"2", text[:-1], b"/" + text, b"a=b", b"\0")
    lines = text.split(b"\n")
    if len(lines) > 1 and rng.random() < 0.7:
        words = (b"uint8[4000000] a", b"Header header", b"time t", b"foo/Bar b", b"MSG: a/b")
        lines[rng.randrange(len(lines))] = rng.choice((*words, b"=" * 80))
        return b"\n".join(lines)
    return rng.choice(odd)


# ---------------------------------------------------------------- ROS 1 bag


def _split_fields(raw: bytes) -> Fields:
    fields, at = [], 0
    while at < len(raw):
        (size,) = struct.unpack_from("<I", raw, at)
        name, _, value = raw[at + 4 : at + 4 + size].partition(b"=")
        fields.append((name, value))
        at += 4 + size
    return fields


def _join_fields(fields: Fields) -> bytes:
    raw = b"".join(struct.pack("<I", len(n) + 1 + len(v)) + n + b"=" + v for n, v in fields)
    return struct.pack("<I", len(raw)) + raw


def _split_bag(data: bytes, at: int) -> Iterator[tuple[int, Fields, bytes]]:
    while at < len(data):
        (head,) = struct.unpack_from("<I", data, at)
        (size,) = struct.unpack_from("<I", data, at + 4 + head)
        body = at + 8 + head
        yield at, _split_fields(data[at + 4 : at + 4 + head]), data[body : body + size]
        at = body + size


def _bag_record(fields: Fields, body: bytes) -> bytes:
    return _join_fields(fields) + struct.pack("<I", len(body)) + body


def _put_field(fields: Fields, name: bytes, value: bytes) -> Fields:
    return [(key, value if key == name else old) for key, old in fields]


_UNPACK = {b"none": bytes, b"bz2": bz2.decompress, b"lz4": lz4.frame.decompress}
_PACK = {b"none": bytes, b"bz2": bz2.compress, b"lz4": lz4.frame.compress}


def changed_bag(data: bytes, rng: random.Random) -> bytes:
    """A good bag with what its chunks or connections hold changed, and an index that fits."""
    records = [(fields, body) for _, fields, body in _split_bag(data, 13)]
    chunks, connections = [], []
    for fields, body in records:
        known = dict(fields)
        if known[b"op"] == b"\5":
            inner = _UNPACK[known[b"compression"]](body)
            chunks.append((known[b"compression"], [(f, b) for _, f, b in _split_bag(inner, 0)]))
        elif known[b"op"] == b"\7":
            connections.append((fields, body))
    kind = rng.randrange(6)
    number = rng.randrange(len(chunks))
    compression, inside = chunks[number]
    if kind == 0:
        chunks = shuffled(chunks, rng)
    elif kind == 1:
        chunks[number] = compression, shuffled(inside, rng)
    elif kind == 2:
        connections = shuffled(connections, rng)
    elif kind == 3:
        chunks[number] = rng.choice([*_PACK, b"zstd"]), inside
    elif kind == 4:
        at = rng.randrange(len(connections))
        connections[at] = _changed_connection(*connections[at], rng)
        if rng.random() < 0.7:  # the same in the chunks
            (key,) = (value for name, value in connections[at][0] if name == b"conn")
            chunks = [
                (c, [connections[at] if _is_connection(f, key) else (f, b) for f, b in found])
                for c, found in chunks
            ]
    else:
        at = rng.randrange(len(inside))
        inside[at] = _changed_message(*inside[at], rng)
    return build_bag(chunks, connections)


def _is_connection(fields: Fields, key: bytes) -> bool:
    known = dict(fields)
    return known[b"op"] == b"\7" and known.get(b"conn") == key


def _changed_connection(fields: Fields, body: bytes, rng: random.Random) -> tuple[Fields, bytes]:
    header = _split_fields(body)
    if rng.random() < 0.3:
        return _put_field(fields, b"topic", odd_text(dict(fields)[b"topic"], rng)), body
    if rng.random() < 0.3:
        return fields, _join_fields(shuffled(header, rng))[4:]
    name, value = rng.choice(header)
    return fields, _join_fields(_put_field(header, name, odd_text(value, rng)))[4:]


def _changed_message(fields: Fields, body: bytes, rng: random.Random) -> tuple[Fields, bytes]:
    if dict(fields)[b"op"] == b"\7":
        return _changed_connection(fields, body, rng)
    kind = rng.randrange(4)
    if kind == 0:
        seconds = rng.choice((0, 1, 2**31, 2**32 - 1))
        time = struct.pack("<II", seconds, rng.choice((0, 10**9 - 1, 10**9, 2**32 - 1)))
        return _put_field(fields, b"time", time), body
    if kind == 1:
        return _put_field(fields, b"conn", struct.pack("<I", rng.randrange(10))), body
    return fields, odd_payload(body, rng)


def build_bag(chunks: list[tuple[bytes, list[Record]]], connections: list[Record]) -> bytes:
    """A bag of these chunks, each with its compression, and an index that fits."""
    at, pieces, infos = 4096 + 13, [], []
    for compression, inside in chunks:
        entries: dict[bytes, list[bytes]] = {}
        place, content = 0, []
        for fields, body in inside:
            known, raw = dict(fields), _bag_record(fields, body)
            if known.get(b"op") == b"\2" and b"conn" in known and b"time" in known:
                entry = known[b"time"] + struct.pack("<I", place)
                entries.setdefault(known[b"conn"], []).append(entry)
            content.append(raw)
            place += len(raw)
        packed = _PACK.get(compression, bytes)(b"".join(content))
        head = [(b"op", b"\5"), (b"compression", compression), (b"size", struct.pack("<I", place))]
        made = _bag_record(head, packed)
        for key, found in entries.items():
            count = struct.pack("<I", len(found))
            head = [(b"op", b"\4"), (b"ver", b"\1\0\0\0"), (b"conn", key), (b"count", count)]
            made += _bag_record(head, b"".join(found))
        times = sorted(entry[:8] for found in entries.values() for entry in found) or [bytes(8)]
        head = [(b"op", b"\6"), (b"ver", b"\1\0\0\0"), (b"chunk_pos", struct.pack("<Q", at))]
        head += [(b"start_time", times[0]), (b"end_time", times[-1])]
        counts = [key + struct.pack("<I", len(found)) for key, found in entries.items()]
        head.append((b"count", struct.pack("<I", len(counts))))
        infos.append(_bag_record(head, b"".join(counts)))
        pieces.append(made)
        at += len(made)
    index = b"".join(_bag_record(*item) for item in connections) + b"".join(infos)
    head = [(b"op", b"\3"), (b"index_pos", struct.pack("<Q", at))]
    head += [(b"conn_count", struct.pack("<I", len(connections)))]
    head += [(b"chunk_count", struct.pack("<I", len(infos)))]
    raw = _join_fields(head)
    padding = b" " * (4096 - len(raw) - 4)
    start = b"#ROSBAG V2.0\n" + raw + struct.pack("<I", len(padding)) + padding
    return start + b"".join(pieces) + index


def changed_bag_records(data: bytes, rng: random.Random) -> bytes:
    """A bag with one of its records gone, twice, elsewhere, or with another field."""
    records = [[at, fields, body] for at, fields, body in _split_bag(data, 13)]
    if rng.random() < 0.4:
        records[1:] = shuffled(records[1:], rng)
    else:
        one = rng.randrange(len(records))
        at, fields, body = records[one]
        place = rng.randrange(len(fields) + 1)
        if place == len(fields):
            body = shuffled_words(body, rng)
        elif rng.random() < 0.2:
            fields = shuffled(fields, rng)
        else:
            name, value = fields[place]
            new = odd_number(int.from_bytes(value, "little"), len(value), rng)
            fields = _put_field(
                fields, name, new if len(value) in (1, 4, 8) else odd_text(value, rng)
            )
        records[one] = [at, fields, body]
    return _refit_bag(records, rng)


def _refit_bag(records: list[Any], rng: random.Random) -> bytes:
    """Join records, so that places and counts fit those that are there, most of the times."""
    starts: dict[bytes, bytes] = {}
    place = 13
    for at, fields, body in records:
        starts.setdefault(struct.pack("<Q", at), struct.pack("<Q", place))
        place += len(_bag_record(fields, body))
    kinds = Counter(dict(fields).get(b"op") for _, fields, _ in records)
    counted = {
        b"conn_count": struct.pack("<I", kinds[b"\7"]),
        b"chunk_count": struct.pack("<I", kinds[b"\6"]),
    }
    refit, recount = rng.random() < 0.7, rng.random() < 0.5
    out = b"#ROSBAG V2.0\n"
    for _, fields, body in records:
        known = [
            (name, starts.get(value, value) if refit and name.endswith(b"_pos") else value)
            for name, value in fields
        ]
        if recount:
            known = [(name, counted.get(name, value)) for name, value in known]
        out += _bag_record(known, body)
    return out


def shuffled_words(data: bytes, rng: random.Random) -> bytes:
    """Data with a number of 4 or 8 bytes changed, or with some more or fewer."""
    size = rng.choice((4, 8))
    if len(data) < size or rng.random() < 0.2:
        return data[:-size] if rng.random() < 0.5 else data + bytes(size)
    return with_odd_number(data, rng.randrange(len(data) // size) * size, size, rng)


# ---------------------------------------------------------------- sqlite3

_STATEMENTS: tuple[str, ...] = (
    *("UPDATE messages SET {column} = {value} WHERE id = {id}",) * 6,
    *("UPDATE topics SET {text} = {value} WHERE id = {topic}",) * 3,
    *("DELETE FROM messages WHERE id = {id}", "DELETE FROM topics WHERE id = {topic}"),
    "DELETE FROM {table}",
    "INSERT INTO messages SELECT id + 1000, topic_id, timestamp, data FROM messages",
    "INSERT INTO topics SELECT id + 100, name, type, serialization_format, '' FROM topics",
    *("DROP TABLE {table}", "DROP INDEX timestamp_idx"),
    "ALTER TABLE messages ADD COLUMN {odd}",
    "ALTER TABLE topics ADD COLUMN {odd} DEFAULT {value}",
    "UPDATE metadata SET metadata = {value}",
    "UPDATE schema SET schema_version = {value}",
    "UPDATE message_definitions SET {definition} = {value}",
    "CREATE TABLE other (a); INSERT INTO other VALUES ({value})",
)
_SQL_VALUES = (
    *("NULL", "0", "1", "-1", "1.5", "1e300", "9223372036854775807", "-9223372036854775808"),
    *("''", "'a'", "x''", "x'00'", "x'fffe'", "x'000100000000'", "char(0)", "'ros2idl'"),
    *("timestamp", "data", "zeroblob(70000)"),
)


def changed_sqlite(path: Path, rng: random.Random) -> None:
    """Change the tables of a database."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.executescript("PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF")
        for _ in range(rng.choice((1, 1, 2, 3))):
            tables = ("messages", "topics", "schema", "metadata", "message_definitions")
            statement = rng.choice(_STATEMENTS).format(
                column=rng.choice(("id", "topic_id", "timestamp", "timestamp", "data", "data")),
                text=rng.choice(("id", "name", "type", "serialization_format")),
                definition=rng.choice(("topic_type", "encoding", "encoded_message_definition")),
                value=rng.choice(_SQL_VALUES),
                id=rng.randrange(1, 17),
                topic=rng.randrange(1, 8),
                table=rng.choice(tables),
                odd=rng.choice(("more", '"a b"', '"db3:x"', "offered_qos")),
            )
            with suppress(sqlite3.Error):
                connection.executescript(statement)


def changed_metadata(data: bytes, rng: random.Random) -> bytes:
    """A metadata.yaml with another value somewhere, gone or twice."""
    document = yaml.load(data, yaml.CSafeLoader)
    change_value(document, rng)
    return json.dumps(document).encode()


# ---------------------------------------------------------------- MCAP

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = (
    range(9, 16)
)

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


def split_mcap(data: bytes, at: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    """Place, opcode and body of each record."""
    while at + 9 <= end:
        opcode, size = struct.unpack_from("<BQ", data, at)
        yield at, opcode, data[at + 9 : at + 9 + size]
        at += 9 + size


def _mcap_record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _unpacked(body: bytes) -> list[Record]:
    """The records of a chunk."""
    size, _, length = struct.unpack_from("<QII", body, 16)
    compression, data = body[32 : 32 + length], body[32 + length + 8 :]
    if compression == b"zstd":
        data = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    elif compression == b"lz4":
        data = lz4.frame.decompress(data)
    return [(opcode, part) for _, opcode, part in split_mcap(data, 0, len(data))]


def changed_mcap(data: bytes, rng: random.Random) -> bytes:
    """A good file with what it holds changed, and an index that fits, or none."""
    chunks: list[list[Record]] = []
    others: list[Record] = []
    for _, opcode, body in split_mcap(data, len(MAGIC), len(data) - len(MAGIC)):
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
    return build_mcap(header, chunks, others, **options)  # type: ignore[arg-type]


def _changed_record(opcode: int, body: bytes, rng: random.Random) -> Record:
    if opcode == MESSAGE and rng.random() < 0.5:
        return opcode, body[:22] + odd_payload(body[22:], rng)
    if opcode == MESSAGE or rng.random() < 0.4:
        return opcode, _odd_field(opcode, body, rng)
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


def build_mcap(
    header: bytes,
    chunks: list[list[Record]],
    others: list[Record],
    *,
    compression: bytes = b"",
    indexed: bool = True,
    counted: bool = True,
    chunked: bool = True,
) -> bytes:
    """A file of these records: chunks, or what is in them; an unknown compression is only told."""
    out = MAGIC + _mcap_record(HEADER, header) + b"".join(_mcap_record(*item) for item in others)
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
            content += _mcap_record(opcode, body)
        if not chunked:
            out += content
            continue
        span = [log for found in entries.values() for log, _ in found] or [0]
        pack = {b"zstd": zstandard.compress, b"lz4": lz4.frame.compress}.get(compression, bytes)
        packed = pack(content)
        head = struct.pack("<QQQII", min(span), max(span), len(content), 0, len(compression))
        body = head + compression + struct.pack("<Q", len(packed)) + packed
        start = len(out)
        out += _mcap_record(CHUNK, body)
        length, offsets = len(out) - start, b""
        for channel, found in entries.items() if indexed else ():
            offsets += struct.pack("<HQ", channel, len(out))
            pairs = b"".join(struct.pack("<QQ", *pair) for pair in found)
            out += _mcap_record(MESSAGE_INDEX, struct.pack("<HI", channel, len(pairs)) + pairs)
        listed.append(
            struct.pack("<QQQQI", min(span), max(span), start, length, len(offsets))
            + offsets
            + struct.pack("<QI", len(out) - start - length, len(compression))
            + compression
            + struct.pack("<QQ", len(packed), len(content))
        )
    out += _mcap_record(DATA_END, bytes(4))
    summary = b"".join(_mcap_record(opcode, body) for (opcode, _), body in sorted(known.items()))
    if counted:
        kinds = Counter(opcode for opcode, _ in [*others, *known])
        head = struct.pack("<QHI", sum(counts.values()), kinds[SCHEMA], kinds[CHANNEL])
        head += struct.pack("<III", kinds[ATTACHMENT], kinds[METADATA], len(listed))
        head += struct.pack("<QQI", min(times or [0]), max(times or [0]), 10 * len(counts))
        summary += _mcap_record(
            STATISTICS, head + b"".join(struct.pack("<HQ", *pair) for pair in counts.items())
        )
    if indexed:
        summary += b"".join(_mcap_record(CHUNK_INDEX, body) for body in listed)
    footer = struct.pack("<QQI", len(out) if summary else 0, 0, 0)
    return out + summary + _mcap_record(FOOTER, footer) + MAGIC


def changed_mcap_records(data: bytes, rng: random.Random) -> bytes:
    """A file with one of its records gone, twice, elsewhere, or with another number."""
    records = [*split_mcap(data, len(MAGIC), len(data) - len(MAGIC))]
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
    return with_odd_number(body, *rng.choice(numbers), rng)


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
        out += _mcap_record(opcode, body)
    return out + MAGIC


# ---------------------------------------------------------------- datasets

MANIFEST = "dataset.yaml"
MESSAGES = "messages.mcap"

_ODD: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 255, 2**31, 2**32 - 1, 2**32, 2**63 - 1, -(2**63), 2**64, 1e300),
    *("", "0", "a", "\0", "../x", "x" * 3000, "\U0001f600", [], {}, [1], {"a": 1}, 0.5, "1 2"),
)
_WORDS = ("lossless", "visual", "crf=1", "ros1", "ros2", "cdr-le", "cdr-be", "gray", "h264", "ffv1")
_WORDS += ("bag", "mcap", "rosbag2", "mono8", "rgb8", "16UC1", "xxh64", "jpeg", "packet", "pixels")
_WORDS += (
    "sqlite3",
    "message",
    "file",
    "zstd",
    "0",
    "-1",
    "0*1",
    "1*0",
    f"{2**63 - 1}*1",
    "*",
    "-",
)
_CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"dinf")


def read_dataset(folder: Path) -> tuple[dict[str, bytes], dict[str, Document]]:
    """The content of its files by name, and its YAML files, parsed."""
    files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    yamls = ((name, data) for name, data in files.items() if name.endswith("yaml"))
    return files, {name: yamlio.load(data, name) for name, data in yamls}


def changed_dataset(
    files: dict[str, bytes], documents: dict[str, Document], kind: str, rng: random.Random
) -> dict[str, bytes]:
    """The files of a dataset of which one is changed.

    Args:
        files: Content of the files of the dataset.
        documents: What is in its YAML files.
        kind: ``manifest``, ``sidecar``, ``columns``, ``video`` or ``messages``.
        rng: Says how.
    """
    files, documents = dict(files), copy.deepcopy(documents)
    sidecars = [name for name in documents if name != MANIFEST]
    name = rng.choice(sidecars)
    document = documents[name]
    if kind == "manifest":
        document, name = documents[MANIFEST], MANIFEST
        change_value(document, rng)
    elif kind == "sidecar":
        for _ in range(rng.choice((1, 1, 2))):
            change_value(document, rng)
    elif kind == "columns":
        places = [part["columns"] for part in (document, document.get("camera_info")) if part]
        change_value(rng.choice([place for place in places if place]), rng)
    elif kind == "video":
        video = document["video"]["file"]
        files[video] = changed_boxes(files[video], rng)
    else:
        change = rng.choice((changed_mcap, changed_mcap_records))
        files[MESSAGES] = change(files[MESSAGES], rng)
    if kind != "manifest" and rng.random() < 0.3:  # so that no digest tells first
        document.pop("digests", None)
        document["profile"] = documents[MANIFEST]["profile"] = "crf=1"
    _agree(files, documents, rng)
    return files


def _agree(files: dict[str, bytes], documents: dict[str, Document], rng: random.Random) -> None:
    """Let all say of the files what they are now, most of the times."""
    exact = rng.random() < 0.9
    for name, document in documents.items():
        if name == MANIFEST:
            continue
        video = document.get("video")
        data = files.get(str(video.get("file"))) if isinstance(video, dict) else None
        if exact and data is not None:
            video |= {key: value for key, value in _facts(data).items() if key in video}
        files[name] = _dumped(document)
    entries = documents[MANIFEST].get("files")
    for entry in entries if exact and isinstance(entries, list) else ():
        if isinstance(entry, dict) and isinstance(entry.get("name"), str):
            entry |= _facts(files[entry["name"]]) if entry["name"] in files else {}
    files[MANIFEST] = _dumped(documents[MANIFEST])


def _facts(data: bytes) -> Document:
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _dumped(document: Document) -> bytes:
    # JSON is YAML, and many times as fast to write; the checksum may be left out
    return json.dumps(document, ensure_ascii=False).encode("utf-8", "surrogatepass") + b"\n"


def change_value(document: Document, rng: random.Random) -> None:
    """Give a value that is anywhere in a document to something else, or take it away."""
    where: Any = document
    while True:
        key = rng.choice([*where]) if isinstance(where, dict) else rng.randrange(len(where))
        value = where[key]
        if isinstance(value, (dict, list)) and value and rng.random() < 0.85:
            where = value
            continue
        break
    kind = rng.random()
    if kind < 0.15:
        del where[key]
    elif kind < 0.25 and isinstance(where, list):
        where.insert(key, copy.deepcopy(value))
    elif kind < 0.3 and isinstance(where, dict):
        where["more"] = value
    elif isinstance(value, bool) or value is None:
        where[key] = rng.choice((True, False, None, 1))
    elif isinstance(value, int) and kind < 0.8:
        where[key] = rng.choice((value + 1, value - 1, value * 2, -value, *LENGTHS))
    elif isinstance(value, str) and kind < 0.8:
        odd = (value + "2", value[:-1], value.upper(), value * 2, value[::-1], *_WORDS)
        where[key] = rng.choice(odd)
    else:
        where[key] = rng.choice(_ODD)


# ---------------------------------------------------------------- mp4

Box = tuple[bytes, Any]
"""Type, and the body, of a container a list of boxes."""


def _boxes(data: bytes) -> list[Box]:
    found, at = [], 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        size = size if size >= 8 else len(data) - at
        body = data[at + 8 : at + size]
        found.append((kind, _boxes(body) if kind in _CONTAINERS else body))
        at += size
    return found


def _joined_boxes(boxes: list[Box]) -> bytes:
    out = b""
    for kind, body in boxes:
        data = _joined_boxes(body) if isinstance(body, list) else body
        out += struct.pack(">I4s", len(data) + 8, kind) + data
    return out


def changed_boxes(data: bytes, rng: random.Random) -> bytes:
    """A video with a box gone, twice, elsewhere, of another type or size, or a number changed."""
    boxes = _boxes(data)
    inside = boxes
    while rng.random() < 0.85:
        deeper = [body for _, body in inside if isinstance(body, list)]
        if not deeper:
            break
        inside = rng.choice(deeper)
    at = rng.randrange(len(inside))
    kind, body = inside[at]
    choice = rng.random()
    if choice < 0.1:
        del inside[at]
    elif choice < 0.2:
        inside.insert(rng.randrange(len(inside)), inside[at])
    elif choice < 0.25:
        inside[at] = rng.choice((b"free", b"moov", b"stbl", b"co64", b"abcd")), body
    elif isinstance(body, bytes) and len(body) >= 4:
        size = rng.choice((1, 2, 4, 4, 4))
        place = rng.randrange(len(body) // size) * size
        old = int.from_bytes(body[place : place + size], "big")
        inside[at] = kind, body[:place] + odd_number(old, size, rng)[::-1] + body[place + size :]
    made = _joined_boxes(boxes)
    if choice > 0.95:  # a size that is not what it encloses
        place = max(made.find(kind, rng.randrange(len(made))) - 4, 0)
        made = made[:place] + odd_number(len(body), 4, rng)[::-1] + made[place + 4 :]
    return made


# ---------------------------------------------------------------- bytes of any file


def damaged(data: bytes, rng: random.Random) -> bytes:
    """One to four injuries."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(INJURIES)(data, rng) or b"\0"
    return data


def _injured(data: bytes, rng: random.Random) -> bytes:
    """Bytes are changed, gone, or come in between."""
    injure = rng.choice([*damage.INJURIES.values()])
    return injure(data, rng)[0] if len(data) > 32 else data[1:]


def _length(data: bytes, rng: random.Random) -> bytes:
    """A number of 2, 4 or 8 bytes that may be a length gets another value."""
    form = rng.choice(("<H", "<I", "<Q", ">H", ">I", ">Q"))
    size = struct.calcsize(form)
    if len(data) < size:
        return data
    likely = [rng.randrange(len(data) - size + 1) for _ in range(16)]
    place = min(likely, key=lambda at: struct.unpack_from(form, data, at)[0] or 2**64)
    old = struct.unpack_from(form, data, place)[0]
    new = rng.choice((*LENGTHS, old + 1, old - 1, old * 2, len(data), len(data) - place))
    return _put(data, place, struct.pack(form, new % 2 ** (8 * size)))


def _token(data: bytes, rng: random.Random) -> bytes:
    """A value of a text gets another one; of other files, a word."""
    lines = data.split(b"\n")
    number = rng.randrange(len(lines))
    key, colon, _ = lines[number].partition(b":")
    if not colon or len(key) > 60:
        return _injured(data, rng)
    values = (
        *(b"-1", b"9999999999999999999999", b"null", b"[]", b"{}", b"true", b'""', b"1e999"),
        *(b"../../etc/passwd", b"'" + b"x" * 5000 + b"'", b"&a [*a]", b"!!python/none x", b"."),
    )
    comma = b"," if lines[number].rstrip().endswith(b",") else b""
    lines[number] = key + b": " + rng.choice(values) + comma
    return b"\n".join(lines)


INJURIES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    *((_injured,) * 6),
    *(_length, _length, _length, _token, _token),
)


def _put(data: bytes, place: int, new: bytes) -> bytes:
    return data[:place] + new + data[place + len(new) :]
