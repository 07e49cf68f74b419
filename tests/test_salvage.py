"""Damaged recordings: what is there comes back, what is lost is told, and nothing else happens."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import zstandard

from commands import program
from conftest import DATA, real
from damage import INJURIES, Key, Piece, all_messages, pieces_of, sound_messages
from mp4ds import SourceError
from mp4ds.bags.formats import open_sources
from mp4ds.records import (
    EVERYTHING,
    MAX_LOSSES,
    Channel,
    Excerpt,
    Loss,
    Message,
    Record,
)
from sources import SOURCES, scene, write_bag, write_mcap, write_rosbag2, write_split_bags

PLACES = 8
Salvaged = tuple[list[Record], Sequence[Loss]]


def salvaged(*paths: Path, excerpt: Excerpt = EVERYTHING) -> Salvaged:
    """All records that can be read, and what is lost."""
    with open_sources(list(paths), salvage=True) as reader:
        records = list(reader.records(excerpt))
        assert not reader.is_indexed
        return records, reader.losses


def keys(records: Sequence[Record]) -> Counter[Key]:
    return Counter(
        (record.channel.topic, record.log_time, bytes(record.data))
        for record in records
        if isinstance(record, Message)
    )


def usual(*paths: Path) -> list[Record]:
    with open_sources(list(paths)) as reader:
        return list(reader.records())


def plain(record: Record) -> Any:
    """A record without the id of its channel, which has no meaning."""
    if isinstance(record, Message):
        times = record.log_time, record.publish_time, record.sequence
        return (record.channel.identity, *times, bytes(record.data))
    return asdict(record)


# ---------------------------------------------------------------- intact recordings


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", SOURCES)
def test_an_intact_recording_is_read_as_usual(name: str, tmp_path: Path) -> None:
    paths = SOURCES[name](tmp_path, scene("bayer_rggb8"))
    with open_sources(paths) as reader, open_sources(paths, salvage=True) as salvage:
        assert list(map(plain, salvage.records())) == list(map(plain, reader.records()))
        assert salvage.losses == []

        def facts(channel: Channel) -> object:
            return channel.id, channel.identity

        assert list(map(facts, salvage.channels)) == list(map(facts, reader.channels))
        assert list(salvage.unused_schemas) == list(reader.unused_schemas)
        assert dict(salvage.skipped) == dict(reader.skipped)
        assert (salvage.format, salvage.profile) == (reader.format, reader.profile)
        assert salvage.library == reader.library
        assert list(salvage.files) == list(reader.files)
        assert salvage.position == reader.position == sum(f.stat().st_size for f in reader.files)


FOLDERS = [("bags", "**/*.bag"), ("mcap", "**/*.mcap"), ("rosbag2", "**/*.mcap")]
REAL = [
    str(path.relative_to(DATA))
    for folder, pattern in [*FOLDERS, ("rosbag2", "**/*.db3")]
    for path in sorted((DATA / folder).glob(pattern))
]


@pytest.mark.one_in(8)
@pytest.mark.parametrize("name", REAL)
def test_a_real_intact_recording_is_read_as_usual(name: str) -> None:
    path = real(name)
    try:
        expected = list(map(plain, usual(path)))
    except SourceError:
        pytest.skip("the usual reader refuses it")
    records, losses = salvaged(path)
    assert list(map(plain, records)) == expected
    assert losses == []


def test_an_excerpt_is_a_part_of_it(tmp_path: Path) -> None:
    (path,) = SOURCES["mcap-ros2-zstd"](tmp_path, scene("mono8"))
    os.truncate(path, path.stat().st_size * 3 // 4)
    everything, _ = salvaged(path)
    times = sorted(r.log_time for r in everything if isinstance(r, Message))
    part = Excerpt(times[3], times[-3], frozenset({"/imu", "/tf"}), others=False)
    records, _ = salvaged(path, excerpt=part)
    assert list(map(plain, records)) == [plain(r) for r in everything if part.has(r)]
    assert 0 < len(records) < len(everything)


# ---------------------------------------------------------------- damage anywhere


def without_index(path: Path) -> None:
    """A bag whose recorder was killed: the index was never written."""
    data = bytearray(path.read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    (index,) = struct.unpack_from("<Q", data, place)
    data[place : place + 8] = bytes(8)
    path.write_bytes(data[:index])


COMPRESSED = [f"bag-{c}" for c in ("none", "bz2", "lz4")]
KINDS = [
    *COMPRESSED,
    *(f"{kind}-unindexed" for kind in COMPRESSED),
    *(f"mcap-{c}" for c in ("none", "lz4", "zstd")),
    "mcap-unchunked",
    "mcap-unindexed",
]


def write_kind(kind: str, path: Path) -> None:
    form, *words = kind.split("-")
    compression = next((word for word in words if not word.startswith("un")), "none")
    if form == "bag":
        write_bag(path, scene("rgb8"), compression)
        if "unindexed" in words:
            without_index(path)
    else:
        there = {"chunked": "unchunked" not in words, "indexed": "unindexed" not in words}
        write_mcap(path, scene("rgb8"), compression=compression, **there)


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[bytes, list[Piece]]]:
    """Bytes and pieces of an intact file of a kind."""
    folder = tmp_path_factory.mktemp("intact")

    @cache
    def make(kind: str) -> tuple[bytes, list[Piece]]:
        path = folder / f"{kind}.{kind.partition('-')[0]}"
        write_kind(kind, path)
        return path.read_bytes(), pieces_of(path)

    return make


Intact = Callable[[str], tuple[bytes, list[Piece]]]


@pytest.fixture
def salvaged_as(tmp_path: Path) -> Callable[[str, bytes], Salvaged]:
    """What comes out of a file of a kind with these bytes."""

    def read(kind: str, data: bytes) -> Salvaged:
        path = tmp_path / f"drive.{kind.partition('-')[0]}"
        path.write_bytes(data)
        return salvaged(path)

    return read


SalvagedAs = Callable[[str, bytes], Salvaged]


@pytest.mark.parametrize("kind", KINDS)
def test_the_pieces_are_all_there_is(kind: str, intact: Intact) -> None:
    """What the other tests measure by."""
    data, pieces = intact(kind)
    assert [p.start for p in pieces] == [0, *(p.end for p in pieces[:-1])]
    assert pieces[-1].end == len(data)
    written = Counter((message.topic, message.log_time) for message in scene("rgb8").messages)
    assert Counter(key[:2] for key in all_messages(pieces)) == written


@pytest.mark.one_in(4)
@pytest.mark.parametrize("injury", [*INJURIES, "four zeros"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_not_damaged_comes_back(
    kind: str, injury: str, intact: Intact, salvaged_as: SalvagedAs
) -> None:
    data, pieces = intact(kind)
    everything = Counter(all_messages(pieces))
    total = everything.total()
    *several, name = injury.split()
    for place in range(PLACES):
        rng, damages, damaged = random.Random(f"{kind} {injury} {place}"), [], data
        for _ in range(4 if several else 1):
            damaged, damage = INJURIES[name](damaged, rng)
            damages.append(damage)
        records, losses = salvaged_as(kind, damaged)
        found = keys(records)
        assert not Counter(sound_messages(pieces, damages)) - found, damages
        check_ranges(losses, len(damaged))
        lost = total - found.total()
        assert losses or not lost, damages
        if several or damage.shift:
            continue
        if all(loss.messages is not None for loss in losses):
            told = sum(loss.messages or 0 for loss in losses)
            assert lost <= told <= total - (found & everything).total(), damage
        there = {key[1] for key in found}
        for piece in pieces if lost else ():
            if {message[1] for message in piece.messages} - there:
                covered = any(covers(loss, piece) for loss in losses)
                assert covered or (losses and piece.end > len(damaged)), (damage, piece.start)


def check_ranges(losses: Sequence[Loss], size: int) -> None:
    """Places are in the file, in order, and do not overlap."""
    end = 0
    for loss in losses:
        assert loss.problem
        assert "\n" not in loss.problem
        if loss.offset is not None and loss.size is not None:
            assert end <= loss.offset
            end = loss.offset + loss.size
            assert end <= size


def covers(loss: Loss, piece: Piece) -> bool:
    if loss.offset is None or loss.size is None:
        return True
    return loss.offset < piece.end and piece.start < loss.offset + loss.size


# ---------------------------------------------------------------- counts and words


def test_a_lost_chunk_is_counted(intact: Intact, salvaged_as: SalvagedAs) -> None:
    """By its own index, where the file has no other."""
    for kind in ("bag-bz2-unindexed", "bag-bz2", "mcap-zstd"):
        data, pieces = intact(kind)
        chunk = [piece for piece in pieces if len(piece.messages) > 5][-1]
        middle = (chunk.start + chunk.end) // 2
        damaged = data[:middle] + bytes(3000) + data[middle + 3000 :]
        records, (loss,) = salvaged_as(kind, damaged)
        gone = Counter(all_messages(pieces)) - keys(records)
        assert loss.messages == gone.total()
        assert set(loss.topics) <= {key[0] for key in gone}
        assert loss.topics
        assert (loss.offset, loss.size) == (chunk.start, chunk.end - chunk.start)
        assert "damaged" in loss.problem or "checksum" in loss.problem
        times = [r.log_time for r in records if isinstance(r, Message)]
        assert {loss.start, loss.end} <= {None, *times}


def test_a_file_that_was_cut_short_says_so(intact: Intact, salvaged_as: SalvagedAs) -> None:
    data, pieces = intact("mcap-none")
    end = [piece.end for piece in pieces if piece.messages][-1]
    _, (loss,) = salvaged_as("mcap-none", data[:end])
    assert loss == Loss("drive.mcap", end, None, loss.problem, start=loss.start)
    assert loss.problem == "the file ends before its footer"


def test_nothing_but_the_index_was_cut_off(intact: Intact, salvaged_as: SalvagedAs) -> None:
    """Even where its first record is incomplete, no message is lost from there on."""
    data, pieces = intact("bag-none")
    index = next(piece for piece in pieces if piece.is_index and piece.defines)
    records, (loss,) = salvaged_as("bag-none", data[: (index.start + index.end) // 2])
    assert keys(records) == Counter(all_messages(pieces))
    assert loss.messages == 0


def test_messages_without_their_channel(intact: Intact, salvaged_as: SalvagedAs) -> None:
    """Nothing tells what they are: they are counted."""
    for kind, word in (("bag-none-unindexed", "connection"), ("mcap-unchunked", "channel")):
        data, pieces = intact(kind)
        piece = next(p for p in pieces if "/imu" in p.defines.values() and not p.is_index)
        (number,) = piece.defines
        damaged = data[: piece.start] + bytes(piece.end - piece.start) + data[piece.end :]
        if kind.startswith("mcap"):  # the summary repeats it
            damaged = damaged[: next(p for p in pieces if p.is_index).start]
        records, losses = salvaged_as(kind, damaged)
        assert "/imu" not in {key[0] for key in keys(records)}
        (loss,) = (x for x in losses if f"{word} {number}," in x.problem)
        count = sum(m[0] == number for p in pieces for m in p.messages)
        assert loss.messages in (count, count - 1)  # one may be taken for part of the damage


def test_messages_without_their_schema_are_kept(intact: Intact, salvaged_as: SalvagedAs) -> None:
    data, pieces = intact("mcap-unchunked")
    image = next(piece for piece in pieces if "/cam/image_raw" in piece.defines.values())
    schema = pieces[pieces.index(image) - 1]
    assert min(schema.defines) < 0
    end = next(piece for piece in pieces if piece.is_index).start
    zeros = bytes(schema.end - schema.start)
    damaged = data[: schema.start] + zeros + data[schema.end : end]
    records, losses = salvaged_as("mcap-unchunked", damaged)
    channels = [r.channel for r in records if isinstance(r, Message) and r.channel.schema is None]
    assert channels
    (loss,) = (loss for loss in losses if "schema" in loss.problem)
    assert (loss.messages, loss.topics) == (0, (channels[0].topic,))
    assert keys(records) == Counter(all_messages(pieces))


def test_a_wrong_checksum_alone_loses_nothing(intact: Intact, salvaged_as: SalvagedAs) -> None:
    data, pieces = intact("mcap-none")
    image = next(p for p in pieces if p.messages and len(p.messages[0][2]) > 5000)
    place = (image.start + image.end) // 2
    damaged = data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]
    records, (loss,) = salvaged_as("mcap-none", damaged)
    assert keys(records).total() == Counter(all_messages(pieces)).total()
    assert loss.messages == 0
    assert "checksum" in loss.problem


def test_there_are_not_more_losses_than_a_manifest_holds(tmp_path: Path) -> None:
    path = tmp_path / "drive.bag"
    write_bag(path, scene("mono8", frames=900, width=4, height=2), chunk_size=10**9)
    data = bytearray(path.read_bytes())
    places = [p for p in pieces_of(path) if p.messages]
    for piece in places[::4]:
        data[piece.start : piece.start + 20] = bytes(20)
    path.write_bytes(data)
    records, losses = salvaged(path)
    damaged = len(places[::4])
    assert damaged > MAX_LOSSES
    assert keys(records).total() == len(places) - damaged
    assert len(losses) == MAX_LOSSES
    assert losses[-1].problem == f"{damaged - MAX_LOSSES + 1} more places that could not be read"
    assert sum(loss.messages or 0 for loss in losses) == damaged


# ---------------------------------------------------------------- the usual reader


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", SOURCES)
def test_the_usual_error_names_the_option(name: str, tmp_path: Path) -> None:
    paths = SOURCES[name](tmp_path, scene("mono8"))
    last = paths[-1]
    if last.is_dir():
        last = sorted(last.glob("*_0.*"))[0]
    os.truncate(last, last.stat().st_size * 2 // 3)
    with pytest.raises(SourceError, match=r"`mp4ds pack --salvage` to pack what is still readable"):
        usual(*paths)
    if "zstd-file" in name:
        return  # a single block: nothing of it comes out
    records, losses = salvaged(*paths)
    assert losses
    assert keys(records) or name.startswith("mcap") or "zstd" in name


def test_the_damaged_files_of_others() -> None:
    found = {
        name: (keys(records).total(), len(losses))
        for name in ("unindexed.bag", "truncated.bag", "truncated_a.mcap", "sample_ok.bag")
        for records, losses in [salvaged(real(f"corrupt/{name}"))]
    }
    assert found == {
        "unindexed.bag": (14, 0),
        "truncated.bag": (3, 1),
        "truncated_a.mcap": (14, 1),
        "sample_ok.bag": (14, 0),
    }
    with pytest.raises(SourceError, match="git lfs pull"):
        salvaged(real("corrupt/lfs_pointer.bag"))


@pytest.mark.parametrize("suffix", ["bag", "mcap"])
def test_other_files_are_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"drive.{suffix}"
    path.write_bytes(random.Random(suffix).randbytes(10**6))
    with pytest.raises(SourceError, match="holds no records of"):
        salvaged(path)
    path.write_bytes(b"")
    with pytest.raises(SourceError, match="is empty"):
        salvaged(path)


# ---------------------------------------------------------------- lengths that lie


def patched(data: bytes, mark: bytes, skip: int, new: bytes) -> bytes:
    """With other bytes so far after the second place where a mark stands."""
    place = data.index(mark, data.index(mark) + 1) + len(mark) + skip
    return data[:place] + new + data[place + len(new) :]


def chunk_field(offset: int, new: bytes) -> Callable[[bytes, list[Piece]], bytes]:
    """An MCAP chunk with another value at an offset of its record."""

    def change(data: bytes, pieces: list[Piece]) -> bytes:
        place = [p.start for p in pieces if data[p.start] == 6][1] + offset
        return data[:place] + new + data[place + len(new) :]

    return change


HUGE32, HUGE64 = b"\xf0\xff\xff\xff", b"\0\0\0\0\x7f\0\0\0"
LIES: dict[str, tuple[str, Callable[[bytes, list[Piece]], bytes]]] = {
    **{
        f"chunk size, {c}": (f"bag-{c}", lambda d, _: patched(d, b"size=", 0, HUGE32))
        for c in ("none", "bz2", "lz4")
    },
    **{
        f"length of a chunk, {c}": (
            f"bag-{c}",
            lambda d, _, c=c: patched(d, b"size=", 4, HUGE32),  # type: ignore[misc]
        )
        for c in ("none", "bz2", "lz4")
    },
    "length of a message": ("bag-none", lambda d, _: patched(d, b"time=", 8, HUGE32)),
    "length of a header": ("bag-none", lambda d, _: patched(d, b"time=", -50, HUGE32)),
    "chunk count": (
        "bag-bz2",
        lambda d, _: d.replace(b"chunk_count=", b"chunk_count=\xff", 1)[:-1],
    ),
    **{
        f"{what}, {c}": (f"mcap-{c}", chunk_field(offset, new))
        for c in ("none", "lz4", "zstd")
        for what, offset, new in (
            ("length of a chunk", 1, HUGE64),
            ("size of a chunk", 25, HUGE64),
            ("name of a compression", 37, HUGE32),
        )
    },
    "length of an MCAP message": (
        "mcap-unchunked",
        lambda d, p: (lambda at: d[: at + 1] + HUGE64 + d[at + 9 :])(
            [x.start for x in p if x.messages][9]
        ),
    ),
}

READ = """
import resource, sys
from pathlib import Path
limit = int(sys.argv[2])
from mp4ds.bags.formats import open_sources
from mp4ds.bags import salvage_mcap, salvage_ros1, salvage_rosbag2
from mp4ds.errors import SourceError
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
resource.setrlimit(resource.RLIMIT_CPU, (30, 30))
try:
    with open_sources([Path(sys.argv[1])], salvage=True) as reader:
        print(sum(1 for _ in reader.records()), len(reader.losses))
except SourceError as error:
    print(0, 0, error)
# not ru_maxrss, which counts what the process was forked from
status = Path("/proc/self/status").read_text().split()
print(status[status.index("VmHWM:") + 1])
"""


def read_confined(path: Path) -> tuple[int, int, int]:
    """Records, losses and peak of memory in MiB of a process that may not take much of it."""
    counts, peak = program("-c", READ, path, 2 * 2**30).out.splitlines()
    records, losses = counts.split()[:2]
    return int(records), int(losses), int(peak) // 1024


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", LIES)
def test_a_length_that_lies_takes_no_memory(name: str, intact: Intact, tmp_path: Path) -> None:
    kind, change = LIES[name]
    data, pieces = intact(kind)
    path = tmp_path / f"drive.{kind.partition('-')[0]}"
    path.write_bytes(change(data, pieces))
    records, _, peak = read_confined(path)
    total = sum(len(piece.messages) for piece in pieces)
    largest = max(len(piece.messages) for piece in pieces)
    assert records >= total - largest - 1
    assert peak < 200


# ---------------------------------------------------------------- rosbag2


def folder_of(path: Path, **options: Any) -> Path:
    write_rosbag2(path / "drive", scene("rgb8"), **options)
    return path / "drive"


STORAGES = ["sqlite3", "mcap"]


@pytest.mark.parametrize("compression", [None, "file", "message"])
@pytest.mark.parametrize("storage", STORAGES)
def test_a_folder_without_metadata(storage: str, compression: str | None, tmp_path: Path) -> None:
    folder = folder_of(tmp_path, storage=storage, compression=compression, files=3)
    expected = keys(usual(folder))
    (folder / "metadata.yaml").unlink()
    with pytest.raises(SourceError, match=r"has no metadata.yaml.*`ros2 bag reindex`.*--salvage"):
        usual(folder)
    records, losses = salvaged(folder)
    assert keys(records) == expected
    assert losses == [Loss("metadata.yaml", None, None, "is missing", 0)]
    times = [r.log_time for r in records if isinstance(r, Message)]
    assert times == sorted(times) or storage == "mcap"


@pytest.mark.parametrize("text", [b"", b"\xff: [", b"a: [", b"[]", b"version: x"])
def test_a_folder_with_damaged_metadata(text: bytes, tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    expected = keys(usual(folder))
    (folder / "metadata.yaml").write_bytes(text)
    with pytest.raises(SourceError, match=r"--salvage"):
        usual(folder)
    records, (loss,) = salvaged(folder)
    assert keys(records) == expected
    assert (loss.file, loss.messages) == ("metadata.yaml", 0)


@pytest.mark.parametrize("storage", STORAGES)
def test_storage_that_metadata_does_not_list_is_read(storage: str, tmp_path: Path) -> None:
    folder = folder_of(tmp_path, storage=storage, files=3)
    expected = keys(usual(folder))
    text = (folder / "metadata.yaml").read_text()
    suffix = "mcap" if storage == "mcap" else "db3"
    (folder / "metadata.yaml").write_text(text.replace(f"  - drive_1.{suffix}\n", "", 1))
    (folder / f"other_0.{suffix}").write_bytes(b"not of this recording")
    records, (loss,) = salvaged(folder)
    assert keys(records) == expected
    assert (loss.file, loss.messages) == (f"drive_1.{suffix}", 0)
    assert "not listed" in loss.problem


@pytest.mark.parametrize("storage", STORAGES)
def test_a_storage_file_that_is_missing_is_a_loss(storage: str, tmp_path: Path) -> None:
    folder = folder_of(tmp_path, storage=storage, files=3)
    expected = keys(usual(folder))
    missing = sorted(folder.glob("drive_1.*"))[0]
    missing.unlink()
    records, (loss,) = salvaged(folder)
    gone = expected - keys(records)
    assert loss == Loss(missing.name, None, None, "is missing", gone.total())
    assert gone.total() > 5


@pytest.mark.parametrize("compression", [None, "file", "message"])
@pytest.mark.parametrize("storage", STORAGES)
def test_damaged_storage(storage: str, compression: str | None, tmp_path: Path) -> None:
    folder = folder_of(tmp_path, storage=storage, compression=compression)
    expected = keys(usual(folder))
    path = next(folder.glob("drive_0.*"))
    data = path.read_bytes()
    for place in range(PLACES):
        rng = random.Random(f"{storage} {compression} {place}")
        for injury in ("cut", "burst", "zeros", "gap"):
            path.write_bytes(INJURIES[injury](data, rng)[0])
            try:
                records, losses = salvaged(folder)
            except SourceError:  # nothing comes out of the compressed file
                if compression != "file":
                    raise
                continue
            found = keys(records)
            assert losses or found.total() >= expected.total()
            assert {loss.file for loss in losses} <= {path.name, "metadata.yaml"}
    path.write_bytes(data)
    assert keys(salvaged(folder)[0]) == expected


def test_a_compressed_file_is_read_up_to_the_damage(tmp_path: Path) -> None:
    """Of a stream that was cut off nothing is missing but the end."""
    for storage in STORAGES:
        folder = folder_of(tmp_path / storage, storage=storage, compression="file")
        expected = keys(usual(folder))
        path = next(folder.glob("drive_0.*"))
        whole = zstandard.ZstdDecompressor().decompressobj().decompress(path.read_bytes())
        frame = zstandard.ZstdCompressor(level=1).compressobj()
        blocks = b"".join(
            frame.compress(whole[start : start + 4096])
            + frame.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
            for start in range(0, len(whole), 4096)
        )
        path.write_bytes(blocks[: len(blocks) * 2 // 3])
        records, losses = salvaged(folder)
        found = keys(records)
        assert not found - expected
        assert found.total() > expected.total() // 5
        assert losses


# ---------------------------------------------------------------- sqlite3


Place = tuple[Key, frozenset[int]]


def places_of(path: Path) -> tuple[list[Place], set[int], int]:
    """Messages with the pages that they stand in, pages of the topics, and bytes of a page."""
    with closing(sqlite3.connect(path)) as database:
        query = database.execute
        topics = dict(query("SELECT id, name FROM topics"))
        messages = list(query("SELECT topic_id, timestamp, data FROM messages ORDER BY id"))
        leaves: list[tuple[str, int, int]] = []
        overflow: dict[str, set[int]] = {}
        try:
            pages = list(
                query(
                    "SELECT path, pageno, pagetype, ncell FROM dbstat"
                    " WHERE name = 'messages' ORDER BY path"
                )
            )
        except sqlite3.OperationalError:
            pytest.skip("this sqlite3 does not tell which page belongs to which row")
        for route, number, kind, cells in pages:
            if kind == "leaf":
                leaves.append((route.rstrip("/"), number, cells))
            elif kind == "overflow":
                overflow.setdefault(route.rpartition("+")[0], set()).add(number)
        found: list[Place] = []
        for route, number, cells in leaves:
            for cell in range(cells):
                topic, time, data = messages[len(found)]
                others = overflow.get(f"{route}/{cell:03x}", set())
                found.append(((topics[topic], time, data), frozenset({number, *others})))
        small = {n for (n,) in query("SELECT pageno FROM dbstat WHERE name = 'topics'")}
        (size,) = query("PRAGMA page_size").fetchone()
    assert len(found) == len(messages)
    return found, small, size


@pytest.mark.parametrize("injury", ["flip", "burst", "zeros", "cut"])
@pytest.mark.parametrize("frames", [16, 200])
def test_rows_of_undamaged_pages_come_back(frames: int, injury: str, tmp_path: Path) -> None:
    side = 64 if frames < 100 else 6
    write_rosbag2(tmp_path / "drive", scene("rgb8", frames=frames, width=side, height=side))
    path = next((tmp_path / "drive").glob("*.db3"))
    rows, small, size = places_of(path)
    data = path.read_bytes()
    everything = Counter(key for key, _ in rows)
    for place in range(PLACES):
        damaged, damage = INJURIES[injury](data, random.Random(f"{frames} {injury} {place}"))
        path.write_bytes(damaged)
        records, losses = salvaged(tmp_path / "drive")
        found = keys(records)
        bad = set(range(damage.start // size + 1, (damage.end - 1) // size + 2))
        if not bad & small:
            sound = Counter(key for key, pages in rows if not pages & bad)
            assert not sound - found, damage
            if injury == "cut" and found:  # and where nothing tells how many there were
                alone = tmp_path / "alone.db3"
                alone.write_bytes(damaged)
                assert not sound - keys(salvaged(alone)[0])
        lost = everything.total() - found.total()
        assert losses or not lost
        if all(loss.messages is not None for loss in losses):
            assert sum(loss.messages or 0 for loss in losses) == lost, damage
        check_ranges([loss for loss in losses if loss.file == path.name], len(damaged))


def test_keys_with_gaps(tmp_path: Path) -> None:
    """Of a file that was cut off, all rows before the end come back, whatever their keys."""
    path = tmp_path / "alone.db3"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
            " timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        database.execute("INSERT INTO topics VALUES(1, '/a', 'a/msg/A', 'cdr', '')")
        values = [(3 * n, n, bytes(400)) for n in range(1, 200)]
        database.executemany("INSERT INTO messages VALUES(?, 1, ?, ?)", values)
    rows, small, size = places_of(path)
    data = path.read_bytes()
    for count in range(max(small) + 1, len(data) // size):
        path.write_bytes(data[: count * size])
        sound = Counter(key for key, pages in rows if max(pages) <= count)
        assert not sound - keys(salvaged(path)[0])


def insert(database: sqlite3.Connection, count: int, size: int) -> None:
    (last,) = database.execute("SELECT MAX(timestamp) FROM messages").fetchone()
    rows = [(last + 1 + n, bytes([n % 251]) * size) for n in range(count)]
    database.executemany("INSERT INTO messages VALUES(NULL, 1, ?, ?)", rows)


def copied(path: Path, folder: Path) -> Path:
    """A database and the files beside it, as a power cut leaves them."""
    folder.mkdir()
    for file in path.parent.glob(f"{path.name}*"):
        shutil.copy(file, folder)
    return folder / path.name


@pytest.fixture
def database(tmp_path: Path) -> Path:
    write_rosbag2(tmp_path / "drive", scene("mono8"))
    return Path(shutil.copy(next((tmp_path / "drive").glob("*.db3")), tmp_path / "run_0.db3"))


def tree(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_transaction_that_was_not_finished_needs_sqlite3(database: Path, tmp_path: Path) -> None:
    expected = keys(usual(database))
    with closing(sqlite3.connect(database, isolation_level=None)) as connection:
        connection.execute("PRAGMA cache_size = 2")
        connection.execute("BEGIN")
        insert(connection, 400, 3000)
        path = copied(database, tmp_path / "cut")
        connection.execute("ROLLBACK")
    assert {file.name for file in path.parent.iterdir()} == {"run_0.db3", "run_0.db3-journal"}
    assert path.stat().st_size > 10**6
    with pytest.raises(SourceError, match=r"not closed properly.*--salvage"):
        usual(path)
    before = tree(path.parent)
    with pytest.raises(SourceError, match=r"not closed properly: open and close it once with"):
        salvaged(path)
    assert tree(path.parent) == before
    with closing(sqlite3.connect(path)) as connection:  # which takes the change back
        assert connection.execute("SELECT COUNT(*) FROM messages").fetchone() == (expected.total(),)
    assert keys(salvaged(path)[0]) == expected


@pytest.mark.parametrize("keep", [1.0, 0.6, 0.001])
def test_what_a_write_ahead_log_committed_is_read(
    keep: float, database: Path, tmp_path: Path
) -> None:
    with closing(sqlite3.connect(database, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA wal_autocheckpoint = 0")
        for _ in range(10):
            connection.execute("BEGIN")
            insert(connection, 20, 3000)
            connection.execute("COMMIT")
        path = copied(database, tmp_path / "cut")
    log = path.with_name("run_0.db3-wal")
    path.with_name("run_0.db3-shm").unlink(missing_ok=True)
    os.truncate(log, int(log.stat().st_size * keep))
    before = tree(path.parent)
    found = keys(salvaged(path)[0])
    assert keys(usual(path)) == found
    assert tree(path.parent) == before
    with closing(sqlite3.connect(path)) as connection:  # which writes them back
        rows = connection.execute("SELECT timestamp, data FROM messages").fetchall()
    assert Counter((key[1], key[2]) for key in found.elements()) == Counter(rows)
    assert (len(rows) > len(scene("mono8").messages)) == (keep > 0.01)


# ---------------------------------------------------------------- several files


def test_of_a_split_recording_only_the_damaged_part_loses(tmp_path: Path) -> None:
    paths = write_split_bags(tmp_path, scene("rgb8", frames=12), 3)
    expected = keys(usual(*paths))
    os.truncate(paths[1], paths[1].stat().st_size // 2)
    with pytest.raises(SourceError, match="--salvage"):
        usual(*paths)
    records, losses = salvaged(*paths)
    found = keys(records)
    assert not found - expected
    assert {loss.file for loss in losses} == {paths[1].name}
    for path in (paths[0], paths[2]):
        assert not keys(usual(path)) - found
    for topic in {key[0] for key in found}:
        times = [r.log_time for r in records if isinstance(r, Message) and r.channel.topic == topic]
        assert times == sorted(times)
