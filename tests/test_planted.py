"""A work folder that somebody else has put beside the dataset: refused, and left as it is.

What is planted is real: the folder of a pack that was interrupted, changed as an attacker would.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from commands import call, refused, tree
from in_parts import InlineEngine, facts, leftovers
from mp4ds.errors import PartsFailedError, TargetError
from mp4ds.packing.manifest import dump_kept, load_kept
from mp4ds.packing.options import PackOptions
from mp4ds.packing.pack import pack_share
from mp4ds.packing.workplace import Workplace
from mp4ds.video.codecs import lossless_codecs, recipe_for, remade
from sources import SOURCES, scene

IN_PARTS = PackOptions(window=3, codec="h264")
WORK = ".out.mp4ds-part"


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    (tmp_path / "source").mkdir()
    (path,) = SOURCES["bag-none"](tmp_path / "source", scene("bayer_rggb8", frames=9))
    return path


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A home with what must not be lost."""
    for name in (".ssh/id_ed25519", ".config/app", "thesis.tex", "parts/00001-0/thesis.tex"):
        path = tmp_path / "victim" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("years of work")
    return tmp_path / "victim"


@pytest.fixture
def work(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What an interrupted pack has left."""
    with monkeypatch.context() as patch:
        patch.setattr(
            "mp4ds.packing.pack._engine", lambda *_: InlineEngine(lambda n: n == "00002-0")
        )
        with pytest.raises(PartsFailedError):
            mp4ds.pack(bag, tmp_path / "out", IN_PARTS)
    return tmp_path / WORK


@pytest.fixture(autouse=True)
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mp4ds.packing.pack._engine", lambda *_: InlineEngine())


def pack(bag: Path, tmp_path: Path, *more: str) -> Any:
    options = ("--codec", "h264", "--window", "3")
    return call("pack", bag, "-o", tmp_path / "out", *options, *more)


@pytest.mark.parametrize("more", [(), ("--restart",), ("--force",), ("--shard", "1/2")])
@pytest.mark.parametrize("link", [WORK, f"{WORK}/parts", f"{WORK}/dataset", f"{WORK}/parts/.ssh"])
def test_links_lead_nowhere(
    link: str, more: tuple[str, ...], bag: Path, victim: Path, tmp_path: Path
) -> None:
    """Neither is anything of their targets removed, nor is anything written there."""
    (tmp_path / link).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / link).symlink_to(victim)
    before = tree(tmp_path)
    refused(pack(bag, tmp_path, *more), 2, WORK)
    after = tree(tmp_path)
    for made in (f"{WORK}/lock", f"{WORK}/parts"):
        if made not in before:
            after.pop(made, None)
    assert after == before


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives away")
@pytest.mark.parametrize("more", [(), ("--restart",), ("--shard", "1/2")])
@pytest.mark.parametrize("name", [".", "parts", "job.json", "parts/00001-0/part.json"])
def test_what_another_has_put_into_it_is_refused(
    name: str, more: tuple[str, ...], bag: Path, work: Path, tmp_path: Path
) -> None:
    os.chown(work / name, 12345, -1)
    before = tree(tmp_path)
    what = "belongs to another user" if name in (".", "parts") else "did not make"
    refused(pack(bag, tmp_path, *more), 2, what)
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    "stranger",
    ["notes.txt", "parts/notes.txt", "parts/.config/app", "parts/00001-0.bak/x", "parts/all/../x"],
)
def test_strangers_in_it_are_kept(stranger: str, bag: Path, work: Path, tmp_path: Path) -> None:
    (work / "parts" / "all").mkdir()
    (work / stranger).parent.mkdir(exist_ok=True)
    (work / stranger).write_text("mine")
    before = tree(tmp_path)
    refused(pack(bag, tmp_path), 2, "holds 1 item", "did not make")
    refused(pack(bag, tmp_path, "--restart"), 2, "holds 1 item", "did not make")
    assert tree(tmp_path) == before


@pytest.mark.parametrize("kind", ["fifo", "hole"])
def test_what_is_no_file_is_refused(kind: str, bag: Path, work: Path, tmp_path: Path) -> None:
    (work / "job.json").unlink()
    if kind == "fifo":
        os.mkfifo(work / "job.json")
    else:
        (work / "job.json").mkdir()
    refused(pack(bag, tmp_path), 2, "job.json", "is not a file")


def test_a_copy_is_not_taken_for_what_was_begun_here(bag: Path, work: Path, tmp_path: Path) -> None:
    """Its parts may hold other messages; --restart begins anew, on the same machine."""
    work.rename(tmp_path / "moved")
    shutil.copytree(tmp_path / "moved", work)
    refused(pack(bag, tmp_path), 2, "was started elsewhere", "--restart")
    assert pack(bag, tmp_path, "--restart").code == 0
    shutil.rmtree(tmp_path / "moved")
    assert mp4ds.validate(tmp_path / "out", deep=True) == []
    assert leftovers(tmp_path) == []


def test_machines_that_share_it_may_see_another_inode(
    bag: Path, work: Path, tmp_path: Path
) -> None:
    work.rename(tmp_path / "moved")
    shutil.copytree(tmp_path / "moved", work)
    shutil.rmtree(tmp_path / "moved")
    pack_share(bag, tmp_path / "out", (1, 1), IN_PARTS)
    mp4ds.pack(bag, tmp_path / "out", replace(IN_PARTS, join=True))
    mp4ds.pack(bag, tmp_path / "whole", PackOptions(codec="h264"))
    assert facts(tmp_path / "out") == facts(tmp_path / "whole")


def _set(*path: object) -> Callable[[Any], None]:
    *places, last, value = path

    def change(values: Any) -> None:
        for place in places:
            values = values[place]
        values[last] = value

    return change


def _plan(values: Any) -> dict[str, Any]:
    (decisions,) = values["survey"]["decisions"].values()
    plan: dict[str, Any] = decisions[0]["plans"][0]
    return plan


def _recipe(values: Any) -> dict[str, Any]:
    recipe: dict[str, Any] = _plan(values)["recipe"]
    return recipe


def _key(values: Any) -> dict[str, Any]:
    (decisions,) = values["survey"]["decisions"].values()
    key: dict[str, Any] = decisions[0]["key"]
    return key


PLANTED: dict[str, Callable[[Any], object]] = {
    "absolute": _set("tasks", 1, "name", "/VICTIM"),
    "above": _set("tasks", 1, "name", "../../victim"),
    "hidden": _set("tasks", 1, "name", ".ssh"),
    "newline": _set("tasks", 1, "name", "00001-0\n"),
    "number": _set("tasks", 1, "name", 7),
    "twice": _set("tasks", 1, "name", "00001-0"),
    "no source": _set("tasks", 0, "source", 9),
    "dump": lambda values: _recipe(values)["options"].update({"x264-params": "dump-yuv=VICTIM"}),
    "stats": lambda values: _recipe(values)["options"].update(stats="VICTIM"),
    "encoder": lambda values: _recipe(values).update(encoder="rawvideo"),
    "lossy": lambda values: _recipe(values)["options"].update(qp="30"),
    "profile": lambda values: _plan(values).update(profile={}),
    "threads": _set("threads", 10**9),
    "options": lambda values: values["options"].pop("salvage"),
    "work": _set("work", {"/cam": "x"}),
    "key": lambda values: _key(values).update(encoding=[]),
    "size": lambda values: _key(values).update(width="7"),
    "source": lambda values: values["sources"][0].update(path=[]),
    "nothing": lambda values: values.clear() or values.update(x=1),
}


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("kind", PLANTED)
def test_a_job_that_was_planted_is_refused(
    kind: str, shared: bool, bag: Path, work: Path, victim: Path, tmp_path: Path
) -> None:
    """Also where machines share the folder, so that its inode is not compared."""
    path = work / "job.json"
    values = load_kept(path.read_bytes())
    PLANTED[kind](values)
    text = json.dumps(values).replace("VICTIM", str(victim / "thesis.tex").lstrip("/"))
    path.write_bytes(dump_kept(json.loads(text)))
    before = tree(tmp_path)
    refused(pack(bag, tmp_path, *(["--shard", "1/1"] * shared)), 2, WORK, "--restart")
    assert tree(tmp_path) == before
    with pytest.raises(TargetError):
        Workplace(work).job(shared=True)  # as a worker reads it


def test_another_recording_in_a_planted_job_is_refused(
    bag: Path, work: Path, tmp_path: Path
) -> None:
    """The digest of another file would be in the manifest."""
    (tmp_path / "secret").write_text("x" * 100)
    job = Workplace(work).job(shared=False)
    assert job is not None
    other = type(job.sources[0]).of(tmp_path / "secret")
    path = work / "job.json"
    path.write_bytes(replace(job, sources=[other]).to_json())
    shutil.rmtree(work / "parts" / "source-0")
    result = pack(bag, tmp_path)
    refused(result, result.code, "consists of different files")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "change",
    [
        lambda record: record.update(streams=["../../../victim/thesis"]),
        lambda record: record.update(streams=["/etc/passwd"]),
        lambda record: record.update(files={"../../../victim/thesis.tex": 13}),
        lambda record: record.update(topics=[{"topic": "/cam"}]),
        lambda record: record["topics"][0].update(messages="x"),
        lambda record: record.update(topics=3),
        lambda record: record.update(span=3),
        lambda record: record.update(losses=[{"x": 1}]),
        lambda record: record.update(counts={"x": 1}),
        lambda record: record.update(transforms=[3]),
        lambda record: record.update(span=[0, 2**65]),
        lambda record: record["topics"][0].update(messages=record["topics"][0]["messages"] + 28),
        lambda record: record["topics"][0].update(frames=[]),
        lambda record: record["topics"][0].update(notes=7),
        lambda record: record.update(skipped=0.5),
        lambda record: record.update(left_out=3),
        lambda record: record["files"].pop("messages.mcap"),
    ],
)
def test_a_record_that_was_planted_is_no_part(
    change: Callable[[dict[str, Any]], object],
    bag: Path,
    work: Path,
    victim: Path,
    tmp_path: Path,
) -> None:
    """It is made anew, at once or by the next run."""
    path = work / "parts" / "00001-0" / "part.json"
    record = load_kept(path.read_bytes())
    change(record)
    path.write_bytes(dump_kept(record))
    before = tree(victim)
    first = pack(bag, tmp_path)
    if first.code:
        refused(first, 1, "damaged")
        assert pack(bag, tmp_path).code == 0
    mp4ds.pack(bag, tmp_path / "whole", PackOptions(codec="h264"))
    assert facts(tmp_path / "out") == facts(tmp_path / "whole")
    assert tree(victim) == before


def test_every_recipe_is_made_again() -> None:
    """Those that are planned come back from the file, whatever was asked for."""
    for pixel_format in ("gray", "gray12le", "rgb24", "yuv420p", "gbrp10le"):
        for codec in lossless_codecs(pixel_format):
            for preset in (None, *(["veryfast", "slow"] if codec != "ffv1" else [])):
                recipe = recipe_for(pixel_format, lossless=True, codec=codec, preset=preset)
                assert remade(pixel_format, json.loads(json.dumps(asdict(recipe)))) == recipe
    for codec in (None, "av1", "av1-10bit", "h264", "h265"):
        for crf in (1, 20, 40):
            for varied in (False, True):
                preset = "4" if codec in ("av1", "av1-10bit") else None
                recipe = recipe_for(
                    "yuv420p", lossless=False, codec=codec, crf=crf, preset=preset, varied=varied
                )
                assert remade("yuv420p", json.loads(json.dumps(asdict(recipe)))) == recipe
