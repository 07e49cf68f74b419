"""Putting datasets together that follow one another."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from compare import compare
from edits import flip
from mp4ds.bags.protocols import RecordingSlice
from mp4ds.dataset.checks import validate
from mp4ds.dataset.concat import concat
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.recording import copy_part
from mp4ds.errors import FormatError
from mp4ds.packing.options import PackOptions
from mp4ds.packing.pack import pack
from mp4ds.records import Excerpt
from mp4ds.unpacking.unpack import unpack
from sources import scene, write_bag


@pytest.fixture(
    scope="module",
    params=[("16UC1", "ffv1", 1), ("rgb8", "ffv1", 1), ("rgb8", "h264", 8)],
    ids=lambda param: "-".join(map(str, param)),
)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset whose videos can be cut at every frame, or only hide what is before the cut."""
    encoding, codec, gop = request.param
    folder = tmp_path_factory.mktemp("concat")
    write_bag(folder / "drive.bag", scene(encoding, frames=12))
    pack(folder / "drive.bag", folder / "drive", PackOptions(codec=codec, gop=gop))
    return folder / "drive"


def cut(dataset: Path, folder: Path, parts: int) -> list[Path]:
    """Slices of a dataset that follow one another."""
    made = []
    with Dataset(dataset) as opened:
        manifest = opened.manifest
        assert manifest is not None
        assert manifest.time_range is not None
        start, end = manifest.time_range.start, manifest.time_range.end + 1
        for span in pairwise(np.linspace(start, end, parts + 1).astype(np.int64).tolist()):
            made.append(folder / f"{len(made)}")
            made[-1].mkdir(parents=True)
            copy_part(opened, made[-1], part=RecordingSlice(Excerpt(*span)))
    return made


def join(parts: list[Path], folder: Path) -> Path:
    folder.mkdir()
    with ExitStack() as stack:
        concat([stack.enter_context(Dataset(part)) for part in parts], folder)
    return folder


@pytest.fixture
def few_files() -> Iterator[None]:
    """Fewer than twelve more files may be open."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    opened = max(int(path.name) for path in Path("/dev/fd").iterdir()) + 1
    resource.setrlimit(resource.RLIMIT_NOFILE, (opened + 10, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.usefixtures("few_files")
def test_files_of_all_parts_are_not_open_at_once(whole: Path, tmp_path: Path) -> None:
    """A long recording has a part for every few seconds."""
    join(cut(whole, tmp_path / "parts", 12), tmp_path / "joined")
    assert validate(tmp_path / "joined") == []


@pytest.mark.parametrize("count", [2, 5])
def test_parts_are_the_whole_again(count: int, whole: Path, tmp_path: Path) -> None:
    joined = join(cut(whole, tmp_path / "parts", count), tmp_path / "joined")
    assert validate(joined, deep=True) == []
    for dataset in (whole, joined):
        unpack(dataset, "bag", tmp_path / f"{dataset.name}.bag")
    assert compare([tmp_path / "drive.bag"], tmp_path / "joined.bag") == []
    with Dataset(whole) as before, Dataset(joined) as after:
        assert before.manifest is not None
        assert after.manifest is not None
        assert after.manifest.transforms == before.manifest.transforms
        assert after.manifest.time_range == before.manifest.time_range
        assert after.manifest.messages == before.manifest.messages


def test_videos_are_joined_where_nothing_is_hidden(whole: Path, tmp_path: Path) -> None:
    joined = join(cut(whole, tmp_path / "parts", 3), tmp_path / "joined")
    with Dataset(whole) as before, Dataset(joined) as after:
        sidecar = before.streams[0].sidecar
        is_cut_anywhere = sidecar.video.codec == "ffv1" and not sidecar.view
        assert (len(after.streams) == len(before.streams)) == is_cut_anywhere


@pytest.mark.parametrize("count", [1, 2])
def test_a_damaged_part_is_not_copied(count: int, whole: Path, tmp_path: Path) -> None:
    for video in sorted(whole.glob("*.mp4")):
        parts = cut(whole, tmp_path / f"parts of {video.stem}", count)
        flip(parts[-1] / video.name)
        with pytest.raises(FormatError, match=video.name):
            join(parts, tmp_path / f"joined of {video.stem}")
