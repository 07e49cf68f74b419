"""The conformance suite: mp4ds and a second reader pass it, and it covers the format."""

from __future__ import annotations

import ast
import contextlib
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import pytest

import mp4ds
from mp4ds import yamlio
from mp4ds.errors import FormatError
from mp4ds.format.fields import FORMAT_VERSION, Body
from mp4ds.format.models import VIDEO_CODECS
from mp4ds.messages.layouts import LAYOUTS
from mp4ds.messages.serializations import WIRES
from sources import load_tool
from waiting import WATCHDOG_S

SUITE = Path(__file__).parents[1] / "conformance"
CASES = SUITE / "cases"
DUMP = SUITE.parent / "tools" / "conformance_dump.py"
LISTED: dict[str, Any] = json.loads((CASES / "cases.json").read_text())
NOT_READ = "values,messages,version-0"
"""Parts that the second reader does not claim; README.md says the same."""

Case = dict[str, Any]


def ids(case: Case) -> str:
    return str(case["path"])


def run(
    *command: str | Path, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        list(map(str, command)),
        capture_output=True,
        text=True,
        check=False,
        timeout=WATCHDOG_S,
        env=env,
    )


def expected(case: Case) -> Case:
    found: Case = json.loads((CASES / case["expected"]).read_text())
    return found


def streams() -> Iterator[Case]:
    for case in LISTED["cases"]:
        if "expected" in case:
            yield from expected(case)["streams"]


# ---------------------------------------------------------------- readers


@pytest.mark.parametrize("case", LISTED["cases"], ids=ids)
def test_mp4ds_reads_what_is_expected(case: Case) -> None:
    module = load_tool("conformance_dump")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of newer minor versions
        found = json.loads(module.as_json(module.conformance_dump(CASES / case["path"])))
    assert found == (expected(case) if "expected" in case else {"problems": case["problems"]})


@pytest.mark.parametrize(("inside", "is_taken"), [(31, True), (32, False)])
def test_both_readers_count_nesting_alike(inside: int, is_taken: bool) -> None:
    """32 maps and lists within one another, the top being the first."""
    text = "a: " + "[" * inside + "1" + "]" * inside + "\n"
    done = run(
        *(sys.executable, "-c"),
        "import sys, yaml, subset; yaml.load(sys.argv[1], subset.Loader)",
        text,
        env={**os.environ, "PYTHONPATH": str(SUITE)},
    )
    assert (done.returncode == 0) == is_taken, done.stderr
    assert "nested too deeply" in done.stderr or is_taken
    with contextlib.nullcontext() if is_taken else pytest.raises(FormatError, match="nested"):
        yamlio.load(text.encode(), "some.yaml")


def test_null_is_as_good_as_absent(tmp_path: Path) -> None:
    for file in ("least.yaml", "gray.mp4"):
        shutil.copy(CASES / "sidecars" / "valid" / file, tmp_path)
    path = tmp_path / "least.yaml"
    text = re.sub("^checksum.*\n", "", path.read_text(), flags=re.MULTILINE)
    path.write_text(text.replace("\ncolumns:\n", "\ncamera_info: null\ncolumns:\n  seq: null\n"))
    assert mp4ds.validate(path, deep=True) == []
    done = run(
        *(sys.executable, "-c"),
        "import sys, pathlib, subset; print(*subset.load(pathlib.Path(sys.argv[1]), 'stream'))",
        path,
        env={**os.environ, "PYTHONPATH": str(SUITE)},
    )
    assert done.returncode == 0, done.stderr
    assert "columns" in done.stdout.split()
    assert "camera_info" not in done.stdout.split()


def has_ffmpeg() -> bool:
    if not (shutil.which("ffmpeg") and shutil.which("ffprobe")):
        return False
    decoders = run("ffmpeg", "-v", "quiet", "-decoders").stdout
    return bool(re.search("libdav1d|libaom-av1|libgav1", decoders))


@pytest.mark.slow
@pytest.mark.skipif(not has_ffmpeg(), reason="needs ffmpeg's command line with an AV1 decoder")
def test_a_second_reader_passes() -> None:
    reader = (sys.executable, SUITE / "reader.py", "{file}")
    done = run(sys.executable, SUITE / "run.py", "--without", NOT_READ, "--", *reader)
    assert done.returncode == 0, done.stdout + done.stderr
    not_shown = re.findall(r"^not shown: (.*)$", done.stdout, re.MULTILINE)
    assert not_shown == [f"streams.{key}" for key in ("camera_info.payloads", "payloads", "pixels")]


@pytest.mark.parametrize("path", sorted(SUITE.glob("*.py")), ids=lambda path: path.name)
def test_the_suite_stands_alone(path: Path) -> None:
    allowed = set(sys.stdlib_module_names) | {"yaml", "subset"}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            assert {alias.name.split(".")[0] for alias in node.names} <= allowed
        elif isinstance(node, ast.ImportFrom):
            assert (node.module or "").split(".")[0] in allowed


# ---------------------------------------------------------------- the runner


def reading(folder: Path, change: str) -> list[str | Path]:
    """A reader that knows the answers, but for a change of `found`, which it makes."""
    reader = folder / "reader.py"
    reader.write_text(
        "import json, pathlib, sys\n"
        "path = pathlib.Path(sys.argv[1])\n"
        "file = path / 'expected.json' if path.is_dir() else path.with_suffix('.json')\n"
        "found = json.loads(file.read_text()) if file.exists() else {'problems': []}\n"
        f"{change}\n"
        "print(json.dumps(found))\n"
    )
    return [sys.executable, reader, "{file}"]


def test_the_runner_lets_right_answers_pass(tmp_path: Path) -> None:
    command = reading(tmp_path, "del found['streams'][0]['planes']")
    done = run(sys.executable, SUITE / "run.py", "--only", "datasets/before", "--", *command)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 of 1 cases passed" in done.stdout
    assert "not shown: streams.planes" in done.stdout


@pytest.mark.parametrize(
    "change",
    [
        "found['streams'][0]['columns']['stamp'][1] = '0'",
        "found['streams'][0]['frames'] = True",
        "found['streams'][0]['columns']['stamp'].pop()",
        "found['streams'] = []",
        "found['streams'][0]['planes']['sha256'].reverse()",
        "found['more'] = 1",
        "found = None",
        "raise SystemExit",
    ],
)
def test_the_runner_sees_wrong_answers(change: str, tmp_path: Path) -> None:
    command = reading(tmp_path, change)
    done = run(sys.executable, SUITE / "run.py", "--only", "datasets/before", "--", *command)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "FAILED datasets/before-1970" in done.stdout


@pytest.mark.parametrize("flags", [[], ["--validator"]], ids=["reader", "validator"])
def test_the_runner_sees_who_reads_what_is_to_be_refused(flags: list[str], tmp_path: Path) -> None:
    only = ("--only", "sidecars/invalid/column-")
    done = run(sys.executable, SUITE / "run.py", *only, *flags, "--", *reading(tmp_path, ""))
    assert done.returncode == 1
    count = sum(case["path"].startswith(only[1]) for case in LISTED["cases"])
    assert f"0 of {count} cases passed" in done.stdout


def test_the_runner_sees_a_problem_too_many(tmp_path: Path) -> None:
    change = "found = {'problems': [{'file': 'dataset.yaml', 'code': 'kind-unknown'}] * 2}"
    command = ("--validator", "--only", "broken/manifest-kind", "--", *reading(tmp_path, change))
    assert run(sys.executable, SUITE / "run.py", *command).returncode == 1
    command = (*command[:4], *reading(tmp_path, change.removesuffix(" * 2}") + "}"))
    done = run(sys.executable, SUITE / "run.py", *command)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("at", "passes"),
    [("columns.stamp", True), ("columns.stamp.values", True), (None, True), ("columns", False)],
)
def test_the_runner_takes_a_place_within_the_expected_one(
    at: str | None, passes: bool, tmp_path: Path
) -> None:
    problem = {"file": "column-short.yaml", "code": "column-invalid"} | ({"at": at} if at else {})
    only = ("--validator", "--only", "sidecars/invalid/column-short")
    command = reading(tmp_path, f"found = {{'problems': [{problem}]}}")
    done = run(sys.executable, SUITE / "run.py", *only, "--", *command)
    assert (done.returncode == 0) == passes, done.stdout


# ---------------------------------------------------------------- the command


def test_the_command_prints_what_is_expected() -> None:
    dataset = CASES / "datasets" / "before-1970"
    done = run(sys.executable, DUMP, dataset)
    assert done.returncode == 0, done.stderr
    assert done.stdout == (dataset / "expected.json").read_text()


def test_the_command_prints_problems() -> None:
    broken = CASES / "sidecars" / "invalid" / "column-short.yaml"
    done = run(sys.executable, DUMP, broken)
    assert done.returncode == 1
    place = {"file": broken.name, "at": "columns.stamp", "code": "column-invalid"}
    assert json.loads(done.stdout) == {"problems": [place]}


def test_the_command_refuses_what_is_no_dataset(tmp_path: Path) -> None:
    done = run(sys.executable, DUMP, tmp_path)
    assert done.returncode == 2
    assert "is not a dataset" in done.stderr
    assert "Traceback" not in done.stderr


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
    assert {stream["layout"] for stream in seen} == set(LAYOUTS)
    assert {stream["codec"] for stream in seen} == set(VIDEO_CODECS)
    assert {stream["body"] for stream in seen} == set(Body.__args__)  # type: ignore[attr-defined]
    assert {stream["wire"] for stream in seen} == set(WIRES)
    profiles = {"lossless", "crf=30", "crf=22", "crf=1", "psnr=41"}
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


def test_each_stream_is_proven_by_planes_or_packets() -> None:
    for stream in streams():
        assert len(stream["packets"]) == stream["frames"]
        is_jpeg = stream["codec"] == "mjpeg"
        assert (stream["planes"] is None) == is_jpeg, stream["topic"]
        if stream["profile"] == "lossless":
            assert len(set(stream["payloads"])) > 1 or stream["frames"] == 1
            assert (stream["pixels"] is None) == (stream["body"] == "packet")


def integers(value: Any) -> Iterator[int]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from integers(item)
    elif isinstance(value, int):
        yield value


def test_the_json_can_be_read_in_any_language() -> None:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    for path in CASES.rglob("*.json"):
        values = json.loads(path.read_text(), parse_constant=refuse)
        assert all(abs(number) < 2**53 for number in integers(values)), path


def test_the_list_is_whole() -> None:
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
    assert f"--without {NOT_READ}" in readme


def test_the_suite_is_small() -> None:
    size = sum(path.stat().st_size for path in (SUITE / "cases").rglob("*") if path.is_file())
    assert size < 2_000_000


def test_a_stream_that_does_not_decode_is_told_without_planes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As packets are that were recorded after others had been lost."""
    module = load_tool("conformance_dump")
    decoded = module.decoded

    def fail(path: Path) -> Iterator[Any]:
        yield from itertools.islice(decoded(path), 1)
        raise av.error.InvalidDataError(0, "damaged")

    monkeypatch.setattr(module, "decoded", fail)
    found = module.conformance_dump(CASES / "sidecars" / "valid" / "packets.yaml")
    (stream,) = found["streams"]
    assert stream["planes"] is None
    assert len(stream["payloads"]) == stream["frames"]
