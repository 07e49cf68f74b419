"""Lists of times, of files and of measurements: texts with a line for each."""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused, SourceError

MAX_STAMP = 2**31 * 10**9 - 1
"""The latest time that a ROS 2 message can represent, nanoseconds: in 2038."""

ROUNDED = "times finer than a nanosecond, which were rounded"

Row = tuple[int, list[str]]
"""Number of a line, from 1, and its values."""

_UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_CERTAIN_DIGITS = 16  # of nanoseconds since 1970; counts of seconds or images have fewer
_NUMBER = re.compile(r"\+?([0-9]{1,40})(?:(\.[0-9]{0,40})?([eE][-+]?[0-9]{1,2})?)?")
_MAX_TEXT = 2**30
_MAX_LINE = 2**16


def is_number(text: str) -> bool:
    """Whether a text is a number that may be a time."""
    return _NUMBER.fullmatch(text) is not None


def unit_of(texts: Sequence[str]) -> str | None:
    """The unit of numbers: seconds if one has decimals, nanoseconds if they are long.

    Returns:
        ``s`` or ``ns``; None if unknown.
    """
    if any(not text.lstrip("+").isdigit() for text in texts):
        return "s"
    longest = max((len(text.lstrip("+0")) for text in texts), default=0)
    return "ns" if longest >= _CERTAIN_DIGITS else None


def at_rate(count: int, rate: str) -> NDArray[np.int64]:
    """Times of images at a rate, from 0 on, rounded to nanoseconds.

    Args:
        count: Number of images.
        rate: Images per second, such as ``20``, ``29.97`` or ``30000/1001``.

    Raises:
        Refused: It is not a rate.
    """
    try:
        found = Fraction(rate)
    except (ValueError, ZeroDivisionError):
        found = Fraction(0)
    if not Fraction(1, 10**6) <= found <= 10**6:
        raise Refused(f"{rate!r} is not a rate in Hz")
    times = [round(number * 10**9 / found) for number in range(count)]
    if times and times[-1] > MAX_STAMP:
        raise Refused(f"{rate!r} Hz is too slow for {count} images")
    return np.array(times, np.int64)


def rows_of(path: Path) -> Iterator[Row]:
    """The lines of a list that are neither blank nor comments.

    Values are between commas if there is one in the line, else between spaces.

    Raises:
        SourceError: It is not a text file, or too large for a list.
        OSError: It cannot be read.
    """
    for number, line in _lines_of(path):
        yield number, [part.strip() for part in line.split(",")] if "," in line else line.split()


def _lines_of(path: Path) -> Iterator[tuple[int, str]]:
    if path.stat().st_size > _MAX_TEXT:
        raise SourceError(path, f"is larger than {_MAX_TEXT} bytes, so it cannot be a list")
    try:
        with path.open(encoding="utf-8-sig") as stream:
            for number, line in enumerate(iter(lambda: stream.readline(_MAX_LINE + 1), ""), 1):
                if len(line) > _MAX_LINE:  # what follows of it would be taken for another line
                    raise SourceError(path, f"line {number} is too long for a list")
                text = line.strip()
                if text and not text.startswith("#"):
                    yield number, text
    except UnicodeDecodeError:
        raise SourceError(path, "is not a text file") from None


class ListReader:
    """Reads lists whose lines begin with a time.

    Args:
        unit: Of the times: ``s``, ``ms``, ``us`` or ``ns``.
        left_out: Counts what is not taken as it is: a phrase -> how many.
    """

    def __init__(self, unit: str, left_out: Counter[str]) -> None:
        self._unit, self._left_out = unit, left_out

    def time(self, text: str) -> int:
        """Nanoseconds of a time.

        Raises:
            Refused: It is none.
        """
        if not is_number(text):
            raise Refused(f"{text!r} is not a time in {self._unit}")
        exact = Fraction(text) * _UNITS[self._unit]
        nanoseconds = round(exact)
        if not 0 <= nanoseconds <= MAX_STAMP:
            raise Refused(f"{text!r} is not between 1970 and 2038, the range of ROS 2 times")
        if nanoseconds != exact:
            self._left_out[ROUNDED] += 1
        return nanoseconds

    def times(self, path: Path, rows: Iterable[Row]) -> NDArray[np.int64]:
        """The times at the start of a list's rows.

        Raises:
            SourceError: One is not valid; names its line.
        """
        return np.array([self._time_of(path, row) for row in rows], np.int64)

    def _time_of(self, path: Path, row: Row) -> int:
        try:
            return self.time(row[1][0])
        except Refused as error:
            raise SourceError(path, f"line {row[0]}: {error}") from None

    def table(
        self, path: Path, count: int, *, shortened: str = ""
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Times and numbers of a list.

        A number may be NaN or infinite: a sensor says so, and a message can hold it.

        Args:
            path: The file.
            count: Numbers of each row after the time.
            shortened: The phrase that counts rows with further numbers, which are not taken;
                empty if there may be none.

        Raises:
            SourceError: A line has different values; names it.
        """
        times, numbers = array("q"), array("d")
        for number, row in rows_of(path):
            times.append(self._time_of(path, (number, row)))
            if len(row) <= count or (len(row) > count + 1 and not shortened):
                raise SourceError(path, f"line {number} has {len(row)} values, not {count + 1}")
            if len(row) > count + 1:
                self._left_out[shortened] += 1
            try:
                numbers.extend(map(float, row[1 : count + 1]))
            except ValueError:
                problem = f"line {number} holds something other than numbers"
                raise SourceError(path, problem) from None
        return np.array(times, np.int64), np.array(numbers, np.float64).reshape(-1, count)

    def images(
        self, path: Path, folder: Path, rows: Sequence[Row] | None = None
    ) -> tuple[list[Path], NDArray[np.int64]]:
        """The images of a list of times and file names.

        Args:
            path: The list.
            folder: The folder of the files.
            rows: The time and name of each, if already read.

        Raises:
            SourceError: A line is not a time and name, or its file does not exist.
        """
        if rows is None:
            rows = [
                # in two: a name may have spaces in it
                (number, [part.strip() for part in re.split(r",|\s", line, maxsplit=1)])
                for number, line in _lines_of(path)
            ]
        times = self.times(path, rows)
        return [_listed(path, folder, *row) for row in rows], times


def _listed(path: Path, folder: Path, number: int, values: list[str]) -> Path:
    if len(values) != 2 or not values[1]:
        raise SourceError(path, f"line {number} is not a time and a file name")
    name = PurePosixPath(values[1])
    if name.is_absolute() or ".." in name.parts:
        raise SourceError(path, f"line {number} names a file outside of {folder}: {name}")
    image = folder / name
    if not image.is_file():
        raise SourceError(path, f"line {number} names {image}, which does not exist")
    return image
