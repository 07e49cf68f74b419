"""How much of damaged recordings comes back, by mp4ds and by the tools of each format.

    python benchmarks/salvage.py [FOLDER] [--places N] [--rosbag PYTHON]

Reads every recording of FOLDER, and recordings that it makes and damages itself: it cuts
them off, changes a byte, and empties a sector, at N places each. In these, a message counts if
it is to the byte one of the intact recording. The other tools are ``rosbag reindex`` of ROS 1,
by a PYTHON that has its python, ``pymcap-cli recover``, and of the sqlite3 tool ``.recover``
or, where that gives less, ``.dump``.
"""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from measure import parser_of, print_table
from mp4ds.bags.formats import open_sources
from mp4ds.errors import SourceError
from mp4ds.records import Message

Found = Counter[tuple[str, int, str]]
"""Messages: topic, log time in ns, digest of the payload."""

_START = 1_700_000_000_000_000_000
_REINDEX = """
import json, sys, hashlib
import rosbag
path = sys.argv[1]
try:
    with rosbag.Bag(path, "a", allow_unindexed=True) as bag:
        for _ in bag.reindex():
            pass
except Exception as error:
    print(repr(error)[:200], file=sys.stderr)
found = []
try:
    with rosbag.Bag(path, "r", allow_unindexed=True) as bag:
        for topic, (_, data, _, _, _), time in bag.read_messages(raw=True):
            found.append((topic, time.to_nsec(), hashlib.sha256(data).hexdigest()))
except Exception as error:
    print(repr(error)[:200], file=sys.stderr)
print(json.dumps(found))
"""


_WRITE = """
import json, sys
import genpy, rosbag
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
path, compression = sys.argv[1:]
types = {"/camera": UInt8MultiArray, "/imu": Float64MultiArray}
with rosbag.Bag(path, "w", compression=compression, chunk_threshold=2**18) as bag:
    while line := sys.stdin.buffer.readline():
        topic, time, size = json.loads(line)
        kind = types[topic]
        raw = (kind._type, sys.stdin.buffer.read(size), kind._md5sum, kind)
        bag.write(topic, raw, genpy.Time(*divmod(time, 10**9)), raw=True)
"""


def digest(data: bytes | memoryview) -> str:
    """Of a payload."""
    return hashlib.sha256(data).hexdigest()


# ---------------------------------------------------------------- recordings


def payloads(count: int) -> Iterator[tuple[str, int, bytes]]:
    """Topic, log time and payload: pictures that do not compress well, amid small messages."""
    rng = np.random.default_rng(1)
    for number in range(count):
        time = _START + number * 33_333_333
        smooth = np.cumsum(rng.integers(-2, 3, 40_000), dtype=np.int64).astype(np.uint8)
        yield "/camera", time, smooth.tobytes()
        for k in range(6):
            values = rng.normal(size=38) * 0.1 + k
            yield "/imu", time + k * 5_000_000, values.tobytes()


def make_bag(path: Path, compression: str, python: str) -> None:
    """A ROS 1 bag of many chunks, by ROS 1 where it is there: it reindexes no others."""
    if has_rosbag(python):
        rows = (
            json.dumps([topic, time, len(data)]).encode() + b"\n" + data
            for topic, time, data in payloads(80)
        )
        command = [python, "-c", _WRITE, str(path), compression]
        subprocess.run(command, input=b"".join(rows), check=True)
        return
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = BagWriter(path)
    if compression != "none":
        writer.set_compression(BagWriter.CompressionFormat[compression.upper()])
    writer.chunk_threshold = 2**18
    with writer:
        types = {
            "/camera": "std_msgs/msg/UInt8MultiArray",
            "/imu": "std_msgs/msg/Float64MultiArray",
        }
        connections = {
            topic: writer.add_connection(topic, msgtype, typestore=store)
            for topic, msgtype in types.items()
        }
        for topic, time, data in payloads(80):
            writer.write(connections[topic], time, data)


def has_rosbag(python: str) -> bool:
    """Whether a Python has the packages of ROS 1."""
    check = [python, "-c", "import rosbag"]
    return not subprocess.run(check, capture_output=True, check=False).returncode


def make_mcap(path: Path, compression: str, _: str) -> None:
    """An MCAP file of many chunks, or without any."""
    chunked = compression != "unchunked"
    kind = CompressionType[compression.upper() if chunked else "NONE"]
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2**18, compression=kind, use_chunking=chunked)
        writer.start("ros2", "recorder")
        channels = {}
        for topic in ("/camera", "/imu"):
            schema = writer.register_schema(f"a/msg/{topic[1:]}", "ros2msg", b"uint8[] data\n")
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, time, data in payloads(80):
            writer.add_message(channels[topic], time, data, time)
        writer.finish()  # type: ignore[no-untyped-call]


def make_db3(path: Path, _compression: str, _python: str) -> None:
    """A storage file of rosbag2."""
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
            " timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        ids = {"/camera": 1, "/imu": 2}
        rows = [(key, topic, "a/msg/A", "cdr", "") for topic, key in ids.items()]
        database.executemany("INSERT INTO topics VALUES(?, ?, ?, ?, ?)", rows)
        for topic, time, data in payloads(80):
            row = (ids[topic], time, data)
            database.execute("INSERT INTO messages VALUES(NULL, ?, ?, ?)", row)


RECORDINGS: dict[str, tuple[str, Callable[[Path, str, str], None], str]] = {
    **{f"bag, {c}": ("bag", make_bag, c) for c in ("none", "bz2", "lz4")},
    **{f"mcap, {c}": ("mcap", make_mcap, c) for c in ("none", "lz4", "zstd", "unchunked")},
    "db3": ("db3", make_db3, ""),
}


def cut(data: bytes, rng: random.Random) -> bytes:
    """Without its end."""
    return data[: rng.randrange(1, len(data))]


def flipped(data: bytes, rng: random.Random) -> bytes:
    """With one byte changed."""
    place = rng.randrange(len(data))
    return data[:place] + bytes([data[place] ^ rng.randrange(1, 256)]) + data[place + 1 :]


def burst(data: bytes, rng: random.Random) -> bytes:
    """With a sector of zeros."""
    place = rng.randrange(len(data)) // 512 * 512
    return data[:place] + bytes(len(data[place : place + 512])) + data[place + 512 :]


DAMAGES = {"cut": cut, "byte": flipped, "sector": burst}


# ---------------------------------------------------------------- ways of reading


def by_mp4ds(path: Path) -> Found:
    """What mp4ds salvages."""
    found: Found = Counter()
    try:
        with open_sources([path], salvage=True) as reader:
            for record in reader.records():
                if isinstance(record, Message):
                    found[record.channel.topic, record.log_time, digest(record.data)] += 1
    except SourceError:
        pass
    return found


def by_rosbag(path: Path, python: str) -> Found | None:
    """What a bag holds after ``rosbag reindex``; None without ROS 1."""
    if not has_rosbag(python):
        return None
    copy = path.with_name("reindexed.bag")
    shutil.copy(path, copy)
    copy.chmod(0o644)
    done = subprocess.run(
        [python, "-c", _REINDEX, str(copy)],
        capture_output=True,
        text=True,
        check=False,
    )
    copy.unlink()
    try:
        rows: list[Any] = json.loads(done.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        rows = []
    return Counter((topic, time, told) for topic, time, told in rows)


def by_pymcap(path: Path, _: str) -> Found | None:
    """What ``pymcap-cli recover`` writes; None where it is not installed."""
    tool = shutil.which("pymcap-cli", path=str(Path(sys.executable).parent))
    if tool is None:
        return None
    target = path.with_name("recovered.mcap")
    command = [tool, "recover", str(path), "--output", str(target), "--force"]
    subprocess.run(command, capture_output=True, check=False)
    found: Found = Counter()
    if target.exists():
        try:
            with target.open("rb") as stream:
                for _schema, channel, message in make_reader(stream).iter_messages():
                    found[channel.topic, message.log_time, digest(message.data)] += 1
        except Exception as error:
            print(f"{path.name}: {error!r}", file=sys.stderr)
        target.unlink()
    return found


def by_sqlite(path: Path, _: str) -> Found | None:
    """What the sqlite3 tool recovers or dumps; None where it is not installed."""
    tool = shutil.which("sqlite3")
    if tool is None:
        return None
    ways = (_by_sqlite(tool, path, command) for command in (".recover", ".dump"))
    return max(ways, key=lambda found: sum(found.values()))


def _by_sqlite(tool: str, path: Path, command: str) -> Found:
    target = path.with_name("recovered.db3")
    dump = subprocess.run([tool, str(path), command], capture_output=True, check=False)
    subprocess.run(
        [tool, str(target)],
        input=dump.stdout.replace(b"ROLLBACK;", b"COMMIT;"),
        capture_output=True,
        check=False,
    )
    found: Found = Counter()
    query = "SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id"
    try:
        with closing(sqlite3.connect(target)) as database:
            for topic, time, data in database.execute(query):
                if isinstance(time, int) and isinstance(data, bytes):
                    found[topic, time, digest(data)] += 1
    except sqlite3.Error:
        pass
    target.unlink(missing_ok=True)
    return found


TOOLS: dict[str, Callable[[Path, str], Found | None]] = {
    "bag": by_rosbag,
    "mcap": by_pymcap,
    "db3": by_sqlite,
}


# ---------------------------------------------------------------- table


def score(found: Found | None, original: Found | None) -> tuple[int, int]:
    """Messages that are those of the original, and others."""
    if found is None:
        return -1, 0
    if original is None:
        return sum(found.values()), 0
    right = sum((found & original).values())
    return right, sum(found.values()) - right


def shown(counts: tuple[int, int]) -> str:
    """A score."""
    if counts[0] < 0:
        return "-"
    return f"{counts[0]}" + (f" (and {counts[1]} altered)" if counts[1] else "")


def compare(path: Path, original: Found | None, python: str) -> tuple[Any, Any]:
    """Scores of mp4ds and of the other tool."""
    ours, theirs = by_mp4ds(path), TOOLS[path.suffix[1:]](path, python)
    return score(ours, original), score(theirs, original)


def given(folder: Path, scratch: Path, python: str) -> Iterator[list[object]]:
    """A row for each recording of a folder."""
    for path in sorted(folder.iterdir()):
        if path.suffix[1:] not in TOOLS:
            continue
        copy = Path(shutil.copy(path, scratch / path.name))
        ours, theirs = compare(copy, None, python)
        fewer = f"fewer in {int(ours[0] < theirs[0])}"
        yield [path.name, 1, "-", shown(ours), shown(theirs), fewer]
        copy.unlink()


def made(scratch: Path, places: int, python: str) -> Iterator[list[object]]:
    """A row for each kind of recording and damage."""
    for name, (suffix, make, compression) in RECORDINGS.items():
        whole = scratch / f"whole.{suffix}"
        make(whole, compression, python)
        data, original = whole.read_bytes(), by_mp4ds(whole)
        for what, damage in DAMAGES.items():
            sums, fewer = np.zeros((2, 2), np.int64), 0
            for place in range(places):
                path = scratch / f"damaged.{suffix}"
                path.write_bytes(damage(data, random.Random(f"{name} {what} {place}")))
                scores = np.array(compare(path, original, python))
                fewer += int(scores[0, 0] < scores[1, 0])
                sums += scores
            ours, theirs = (shown((int(row[0]), int(row[1]))) for row in sums)
            total = places * sum(original.values())
            yield [f"{name}, {what}", places, total, ours, theirs, f"fewer in {fewer}"]
        whole.unlink()


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--places", type=int, default=10)
    parser.add_argument("--rosbag", default=sys.executable, help="a Python that has rosbag")
    arguments = parser.parse_args()
    header = ["recording", "files", "messages", "mp4ds", "other tool", "mp4ds against it"]
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        if arguments.folder:
            print_table(header, given(arguments.folder, scratch, arguments.rosbag))
        print_table(header, made(scratch, arguments.places, arguments.rosbag))


if __name__ == "__main__":
    main()
