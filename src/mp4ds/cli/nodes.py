"""Commands that run as ROS nodes: they take the arguments of ROS, and those of ROS's own tools."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

import click

from mp4ds.cli.keyboard import Keyboard
from mp4ds.cli.options import Command, option
from mp4ds.cli.output import be_quiet, complain
from mp4ds.cli.process import DEBUG, caught_signals
from mp4ds.cli.progress import Row, display
from mp4ds.errors import OptionError
from mp4ds.options import WHERE, Options
from mp4ds.options import option as field_option
from mp4ds.plugins.ros.names import LOG_LEVELS, PLAIN, NodeNames, node_arguments

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
        be_quiet()
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
    options: RosOptions, stop: Callable[[], None], keys: Mapping[str, Callable[[], object]]
) -> Iterator[Sequence[int]]:
    """Stop a node on signals, which are returned, and run actions when keys are pressed."""
    keyboard = nullcontext() if options.disable_keyboard_controls else Keyboard(keys)
    with caught_signals(stop) as caught, keyboard:
        yield caught


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
