"""Dataset -> folders of image files, one per topic, with their times."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.images import Images, VerbatimImages
from mp4ds.dataset.stream import Stream
from mp4ds.dataset.topic import Topic
from mp4ds.errors import OptionError
from mp4ds.files.outputs import csv_cell
from mp4ds.format.fields import DecodedColumns, marked
from mp4ds.unpacking.pictures import FrameOptions, files_of
from mp4ds.video.images import ImageFile

_STAMPS_NAME = "stamps.csv"
_HEAD = ["file", "stamp_ns", "log_time_ns", "frame_id"]
_SUFFIXES = {"jpeg": "jpg", "png": "png"}
_NOT_DECODED = "its picture cannot be decoded"


@dataclass(frozen=True)
class _Files:
    """How frames of one size and encoding become files.

    Attributes:
        part: The frames: a stream, or images stored verbatim.
        numbers: Their numbers in the topic, shape (frames,).
        is_kept: Which are written, shape (frames,).
        kind: ``png`` or ``jpeg``.
        file: Encodes them; None if their files are written as recorded.
    """

    part: Images
    numbers: NDArray[np.int64]
    is_kept: NDArray[np.bool_]
    kind: str
    file: ImageFile | None

    def all(self) -> Iterator[tuple[int, bytes | memoryview | None]]:
        """The files, each with its frame's number in the part; None: it has no picture."""
        part, file = self.part, self.file
        if isinstance(part, Stream):
            part.verify_pictures()
            if file is None:
                yield from files_of(part, marked(self.is_kept))
                return
            is_strict = not part.sidecar.keeps_packets
            for index, picture in part.pictures(marked(self.is_kept), is_strict=is_strict):
                made = None
                if picture is not None:
                    made = file.encode(part.recorded_pixels(picture))
                yield index, made
        elif isinstance(part, VerbatimImages):
            for index, shown in part.all_shown():
                if self.is_kept[index]:
                    yield index, file.encode(shown.pixels) if file else shown.file


class TopicImages:
    """The images of a topic, in videos and verbatim, about to be written.

    Args:
        frames: The topic.
        options: Which of its frames are left out, counted in the topic.
        image_format: ``png`` or ``jpeg``; None: JPEG files as recorded, others as png.
        jpeg_quality: Of new JPEG files, 1 to 100.

    Attributes:
        topic: The topic.
        thinned: How many of them are left out because fewer were requested.
        refused: How many cannot be written, by reason.

    Raises:
        FormatError: The dataset is damaged.
    """

    def __init__(
        self, frames: Topic, options: FrameOptions, image_format: str | None, jpeg_quality: int
    ) -> None:
        self.topic = frames.topic
        self.thinned, self.refused = 0, Counter[str]()
        self._digits = len(str(len(frames) - 1))
        self._files: list[_Files] = []
        is_kept = options.kept(DecodedColumns.of_frames(frames.stamps, frames.log_times))
        for place, part in enumerate(frames.parts):
            numbers = frames.numbers_of(place)
            kept = is_kept[numbers]
            self.thinned += part.count(~kept)
            keeps_files = part.are_jpeg_files and image_format != "png"
            kind = "jpeg" if keeps_files else image_format or "png"
            try:
                file = None
                if not keeps_files:
                    file = ImageFile(part.encoding, kind, quality=jpeg_quality)
                self._files.append(_Files(part, numbers, kept, kind, file))
            except OptionError as error:
                self.refused[str(error).rstrip(".")] += part.count(kept)

    @property
    def count(self) -> int:
        """How many are written, unless some cannot be decoded."""
        return sum(files.part.count(files.is_kept) for files in self._files)

    def write(self, folder: Path, on_file: Callable[[], None]) -> int:
        """Write one file per frame, named by its number in the topic, and stamps.csv.

        Args:
            folder: To make.
            on_file: Called after each file.

        Returns:
            How many were written; the others are added to `refused`.

        Raises:
            FormatError: The dataset is damaged.
        """
        folder.mkdir()
        rows: dict[int, list[str | int]] = {}
        for files in self._files:
            part = files.part
            for index, data in files.all():
                if data is None:
                    self.refused[_NOT_DECODED] += 1
                    continue
                number = int(files.numbers[index])
                name = f"{number:0{self._digits}d}.{_SUFFIXES[files.kind]}"
                (folder / name).write_bytes(data)
                stamp, log_time = int(part.stamps[index]), int(part.log_times[index])
                rows[number] = [name, stamp, log_time, csv_cell(part.frame_id(index))]
                on_file()
        with (folder / _STAMPS_NAME).open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([_HEAD, *(rows[number] for number in sorted(rows))])
        return len(rows)


def image_names(folder: Path) -> set[str] | None:
    """Names of the files of image folders, by their stamps.csv; None if there is none."""
    if not folder.is_dir():
        return None
    names: set[str] = set()
    for place in folder.iterdir():
        if place.is_dir():
            names.update(f"{place.name}/{name}" for name in _names_in(place / _STAMPS_NAME))
    return names or None


def _names_in(stamps: Path) -> set[str]:
    try:
        rows = csv.reader(io.StringIO(stamps.read_bytes().decode(), newline=""))
        if next(rows, None) != _HEAD:
            return set()
        return {stamps.name, *(row[0] for row in rows if row)}
    except (OSError, ValueError, csv.Error):
        return set()
