"""Damaged files of every kind are read, or refused in a sentence; see `benchmarks/fuzz.py`."""

from __future__ import annotations

import importlib.util
import random
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from mp4ds import Mp4dsError
from mp4ds.bags import open_sources

PER_KIND = 90
KNOWN = "RecursionError"
"""What metadata.yaml with a list that holds itself leads to; see the last test."""


def _load() -> ModuleType:
    path = Path(__file__).parents[1] / "benchmarks" / "fuzz.py"
    spec = importlib.util.spec_from_file_location("fuzz", path)
    if spec is None or spec.loader is None:
        raise ImportError(path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz"] = module  # where its dataclasses look for their annotations
    spec.loader.exec_module(module)
    return module


fuzz = _load()


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mp4ds.packing._engine", None)  # the making of work folders replaces it
        yield fuzz.make_kinds(tmp_path_factory.mktemp("good"))


def test_damaged_files_are_read_or_refused(kinds: dict[str, Any], tmp_path: Path) -> None:
    around = tmp_path / "around"
    around.mkdir()
    counts, findings = fuzz.run(
        kinds, count=PER_KIND * len(kinds), seed=7, seconds=120.0, around=around
    )
    told = [f"{found.seed}: {found.what}" for found, _ in findings]
    assert [text for text in told if not ("metadata" in text and KNOWN in text)] == []
    assert set(counts) == set(kinds)
    for name, results in counts.items():
        assert sum(results.values()) == PER_KIND, name
        assert results["read"], name
    assert sum(results["refused"] for results in counts.values()) > PER_KIND * len(kinds) // 4


def test_a_good_file_of_each_kind_is_read(
    kinds: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzz, "damaged", lambda data, _: data)
    for name, kind in kinds.items():
        assert fuzz.try_input(kind, "0", tmp_path) == ("read", ""), name


def test_an_input_is_made_again_by_its_seed(kinds: dict[str, Any], tmp_path: Path) -> None:
    made = []
    for folder in (tmp_path / "first", tmp_path / "second"):
        folder.mkdir()
        fuzz.make_input(kinds["sidecar"], "1:sidecar:5", folder)
        made.append(next(folder.rglob("cam*.yaml")).read_bytes())
    assert made[0] == made[1]


def test_every_injury_changes_something() -> None:
    data = bytes(range(1, 200)) + b"\nkey: value\nop=\x02conn=abcd"
    for injury in fuzz._INJURIES:
        assert any(injury(data, random.Random(seed)) != data for seed in range(20))


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (lambda *_: [][0], "IndexError: list index out of range"),
        (lambda *_: bytearray(2 * fuzz.MEMORY), "MemoryError: "),
        (lambda *_: __import__("os")._exit(6), "its process died with status 1536"),
        (lambda folder, _: (folder.parent / "out").touch(), "wrote beside its folder"),
        (lambda *_: __import__("time").sleep(30), "_TookTooLongError: "),
    ],
    ids=["error", "memory", "death", "write", "hang"],
)
def test_what_may_not_happen_is_found(
    harm: Any, told: str, kinds: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzz, "SECONDS", 1)
    kind = fuzz.Kind(kinds["bag-none"].folder, kinds["bag-none"].victims, harm)
    _, findings = fuzz.run({"bad": kind}, count=1, seed=0, seconds=60.0, around=tmp_path)
    assert [found.what.partition("\n")[0] for found, _ in findings] == [told]


def test_metadata_with_a_list_that_holds_itself(kinds: dict[str, Any], tmp_path: Path) -> None:
    kind = kinds["rosbag2-mcap-v9-metadata"]
    shutil.copytree(kind.folder, tmp_path, dirs_exist_ok=True)
    path = tmp_path / kind.victims[0]
    text = path.read_text()
    path.write_text(re.sub(r"nsec: .*", "nsec: &a [*a]", text, count=1))
    with pytest.raises(Mp4dsError):
        open_sources([path.parent])
