"""The command line: the only place that prints or exits.

Exit codes: 0 success; 1 failure, or problems were found; 2 wrong input or options; 130 interrupted.
"""

from __future__ import annotations

import errno
import gc
import os
import platform
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NoReturn

import click

from mp4ds._version import __version__
from mp4ds.cli.options import in_flags, quiet_option
from mp4ds.cli.output import JSON, complain, is_set, print_json, printed, say
from mp4ds.errors import Mp4dsError, sentence_of

COMMANDS = {
    "pack": ("pack", "Pack a recording into a dataset of mp4 files, or repack a dataset."),
    "repack": ("pack", "Pack a recording into a dataset of mp4 files, or repack a dataset."),
    "unpack": ("pack", "Turn a dataset back into a recording: a bag, rosbag2 or MCAP."),
    "import": ("pack", "Make a dataset from images, from a video, or from a LeRobotDataset."),
    "export": (
        "pack",
        "Export a dataset to image files or another tool's format, keeping what that supports.",
    ),
    "play": ("play", "Play back datasets, publishing to ROS 1 or ROS 2."),
    "record": ("record", "Record topics of a live robot, ROS 1 or ROS 2, into a dataset."),
    "report": (
        "report",
        "Make an HTML report: synchronised cameras, timing, topics, calibrations.",
    ),
    "frames": ("report", "Save one frame as an image."),
    "evaluate": (
        "report",
        "Compare encoder settings on clips of a recording: quality, size and time.",
    ),
    "validate": ("info", "Check datasets and list every problem; exits with 1 if there are any."),
    "info": ("info", "Show what is in a recording or a dataset."),
    "demo": (
        "pack",
        "Make a small test recording: two cameras (Bayer and RGB), calibrations, IMU, tf.",
    ),
}
"""Commands -> their module, which is imported for them alone, and what they do."""


class Commands(click.Group):
    """The command line, with the commands of the table."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The names."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context | None, cmd_name: str) -> click.Command | None:
        """The command of a name."""
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = getattr(
            import_module(f"mp4ds.cli.{COMMANDS[cmd_name][0]}"), f"{cmd_name}_command"
        )
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write what they do, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, does) for name, (_, does) in COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command, and report its errors."""
        with report_errors():
            return super().invoke(ctx)


@click.group(
    cls=Commands,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.option("--version", is_flag=True, help="Print the version.")
@quiet_option
@click.option("--verbose", "-v", is_flag=True, help="Show tracebacks of errors.")
@click.pass_context
def commands(context: click.Context, version: bool, verbose: bool) -> None:
    """Turn robot camera recordings into ordinary mp4 files, and back again exactly."""
    if verbose:
        os.environ[DEBUG] = "1"
    if version:
        say(f"mp4ds {__version__}")
        context.exit()
    if context.invoked_subcommand is None:
        click.echo(context.get_help(), err=True)
        context.exit(2)


def main() -> NoReturn:
    """Run the command line and exit."""
    prepare_process()
    code = exit_code_of(lambda: commands.main(sys.argv[1:]))
    # all is cleaned up: one more Ctrl-C while Python ends its threads would print a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(code)


# ---------------------------------------------------------------- errors

_NOTHING_LEFT = "no partial output was left behind"
_BAD_PATH = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EACCES, errno.EINVAL)
DEBUG = "MP4DS_DEBUG"
_NO_MEMORY = "out of memory; try fewer --jobs"
_MEMORY_REFUSED = ("can't start new thread", "failed to map segment", "Cannot allocate memory")
_LONGEST = 500
_PACKAGE = Path(__file__).parents[1]


@contextmanager
def report_errors() -> Iterator[None]:
    """Turn errors into one sentence and an exit code."""
    try:
        yield
    except (click.ClickException, click.exceptions.Exit, click.Abort):
        raise
    except KeyboardInterrupt as interrupt:
        _fail(str(interrupt) or f"interrupted; {_NOTHING_LEFT}", 130)
    except SystemExit as ended:  # by SIGTERM; without words of its own, its argument is its code
        said = ended.args[0] if ended.args and isinstance(ended.args[0], str) else ""
        _fail(said or f"terminated; {_NOTHING_LEFT}", ended.code)
    except Mp4dsError as error:
        _fail(in_flags(str(error)), error.exit_code)
    except OSError as error:
        # a path that the system itself refuses, wherever it occurs
        _fail(sentence_of(error), 2 if error.errno in _BAD_PATH else 1)
    except MemoryError:
        _fail(_NO_MEMORY, 1)
    except Exception as error:
        # errors of other calls on a system that is out of memory
        if any(words in str(error) for words in _MEMORY_REFUSED):
            _fail(_NO_MEMORY, 1)
        _fail(_unexpected(error), 1, versions=_versions())


def _fail(message: str, code: Any, *, versions: dict[str, str] | None = None) -> NoReturn:
    if os.environ.get(DEBUG):
        for line in traceback.format_exc().splitlines():
            complain(line)
    if is_set(JSON):
        with suppress(Mp4dsError):  # nobody reads it
            print_json(
                {"error": message, "exit_code": code} | ({"versions": versions} if versions else {})
            )
    complain(message)
    if versions:
        complain(", ".join(f"{name} {version}" for name, version in versions.items()))
    raise click.exceptions.Exit(code)


def _unexpected(error: Exception) -> str:
    """A sentence about an unexpected error."""
    said = " ".join(str(error).split())[:_LONGEST].rstrip(".") or "no details"
    place = ""
    for frame in traceback.extract_tb(error.__traceback__):
        path = Path(frame.filename)
        if _PACKAGE in path.parents:
            place = f" in {path.relative_to(_PACKAGE).as_posix()}:{frame.lineno}"
    return (
        f"{type(error).__name__}{place}: {said}. This is a bug: please report it, with the "
        f"versions listed here and the output with {DEBUG}=1."
    )


def _versions() -> dict[str, str]:
    """The software involved, with versions."""
    from importlib import metadata  # which a command without errors need not wait for

    found = {"mp4ds": __version__, "Python": platform.python_version()}
    for name in ("av", "click", "mcap", "numpy", "pillow", "pydantic", "rosbags"):
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found | {"on": platform.platform()}


# ---------------------------------------------------------------- process

_MOST_FILES = 65_536


def prepare_process() -> None:
    """Make the process ready, before numpy is imported."""
    if "record" in sys.argv[1:] and hasattr(signal, "SIGUSR1"):  # Windows has none
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # until there is something to save
    # no matrices are multiplied here, and idle threads cost time
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(20_000)  # imports create many objects but no garbage
    warnings.showwarning = lambda message, *_, **__: complain(message)
    # sent by batch systems, and when a terminal is lost: exit as after Ctrl-C
    for number in ending_signals():
        signal.signal(number, _end)
    _fill_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # for names in other scripts
    _allow_files()


def ending_signals() -> list[signal.Signals]:
    """The signals that end a command, besides Ctrl-C's; except those that nohup ignores."""
    names = [name for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]  # or Windows
    numbers = [signal.Signals[name] for name in names]
    return [number for number in numbers if signal.getsignal(number) != signal.SIG_IGN]


def _end(number: int, _: object) -> None:
    if number != signal.SIGTERM:  # a lost terminal sends it more than once, even during cleanup
        signal.signal(number, signal.SIG_IGN)
    sys.exit(128 + number)


def _fill_streams() -> None:
    """Open /dev/null for closed standard streams.

    Otherwise the next opened file gets its number, and the error messages of libraries.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open("w" if number else "r")  # noqa: SIM115
            with suppress(OSError):
                os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)


def _allow_files() -> None:
    """Raise the limit of open files as far as allowed: every camera has some."""
    try:
        import resource
    except ImportError:  # Windows
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < most:
        with suppress(OSError, ValueError):  # macOS accepts less than it reports
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def exit_code_of(command: Callable[[], object]) -> int:
    """Run the command line to its end, even if nobody reads its output.

    Args:
        command: Runs it; raises `SystemExit` with its exit code.
    """
    code = 0
    try:
        with report_errors(), printed():  # the commands report everything else themselves
            try:
                command()
            except SystemExit as ended:
                code = int(ended.code or 0)
            sys.stdout.flush()
    except click.exceptions.Exit as ended:
        code = code or ended.exit_code
    for stream in (sys.stdout, sys.stderr):
        _let_go(stream)
    return code


def _let_go(stream: object) -> None:
    """Drop what a stream did not accept: Python would try again at exit, and complain."""
    if isinstance(stream, TextIOWrapper):
        try:
            stream.flush()
        except (OSError, ValueError):
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
