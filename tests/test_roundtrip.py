"""Recording -> dataset -> recording: every message equal, for every source, encoding and target.

The comparison is tools/compare.py, which reads with the public libraries and shares no code
with the package.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import mp4ds
from conftest import DATA, real
from mp4ds.packing import PackOptions
from mp4ds.unpacking import UnpackOptions
from sources import ENCODINGS, SOURCES, TRAITS, odd_scene, scene

Compare = Callable[..., list[str]]

TARGETS = {
    "bag": ("bag", None),
    "rosbag2-sqlite3": ("rosbag2", "sqlite3"),
    "rosbag2-mcap": ("rosbag2", "mcap"),
    "mcap": ("mcap", None),
    "rosbag2": ("rosbag2", None),
}
OWN_TARGET = {"bag": "bag", "rosbag2": "rosbag2-mcap", "mcap": "mcap"}


def own_target(source: str) -> str:
    kind = source.split("-")[0]
    return "rosbag2-sqlite3" if source.startswith("rosbag2-sqlite3") else OWN_TARGET[kind]


def round_trip(
    sources: list[Path], folder: Path, target: str, exclude: list[str] | None = None
) -> Path:
    """Pack, validate, unpack; returns what came out."""
    mp4ds.pack(sources, folder / "dataset", PackOptions(exclude=exclude or ()))
    assert mp4ds.validate(folder / "dataset", deep=True) == []
    to, storage = TARGETS[target]
    output = folder / f"again{ {'bag': '.bag', 'mcap': '.mcap'}.get(to, '') }"
    mp4ds.unpack(folder / "dataset", to, output, UnpackOptions(storage=storage))
    return output


def has_streams(folder: Path) -> bool:
    return bool(list(folder.glob("*.mp4")))


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("encoding", ["bayer_gbrg8", "mono16"])
def test_every_source_returns_to_its_own_format(
    source: str, encoding: str, tmp_path: Path, compare: Compare
) -> None:
    (tmp_path / "source").mkdir()
    sources = SOURCES[source](tmp_path / "source", scene(encoding))
    output = round_trip(sources, tmp_path, own_target(source))
    assert has_streams(tmp_path / "dataset")
    assert compare(sources, output) == []


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("source", ["bag-lz4", "rosbag2-sqlite3-v9", "mcap-ros2-zstd"])
def test_every_encoding_is_a_video_and_returns(
    source: str, encoding: str, tmp_path: Path, compare: Compare
) -> None:
    (tmp_path / "source").mkdir()
    sources = SOURCES[source](tmp_path / "source", scene(encoding, width=63, height=47))
    output = round_trip(sources, tmp_path, own_target(source))
    manifest = mp4ds.open(tmp_path / "dataset").manifest
    assert manifest is not None
    assert not manifest.verbatim
    assert [stream.frames for stream in manifest.streams] == [8]
    assert compare(sources, output) == []


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("source", SOURCES)
def test_every_source_and_encoding(
    source: str, encoding: str, tmp_path: Path, compare: Compare
) -> None:
    (tmp_path / "source").mkdir()
    sources = SOURCES[source](tmp_path / "source", scene(encoding, seed=1))
    output = round_trip(sources, tmp_path, own_target(source))
    assert compare(sources, output) == []


@pytest.mark.parametrize("target", [*TARGETS][:4])
@pytest.mark.parametrize(
    "source",
    ["bag-none", "rosbag2-sqlite3-v4", "rosbag2-mcap-v9", "mcap-ros1-zstd", "mcap-ros2-lz4"],
)
def test_every_target(source: str, target: str, tmp_path: Path, compare: Compare) -> None:
    (tmp_path / "source").mkdir()
    sources = SOURCES[source](tmp_path / "source", scene("rgb8"))
    output = round_trip(sources, tmp_path, target)
    assert compare(sources, output) == []


@pytest.mark.parametrize("trait", TRAITS)
@pytest.mark.parametrize("source", ["bag-none", "mcap-ros2-none"])
def test_odd_messages_return(trait: str, source: str, tmp_path: Path, compare: Compare) -> None:
    (tmp_path / "source").mkdir()
    sources = SOURCES[source](tmp_path / "source", odd_scene(trait))
    output = round_trip(sources, tmp_path, own_target(source))
    assert compare(sources, output) == []


REAL = sorted(
    str(path.relative_to(DATA))
    for pattern in (
        "bags/**/*.bag",
        "mcap/*.mcap",
        "corrupt/sample_ok.*",
        "rosbag2/**/*.db3",
        "rosbag2/**/*.mcap",
        "mcap/conformance/**/*.mcap",
    )
    for path in DATA.glob(pattern)
)
REAL_FOLDERS = sorted(
    str(path.parent.relative_to(DATA)) for path in DATA.glob("rosbag2/**/metadata.yaml")
)


@pytest.mark.parametrize("name", [*REAL, *REAL_FOLDERS] or ["bags"])
def test_real_recordings_return(name: str, tmp_path: Path, compare: Compare) -> None:
    path = real(name)
    target = "rosbag2" if path.is_dir() or path.suffix == ".db3" else path.suffix[1:]
    output = round_trip([path], tmp_path, target)
    assert compare(path, output) == []
