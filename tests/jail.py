"""Reads what a stranger sent, in a process that may not take much memory or time.

A `Jail` keeps one process in which mp4ds is imported; it forks for every reading, so that each
has limits of its own and costs milliseconds.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mp4ds.records import Message
from waiting import WATCHDOG_S

MEMORY = 2 * 2**30
"""Bytes of address space that a reading may take."""

SECONDS = 10
"""Seconds of computing after which a reading is ended."""


@dataclass(frozen=True)
class Outcome:
    """What came of one reading.

    Attributes:
        codes: Problem codes, sorted, each once.
        problems: The problems as text.
        error: Name of the class of the error, empty if there was none.
        ours: Whether the error is one that mp4ds raises on purpose.
        text: The error's sentence; for a foreign error its traceback.
        frames: Frames that were read.
        messages: Messages that were read.
        warned: Warnings that were given.
        peak: Most bytes of memory that the process had.
    """

    codes: list[str]
    problems: list[str]
    error: str
    ours: bool
    text: str
    frames: int
    messages: int
    warned: list[str]
    peak: int


class Jail:
    """A process that reads for us. A context manager."""

    def __enter__(self) -> Jail:
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            text=True,
        )
        return self

    def __exit__(self, *_: object) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.wait(timeout=WATCHDOG_S)

    def validate(self, path: Path, *, deep: bool = True) -> Outcome:
        """All problems of a sidecar or dataset."""
        return self._ask("validate", path, deep)

    def read(self, path: Path) -> Outcome:
        """Open a sidecar or dataset, read a frame, all frames, and all messages."""
        return self._ask("read", path, False)

    def records(self, path: Path, *, salvage: bool = False) -> Outcome:
        """Read all messages of a recording, or what is there of a damaged one."""
        return self._ask("salvage" if salvage else "records", path, False)

    def converted(self, path: Path, to: str) -> Outcome:
        """Convert all messages of a recording to ``ros1`` or ``ros2``."""
        return self._ask(to, path, False)

    def decoded(self, path: Path) -> Outcome:
        """Decode all messages of a recording."""
        return self._ask("decoded", path, False)

    def unpacked(self, path: Path, to: str) -> Outcome:
        """Pack a recording and unpack it to a format; both are made beside it."""
        return self._ask(to, path, False)

    def _ask(self, task: str, path: Path, deep: bool) -> Outcome:
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            raise RuntimeError("the jail is not open")
        stdin.write(json.dumps([task, str(path), deep]) + "\n")
        stdin.flush()
        return Outcome(**json.loads(stdout.readline()))


def _read(path: str, _deep: bool, found: dict[str, Any]) -> None:
    import mp4ds

    with mp4ds.open(path) as dataset:
        for topic in dataset:
            _ = topic[-1]
            for _ in topic:
                found["frames"] += 1
        for _ in dataset.records():
            found["messages"] += 1


def _validate(path: str, deep: bool, found: dict[str, Any]) -> None:
    import mp4ds

    problems = mp4ds.validate(path, deep=deep)
    found["codes"] = sorted({problem.code for problem in problems})
    found["problems"] = [str(problem) for problem in problems]


def _records(path: str, _deep: bool, found: dict[str, Any], *, salvage: bool = False) -> None:
    from mp4ds.bags.formats import open_sources

    with open_sources([Path(path)], salvage=salvage) as reader:  # type: ignore[call-overload]
        for record in reader.records():
            found["messages"] += isinstance(record, Message)
        if salvage:
            found["problems"] = [loss.problem for loss in reader.losses]


def _converted(path: str, _deep: bool, found: dict[str, Any], *, to: str) -> None:
    from mp4ds.bags.convert import Converter
    from mp4ds.bags.formats import open_sources

    converter = Converter(to)
    with open_sources([Path(path)]) as reader:
        for record in reader.records():
            if isinstance(record, Message):
                converter.channel(record.channel)
                converter.payload(record.channel, record.data)
                found["messages"] += 1


def _decoded(path: str, _deep: bool, _found: dict[str, Any]) -> None:
    from mp4ds.bags.formats import open_sources
    from mp4ds.dataset.messages import as_recorded

    with open_sources([Path(path)]) as reader:
        messages = (record for record in reader.records() if isinstance(record, Message))
        for message in as_recorded(messages, Path(path)):
            _ = message.decoded


def _unpacked(path: str, _deep: bool, _found: dict[str, Any], *, to: str) -> None:
    import mp4ds

    mp4ds.pack(path, f"{path}.packed")
    mp4ds.unpack(f"{path}.packed", to, f"{path}.unpacked.{to}")


_TASKS: dict[str, Callable[[str, bool, dict[str, Any]], None]] = {
    "read": _read,
    "validate": _validate,
    "records": _records,
    "salvage": partial(_records, salvage=True),
    "decoded": _decoded,
    **{to: partial(_converted, to=to) for to in ("ros1", "ros2")},
    **{to: partial(_unpacked, to=to) for to in ("bag", "rosbag2")},
}


def _run(task: str, path: str, deep: bool) -> dict[str, Any]:
    from mp4ds import Mp4dsError

    found: dict[str, Any] = {"codes": [], "problems": [], "error": "", "ours": False, "text": ""}
    found |= {"frames": 0, "messages": 0}
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            _TASKS[task](path, deep, found)
        except BaseException as error:
            found["error"], found["ours"] = type(error).__name__, isinstance(error, Mp4dsError)
            found["text"] = str(error) if found["ours"] else traceback.format_exc()
    found["warned"] = [str(item.message) for item in warned]
    return found


def _in_child(request: list[Any]) -> dict[str, Any]:
    receiver, sender = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receiver)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        signal.alarm(30 * SECONDS)  # for one that waits: on a busy machine, too
        with os.fdopen(sender, "w") as pipe:
            json.dump(_run(*request), pipe)
        os._exit(0)
    os.close(sender)
    with os.fdopen(receiver) as pipe:
        answer = pipe.read()
    _, status, usage = os.wait4(child, 0)
    if answer:
        found: dict[str, Any] = json.loads(answer)
    else:
        found = {"codes": [], "problems": [], "error": "Killed", "ours": False, "frames": 0}
        found |= {"text": f"ended with status {status}", "messages": 0, "warned": []}
    found["peak"] = usage.ru_maxrss * 1024
    return found


_IMPORTED = (
    "jsonschema",
    "rosbags.typesys.stores.ros1_noetic",
    "rosbags.typesys.stores.ros2_humble",
    "mp4ds.bags.convert",
    "mp4ds.dataset.checks",
    "mp4ds.dataset.dataset",
)


def _serve() -> None:
    for module in _IMPORTED:
        importlib.import_module(module)  # once, for all children

    for line in sys.stdin:
        print(json.dumps(_in_child(json.loads(line))), flush=True)  # noqa: T201


if __name__ == "__main__":
    _serve()
