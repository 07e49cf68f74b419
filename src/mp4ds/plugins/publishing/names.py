"""What ROS tells each of its nodes on the command line: names, and rules for those of topics."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from mp4ds.errors import OptionError

_NODE = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_NAMESPACE = re.compile(r"/?(?:[A-Za-z_]\w*/?)*", re.ASCII)
_RULE = re.compile(r"(?:[A-Za-z_]\w*:(?!=))?([^:=\s]+):=(\S+)")
_BARE = re.compile(r"[~/A-Za-z_][\w/~]*:=.*", re.ASCII)
_VALUED = {
    "-r": "remap",
    "--remap": "remap",
    "--log-level": "log_level",
    "-p": "",
    "--param": "",
    "--params-file": "",
    "--log-config-file": "",
    "-e": "",
    "--enclave": "",
}
"""Arguments of ROS 2 that take a value -> what it is for; empty for what has no meaning here."""

_FLAG = re.compile(r"--(?:enable|disable)-[\w-]+-logs")
_LEVELS = ("debug", "info", "warn", "error", "fatal")


@dataclass(frozen=True)
class NodeNames:
    """What a node is told on the command line.

    Attributes:
        node: Its name; empty for its own.
        namespace: Where it is, such as ``/robot``; empty for the root.
        rules: New names of topics, by the names that the node gives them.
        log_level: How much it is to say, as ROS 2 calls it; empty where that is not told.
    """

    node: str = ""
    namespace: str = ""
    rules: tuple[tuple[str, str], ...] = ()
    log_level: str = ""

    def renamed(self, topic: str) -> str:
        """The name of a topic by the rules; itself where none is about it."""
        found = {self._resolved(old): new for old, new in self.rules}.get(self._resolved(topic))
        return topic if found is None else self._resolved(found)

    def _resolved(self, name: str) -> str:
        root = "/" + self.namespace.strip("/")
        if name.startswith("/"):
            return name
        if name.startswith("~"):
            name = f"{self.node}/{name[1:].lstrip('/')}"
        return f"{root.rstrip('/')}/{name}"


PLAIN = NodeNames()
"""Nothing was told."""


def node_arguments(
    words: Sequence[str], *, rules_of: Sequence[str] = ("--remap", "-m")
) -> tuple[list[str], NodeNames]:
    """Take the arguments of ROS out of a command line.

    Those of ROS 2 stand between ``--ros-args`` and ``--`` or the end; those of ROS 1 anywhere:
    ``__name:=x``, ``__ns:=/y``, ``_parameter:=1``, ``/topic:=/other``. Parameters are left out,
    for a command has none.

    Args:
        words: The command line.
        rules_of: Options of the command that have rules for topics of their own behind them.

    Returns:
        The words that are left, and what ROS told.

    Raises:
        OptionError: An argument of ROS makes no sense.
    """
    rest: list[str] = []
    names = NodeNames()
    left = iter(words)
    is_own = False
    for word in left:
        if word == "--ros-args":
            names = _ros2(left, names)
        elif word == "--":
            return [*rest, word, *left], names
        elif _BARE.fullmatch(word) and not is_own:
            names = _told(names, word)
        else:
            is_own = word in rules_of or (is_own and ":=" in word)
            rest.append(word)
    return rest, names


def _ros2(words: Iterator[str], names: NodeNames) -> NodeNames:
    for word in words:
        name, has_value, value = word.partition("=")
        if word == "--":
            break
        if _FLAG.fullmatch(word):
            continue
        if name not in _VALUED:
            known = ", ".join(_VALUED)
            raise OptionError(f"--ros-args {word} is not known. Use {known}; -- ends them.")
        if not (has_value and name.startswith("--")):
            value = next(words, "")
        if _VALUED[name] == "remap":
            names = _told(names, value)
        elif _VALUED[name] == "log_level":
            names = replace(names, log_level=value if value in _LEVELS else "")
    return names


def _told(names: NodeNames, rule: str) -> NodeNames:
    match = _RULE.fullmatch(rule)
    if not match:
        raise OptionError(f"{rule!r} is no rule of ROS: write it as /old/topic:=/new/topic.")
    old, new = match.groups()
    if old in ("__node", "__name"):
        if not _NODE.fullmatch(new):
            raise OptionError(f"{rule!r}: a node cannot be called {new!r}.")
        return replace(names, node=new)
    if old == "__ns":
        if not _NAMESPACE.fullmatch(new):
            raise OptionError(f"{rule!r}: {new!r} is no namespace, such as /robot.")
        return replace(names, namespace=new)
    if old.startswith("_"):  # __log, __master and the like are read by ROS itself; parameters
        return names
    return replace(names, rules=(*names.rules, (old, new)))
