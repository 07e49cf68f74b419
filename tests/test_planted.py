"""A work folder that somebody else has put beside the dataset: refused, and left as it is.

What is planted is real: the folder of a pack that was interrupted, changed as an attacker would.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from commands import call, refused, tree
from in_parts import InlineExecutor, facts, leftovers, use
from mp4ds.errors import PartsFailedError
from mp4ds.packing.options import PackOptions
from sources import SOURCES, scene

IN_PARTS = PackOptions(window=3, codec="h264")
WORK = ".out.mp4ds-part"


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    (path,) = SOURCES["bag-none"](tmp_path / "source", scene("bayer_rggb8", frames=9))
    return path


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A home with what must not be lost."""
    for name in (".ssh/id_ed25519", ".config/app", "thesis.tex", "00001/thesis.tex"):
        path = tmp_path / "victim" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("years of work")
    return tmp_path / "victim"


@pytest.fixture
def work(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What an interrupted pack has left."""
    with monkeypatch.context() as patch:
        use(patch, InlineExecutor(lambda n: n == "00002"))
        with pytest.raises(PartsFailedError):
            mp4ds.pack(bag, tmp_path / "out", IN_PARTS)
    return tmp_path / WORK


@pytest.fixture(autouse=True)
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, InlineExecutor())


def pack(bag: Path, tmp_path: Path, *more: str) -> Any:
    options = ("--codec", "h264", "--window", "3")
    return call("pack", bag, "-o", tmp_path / "out", *options, *more)


@pytest.mark.parametrize("more", [(), ("--restart",), ("--force",), ("--shard", "1/2")])
@pytest.mark.parametrize("link", [WORK, f"{WORK}/00001", f"{WORK}/plan.json", f"{WORK}/.ssh"])
def test_links_lead_nowhere(
    link: str, more: tuple[str, ...], bag: Path, victim: Path, tmp_path: Path
) -> None:
    """Neither is anything of their targets removed, nor is anything written there."""
    (tmp_path / link).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / link).symlink_to(victim)
    before = tree(tmp_path)
    refused(pack(bag, tmp_path, *more), 2, WORK)
    after = tree(tmp_path)
    for made in (f"{WORK}/lock",):
        if made not in before:
            after.pop(made, None)
    assert after == before


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives away")
@pytest.mark.parametrize("more", [(), ("--restart",), ("--shard", "1/2")])
@pytest.mark.parametrize("name", [".", "00001", "plan.json", "00001/part.json"])
def test_what_another_has_put_into_it_is_refused(
    name: str, more: tuple[str, ...], bag: Path, work: Path, tmp_path: Path
) -> None:
    os.chown(work / name, 12345, -1)
    before = tree(tmp_path)
    what = "belongs to another user" if name == "." else "did not make"
    refused(pack(bag, tmp_path, *more), 2, what)
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    "stranger",
    ["notes.txt", "parts/00001/x", ".config/app", "00001.bak/x", "all/../x", "00001\n/x"],
)
def test_strangers_in_it_are_kept(stranger: str, bag: Path, work: Path, tmp_path: Path) -> None:
    (work / "all").mkdir()
    (work / stranger).parent.mkdir(parents=True, exist_ok=True)
    (work / stranger).write_text("mine")
    before = tree(tmp_path)
    refused(pack(bag, tmp_path), 2, "holds 1 item", "did not make")
    refused(pack(bag, tmp_path, "--restart"), 2, "holds 1 item", "did not make")
    assert tree(tmp_path) == before


@pytest.mark.parametrize("kind", ["fifo", "hole"])
def test_other_kinds_of_files_are_refused(kind: str, bag: Path, work: Path, tmp_path: Path) -> None:
    (work / "plan.json").unlink()
    if kind == "fifo":
        os.mkfifo(work / "plan.json")
    else:
        (work / "plan.json").mkdir()
    refused(pack(bag, tmp_path), 2, "plan.json", "is not a file")


def test_a_copy_is_not_taken_for_what_was_begun_here(bag: Path, work: Path, tmp_path: Path) -> None:
    """Its parts may hold other messages; --restart begins anew, on the same machine."""
    work.rename(tmp_path / "moved")
    shutil.copytree(tmp_path / "moved", work)
    refused(pack(bag, tmp_path), 2, "was started elsewhere", "--restart")
    assert pack(bag, tmp_path, "--restart").code == 0
    shutil.rmtree(tmp_path / "moved")
    assert mp4ds.validate(tmp_path / "out", deep=True) == []
    assert leftovers(tmp_path) == []


PLANTED: dict[str, Callable[[dict[str, Any]], object]] = {
    "nothing": dict.clear,
    "paths": lambda note: note.update(paths=7),
    "sources": lambda note: note.update(sources=[]),
    "source": lambda note: note["sources"][0].update(path=[]),
    "size": lambda note: note["sources"][0].update(size=7),
    "tools": lambda note: note.update(tools=["mp4ds"]),
    "options": lambda note: note["options"].pop("salvage"),
    "option": lambda note: note["options"].update(salvage=True),
    "decisions": lambda note: note["decisions"][0].pop(),
    "inode": lambda note: note.update(inode="x"),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("kind", PLANTED)
def test_a_note_of_another_plan_is_refused(
    kind: str, shared: bool, bag: Path, work: Path, tmp_path: Path
) -> None:
    """Also where machines share the folder, so that its inode is not compared."""
    path = work / "plan.json"
    note = json.loads(path.read_bytes())
    PLANTED[kind](note)
    path.write_text(json.dumps(note))
    before = tree(tmp_path)
    refused(pack(bag, tmp_path, *(["--shard", "1/1"] * shared)), 2, "restart")
    assert tree(tmp_path) == before


def test_files_that_a_note_names_are_not_read(bag: Path, work: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")  # reading it would wait forever
    path = work / "plan.json"
    note = json.loads(path.read_bytes())
    note["sources"][0]["path"] = str(tmp_path / "fifo")
    path.write_text(json.dumps(note))
    refused(pack(bag, tmp_path), 2, "consists of different files")


@pytest.mark.parametrize(
    "change",
    [
        dict.clear,
        lambda facts: facts.update(topics=3),
        lambda facts: facts["topics"].update({"/cam/image_raw": ["x", 1]}),
        lambda facts: facts["topics"].update({"/cam/image_raw": [28, 1], "/none": [1, 1]}),
        lambda facts: facts.update(notes=7),
        lambda facts: facts.update(skipped=0.5),
    ],
)
def test_facts_that_were_planted_are_no_part(
    change: Callable[[dict[str, Any]], object], bag: Path, work: Path, tmp_path: Path
) -> None:
    """It is made anew; numbers of messages are not taken from it."""
    path = work / "00001" / "part.json"
    facts_of_part = json.loads(path.read_bytes())
    change(facts_of_part)
    path.write_text(json.dumps(facts_of_part))
    assert pack(bag, tmp_path).code == 0
    mp4ds.pack(bag, tmp_path / "whole", PackOptions(codec="h264"))
    assert facts(tmp_path / "out") == facts(tmp_path / "whole")
