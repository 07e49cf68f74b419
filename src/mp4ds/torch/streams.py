"""Samples in the order of the recordings: windows at random, shared among processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import IterableDataset, get_worker_info

from mp4ds.errors import OptionError
from mp4ds.torch.datasets import FrameDataset
from mp4ds.torch.recordings import Paths, at_least

_T = TypeVar("_T")
_UNREAD = object()


def mixed(
    items: Iterable[_T],
    read: Callable[[_T], Any],
    *,
    size: int,
    random: np.random.Generator,
    skip: int = 0,
) -> Iterator[Any]:
    """Items as read, in random order within the limits of a buffer.

    Args:
        items: What to read, in the cheapest order.
        read: Reads one.
        size: Of the buffer; 0 keeps the order.
        random: The source of randomness.
        skip: How many to skip at the beginning, without reading them; what the buffer holds by then
            is read when it is yielded.
    """
    kept: list[Any] = []  # items, each with what was read of it
    for item in items:
        entry = (item, _UNREAD if skip > 0 else read(item))
        if len(kept) < size:
            kept.append(entry)
            continue
        if size:
            place = int(random.integers(size))
            kept[place], entry = entry, kept[place]
        if skip > 0:
            skip -= 1
        else:
            yield read(entry[0]) if entry[1] is _UNREAD else entry[1]
    random.shuffle(kept)
    for item, value in kept[skip:]:
        yield read(item) if value is _UNREAD else value


class FrameStream(IterableDataset):
    """Frames of datasets at full decoding speed, from beginning to end.

    The recordings are cut into windows that begin with a key frame. Windows come in random
    order, shared among the workers of a DataLoader and the processes of a distributed training;
    each sample is read once per epoch, by one of them. Within a window, frames are in order, unless
    a `buffer` mixes them.

    Processes of a distributed training get equal numbers of samples, so some samples are repeated
    or left out: see `drop_last`. To share evenly, each process reads the indexes of all videos
    once; a single process reads them when needed.

    Samples are like those of `FrameDataset` with one frame each. Do not give ``shuffle`` to the
    DataLoader. torchdata's StatefulDataLoader saves and restores the position in an epoch.

    Args:
        paths: As for `FrameDataset`.
        topics: As for `FrameDataset`.
        window: Samples of a window; the key frames of the first camera make it a little
            shorter or longer. Use several key frame intervals, or decoding costs more.
        shuffle: Whether windows come in random order.
        seed: Of the order; the same in all processes.
        buffer: Number of samples to keep for mixing; 0: none.
        rank: Number of this process of a distributed training.
        world_size: Number of processes.
        drop_last: For distributed training, as in DistributedSampler: leave out the last samples
            that cannot be shared evenly. Otherwise the first ones of the epoch are repeated.
        cache_files: Maximum number of open videos; at least one per camera.
        **options: All others of `FrameDataset`, but for those of offsets.

    Raises:
        OptionError: An option is wrong, a topic is not there, or there is no sample.
        SourceError: A path is not a dataset.
        FormatError: A manifest or sidecar breaks a rule of the format.
    """

    def __init__(
        self,
        paths: Paths,
        *,
        topics: Sequence[str] | None = None,
        window: int = 256,
        shuffle: bool = True,
        seed: int = 0,
        buffer: int = 0,
        rank: int = 0,
        world_size: int = 1,
        drop_last: bool = False,
        cache_files: int = 16,
        **options: Any,
    ) -> None:
        for name in ("offsets", "offsets_in", "tolerance_ns"):
            if name in options:
                raise TypeError(f"FrameStream has no {name!r}: its samples have one frame each")
        at_least(1, window=window, world_size=world_size)
        at_least(0, seed=seed, buffer=buffer, rank=rank)
        if rank >= world_size:
            raise OptionError(
                f"rank is {rank}, but must be less than the world_size, {world_size}."
            )
        self._frames = FrameDataset(paths, topics=topics, cache_files=cache_files, **options)
        if cache_files < len(self.topics):
            raise OptionError(
                f"cache_files is {cache_files}, but must be at least {len(self.topics)}: one per "
                "camera."
            )
        self._length = window
        self._shuffle = shuffle
        self._seed = seed
        self._buffer = buffer
        self._rank, self._world_size = rank, world_size
        self._drop_last = drop_last
        self._starts: dict[int, NDArray[np.int64]] = {}
        self._given = self._resumed = 0
        # in shared memory, so that persistent workers learn of the next epoch
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    @property
    def topics(self) -> tuple[str, ...]:
        """The cameras of a sample."""
        return self._frames.topics

    @property
    def samples(self) -> int:
        """Number of samples per epoch, over all processes."""
        return len(self._frames)

    def __repr__(self) -> str:
        return repr(self._frames).replace("FrameDataset", "FrameStream", 1)

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the next epoch; the same number gives the same order.

        Args:
            epoch: 0 or more; the same in all processes.

        Raises:
            OptionError: It is negative.
        """
        at_least(0, epoch=epoch)
        self._epoch.fill_(epoch)

    def state_dict(self) -> dict[str, Any]:
        """Position in the epoch in this process, for `load_state_dict`.

        Refers to the most recent iterator.
        """
        return {"epoch": int(self._epoch), "given": self._given, "order": self._order()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Let the next iterator resume where another one was, without rereading earlier samples.

        Args:
            state_dict: From the same process or worker, of a stream with the same options.

        Raises:
            OptionError: It belongs to a different order of samples.
        """
        other = state_dict["order"]
        for name, own in self._order().items():
            if other[name] != own:
                theirs = f"{name} {other[name]!r}"
                raise OptionError(
                    f"the state is from a stream with {theirs}, but this one has {own!r}."
                )
        self.set_epoch(state_dict["epoch"])
        self._given = self._resumed = state_dict["given"]

    def _order(self) -> dict[str, Any]:
        """Everything besides the epoch that determines the order of samples."""
        share, shares = self._share()
        return {
            "samples": self.samples,
            "window": self._length,
            "shuffle": self._shuffle,
            "seed": self._seed,
            "buffer": self._buffer,
            "drop_last": self._drop_last,
            "world_size": self._world_size,
            "share": f"{share} of {shares}",
        }

    def _share(self) -> tuple[int, int]:
        """Number of this process among all workers of all processes, and how many there are."""
        worker = get_worker_info()
        if worker is None:
            return self._rank, self._world_size
        return (self._rank * worker.num_workers + worker.id, self._world_size * worker.num_workers)

    def __iter__(self) -> Iterator[Any]:
        share, shares = self._share()
        self._given, self._resumed = self._resumed, 0
        order = (self._seed, int(self._epoch))
        random = np.random.default_rng((*order, share))
        rows = self._numbers(order, share, shares)
        return self._counted(
            mixed(
                rows, self._frames.__getitem__, size=self._buffer, random=random, skip=self._given
            )
        )

    def _counted(self, samples: Iterator[Any]) -> Iterator[Any]:
        for sample in samples:
            self._given += 1
            yield sample

    def _numbers(self, order: tuple[int, int], share: int, shares: int) -> Iterator[int]:
        """The samples of a share, in order."""
        windows = [
            (number, window)
            for number in range(len(self._frames.recordings))
            for window in range(self._window_count(number))
        ]
        if self._shuffle:
            np.random.default_rng(order).shuffle(windows)
        if self._world_size == 1:
            for number, window in windows[share::shares]:
                yield from self._window(number, window)
            return
        # equal parts of all windows in sequence: at most one window is divided per share
        lengths = [len(self._window(*window)) for window in windows]
        starts = np.cumsum([0, *lengths[:-1]])
        total = self.samples
        count = total // shares if self._drop_last else -(-total // shares)
        for place in np.arange(share * count, (share + 1) * count) % total:
            at = int(np.searchsorted(starts, place, side="right")) - 1
            yield self._window(*windows[at])[place - starts[at]]

    def _window_count(self, number: int) -> int:
        return -(-self._frames.recordings[number].rows // self._length)

    def _window(self, number: int, window: int) -> range:
        """The samples of a window of a recording.

        It begins with the first sample at or after a multiple of the length whose frame of the
        first camera is the first one after a key frame, and ends where the next one begins. So
        windows partition the samples, whatever the key frames, and some may be empty.
        """
        if number not in self._starts:
            recording, rows = self._frames.recordings[number], self._frames.recordings[number].rows
            frames = recording.frames(np.arange(rows), 0)
            groups = np.searchsorted(self._frames.key_frames(number), frames, side="right")
            begins = np.append(np.flatnonzero(np.diff(groups) > 0) + 1, rows)
            asked = np.arange(1, self._window_count(number)) * self._length
            starts = np.concatenate(([0], begins[np.searchsorted(begins, asked)], [rows]))
            self._starts[number] = starts.astype(np.int64)
        first = self._frames.first_number(number)
        return range(*(first + self._starts[number][window : window + 2]).tolist())

    def close(self) -> None:
        """Close the videos that this process has open; they are opened again when needed."""
        self._frames.close()
