"""The structural hash of MCAP files by a foreign tool, before and after.

``pymcap-cli hash`` (PyPI: pymcap-cli) covers profile, schemas, channels with their metadata,
message counts and log times; not payloads, which other tests compare. It believes a file's own
index, so files without one are left out.
"""

from __future__ import annotations

from pathlib import Path

import pytest

import mp4ds
from conftest import DATA, real
from round_trips import journey, own_target, unpacked
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


def without_twins(recorded: Scene) -> Scene:
    """A scene in which no two channels have one type, as they would tell their schemas twice."""
    return Scene([m for m in recorded.messages if m.topic != "/chatter" or not m.publisher])


ONE_FILE = [name for name in SOURCES if name.startswith("mcap-") and name != "mcap-unindexed"]
ONE_FILE += ["rosbag2-mcap-v5", "rosbag2-mcap-v9"]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("source", ONE_FILE)
def test_hashes_of_written_files(source: str, tmp_path: Path) -> None:
    done = journey(tmp_path, SOURCES[source], without_twins(scene("bgr8")), own_target(source))
    assert hash_of(storage_of(done.output)) == hash_of(storage_of(done.sources[0]))


def is_believed(path: Path) -> bool:
    """Whether the tool sees all of a real file, and each schema is told once.

    The conformance files tell by the letters of their names what they leave out: chunks (ch)
    without message indexes (mx), or a summary (chx, st) without schemas (rsh) or channels (rch).
    """
    flags = set(path.stem.split("-")[1:])
    has_gaps = {"chx", "st"} <= flags and not {"rch", "rsh"} <= flags
    return path.stem != "roboto_tiny_dvs_ros1profile" and (
        "ch" not in flags or ("mx" in flags and not has_gaps)
    )


REAL = [
    str(path.relative_to(DATA))
    for pattern, every in (("mcap/*.mcap", 1), ("mcap/conformance/**/*.mcap", 10))
    for path in sorted(filter(is_believed, DATA.glob(pattern)))[::every]
]


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", REAL or ["mcap"])
def test_hashes_of_real_files(name: str, tmp_path: Path) -> None:
    path = real(name)
    mp4ds.pack(path, tmp_path / "dataset")
    assert hash_of(unpacked(tmp_path, "mcap")) == hash_of(path)
