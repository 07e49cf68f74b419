"""The command line of ``mp4ds play`` as users of `rosbag play` and `ros2 bag play` type it."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

from mp4ds.errors import OptionError
from mp4ds.plugins.publishing.names import NodeNames, node_arguments

STORAGES = ("sqlite3", "mcap")

_LETTERS = {
    "ros1": {"-p": "--prefix"},
    "ros2": {"-x": "--exclude-regex", "-s": "--storage", "-i": "--input"},
}
"""What letters mean to users of one player that mean something else to those of the other."""

_LISTS = {
    **dict.fromkeys(("--topics", "--exclude-topics", "--clock-topics", "--pause-topics"), ""),
    "--remap": "",
    "-m": "--remap",
    "--services": "--topics",
    "--exclude-services": "--exclude-topics",
}
"""Options with several words behind them -> what they are called here, if otherwise."""

_EVENTS = "/_service_event"  # a service's topic, where its calls are recorded
_NUMBER = re.compile(r"[0-9]+(\.[0-9]+)?")
_IGNORED = {
    "--disable-loan-message": 0,
    "--try-future-version": 0,
    "--storage-config-file": 1,
    "--progress-bar-separation-lines": 1,
}
"""Options that change nothing here -> how many words they take."""

_REFUSED = {
    "--publish-service-requests": "services are not called; their events are played as topics",
    "--service-requests-source": "services are not called; their events are played as topics",
}
_FOREIGN = ("--bags", "--input", "--message-order", "--progress-bar-update-rate")


def known_words() -> Collection[str]:
    """Options that are understood besides those that ``--help`` shows."""
    letters = (name for found in _LETTERS.values() for name in found)
    return {*_LISTS, *_IGNORED, *_REFUSED, *_FOREIGN, *letters, "--ros-args", "-r"}


def spelled(
    arguments: Sequence[str], takes_value: Callable[[str], bool]
) -> tuple[list[str], NodeNames]:
    """Arguments as the command has them, and what ROS tells the node.

    Args:
        arguments: As they were typed.
        takes_value: Whether an option of the command has a word behind it.

    Raises:
        OptionError: An option of another player has no meaning here, or a value that is none.
    """
    words, names = node_arguments(arguments, rules_of=("--remap", "-m"))
    flavour = "ros1" if "--ros1" in words else "ros2" if "--ros2" in words else ""
    made = _Words(_split(words, _LETTERS.get(flavour, {})), takes_value)
    made.has_datasets = "--bags" in words
    result = [*made]
    if flavour == "ros2" and "--clock" in result and "--hz" not in result:
        result += ["--hz", "40"]
    return result, names


def _split(words: Sequence[str], letters: dict[str, str]) -> list[str]:
    """Words with values of their own, and with letters as the long names that they stand for."""
    made: list[str] = []
    for word in words:
        name, has_value, value = word.partition("=")
        if name in (*_LISTS, *_IGNORED, *_FOREIGN, "--clock") and has_value:
            made += [name, value]
        elif word[:2] in letters and not word.startswith("--"):
            made += [letters[word[:2]], *filter(None, [word[2:]])]
        else:
            made.append(word)
    return made


class _Words:
    """Goes through words, and gives those of the command."""

    def __init__(self, words: list[str], takes_value: Callable[[str], bool]) -> None:
        self._left = words[::-1]
        self._takes_value = takes_value
        self.has_datasets = False

    def __iter__(self) -> Iterator[str]:
        while self._left:
            word = self._left.pop()
            if word == "--":
                yield word
                yield from self._left[::-1]
                return
            if word in _LISTS:
                yield from self._list(word)
            elif word in _REFUSED:
                raise OptionError(f"{word} has no counterpart: {_REFUSED[word]}.")
            elif word in _IGNORED:
                for _ in range(_IGNORED[word]):
                    self._value(word)
            elif word in _FOREIGN:
                yield from self._foreign(word)
            elif word == "--clock":
                yield word
                if self._left and _NUMBER.fullmatch(self._left[-1]):
                    yield from ("--hz", self._left.pop())
            else:
                yield word
                if word.startswith("-") and len(word) > 1:
                    yield from [self._left.pop()] if self._left and self._takes_value(word) else []
                else:
                    self.has_datasets = True

    def _value(self, option: str) -> str:
        if not self._left:
            raise OptionError(f"{option} requires an argument.")
        return self._left.pop()

    def _list(self, option: str) -> Iterator[str]:
        """Words up to the next option; or to a dataset, where none was told before."""
        name, is_first = _LISTS[option] or option, True
        ending = _EVENTS if "services" in option else ""
        while is_first or (self._left and self._is_in_list(name, self._left[-1])):
            value = self._value(option)
            if value.startswith("-"):
                raise OptionError(f"{option} requires an argument.")
            yield from (name, value + (ending if not value.endswith(ending) else ""))
            is_first = False

    def _is_in_list(self, name: str, word: str) -> bool:
        if word.startswith("-") and len(word) > 1:
            return False
        if name == "--remap":
            return ":=" in word
        return self.has_datasets or not ("://" in word or Path(word).exists())

    def _foreign(self, option: str) -> Iterator[str]:
        if option == "--bags":
            while self._left and not self._left[-1].startswith("-"):
                yield self._left.pop()
        elif option == "--input":
            self.has_datasets = True
            yield self._value(option)
            if self._left and self._left[-1] in STORAGES:
                self._left.pop()
        elif option == "--message-order":
            if (order := self._value(option)) != "received":
                raise OptionError(
                    f"--message-order {order!r}: messages come as they were received."
                )
        elif not _NUMBER.fullmatch(rate := self._value(option)) or not float(rate):
            yield "--no-progress"
