"""Command lines of `rosbag record` and `ros2 bag record`, translated for ``mp4ds record``."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from mp4ds.errors import OptionError
from mp4ds.plugins.ros.names import SERVICE_EVENTS, NodeNames, node_arguments

_SAME = {
    **dict.fromkeys(("-O", "--output-name"), "--output"),
    "--max-bag-size": "--max-size",
    "--topic": "--topics",
}
"""Options of ROS's own recorders -> their name here."""

_ROS2_LETTERS = {"-b": "--max-size", "-s": "--storage"}
_IGNORED = {
    **dict.fromkeys(("--storage", "--storage-preset-profile", "--storage-config-file"), 1),
    **dict.fromkeys(("--compression-mode", "--compression-format", "--chunksize"), 1),
    **dict.fromkeys(("--compression-queue-size", "--compression-threads"), 1),
    **dict.fromkeys(("--compression-threads-priority", "--serialization-format"), 1),
    **dict.fromkeys(("-j", "--bz2", "--lz4", "--tcpnodelay"), 0),
}
"""Options without meaning for a dataset -> the number of values they take."""

_BYTES = "--max-cache-size"
_LISTS = {
    "--topics": ("", ""),
    "--services": ("", SERVICE_EVENTS),
    "--exclude": ("--exclude", ""),
    "--exclude-topics": ("--exclude", ""),
    "--exclude-services": ("--exclude", SERVICE_EVENTS),
    **{name: (name, "") for name in ("--topic-types", "--exclude-topic-types", "--custom-data")},
}
"""Options that take several values -> the option for each (empty: a topic), and its suffix."""

_MB = 10**6


def known_words() -> Collection[str]:
    """Options that are accepted besides those in ``--help``."""
    return {
        *_SAME,
        *_ROS2_LETTERS,
        *_IGNORED,
        *_LISTS,
        _BYTES,
        "--split",
        "--size",
        "--ros-args",
        "-r",
    }


def spelled(
    arguments: Sequence[str], takes_value: Callable[[str], bool]
) -> tuple[list[str], NodeNames]:
    """Translate a command line.

    Args:
        arguments: As typed by the user.
        takes_value: Whether an option of the command takes a value.

    Returns:
        Arguments of the command; name, namespace and remappings of the node.

    Raises:
        OptionError: An option lacks its value.
    """
    words, names = node_arguments(arguments, rules_of=())
    letters = _ROS2_LETTERS if "--ros2" in words else {}
    is_split, is_ros1 = "--split" in words, "--ros1" in words
    made: list[str] = []
    topics: list[str] = []
    patterns = False  # with -e, topics are regular expressions for rosbag record
    left = [part for word in words for part in _parted(letters.get(word, word))][::-1]

    def value(option: str) -> str:
        if not left:
            raise OptionError(f"{option} requires an argument.")
        return left.pop()

    while left:
        word = left.pop()
        name = _SAME.get(word, word)
        if name in _LISTS:
            option, ending = _LISTS[name]
            while left and not left[-1].startswith("-"):
                found = left.pop().removesuffix(ending) + ending
                if option:
                    made += [option, found]
                else:
                    topics.append(found)
        elif name in _IGNORED:
            for _ in range(_IGNORED[name]):
                value(name)
        elif name == _BYTES:
            if not (count := value(name)).isdigit():
                raise OptionError(f"{name} {count!r} is not a number of bytes.")
            made += ["--buffsize", str(max(1, int(count) // _MB))]
        elif name == "--split":
            continue
        elif name == "--size":
            made += ["--max-size", f"{value(name)}M"]
        elif name == "--duration":
            made += ["--max-bag-duration" if is_split else name, _seconds(value(name))]
        elif is_ros1 and name in ("-e", "--regex"):
            patterns = True
        elif is_ros1 and name in ("-x", "--exclude-regex"):
            made += [name, _whole([value(name)])]  # where ROS 2 searches, ROS 1 matches
        elif not name.startswith("-"):
            topics.append(name)
        else:
            made += [name, *([left.pop()] if left and takes_value(name) else [])]
    made += ["--regex", _whole(topics)] if patterns and topics else topics
    return made, names


def _parted(word: str) -> list[str]:
    name, has_value, value = word.partition("=")
    is_ours = name in (*_SAME, *_IGNORED, *_LISTS, _BYTES, "--size", "--duration")
    return [name, value] if has_value and is_ours else [word]


def _seconds(duration: str) -> str:
    """``90``, ``5m`` or ``2h`` in seconds; anything else unchanged."""
    factor = {"m": 60, "h": 3600}.get(duration[-1:], 0)
    return str(int(duration[:-1]) * factor) if factor and duration[:-1].isdigit() else duration


def _whole(patterns: Sequence[str]) -> str:
    return f"^(?:{'|'.join(patterns)})$"
