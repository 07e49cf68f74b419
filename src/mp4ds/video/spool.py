"""Frames kept on disk, so that they can be encoded several times."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mp4ds.video.planes import Planes, planes_in


class PlaneSpool:
    """The planes of a few frames, in a file; one of them is in memory at a time.

    Args:
        path: The file to make; the caller removes it.
        width: Columns of a frame, even.
        height: Rows of a frame, even.
    """

    def __init__(self, path: Path, width: int, height: int) -> None:
        self.width, self.height = width, height
        self._size = width * height * 3 // 2
        self._file = path.open("w+b", buffering=0)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, planes: Planes) -> None:
        """Keep one more frame.

        Raises:
            OSError: The disk refused.
        """
        self._file.seek(self._count * self._size)
        for plane in planes:
            data = np.ascontiguousarray(plane).data.cast("B")
            while data:
                data = data[self._file.write(data) :]
        self._count += 1

    def __iter__(self) -> Iterator[Planes]:
        return map(self.frame, range(self._count))

    def frame(self, number: int) -> Planes:
        """The planes of one frame, of their own memory.

        Raises:
            OSError: The file cannot be read.
        """
        data = np.empty(self._size, np.uint8)
        rest = data.data
        self._file.seek(number * self._size)
        while rest:
            count = self._file.readinto(rest)
            if not count:
                raise OSError("frames that were kept on disk have been cut short")
            rest = rest[count:]
        return planes_in(data, self.width, self.height)

    def clear(self) -> None:
        """Forget all frames."""
        self._count = 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()
