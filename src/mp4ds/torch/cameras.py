"""The open streams of a worker: few at a time, and none of another process."""

from __future__ import annotations

import os
from collections import OrderedDict
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mp4ds.dataset import Stream, Video
from mp4ds.errors import FormatError, Mp4dsError, OptionError, VideoError
from mp4ds.intervals import nearest
from mp4ds.torch.codec import TorchcodecReader
from mp4ds.torch.errors import SampleError
from mp4ds.torch.pictures import Pictures, View
from mp4ds.torch.recordings import Recording, Source, open_source
from mp4ds.video.samples import Unindexed, read_sample_table


class Reader(Protocol):
    """What decodes frames of a stream."""

    def read(self, frames: list[int]) -> Tensor:
        """Frames in the order asked for, repeated as asked; (N, H, W) or (N, H, W, C)."""
        ...

    def close(self) -> None:
        """Close the video."""
        ...


class StreamReader:
    """Decodes by ``read`` of a stream.

    Args:
        stream: The stream.
        view: What of its frames is wanted.
    """

    def __init__(self, stream: Stream | Video, view: View) -> None:
        self._stream = stream
        self._view = view

    def read(self, frames: list[int]) -> Tensor:
        """As `Reader.read`."""
        view = self._view
        pixels = self._stream.read(frames, format=view.format, resize=view.resize, crop=view.crop)
        return torch.from_numpy(pixels)  # shares the memory

    def close(self) -> None:
        """As `Reader.close`."""
        self._stream.close()


class Camera:
    """An open stream: its frames as tensors, and its stamps.

    Args:
        source: Which.
        view: What of its frames is wanted.
        pictures: How they become tensors.

    Raises:
        FormatError: The stream breaks a rule of the format.
    """

    def __init__(self, source: Source, view: View, pictures: Pictures) -> None:
        self.source = source
        self._view = view
        self._pictures = pictures
        self.stream = open_source(source, fast_colour=pictures.fast_colour)
        if len(self.stream) != source.frames:
            raise FormatError(
                "frame-count",
                source.place,
                f"has {len(self.stream)} frames where {source.frames} are due",
            )
        self._reader: Reader = (
            TorchcodecReader(self.stream, view.crop, pictures.device)
            if pictures.backend == "torchcodec"
            else StreamReader(self.stream, view)
        )

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds, by frame."""
        return self.stream.stamps

    @cached_property
    def _order(self) -> NDArray[np.intp]:
        return np.argsort(self.stamps, kind="stable")

    @cached_property
    def period_ns(self) -> int:
        """Median time between frames, nanoseconds; 0 of a single one."""
        gaps = np.diff(self.stamps[self._order])
        return int(np.median(gaps)) if len(gaps) else 0

    def nearest(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """The frames whose stamps are nearest to times; the first of several such."""
        stamps = self.stamps[self._order]
        return self._order[nearest(stamps, times)].astype(np.int64)

    @cached_property
    def key_frames(self) -> NDArray[np.int64]:
        """Numbers of the frames at which decoding can begin, in order; all where none are told.

        Raises:
            VideoError: The video's index is damaged.
        """
        path = self.stream.video_path
        try:
            with path.open("rb") as file:
                table = read_sample_table(file, path.stat().st_size, str(path))
        except Unindexed:
            return np.arange(len(self.stream), dtype=np.int64)
        except OSError as error:
            raise VideoError("file-missing", path, f"cannot be read: {error.strerror}") from None
        return np.flatnonzero(table.sync[table.order]).astype(np.int64)

    def read(self, frames: NDArray[np.int64]) -> Tensor:
        """Frames as a tensor, decoded in one pass.

        Args:
            frames: Numbers, shape (N,), in any order.

        Returns:
            Shape (N, C, H, W) or (N, H, W, C); memory of its own.

        Raises:
            SampleError: One of them cannot be decoded.
            OptionError: They cannot be had as asked.
        """
        numbers: list[int] = frames.tolist()
        try:
            pixels = self._reader.read(numbers)
        except OptionError:
            raise
        except Mp4dsError as error:
            raise self._first_failure(numbers, error) from None
        return self._pictures.tensor(pixels, self.source.topic, self._view.format)

    def _first_failure(self, numbers: list[int], error: Mp4dsError) -> Mp4dsError:
        """Which frame it was, since a sentence about many does not always tell."""
        for number in sorted(set(numbers)):
            try:
                self._reader.read([number])
            except Mp4dsError as its:
                return SampleError(f"frame {number}: {its}")
        return SampleError(f"one of {len(numbers)} frames: {error}")

    def close(self) -> None:
        """Close the video."""
        self._reader.close()
        self.stream.close()


class Cameras:
    """The cameras of one process that are open; those not used for long are closed.

    A copy of it, by pickling or by a fork, has none open: a decoder's threads do not exist in
    another process, and it would wait for them.

    Args:
        most: How many are open at most.
        pictures: How their frames become tensors.

    Raises:
        OptionError: `most` is less than one.
    """

    def __init__(self, most: int, pictures: Pictures) -> None:
        self._most = most
        self._pictures = pictures
        self._start()
        if most < 1:
            raise OptionError(f"cache_files is {most}, and must be at least 1.")

    def _start(self) -> None:
        self._process = os.getpid()
        self._open: OrderedDict[str, Camera] = OrderedDict()
        self._inherited: list[OrderedDict[str, Camera]] = []

    def __len__(self) -> int:
        return len(self._open)

    def get(self, recording: Recording, camera: int) -> Camera:
        """A camera of a recording, opened if need be.

        Raises:
            FormatError: It breaks a rule of the format.
        """
        if self._process != os.getpid():
            # kept as it is: to close or free what the parent decodes with may never end here
            self._inherited.append(self._open)
            self._open, self._process = OrderedDict(), os.getpid()
        source = recording.sources[camera]
        found = self._open.pop(source.place, None)
        if found is None:
            while len(self._open) >= self._most:
                self._open.popitem(last=False)[1].close()
            found = Camera(source, self._pictures.views[camera], self._pictures)
        self._open[source.place] = found
        return found

    def close(self) -> None:
        """Close what this process has open."""
        if self._process == os.getpid():
            while self._open:
                self._open.popitem()[1].close()

    def __del__(self) -> None:
        # a decoder that waits for the garbage collector may meet it in a forked process
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        return {"_most": self._most, "_pictures": self._pictures}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._start()
