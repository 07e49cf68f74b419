"""Samples by number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import index as as_integer
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from mp4ds.torch.offsets import Unit, offsets_from
from mp4ds.torch.pictures import Backend, Crop, Dtype, Resize, pictures_from
from mp4ds.torch.recordings import Collection, Paths
from mp4ds.torch.samples import SampleReader, Transform

SYNC_TOLERANCE_NS = 20_000_000


class FrameDataset(Dataset):
    """Frames of datasets by number, for a DataLoader that shuffles.

    A sample is a dictionary, here of the topics ``/left`` and ``/right``::

        {"/left": uint8 (T, C, H, W), "/right": ..., "/left_is_pad": bool (T,), ...,
         "stamp_ns": int, "index": int, "dataset": int}

    T is the number of offsets; with the default, one, tensors are (C, H, W). C is 1 for grey
    images. ``is_pad`` tells which frames stand in for some that are not there. ``stamp_ns`` is the
    header stamp of the first topic's frame, ``index`` the sample's number, ``dataset`` that of
    the path. Tensors are views of an array that they share with no other sample's.

    Of several cameras, a sample has the frames that belong together: they are matched by header
    stamp (`mp4ds.Dataset.sync`), each frame at most once, and `unmatched` has the others.

    It may be pickled and forked. Videos are opened when first needed, by each process for itself.

    Args:
        paths: Datasets, one or several: folders, sidecars, videos, URLs.
        topics: Cameras; None: all of the first dataset. The others must have them, too.
        offsets: Of the frames of a sample from its own: ``(-1, 0)`` is the one before it and
            itself.
        offsets_in: ``frames``: samples of the same recording before and after. ``seconds``: in
            each camera the frame whose stamp is nearest.
        tolerance_ns: With seconds, how far a stamp may be from its time without being padding;
            None: half the median time between the camera's frames.
        sync_tolerance_ns: How far stamps of different cameras may be apart in a sample.
        format: ``rgb``, ``bgr``, ``gray`` or ``native``: the pixels as recorded. A mapping by
            topic gives each camera its own; so do mappings for `resize` and `crop`.
        resize: Factor, or width and height in pixels.
        crop: x, y, width, height in pixels; before `resize`.
        dtype: ``native``: as decoded, which is uint8 but for cameras of more bits. ``uint8``: the
            same, and refused for those. ``float32``: 0 to 1; native pixels keep their numbers.
        channels_first: (C, H, W), not (H, W, C).
        transform: Called with each sample; what it returns takes the sample's place.
        cache_files: How many videos a process has open at most.
        fast_colour: See `mp4ds.Dataset`.
        backend: ``torchcodec`` decodes with that, which converts colours a little differently.
        device: With ``torchcodec``, where to decode and have the tensors, such as ``cuda``.

    Raises:
        OptionError: An option is wrong, a topic is not there, or there is no sample.
        SourceError: A path is no dataset.
        FormatError: A manifest or sidecar breaks a rule of the format.
    """

    def __init__(
        self,
        paths: Paths,
        *,
        topics: Sequence[str] | None = None,
        offsets: Sequence[float] = (0,),
        offsets_in: Unit = "frames",
        tolerance_ns: int | None = None,
        sync_tolerance_ns: int = SYNC_TOLERANCE_NS,
        format: str | Mapping[str, str] = "rgb",  # noqa: A002 - as of Stream.read
        resize: Resize | Mapping[str, Resize] | None = None,
        crop: Crop | Mapping[str, Crop] | None = None,
        dtype: Dtype = "native",
        channels_first: bool = True,
        transform: Transform | None = None,
        cache_files: int = 16,
        fast_colour: bool = False,
        backend: Backend = "mp4ds",
        device: str = "cpu",
    ) -> None:
        chosen = offsets_from(offsets, offsets_in, tolerance_ns)
        self._collection = Collection(paths, topics=topics, sync_tolerance_ns=sync_tolerance_ns)
        pictures = pictures_from(
            self.topics,
            format_=format,
            resize=resize,
            crop=crop,
            dtype=dtype,
            channels_first=channels_first,
            fast_colour=fast_colour,
            backend=backend,
            device=device,
        )
        self._reader = SampleReader(self._collection, pictures, chosen, transform, cache_files)

    @property
    def topics(self) -> tuple[str, ...]:
        """The cameras of a sample."""
        return self._collection.topics

    @property
    def paths(self) -> list[str]:
        """The datasets; a sample's ``dataset`` is the number of one."""
        return [recording.path for recording in self._collection.recordings]

    @property
    def lengths(self) -> list[int]:
        """Number of samples of each dataset."""
        return [recording.rows for recording in self._collection.recordings]

    @property
    def unmatched(self) -> list[dict[str, NDArray[np.int64]]]:
        """Of each dataset, the numbers of the frames that are in no sample, by topic."""
        return [recording.unmatched for recording in self._collection.recordings]

    def __len__(self) -> int:
        return int(self._collection.starts[-1])

    def __getitem__(self, index: SupportsIndex) -> Any:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[SupportsIndex]) -> list[Any]:
        """Samples, in the order asked for.

        The frames of each camera are decoded in one pass, in the order that is cheapest.

        Raises:
            IndexError: There is no sample of a number.
            SampleError: A frame cannot be read.
        """
        wanted = np.array([self._number(index) for index in indices], np.int64)
        recordings, rows = self._collection.locate(wanted)
        samples: list[Any] = [None] * len(wanted)
        for number in np.unique(recordings).tolist():
            places = np.flatnonzero(recordings == number)
            for place, sample in zip(
                places.tolist(), self._reader.read(number, rows[places]), strict=True
            ):
                samples[place] = sample
        return samples

    def _number(self, index: SupportsIndex) -> int:
        number = as_integer(index)
        if not -len(self) <= number < len(self):
            raise IndexError(f"there are {len(self)} samples, and none of number {number}")
        return number % len(self)

    def close(self) -> None:
        """Close the videos that this process has open; they are opened again when needed."""
        self._reader.cameras.close()
