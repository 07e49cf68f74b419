"""Many datasets: found below a folder, worked on side by side, shown in a table and on a page."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import pytest

from commands import call
from mp4ds.dataset.dataset import datasets_in
from mp4ds.errors import (
    OptionError,
    SourceError,
    SourceNotFoundError,
    TargetExistsError,
)
from mp4ds.plugins.info import brief
from mp4ds.plugins.reporting.report import ReportOptions, reports
from mp4ds.unpacking.unpack import unpack_each


@pytest.fixture
def drives(packed_bag: Path, tmp_path: Path) -> Path:
    """A folder of three datasets, and of other things."""
    folder = tmp_path / "drives"
    for name in ("b", "a", "deep/c", "deep/.d.part/new"):
        shutil.copytree(packed_bag, folder / name)
    (folder / "notes.txt").write_text("windy")
    (folder / "empty").mkdir()
    return folder


# ---------------------------------------------------------------- which


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (".", ["a", "b", "deep/c"]),
        (["b", "."], ["b", "a", "b", "deep/c"]),
        ("deep", ["deep/c"]),
        ("a", ["a"]),
        ("a/dataset.yaml", ["a"]),
        ("*", ["a", "b", "deep/c"]),
        ("[ab]", ["a", "b"]),
        (["a/camera_image_raw.yaml"], ["a/camera_image_raw.yaml"]),
    ],
)
def test_what_is_meant(paths: str | list[str], names: list[str], drives: Path) -> None:
    given = drives / paths if isinstance(paths, str) else [drives / path for path in paths]
    if names == ["a/camera_image_raw.yaml"]:
        sidecar = next(path for path in (drives / "a").glob("*.yaml") if path.stem != "dataset")
        assert datasets_in([sidecar]) == [sidecar]
        return
    found = datasets_in(given)
    assert [os.path.relpath(path, drives) for path in found] == names


def test_what_is_not_there(drives: Path) -> None:
    for path in ("nothing", "x*"):
        with pytest.raises(SourceNotFoundError):
            datasets_in(drives / path)
    for path in ("empty", "e*"):
        with pytest.raises(SourceError, match="dataset"):
            datasets_in(drives / path)


# ---------------------------------------------------------------- what is made of them


def test_all_are_unpacked(drives: Path, tmp_path: Path) -> None:
    summaries = unpack_each(drives, None, tmp_path / "out", jobs=2)
    assert [item.output.name for item in summaries] == ["a.bag", "b.bag", "c.bag"]
    assert len({path.read_bytes() for path in (tmp_path / "out").iterdir()}) == 1
    with pytest.raises(TargetExistsError):
        unpack_each(drives, None, tmp_path / "out")
    shutil.copytree(drives / "a", drives / "deep" / "a")
    with pytest.raises(OptionError, match="Two datasets would become"):
        unpack_each(drives, None, tmp_path / "more")
    assert not (tmp_path / "more").exists()


def test_the_table_of_all(drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = call("info", "drives")
    lines = done.out.splitlines()
    assert [line.split()[0] for line in lines] == ["dataset", "a", "b", "deep/c", "3"]
    rows = json.loads(call("info", "drives", "--json").out)
    one = brief(drives / "a")
    assert [row["messages"] for row in rows] == [one.messages] * 3
    assert re.search(rf" {3 * one.messages} ", lines[-1])
    assert call("info", "drives", "--checksums").code == 2


def test_all_are_validated(drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = call("validate", "drives")
    assert (done.code, done.out) == (
        0,
        "3 datasets: no problems; frames were not decoded (--deep does)\n",
    )
    (drives / "a" / "messages.mcap").unlink()
    done = call("validate", "drives/a", "drives/b", "-j", "2")
    assert done.code == 1
    assert "2 datasets: 1 problem in 1 of them" in done.out
    rows = json.loads(call("validate", "drives", "--json").out)
    assert [len(row["problems"]) for row in rows] == [1, 0, 0]


def test_the_page_of_all(drives: Path, tmp_path: Path) -> None:
    (drives / "b" / "dataset.yaml").write_text("mp4ds: no\n")
    summary = reports(drives, tmp_path / "page", jobs=2)
    assert summary.datasets == 3
    assert len(summary.problems) == 1
    page = summary.index.read_text()
    links = re.findall(r'href="([^"]+/index.html)"', page)
    assert links == [f"../drives/{name}/index.html" for name in ("a", "b", "deep/c")]
    assert [(tmp_path / "page" / link).exists() for link in links] == [True, False, True]
    pictures = re.findall(r'src="([^"]+)"', page)
    assert len(pictures) == 2
    assert all((tmp_path / "page" / picture).exists() for picture in pictures)
    assert "not shown" in page
    assert reports(drives, tmp_path / "page").datasets == 3  # replaces its own
    with pytest.raises(OptionError, match="`output`"):
        reports(drives, tmp_path / "page", ReportOptions(output=tmp_path / "one"))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "index.html").write_text("mine")
    with pytest.raises(TargetExistsError):
        reports(drives, tmp_path / "mine")
