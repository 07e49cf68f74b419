"""ROS arguments of a node on the command line: names and remappings."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from mp4ds.errors import OptionError

SERVICE_EVENTS = "/_service_event"
"""What follows the name of a service in that of the topic of its events, in ROS 2."""

_NODE = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_NAMESPACE = re.compile(r"/?(?:[A-Za-z_]\w*/?)*", re.ASCII)
_RULE = re.compile(r"(?:[A-Za-z_]\w*:(?!=))?([^:=\s]+):=(\S+)")
_OTHER = re.compile(r"_(?!_(?:node|name|ns):=).*:=.*", re.DOTALL)
"""Handled by ROS itself, such as ``__log:=``, or a private parameter."""

_BARE = re.compile(r"[~/A-Za-z_][\w/~]*:=.*", re.ASCII)
_VALUED = {
    "-r": "remap",
    "--remap": "remap",
    "--log-level": "log_level",
    "-p": "parameter",
    "--param": "parameter",
    "--params-file": "file",
    "--log-config-file": "",
    "-e": "",
    "--enclave": "",
}
"""ROS 2 arguments that take a value -> what it is; empty for those that are ignored."""

_SIM_TIME = "use_sim_time"
_FLAG = re.compile(r"--(?:enable|disable)-[\w-]+-logs")
LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")
_MAX_BYTES = 2**20
_Loader: type[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class NodeNames:
    """The ROS arguments of a node.

    Attributes:
        node: Its name; empty for the default.
        namespace: Its namespace, such as ``/robot``; empty for the root.
        rules: Remappings of topics: old name, new name.
        log_level: The log level, as in ROS 2; empty if not given.
        use_sim_time: The parameter of this name; None if not given.
    """

    node: str = ""
    namespace: str = ""
    rules: tuple[tuple[str, str], ...] = ()
    log_level: str = ""
    use_sim_time: bool | None = None

    def in_world(self, world: str | None) -> NodeNames:
        """The same for a ROS version: in ROS 1 the environment may set the namespace."""
        namespace = os.environ.get("ROS_NAMESPACE", "") if world == "ros1" else ""
        return replace(self, namespace=namespace) if namespace and not self.namespace else self

    def of_node(self, node: str) -> str:
        """The node's name with its namespace, such as ``robot/player``; `node` is the default."""
        return "/".join(filter(None, (self.namespace.strip("/"), self.node or node)))

    def renamed(self, topic: str) -> str:
        """The name of a topic after remapping; unchanged if no rule applies."""
        found = {self.resolved(old): new for old, new in self.rules}.get(self.resolved(topic))
        return topic if found is None else self.resolved(found)

    def resolved(self, name: str) -> str:
        """The absolute name, such as ``/robot/imu``."""
        root = "/" + self.namespace.strip("/")
        if name.startswith("/"):
            return name
        if name.startswith("~"):
            name = f"{self.node}/{name[1:].lstrip('/')}"
        return f"{root.rstrip('/')}/{name}"


PLAIN = NodeNames()
"""No ROS arguments."""


def node_arguments(
    words: Sequence[str], *, rules_of: Sequence[str] = ("--remap", "-m")
) -> tuple[list[str], NodeNames]:
    """Separate the ROS arguments from the others of a command line.

    ROS 2 arguments are between ``--ros-args`` and ``--`` or the end, ROS 1 arguments anywhere:
    ``__name:=x``, ``__ns:=/y``, ``_parameter:=1``, ``/topic:=/other``. Parameters other than
    ``use_sim_time`` are ignored.

    Args:
        words: The command line.
        rules_of: Options of the command itself that take remappings.

    Returns:
        The other arguments, and the ROS arguments.

    Raises:
        OptionError: A ROS argument is not valid.
    """
    rest: list[str] = []
    names = NodeNames()
    parameters: list[tuple[str, str]] = []
    left = iter(words)
    is_own = False
    for word in left:
        if word == "--ros-args":
            names = _ros2(left, names, parameters)
        elif word == "--":
            rest += [word, *left]
        elif _BARE.fullmatch(word) and not is_own:
            names = _with_rule(names, word)
        else:
            is_own = word in rules_of or (is_own and ":=" in word)
            rest.append(word)
    for kind, value in parameters:  # last, as files have sections for node names
        names = _with_file(names, Path(value)) if kind == "file" else _with(names, value)
    return rest, names


def _ros2(words: Iterator[str], names: NodeNames, parameters: list[tuple[str, str]]) -> NodeNames:
    for word in words:
        name, has_value, value = word.partition("=")
        if word == "--":
            break
        if _FLAG.fullmatch(word):
            continue
        if name not in _VALUED:
            known = ", ".join(_VALUED)
            raise OptionError(f"--ros-args {word} is not known. Use {known}; end them with --.")
        if not (has_value and name.startswith("--")):
            value = next(words, "")
        if _VALUED[name] == "remap":
            names = _with_rule(names, value)
        elif _VALUED[name] == "log_level":
            names = replace(names, log_level=value if value in LOG_LEVELS else "")
        elif _VALUED[name]:
            parameters.append((_VALUED[name], value))
    return names


def _with(names: NodeNames, parameter: str) -> NodeNames:
    """Add a parameter given as ``name:=value``."""
    name, is_given, value = parameter.partition(":=")
    if not is_given:
        raise OptionError(f"{parameter!r} is not a ROS parameter; write it as name:=value.")
    if name.rpartition(":")[2] != _SIM_TIME:
        return names
    return replace(names, use_sim_time=_truth(value, "--ros-args"))


def _with_file(names: NodeNames, path: Path) -> NodeNames:
    """Add the parameters that a file has for this node."""
    own = names.of_node("")
    for node, parameters in _nodes(load_map(path, "nodes to parameters"), ""):
        if node in ("**", own) and _SIM_TIME in parameters:
            names = replace(names, use_sim_time=_truth(parameters[_SIM_TIME], str(path)))
    return names


def load_map(path: Path, of: str) -> dict[Any, Any]:
    """Read a small YAML file of the user's.

    Args:
        path: The file; an empty one is an empty map.
        of: What it maps, for errors.

    Raises:
        OptionError: It cannot be read, or is not a map.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise OptionError(f"{path}: cannot be read: {error.strerror}.") from None
    if len(data) > _MAX_BYTES:
        raise OptionError(f"{path}: is larger than {_MAX_BYTES} bytes, too large to map {of}.")
    try:
        document = yaml.load(data.decode(), Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise OptionError(f"{path}: is not valid YAML: {reason}.") from None
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise OptionError(f"{path}: does not map {of}.")
    return document


def _nodes(found: Mapping[Any, Any], place: str) -> Iterator[tuple[str, Mapping[Any, Any]]]:
    for key, value in found.items():
        if isinstance(value, dict) and key == "ros__parameters":
            yield place, value
        elif isinstance(value, dict):
            yield from _nodes(value, f"{place}/{key}".replace("//", "/").strip("/"))


def _truth(value: Any, place: str) -> bool:
    known = {"true": True, "false": False}
    if str(value).lower() in known:
        return known[str(value).lower()]
    raise OptionError(f"{place}: {_SIM_TIME} must be true or false, not {value!r}.")


def _with_rule(names: NodeNames, rule: str) -> NodeNames:
    if _OTHER.fullmatch(rule):
        return names
    match = _RULE.fullmatch(rule)
    if not match:
        raise OptionError(f"{rule!r} is not a remapping; write it as /old/topic:=/new/topic.")
    old, new = match.groups()
    if old in ("__node", "__name"):
        if not _NODE.fullmatch(new):
            raise OptionError(f"{rule!r}: {new!r} is not a valid node name.")
        return replace(names, node=new)
    if old == "__ns":
        if not _NAMESPACE.fullmatch(new):
            raise OptionError(f"{rule!r}: {new!r} is not a valid namespace, such as /robot.")
        return replace(names, namespace=new)
    return replace(names, rules=(*names.rules, (old, new)))
