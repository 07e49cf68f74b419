"""What a recorder left unfinished: its folder may be damaged, hostile, or somebody else's."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import xxhash

import mp4ds
from mp4ds.errors import RecordError
from mp4ds.files.sources import JOURNAL_NAME
from record_scenes import PlayedSource, recorded
from scenes import scene
from sources import SOURCES
from test_bad_input import Result, call, tree

Compare = Callable[..., list[str]]
VIDEO = "cam_image_raw"
FRAMES = 12


@pytest.fixture
def unfinished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a recorder that could not finish, in a folder of its own."""
    monkeypatch.setattr("mp4ds.cli.output._quiet", False)
    (tmp_path / "source").mkdir()
    made = replace(scene("bayer_rggb8", frames=FRAMES), silent={})
    paths = SOURCES["bag-none"](tmp_path / "source", made)
    place = tmp_path / "robot" / "drives"
    place.mkdir(parents=True)

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr("mp4ds.plugins.recording.record.write_manifest", refuse)
        with pytest.raises(RecordError, match="No space left"):
            recorded(PlayedSource(paths), place / "drive")
    return place / "drive.recording"


def salvaged(folder: Path, *options: str) -> Result:
    return call("pack", "--salvage", folder, "-o", folder.with_name("made"), *options)


def lines_of(folder: Path) -> list[Any]:
    """What the lines of its journal say."""
    return [json.loads(line[9:]) for line in (folder / JOURNAL_NAME).read_bytes().splitlines()]


def write_lines(folder: Path, lines: list[Any]) -> None:
    """Write a journal, with checksums that are right."""
    texts = (json.dumps(line, separators=(",", ":")).encode() for line in lines)
    data = b"".join(b"%b %b\n" % (xxhash.xxh32_hexdigest(t).encode(), t) for t in texts)
    (folder / JOURNAL_NAME).write_bytes(data)


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
    source = PlayedSource([*(unfinished.parents[2] / "source").iterdir()])
    summary = recorded(source, unfinished.parent / "next")
    (warning,) = summary.warnings
    assert f"mp4ds pack --salvage {unfinished} -o {unfinished.parent / 'drive'}" in warning
    shutil.rmtree(unfinished.parent / "next")
    assert tree(unfinished.parent) == before


# ---------------------------------------------------------------- damage


def test_zeros_in_the_journal(unfinished: Path, compare: Compare) -> None:
    """What comes before them is recovered, what comes after is counted as lost."""
    journal = unfinished / JOURNAL_NAME
    data = journal.read_bytes()
    begin = [match.start() for match in re.finditer(rb'\["frame"', data)][FRAMES // 2]
    journal.write_bytes(data[:begin] + bytes(512) + data[begin + 512 :])
    (unfinished / "notes.txt").write_text("mine")
    before = tree(unfinished)
    result = salvaged(unfinished)
    assert result.code == 0, result
    assert f"lost: {JOURNAL_NAME} at byte " in result.out
    assert tree(unfinished) == before
    assert mp4ds.validate(unfinished.with_name("made"), deep=True) == []
    with mp4ds.open(unfinished.with_name("made")) as dataset:
        assert 0 < len(dataset["/cam/image_raw"]) < FRAMES


def test_files_of_the_user(unfinished: Path) -> None:
    """They stay, are not copied, and need not be readable."""
    (unfinished / "notes.txt").write_text("mine")
    (unfinished / "latest").symlink_to("nowhere")
    (unfinished / "photos").mkdir()
    before = tree(unfinished)
    assert salvaged(unfinished).code == 0
    assert tree(unfinished) == before
    made = {path.name for path in unfinished.with_name("made").iterdir()}
    assert not {"notes.txt", "latest", "photos"} & made


# ---------------------------------------------------------------- hostility


@pytest.mark.parametrize(
    "stem",
    [
        *("../../victim", "../victim", "/tmp/victim", "a/b", "..", "", ".hidden", "a\0b", "a\nb"),
        *("messages", "dataset", "nul", "x" * 300),
    ],
)
def test_names_of_streams(stem: str, unfinished: Path) -> None:
    """One that could lead out of the folder, or to another file of the dataset, is refused."""
    stem = stem.replace("/tmp", str(unfinished.parents[1]))
    victims = [unfinished.parents[1] / "victim.mp4", unfinished.parent / "victim.mp4"]
    for victim in victims:
        shutil.copy(unfinished / f"{VIDEO}.mp4", victim)
    lines = lines_of(unfinished)
    write_lines(unfinished, [[stem if v == VIDEO else v for v in line] for line in lines])
    assert_refused(unfinished, "journal.jsonl: is damaged")
    write_lines(unfinished, lines)


def test_two_streams_of_one_name(unfinished: Path) -> None:
    lines = lines_of(unfinished)
    (stream,) = (line for line in lines if line[0] == "stream")
    stream = [stream[0], VIDEO.upper(), *stream[2:]]
    write_lines(unfinished, [*lines, stream])
    assert_refused(unfinished, "journal.jsonl: is damaged")


@pytest.mark.parametrize("name", [f"{VIDEO}.mp4", "messages.mcap", JOURNAL_NAME])
def test_files_that_are_links(name: str, unfinished: Path) -> None:
    path, other = unfinished / name, unfinished.with_name("other")
    path.rename(other)
    path.symlink_to(other)
    assert_refused(unfinished, f"{name}: is a symbolic link")
    path.unlink()
    other.rename(path)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_what_belongs_to_others(unfinished: Path) -> None:
    """As root, too."""
    names = [f"{VIDEO}.mp4", "messages.mcap", JOURNAL_NAME, "."]
    for name in names:
        path = unfinished / name
        os.chown(path, 1234, -1)
        assert_refused(unfinished, "belongs to another user")
        os.chown(path, os.geteuid(), -1)
    assert salvaged(unfinished).code == 0


def hostile(lines: list[Any]) -> Iterator[tuple[str, list[Any]]]:
    """Journals in which one value of the last line of a kind is another."""
    values: tuple[Any, ...] = (-1, 0, 3, 2**31, 2**53, 2**63 - 1, 2**63, -(2**63), 2**64, 10**400)
    values += (1.5, True, None, "", "x", "../x", [], {}, [[1, 2]], {"codec": "h264"})
    places = {line[0]: number for number, line in enumerate(lines)}
    for kind, number in places.items():
        for place in range(len(lines[number])):
            for value in values:
                changed = [*lines[number]]
                changed[place] = value
                name = f"{kind} {place} {str(value)[:30]}"
                yield name, [*lines[:number], changed, *lines[number + 1 :]]
        yield f"{kind} twice", [*lines[: number + 1], *lines[number:]]
        yield f"no {kind}", [*lines[:number], *lines[number + 1 :]]


@pytest.mark.slow
def test_every_value_of_the_journal(unfinished: Path) -> None:
    """Is refused in one sentence, or gives a dataset that is valid."""
    lines, made = lines_of(unfinished), unfinished.with_name("made")
    lines = [line for line in lines if line[0] != "frame" or line[9] < 3]
    seen, failed = set(), {}
    for name, changed in hostile(lines):
        write_lines(unfinished, changed)
        before = tree(unfinished.parents[1])
        result = salvaged(unfinished)
        seen.add(result.code)
        if result.code == 0:
            problems = list(map(str, mp4ds.validate(made)))
            shutil.rmtree(made)
        else:
            problems = [] if result.code == 2 and result.err.count("\n") == 1 else [result.err]
        if tree(unfinished.parents[1]) != before:
            problems.append("files changed")
        if problems:
            failed[name] = problems
    assert failed == {}, json.dumps(failed, indent=1)
    assert seen == {0, 2}
