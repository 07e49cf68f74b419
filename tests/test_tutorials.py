"""Tutorials, and pages like them: each command and snippet in order, and what it prints.

A page has blocks. ``sh`` and ``python`` are run; a command that is to fail says so behind it
(``# exit code 2``). ``text`` right after a block is what this prints, of which numbers may differ
and lines may be left out; their order is not compared. ``console`` is for what needs ROS or another
machine, and is not run.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from commands import Result, typed
from mp4ds.cli import commands as command_line
from ros2_sides import alone_in_ros2

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted((DOCS / "tutorials").glob("*.md"))
OTHERS = [DOCS / f"{name}.md" for name in ("exporting", "hub", "report")]
NEEDS = {"--ros2": "cyclonedds", "mp4ds.torch": "torch"}
"""What a line needs beside the package -> the module of it; the page is skipped without."""


def blocks_of(page: Path) -> list[tuple[str, str]]:
    """Kind and text of each fenced block of a page."""
    return re.findall(r"```(\w+)\n(.*?)```", page.read_text(), re.S)


def commands(text: str) -> Iterator[tuple[str, int]]:
    """Each command of a block, and the exit code that it is to have."""
    for line in text.replace("\\\n", " ").splitlines():
        command, _, remark = line.partition(" #")
        if command.strip():
            found = re.search(r"exit code (\d+)", remark)
            yield command.strip(), int(found[1]) if found else 0


def run_command(command: str, folder: Path) -> Result:
    """A command, with a demonstration as long as these tests can afford."""
    is_demo = command.startswith("mp4ds demo") and "--seconds" not in command
    return typed(f"{command} --seconds 0.8" if is_demo else command, folder)


def run_snippet(text: str, names: dict[str, Any]) -> str:
    """What a snippet prints; it knows what those before it on the page made."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(text, names)
    return printed.getvalue()


def loosely(line: str) -> str:
    """A line as it is compared: its words; numbers, units of bytes and folders do not matter."""
    line = re.sub(r"\d+(\.\d+)?", "0", line.replace("/home/ada/", ""))
    return " ".join(re.sub(r"\b0 (B|kB|MB|GB)\b", "0 bytes", line).split())


def assert_printed(said: str, printed: str) -> None:
    """Each line that a page shows is printed; topics come in the order of their first message."""
    lines = [loosely(line) for line in printed.splitlines()]
    for line in said.splitlines():
        due = loosely(line)
        assert any(due in found for found in lines), f"{line}\n\n{printed}"


@pytest.mark.slow
@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=lambda page: page.stem)
def test_a_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    alone_in_ros2(monkeypatch)
    blocks = blocks_of(page)
    for word, module in NEEDS.items():
        if any(word in text for _, text in blocks) and find_spec(module) is None:
            pytest.skip(f"needs {module}")
    names: dict[str, Any] = {}
    printed = ""
    for kind, text in blocks:
        if kind == "sh":
            printed = ""
            for command, code in commands(text):
                done = run_command(command, tmp_path)
                assert done.code == code, f"{command}\n{done}"
                printed += done.out + done.err
        elif kind == "python":
            printed = run_snippet(text, names)
        elif kind == "text":
            assert printed, f"nothing was run before:\n{text}"
            assert_printed(text, printed.replace(f"{tmp_path}/", ""))
        else:
            assert kind in ("console", "yaml", "markdown"), kind


def test_there_are_tutorials_and_they_run_something() -> None:
    assert [page.stem for page in PAGES] == ["archive", "replay", "share", "train"]
    for page in PAGES:
        blocks = blocks_of(page)
        count = sum(len(list(commands(text))) for kind, text in blocks if kind == "sh")
        assert count >= 5, page
        assert any(kind == "text" for kind, _ in blocks), page
        for kind, text in blocks:
            assert "mp4ds " in text or kind != "sh", text


# ---------------------------------------------------------------- options that pages name


@cache
def options_of(command: str) -> set[str]:
    known: Any = command_line.get_command(None, command)
    below = getattr(known, "commands", {}).values()
    params = [option for each in (known, *below) for option in each.params]
    names = {name for option in params for name in (*option.opts, *option.secondary_opts)}
    words = getattr(known, "known", ())  # of nodes, as users of ROS type them
    return {name for name in names if name.startswith("-")} | {"--help", "-h", *words}


def invocations(text: str) -> Iterator[tuple[str, list[str]]]:
    """Commands in the code of a page, each with the options it is given."""
    spans = re.findall(r"```(?:sh|console|bash)\n(.*?)```", text, re.S)
    for span in [
        *spans,
        *re.findall(r"`(mp4ds [^`]*)`", re.sub(r"```.*?```", "", text, flags=re.S)),
    ]:
        for line in span.replace("\\\n", " ").splitlines():
            for found in re.finditer(r"\bmp4ds ([a-z][a-z-]*)\b([^|;&]*)", line.split(" #")[0]):
                yield found[1], re.findall(r"(?<![\w-])--?[a-z][a-z0-9-]*", found[2])


@pytest.mark.parametrize(
    "page",
    [ROOT / "README.md", *sorted(DOCS.rglob("*.md")), *sorted((ROOT / "spec").glob("*.md"))],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_every_option_that_a_page_names_is_there(page: Path) -> None:
    for command, given in invocations(page.read_text()):
        known = options_of(command)
        unknown = [option for option in given if option not in known]
        assert not unknown, f"mp4ds {command} has no {', '.join(unknown)}"
