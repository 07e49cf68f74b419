"""The structural hash of MCAP files by a foreign tool, before and after.

``pymcap-cli hash`` (PyPI: pymcap-cli) covers profile, schemas, channels with their metadata,
message counts and log times; not payloads, which other tests compare. It believes a file's own
index, so files without one are left out.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from round_trips import journey, own_target
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
