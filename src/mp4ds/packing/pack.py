"""Source -> dataset: images into videos, everything else verbatim.

A short recording is packed in one pass. A long one is packed in parts, on every core or on other
machines, which are kept until all are done, and then put together.
"""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path

from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.checks import validate
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.recording import copy_part, dataset_at, slice_of, with_shared
from mp4ds.dataset.stream import Stream
from mp4ds.errors import (
    FormatError,
    OptionError,
    Refused,
    SourceError,
    TargetExistsError,
    WriteError,
    advising,
    path_text,
)
from mp4ds.files.outputs import check_target, digest_file, local_target, staged
from mp4ds.files.sources import (
    SourceHasher,
    is_unfinished,
    salvage_command,
    source_size,
    unchanged,
)
from mp4ds.files.urls import RemotePath, location, remote
from mp4ds.format.manifest import ReductionEntry
from mp4ds.format.models import StreamSidecar
from mp4ds.format.sidecars import COPY_AGAIN, MANIFEST_NAME, load_about, load_manifest
from mp4ds.messages.depth import DEPTHS
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.options import CONTENT, ENCODING
from mp4ds.packing.long_packs import PartedPack, Report, pack_parts
from mp4ds.packing.manifest import (
    PartRecord,
    dataset_files,
    folder_size,
    summarize,
    write_manifest,
)
from mp4ds.packing.options import NO_VIEW, PackOptions, PackSummary, plugin
from mp4ds.packing.packer import Exact, Packer, until_in_reach
from mp4ds.packing.parts import PartsFolder, PlanNote, digest_source
from mp4ds.packing.planning import (
    Plan,
    divide,
    open_recording,
    surveyed,
)
from mp4ds.packing.spool import recover
from mp4ds.packing.tracks import TrackPlan
from mp4ds.processes import ProcessExecutor, available_cores, memory_bytes
from mp4ds.video.codecs import (
    LOSSLESS,
    VISUAL,
    check_codec,
    parse_quality,
)
from mp4ds.video.scores import find_ffmpeg

# ---------------------------------------------------------------- in one pass


def _pack_in_one_pass(parted: PartedPack, exact: Exact) -> PackSummary:
    """Pack a whole recording; its files are hashed while they are read.

    Raises:
        SourceError: The recording is damaged, or changed while it was being read.
        WriteError: It cannot be written.
    """
    target = parted.target
    with (
        parted.plan.open() as reader,
        staged(target, force=parted.force, owned=dataset_files, sources=parted.paths) as folder,
    ):
        folder.mkdir()
        try:
            return _fill(folder, reader, parted, exact)
        except OSError as error:
            if isinstance(error, SourceError) or error.errno is None:
                raise
            raise WriteError(target, error) from error


def _fill(folder: Path, reader: BagReader, parted: PartedPack, exact: Exact) -> PackSummary:
    plan = parted.plan
    is_slice = plan.options.is_slice
    total = sum(map(source_size, reader.files))
    due = sum(item.count for item in reader.stats().values())
    next_report = 0.0

    def progress(part: PartRecord, *, done: bool = False) -> None:
        nonlocal next_report
        if not is_slice:  # close behind the reader: a store's bytes are kept for a moment only
            hasher.advance(reader.position)
        now = time.monotonic()
        if parted.report is not None and (done or now >= next_report):
            next_report = now + _REPORT_SECONDS
            share = reader.position / max(1, total)
            if is_slice:
                share = sum(topic.messages for topic in part.topics.values()) / max(1, due)
            parted.tell_whole(part, 1.0 if done else min(1.0, share))

    (piece,) = plan.pieces
    with unchanged(plan.sources), SourceHasher(reader.files) as hasher:
        part = Packer(reader, folder, plan, piece, exact, progress).run()
        if is_slice:  # little of it was read
            digests = {source.path: digest_source(source) for source in plan.hashed}
        else:
            files = enumerate(plan.hashed)
            digests = {source.path: hasher.digest(number) for number, source in files}
    write_manifest(part, plan.origin(reader, part, digests), str(plan.options.quality))
    progress(part, done=True)
    source_bytes = None if is_slice else total
    return summarize(part, parted.target, source_bytes, too_large=reader.slice.left_out)


# ---------------------------------------------------------------- pack

_USUAL = PackOptions()
_REPORT_SECONDS = 0.2


def pack(
    sources: Sequence[Path | str] | Path | str,
    dataset: Path | str | None = None,
    options: PackOptions | None = None,
    *,
    progress: Report | None = None,
) -> PackSummary:
    """Pack a recording into a dataset.

    Args:
        sources: A bag, rosbag2 folder, MCAP file or dataset, or several that belong together; or
            URLs. A folder of images or a video if the options have `images`.
        dataset: The folder to make, or its URL; None for a folder in the current one with the name
            of the recording.
        options: How to pack; lossless by default.
        progress: Called several times a second.

    Returns:
        The result for each topic.

    Raises:
        SourceError: The recording cannot be read.
        TargetError: The dataset cannot be written there.
        WriteError: The dataset could not be written.
        RemoteError: A store or web server fails.
        OptionError: An option is wrong.
        PartsFailedError: Parts of a long recording failed; finished ones are kept next to the
            dataset, and calling it again resumes. Otherwise nothing is left behind.
    """
    paths = _paths(sources)
    target = _target(dataset, paths)
    return _pack(paths, target, _checked(options or PackOptions(), paths), progress)


def _pack(
    paths: Sequence[Path], target: Path, options: PackOptions, progress: Report | None
) -> PackSummary:
    if any(map(is_unfinished, paths)):
        return _recovered(paths, target, options)
    if not _is_copy(paths, options):
        return _encoded(paths, target, options, progress)
    try:
        return _copy(paths[0], target, options)
    except Refused as reason:
        again = _checked(options, paths, may_copy=False)
        summary = _encoded(paths, target, again, progress)
        return replace(summary, not_copied=str(reason))


def _encoded(
    paths: Sequence[Path], target: Path, options: PackOptions, progress: Report | None
) -> PackSummary:
    parted = _planned(paths, target, options, progress)
    if parted.is_new and not parted.plan.is_divided and not options.cluster:
        return until_in_reach(partial(_pack_in_one_pass, parted))
    return _pack_all([parted], options)[0]


def _recovered(paths: Sequence[Path], target: Path, options: PackOptions) -> PackSummary:
    """The dataset of a recording that was cut off while `mp4ds record` made it."""
    folder = next(filter(is_unfinished, paths))
    usual = replace(_USUAL, salvage=True, force=options.force, about=options.about)
    if len(paths) > 1 or replace(options, quality=None) != usual:
        raise OptionError(
            f"{folder} was being recorded when it was cut off. Make a dataset of it first, and "
            f"pack that: {salvage_command(folder)}"
        )
    about = load_about(options.about) if options.about is not None else None
    return recover(folder, target, pack, force=options.force, about=about)


def _copy(path: Path, target: Path, options: PackOptions) -> PackSummary:
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
        if options.quality is None:
            dataset.require_exact(selected)
        else:
            dataset.streams = [
                stream.in_layer("view") if _is_encoded(stream, options) else stream
                for stream in dataset.streams
            ]
        selected.check(channel.topic for channel in dataset.channels)
        folder.mkdir()
        part = slice_of(dataset, options, selected)
        # whole files are checked as copied
        if options.is_slice or options.topics or options.exclude:
            dataset.verify_messages()
        copy_part(dataset, folder, part=part, selected=selected, about=about)
        if options.is_slice:
            for problem in validate(folder, deep=True):
                raise FormatError(problem.code, dataset.path, f"is damaged: {problem}")
        left_out = [item.topic for item in dataset.channels if not selected(item.topic)]
        made = PartRecord(folder, left_out=dict.fromkeys(left_out))
        summary = summarize(made, target, 0, is_copy=True, too_large=part.left_out)
        return replace(summary, source_bytes=folder_size(dataset.path))


def pack_share(
    sources: Sequence[Path | str] | Path | str,
    dataset: Path | str | None,
    share: tuple[int, int],
    options: PackOptions | None = None,
    *,
    progress: Report | None = None,
) -> None:
    """Pack one machine's share of a recording; `pack` makes the dataset when all shares are done.

    Args:
        sources: As for `pack`, under the same path on all machines.
        dataset: The folder to make in the end, as for `pack`; parts are made next to it.
        share: Number of this share, from 1, and the number of shares.
        options: How to pack; the same for all shares.
        progress: Called several times a second.

    Raises:
        Mp4dsError: As for `pack`.
    """
    paths = _paths(sources)
    chosen = _checked(options or PackOptions(), paths, may_copy=False)
    if chosen.finds:
        raise OptionError(
            "`redact` is a function, of which other shares may have another version: give a file "
            "of rules, or pack as a whole."
        )
    target = _target(dataset, paths)
    _pack_all([_planned(paths, target, chosen, progress, is_share=True)], chosen, share)


def pack_each(
    sources: Sequence[Path | str],
    folder: Path | str,
    options: PackOptions | None = None,
    *,
    progress: Report | None = None,
) -> list[PackSummary]:
    """Pack recordings into one dataset each, as one job.

    Args:
        sources: Each a bag, rosbag2 folder or MCAP file, or its URL.
        folder: Folder in which to make the datasets; each is named after its recording.
        options: How.
        progress: Called several times a second.

    Returns:
        The result for each one packed now, in the order of the sources; existing datasets of the
        same recordings are left as they are.

    Raises:
        Mp4dsError: As for `pack`.
    """
    paths = _paths(sources)
    asked = options or PackOptions()
    copied = [path for path in paths if _is_copy([path], asked)]
    chosen = _checked(asked, [path for path in paths if path not in copied], may_copy=False)
    parent = local_target(folder)
    targets: dict[Path, Path] = {}
    for source in paths:
        target = parent / _name_of(source)
        if target in targets:
            raise OptionError(
                f"{targets[target]} and {source} would both become {target}. Pack one of them "
                "elsewhere."
            )
        targets[target] = source
    parent.mkdir(exist_ok=True)
    missing = {
        target: source
        for target, source in targets.items()
        if asked.force or not is_packed(source, target, asked)
    }
    made: dict[Path, PackSummary] = {}
    parted = []
    for target, source in missing.items():
        if source in copied:  # one after another
            own = _checked(asked, [source])
            made[target] = _pack([source], target, own, progress)
        else:
            parted.append(_planned([source], target, chosen, progress, recordings=len(targets)))
    for summary in _pack_all(parted, chosen) if parted else ():
        made[summary.dataset] = summary
    return [made[target] for target in missing if target in made]


def is_packed(source: Path, target: Path, options: PackOptions) -> bool:
    """Whether a dataset of a recording already exists.

    Args:
        source: The recording.
        target: The dataset.
        options: How it is packed.

    Raises:
        TargetExistsError: Something else is there.
    """
    if not os.path.lexists(target):
        return False
    try:
        manifest = load_manifest(target / MANIFEST_NAME)
    except FormatError:
        raise TargetExistsError(target) from None
    folder = dataset_at(source)
    plain = PackOptions(**options.changing(CONTENT), salvage=options.salvage, images=options.images)
    with open_recording([source], replace(plain, latched=False)) as reader:
        span = reader.slice.span
        sizes = sorted(map(source_size, reader.files))
    reductions = [ReductionEntry.model_validate(options.reduction)] if options.derives else []
    hidden = [options.redaction.told] if options.redaction else []
    if folder:
        known = load_manifest(folder / MANIFEST_NAME)
        reductions = [*known.reductions, *reductions]
        hidden = [*(one.told for one in known.redactions), *hidden]
        due = [item.within(span) for item in known.sources]
        earlier = [item.sha256 for item in manifest.derived_from[-1:]]
        is_same = earlier == [digest_file(folder / MANIFEST_NAME)[1]] and manifest.sources == due
    else:
        is_same = sorted(item.size for item in manifest.sources) == sizes and all(
            item.within(span) == item.model_copy(update={"excerpt": None}).within(span)
            for item in manifest.sources
        )
    done = [entry.model_copy(update={"images": []}) for entry in manifest.reductions]
    asked = [entry.model_copy(update={"images": []}) for entry in reductions]
    hides = [one.told for one in manifest.redactions]
    if options.finds or not (is_same and done == asked and hides == hidden):
        raise TargetExistsError(target)
    return True


def _is_copy(paths: Sequence[Path], options: PackOptions) -> bool:
    """Whether it is one dataset, and no option asks for encoding its videos."""
    is_divided = options.join or options.cluster is not None
    folder = dataset_at(paths[0]) if len(paths) == 1 and not is_divided else None
    if folder is None:
        return False
    is_visual = options.quality is not None and options.quality.name == VISUAL
    kept = replace(options, quality=None, transcode=options.transcode and not is_visual)
    if options.view and not options.quality and _has_views(folder, options):
        kept = replace(kept, view=None)
    if kept.changing(ENCODING) != PackOptions().changing(ENCODING):
        return False
    if options.quality is None:
        return True
    streams = Dataset(folder).streams
    encoded = [stream for stream in streams if _is_encoded(stream, options)]
    has_views = all(one.exact_path or one.sidecar.profile == VISUAL for one in encoded)
    return is_visual and has_views and any(stream.exact_path for stream in streams)


def _has_views(folder: Path, options: PackOptions) -> bool:
    """Whether the streams of a dataset have the views that are asked for already."""
    chosen = [one.sidecar for one in Dataset(folder).streams if options.selected(one.topic)]
    has_some = options.view == NO_VIEW or any(one.view for one in chosen)
    return has_some and all(_has_view(one, options) for one in chosen)


def _has_view(sidecar: StreamSidecar, options: PackOptions) -> bool:
    """Whether a stream has the view that is asked for already, or can have none."""
    view = sidecar.view
    if options.view == NO_VIEW or view:
        return (view.codec if view else NO_VIEW) == options.view
    return sidecar.profile != LOSSLESS or not ENCODINGS[sidecar.image.encoding].lossy


def _copied_topics(paths: Sequence[Path], options: PackOptions) -> frozenset[str]:
    """Topics of streams that have the view already, if all that is asked for is that others do.

    Args:
        paths: What is to be packed.
        options: As completed.
    """
    folder = dataset_at(paths[0]) if len(paths) == 1 else None
    kept = {name: getattr(options, name) for name in ("view", "quality", "window")}
    is_usual = options.changing(CONTENT, ENCODING) == {**_USUAL.changing(CONTENT, ENCODING), **kept}
    if not (folder and is_usual and options.view and options.goal.lossless):
        return frozenset()
    with Dataset(folder) as dataset:
        lacking = {
            one.topic
            for one in dataset.streams
            if one.sidecar.profile != LOSSLESS or not _has_view(one.sidecar, options)
        }
        topics = {topic for one in dataset.streams if lacking for topic in one.topics}
        return frozenset(topics - with_shared(dataset, lacking.__contains__))


def _is_encoded(stream: Stream, options: PackOptions) -> bool:
    """Whether images of a stream become lossy ones where a lossy quality is asked for."""
    sidecar, name = stream.sidecar, stream.sidecar.image.encoding
    is_kept = sidecar.keeps_packets and not (options.transcode and stream.file_suffix == "jpg")
    return not is_kept and ENCODINGS[name].lossy is not None and name not in DEPTHS


def _checked(options: PackOptions, paths: Sequence[Path], *, may_copy: bool = True) -> PackOptions:
    """The options, completed from the sources; refuses contradictory ones.

    Args:
        options: As given by the user.
        paths: What is to be packed.
        may_copy: A dataset may be copied, in which case no quality is needed.

    Raises:
        OptionError: They contradict each other.
        ScoringError: VMAF is requested, but cannot be computed.
    """
    images = options.images.absolute() if options.images else None
    if options.about is not None:
        load_about(options.about)  # fails before anything is read
    if may_copy and _is_copy(paths, options):
        return options
    datasets = [Dataset(folder) for folder in map(dataset_at, paths) if folder]
    sidecars = [stream.sidecar for dataset in datasets for stream in dataset.streams]
    profiles = {dataset.manifest.profile for dataset in datasets if dataset.manifest}
    if len(datasets) < len(paths) or not paths:
        profiles.add(LOSSLESS)  # as of a recording
    if options.asks_for_views:
        _check_views(options, profiles)
    quality = options.quality
    if quality is None:
        if len(profiles) > 1 or parse_quality(*profiles).crf is not None:
            raise OptionError(
                "There is no default `quality` for what was packed as "
                f"{', '.join(sorted(profiles))}. Give one."
            )
        quality = parse_quality(*profiles)
    if quality.name != VISUAL:  # a score would be one of the views
        for dataset in datasets:
            dataset.require_exact(options.selected)
    if options.transcode and quality.lossless:
        raise OptionError(
            "`transcode` needs a lossy `quality`, such as visual: a JPEG file is smaller than "
            "any lossless video of its pixels."
        )
    codec = check_codec(
        options.codec,
        options.preset,
        lossless=quality.lossless,
        crf=quality.crf,
        fast=options.is_fast,
    )
    if quality.target and quality.target.metric == "vmaf" and not options.join:
        find_ffmpeg()  # fails before anything is read, saying how to get one
    transcode, view = options.transcode, options.view
    if not quality.lossless:
        transcode |= any(one.body == "jpeg" for one in sidecars)
    elif view is None and not options.is_fast:
        packets = (one.view for one in sidecars if one.body == "packet")
        view = next((one.codec for one in packets if one), None)
    chosen = replace(
        options, quality=quality, codec=codec, view=view, transcode=transcode, images=images
    )
    chosen.group_frames  # noqa: B018 - refuses a contradiction
    return chosen


def _check_views(options: PackOptions, profiles: Collection[str]) -> None:
    """Refuse views where there are none.

    Args:
        options: As given by the user.
        profiles: Of what is to be packed.

    Raises:
        OptionError: Says why.
    """
    told = {f"with `quality` {options.quality}": options.goal.lossless}
    if options.quality is None:
        told = {f"of a dataset of {one}": one == LOSSLESS for one in profiles}
    if lossy := [words for words, is_lossless in told.items() if not is_lossless]:
        raise OptionError(
            f"`view` is for lossless packing: {lossy[0]}, the videos are what a view would be."
        )
    if options.is_fast:
        raise OptionError(
            "`purpose` speed encodes nothing twice. Pack without `view`, and add views later: "
            "mp4ds pack DATASET -o NEW --view"
        )


def _planned(
    paths: Sequence[Path],
    target: Path,
    options: PackOptions,
    progress: Report | None,
    *,
    recordings: int = 1,
    is_share: bool = False,
) -> PartedPack:
    """The pack of a recording: one that was begun, or a new one."""
    check_target(target, force=options.force, owned=dataset_files, sources=paths)
    folder = PartsFolder(target)
    is_shared = is_share or options.join or options.cluster is not None
    note = None if options.restart else folder.note()
    if note is not None:
        note.check_sources(paths)
    elif options.join:
        raise OptionError(
            f"There is nothing to join: {folder.path} holds no pack in progress. Run the shards "
            "first."
        )
    with open_recording(paths, options) as reader:
        plan = divide(reader, paths, options, recordings, _copied_topics(paths, options))
        if note is not None:
            folder.check(PlanNote.of(plan), shared=is_shared)
        if not options.join:
            plan = surveyed(plan, reader)
    return PartedPack(
        plan, paths, target, options.force, progress, is_new=note is None, is_shared=is_shared
    )


def _pack_all(
    packs: Sequence[PartedPack], options: PackOptions, share: tuple[int, int] | None = None
) -> list[PackSummary]:
    """Pack recordings in parts, and make their datasets unless only a share is packed."""
    results = pack_parts(packs, _executor(packs, options), options, share)
    made = {summary.dataset: summary for summary in results}
    return [made[pack.target] for pack in packs if pack.target in made]


def _executor(
    packs: Sequence[PartedPack], options: PackOptions
) -> AbstractContextManager[Executor]:
    """What packs the pieces."""
    if options.cluster:
        found: AbstractContextManager[Executor] = plugin("cluster:cluster_executor")(
            options.cluster
        )
        return found
    return ProcessExecutor(min(_processes_for(pack.plan) for pack in packs))


def _processes_for(plan: Plan) -> int:
    """Processes that pack at a time: as requested, or as many as cores and memory serve."""
    encoders = sum(
        decision.key.width * decision.key.height * _bytes_a_pixel(track)
        for decisions in plan.decisions.values()
        for decision in decisions
        for track in decision.plans[:1]
    )
    busy = available_cores() // max(1, plan.threads * plan.workers)
    return plan.options.jobs or max(1, min(busy, memory_bytes() // 2 // (encoders or 1)))


def _bytes_a_pixel(plan: TrackPlan) -> int:
    """About what encoders take; SVT-AV1 looks ahead with many pictures, x264 qp 0 with none."""
    own = 0
    if plan.coding is not None:
        own = 60 if plan.coding.recipe.lossless else 250
    if plan.view is not None:  # its encoder and decoder, and some 45 images that wait for it
        own += 300 + (45 * plan.view.layout.encoding.pixel_bytes if plan.coding else 0)
    return own


def _paths(sources: Sequence[Path | str] | Path | str) -> list[Path]:
    several = [sources] if isinstance(sources, (str, Path, RemotePath)) else sources
    return [location(path) for path in several]


def _target(dataset: Path | str | None, paths: Sequence[Path]) -> Path:
    """The dataset to make: as named, or named after the recording, in the current folder.

    Raises:
        OptionError: It is not named, and has to be.
    """
    if dataset is not None:
        return local_target(dataset)
    if len(paths) != 1 or dataset_at(paths[0]):
        raise OptionError(
            "Give `output`, the dataset to make: only that of one recording is named by itself."
        )
    source = paths[0] if remote(paths[0]) else local_target(paths[0])
    target = local_target(_name_of(source))
    if target == source:
        raise OptionError(
            f"Give `output`, the dataset to make: {path_text(target)} is the recording itself."
        )
    return target


def _name_of(source: Path) -> str:
    """The name of a dataset after that of its recording."""
    return source.name if source.is_dir() else source.stem
