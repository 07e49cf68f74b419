"""Reading samples: the frames of all cameras, as one dictionary of tensors each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mp4ds.errors import Mp4dsError, OptionError
from mp4ds.torch.cameras import Camera, Cameras
from mp4ds.torch.errors import SampleError
from mp4ds.torch.offsets import Offsets
from mp4ds.torch.pictures import Pictures
from mp4ds.torch.recordings import Collection

Sample = dict[str, Any]
Transform = Callable[[Sample], Any]


class SampleReader:
    """Reads the samples of a collection.

    Args:
        collection: The samples.
        pictures: How their frames become tensors.
        offsets: Which frames a sample has.
        transform: What makes of a sample that which is given; None: nothing.
        cache_files: How many videos are open at most.

    Raises:
        OptionError: `cache_files` is less than one.
    """

    def __init__(
        self,
        collection: Collection,
        pictures: Pictures,
        offsets: Offsets,
        transform: Transform | None,
        cache_files: int,
    ) -> None:
        self._collection = collection
        self._offsets = offsets
        self._transform = transform
        self.cameras = Cameras(cache_files, pictures)

    def key_frames(self, number: int) -> NDArray[np.int64]:
        """Numbers of the key frames of a recording's first camera, in order.

        Raises:
            SampleError: Its video cannot be read.
        """
        recording = self._collection.recordings[number]
        with _named(recording.path, self._collection.topics[0]):
            return self.cameras.get(recording, 0).key_frames

    def read(self, number: int, rows: NDArray[np.int64]) -> list[Any]:
        """Samples of one recording; the frames of each camera are decoded in one pass.

        Args:
            number: Of the recording.
            rows: The samples, shape (N,), in any order.

        Raises:
            SampleError: A frame cannot be read.
        """
        first = int(self._collection.starts[number])
        samples: list[Sample] = [{} for _ in rows]
        masks: list[Sample] = [{} for _ in rows]
        stamps: list[int] = []
        for camera_number, topic in enumerate(self._collection.topics):
            recording = self._collection.recordings[number]
            with _named(recording.path, topic):
                camera = self.cameras.get(recording, camera_number)
                frames, padded = self._offsets.frames(recording, camera_number, camera, rows)
                tensors = self._windows(camera, frames)
                if camera_number == 0:
                    stamps = camera.stamps[recording.frames(rows, 0)].tolist()
            flags = torch.from_numpy(padded)
            for place, sample in enumerate(samples):
                sample[topic] = tensors[place]
                masks[place][f"{topic}_is_pad"] = flags[place]
        for place, row in enumerate(rows.tolist()):
            samples[place] |= masks[place]
            samples[place] |= {"stamp_ns": stamps[place], "index": first + row, "dataset": number}
        return samples if self._transform is None else [self._transform(s) for s in samples]

    def _windows(self, camera: Camera, frames: NDArray[np.int64]) -> torch.Tensor:
        """Frames of shape (N, T) as a tensor of shape (N, T, ...), without T if it is 1."""
        tensors = camera.read(frames.ravel())
        if self._offsets == Offsets():
            return tensors
        return tensors.unflatten(0, frames.shape)


@contextmanager
def _named(path: str, topic: str) -> Iterator[None]:
    """Say in an error of which dataset and topic it is."""
    try:
        yield
    except OptionError:
        raise
    except SampleError as error:
        raise SampleError(f"{path}, topic {topic}, {error}") from None
    except Mp4dsError as error:
        raise SampleError(f"{path}, topic {topic}: {error}") from None
