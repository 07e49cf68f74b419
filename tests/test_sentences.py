"""What commands say of their results, and of what is wrong with their input."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import mp4ds
from commands import call, refused, unchanged
from mp4ds.cli.output import print_table
from sources import SOURCES, scene, write_bag, write_rosbag2
from test_terminal import Screen

VIDEO, SIDECAR, MANIFEST = "cam_image_raw.mp4", "cam_image_raw.yaml", "dataset.yaml"


@pytest.fixture
def dataset(packed_bag: Path, tmp_path: Path) -> Path:
    """A dataset that may be damaged."""
    shutil.copytree(packed_bag, tmp_path / "drive")
    return tmp_path / "drive"


# ---------------------------------------------------------------- results


def test_what_was_checked_of_a_dataset(dataset: Path) -> None:
    done = call("validate", "--deep", dataset)
    assert done.out.endswith(
        "no problems; every video was decoded, every message with a digest checked\n"
    )
    (dataset / VIDEO).unlink()
    done = call("validate", "--deep", dataset)
    assert done.code == 1
    assert done.out.splitlines() == [
        f"{dataset / VIDEO}: is listed in the manifest but missing [file-missing]",
        f"{dataset}: 1 problem",
    ]


def test_paths_are_as_users_write_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative to the current folder where they are inside of it, in results and errors alike."""
    monkeypatch.chdir(tmp_path)
    assert call("demo", "drive.bag", "--seconds", "0.2").out.startswith("drive.bag: ")
    for words in (("pack", "drive.bag", "-o", tmp_path / "drive"), ("info", tmp_path / "drive")):
        done = call(*words)
        assert str(tmp_path) not in done.out
        assert re.search("^drive: ", done.out, re.MULTILINE)
    assert call("pack", "drive.bag", "-o", "drive").err.startswith("mp4ds: drive: already exists")
    (tmp_path / "drive" / "left_image_raw.mp4").unlink()
    for said in (call("validate", "drive"), call("validate", tmp_path / "drive")):
        assert said.out.startswith("drive/left_image_raw.mp4: is listed in the manifest")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for typed in (str(tmp_path / "drive"), "../drive"):
        assert call("validate", typed).out.startswith(f"{typed}/left_image_raw.mp4: is listed")


def test_a_dataset_is_named_after_its_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    source = tmp_path / "disk" / "drive.v2.bag"
    write_bag(source, scene("mono8", frames=2))
    assert call("pack", source).code == 0
    assert mp4ds.validate("drive.v2", deep=True) == []
    assert call("pack", source).err.startswith("mp4ds: drive.v2: already exists. ")
    assert call("pack", source, "--force").code == 0
    assert mp4ds.pack(write_named(tmp_path / "disk")).dataset == tmp_path / "here" / "folder"
    monkeypatch.chdir(tmp_path / "disk")
    for words, said in (
        (["folder"], "Give --output, the dataset to make: folder is the recording itself."),
        (["../here/drive.v2"], "only that of one recording is named by itself"),
        (["drive.v2.bag", "folder"], "only that of one recording is named by itself"),
    ):
        with unchanged(tmp_path):
            refused(call("pack", *words), 2, said)


def write_named(folder: Path) -> Path:
    """A rosbag2 folder."""
    write_rosbag2(folder / "folder", scene("mono8", frames=2))
    return folder / "folder"


# ---------------------------------------------------------------- tables

COLUMNS = ("topic", "type", "messages", "gaps", "jitter", "content")
NAMES = [f"/vehicle/sensor_{n:02}/camera/image_rect_color/compressed" for n in range(70)]
ROWS = [[name, "sensor_msgs/Image", "123", "", "0.5", "rgb8 " * 9] for name in NAMES]


def printed(
    monkeypatch: pytest.MonkeyPatch, columns: int | None, rows: list[list[str]] = ROWS
) -> list[str]:
    """The lines of a table, on a terminal that is so wide, or in a pipe."""
    screen = Screen() if columns else io.StringIO()
    monkeypatch.setenv("COLUMNS", str(columns or 80))
    with contextlib.redirect_stdout(screen):
        is_cut = print_table(
            [dict(zip(COLUMNS, row, strict=True)) for row in rows],
            {"topic": "topic", "type": "type", "content": "text"},
            spare=("gaps", "jitter", "type"),
        )
    assert is_cut == bool(columns and columns < 300)
    return re.sub(r"\x1b\[[0-9;]*m", "", screen.getvalue()).splitlines()


def test_a_pipe_gets_all_of_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """One line for each row, nothing wrapped or shortened; no column without values."""
    heading, *lines = printed(monkeypatch, None)
    assert heading.split() == ["topic", "type", "messages", "jitter", "content"]
    assert [line.split()[:3] for line in lines] == [row[:3] for row in ROWS]
    assert all(line.endswith("rgb8") for line in lines)


@pytest.mark.parametrize("columns", [40, 80, 120, 300])
def test_a_table_fits_a_terminal(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    heading, *lines = printed(monkeypatch, columns)
    assert max(map(len, (heading, *lines))) <= columns
    assert "gaps" not in heading
    assert ("jitter" in heading) == (columns >= 120)
    assert ("sensor_msgs/Image" in lines[0]) == (columns >= 120)
    assert all(line.startswith("/vehi") for line in lines)
    assert lines[0].split()[0].endswith("compressed" if columns > 40 else "...")
    assert len(lines) == len(ROWS)


# ---------------------------------------------------------------- what is wrong


def cut(name: str, before: bytes) -> Callable[[Path], None]:
    """Cut a file of a dataset short."""

    def damage(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: data.index(before)])

    return damage


CUT = {
    "a video": (cut(VIDEO, b"moov"), VIDEO, "was cut short: it has no index"),
    "its index": (cut(VIDEO, b"mvhd"), VIDEO, "was cut short or damaged: the file ends in the mid"),
    "a sidecar": (cut(SIDECAR, b"headers:"), SIDECAR, "ends without headers, video"),
    "its key": (cut(SIDECAR, b"aders:"), SIDECAR, "is not valid YAML of the subset, perhaps cut"),
    "a manifest": (cut(MANIFEST, b"files:"), MANIFEST, "ends without files: it was"),
    "its text": (cut(MANIFEST, b'"\n'), MANIFEST, "is not valid YAML of the subset, perhaps cut"),
}


@pytest.mark.parametrize("what", CUT)
def test_what_was_cut_short(what: str, dataset: Path) -> None:
    """By `validate`, which says so once, and by whatever reads it."""
    damage, name, words = CUT[what]
    damage(dataset)
    said = call("validate", dataset).out
    assert f"{dataset / name}: {words}" in said
    assert said.count(words) == 1
    assert "schema-invalid" not in said.replace("short [schema-invalid]", "")
    read = call("unpack", dataset, "--to", "mcap", "-o", dataset.parent / "again.mcap")
    assert read.code == 1
    assert "This is a bug" not in read.err
    if name != VIDEO:
        assert f"{dataset / name}: {words}" in read.err


def test_a_video_alone_that_was_cut_short(dataset: Path, tmp_path: Path) -> None:
    data = (dataset / VIDEO).read_bytes()
    for size in (len(data) - 10, data.index(b"moov") + 60, len(data) // 3):
        (tmp_path / "alone.mp4").write_bytes(data[:size])
        with pytest.raises(mp4ds.VideoError, match="the file ends in the middle of a box"):
            mp4ds.open(tmp_path / "alone.mp4")
    (tmp_path / "alone.mp4").write_bytes(b"")
    with pytest.raises(mp4ds.VideoError, match="is empty"):
        mp4ds.open(tmp_path / "alone.mp4")


def test_a_folder_of_datasets_is_not_one(dataset: Path) -> None:
    with pytest.raises(mp4ds.SourceError) as caught:
        mp4ds.open(dataset.parent)
    assert str(caught.value) == (
        f"{dataset.parent}: is a folder of 1 dataset, not a dataset. Open one of them, such as "
        f"{dataset}."
    )


def test_a_recording_is_not_a_dataset(tmp_path: Path) -> None:
    for kind in ("bag-none", "mcap-ros2-none", "rosbag2-sqlite3-v9"):
        (tmp_path / kind).mkdir()
        (source,) = SOURCES[kind](tmp_path / kind, scene("mono8", frames=2))
        with pytest.raises(mp4ds.SourceError) as caught:
            mp4ds.open(source)
        assert str(caught.value) == (
            f"{source}: is a recording, not a dataset. Make a dataset of it first: "
            f"mp4ds pack {source}"
        )
