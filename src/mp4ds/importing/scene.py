"""What a layout finds in a folder, and how its lists are read."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import SourceError
from mp4ds.importing.times import NoTimeError
from mp4ds.wire import CalibrationFields
from mp4ds.wire.transforms import Transform

MAX_TEXT = 2**30
_MAX_LINE = 2**16


@dataclass(frozen=True)
class Camera:
    """The images of a camera, by time.

    Attributes:
        topic: Of its raw images.
        frame_id: Coordinate frame.
        files: The images.
        stamps: Their times, nanoseconds, int64, shape (images,).
        calibration: Its intrinsics, where they are known.
        encoding: ROS image encoding; None: the one that the files tell.
    """

    topic: str
    frame_id: str
    files: Sequence[Path]
    stamps: NDArray[np.int64]
    calibration: CalibrationFields | None = None
    encoding: str | None = None

    def by_time(self) -> Camera:
        """The same in the order of the times; those of one time stay in theirs."""
        order = np.argsort(self.stamps, kind="stable")
        files = [self.files[number] for number in order.tolist()]
        return replace(self, files=files, stamps=self.stamps[order])


@dataclass(frozen=True)
class Table:
    """Measurements of a sensor that is no camera.

    Attributes:
        topic: Its topic.
        kind: One of `mp4ds.importing.messages.TABLES`.
        frame_id: Coordinate frame.
        stamps: Nanoseconds, int64, shape (rows,).
        rows: float64, shape (rows, values).
    """

    topic: str
    kind: str
    frame_id: str
    stamps: NDArray[np.int64]
    rows: NDArray[np.float64]

    def by_time(self) -> Table:
        """The same in the order of the times."""
        order = np.argsort(self.stamps, kind="stable")
        return replace(self, stamps=self.stamps[order], rows=self.rows[order])


@dataclass
class Scene:
    """All that a folder holds.

    Attributes:
        folder: The folder.
        files: What it was read from; folders of images among them.
        cameras: Its cameras.
        tables: Its other sensors.
        transforms: Where they are.
        kept: Files that are stored as they are: what messages do not say all of.
        skipped: What is left out: a phrase -> how many.
    """

    folder: Path
    files: list[Path] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    transforms: list[Transform] = field(default_factory=list)
    kept: list[Path] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)

    def leave_out(self, path: Path, what: str) -> None:
        """Count the files of something that does not become messages."""
        files = [path] if path.is_file() else [item for item in path.rglob("*") if item.is_file()]
        if files:
            self.skipped[f"files of {what}"] += len(files)


def lines_of(path: Path) -> Iterator[tuple[int, str]]:
    """Number, from 1, and text of each line that is neither blank nor a comment.

    Raises:
        SourceError: It is no text, or cannot be read.
    """
    try:
        if path.stat().st_size > MAX_TEXT:
            raise SourceError(path, f"is larger than {MAX_TEXT} bytes, and no list")
        with path.open(encoding="utf-8-sig") as stream:
            for number, line in enumerate(iter(lambda: stream.readline(_MAX_LINE), ""), start=1):
                text = line.strip()
                if text and not text.startswith("#"):
                    yield number, text
    except UnicodeDecodeError:
        raise SourceError(path, "is no text") from None
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None


def split(line: str) -> list[str]:
    """The values of a line: between commas if there is one, else between spaces."""
    if "," in line:
        return [part.strip() for part in line.split(",")]
    return line.split()


Rows = list[tuple[int, list[str]]]


def read_times(path: Path, rows: Rows, read: Callable[[str], int]) -> NDArray[np.int64]:
    """The times with which the rows of a list begin.

    Raises:
        SourceError: One is none; names its line.
    """
    times = np.empty(len(rows), np.int64)
    for place, (number, values) in enumerate(rows):
        try:
            times[place] = read(values[0])
        except NoTimeError as error:
            raise SourceError(path, f"line {number}: {error}") from None
    return times


def read_table(
    path: Path, read: Callable[[str], int], values: int, *, more: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Times and numbers of a list.

    Args:
        path: The file.
        read: Reads a time.
        values: Numbers of each row after the time.
        more: Whether further ones may follow, which are not read.

    Raises:
        SourceError: A line has other values; names it.
    """
    rows = [(number, split(line)) for number, line in lines_of(path)]
    times = read_times(path, rows, read)
    table = np.empty((len(rows), values))
    for place, (number, row) in enumerate(rows):
        if len(row) < values + 1 or (len(row) > values + 1 and not more):
            raise SourceError(path, f"line {number} has {len(row)} values, not {values + 1}")
        try:
            table[place] = [float(text) for text in row[1 : values + 1]]
        except ValueError:
            raise SourceError(path, f"line {number} holds something else than numbers") from None
    return times, table


def listed_images(
    path: Path, folder: Path, read: Callable[[str], int], rows: Rows | None = None
) -> tuple[list[Path], NDArray[np.int64]]:
    """The images of a list of times and file names.

    Args:
        path: The list.
        folder: In which the files are.
        read: Reads a time.
        rows: The lines of the list, where they were read already.

    Raises:
        SourceError: A line is no time and name, or its file is not there.
    """
    if rows is None:
        rows = [(number, _time_and_name(line)) for number, line in lines_of(path)]
    times = read_times(path, rows, read)
    return [_listed(path, folder, number, values) for number, values in rows], times


def _time_and_name(line: str) -> list[str]:
    """Two values: a name may have spaces in it."""
    return [part.strip() for part in re.split(r",|\s", line, maxsplit=1)]


def _listed(path: Path, folder: Path, number: int, values: list[str]) -> Path:
    if len(values) != 2 or not values[1]:
        raise SourceError(path, f"line {number} is not a time and a file name")
    name = PurePosixPath(values[1])
    if name.is_absolute() or ".." in name.parts:
        raise SourceError(path, f"line {number} names a file outside of {folder}: {name}")
    image = folder / name
    if not image.is_file():
        raise SourceError(path, f"line {number} names {image}, which is not there")
    return image
