"""Divides a pack into independent tasks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.collections import available_cores
from mp4ds.files.sources import SourceState
from mp4ds.messages.serializations import is_calibration, is_camera
from mp4ds.options import Slice
from mp4ds.packing.calibrations import choose_pairs, pair_camera_infos, unpaired_infos
from mp4ds.packing.inspection import depends_on_others
from mp4ds.packing.job import Job, Task, absolute, is_hashed, outcome_options, tools
from mp4ds.packing.options import PackOptions
from mp4ds.packing.survey import Survey, survey_channel, survey_pairs
from mp4ds.packing.tracks import PicturePlan, StreamSettings, TrackPlan
from mp4ds.plan import LOSSLESS, parse_quality
from mp4ds.records import Channel

GOPS_PER_WINDOW = 10
"""Groups of pictures of the busiest camera in a window: a cut costs at most one key frame."""

LEAST_WINDOW = 300
"""Minimum frames of a window, unless the user says otherwise: each part has some overhead."""


def cut_times(times: Sequence[NDArray[np.int64]], frames: int) -> list[int]:
    """Log times at which to cut a recording, each that of a camera message.

    The busiest camera is cut after that many of its frames; so is any other camera within windows
    in which it has more than twice as many.

    Args:
        times: Sorted log times of each camera's messages, ns.
        frames: Frames of a window.

    Returns:
        Increasing; each begins a window, and the first window begins before all of them.
    """
    cuts: list[int] = []
    for column in sorted(times, key=len, reverse=True):
        edges = [0, *np.searchsorted(column, np.array(cuts, np.int64)).tolist(), len(column)]
        new: list[int] = []
        for start, end in pairwise(edges):
            if end - start > (2 * frames if cuts else frames):
                new.extend(column[start + frames : end : frames].tolist())
        cuts = sorted({*cuts, *(time for time in new if time > int(column[0]))})
    return _without_short_end(cuts, times, frames)


def _without_short_end(
    cuts: list[int], times: Sequence[NDArray[np.int64]], frames: int
) -> list[int]:
    """Drop a last cut that leaves little after it."""
    if not cuts:
        return cuts
    rest = max((len(column) - np.searchsorted(column, cuts[-1]) for column in times), default=0)
    return cuts[:-1] if rest < frames // 2 else cuts


def spans_of(cuts: Sequence[int]) -> list[tuple[int | None, int | None]]:
    """Half-open spans of log time, ns, between the cuts; None is open."""
    edges = [None, *cuts, None]
    return list(pairwise(edges))


def share(number: int, tasks: Sequence[tuple[str, ...]], shares: int) -> list[tuple[str, ...]]:
    """One machine's share of the tasks: every nth one.

    Args:
        number: Number of the share, from 1.
        tasks: All, in an order on which all machines agree.
        shares: Number of shares.
    """
    return list(tasks[number - 1 :: shares])


# ---------------------------------------------------------------- planning

_COPIED, _OTHER_COST = 0.02, 1_000.0  # cost of a message that is not encoded; only for progress


@dataclass(frozen=True, slots=True)
class Resources:
    """Resources of a machine for a pack.

    Attributes:
        cores: Processors.
        jobs: Requested number of processes, or None.
    """

    cores: int
    jobs: int | None = None

    @classmethod
    def of(cls, options: PackOptions) -> Resources:
        """Those of this machine, within the options' limits."""
        return cls(available_cores(), options.jobs)

    def for_one_of(self, recordings: int) -> Resources:
        """The share of each of several recordings packed at the same time."""
        if recordings < 2:
            return self
        return replace(self, cores=max(1, self.cores // recordings), jobs=None)

    def slots(self, job: Job) -> int:
        """Number of processes for a job: as requested, or as many as cores and memory serve."""
        encoders = sum(
            decision.key.width * decision.key.height * _bytes_a_pixel(plan)
            for decisions in job.survey.decisions.values()
            for decision in decisions
            for plan in decision.plans[:1]
        )
        busy = self.cores // max(1, job.threads * job.workers)
        return self.jobs or max(1, min(busy, _memory() // 2 // (encoders or 1)))


def _bytes_a_pixel(plan: TrackPlan) -> int:
    """About what an encoder takes; SVT-AV1 looks ahead with many pictures, x264 qp 0 with none."""
    if not isinstance(plan, PicturePlan):
        return 0
    return 60 if plan.recipe.lossless else 300


def _memory() -> int:
    """This machine's memory, or the container's limit if lower, bytes."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):
            total = min(total, int(Path(name).read_text()))
    return total


@dataclass(frozen=True, slots=True)
class _Topics:
    """The camera channels of a recording, by how they can be divided.

    Attributes:
        free: Their messages are independent, so that they can be cut anywhere.
        bound: Those that a single task must take as a whole.
        infos: Topics of calibrations -> the topic of their images.
    """

    free: list[Channel]
    bound: list[Channel]
    infos: dict[str, str]


def plan_job(
    reader: BagReader, paths: Sequence[Path], options: PackOptions, means: Resources
) -> Job:
    """Plan a pack.

    Args:
        reader: The recording.
        paths: What it was opened from.
        options: How to pack.
        means: The available resources.

    Returns:
        The job; a single task if the recording is short, or has no index.

    Raises:
        OptionError: An option is wrong.
    """
    selected = options.selected
    selected.check(channel.topic for channel in reader.channels)
    channels = [channel for channel in reader.channels if selected(channel.topic)]
    if not reader.is_indexed:
        return _single(reader, paths, options, means)
    topics, pairs = _topics(reader, channels, options)
    settings = StreamSettings(
        quality=options.quality or parse_quality(LOSSLESS),
        codec=options.codec,
        preset=options.preset,
        gop=options.group_frames,
        threads=_side_by_side(reader, means)[1],
        transcode=options.transcode,
        purpose=options.purpose,
    )
    if not topics.free:
        return _single(reader, paths, options, means)
    window = options.window or GOPS_PER_WINDOW * options.group_frames
    if options.window is None and options.gop is None:
        window = max(window, LEAST_WINDOW)
    times = reader.times()
    columns = [times[channel.id] for channel in topics.free if len(times.get(channel.id, ()))]
    spans = spans_of(cut_times(columns, window))
    if len(spans) == 1:
        return _single(reader, paths, options, means)
    survey = _survey(reader, channels, topics, pairs, spans, replace(settings, threads=1))
    tasks = _tasks(spans, topics, reader, options.slice)
    spare = max(1, means.cores // len(tasks))
    workers = min(spare, len(topics.free))
    threads = max(1, spare // workers)
    return Job(
        paths=absolute(paths),
        sources=[SourceState.of(path) for path in reader.files],
        options=outcome_options(options),
        threads=threads,
        workers=workers,
        survey=survey,
        tasks=tasks,
        work=_work(reader, channels, survey),
        cameras=list(dict.fromkeys(channel.topic for channel in (*topics.free, *topics.bound))),
        tools=tools(),
    )


def _single(
    reader: BagReader, paths: Sequence[Path], options: PackOptions, means: Resources
) -> Job:
    """The job of one task that takes everything."""
    workers, threads = _side_by_side(reader, means)
    return Job(
        paths=absolute(paths),
        sources=[SourceState.of(path) for path in reader.files],
        options=outcome_options(options),
        threads=threads,
        workers=workers,
        survey=Survey(),
        tasks=[*_digest_tasks(reader, options.slice), Task("all", others=True, whole=True)],
        work={},
        cameras=[],
        tools=tools(),
    )


def _side_by_side(reader: BagReader, means: Resources) -> tuple[int, int]:
    """Streams that one process encodes at a time, and the threads of each encoder."""
    cores = means.jobs or means.cores
    workers = min(cores, sum(map(is_camera, reader.channels)) or 1)
    return workers, max(1, -(-cores // workers))


def _digest_tasks(reader: BagReader, asked: Slice) -> list[Task]:
    return [
        Task(f"source-{number}", source=number)
        for number, path in enumerate(reader.files)
        if is_hashed(path, asked)
    ]


def _work(
    reader: BagReader, channels: Sequence[Channel], survey: Survey
) -> dict[str, tuple[int, float]]:
    """Messages of each topic, and the cost of one: its bytes, more if it is encoded."""
    stats = reader.stats()
    work: dict[str, tuple[int, float]] = {}
    for channel in channels:
        first = reader.first(channel) if channel.id in survey.decisions else None
        encoded = any(item.plans for item in survey.decisions.get(channel.id, ()))
        cost = len(first.data) * (1.0 if encoded else _COPIED) if first else _OTHER_COST
        count, _ = work.get(channel.topic, (0, 0.0))
        count += stats[channel.id].count if channel.id in stats else 0
        work[channel.topic] = (count, cost)
    return work


def _topics(
    reader: BagReader, channels: Sequence[Channel], options: PackOptions
) -> tuple[_Topics, dict[int, int]]:
    """How the camera channels can be divided, and the calibrations paired by name."""
    cameras = [channel for channel in channels if is_camera(channel)]
    bound = {channel.topic for channel in cameras if _is_bound(reader, channel)}
    pairs = pair_camera_infos(channels, chosen=choose_pairs(options.camera_info, channels))
    by_id = {channel.id: channel.topic for channel in channels}
    return (
        _Topics(
            [channel for channel in cameras if channel.topic not in bound],
            [channel for channel in cameras if channel.topic in bound],
            {by_id[info]: by_id[image] for info, image in pairs.items()},
        ),
        pairs,
    )


def _is_bound(reader: BagReader, channel: Channel) -> bool:
    first = reader.first(channel)
    return first is not None and depends_on_others(channel, first)


def _survey(
    reader: BagReader,
    channels: Sequence[Channel],
    topics: _Topics,
    pairs: dict[int, int],
    spans: Sequence[tuple[int | None, int | None]],
    settings: StreamSettings,
) -> Survey:
    infos = [channel for channel in channels if is_calibration(channel)]
    found: dict[int, int] = {}
    if unpaired_infos(channels, pairs):
        found = survey_pairs(reader, topics.free, infos, pairs)
        by_id = {channel.id: channel.topic for channel in channels}
        topics.infos.update({by_id[info]: by_id[image] for info, image in found.items()})
    starts = [start for start, _ in spans]
    decisions = {
        channel.id: survey_channel(reader, channel, starts, settings) for channel in topics.free
    }
    return Survey(decisions, found)


def _tasks(
    spans: Sequence[tuple[int | None, int | None]],
    topics: _Topics,
    reader: BagReader,
    asked: Slice,
) -> list[Task]:
    """All tasks: of the topics that are packed as a whole, and of each span of the others."""
    solo = [
        _with_infos([topic], topics)
        for topic in dict.fromkeys(channel.topic for channel in topics.bound)
    ]
    without = tuple(sorted(topic for group in solo for topic in group))
    tasks = _digest_tasks(reader, asked)
    tasks += [Task(f"whole-{n}", topics=group, solo=True) for n, group in enumerate(solo)]
    for number, (start, end) in enumerate(spans):
        tasks.append(Task(f"{number:05}-0", start, end, without=without, others=number == 0))
    return tasks


def _with_infos(group: Sequence[str], topics: _Topics) -> tuple[str, ...]:
    """Topics of a group, including those of their calibrations."""
    infos = [info for info, image in topics.infos.items() if image in group]
    return tuple(sorted({*group, *infos}))
