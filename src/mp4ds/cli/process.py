"""The process that the command line runs in: its streams, signals and limits, and its end."""

from __future__ import annotations

import gc
import os
import signal
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from io import TextIOWrapper
from pathlib import Path

import typer

from mp4ds.cli.failures import told_errors
from mp4ds.cli.output import complain, printed

_MOST_FILES = 65_536


def prepare_process() -> None:
    """Make the process ready, before numpy is imported."""
    # no matrix is multiplied here, and idle threads cost time
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(20_000)  # imports make many objects and no garbage
    warnings.showwarning = lambda message, *_, **__: complain(message)
    # a batch system's way to interrupt, and a terminal's that is lost: leave as after Ctrl-C
    for number in ending_signals():
        signal.signal(number, _end)
    _fill_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal may lack a topic's letters
    _allow_files()


def ending_signals() -> list[signal.Signals]:
    """The signals that end a command, besides Ctrl-C's; not those that nohup keeps away."""
    names = [name for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]  # or Windows
    numbers = [signal.Signals[name] for name in names]
    return [number for number in numbers if signal.getsignal(number) != signal.SIG_IGN]


def _end(number: int, _: object) -> None:
    if number != signal.SIGTERM:  # a lost terminal tells so more than once, also while tidying up
        signal.signal(number, signal.SIG_IGN)
    sys.exit(128 + number)


def _fill_streams() -> None:
    """Put /dev/null where a standard stream is closed.

    Else the next file that is opened gets its number, and what libraries say of errors.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open("w" if number else "r")  # noqa: SIM115
            with suppress(OSError):
                os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)


def _allow_files() -> None:
    """Raise the limit of open files as far as may be: every camera has some."""
    try:
        import resource
    except ImportError:  # Windows
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < most:
        with suppress(OSError, ValueError):  # macOS takes less than it tells
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def exit_code_of(command: Callable[[], object], *, as_json: bool) -> int:
    """Run the command line to its end, also where nobody takes what it prints.

    Args:
        command: Runs it; raises `SystemExit` with its exit code.
        as_json: How errors are told.
    """
    code = 0
    try:
        with told_errors(as_json), printed():  # all else is told by the commands themselves
            try:
                command()
            except SystemExit as ended:
                code = int(ended.code or 0)
            sys.stdout.flush()
    except typer.Exit as ended:
        code = code or ended.exit_code
    for stream in (sys.stdout, sys.stderr):
        _let_go(stream)
    return code


def _let_go(stream: object) -> None:
    """Drop what a stream did not take: Python would try again at its end, and complain."""
    if isinstance(stream, TextIOWrapper):
        try:
            stream.flush()
        except (OSError, ValueError):
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
