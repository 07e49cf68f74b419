"""Writers of recordings: what they refuse, and what is left when they are stopped."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from mp4ds.bags.formats import open_sources
from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.protocols import BagWriter
from mp4ds.bags.ros1_writer import Ros1Writer
from mp4ds.bags.rosbag2 import Rosbag2Writer
from mp4ds.bags.rosbag2_sqlite import SqliteWriter
from mp4ds.errors import ConversionError, SourceError
from mp4ds.records import Channel, Message, Schema

STRING = Schema("std_msgs/msg/String", "ros2msg", b"string data")
WRITERS: dict[str, Callable[..., BagWriter]] = {
    "a.bag": Ros1Writer,
    "a.mcap": partial(McapWriter, profile=""),
    "sqlite3": partial(Rosbag2Writer, storage="sqlite3"),
    "mcap": partial(Rosbag2Writer, storage="mcap"),
}


def channel_for(name: str, schema: Schema | None = STRING) -> Channel:
    return Channel(7, "/a", "ros1" if name == "a.bag" else "cdr", schema, {})


@pytest.mark.parametrize("name", WRITERS)
def test_what_was_not_finished_is_no_recording(name: str, tmp_path: Path) -> None:
    def write() -> None:
        with WRITERS[name](tmp_path / name) as writer:
            channel = channel_for(name)
            writer.add_channel(channel)
            writer.write(Message(channel, 1, 1, 0, b"abc"))
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        write()
    with pytest.raises(SourceError), open_sources([tmp_path / name]) as reader:
        list(reader.records())
    assert not (tmp_path / name / "metadata.yaml").exists()


@pytest.mark.parametrize(
    ("name", "time"),
    [*((n, -1) for n in WRITERS), ("a.bag", 2**32 * 10**9), ("a.mcap", 2**64), ("sqlite3", 2**63)],
)
def test_a_time_that_does_not_fit(name: str, time: int, tmp_path: Path) -> None:
    channel = channel_for(name)
    with WRITERS[name](tmp_path / name) as writer:
        writer.add_channel(channel)
        with pytest.raises(ConversionError, match=r"topic /a: .*time"):
            writer.write(Message(channel, time, 1, 0, b""))
    with open_sources([tmp_path / name]) as reader:
        assert not [record for record in reader.records() if isinstance(record, Message)]


def test_what_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="unable to open"):
        SqliteWriter(tmp_path / "missing" / "a.db3")
    assert list(tmp_path.iterdir()) == []
    with Ros1Writer(tmp_path / "a.bag") as bag:
        with pytest.raises(ConversionError, match="messages are cdr"):
            bag.add_channel(channel_for("mcap"))
        with pytest.raises(FileExistsError):
            Ros1Writer(tmp_path / "a.bag")
    schemaless = pytest.raises(ConversionError, match="topic /a: has no schema")
    with WRITERS["sqlite3"](tmp_path / "sqlite3") as database, schemaless:
        database.add_channel(channel_for("sqlite3", None))
