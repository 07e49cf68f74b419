"""Reads what a stranger sent, in a process that may not take much memory or time.

multiprocessing's fork server has mp4ds imported, and forks for every reading, so that each has
limits of its own and costs milliseconds.
"""

from __future__ import annotations

import multiprocessing
import resource
import signal
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import mp4ds
from mp4ds.bags.convert import Converter
from mp4ds.bags.formats import open_sources
from mp4ds.dataset.messages import as_recorded
from mp4ds.records import Message
from waiting import WATCHDOG_S

MEMORY = 2 * 2**30
"""Bytes of address space that a reading may take."""

MAX_MEMORY = 1000 * 2**20
"""Bytes of memory that one must get along with."""

SECONDS = 10
"""Seconds of computing after which a reading is ended."""


@dataclass
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

    codes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    error: str = ""
    ours: bool = False
    text: str = ""
    frames: int = 0
    messages: int = 0
    warned: list[str] = field(default_factory=list)
    peak: int = 0


_CONTEXT = multiprocessing.get_context("forkserver")
_STORES = [f"rosbags.typesys.stores.ros{name}" for name in ("1_noetic", "2_humble")]
_CONTEXT.set_forkserver_preload([__name__, "jsonschema", "mp4ds.dataset.checks", *_STORES])


def confined(work: Callable[..., None]) -> Callable[..., Outcome]:
    """Have a reading, which notes its outcome, done in a process of its own.

    It must end with a result or an error that mp4ds raises on purpose, in little memory.
    """

    @wraps(work)
    def run(*arguments: object, **options: object) -> Outcome:
        receiver, sender = _CONTEXT.Pipe(duplex=False)
        child = _CONTEXT.Process(target=_run, args=(sender, run, arguments, options))
        child.start()
        sender.close()
        try:
            outcome: Outcome = receiver.recv()
        except EOFError:
            child.join(WATCHDOG_S)
            outcome = Outcome(error="Killed", text=f"ended with status {child.exitcode}")
        child.join(WATCHDOG_S)
        assert outcome.ours or not outcome.error, outcome.text
        assert outcome.peak < MAX_MEMORY
        return outcome

    return run


def _run(sender: Connection, work: Any, arguments: Any, options: Any) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    signal.alarm(30 * SECONDS)  # for one that waits: on a busy machine, too
    found = Outcome()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            work.__wrapped__(found, *arguments, **options)
        except BaseException as error:
            found.error, found.ours = type(error).__name__, isinstance(error, mp4ds.Mp4dsError)
            found.text = str(error) if found.ours else traceback.format_exc()
    found.warned = [str(item.message) for item in warned]
    found.peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    sender.send(found)


@confined
def read(found: Outcome, path: Path) -> None:
    """Open a sidecar or dataset, read a frame, all frames, and all messages."""
    with mp4ds.open(path) as dataset:
        for topic in dataset:
            _ = topic[-1]
            for _ in topic:
                found.frames += 1
        for _ in dataset.records():
            found.messages += 1


@confined
def validate(found: Outcome, path: Path, *, deep: bool = True) -> None:
    """Find all problems of a sidecar or dataset."""
    problems = mp4ds.validate(path, deep=deep)
    found.codes = sorted({problem.code for problem in problems})
    found.problems = [str(problem) for problem in problems]


@confined
def records(found: Outcome, path: Path, *, salvage: bool = False) -> None:
    """Read all messages of a recording, or what is there of a damaged one."""
    with open_sources([path], salvage=salvage) as reader:  # type: ignore[call-overload]
        for record in reader.records():
            found.messages += isinstance(record, Message)
        if salvage:
            found.problems = [loss.problem for loss in reader.losses]


@confined
def converted(found: Outcome, path: Path, to: str) -> None:
    """Convert all messages of a recording to ``ros1`` or ``ros2``."""
    converter = Converter(to)
    with open_sources([path]) as reader:
        for record in reader.records():
            if isinstance(record, Message):
                converter.channel(record.channel)
                converter.payload(record.channel, record.data)
                found.messages += 1


@confined
def decoded(_: Outcome, path: Path) -> None:
    """Decode all messages of a recording."""
    with open_sources([path]) as reader:
        messages = (record for record in reader.records() if isinstance(record, Message))
        for message in as_recorded(messages, path):
            _ = message.decoded


@confined
def unpacked(_: Outcome, path: Path, to: str) -> None:
    """Pack a recording and unpack it to a format; both are made beside it."""
    mp4ds.pack(path, f"{path}.packed")
    mp4ds.unpack(f"{path}.packed", to, f"{path}.unpacked.{to}")
