"""The conformance suite: mp4ds passes it, its runner finds what is wrong, it covers the format."""

from __future__ import annotations

import hashlib
import json
import re
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

import conformance_dump
import mp4ds
import run
from commands import program
from mp4ds.format.fields import FORMAT_VERSION, Body
from mp4ds.format.models import VIDEO_CODECS
from mp4ds.format.sidecars import MIGRATIONS
from mp4ds.messages.layouts import LAYOUTS
from mp4ds.messages.serializations import WIRES

SUITE = Path(__file__).parents[1] / "conformance"
CASES = SUITE / "cases"
DUMP = SUITE.parent / "tools" / "conformance_dump.py"
LISTED: dict[str, Any] = json.loads((CASES / "cases.json").read_text())
Case = dict[str, Any]


def expected(case: Case) -> Case:
    found: Case = json.loads((CASES / case["expected"]).read_text())
    return found


def streams() -> Iterator[Case]:
    for case in LISTED["cases"]:
        if "expected" in case:
            yield from expected(case)["streams"]


# ---------------------------------------------------------------- readers


@pytest.mark.parametrize("case", LISTED["cases"], ids=lambda case: case["path"])
def test_mp4ds_reads_what_is_expected(case: Case) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of newer minor versions
        found = json.loads(conformance_dump.as_json(conformance_dump.dump(CASES / case["path"])))
    assert found == (expected(case) if "expected" in case else {"problems": case["problems"]})


DATASETS = [case for case in LISTED["cases"] if case["path"].startswith("datasets/")]


@pytest.mark.parametrize("case", DATASETS, ids=lambda case: case["path"])
def test_datasets_of_all_versions_are_unpacked(case: Case, tmp_path: Path) -> None:
    """Their files are those of the versions that they say, and are never written again."""
    options = None if not case["path"].endswith("-alone") else mp4ds.UnpackOptions(quality="visual")
    mp4ds.unpack(CASES / case["path"], "mcap", tmp_path / "again.mcap", options)
    found = Counter[tuple[str, str]]()
    with (tmp_path / "again.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found[channel.topic, hashlib.sha256(message.data).hexdigest()] += 1
    made = expected(case)
    assert found.total() == int(made["manifest"]["messages"])
    for stream in made["streams"]:
        if stream["payloads"] and options is None:
            due = Counter((stream["topic"], payload) for payload in stream["payloads"])
            assert due <= found


def test_there_are_datasets_of_all_versions() -> None:
    texts = [(CASES / case["path"] / "dataset.yaml").read_text() for case in DATASETS]
    found = {re.findall('^mp4ds: "(.*)"$', text, re.MULTILINE)[0] for text in texts}
    assert found == {*MIGRATIONS, FORMAT_VERSION}


@pytest.mark.parametrize(
    ("path", "code", "said"),
    [
        ("datasets/before-1970", 0, '"problems": []'),
        ("sidecars/invalid/column-short.yaml", 1, '"at": "columns.stamp"'),
        ("datasets", 2, "is not a dataset"),
    ],
)
def test_the_command(path: str, code: int, said: str) -> None:
    done = program(sys.executable, DUMP, CASES / path, code=code)
    assert said in (done.err if code == 2 else done.out)
    assert "Traceback" not in done.err
    if code == 0:
        assert done.out == (CASES / path / "expected.json").read_text()


# ---------------------------------------------------------------- the runner

(BEFORE,) = (case for case in LISTED["cases"] if case["path"] == "datasets/before-1970")


@pytest.mark.parametrize(
    ("change", "is_right"),
    [
        ("", True),
        ("del found['streams'][0]['planes']", True),
        ("found['streams'][0]['columns']['stamp'][1] = '0'", False),
        ("found['streams'][0]['frames'] = True", False),
        ("found['streams'][0]['columns']['stamp'].pop()", False),
        ("found['streams'] = []", False),
        ("found['streams'][0]['planes']['sha256'].reverse()", False),
        ("found['more'] = 1", False),
        ("found = None", False),
    ],
)
def test_the_runner_compares_every_value(change: str, is_right: bool) -> None:
    names = {"found": expected(BEFORE)}
    exec(change, names)
    left_out: set[str] = set()
    assert (run.wrong_of(BEFORE, names["found"], False, left_out) == []) == is_right
    assert left_out == ({"streams.planes"} if change.startswith("del") else set())


@pytest.mark.parametrize(
    ("only", "code"), [("datasets/b", 0), ("sidecars/invalid/schema-twice", 1)]
)
def test_the_runner_asks_a_command(only: str, code: int) -> None:
    command = (sys.executable, SUITE / "reader.py", "{file}")
    done = program(sys.executable, SUITE / "run.py", "--only", only, "--", *command, code=code)
    assert done.out.endswith(f"{0 if code else 2} of {1 if code else 2} cases passed\n")
    assert ("FAILED sidecars/invalid/schema-twice.yaml" in done.out) == bool(code)


# ---------------------------------------------------------------- what it covers


def test_every_problem_code_has_a_case() -> None:
    registry = (SUITE.parent / "spec" / "registry.md").read_text()
    section = registry.split("\n## Problem codes\n", 1)[1].split("\n## ", 1)[0]
    codes = set(re.findall(r"^\| `([a-z-]+)` \|", section, re.MULTILINE))
    found = {p["code"] for case in LISTED["cases"] for p in case.get("problems", ())}
    assert codes
    assert found == codes


def test_the_datasets_cover_the_format() -> None:
    seen = list(streams())
    videos = [*seen, *(stream["view"] for stream in seen if "view" in stream)]
    assert {video["layout"] for video in videos} == set(LAYOUTS)
    assert {video["codec"] for video in videos} == set(VIDEO_CODECS)
    assert {stream["body"] for stream in seen} == set(Body.__args__)  # type: ignore[attr-defined]
    assert {stream["wire"] for stream in seen} == set(WIRES)
    profiles = {"lossless", "visual", "crf=30", "crf=1", "psnr=41"}
    assert {stream["profile"] for stream in seen} == profiles
    assert any(stream["camera_info"] for stream in seen)
    assert any(stream["image"]["is_bigendian"] for stream in seen)
    stamps = [list(map(int, stream["columns"]["stamp"])) for stream in seen]
    assert any(0 in times for times in stamps)
    assert any(len(set(times)) < len(times) for times in stamps)
    assert any(times != sorted(times) for times in stamps)
    assert any(min(times) < 0 for times in stamps)
    orders = [
        channel["files"]
        for case in LISTED["cases"]
        if "order" in (found := expected(case) if "expected" in case else {})
        for channel in found["order"]
    ]
    assert any(len(set(files) - {"messages.mcap"}) > 1 for files in orders)
    assert any("messages.mcap" in files for files in orders)


def test_every_case_is_listed() -> None:
    assert LISTED["format"] == FORMAT_VERSION
    paths = [case["path"] for case in LISTED["cases"]]
    files = [
        path.relative_to(CASES).as_posix()
        for path in (
            *(CASES / "datasets").iterdir(),
            *(CASES / "broken").iterdir(),
            *(CASES / "sidecars").rglob("*.yaml"),
        )
    ]
    assert sorted(paths) == sorted(files)
    readme = (SUITE / "README.md").read_text()
    parts = set(re.findall(r"^\| `([a-z0-9-]+)` \| ", readme, re.MULTILINE))
    assert {case["part"] for case in LISTED["cases"]} <= parts
    assert sum(path.stat().st_size for path in CASES.rglob("*") if path.is_file()) < 2_600_000
