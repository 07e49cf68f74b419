"""Recordings taken apart into their records, changed, and put together again.

What is changed is what a reader trusts: lengths, counts, offsets, opcodes, times, definitions,
compression, indexes. Around a change the rest is made to fit again, most of the times, so that it
is not refused for its frame alone.
"""

from __future__ import annotations

import bz2
import json
import random
import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import lz4.frame
import yaml
import zstandard

Fields = list[tuple[bytes, bytes]]
Record = tuple[Any, bytes]
"""Of a bag: fields of the header, and data; of an MCAP file: opcode, and body."""

LENGTHS = (0, 1, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
TIMES = (0, 1, 2**32 * 10**9 - 1, 2**32 * 10**9, 2**63 - 1, 2**63, 2**64 - 1)


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
    old = int.from_bytes(data[place : place + 4], "little")
    return data[:place] + odd_number(old, 4, rng) + data[place + 4 :]


def odd_text(text: bytes, rng: random.Random) -> bytes:
    """Another name or definition."""
    odd = (b"", b"\xff\xfe", b"a" * 300, text + b"2", text[:-1], b"/" + text, b"a=b", b"\0")
    lines = text.split(b"\n")
    if len(lines) > 1 and rng.random() < 0.7:
        words = (
            b"uint8[4000000] a",
            b"Header header",
            b"time t",
            b"foo/Bar b",
            b"=" * 80,
            b"MSG: a/b",
        )
        lines[rng.randrange(len(lines))] = rng.choice(words)
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
    place = rng.randrange(len(data) // size) * size
    old = int.from_bytes(data[place : place + size], "little")
    return data[:place] + odd_number(old, size, rng) + data[place + size :]


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
    where: Any = document
    while True:
        key = rng.choice([*where]) if isinstance(where, dict) else rng.randrange(len(where))
        value = where[key]
        if not isinstance(value, (dict, list)) or not value or rng.random() < 0.1:
            break
        where = value
    odd = (None, 0, 1, -1, 2**63, 1.5, "", "x", "../x", [], {}, [1], {"a": 1}, True, "zstd", "file")
    if rng.random() < 0.2:
        del where[key]
    elif rng.random() < 0.2 and isinstance(where, list):
        where.append(value)
    elif isinstance(value, int) and rng.random() < 0.5:
        where[key] = rng.choice((value + 1, value - 1, *LENGTHS, *range(10)))
    else:
        where[key] = rng.choice((*odd, "message", "mcap", "sqlite3", f"{value}2"))
    return json.dumps(document).encode()


def unpacked_of_zstd(data: bytes) -> bytes:
    """The content of a file that rosbag2 compressed."""
    return zstandard.ZstdDecompressor().decompressobj().decompress(data)


def packed_with_zstd(data: bytes) -> bytes:
    """As rosbag2 compresses files."""
    return zstandard.ZstdCompressor(level=1).compress(data)
