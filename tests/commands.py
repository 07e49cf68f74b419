"""The command line, in this process or in one of its own, and what it leaves of folders."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from mp4ds.cli import commands as command_line
from waiting import WATCHDOG_S

ROOT = Path(mp4ds.__file__).parents[1]
NEEDS_ROOT = "a file system can only be mounted by root"


@dataclass(frozen=True)
class Result:
    """What a command did."""

    code: int
    out: str
    err: str


def without_progress(err: str) -> str:
    """What is told of the progress depends on how long it takes."""
    return re.sub(r"^\d\d:\d\d:\d\d (un)?packing .*\n", "", err, flags=re.MULTILINE)


def call(*arguments: object, screen: Callable[[], io.StringIO] = io.StringIO) -> Result:
    """A command in this process: its exit code and what it wrote, but for its progress."""
    out, err = screen(), screen()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            command_line.main([str(argument) for argument in arguments])
            code: Any = 0
        except SystemExit as exit_:
            code = exit_.code or 0
    return Result(code, out.getvalue(), without_progress(err.getvalue()))


def start(*arguments: object, **options: Any) -> subprocess.Popen[str]:
    """A command as a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "mp4ds", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), **options.pop("env", {})},
        **options,
    )


def run(*arguments: object, **options: Any) -> Result:
    """A command as a process of its own: its exit code and what it wrote, but for its progress."""
    with start(*arguments, **options) as process:
        out, err = process.communicate(timeout=WATCHDOG_S)
    return Result(process.returncode, out, without_progress(err))


def program(
    *command: object, code: int | None = 0, env: Mapping[str, str] | None = None, **options: Any
) -> Result:
    """Another program, or Python code behind ``-c`` alone, which is to have an exit code.

    Programs of this environment come first on its path, and Python finds the package.

    Args:
        command: Its words.
        code: That it ends with; None for any.
        env: What is added to the environment.
        options: Of `subprocess.run`.
    """
    words = [sys.executable, *command] if command[0] == "-c" else command
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        list(map(str, words)),
        capture_output=True,
        text=True,
        timeout=WATCHDOG_S,
        check=False,
        stdin=subprocess.DEVNULL,
        env={**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), **(env or {})},
        **options,
    )
    assert code in (done.returncode, None), done.stdout + done.stderr
    return Result(done.returncode, done.stdout, done.stderr)


def ffprobe(path: Path, *options: str) -> Any:
    """What ffprobe says of a file, as JSON values."""
    if not shutil.which("ffprobe"):
        pytest.skip("there is no ffprobe")
    return json.loads(program("ffprobe", "-v", "error", "-of", "json", *options, path).out)


def typed(line: str, folder: Path) -> Result:
    """A line as it is typed into a shell in a folder.

    A command of the package runs in this process, which has it loaded, unless it needs a shell.
    """
    words = shlex.split(line)
    needs_shell = set(re.sub("'[^']*'", "", line)) & set("*|;&$<>")
    if words[0] == "mp4ds" and not needs_shell:
        with contextlib.ExitStack() as stack:
            stack.callback(os.chdir, Path.cwd())
            os.chdir(folder)
            return call(*words[1:])
    return program("bash", "-c", line, code=None, cwd=folder)


def tree(folder: Path) -> dict[str, str]:
    """Everything below a folder, hidden files too: relative path -> SHA-256, link or ``/``."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            content = f"-> {path.readlink()}"
        elif path.is_dir():
            content = "/"
        elif path.is_file():
            content = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            content = "special"
        found[str(path.relative_to(folder))] = content
    return found


@contextlib.contextmanager
def unchanged(folder: Path) -> Iterator[None]:
    """Whatever is done, source, target and all beside them stay as they are."""
    before = tree(folder)
    yield
    assert tree(folder) == before


def refused(result: Result, code: int, *words: str) -> None:
    """One sentence on stderr, with these words, and nothing on stdout."""
    assert "Traceback" not in result.err
    assert result.code == code, result.err
    assert re.fullmatch(r"mp4ds: [^\n]+\n", result.err), result.err
    for word in words:
        assert word in result.err
    assert result.out == ""
