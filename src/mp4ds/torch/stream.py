"""Samples in the order of the recordings, window by window."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import IterableDataset, get_worker_info

from mp4ds.errors import OptionError
from mp4ds.torch.dataset import SYNC_TOLERANCE_NS
from mp4ds.torch.offsets import Offsets
from mp4ds.torch.pictures import Backend, Crop, Dtype, Resize, pictures_from
from mp4ds.torch.recordings import Collection, Paths
from mp4ds.torch.samples import SampleReader, Transform
from mp4ds.torch.windows import rows_of, shuffled, windows


class FrameStream(IterableDataset):
    """Frames of datasets as fast as videos are decoded: from beginning to end.

    The recordings are cut into windows that begin with a key frame. Windows come in random
    order, shared among the workers of a DataLoader and the processes of a distributed training;
    each sample is read once an epoch, by one of them. Inside a window frames follow each other,
    unless a `buffer` mixes them.

    Samples are as those of `FrameDataset` with one frame each. Give no ``shuffle`` to the
    DataLoader. Processes of a distributed training may get different numbers of samples.

    Args:
        paths: As of `FrameDataset`, and so are `topics`, `sync_tolerance_ns`, `format`,
            `resize`, `crop`, `dtype`, `channels_first`, `transform`, `cache_files`, `backend`
            and `device`.
        topics: Cameras.
        sync_tolerance_ns: Of the matches.
        format: Of the frames.
        resize: Of the frames.
        crop: Of the frames.
        dtype: Of the tensors.
        channels_first: Of the tensors.
        transform: Of the samples.
        window: Samples of a window; the key frames of the first camera make it a little
            shorter or longer. Several times the distance of key frames, or decoding costs more.
        shuffle: Whether windows are in random order.
        seed: Of the order; the same in all processes.
        buffer: Samples that are kept to mix their order; 0: none.
        rank: Number of this process of a distributed training.
        world_size: How many there are.
        cache_files: Videos that are open at most; one for each camera at least.
        fast_colour: See `mp4ds.Dataset`.
        backend: Who decodes.
        device: Where.

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
        sync_tolerance_ns: int = SYNC_TOLERANCE_NS,
        format: str | Mapping[str, str] = "rgb",  # noqa: A002 - as of Stream.read
        resize: Resize | Mapping[str, Resize] | None = None,
        crop: Crop | Mapping[str, Crop] | None = None,
        dtype: Dtype = "native",
        channels_first: bool = True,
        transform: Transform | None = None,
        window: int = 256,
        shuffle: bool = True,
        seed: int = 0,
        buffer: int = 0,
        rank: int = 0,
        world_size: int = 1,
        cache_files: int = 16,
        fast_colour: bool = False,
        backend: Backend = "mp4ds",
        device: str = "cpu",
    ) -> None:
        _check(window=window, seed=seed, buffer=buffer, rank=rank, world_size=world_size)
        self._collection = Collection(paths, topics=topics, sync_tolerance_ns=sync_tolerance_ns)
        if cache_files < len(self.topics):
            raise OptionError(
                f"cache_files is {cache_files}, and must be at least {len(self.topics)}: one for "
                "each camera."
            )
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
        self._reader = SampleReader(self._collection, pictures, Offsets(), transform, cache_files)
        self._window = window
        self._shuffle = shuffle
        self._seed = seed
        self._buffer = buffer
        self._share = (rank, world_size)
        # in shared memory, so that workers that outlive an epoch learn of the next
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    @property
    def topics(self) -> tuple[str, ...]:
        """The cameras of a sample."""
        return self._collection.topics

    @property
    def samples(self) -> int:
        """Number of samples of an epoch, of all processes together."""
        return int(self._collection.starts[-1])

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the next epoch; the same number gives the same order.

        Args:
            epoch: 0 or more; the same in all processes.

        Raises:
            OptionError: It is negative.
        """
        _check(epoch=epoch)
        self._epoch.fill_(epoch)

    def __iter__(self) -> Iterator[Any]:
        rank, world_size = self._share
        worker = get_worker_info()
        if worker is not None:
            rank = rank * worker.num_workers + worker.id
            world_size *= worker.num_workers
        order = (self._seed, int(self._epoch))
        samples = self._samples(order, rank, world_size)
        if not self._buffer:
            return samples
        return shuffled(samples, self._buffer, np.random.default_rng((*order, rank)))

    def _samples(self, order: tuple[int, int], rank: int, world_size: int) -> Iterator[Any]:
        all_windows = windows(self._collection, self._window)
        if self._shuffle:
            all_windows = np.random.default_rng(order).permutation(all_windows)
        for number, window in all_windows[rank::world_size].tolist():
            keys = self._reader.key_frames(number)
            rows = rows_of(self._collection.recordings[number], window, self._window, keys)
            for row in rows:  # one by one: the decoder goes on where it was
                yield from self._reader.read(number, row[None])

    def close(self) -> None:
        """Close the videos that this process has open; they are opened again when needed."""
        self._reader.cameras.close()


def _check(**numbers: int) -> None:
    for name, value in numbers.items():
        least = 1 if name in ("window", "world_size") else 0
        if value < least:
            raise OptionError(f"{name} is {value}, and must be at least {least}.")
    if numbers.get("rank", 0) >= numbers.get("world_size", 1):
        raise OptionError(
            f"rank is {numbers['rank']}, and must be less than the world_size, "
            f"{numbers['world_size']}."
        )
