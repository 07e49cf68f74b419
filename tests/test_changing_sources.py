"""A recording that changes while it is packed is refused: the dataset would be of no recording."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import mp4ds
from in_parts import InlineExecutor, leftovers, use
from mp4ds.errors import SourceError
from mp4ds.packing.packer import Packer
from mp4ds.plugins.importing import ros_mp4
from mp4ds.plugins.importing.ros_mp4 import import_ros_mp4
from sources import SOURCES, scene
from test_import_ros_mp4 import FIXTURE

OLD_NS = 1_700_000_000_123_456_789


def append(file: Path) -> None:
    with file.open("ab") as stream:
        stream.write(b"more")


def edit(file: Path) -> None:
    """Write over the middle; the size stays."""
    with file.open("r+b") as stream:
        stream.seek(file.stat().st_size // 2)
        stream.write(b"\xff")


def replace(file: Path) -> None:
    """Move a file of the same size, time, beginning and end into the place."""
    stat = file.stat()
    other = file.with_name("other")
    shutil.copyfile(file, other)
    edit(other)
    os.utime(other, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    other.replace(file)


def write_ahead(file: Path) -> None:
    """What sqlite leaves beside a database of which others write."""
    file.with_name(f"{file.name}-wal").write_bytes(b"not yet in it")


CHANGES = {"append": append, "edit": edit, "replace": replace, "write-ahead": write_ahead}


def image_folder(folder: Path) -> Path:
    """Images of a camera, named by their times."""
    place = folder / "cam0"
    place.mkdir(parents=True)
    for number in range(4):
        picture = Image.linear_gradient("L").resize((32, 24)).rotate(90 * number)
        picture.save(place / f"{OLD_NS + number * 10**8}.png")
    return place


def recording(kind: str, folder: Path) -> tuple[Path, Path]:
    """What to pack, and the file of it that changes; long since written."""
    folder.mkdir()
    if kind == "images":
        path = image_folder(folder)
        file = sorted(path.iterdir())[-1]
    else:
        # so large that its first and last 64 KiB are not all of it
        picture = scene("rgb8", frames=4, width=160, height=120)
        (path,) = SOURCES[kind](folder, picture)
        file = max(path.rglob("*"), key=lambda one: one.stat().st_size) if path.is_dir() else path
    for one in folder.rglob("*"):
        os.utime(one, ns=(OLD_NS, OLD_NS))
    return path, file


def changes_once(change: Callable[[Path], None], file: Path) -> Callable[[object], None]:
    """What changes a file when a pack first tells of its progress."""
    waiting = [change]

    def progress(_: object) -> None:
        if waiting:
            waiting.pop()(file)

    return progress


CASES = [
    *(("bag-none", change) for change in ("append", "edit", "replace")),
    *(("mcap-ros2-zstd", change) for change in ("append", "edit", "replace")),
    *(("rosbag2-sqlite3-v9", change) for change in ("append", "edit", "replace", "write-ahead")),
    ("rosbag2-mcap-v9", "replace"),
    *(("images", change) for change in ("edit", "replace")),
]


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("kind", "change"), CASES)
@pytest.mark.parametrize("salvage", [False, True])
def test_a_source_that_changes_while_it_is_packed(
    kind: str, change: str, salvage: bool, tmp_path: Path
) -> None:
    if salvage and kind == "images":
        pytest.skip("images are not salvaged")
    path, file = recording(kind, tmp_path / "source")
    images = mp4ds.ImportOptions() if kind == "images" else None
    options = mp4ds.PackOptions(images=images, codec="ffv1", salvage=salvage)
    progress = changes_once(CHANGES[change], file)
    with pytest.raises(SourceError, match="changed while it was being read"):
        mp4ds.pack(path, tmp_path / "dataset", options, progress=progress)
    assert not (tmp_path / "dataset").exists()
    assert leftovers(tmp_path) == []


def test_a_source_that_changes_while_it_is_packed_in_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, file = recording("bag-none", tmp_path / "source")
    use(monkeypatch, InlineExecutor())
    make = Packer.run

    def changing(packer: Packer) -> Any:
        replace(file)
        return make(packer)

    monkeypatch.setattr(Packer, "run", changing)
    options = mp4ds.PackOptions(codec="ffv1", gop=2, window=2)
    with pytest.raises(mp4ds.PartsFailedError, match="changed while it was being read"):
        mp4ds.pack(path, tmp_path / "dataset", options)
    assert not (tmp_path / "dataset").exists()


def test_a_source_that_gets_another_name_and_a_link_is_the_same(tmp_path: Path) -> None:
    """Backups link files, and nothing of them changes."""
    path, file = recording("bag-none", tmp_path / "source")
    progress = changes_once(lambda file: os.link(file, tmp_path / "backup"), file)
    mp4ds.pack(path, tmp_path / "dataset", mp4ds.PackOptions(codec="ffv1"), progress=progress)
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []


@pytest.mark.parametrize("name", ["drive.mp4", "drive.yaml"])
@pytest.mark.parametrize("change", ["append", "replace"])
def test_a_pair_that_changes_while_it_is_imported(
    name: str, change: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = Path(shutil.copytree(FIXTURE, tmp_path / "source"))
    make = ros_mp4._part_of

    def changing(*arguments: Any) -> Any:
        CHANGES[change](source / name)
        return make(*arguments)

    monkeypatch.setattr(ros_mp4, "_part_of", changing)
    with pytest.raises(SourceError, match="changed while it was being read"):
        import_ros_mp4(source / "drive.mp4", source / "drive.yaml", tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()
    assert leftovers(tmp_path) == []
