"""The structural hash of MCAP files by a foreign tool, before and after.

``pymcap-cli hash`` (PyPI: pymcap-cli) covers profile, schemas, channels with their metadata,
message counts and log times; not payloads, which other tests compare.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from coded_scenes import CODED
from conftest import DATA, real
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from round_trips import journey, own_target, round_trip
from sources import SOURCES, scene

TOOL = shutil.which("pymcap-cli", path=str(Path(sys.executable).parent)) or shutil.which(
    "pymcap-cli"
)
pytestmark = pytest.mark.skipif(
    not TOOL, reason="pymcap-cli is not installed: pip install pymcap-cli, Python 3.10 or newer"
)


def hash_of(path: Path) -> str:
    """What the tool prints, or an empty string for a file that it refuses."""
    done = subprocess.run(
        [str(TOOL), "hash", str(path)], capture_output=True, text=True, check=False
    )
    return done.stdout.strip() if done.returncode == 0 else ""


def storage_of(path: Path) -> Path:
    """The MCAP file of a recording of one."""
    (found,) = path.glob("*.mcap") if path.is_dir() else [path]
    return found


ONE_FILE = [name for name in SOURCES if name.startswith("mcap-")]
ONE_FILE += ["rosbag2-mcap-v5", "rosbag2-mcap-v9"]


@pytest.mark.parametrize("source", ONE_FILE)
def test_hashes_of_written_files(source: str, tmp_path: Path) -> None:
    done = journey(tmp_path, SOURCES[source], scene("bgr8"), own_target(source))
    expected = hash_of(storage_of(done.sources[0]))
    assert expected.startswith("mcap-index-v1:")
    assert hash_of(storage_of(done.output)) == expected


@pytest.mark.parametrize("name", ["jpeg-cut-one", "depth-32FC1-rvl", "video-h264-mid-gop"])
def test_hashes_of_coded_pictures(name: str, tmp_path: Path) -> None:
    done = journey(tmp_path, SOURCES["mcap-ros2-lz4"], CODED[name](), "mcap")
    expected = hash_of(done.sources[0])
    assert expected.startswith("mcap-index-v1:")
    assert hash_of(done.output) == expected


@pytest.mark.parametrize("source", FOXGLOVE_SOURCES)
def test_hashes_of_foxglove_messages(source: str, tmp_path: Path) -> None:
    done = journey(tmp_path, FOXGLOVE_SOURCES[source], FOXGLOVE["jpeg-cut-one"](), "mcap")
    expected = hash_of(done.sources[0])
    assert expected.startswith("mcap-index-v1:")
    assert hash_of(done.output) == expected


def test_the_hash_tells_recordings_apart(tmp_path: Path) -> None:
    found = set()
    for seed in range(3):
        (tmp_path / str(seed)).mkdir()
        found.add(
            hash_of(SOURCES["mcap-ros2-lz4"](tmp_path / str(seed), scene("bgr8", seed=seed))[0])
        )
    assert len(found) == 3


REAL = sorted(
    str(path.relative_to(DATA))
    for pattern in ("mcap/**/*.mcap", "corrupt/sample_ok.mcap")
    for path in DATA.glob(pattern)
)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if "conformance" in name else [])
        for name in REAL or ["mcap"]
    ],
)
def test_hashes_of_real_files(name: str, tmp_path: Path) -> None:
    path = real(name)
    expected = hash_of(path)
    output = round_trip([path], tmp_path, "mcap")
    if not expected:
        pytest.skip(f"pymcap-cli refuses {name}")
    assert hash_of(output) == expected
