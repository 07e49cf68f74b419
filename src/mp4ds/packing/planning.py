"""Divides a pack into independent tasks."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.protocols import BagReader
from mp4ds.errors import OptionError, Refused
from mp4ds.files.sources import SourceState
from mp4ds.messages.serializations import is_calibration, is_camera
from mp4ds.options import Slice
from mp4ds.packing.calibrations import choose_pairs, pair_camera_infos, unpaired_infos
from mp4ds.packing.job import Job, Task, absolute, is_hashed, outcome_options, tools
from mp4ds.packing.look import Looker, depends_on_others
from mp4ds.packing.options import PackOptions
from mp4ds.packing.survey import Decision, Survey, decide, rate_of, survey_channel, survey_pairs
from mp4ds.packing.tracks import PicturePlan, StreamSettings, TargetPlan, needs_trial
from mp4ds.plan import QualitySetting, Selection, parse_purpose
from mp4ds.records import Channel
from mp4ds.video.trial import encoder_bytes

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


def group_topics(costs: Mapping[str, int], budget: int) -> list[list[str]]:
    """Group topics so that no group exceeds a budget, if possible.

    Args:
        costs: Memory that each topic takes while it is packed, bytes.
        budget: Bytes.

    Returns:
        At least one group; a topic beyond the budget has its own.
    """
    groups: list[list[str]] = []
    left: list[int] = []
    for topic in sorted(costs, key=lambda topic: (-costs[topic], topic)):
        place = next((n for n, room in enumerate(left) if costs[topic] <= room), None)
        if place is None:
            place = len(groups)
            groups.append([])
            left.append(budget)
        groups[place].append(topic)
        left[place] -= costs[topic]
    return groups or [[]]


def share(number: int, tasks: Sequence[tuple[str, ...]], shares: int) -> list[tuple[str, ...]]:
    """One machine's share of the tasks: every nth one.

    Args:
        number: Number of the share, from 1.
        tasks: All, in an order on which all machines agree.
        shares: Number of shares.
    """
    return list(tasks[number - 1 :: shares])


# ---------------------------------------------------------------- planning

TASK_BYTES = 160 * 2**20
"""A task's memory besides its encoders: the interpreter, libraries, and chunks of the source."""

_MESSAGES_IN_FLIGHT = 8
_ASSUMED_ROW = 32  # bytes of a lossless encoder per byte of a message
_UNKNOWN_BYTES = 2**30  # of a task whose cameras no index lists
_COPIED, _OTHER_COST = 0.02, 1_000.0  # cost of a message that is not encoded; only for progress


@dataclass(frozen=True, slots=True)
class Resources:
    """Resources of a machine for a pack.

    Attributes:
        cores: Processors.
        memory: Bytes that may be used.
        jobs: Requested number of processes, or None.
    """

    cores: int
    memory: int
    jobs: int | None = None

    @classmethod
    def of(cls, options: PackOptions) -> Resources:
        """Those of this machine, within the options' limits."""
        return cls(available_cores(), options.memory or available_memory() // 2, options.jobs)

    def for_one_of(self, recordings: int) -> Resources:
        """The share of each of several recordings packed at the same time."""
        if recordings < 2:
            return self
        return replace(self, cores=max(1, self.cores // recordings), jobs=None)

    def slots(self, job: Job) -> int:
        """Number of processes for a job, limited by cores and memory.

        Raises:
            OptionError: Not one fits into the memory.
        """
        busy = max(1, self.cores // max(1, job.threads * job.workers))
        fitting = (self.memory - TASK_BYTES) // job.task_bytes  # except for what coordinates them
        if fitting < 1 and self.memory < job.task_bytes:
            needed = -(-job.task_bytes // 2**20)
            raise OptionError(
                f"`memory` of {self.memory // 2**20} MiB is too little: encoding the largest "
                f"images takes about {needed} MiB."
            )
        return min(self.jobs or busy, max(1, fitting))


def available_cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory() -> int:
    """This machine's memory, or the container's limit if lower, bytes."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            total = min(total, int(Path(name).read_text()))
        except (OSError, ValueError):
            continue
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
    selected = Selection(options.topics, options.exclude)
    selected.check(channel.topic for channel in reader.channels)
    channels = [channel for channel in reader.channels if selected(channel.topic)]
    if not reader.is_indexed:
        return _single(reader, paths, options, means, _UNKNOWN_BYTES)
    topics, pairs = _topics(reader, channels, options)
    settings = StreamSettings(
        quality=options.setting,
        codec=options.codec,
        preset=options.preset,
        gop=options.group_frames,
        threads=_side_by_side(reader, means)[1],
        transcode=options.transcode,
        purpose=parse_purpose(options.purpose),
    )
    needed = _assumed_bytes(reader, topics, settings)
    if not topics.free:
        return _single(reader, paths, options, means, needed)
    window = options.window or GOPS_PER_WINDOW * options.group_frames
    if options.window is None and options.gop is None:
        window = max(window, LEAST_WINDOW)
    times = reader.times()
    columns = [times[channel.id] for channel in topics.free if len(times.get(channel.id, ()))]
    spans = spans_of(cut_times(columns, window))
    if len(spans) == 1 and needed <= means.memory:
        return _single(reader, paths, options, means, needed)
    survey = _survey(reader, channels, topics, pairs, spans, replace(settings, threads=1))
    costs = _costs(reader, topics, survey, threads=1)
    budget = max(max(costs.values()), means.memory // (means.jobs or means.cores) - TASK_BYTES)
    groups = group_topics(costs, budget)
    tasks = _tasks(spans, groups, topics, reader, options.slice)
    spare = max(1, means.cores // len(tasks))
    workers = min(spare, max(map(len, groups)))
    threads = max(1, spare // workers)
    largest = _largest(groups, _costs(reader, topics, survey, threads=threads))
    if TASK_BYTES + largest > means.memory:
        threads, largest = 1, _largest(groups, costs)
    return Job(
        paths=absolute(paths),
        sources=[SourceState.of(path) for path in reader.files],
        options=outcome_options(options),
        threads=threads,
        workers=workers,
        task_bytes=TASK_BYTES + largest,
        survey=survey,
        tasks=tasks,
        work=_work(reader, channels, survey),
        cameras=list(dict.fromkeys(channel.topic for channel in (*topics.free, *topics.bound))),
        tools=tools(),
    )


def _single(
    reader: BagReader, paths: Sequence[Path], options: PackOptions, means: Resources, needed: int
) -> Job:
    """The job of one task that takes everything."""
    workers, threads = _side_by_side(reader, means)
    return Job(
        paths=absolute(paths),
        sources=[SourceState.of(path) for path in reader.files],
        options=outcome_options(options),
        threads=threads,
        workers=workers,
        task_bytes=needed,
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


def _largest(groups: Sequence[Sequence[str]], costs: Mapping[str, int]) -> int:
    return max(sum(costs[topic] for topic in group) for group in groups)


def _costs(reader: BagReader, topics: _Topics, survey: Survey, *, threads: int) -> dict[str, int]:
    """Memory of each topic's encoders and queued messages, bytes."""
    costs: dict[str, int] = {}
    for channel in topics.free:
        first = reader.first(channel)
        cost = _MESSAGES_IN_FLIGHT * len(first.data) if first else 0
        cost += sum(_encoder_bytes(item, threads) for item in survey.decisions[channel.id])
        costs[channel.topic] = costs.get(channel.topic, 0) + cost
    return costs


def _encoder_bytes(decision: Decision, threads: int) -> int:
    """Memory of the encoder of a key's images; of the first plan, as others are rarely needed."""
    for plan in decision.plans[:1]:
        if isinstance(plan, PicturePlan):
            size = plan.layout.picture_size(decision.key.width, decision.key.height)
            needed = encoder_bytes(plan.recipe, *size, threads)
            if isinstance(plan, TargetPlan) and plan.target.metric == "vmaf":
                from mp4ds.video.libvmaf import vmaf_bytes

                # a window is scored after its encoder is closed
                needed = max(needed, vmaf_bytes(*size, threads))
            return needed
    return 0


def _assumed_bytes(reader: BagReader, topics: _Topics, settings: StreamSettings) -> int:
    """Memory for packing everything at once, estimated before looking at the images closely."""
    needed = TASK_BYTES
    if settings.quality.target is not None:  # the crf is not searched for yet
        settings = replace(settings, quality=QualitySetting("visual"))
    for channel in topics.free:
        first = reader.first(channel)
        if first is None:
            continue
        needed += _ASSUMED_ROW * len(first.data)
        with suppress(Refused):
            seen = Looker(channel, transcode=settings.transcode).look(first)
            if not needs_trial(seen, settings):
                decision = decide([seen], settings, rate_of(reader, channel))
                needed += _encoder_bytes(decision, settings.threads)
    return needed


def _tasks(
    spans: Sequence[tuple[int | None, int | None]],
    groups: Sequence[Sequence[str]],
    topics: _Topics,
    reader: BagReader,
    asked: Slice,
) -> list[Task]:
    """All tasks, those of one time together; the first group also has those without a camera."""
    apart = [_with_infos(group, topics) for group in groups[1:]]
    solo = [
        _with_infos([topic], topics)
        for topic in dict.fromkeys(channel.topic for channel in topics.bound)
    ]
    without = tuple(sorted(topic for group in (*apart, *solo) for topic in group))
    tasks = _digest_tasks(reader, asked)
    tasks += [Task(f"whole-{n}", topics=group, solo=True) for n, group in enumerate(solo)]
    for number, (start, end) in enumerate(spans):
        name = f"{number:05}"
        tasks.append(Task(f"{name}-0", start, end, without=without, others=number == 0))
        tasks += [Task(f"{name}-{n}", start, end, group) for n, group in enumerate(apart, start=1)]
    return tasks


def _with_infos(group: Sequence[str], topics: _Topics) -> tuple[str, ...]:
    """Topics of a group, including those of their calibrations."""
    infos = [info for info, image in topics.infos.items() if image in group]
    return tuple(sorted({*group, *infos}))
