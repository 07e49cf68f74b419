"""Times as text, exactly in nanoseconds: never by way of floats."""

from __future__ import annotations

import re
from calendar import timegm
from collections import Counter
from collections.abc import Callable, Sequence
from datetime import datetime
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds of each unit."""

MAX_STAMP = 2**31 * 10**9 - 1
"""The latest time that a message of ROS 2 has bits for, nanoseconds: in 2038."""

ROUNDED = "times finer than a nanosecond, which were rounded to it"

_CERTAIN_DIGITS = 16  # of nanoseconds since 1970; a count of seconds or images has fewer
_NUMBER = re.compile(r"\+?([0-9]{1,40})(?:(\.[0-9]{0,40})?([eE][-+]?[0-9]{1,2})?)?")
_DATE = re.compile(r"([0-9]{4}-[0-9]{2}-[0-9]{2}[ T][0-9]{2}:[0-9]{2}:[0-9]{2})(\.[0-9]{1,40})?")


class NoTimeError(ValueError):
    """A text that is no time; the message is a phrase."""


def is_number(text: str) -> bool:
    """Whether a text is a number that may be a time."""
    return _NUMBER.fullmatch(text) is not None


def unit_of(texts: Sequence[str]) -> str | None:
    """The unit that numbers have: seconds if one has decimals, nanoseconds if they are long.

    Returns:
        ``s`` or ``ns``; None if nothing tells.
    """
    if any(not text.lstrip("+").isdigit() for text in texts):
        return "s"
    longest = max((len(text.lstrip("+0")) for text in texts), default=0)
    return "ns" if longest >= _CERTAIN_DIGITS else None


def of_unit(unit: str, found: Counter[str]) -> Callable[[str], int]:
    """What reads numbers of a unit.

    Args:
        unit: One of `UNITS`.
        found: Gets how many were rounded.

    Returns:
        Text -> nanoseconds; it raises NoTimeError.
    """
    scale = UNITS[unit]

    def read(text: str) -> int:
        if not _NUMBER.fullmatch(text):
            raise NoTimeError(f"{text!r} is no time in {unit}")
        return _checked(Fraction(text) * scale, text, found)

    return read


def of_date(found: Counter[str]) -> Callable[[str], int]:
    """What reads ``2011-09-26 13:02:25.964389445``, which is taken for UTC. See `of_unit`."""

    def read(text: str) -> int:
        match = _DATE.fullmatch(text.strip())
        try:
            whole = datetime.fromisoformat(match[1]) if match else None
        except ValueError:
            whole = None
        if match is None or whole is None:
            raise NoTimeError(f"{text!r} is no date and time")
        seconds = timegm(whole.timetuple()) + Fraction(f"0{match[2] or ''}")
        return _checked(seconds * UNITS["s"], text, found)

    return read


def _checked(time: Fraction, text: str, found: Counter[str]) -> int:
    nanoseconds = round(time)
    if not 0 <= nanoseconds <= MAX_STAMP:
        raise NoTimeError(f"{text!r} is not a time from 1970 to 2038, which is what ROS 2 has")
    if nanoseconds != time:
        found[ROUNDED] += 1
    return nanoseconds


def at_rate(count: int, rate: str) -> NDArray[np.int64]:
    """Times of images at a rate, from 0 on, rounded to nanoseconds.

    Args:
        count: How many.
        rate: Images per second, such as ``20``, ``29.97`` or ``30000/1001``.

    Raises:
        NoTimeError: It is no rate.
    """
    try:
        found = Fraction(rate)
    except (ValueError, ZeroDivisionError):
        found = Fraction(0)
    if not Fraction(1, 10**6) <= found <= 10**6:
        raise NoTimeError(f"{rate!r} is no rate in Hz")
    times = [round(number * 10**9 / found) for number in range(count)]
    if times and times[-1] > MAX_STAMP:
        raise NoTimeError(f"{rate!r} Hz is too slow for {count} images")
    return np.array(times, np.int64)
