"""What the command line says of itself, on a terminal of 80 columns; and how it keeps quiet."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import pytest

from commands import Result, call, program, refused


def run(*words: str, folder: Path) -> Result:
    return program("mp4ds", *words, cwd=folder, code=None, env={"COLUMNS": "80"})


def test_nothing_is_printed_but_errors(
    packed_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    # before the command or after it; of a process also what libraries print
    for place, asked in enumerate((call, partial(run, folder=tmp_path))):
        for words in (["info"], ["validate"], ["unpack", "-o", f"again{place}.bag"]):
            arguments = [*words, str(packed_bag)]
            assert asked(*arguments[:place], "-q", *arguments[place:]) == Result(0, "", "")
        assert (tmp_path / f"again{place}.bag").exists()
    refused(call("-q", "info", "nothing"), 2, "no such file")
    assert call("-q", "info", packed_bag, "--json").out.startswith("{")


@pytest.mark.parametrize(
    ("words", "number", "expected"),
    [("mp4ds rep", 1, {"repack", "report"}), ("mp4ds pack --dura", 2, {"--duration"})],
)
def test_shells_complete(words: str, number: int, expected: set[str], tmp_path: Path) -> None:
    asked = {"_MP4DS_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": str(number)}
    done = program("mp4ds", cwd=tmp_path, env=asked)
    assert set(re.findall(r"plain,(\S+)", done.out)) == expected
