"""Parts of a recording: spans and topics add up to the whole, and nothing else is read."""

from __future__ import annotations

import sqlite3
import struct
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer
from rosbags.rosbag1 import Reader as BagReader

from mp4ds.bags import protocols
from mp4ds.bags.formats import open_reader, open_sources
from mp4ds.bags.mcap import McapReader
from mp4ds.errors import SourceError
from mp4ds.records import Excerpt, Message, Record
from sources import PERIOD, SOURCES, START, Scene, scene, write_bag, write_mcap, write_rosbag2

NOT_INDEXED = {
    "rosbag2-sqlite3-zstd-file",
    "rosbag2-mcap-zstd-file",
    "mcap-unchunked",
    "mcap-unindexed",
}
NO_MESSAGES = Excerpt(topics=frozenset())

Row = tuple[int, int, int, bytes]


def row(message: Message) -> Row:
    return (message.log_time, message.publish_time, message.sequence, bytes(message.data))


def rows(records: Iterable[Record]) -> list[tuple[object, Row]]:
    """Channel and content of each message."""
    return [(r.channel.identity, row(r)) for r in records if isinstance(r, Message)]


def by_channel(records: Iterable[Record]) -> dict[int, list[Row]]:
    found: dict[int, list[Row]] = defaultdict(list)
    for record in records:
        if isinstance(record, Message):
            found[record.channel.id].append(row(record))
    return dict(found)


def others(records: Iterable[Record]) -> list[Record]:
    return [record for record in records if not isinstance(record, Message)]


def consecutive(edges: Sequence[int], **more: Any) -> list[Excerpt]:
    ends = [None, *edges, None]
    return [Excerpt(start, end, **more) for start, end in pairwise(ends)]


def read_all(reader: Any, excerpts: Iterable[Excerpt]) -> list[Record]:
    return [record for excerpt in excerpts for record in reader.records(excerpt)]


def random_edges(times: Sequence[int], rng: np.random.Generator, count: int) -> list[int]:
    """Times of messages, times beside them, and some that occur twice."""
    picked = rng.choice(np.array(times, np.uint64), count).tolist()
    steps = rng.integers(-1, 2, count).tolist()
    return sorted(time + step for time, step in zip(picked, steps, strict=True))


def check(reader: Any, seed: int = 0, *, ordered: bool | None = None) -> list[Record]:
    """That spans, topics and both together give what one pass gives; returns that."""
    whole = list(reader.records())
    expected, all_others = by_channel(whole), sorted(others(whole), key=repr)
    times = [record.log_time for record in whole if isinstance(record, Message)] or [0]
    rng = np.random.default_rng(seed)
    spans = consecutive(random_edges(times, rng, 6), others=False)
    topics = partition(sorted({channel.topic for channel in reader.channels}), rng)
    both = [
        Excerpt(span.start, span.end, part.topics, part.without, others=False)
        for part in topics
        for span in spans
    ]
    narrow = Excerpt(spans[2].start, spans[2].end)
    asked = (*spans, *topics, *both, narrow)
    pieces = {excerpt: list(reader.records(excerpt)) for excerpt in asked}
    for excerpt, piece in pieces.items():
        assert sorted(others(piece), key=repr) == (all_others if excerpt.others else [])
        assert by_channel(piece) == by_channel(filter(excerpt.has, whole))
    joined = {n: [r for e in part for r in pieces[e]] for n, part in enumerate((spans, both))}
    if reader.is_indexed if ordered is None else ordered:
        assert by_channel(joined[0]) == by_channel(joined[1]) == expected
        assert rows(joined[0]) == rows(whole)
    assert by_channel(chain.from_iterable(pieces[part] for part in topics)) == expected
    assert sorted(reader.records(NO_MESSAGES), key=repr) == all_others
    assert rows(reader.records()) == rows(whole)
    return whole


def partition(topics: Sequence[str], rng: np.random.Generator) -> list[Excerpt]:
    """Each topic in one of three, the last of which takes what the others do not."""
    groups: list[set[str]] = [set(), set(), set()]
    for topic in topics:
        groups[int(rng.integers(0, 3))].add(topic)
    named = frozenset(groups[0] | groups[1])
    return [
        Excerpt(topics=frozenset(groups[0])),
        Excerpt(topics=named, without=frozenset(groups[0])),
        Excerpt(without=named),
    ]


# ---------------------------------------------------------------- all kinds of sources


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("seed", [0, 1])
def test_parts_of_every_source(name: str, seed: int, tmp_path: Path) -> None:
    paths = SOURCES[name](tmp_path, scene("mono8", frames=24))
    with open_sources(paths) as reader:
        assert reader.is_indexed == (name not in NOT_INDEXED)
        whole = check(reader, seed)
        assert len(rows(whole)) == 24 * 8
    # every task opens the recording by itself
    apart = []
    for span in consecutive(random_edges([START + PERIOD * 24], np.random.default_rng(0), 1)):
        with open_sources(paths) as reader:
            apart += list(reader.records(span))
    assert sorted(rows(apart), key=repr) == sorted(rows(whole), key=repr)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", SOURCES)
def test_spans_without_messages(name: str, tmp_path: Path) -> None:
    paths = SOURCES[name](tmp_path, scene("mono8", frames=4))
    with open_sources(paths) as reader:
        whole = list(reader.records())
        times = [record.log_time for record in whole if isinstance(record, Message)]
        first, last = min(times), max(times)
        for start, end in (
            (None, first),
            (last + 1, None),
            (first, first),
            (last, first),
            (-(2**70), -1),
            (None, -(2**70)),
            (2**70, 2**71),
            (2**64, None),
            (first + 1, first + 2),
        ):
            assert list(reader.records(Excerpt(start, end, others=False))) == []
            assert list(reader.records(Excerpt(start, end))) == others(whole)
        for start, end in ((first, last + 1), (-(2**70), 2**70), (0, None), (None, 2**64)):
            assert rows(reader.records(Excerpt(start, end))) == rows(whole)
        assert list(reader.records(Excerpt(topics=frozenset({"/none"}), others=False))) == []


# ---------------------------------------------------------------- what is not read


def damage_chunks(path: Path, keep: Callable[[Any], bool]) -> int:
    """Overwrite the contents of the chunks of an MCAP file that are not to be kept."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary
    data = bytearray(path.read_bytes())
    lost = [chunk for chunk in summary.chunk_indexes if not keep(chunk)]
    for chunk in lost:
        start = chunk.chunk_start_offset + 9
        data[start : chunk.chunk_start_offset + chunk.chunk_length] = b"\xff" * (
            chunk.chunk_length - 9
        )
    path.write_bytes(data)
    return len(lost)


def damage_bag(path: Path, keep: Callable[[Any], bool]) -> int:
    """Overwrite the contents of the chunks of a bag that are not to be kept."""
    with BagReader(path) as reader:
        lost = [reader.chunks[info.pos] for info in reader.chunk_infos if not keep(info)]
    data = bytearray(path.read_bytes())
    for chunk in lost:
        data[chunk.datapos : chunk.datapos + chunk.datasize] = b"\xff" * chunk.datasize
    path.write_bytes(data)
    return len(lost)


CHUNKED = [
    "bag-none", "bag-bz2", "bag-lz4", "bag-split", "mcap-ros1-zstd", "mcap-ros2-none",
    "mcap-ros2-lz4", "mcap-ros2-zstd", "rosbag2-mcap-v5", "rosbag2-mcap-split",
    "rosbag2-mcap-zstd-message",
]  # fmt: skip


@pytest.mark.parametrize("name", CHUNKED)
def test_chunks_outside_of_a_span_are_not_read(name: str, tmp_path: Path) -> None:
    span = Excerpt(START + 20 * PERIOD, START + 26 * PERIOD)
    paths = SOURCES[name](tmp_path, scene("mono8", frames=60))
    with open_sources(paths) as reader:
        expected = list(reader.records(span))
        assert 40 < len(rows(expected)) < 60
        topics = by_channel(reader.records())
    lost = 0
    for path in sorted(tmp_path.rglob("*.*")):
        if path.suffix == ".bag":
            lost += damage_bag(path, lambda c: span.touches(c.start_time, c.end_time - 1))
        elif path.suffix == ".mcap":
            lost += damage_chunks(
                path, lambda c: span.touches(c.message_start_time, c.message_end_time)
            )
    assert lost > 1
    with open_sources(paths) as reader:
        assert rows(reader.records(span)) == rows(expected)
        assert others(reader.records(span)) == others(expected)
        assert sum(s.count for s in reader.stats().values()) == sum(map(len, topics.values()))
        with pytest.raises(SourceError, match="is damaged"):
            list(reader.records())


# ---------------------------------------------------------------- chunks that overlap


def write_channels(
    path: Path, messages: Iterable[tuple[str, int]], **options: Any
) -> list[tuple[str, int, int]]:
    """An MCAP file of small messages (topic, log time); returns them with their numbers."""
    written = []
    with path.open("wb") as stream:
        writer = Writer(stream, **{"chunk_size": 600, **options})
        writer.start()
        ids: dict[str, int] = {}
        for number, (topic, time) in enumerate(messages):
            if topic not in ids:
                ids[topic] = writer.register_channel(topic, "cdr", 0)
            writer.add_message(ids[topic], time, number.to_bytes(40, "little"), time, number)
            written.append((topic, time, number))
        writer.finish()  # type: ignore[no-untyped-call]
    return written


def numbers(records: Iterable[Record]) -> list[tuple[str, int, int]]:
    return [(r.channel.topic, r.log_time, r.sequence) for r in records if isinstance(r, Message)]


def shuffled() -> list[tuple[str, int]]:
    order = np.random.default_rng(3).permutation(300).tolist()
    return [("/ab"[: 1 + n % 2 + n % 3 % 2], time // 3) for n, time in enumerate(order)]


ARRANGED: dict[str, list[tuple[str, int]]] = {
    "topic after topic": [(topic, time // 2) for topic in "abc" for time in range(100)],
    "parts exchanged": [
        ("a", time) for start in (200, 0, 100) for time in range(start, start + 100)
    ],
    "all at once": [("ab"[time % 2], 7) for time in range(300)],
    "backwards": [("ab"[time % 2], 300 - time // 3) for time in range(300)],
    "shuffled": shuffled(),
    "up to the end of time": [("a", 2**64 - 300 + time) for time in range(300)],
    "from zero": [("ab"[time // 7 % 2], time) for time in range(300)],
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ARRANGED)
@pytest.mark.parametrize("hold", [None, 3900])
def test_chunks_in_any_order(
    name: str, hold: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    written = write_channels(path, ARRANGED[name])
    if hold:
        monkeypatch.setattr(protocols, "HOLD_BYTES", hold)
    with McapReader(path) as reader:
        # What fits in time order is in time order, in one pass, too.
        assert reader.is_indexed == (hold is None or name not in ("all at once", "shuffled"))
        for seed in range(2):
            whole = check(reader, seed)
        if reader.is_indexed:
            assert numbers(whole) == sorted(written, key=lambda item: item[1])
        assert sorted(numbers(whole)) == sorted(written)


@pytest.mark.parametrize("compression", ["none", "lz4", "bz2"])
def test_bag_chunks_in_any_order(compression: str, tmp_path: Path) -> None:
    messages = scene("mono8", frames=24).messages
    messages.sort(key=lambda message: (message.topic, message.log_time // (7 * PERIOD)))
    write_bag(tmp_path / "a.bag", Scene(messages), compression, chunk_size=2000)
    with open_reader(tmp_path / "a.bag") as reader:
        for seed in range(2):
            whole = check(reader, seed)
        times = [time for _, (time, *_) in rows(whole)]
        assert times == sorted(times)


# ---------------------------------------------------------------- an index that lies


def patched(path: Path, opcode: int, change: Callable[[bytearray, int], None]) -> None:
    """Change the records of one kind in the summary: their body, and their number."""
    data = bytearray(path.read_bytes())
    (place,) = struct.unpack_from("<Q", data, len(data) - 28)
    number = 0
    while data[place] != 2:
        (length,) = struct.unpack_from("<Q", data, place + 1)
        if data[place] == opcode:
            body = data[place + 9 : place + 9 + length]
            change(body, number)
            data[place + 9 : place + 9 + length] = body
            number += 1
        place += 9 + length
    assert number
    path.write_bytes(data)


def put(form: str, offset: int, value: int, only: int | None = 3) -> Callable[..., None]:
    def change(body: bytearray, number: int) -> None:
        if only in (None, number):
            struct.pack_into(form, body, offset, value)

    return change


def add(form: str, offset: int, value: int, only: int | None = 3) -> Callable[..., None]:
    def change(body: bytearray, number: int) -> None:
        if only in (None, number):
            (old,) = struct.unpack_from(form, body, offset)
            struct.pack_into(form, body, offset, old + value)

    return change


# Fields of a chunk index: start 0, end 8, offset 16, length 24, size of the map 32, map 36.
LIES: dict[str, tuple[int, Callable[..., None], bool]] = {
    "begins too late": (8, add("<Q", 0, 2), True),
    "is elsewhere in time": (8, lambda b, n: n == 3 and struct.pack_into("<QQ", b, 0, 0, 1), True),
    "ends before it begins": (8, put("<Q", 8, 0), False),
    "other channel": (8, lambda b, n: n == 3 and struct.pack_into("<H", b, 36, 99), True),
    "other chunk": (8, add("<Q", 16, 1), False),
    "chunk too short": (8, add("<Q", 24, -1), False),
    "far away": (8, put("<Q", 16, 2**63), False),
    "huge": (8, put("<Q", -8, 2**60), False),
    "small": (8, put("<Q", -8, 1), True),
    "chunk count": (11, add("<I", 22, 1, 0), False),
    "count of a channel": (11, add("<Q", -8, 1, 0), False),
    "another kind of record": (4, lambda b, n: None, True),
}


@pytest.mark.parametrize("name", LIES)
def test_an_index_that_lies_loses_nothing_in_silence(name: str, tmp_path: Path) -> None:
    """Either it is not used, or what is lost is told."""
    opcode, change, is_used = LIES[name]
    path = tmp_path / "a.mcap"
    written = write_channels(path, ARRANGED["from zero"])
    patched(path, opcode, change)
    with McapReader(path) as reader:
        assert reader.is_indexed == is_used
        assert sorted(numbers(reader.records())) == sorted(written)
        if not is_used:
            check(reader)
        elif name != "another kind of record":
            with pytest.raises(SourceError, match=r"is damaged in its record at byte \d+: it "):
                read_all(reader, consecutive([50, 100, 150, 200, 250], others=False))
            topics = [Excerpt(topics=frozenset({topic})) for topic in "ab"]
            with pytest.raises(SourceError, match=r"is damaged in its record at byte \d+: it "):
                read_all(reader, topics)


def test_a_chunk_that_tells_of_no_messages_is_looked_into(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    options = {"index_types": IndexType.ALL & ~IndexType.MESSAGE}
    written = write_channels(path, ARRANGED["from zero"], **options)
    with McapReader(path) as reader:
        assert reader.is_indexed
        for seed in range(2):
            assert numbers(check(reader, seed)) == written
    patched(path, 8, lambda body, number: struct.pack_into("<QQ", body, 0, 0, 0))
    with McapReader(path) as reader, pytest.raises(SourceError, match="of log time"):
        list(reader.records(Excerpt(30, 31)))


def with_record(path: Path, opcode: int, body: bytes, *, in_summary: bool) -> None:
    """Add a record to the end of the data, or to the summary."""
    data = path.read_bytes()
    (summary,) = struct.unpack_from("<Q", data, len(data) - 28)
    place = summary if in_summary else summary - 13  # before the end of the data
    added = struct.pack("<BQ", opcode, len(body)) + body
    start = summary if in_summary else summary + len(added)
    footer = data[-37:-28] + struct.pack("<QQI", start, 0, 0) + data[-8:]
    path.write_bytes(data[:place] + added + data[place:-37] + footer)


@pytest.mark.parametrize("in_summary", [True, False])
def test_messages_beside_the_chunks(in_summary: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written = write_channels(path, ARRANGED["from zero"])
    with_record(path, 5, struct.pack("<HIQQ", 1, 77, 30, 30), in_summary=in_summary)
    with McapReader(path) as reader:
        assert not reader.is_indexed
        assert sorted(numbers(check(reader))) == sorted([*written, ("a", 30, 77)])


# ---------------------------------------------------------------- databases


def changed_database(folder: Path, *statements: str) -> Path:
    write_rosbag2(folder / "a", scene("mono8", frames=24), "sqlite3")
    path = next((folder / "a").glob("*.db3"))
    with closing(sqlite3.connect(path)) as connection, connection:
        for statement in statements:
            connection.execute(statement)
    return path


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("statements", "indexed"),
    [
        ([], True),
        (["DROP INDEX timestamp_idx"], False),
        (["DROP INDEX timestamp_idx", "CREATE INDEX t ON messages(topic_id, timestamp)"], False),
        (["DROP INDEX timestamp_idx", "CREATE INDEX t ON messages(timestamp) WHERE id < 9"], False),
        (["DROP INDEX timestamp_idx", "CREATE INDEX t ON messages(timestamp, topic_id)"], True),
        (["UPDATE messages SET timestamp = 5"], True),
        (["UPDATE messages SET timestamp = 1000 - id"], True),
        (["DELETE FROM messages"], True),
    ],
)
def test_parts_of_databases(statements: list[str], indexed: bool, tmp_path: Path) -> None:
    path = changed_database(tmp_path, *statements)
    for where in (path, path.parent):
        with open_reader(where) as reader:
            assert reader.is_indexed == indexed
            for seed in range(2):
                check(reader, seed, ordered=True)


REBUILT = (
    "CREATE TABLE m(id INTEGER PRIMARY KEY, topic_id, timestamp, data)",
    "INSERT INTO m SELECT * FROM messages",
    "DROP TABLE messages",
    "ALTER TABLE m RENAME TO messages",
    "CREATE INDEX t ON messages(timestamp)",
)


@pytest.mark.parametrize("value", ["NULL", "'text'", "x'ff'", "-5", "1e300", "-1e300"])
def test_invalid_times_of_a_span_are_refused(value: str, tmp_path: Path) -> None:
    path = changed_database(
        tmp_path, *REBUILT, f"UPDATE messages SET timestamp = {value} WHERE id = 50"
    )
    with open_reader(path) as reader:
        assert reader.is_indexed
        spans = consecutive([START + 5 * PERIOD, START + 12 * PERIOD])
        with pytest.raises(
            SourceError, match=r"message of id 50, topic .*: .* is not a valid time"
        ):
            read_all(reader, spans)
        assert rows(reader.records(spans[1]))


def test_a_message_of_no_topic_is_refused_by_all_topics(tmp_path: Path) -> None:
    path = changed_database(tmp_path, "UPDATE messages SET topic_id = 77 WHERE id = 50")
    with open_reader(path) as reader:
        for channel in reader.channels:
            with pytest.raises(SourceError, match="has topic id 77"):
                list(reader.records(Excerpt(topics=frozenset({channel.topic}))))
        assert rows(reader.records(Excerpt(None, START))) == []


# ---------------------------------------------------------------- several recordings


def side_by_side(kind: str, folder: Path) -> list[Path]:
    """Three recordings: two of the same time and topics, one that follows and overlaps."""
    first, late = scene("mono8", frames=12), scene("mono8", frames=12, seed=1)
    moved = [replace(m, log_time=m.log_time + 9 * PERIOD) for m in late.messages]
    parts = [first, Scene(first.messages[::2], first.silent), Scene(moved)]
    paths = []
    for number, part in enumerate(parts):
        path = folder / f"part{number}{'' if kind.startswith('rosbag2') else '.' + kind}"
        if kind == "bag":
            write_bag(path, part)
        elif kind == "mcap":
            write_mcap(path, part)
        else:
            write_rosbag2(path, part, kind.partition("-")[2])
        paths.append(path)
    return paths


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", ["bag", "mcap", "rosbag2-sqlite3", "rosbag2-mcap"])
def test_recordings_side_by_side(kind: str, tmp_path: Path) -> None:
    paths = side_by_side(kind, tmp_path)
    for order in (paths, paths[::-1]):
        with open_sources(order) as reader:
            assert reader.is_indexed
            for seed in range(2):
                whole = check(reader, seed)
            found = [time for _, (time, *_) in rows(whole)]
            assert found == sorted(found)
            assert len(found) == sum(item.count for item in reader.stats().values()) == 240
            if kind == "mcap":
                assert len(others(whole)) == 12
