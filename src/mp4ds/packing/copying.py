"""Copies a dataset, or a part of it, without re-encoding."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mp4ds.dataset.checks import validate
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.slicing import copy_part, latched_at, span_in
from mp4ds.errors import FormatError, advising
from mp4ds.files.outputs import staged
from mp4ds.format.sidecars import COPY_AGAIN, load_about
from mp4ds.options import ENCODING
from mp4ds.packing.manifest import dataset_files, folder_size
from mp4ds.packing.options import PackOptions, PackSummary, TopicSummary
from mp4ds.packing.planning import dataset_at


def is_copy(paths: Sequence[Path], options: PackOptions) -> bool:
    """Whether it is one dataset, and no option asks for encoding its videos."""
    if options.changing(ENCODING) != PackOptions().changing(ENCODING):
        return False
    is_divided = options.join or options.cluster is not None
    return not is_divided and len(paths) == 1 and dataset_at(paths[0]) is not None


def copy(path: Path, target: Path, options: PackOptions) -> PackSummary:
    """Copy a dataset or a part of it.

    Args:
        path: The dataset.
        target: The folder to make.
        options: Which part, and its description.

    Raises:
        Refused: It cannot be copied; says why. Nothing is left behind.
        FormatError: It is damaged.
        TargetError: The dataset may not be written there.
        WriteError: The disk refused.
        OptionError: There is no such topic or time.
    """
    about = load_about(options.about) if options.about is not None else None
    with (
        advising(COPY_AGAIN),
        Dataset(path) as dataset,
        staged(target, force=options.force, owned=dataset_files, sources=[path]) as folder,
    ):
        selected = options.selected
        selected.check(channel.topic for channel in dataset.channels)
        folder.mkdir()
        span = span_in(dataset, options.slice)
        if options.slice or options.topics or options.exclude:  # whole files are checked as copied
            dataset.verify_messages()
        for stream in dataset.streams:
            is_cut = options.slice and selected(stream.topic)
            if is_cut and stream.sidecar.digests is None:  # nothing else shows that it is damaged
                stream.verify_video()
        latched, too_large = latched_at(dataset, span, options.slice, selected)
        manifest = copy_part(
            dataset, folder, span=span, latched=latched, selected=selected, about=about
        )
        if options.slice:
            for problem in validate(folder, deep=True):
                raise FormatError(problem.code, dataset.path, f"is damaged: {problem}")
        with Dataset(folder) as made:
            topics = topic_summaries(made)
            early = dict(made.latched_before) if options.slice else {}
        return PackSummary(
            dataset=target,
            topics=topics,
            source_bytes=folder_size(dataset.path),
            dataset_bytes=folder_size(folder),
            messages_bytes=sum(item.size for item in manifest.files if item.name[-5:] == ".mcap"),
            left_out=[item.topic for item in dataset.channels if not selected(item.topic)],
            skipped={},
            is_copy=True,
            latched=early,
            latched_left_out=list(too_large),
        )


def topic_summaries(dataset: Dataset) -> list[TopicSummary]:
    """What is in a dataset, by topic; the bytes of the recorded messages are not known."""
    times = dataset.times()
    found: dict[str, TopicSummary] = {}
    for channel in dataset.channels:
        topic = found.setdefault(channel.topic, TopicSummary(channel.topic, channel.type_name))
        topic.messages += len(times.get(channel.id, ()))
    for stream in dataset.streams:
        topic = found[stream.topic]
        topic.frames += len(stream)
        topic.files.append(stream.video_path.name)
        topic.packed_bytes += stream.video_path.stat().st_size + stream.path.stat().st_size
        if stream.infos:
            found[stream.infos.channel.topic].frames += len(stream.infos)
    return list(found.values())
