"""--force replaces what mp4ds wrote, and nothing else."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import mp4ds
from commands import call, refused, unchanged
from mp4ds.packing.options import PackOptions
from mp4ds.plugins.reporting.report import report
from sources import SOURCES, scene

FOLDERS: dict[str, tuple[str, ...]] = {
    "pack": ("pack", "BAG", "--codec", "h264"),
    "pack in parts": ("pack", "BAG", "--codec", "h264", "--window", "2"),
    "rosbag2": ("unpack", "DATASET", "--to", "rosbag2", "--storage", "sqlite3"),
    "rosbag2 mcap": ("unpack", "DATASET", "--to", "rosbag2", "--storage", "mcap"),
    "images": ("export", "images", "DATASET"),
    "demo": ("demo",),
    "tum": ("export", "tum", "DATASET"),
    "euroc": ("export", "euroc", "DATASET"),
}
FILES: dict[str, tuple[str, tuple[str, ...]]] = {
    "bag": ("out.bag", ("unpack", "DATASET", "--to", "bag")),
    "mcap": ("out.mcap", ("unpack", "DATASET", "--to", "mcap")),
    "demo": ("out.mcap", ("demo",)),
    "demo bag": ("out.bag", ("demo",)),
    "png": ("out.png", ("frames", "DATASET", "--at", "#0")),
    "jpeg": ("out.jpg", ("frames", "DATASET", "--at", "#0")),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording and its dataset."""
    folder = tmp_path_factory.mktemp("made")
    SOURCES["bag-none"](folder, scene("rgb8", frames=4))
    mp4ds.pack(folder / "drive.bag", folder / "drive", PackOptions(codec="h264"))
    return folder


def arguments(command: tuple[str, ...], made: Path, target: Path) -> list[str]:
    names = {"BAG": str(made / "drive.bag"), "DATASET": str(made / "drive")}
    output = ["-o", str(target)] if command[0] != "demo" else [str(target), "--seconds", "0.1"]
    return [*(names.get(word, word) for word in command), *output]


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", FOLDERS)
def test_a_folder_with_something_else_in_it_is_kept(kind: str, made: Path, tmp_path: Path) -> None:
    target = tmp_path / "out"
    command = arguments(FOLDERS[kind], made, target)
    assert call(*command).code == 0
    inner = next((p for p in sorted(target.iterdir()) if p.is_dir()), target)
    for stranger in (target / "mine.txt", inner / "mine.png", target / "labels" / "0.txt"):
        stranger.parent.mkdir(exist_ok=True)
        stranger.write_text("years of work")
        with unchanged(tmp_path):
            told = stranger.relative_to(target).as_posix().replace("labels/0.txt", "labels/")
            refused(call(*command, "--force"), 2, f"holds 1 item that mp4ds did not write ({told})")
        stranger.unlink()
        if stranger.parent.name == "labels":
            stranger.parent.rmdir()
    assert call(*command, "--force").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("kind", FILES)
def test_a_file_of_another_kind_is_kept(kind: str, made: Path, tmp_path: Path) -> None:
    name, command = FILES[kind]
    line = arguments(command, made, tmp_path / name)
    assert call(*line).code == 0
    assert call(*line, "--force").code == 0
    assert len(list(tmp_path.iterdir())) == 1
    (tmp_path / name).write_text("years of work")
    with unchanged(tmp_path):
        refused(call(*line, "--force"), 2, "was not written by mp4ds")


def yolo(folder: Path) -> None:
    """As YOLO has its folders."""
    (folder / "dataset.yaml").write_text("train: images\nval: images\nnames: {0: person}\n")
    for name in ("images/0.jpg", "labels/0.txt"):
        (folder / name).parent.mkdir()
        (folder / name).write_text("years of work")


def described(folder: Path) -> None:
    (folder / "metadata.yaml").write_text("version: 1\ntitle: Ten years of work\n")
    (folder / "thesis.tex").write_text("years of work")


def noted(folder: Path) -> None:
    (folder / "mp4ds_export.json").write_text('{"files": ["../thesis.tex", 3]}')
    (folder / "cells").mkdir()
    (folder / "cells" / "culture.csv").write_text("years of work")


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", FOLDERS)
@pytest.mark.parametrize("folder", [yolo, described, noted])
def test_a_folder_that_looks_like_an_output_is_kept(
    folder: Callable[[Path], None], kind: str, made: Path, tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    folder(tmp_path / "out")
    with unchanged(tmp_path):
        result = call(*arguments(FOLDERS[kind], made, tmp_path / "out"), "--force")
        refused(result, 2, "so --force does not replace it")


@pytest.mark.parametrize("folder", [yolo, noted])
def test_an_evaluation_goes_into_its_own_folder_only(
    folder: Callable[[Path], None], made: Path, tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    folder(tmp_path / "out")
    with unchanged(tmp_path):
        refused(
            call("evaluate", made / "drive", "-o", tmp_path / "out", "--force"),
            2,
            "was not written by mp4ds",
        )


@pytest.mark.parametrize("kind", [*FOLDERS, *FILES])
def test_a_link_is_kept(kind: str, made: Path, tmp_path: Path) -> None:
    name, command = FILES[kind] if kind in FILES else ("out", FOLDERS[kind])
    line = arguments(command, made, tmp_path / name)
    (tmp_path / f"real-{name}").mkdir()
    (tmp_path / name).symlink_to(f"real-{name}")
    with unchanged(tmp_path):
        refused(call(*line, "--force"), 2, "is a symbolic link", f"real-{name} itself")


def test_a_report_goes_with_its_dataset(made: Path, tmp_path: Path) -> None:
    dataset = tmp_path / "drive"
    shutil.copytree(made / "drive", dataset)
    report(dataset)
    report(dataset)
    (dataset / "report" / "mine.txt").write_text("years of work")
    command = ("pack", made / "drive.bag", "-o", dataset, "--codec", "h264", "--force")
    with unchanged(tmp_path):
        refused(call(*command), 2, "(report/mine.txt)")
        refused(call("report", dataset), 2, "(mine.txt)")
    (dataset / "report" / "mine.txt").unlink()
    (dataset / "index.html").write_text("<h1>mine</h1>")
    with unchanged(tmp_path):
        refused(call(*command), 2, "(index.html)")
    (dataset / "index.html").unlink()
    assert call(*command).code == 0
    assert not (dataset / "report").exists()
