"""Values of options, as users write them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from mp4ds.errors import OptionError

_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}


def parse_size(text: str | None) -> int | None:
    """Bytes of ``8G``, ``500M`` or ``1.5GB``; units of 1024. None where nothing is given.

    Raises:
        OptionError: It is no size.
    """
    if not text:
        return None
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?) *([kmgt]?)(?:i?b)?", text.strip().lower())
    size = int(float(match[1]) * _UNITS[match[2]]) if match else 0
    if not size:
        raise OptionError(f"--memory {text!r} is no size. Give one such as 8G or 500M.")
    return size


def parse_share(text: str) -> tuple[int, int]:
    """Number and count of ``I/N``.

    Raises:
        OptionError: It is none.
    """
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise OptionError(f"--shard {text!r} is not I/N, such as 3/16, with I from 1 to N.")
    return int(match[1]), int(match[2])


def spelled(arguments: Sequence[str]) -> list[str]:
    """Arguments of the command line, ``play --clock 50`` with its rate as an option of its own.

    ``--clock`` is a flag of `rosbag play` and takes a number, if there is one, from users of
    ``ros2 bag play``.
    """
    if arguments[:1] != ["play"]:
        return [*arguments]
    made: list[str] = []
    for argument in arguments:
        name, has_value, value = argument.partition("=")
        if name == "--clock" and has_value:
            made += ["--clock", "--hz", value]
        elif made[-1:] == ["--clock"] and re.fullmatch(r"[0-9]+(\.[0-9]+)?", argument):
            made += ["--hz", argument]
        else:
            made.append(argument)
    return made


def parse_resize(text: str | None) -> float | tuple[int, int] | None:
    """A factor, or width and height, of ``0.5`` or ``640x480``. None where nothing is given.

    Raises:
        OptionError: It is neither.
    """
    if text is None:
        return None
    match = re.fullmatch(r"([0-9]{1,6})x([0-9]{1,6})", text.strip().lower())
    if match:
        return int(match[1]), int(match[2])
    try:
        return float(text)
    except ValueError:
        raise OptionError(
            f"--resize {text!r} is no size. Give a factor such as 0.5, or WxH such as 640x480."
        ) from None
