"""Cuts a dataset out of another: packets are copied, nothing is encoded."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from mp4ds.bags.latched import latched_before
from mp4ds.dataset.concat import concat
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import OptionError, Refused
from mp4ds.files.outputs import digest_file
from mp4ds.format.manifest import About, EarlierDataset, Manifest
from mp4ds.format.sidecars import MANIFEST_NAME
from mp4ds.options import Slice
from mp4ds.records import EVERYTHING, Excerpt, Message


def span_in(dataset: Dataset, asked: Slice) -> Excerpt:
    """A slice as a span of a dataset's times.

    Raises:
        OptionError: It is empty, or a time is not valid.
    """
    if not asked:
        return EVERYTHING
    if dataset.manifest is not None:
        told = dataset.manifest.time_range
        span = (told.start, told.end) if told else None
    else:
        times = [one for one in dataset.times().values() if len(one)]
        span = (min(int(one[0]) for one in times), max(int(one[-1]) for one in times))
    if span is None:
        raise OptionError(f"{dataset.path} has no messages to take a slice of.")
    first, last = span
    first = max(first, dataset.slice_start or first)
    return Excerpt(*asked.times(first, last, dataset.path))


def latched_at(
    dataset: Dataset, span: Excerpt, asked: Slice, selected: Callable[[str], bool]
) -> tuple[Sequence[Message], Sequence[str]]:
    """Latched messages from before a slice if requested, on selected topics, and those left out."""
    start = span.start
    if start is None or not asked.latched:
        return (), ()
    channels = [channel for channel in dataset.channels if selected(channel.topic)]
    return latched_before(channels, lambda topics, frames: dataset.before(start, topics, frames))


@contextmanager
def sliced(
    dataset: Dataset,
    asked: Slice,
    folder: Path,
    selected: Callable[[str], bool],
    latched: Sequence[Message] = (),
) -> Iterator[Dataset]:
    """A temporary dataset of a slice; the dataset itself if no slice is given.

    Args:
        dataset: A folder made by `mp4ds pack`.
        asked: The slice.
        folder: Where to make it.
        selected: Whether a topic has to be in it; those that share a stream with it are, too.
        latched: Messages from before the slice that it has, too.

    Raises:
        OptionError: It is empty, or cannot be cut out.
        FormatError: The dataset is damaged.
        OSError: The disk could not be written.
    """
    if not asked:
        yield dataset
        return
    path = folder / "slice" / dataset.path.name
    path.mkdir(parents=True)
    try:
        kept = _with_shared(dataset, selected).__contains__
        span = span_in(dataset, asked)
        copy_part(dataset, path, span=span, latched=latched, selected=kept)
    except Refused as reason:
        raise OptionError(
            f"{dataset.path} cannot be sliced: {reason}. Pack the slice first (mp4ds pack with the "
            "same times), and use that."
        ) from None
    try:
        with Dataset(path, jpeg_quality=dataset.jpeg_quality) as opened:
            yield opened
    finally:
        shutil.rmtree(path.parent, ignore_errors=True)


def _with_shared(dataset: Dataset, selected: Callable[[str], bool]) -> set[str]:
    """The selected topics, and those that share a stream with them."""
    kept = {channel.topic for channel in dataset.channels if selected(channel.topic)}
    shared = [set(stream.topics) for stream in dataset.streams]
    while more := [own for own in shared if own & kept and not own <= kept]:
        kept.update(*more)
    return kept


def copy_part(
    dataset: Dataset,
    folder: Path,
    *,
    span: Excerpt = EVERYTHING,
    latched: Sequence[Message] = (),
    selected: Callable[[str], bool] = lambda _: True,
    about: About | None = None,
) -> Manifest:
    """Copy what was recorded in a span of log time, on some topics.

    Args:
        dataset: A folder made by `mp4ds pack`.
        folder: The folder to fill, empty.
        span: What to copy; its topics are ignored.
        latched: The messages from before it that are copied, too.
        selected: Whether a topic is to be copied.
        about: Description of the recording; None to keep the dataset's.

    Returns:
        The new manifest, already written.

    Raises:
        Refused: It cannot be copied; says why. Nothing was written.
        FormatError: A file does not match its dataset.
        OSError: The disk could not be written.
    """
    old = dataset.manifest
    if old is None:
        raise Refused("it is a single video, not a dataset")
    earlier = EarlierDataset(
        name=dataset.path.name,
        profile=old.profile,
        sha256=digest_file(dataset.path / MANIFEST_NAME)[1],
    )
    changes = {
        "about": about or old.about,
        "sources": [source.within(span) for source in old.sources],
        "derived_from": [*old.derived_from, earlier],
    }
    manifest, _ = concat(
        [dataset], folder, span=span, latched=latched, selected=selected, changes=changes
    )
    return manifest
