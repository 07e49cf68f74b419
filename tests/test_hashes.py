"""The structural hash of MCAP files by a foreign tool, before and after.

``pymcap-cli hash`` (PyPI: pymcap-cli) covers profile, schemas, channels with their metadata,
message counts and log times; not payloads, which other tests compare. It believes a file's own
index, and counts a schema as often as it is told: such files are first written again by the
``mcap`` library.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mcap import records
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from conftest import DATA, real
from round_trips import journey, own_target, round_trip
from scenes import Scene
from sources import SOURCES, scene

tool = pytest.importorskip("pymcap_cli.core.mcap_compare")


def hash_of(path: Path) -> str:
    """The hash of a file, which the tool must not refuse."""
    found = tool.read_structural_identity_file(str(path))
    assert found, f"the tool cannot read {path}"
    return str(found.identity.digest)


def storage_of(path: Path) -> Path:
    """The MCAP file of a recording of one."""
    (found,) = path.glob("*.mcap") if path.is_dir() else [path]
    return found


def rewritten(path: Path, folder: Path) -> Path:
    """The same file with a whole index, and with equal schemas told once."""
    schemas: dict[tuple[str, str, bytes], int] = {}
    ids: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    target = folder / "rewritten.mcap"
    with path.open("rb") as source, target.open("wb") as sink:
        writer = Writer(sink)
        for record in StreamReader(source).records:
            if isinstance(record, records.Header):
                writer.start(record.profile, record.library)
            elif isinstance(record, records.Schema):
                key = record.name, record.encoding, record.data
                ids[record.id] = schemas.get(key) or writer.register_schema(*key)
                schemas[key] = ids[record.id]
            elif isinstance(record, records.Channel):
                if record.id not in channels:
                    channels[record.id] = writer.register_channel(
                        record.topic,
                        record.message_encoding,
                        ids[record.schema_id],
                        record.metadata,
                    )
            elif isinstance(record, records.Message):
                number, times = channels[record.channel_id], (record.publish_time, record.sequence)
                writer.add_message(number, record.log_time, record.data, *times)
            elif isinstance(record, records.Attachment):
                times = record.create_time, record.log_time
                writer.add_attachment(*times, record.name, record.media_type, record.data)
            elif isinstance(record, records.Metadata):
                writer.add_metadata(record.name, record.metadata)
        writer.finish()  # type: ignore[no-untyped-call]
    return target


def without_twins(recorded: Scene) -> Scene:
    """A scene in which no two channels have one type, as they would tell their schemas twice."""
    return Scene([m for m in recorded.messages if m.topic != "/chatter" or not m.publisher])


ONE_FILE = [name for name in SOURCES if name.startswith("mcap-")]
ONE_FILE += ["rosbag2-mcap-v5", "rosbag2-mcap-v9"]


def some(names: list[str], every: int) -> list[Any]:
    """All names, of which every n-th is in the ordinary run."""
    return [
        pytest.param(name, marks=[pytest.mark.slow] if n % every else [])
        for n, name in enumerate(names)
    ]


@pytest.mark.parametrize("source", some(ONE_FILE, 4))
def test_hashes_of_written_files(source: str, tmp_path: Path) -> None:
    done = journey(tmp_path, SOURCES[source], without_twins(scene("bgr8")), own_target(source))
    path = storage_of(done.sources[0])
    expected = hash_of(rewritten(path, tmp_path) if "unindexed" in source else path)
    assert hash_of(storage_of(done.output)) == expected


def is_believed(path: Path) -> bool:
    """Whether the tool sees all of a file: its index is whole or it does without.

    The conformance files tell by the letters of their names what they leave out: chunks (ch)
    without message indexes (mx), or a summary (chx, st) without schemas (rsh) or channels (rch).
    """
    flags = set(path.stem.split("-")[1:])
    if "ch" not in flags:
        return True
    return "mx" in flags and not ({"chx", "st"} <= flags and not {"rch", "rsh"} <= flags)


TELLS_TWICE = {"roboto_tiny_dvs_ros1profile.mcap"}
ALL_REAL = sorted(str(path.relative_to(DATA)) for path in DATA.glob("mcap/**/*.mcap"))
CONFORMANCE = [name for name in ALL_REAL if "conformance" in name]
REAL = [name for name in ALL_REAL if name not in CONFORMANCE]


@pytest.mark.parametrize(
    "name",
    [
        *(some(REAL, 4) or ["mcap"]),
        *(pytest.param(name, marks=pytest.mark.slow) for name in CONFORMANCE[::5]),
    ],
)
def test_hashes_of_real_files(name: str, tmp_path: Path) -> None:
    """The tool refuses none of them."""
    path = real(name)
    output = round_trip([path], tmp_path, "mcap")
    if path.name in TELLS_TWICE or not is_believed(path):
        path = rewritten(path, tmp_path)
    expected = hash_of(path)
    assert hash_of(output) == expected
