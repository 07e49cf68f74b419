"""The witness is tested too: it sees every single difference, and none where there is none."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mcap.records as records
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader

import compare as witness
from sources import (
    IMAGE,
    SOURCES,
    START,
    Scene,
    raw_scene,
    scene,
    typestore,
    write_bag,
    write_mcap,
    write_rosbag2,
)

WRITERS: dict[str, Callable[..., Any]] = {
    "bag": lambda path, what: write_bag(path.with_suffix(".bag"), what),
    "sqlite3": write_rosbag2,
    "mcap": lambda path, what: write_mcap(path.with_suffix(".mcap"), what),
}
ENDINGS = {"bag": ".bag", "sqlite3": "", "mcap": ".mcap"}
EQUAL = [
    ("bag-none", "bag-bz2"),
    ("bag-none", "bag-split"),
    ("rosbag2-sqlite3-v9", "rosbag2-sqlite3-v4"),
    ("rosbag2-sqlite3-v9", "rosbag2-sqlite3-split"),
    ("rosbag2-sqlite3-v9", "rosbag2-sqlite3-zstd-file"),
    ("rosbag2-sqlite3-v9", "rosbag2-mcap-v9"),
    ("rosbag2-mcap-v9", "rosbag2-mcap-split"),
    ("rosbag2-mcap-v9", "rosbag2-mcap-zstd-message"),
    ("mcap-ros2-none", "mcap-ros2-zstd"),
    ("mcap-ros2-none", "mcap-unindexed"),
    ("mcap-ros1-zstd", "rosbag2-sqlite3-v6"),
]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], list[Path]]:
    """Paths of a source variant, written once."""
    folder, done = tmp_path_factory.mktemp("sources"), dict[str, list[Path]]()

    def get(name: str) -> list[Path]:
        if name not in done:
            (folder / name).mkdir()
            done[name] = SOURCES[name](folder / name, scene("bayer_rggb8"))
        return done[name]

    return get


def one(differences: list[str], pattern: str) -> None:
    """There are differences, and all of them are of the kind expected."""
    assert differences
    assert all(re.search(pattern, difference) for difference in differences), differences


# ---------------------------------------------------------------- equal


@pytest.mark.parametrize("name", SOURCES)
def test_source_is_valid_and_equals_itself(name: str, written: Any) -> None:
    paths = written(name)
    report = witness.examine(paths, paths)
    assert not report.differences
    assert sum(row.a for row in report.rows.values()) == 64
    if name.startswith("mcap"):
        with paths[0].open("rb") as stream:
            assert sum(1 for _ in make_reader(stream).iter_messages()) == 64
    else:
        with AnyReader(paths, default_typestore=typestore("cdr")) as reader:
            assert sum(1 for _ in reader.messages()) == 64


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("a", "b"), EQUAL)
def test_equal_across_compression_and_format(a: str, b: str, written: Any) -> None:
    report = witness.examine(written(a), written(b))
    assert report.differences == []
    assert all(row.equal == row.a == row.b for row in report.rows.values())


# ---------------------------------------------------------------- different messages


def changed(what: Scene, index: int, **changes: Any) -> Scene:
    messages = list(what.messages)
    messages[index] = replace(messages[index], **changes)
    return replace(what, messages=messages)


def _image_index(what: Scene, n: int) -> int:
    return [i for i, m in enumerate(what.messages) if m.msgtype == IMAGE][n]


def _pixel(what: Scene) -> Scene:
    index = _image_index(what, 3)
    values = dict(what.messages[index].values)
    values["data"] = values["data"].copy()
    values["data"][-1] ^= 1
    return changed(what, index, values=values)


def _time(what: Scene) -> Scene:
    index = _image_index(what, 3)
    return changed(what, index, log_time=what.messages[index].log_time + 1)


def _drop(what: Scene) -> Scene:
    index = _image_index(what, 3)
    return replace(what, messages=what.messages[:index] + what.messages[index + 1 :])


def _rename(what: Scene) -> Scene:
    messages = [replace(m, topic=m.topic.replace("/imu", "/inu")) for m in what.messages]
    return replace(what, messages=messages)


def _silence(what: Scene) -> Scene:
    return replace(what, silent={})


MESSAGE_CHANGES: dict[str, tuple[Callable[[Scene], Scene], str]] = {
    "payload byte": (_pixel, r"^/cam/image_raw message 3: payload differs$"),
    "log time": (_time, r"^/cam/image_raw message 3: (log|publish) time \d+ in A, \d+ in B"),
    "dropped": (_drop, r"^/cam/image_raw(: 8 messages in A, 7 in B| message 3: .* missing in B)$"
                       r"|sequence|more"),
    "topic": (_rename, r"/i[mn]u"),
    "silent topic": (_silence, r"/diagnostics.* missing in B"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("change", MESSAGE_CHANGES)
def test_changed_message_is_seen(change: str, kind: str, tmp_path: Path) -> None:
    what = scene("rgb8")
    alter, pattern = MESSAGE_CHANGES[change]
    WRITERS[kind](tmp_path / "a", what)
    WRITERS[kind](tmp_path / "b", alter(what))
    paths = [tmp_path / f"{name}{ENDINGS[kind]}" for name in "ab"]
    one(witness.compare(*paths), pattern)
    assert witness.compare(*reversed(paths))


def test_order_of_equal_times_is_seen(tmp_path: Path) -> None:
    payloads = [(START, b"\1\0\0\0" + x, b"\0\1\0\0\2\0\0\0" + x + b"\0") for x in (b"a", b"b")]
    for name, messages in (("a.bag", payloads), ("b.bag", payloads[::-1])):
        write_bag(tmp_path / name, raw_scene("/t", "std_msgs/msg/String", messages))
    found = witness.compare(tmp_path / "a.bag", tmp_path / "b.bag")
    one(found, r"^/t message [01]: payload differs$")


# ---------------------------------------------------------------- different properties

BAG_CHANGES = {
    "callerid": (b"callerid=/first", b"callerid=/worst", r"metadata callerid '/first' in A"),
    "latching": (b"latching=1", b"latching=0", r"^/chatter: metadata latching '1' in A, '0' in B"),
    "md5sum": (b"md5sum=992ce", b"md5sum=993ce", r"^/(chatter|diagnostics): metadata md5sum"),
    "definition": (b"definition=string data", b"definition=string  dat", r": definition"),
    "type": (b"type=tf2_msgs/TFMessage", b"type=tf3_msgs/TFMessage", r"^/tf: type"),
    "payload": (b"frame 1", b"frame 7", r"^/chatter message \d: payload differs"),
}  # fmt: skip


@pytest.mark.parametrize("change", BAG_CHANGES)
def test_changed_bag_is_seen(change: str, tmp_path: Path) -> None:
    old, new, pattern = BAG_CHANGES[change]
    write_bag(tmp_path / "a.bag", scene("mono8"))
    data = (tmp_path / "a.bag").read_bytes()
    assert old in data
    (tmp_path / "b.bag").write_bytes(data.replace(old, new))
    one(witness.compare(tmp_path / "a.bag", tmp_path / "b.bag"), pattern)


def rewrite(path: Path, change: Callable[[Any], Any]) -> None:
    """Write an MCAP file anew, each record changed, or left out where None is returned."""
    with path.open("rb") as stream:
        found = list(StreamReader(stream).records)
    end = next(i for i, record in enumerate(found) if isinstance(record, records.DataEnd))
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    with path.open("wb") as stream:
        writer = Writer(stream)
        for record in filter(None, map(change, found[:end])):
            if isinstance(record, records.Header):
                writer.start(record.profile, record.library)
            elif isinstance(record, records.Schema) and record.id not in schemas:
                told = record.name, record.encoding, record.data
                schemas[record.id] = writer.register_schema(*told)
            elif isinstance(record, records.Channel) and record.id not in channels:
                schema = schemas[record.schema_id]
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schema, record.metadata
                )
            elif isinstance(record, records.Message):
                times = record.publish_time, record.sequence
                channel = channels[record.channel_id]
                writer.add_message(channel, record.log_time, record.data, *times)
            elif isinstance(record, records.Attachment):
                text = record.name, record.media_type, record.data
                writer.add_attachment(record.create_time, record.log_time, *text)
            elif isinstance(record, records.Metadata):
                writer.add_metadata(record.name, record.metadata)
        writer.finish()  # type: ignore[no-untyped-call]


MCAP_CHANGES: dict[str, tuple[type, Callable[[Any], bool], dict[str, Any] | None, str]] = {
    "attachment": (records.Attachment, lambda r: r.name == "map.bin", {"data": bytes(256)},
                   "^attachment 'map.bin'"),
    "attachment time": (records.Attachment, lambda r: r.name == "map.bin", {"create_time": 5},
                        "^attachment 'map.bin'"),
    "attachment lost": (records.Attachment, lambda r: r.name == "map.bin", None,
                        "^attachment 'map.bin'.* missing in B$"),
    "metadata": (records.Metadata, lambda r: "part" in r.metadata, {"metadata": {"part": "3"}},
                 "^metadata record 'session'"),
    "metadata lost": (records.Metadata, lambda r: "part" in r.metadata, None,
                      "^metadata record 'session'.* missing in B$"),
    "profile": (records.Header, lambda r: True, {"profile": "ros3"}, "^profile: "),
    "publish time": (records.Message, lambda r: r.channel_id == 4 and r.sequence == 2,
                     {"publish_time": 17}, r"message 1: publish time \d+ in A, 17 in B$"),
    "sequence": (records.Message, lambda r: r.channel_id == 4 and r.sequence == 2,
                 {"sequence": 17}, r"message 1: sequence 2 in A, 17 in B$"),
    "channel metadata": (records.Channel, lambda r: r.topic == "/imu", {"metadata": {}},
                         "^/imu: (offered_qos_profiles|topic_type_hash) .* None in B"),
    "definition": (records.Schema, lambda r: r.name.endswith("/Imu"), {"data": b"int8 x\n"},
                   "^/imu: definition 'ros2msg, .* in A, 'ros2msg, 7 bytes"),
    "schema encoding": (records.Schema, lambda r: r.name.endswith("/Imu"), {"encoding": "ros2idl"},
                        "^/imu: definition 'ros2msg, .* in A, 'ros2idl"),
    "message encoding": (records.Channel, lambda r: r.topic == "/imu",
                         {"message_encoding": "cdr2"}, "^/imu: message encoding"),
}  # fmt: skip


@pytest.mark.parametrize("change", MCAP_CHANGES)
def test_changed_mcap_is_seen(change: str, tmp_path: Path) -> None:
    kind, wanted, changes, pattern = MCAP_CHANGES[change]
    a, b = tmp_path / "a.mcap", tmp_path / "b.mcap"
    write_mcap(a, scene("mono8"))
    shutil.copy(a, b)
    rewrite(b, lambda record: record)
    assert witness.compare(a, b) == []

    def alter(record: Any) -> Any:
        if isinstance(record, kind) and wanted(record):
            return replace(record, **changes) if changes is not None else None  # type: ignore[type-var]
        return record

    rewrite(b, alter)
    one(witness.compare(a, b), pattern)


# ---------------------------------------------------------------- pixels left out


def test_ignored_pixels_of_whole_recordings(tmp_path: Path) -> None:
    what = scene("rgb8", frames=4)
    write_bag(tmp_path / "a.bag", what)
    write_bag(tmp_path / "b.bag", _pixel(what))
    write_rosbag2(tmp_path / "c", _pixel(what))
    a, b, c = tmp_path / "a.bag", tmp_path / "b.bag", tmp_path / "c"
    assert witness.compare(a, b, ignore_pixels=["/cam/image*"]) == []
    assert witness.compare(a, c, ignore_pixels=["/cam/image*"]) == []
    one(witness.compare(a, b, ignore_pixels=["/other"]), "payload")
    with pytest.raises(witness.UnreadableError, match="/imu: pixels of sensor_msgs/Imu cannot"):
        witness.compare(a, b, ignore_pixels=["/imu"])


# ---------------------------------------------------------------- command line


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    what = scene("mono8", frames=4)
    write_bag(tmp_path / "a.bag", what)
    write_bag(tmp_path / "b.bag", _pixel(what))
    parts = SOURCES["bag-split"](tmp_path, what)
    a, b, split = str(tmp_path / "a.bag"), str(tmp_path / "b.bag"), ",".join(map(str, parts))
    assert witness.main([a, split]) == 0
    assert capsys.readouterr().out.endswith("EQUAL\n")
    assert witness.main([a, b]) == 1
    assert re.search(r"/cam/image_raw +4 +4 +3 +DIFFERS \(1\)", capsys.readouterr().out)
    assert witness.main([a, b, "--ignore-pixels", "/cam/*_raw"]) == 0
