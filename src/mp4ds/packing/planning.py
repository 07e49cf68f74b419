"""What is decided about a recording before it is packed: its pieces, and what they agree on."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds._version import __version__
from mp4ds.bags.formats import RECORDING_SUFFIXES, open_reader, open_sources
from mp4ds.bags.latched import take_slice
from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.recording import DatasetReader
from mp4ds.errors import OptionError, SourceError, advising
from mp4ds.files.sources import SourceState
from mp4ds.files.urls import location, spelled
from mp4ds.format.manifest import About
from mp4ds.format.sidecars import COPY_AGAIN, MANIFEST_NAME, load_about
from mp4ds.messages.serializations import is_camera
from mp4ds.options import WHOLE, Slice
from mp4ds.packing.calibrations import find_pairs
from mp4ds.packing.inspection import depends_on_others
from mp4ds.packing.manifest import Digest, Origin
from mp4ds.packing.options import ImageFolder, PackOptions
from mp4ds.packing.survey import Decision, survey_channel
from mp4ds.packing.tracks import TrackPlan
from mp4ds.processes import available_cores
from mp4ds.records import EVERYTHING, Channel, Excerpt
from mp4ds.video.encoder import tool_versions

PIECE_NAME = r"all|whole-[0-9]{1,9}|[0-9]{5,9}"
"""Pattern of the names of pieces, which are also folder names."""

_BEST_JPEG = 100  # of the messages of a transcoded stream that is packed again


@dataclass(frozen=True, slots=True)
class Piece:
    """What is packed at a time, into a dataset.

    Attributes:
        name: Of the folder of that dataset.
        excerpt: What is read.
        is_solo: Whether it takes its topics for the whole recording.
    """

    name: str
    excerpt: Excerpt
    is_solo: bool = False

    @property
    def is_all(self) -> bool:
        """Whether it is the whole recording."""
        return self.excerpt == EVERYTHING

    @property
    def decides_itself(self) -> bool:
        """Whether how its images are stored concerns no other piece."""
        return self.is_all or self.is_solo


@dataclass(frozen=True)
class Plan:
    """How a recording is packed: by one process at once, or piece by piece, by any.

    Attributes:
        paths: The recordings, absolute or URLs, as they were given.
        sources: The state of all their files.
        options: As completed from the recordings.
        about: The description of the recording, if there is one.
        pieces: In the order of their time; a single one for a short recording, or without an index.
        pairs: Calibration channels and those of their images, by id.
        frames: Messages of each topic of images, if there are several pieces.
        threads: Of each encoder.
        workers: Streams that a process encodes in parallel.
        tools: Versions of what packs: parts made by different ones may not fit together.
        decisions: How images of a camera channel, by its id, are stored in all pieces; none before
            `surveyed`, and for a single piece.
    """

    paths: Sequence[str]
    sources: Sequence[SourceState]
    options: PackOptions
    about: About | None
    pieces: Sequence[Piece]
    pairs: Mapping[int, int]
    frames: Mapping[str, int]
    threads: int
    workers: int
    tools: Mapping[str, str]
    decisions: Mapping[int, Sequence[Decision]] = field(default_factory=dict)

    @property
    def is_divided(self) -> bool:
        """Whether there are several pieces."""
        return not self.pieces[0].is_all

    @property
    def texts(self) -> list[list[str]]:
        """What pieces agree on, in words: the same for equal plans, in every process."""
        if not self.decisions:
            return []
        pairs = [[f"{info} belongs to {image}"] for info, image in sorted(self.pairs.items())]
        return pairs + [
            [str(channel), *item.texts]
            for channel, items in sorted(self.decisions.items())
            for item in items
        ]

    def open(self) -> BagReader:
        """The recording, open.

        Raises:
            SourceError: It cannot be read.
        """
        options = self.options
        return open_recording(
            list(map(location, self.paths)),
            salvage=options.salvage,
            images=options.images,
            asked=options.slice,
            selected=options.selected,
        )

    @property
    def hashed(self) -> list[SourceState]:
        """The files that are hashed: of a slice, not those that are read only in part."""
        is_part = bool(self.options.slice)
        return [
            source
            for source in self.sources
            if not is_part or location(source.path).name == MANIFEST_NAME
        ]

    def origin(self, reader: BagReader, digests: Mapping[str, Digest]) -> Origin:
        """What a dataset comes from.

        Args:
            reader: The recording.
            digests: Of the files that are hashed, by their paths.

        Raises:
            SourceError: It consists of other files than when it was planned.
        """
        if list(map(spelled, reader.files)) != [source.path for source in self.sources]:
            raise SourceError(
                reader.path,
                "consists of different files than when packing began",
                "Start over with `restart`.",
            )
        return Origin.of(reader, digests, self.about)


def tools() -> dict[str, str]:
    """Versions of the software used."""
    return {"mp4ds": __version__, **tool_versions()}


# ---------------------------------------------------------------- recordings


def open_recording(
    paths: Sequence[Path],
    *,
    salvage: bool = False,
    images: ImageFolder | None = None,
    asked: Slice = WHOLE,
    selected: Callable[[str], bool] = lambda _: True,
) -> BagReader:
    """Open the source to pack.

    Args:
        paths: Recordings and datasets that belong together, or a folder of images.
        salvage: Read what can be read of damaged recordings.
        images: How to read the folder of images; None for recordings.
        asked: The slice to pack.
        selected: Which topics are packed; only their latched messages are.

    Raises:
        SourceError: It cannot be read.
        OptionError: The options do not apply to it.
    """
    reader = _open_whole(paths, salvage, images)
    if asked:
        try:
            take_slice(reader, asked, selected)
        except BaseException:
            reader.close()
            raise
    return reader


def _open_whole(paths: Sequence[Path], salvage: bool, images: ImageFolder | None) -> BagReader:
    if salvage and any(map(dataset_at, paths)):
        raise OptionError("`salvage` works with recordings, not with a dataset.")
    if images is None:
        return open_sources(paths, salvage=salvage, opener=_open_one)
    if salvage:
        raise OptionError("`salvage` works with recordings, not with a folder of images.")
    if len(paths) != 1:
        raise OptionError(
            f"Only one folder of images can be imported at a time, but {len(paths)} were given."
        )
    reader: BagReader = plugin("images")(paths[0], images)
    return reader


def dataset_at(path: Path) -> Path | None:
    """The folder of a dataset that is to be repacked; None for a recording."""
    folder = path.parent if path.name == MANIFEST_NAME else path
    if folder.suffix in RECORDING_SUFFIXES:  # saves a request for URLs
        return None
    try:
        return folder if (folder / MANIFEST_NAME).is_file() else None
    except OSError:
        return None  # opening it will say why


def _open_one(path: Path) -> BagReader:
    folder = dataset_at(path)
    if folder is None:
        return open_reader(path)
    with advising(COPY_AGAIN):
        dataset = Dataset(folder, jpeg_quality=_BEST_JPEG)
        dataset.verify_sidecars()
    return DatasetReader(dataset, advice=COPY_AGAIN)


# ---------------------------------------------------------------- resources


def processes_for(plan: Plan) -> int:
    """Processes that pack at a time: as requested, or as many as cores and memory serve."""
    encoders = sum(
        decision.key.width * decision.key.height * _bytes_a_pixel(track)
        for decisions in plan.decisions.values()
        for decision in decisions
        for track in decision.plans[:1]
    )
    busy = available_cores() // max(1, plan.threads * plan.workers)
    return plan.options.jobs or max(1, min(busy, _memory() // 2 // (encoders or 1)))


def _bytes_a_pixel(plan: TrackPlan) -> int:
    """About what an encoder takes; SVT-AV1 looks ahead with many pictures, x264 qp 0 with none."""
    if plan.coding is None:
        return 0
    return 60 if plan.coding.recipe.lossless else 300


def _memory() -> int:
    """This machine's memory, or the container's limit if lower, bytes."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):
            total = min(total, int(Path(name).read_text()))
    return total


# ---------------------------------------------------------------- cuts

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


# ---------------------------------------------------------------- pieces


def divide(
    reader: BagReader, paths: Sequence[Path], options: PackOptions, recordings: int = 1
) -> Plan:
    """Divide a recording into pieces.

    Args:
        reader: The recording.
        paths: What it was opened from.
        options: How to pack.
        recordings: How many are packed at the same time.

    Returns:
        The plan, without its survey.

    Raises:
        OptionError: An option is wrong.
    """
    selected = options.selected
    selected.check(channel.topic for channel in reader.channels)
    channels = [channel for channel in reader.channels if selected(channel.topic)]
    packed = [channel for channel in channels if is_camera(channel)]
    pairs = find_pairs(reader, options.camera_info, channels)
    pieces = _pieces(reader, channels, pairs, options) if reader.is_indexed else []
    cores = max(1, available_cores() // recordings)
    frames = Counter[str]()
    if len(pieces) > 1:
        # where there are more cores than pieces, each has several: for streams, then for encoders
        spare = max(1, cores // len(pieces))
        workers = min(spare, len(packed))
        threads = max(1, spare // workers)
        stats = reader.stats()
        for channel in packed:
            frames[channel.topic] += stats[channel.id].count if channel.id in stats else 0
    else:
        pieces = [Piece("all", EVERYTHING)]
        if recordings == 1:
            cores = options.jobs or cores
        workers = min(cores, len(list(filter(is_camera, reader.channels))) or 1)
        threads = max(1, -(-cores // workers))
    return Plan(
        paths=list(map(spelled, paths)),
        sources=[SourceState.of(path) for path in reader.files],
        options=options,
        about=None if options.about is None else load_about(options.about),
        pieces=pieces,
        pairs=pairs,
        frames=dict(frames),
        threads=threads,
        workers=workers,
        tools=tools(),
    )


def _pieces(
    reader: BagReader, channels: Sequence[Channel], pairs: Mapping[int, int], options: PackOptions
) -> list[Piece]:
    """The pieces of an indexed recording; fewer than two where it is packed at once."""
    cameras = [channel for channel in channels if is_camera(channel)]
    free = _independent(reader, channels)
    if not free:
        return []
    window = options.window or GOPS_PER_WINDOW * options.group_frames
    if options.window is None and options.gop is None:
        window = max(window, LEAST_WINDOW)
    times = reader.times()
    columns = [times[channel.id] for channel in free if len(times.get(channel.id, ()))]
    spans = spans_of(cut_times(columns, window))
    if len(spans) == 1:
        return []
    topics = {channel.topic for channel in free}
    by_id = {channel.id: channel.topic for channel in channels}
    pieces: list[Piece] = []
    without: set[str] = set()
    for topic in dict.fromkeys(camera.topic for camera in cameras if camera.topic not in topics):
        own = {topic, *(by_id[info] for info, image in pairs.items() if by_id[image] == topic)}
        excerpt = Excerpt(topics=frozenset(own), others=False)
        pieces.append(Piece(f"whole-{len(pieces)}", excerpt, is_solo=True))
        without |= own
    for number, (start, end) in enumerate(spans):
        excerpt = Excerpt(start, end, without=frozenset(without), others=number == 0)
        pieces.append(Piece(f"{number:05}", excerpt))
    return pieces


def _independent(reader: BagReader, channels: Sequence[Channel]) -> list[Channel]:
    """The camera channels that can be cut anywhere."""
    cameras = [channel for channel in channels if is_camera(channel)]
    bound = set()
    for channel in cameras:
        first = reader.first(channel)
        if first is not None and depends_on_others(channel, first):
            bound.add(channel.topic)
    return [channel for channel in cameras if channel.topic not in bound]


def surveyed(plan: Plan, reader: BagReader, known: Collection[str] = ()) -> Plan:
    """The plan with what all its pieces agree on.

    Args:
        plan: Of several pieces.
        reader: The recording.
        known: Texts of what existing parts were made by. A choice for fast reading depends on
            measured times: where one of these is among the candidates, it is chosen again.
    """
    if not plan.is_divided:
        return plan
    channels = [channel for channel in reader.channels if plan.options.selected(channel.topic)]
    starts = [piece.excerpt.start for piece in plan.pieces if not piece.is_solo]
    decisions = {
        channel.id: survey_channel(reader, channel, starts, plan.options, known)
        for channel in _independent(reader, channels)
    }
    return replace(plan, decisions=decisions)


# ---------------------------------------------------------------- plugins

_PLUGINS = {
    "images": "importing.layouts:open_images",
    "cluster": "cluster:ClusterExecutor",
}
"""What the core asks for -> module of `mp4ds.plugins`, and its name there."""


def plugin(name: str) -> Any:
    """What a plugin offers to the core, by one of the names above."""
    module, _, found = _PLUGINS[name].partition(":")
    return getattr(import_module(f"mp4ds.plugins.{module}"), found)
