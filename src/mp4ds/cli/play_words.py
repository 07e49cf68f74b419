"""Accept the options of `rosbag play` and `ros2 bag play` in ``mp4ds play``."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

from mp4ds.errors import OptionError
from mp4ds.plugins.ros.names import SERVICE_EVENTS, NodeNames, node_arguments

STORAGES = ("sqlite3", "mcap")

_LETTERS = {
    "ros1": {"-p": "--prefix"},
    "ros2": {"-x": "--exclude-regex", "-s": "--storage", "-i": "--input"},
}
"""Short options that mean different things in the two players -> their long options here."""

_LISTS = {
    **dict.fromkeys(("--topics", "--exclude-topics", "--clock-topics", "--pause-topics"), ""),
    "--remap": "",
    "-m": "--remap",
    "--services": "--topics",
    "--exclude-services": "--exclude-topics",
}
"""Options that take several values -> their name here, if it differs."""

_NUMBER = re.compile(r"[0-9]+(\.[0-9]+)?")
_IGNORED = {
    "--disable-loan-message": 0,
    "--try-future-version": 0,
    "--storage-config-file": 1,
    "--progress-bar-separation-lines": 1,
}
"""Options that have no effect here -> how many values they take."""

_NO_CALLS = "services are not called; recorded service events are played as topics"
_REFUSED = {
    "--publish-service-requests": _NO_CALLS,
    "--service-requests-source": _NO_CALLS,
}
_TRANSLATED = ("--bags", "--input", "--message-order", "--progress-bar-update-rate")


def known_words() -> Collection[str]:
    """Options that are accepted but not shown by ``--help``."""
    letters = (name for found in _LETTERS.values() for name in found)
    return {*_LISTS, *_IGNORED, *_REFUSED, *_TRANSLATED, *letters, "--ros-args", "-r"}


def spelled(
    arguments: Sequence[str], takes_value: Callable[[str], bool]
) -> tuple[list[str], NodeNames]:
    """Translate arguments of other players to those of this command; and the ROS arguments.

    Args:
        arguments: As typed by the user.
        takes_value: Whether an option of this command takes a value.

    Raises:
        OptionError: An option of another player is not supported, or its value is not valid.
    """
    words, names = node_arguments(arguments, rules_of=("--remap", "-m"))
    flavour = "ros1" if "--ros1" in words else "ros2" if "--ros2" in words else ""
    made = _Translator(_split(words, _LETTERS.get(flavour, {})), takes_value)
    made.has_datasets = "--bags" in words
    result = [*made]
    if flavour == "ros2" and "--clock" in result and "--hz" not in result:
        result += ["--hz", "40"]
    return result, names


def _split(words: Sequence[str], letters: dict[str, str]) -> list[str]:
    """Arguments with values split off from their options, and short options as long ones."""
    made: list[str] = []
    for word in words:
        name, has_value, value = word.partition("=")
        if name in (*_LISTS, *_IGNORED, *_TRANSLATED, "--clock") and has_value:
            made += [name, value]
        elif word[:2] in letters and not word.startswith("--"):
            made += [letters[word[:2]], *filter(None, [word[2:]])]
        else:
            made.append(word)
    return made


class _Translator:
    """Iterates over arguments, translated to those of this command."""

    def __init__(self, words: list[str], takes_value: Callable[[str], bool]) -> None:
        self._rest = words[::-1]
        self._takes_value = takes_value
        self.has_datasets = False

    def __iter__(self) -> Iterator[str]:
        while self._rest:
            word = self._rest.pop()
            if word == "--":
                yield word
                yield from self._rest[::-1]
                return
            if word in _LISTS:
                yield from self._list(word)
            elif word in _REFUSED:
                raise OptionError(f"{word} is not supported: {_REFUSED[word]}.")
            elif word in _IGNORED:
                for _ in range(_IGNORED[word]):
                    self._value(word)
            elif word in _TRANSLATED:
                yield from self._foreign(word)
            elif word == "--clock":
                yield word
                if self._rest and _NUMBER.fullmatch(self._rest[-1]):
                    yield from ("--hz", self._rest.pop())
            else:
                yield word
                if word.startswith("-") and len(word) > 1:
                    yield from [self._rest.pop()] if self._rest and self._takes_value(word) else []
                else:
                    self.has_datasets = True

    def _value(self, option: str) -> str:
        if not self._rest:
            raise OptionError(f"{option} requires an argument.")
        return self._rest.pop()

    def _list(self, option: str) -> Iterator[str]:
        """Values up to the next option, or up to a dataset if none was given before."""
        name, is_first = _LISTS[option] or option, True
        ending = SERVICE_EVENTS if "services" in option else ""
        while is_first or (self._rest and self._is_in_list(name, self._rest[-1])):
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
            while self._rest and not self._rest[-1].startswith("-"):
                yield self._rest.pop()
        elif option == "--input":
            self.has_datasets = True
            yield self._value(option)
            if self._rest and self._rest[-1] in STORAGES:
                self._rest.pop()
        elif option == "--message-order":
            if (order := self._value(option)) != "received":
                raise OptionError(
                    f"--message-order {order!r} is not supported: messages are played in the order "
                    "in which they were received."
                )
        elif not _NUMBER.fullmatch(rate := self._value(option)) or not float(rate):
            yield "--no-progress"
