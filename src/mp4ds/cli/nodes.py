"""Commands that run as ROS nodes: the arguments of ROS and of its own tools; control by keys."""

from __future__ import annotations

import os
import re
import select
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Any, TypeVar

import click

from mp4ds.cli import DEBUG, ending_signals
from mp4ds.cli.options import Command, option
from mp4ds.cli.output import QUIET, Row, complain, display
from mp4ds.errors import OptionError
from mp4ds.options import WHERE, Options
from mp4ds.options import option as field_option
from mp4ds.plugins.ros.node import LOG_LEVELS, PLAIN, NodeNames, node_arguments

try:
    import termios
    import tty
except ImportError:  # Windows
    termios = None  # type: ignore[assignment]

_NUMBER = re.compile(r"[0-9]+(\.[0-9]+)?")
_NAMES = "mp4ds.names"  # key of the ROS arguments in click's context
_State = TypeVar("_State")


@dataclass(frozen=True, kw_only=True)
class RosOptions(Options):
    """Options of all nodes."""

    ros1: bool = field_option("Use ROS 1.", False, panel=WHERE)
    ros2: bool = field_option("Use ROS 2, with rclpy, or else Cyclone DDS.", False, panel=WHERE)
    log_level: str = field_option(
        "Log level: debug, info, warn, error or fatal.", "", choices=LOG_LEVELS
    )
    disable_keyboard_controls: bool = field_option("Disable the keyboard controls.", False)
    progress: bool = field_option("Show the progress.", True, "--progress/--no-progress")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ros1 and self.ros2:
            raise OptionError("--ros1 contradicts --ros2.")

    @property
    def to(self) -> str | None:
        """The ROS version; None for the one that is sourced."""
        return "ros1" if self.ros1 else "ros2" if self.ros2 else None


def node_names(options: RosOptions) -> NodeNames:
    """The ROS arguments of the command that runs; from now on as much is printed as they say."""
    names: NodeNames = click.get_current_context().meta.get(_NAMES, PLAIN)
    level = options.log_level or names.log_level
    if level == "debug":
        os.environ[DEBUG] = "1"
    if level in ("warn", "error", "fatal"):
        click.get_current_context().meta[QUIET] = True
    if level in ("error", "fatal"):
        warnings.simplefilter("ignore")
    return names


@contextmanager
def node_progress(
    rows_of: Callable[[_State], Sequence[Row]],
    warnings_of: Callable[[_State], Iterable[str]],
    *,
    is_shown: bool,
) -> Iterator[Callable[[_State], None]]:
    """Show how far a node is, and what there is to warn of, once.

    Args:
        rows_of: What to show of its state.
        warnings_of: What to warn of in this state.
        is_shown: Show more than warnings.
    """
    warned: set[str] = set()

    with display(timed=False) if is_shown else nullcontext(lambda _: None) as show:

        def report(state: _State) -> None:
            for text in warnings_of(state):
                if text not in warned:
                    warned.add(text)
                    complain(text)
            show(rows_of(state))

        yield report


@contextmanager
def node_controls(
    options: RosOptions,
    stop: Callable[[], None],
    keys: Mapping[str, Callable[[], object]],
    signals: Mapping[str, Callable[[], object]] = {},
) -> Iterator[Sequence[int]]:
    """Run actions when keys are pressed, and let a node end in its own time at Ctrl-C and the like.

    At the second signal, it ends at once.

    Args:
        options: Of the node.
        stop: Ends it.
        keys: The action of each key.
        signals: Action of other signals, by name, which may interrupt anything.

    Yields:
        The numbers of the signals that came.
    """
    caught: list[int] = []

    def end(number: int, _: FrameType | None) -> None:
        if caught:  # asked again: whatever holds it up is not waited for
            raise KeyboardInterrupt
        caught.append(number)
        stop()

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, *ending_signals())}
    for name, act in signals.items():
        if number := getattr(signal, name, None):  # Windows has few
            before[number] = signal.signal(number, lambda *_, act=act: act())
    try:
        with nullcontext() if options.disable_keyboard_controls else Keyboard(keys):
            yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class NodeCommand(Command):
    """A command that is a node; it takes what ROS's own tool for the same purpose takes.

    Args:
        lists: Options that take several values -> the option that takes each of them here, empty
            for an argument, and what each value ends with.
        letters: ROS version -> short options that mean something else in it -> what they mean.
        defaults: Options that may be without their number -> ROS version, or empty -> the number.
        remaps: Options that take remappings.
        takes_paths: Whether its arguments are paths: without one, a list ends before a file.
    """

    def __init__(
        self,
        *args: Any,
        lists: Mapping[str, tuple[str, str]],
        letters: Mapping[str, Mapping[str, str]],
        defaults: Mapping[str, Mapping[str, str]] = {},
        remaps: Sequence[str] = (),
        takes_paths: bool = False,
        **values: Any,
    ) -> None:
        super().__init__(*args, **values)
        self.lists = lists
        self._letters = letters
        self._defaults = defaults
        self._remaps = remaps
        self._takes_paths = takes_paths

    @property
    def known(self) -> set[str]:
        """All options that are accepted, shown in the help or not."""
        own = {flag for item in self.params for flag in (*item.opts, *item.secondary_opts)}
        letters = {letter for found in self._letters.values() for letter in found}
        return {*own, *self.lists, *letters, "--ros-args", "-r"}

    def translated(self, ctx: click.Context, words: list[str]) -> list[str]:
        """The arguments other than ROS arguments, as this command has them.

        Raises:
            OptionError: An option has no value.
        """
        words, ctx.meta[_NAMES] = node_arguments(words, rules_of=self._remaps)
        version = next((name for name in ("ros1", "ros2") if f"--{name}" in words), "")
        letters = self._letters.get(version, {})
        defaults = {name: by.get(version, by[""]) for name, by in self._defaults.items()}
        return [*self._translate([*self._split(words, letters)][::-1], defaults)]

    def _split(self, words: Sequence[str], letters: Mapping[str, str]) -> Iterator[str]:
        """Values split off from options of several, and letters as the options they mean."""
        for word in words:
            name, has_value, value = word.partition("=")
            if name in self.lists and has_value:
                yield from (name, value)
            elif word in letters:
                yield letters[word]
            elif word[:2] in letters and not word.startswith("--"):
                yield from (letters[word[:2]], word[2:])
            else:
                yield word

    def _translate(self, left: list[str], defaults: Mapping[str, str]) -> Iterator[str]:
        """Lists and missing numbers spelled out; `left` is in reverse order."""
        options = [item for item in self.params if isinstance(item, click.Option)]
        valued = {flag for item in options if not item.is_flag for flag in item.opts}
        has_arguments = False
        while left:
            word = left.pop()
            if word == "--":
                yield from [word, *reversed(left)]
                return
            if word in self.lists:
                name, ending = self.lists[word]
                has_arguments |= not name
                if not left or left[-1].startswith("-"):
                    raise OptionError(f"{word} requires an argument.")
                yield from filter(None, (name, left.pop().removesuffix(ending) + ending))
                while left and self._goes_on(name, left[-1], has_arguments):
                    yield from filter(None, (name, left.pop().removesuffix(ending) + ending))
                continue
            yield word
            if not word.startswith("-") or len(word) == 1:
                has_arguments = True
            elif word in defaults and not (left and _NUMBER.fullmatch(left[-1])):
                yield defaults[word]
            elif word in valued and left:
                yield left.pop()

    def _goes_on(self, name: str, word: str, has_arguments: bool) -> bool:
        """Whether a word is one more value of a list, and not an option or argument."""
        if word.startswith("-") and len(word) > 1:
            return False
        if name in self._remaps:
            return ":=" in word
        is_path = "://" in word or os.path.exists(word)  # noqa: PTH110 - is no argument yet
        return not (self._takes_paths and is_path and not has_arguments)


def accepted(*flags: str, values: int = 0) -> Callable[[Any], Any]:
    """Options of ROS's own tools that have no meaning here.

    Args:
        flags: The options.
        values: How many values each takes.
    """
    kind: dict[str, Any] = {"nargs": values, "type": str} if values else {"is_flag": True}

    def decorate(function: Any) -> Any:
        for flag in flags:
            function = option(
                f"ignored{flag.replace('-', '_')}", flag, hidden=True, expose_value=False, **kind
            )(function)
        return function

    return decorate


# ---------------------------------------------------------------- the keyboard

_POLL_S = 0.2
"""How often to check whether the command is in the foreground again."""

_KEY = re.compile(rb"\x1b[\[O][\x20-\x3f]*[^\x20-\x3f]?|.", re.DOTALL)
_ARROWS = {
    b"\x1b" + kind + letter: name
    for kind in (b"[", b"O")
    for letter, name in ((b"A", "up"), (b"B", "down"), (b"C", "right"), (b"D", "left"))
}


class Keyboard:
    """A context manager that runs actions when keys are pressed.

    It does nothing if standard input is not a terminal.

    The terminal is set to deliver each key at once, without echo, also when the program comes back
    to the foreground. In the background it reads nothing. Its settings are restored at the end;
    while the program is stopped (Ctrl-Z), by the shell.

    Args:
        actions: The action of each key, named as by `keys_in`; other keys are ignored.
        fd: File descriptor of the terminal; None for standard input.
    """

    def __init__(
        self, actions: Mapping[str, Callable[[], object]], *, fd: int | None = None
    ) -> None:
        self._actions = actions
        self._fd: int | None = None
        with suppress(AttributeError, OSError, ValueError):  # standard input is None or closed
            number = sys.stdin.fileno() if fd is None else fd
            self._fd = number if termios is not None and os.isatty(number) else None
        self._before: list[Any] = []

    def __enter__(self) -> Keyboard:
        if self._fd is not None:
            self._before = termios.tcgetattr(self._fd)
            _take(self._fd)
            self._wake = os.pipe()
            arguments = (self._fd, self._wake[0])
            self._thread = threading.Thread(
                target=self._read, args=arguments, name="keys", daemon=True
            )
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the terminal, and end the thread."""
        if self._fd is None:
            return
        os.close(self._wake[1])
        self._thread.join(_POLL_S * 5)  # not for long: the action of a key may be stuck
        if not self._thread.is_alive():
            os.close(self._wake[0])
        if _is_in_foreground(self._fd):
            with suppress(termios.error):  # it was closed
                termios.tcsetattr(self._fd, termios.TCSANOW, self._before)

    def _read(self, fd: int, wake: int) -> None:
        while not select.select([wake], [], [], 0)[0]:
            watched = [wake, fd] if _take(fd) else [wake]
            if fd not in select.select(watched, [], [], _POLL_S)[0]:
                continue
            try:
                data = os.read(fd, 256)
            except OSError:  # it was closed
                return
            if not data:
                return
            for key in keys_in(data):
                if action := self._actions.get(key):
                    action()


def _take(fd: int) -> bool:
    """Have a terminal deliver single keys if the program is in the foreground; returns that."""
    is_ours = _is_in_foreground(fd)
    if is_ours:
        with suppress(termios.error):  # it was closed
            if termios.tcgetattr(fd)[3] & termios.ICANON:
                tty.setcbreak(fd, termios.TCSANOW)
    return is_ours


def keys_in(data: bytes) -> Iterator[str]:
    """The keys in what a terminal sends: a character, ``up``, ``down``, ``left`` or ``right``.

    Other sequences, such as those of function keys, and a lone escape are ignored.
    """
    for key in _KEY.findall(data):
        if key in _ARROWS:
            yield _ARROWS[key]
        elif len(key) == 1 and key.isascii() and key != b"\x1b":
            yield key.decode()


def _is_in_foreground(fd: int) -> bool:
    """Whether the terminal may be read and set: a background program would be stopped."""
    try:
        return os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:  # not the controlling terminal: nothing would stop the program
        return True
