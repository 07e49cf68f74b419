"""Values of options, as users write them."""

from __future__ import annotations

import re

from mp4ds.errors import OptionError

_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}


def parse_size(text: str) -> int:
    """Bytes of ``8G``, ``500M`` or ``1.5GB``; units of 1024.

    Raises:
        OptionError: It is no size.
    """
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
