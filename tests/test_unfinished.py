"""What a recorder left unfinished: its folder may be damaged, hostile, or somebody else's."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from commands import Result, call, tree
from compare import compare
from mp4ds.errors import WriteError
from mp4ds.files.sources import RECORDING_NAME
from mp4ds.plugins.recording import spool
from record_scenes import PlayedNode, fail_to_pack, recorded
from scenes import scene
from sources import SOURCES

FRAMES = 12
PIECE, PART = "000002.mcap", "000001"


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a recorder leaves that could not finish, beside what was recorded; not to be changed."""
    folder = tmp_path_factory.mktemp("left")
    made = replace(scene("bayer_rggb8", frames=FRAMES), silent={})
    paths = SOURCES["bag-none"](folder / "source", made)
    (folder / "robot" / "drives").mkdir(parents=True)
    with pytest.MonkeyPatch.context() as tired:
        tired.setattr(spool, "WINDOW_NS", 100_000_000)
        fail_to_pack(2, "the disk is tired", tired)
        with pytest.raises(WriteError, match="the disk is tired"):
            recorded(PlayedNode(paths), folder / "robot" / "drives" / "drive")
    return folder


@pytest.fixture
def unfinished(left: Path, tmp_path: Path) -> Path:
    """The folder of a recorder that could not finish, in a folder of its own."""
    shutil.copytree(left, tmp_path, dirs_exist_ok=True)
    folder = tmp_path / "robot" / "drives" / "drive.recording"
    names = {path.name for path in folder.iterdir()}
    assert {"000000", PART, PIECE, "000003.mcap", RECORDING_NAME} <= names
    return folder


def salvaged(folder: Path, *options: str) -> Result:
    return call("pack", "--salvage", folder, "-o", folder.with_name("made"), *options)


def assert_refused(folder: Path, told: str) -> None:
    """In one sentence, with nothing made, changed or removed."""
    before = tree(folder.parents[1])
    result = salvaged(folder)
    assert result.code == 2, result
    assert told in result.err
    assert result.err.count("\n") == 1
    assert tree(folder.parents[1]) == before


# ---------------------------------------------------------------- what a recorder does


def test_a_recorder_leaves_what_it_finds(unfinished: Path) -> None:
    """It names the folder and the command, and records; nothing is recovered or removed."""
    (unfinished / "notes.txt").write_text("mine")
    before = tree(unfinished.parent)
    node = PlayedNode([*(unfinished.parents[2] / "source").iterdir()])
    summary = recorded(node, unfinished.parent / "next")
    (warning,) = summary.warnings
    assert f"mp4ds pack --salvage {unfinished} -o {unfinished.parent / 'drive'}" in warning
    shutil.rmtree(unfinished.parent / "next")
    assert tree(unfinished.parent) == before


def test_a_recorder_leaves_files_of_the_user(tmp_path: Path) -> None:
    """What somebody put into its folder while it was recording stays when it is done."""
    made = replace(scene("mono8", frames=4), silent={})
    paths = SOURCES["bag-none"](tmp_path / "source", made)

    def put(number: int) -> None:
        (tmp_path / "live.recording" / "notes.txt").write_text("mine")

    recorded(PlayedNode(paths, before=put), tmp_path / "live")
    assert mp4ds.validate(tmp_path / "live", deep=True) == []
    assert [path.name for path in (tmp_path / "live.recording").iterdir()] == ["notes.txt"]


# ---------------------------------------------------------------- damage


def test_everything_is_recovered(unfinished: Path) -> None:
    result = salvaged(unfinished)
    assert result.code == 0, result
    assert "lost" not in result.out
    made = unfinished.with_name("made")
    assert mp4ds.validate(made, deep=True) == []
    mp4ds.unpack(made, None, unfinished.with_name("again.bag"))
    source = [*(unfinished.parents[2] / "source").iterdir()]
    assert compare(source, unfinished.with_name("again.bag")) == []
    with mp4ds.open(made) as dataset:
        assert len(dataset.streams) == 1


def test_zeros_in_a_piece(unfinished: Path) -> None:
    """The other pieces are recovered, what is lost of this one is counted."""
    path = unfinished / PIECE
    data = path.read_bytes()
    path.write_bytes(data[:2000] + bytes(512) + data[2512:])
    before = tree(unfinished)
    result = salvaged(unfinished)
    assert result.code == 0, result
    assert f"lost: {PIECE} at byte " in result.out
    assert tree(unfinished) == before
    assert mp4ds.validate(unfinished.with_name("made"), deep=True) == []
    with mp4ds.open(unfinished.with_name("made")) as dataset:
        assert 0 < len(dataset["/cam/image_raw"]) < FRAMES


def test_zeros_in_the_summary_of_a_piece(unfinished: Path) -> None:
    """What it repeats is in the chunks: a channel of it without a name is none."""
    path = unfinished / PIECE
    data = path.read_bytes()
    start = data.rindex(b"/cam/image_raw") - 8  # of the fields of a channel
    size = int.from_bytes(data[start - 8 : start], "little")
    path.write_bytes(data[:start] + bytes(size) + data[start + size :])
    result = salvaged(unfinished)
    assert result.code == 0, result
    assert f"lost: {PIECE} at byte " in result.out
    assert "its summary is damaged" in result.out
    mp4ds.unpack(unfinished.with_name("made"), None, unfinished.with_name("again.bag"))
    source = [*(unfinished.parents[2] / "source").iterdir()]
    assert compare(source, unfinished.with_name("again.bag")) == []


def test_a_piece_that_is_missing(unfinished: Path) -> None:
    """It is counted as lost, as is what only a name that nobody else has given leads to."""
    (unfinished / PIECE).unlink()
    result = salvaged(unfinished)
    assert result.code == 0, result
    assert "lost: 000002.mcap: this piece of the recording is missing" in result.out


def test_a_part_that_is_damaged(unfinished: Path) -> None:
    (video,) = (unfinished / PART).glob("*.mp4")
    data = video.read_bytes()
    video.write_bytes(data[:-20] + bytes(20))
    assert_refused(unfinished, PART)
    assert_refused(unfinished, "]. Move that part out of the folder to recover the others.\n")
    shutil.rmtree(unfinished / PART)
    (unfinished / PART).mkdir()
    assert_refused(unfinished, PART)


def test_files_of_the_user(unfinished: Path) -> None:
    """They stay, are not copied, and need not be readable."""
    (unfinished / "notes.txt").write_text("mine")
    (unfinished / "latest").symlink_to("nowhere")
    (unfinished / "photos").mkdir()
    (unfinished / "1.mcap").write_text("not a name that a recorder gives")
    before = tree(unfinished)
    result = salvaged(unfinished)
    assert result.code == 0
    assert "lost" not in result.out
    assert tree(unfinished) == before
    made = {path.name for path in unfinished.with_name("made").iterdir()}
    assert not {"notes.txt", "latest", "photos", "1.mcap"} & made


# ---------------------------------------------------------------- hostility


@pytest.mark.parametrize("name", [PIECE, PART, f"{PART}/messages.mcap", RECORDING_NAME])
def test_files_that_are_links(name: str, unfinished: Path) -> None:
    path, other = unfinished / name, unfinished.with_name("other")
    path.rename(other)
    path.symlink_to(other)
    assert_refused(unfinished, f"{name}: is a symbolic link")


@pytest.mark.parametrize("name", [PIECE, f"{PART}/more"])
def test_folders_where_files_are_due(name: str, unfinished: Path) -> None:
    (unfinished / name).unlink(missing_ok=True)
    (unfinished / name).mkdir()
    assert_refused(unfinished, f"{name}: is not a regular file")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_what_belongs_to_others(unfinished: Path) -> None:
    """As root, too."""
    for name in (PIECE, PART, f"{PART}/messages.mcap", RECORDING_NAME, "."):
        path = unfinished / name
        os.chown(path, 1234, -1)
        assert_refused(unfinished, "belongs to another user")
        os.chown(path, os.geteuid(), -1)
    assert salvaged(unfinished).code == 0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("format", value) for value in ("mcap2", "", 3, None)),
        *(("profile", value) for value in ("ros3", "../x", 1, None)),
        *(("quality", value) for value in ("best", "crf=99", 3, None)),
        *(("codec", value) for value in ("../../bin/sh", "av1", "", 3, [])),
        *(("preset", value) for value in ("../x", "veryslowest", 3, {})),
        *(("gop", value) for value in (-1, 0, 2**63, 10**400, 1.5, "1", True)),
        ("more", 1),
    ],
)
def test_settings_that_make_no_sense(name: str, value: Any, unfinished: Path) -> None:
    settings = json.loads((unfinished / RECORDING_NAME).read_text())
    settings[name] = value
    (unfinished / RECORDING_NAME).write_text(json.dumps(settings))
    assert_refused(unfinished, "")


@pytest.mark.parametrize("text", ["", "{", "[]", "\0" * 100, "[" * 100_000])
def test_settings_that_are_none(text: str, unfinished: Path) -> None:
    (unfinished / RECORDING_NAME).write_text(text)
    assert_refused(unfinished, f"{RECORDING_NAME}: is damaged")
