"""What is decided before a recording is packed: how images are stored, and its pieces.

Images are looked at: the first of each kind, or those with which the pieces of a long recording
begin.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

from mp4ds.bags.formats import open_sources
from mp4ds.bags.latched import take_slice
from mp4ds.bags.mcap import compressed_size
from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.recording import dataset_at, open_source
from mp4ds.errors import EncoderRefusedError, OptionError, Refused, SourceError
from mp4ds.files.sources import SourceState
from mp4ds.files.urls import location, spelled
from mp4ds.format.manifest import About
from mp4ds.format.sidecars import MANIFEST_NAME, load_about
from mp4ds.messages.depth import DEPTHS
from mp4ds.messages.encodings import ENCODINGS, Encoding, Pixels
from mp4ds.messages.layouts import LAYOUTS, Layout, fit, layout_for
from mp4ds.messages.serializations import is_camera
from mp4ds.packing.inspection import (
    CameraMessage,
    MessageInspector,
    StreamKey,
    choose_pairs,
    depends_on_others,
    pair_camera_infos,
)
from mp4ds.packing.manifest import Digest, PartRecord, origin_of, tools
from mp4ds.packing.options import NO_VIEW, PackOptions, plugin
from mp4ds.packing.tracks import TrackPlan
from mp4ds.packing.windows import WindowCoder
from mp4ds.processes import available_cores
from mp4ds.records import Channel, Excerpt, Message
from mp4ds.times import cut_times
from mp4ds.video.codecs import (
    AV1,
    BESIDE_PRESET,
    DEFAULT_LOSSY,
    DIFFERENCES_GOP,
    LOSSY_GOP,
    PURPOSE_PRESET,
    TRAINING,
    TRAINING_CRF,
    TRAINING_PRESET,
    VIEW_CRF,
    VIEW_LEVELS,
    VIEW_PRESET,
    VIEW_TRAINING_GOP,
    fastest_preset,
    lossless_codecs,
    recipe_for,
    visual_setting,
)
from mp4ds.video.encoder import Coding, choose, choose_predicted, difference_layouts
from mp4ds.video.packets import packet_format

# ---------------------------------------------------------------- one kind of images

SAMPLES = 6
"""Images of a stream that show how it is best encoded."""

MAX_STREAMS_PER_CHANNEL = 16
"""Limit of streams for a channel that keeps changing its geometry."""

_MAX_LOOKS = 64
_KEPT_JPEG = "JPEG files are kept as they are; --transcode re-encodes them"
_PLAYED = ("yuv420p", "yuvj420p")
"""Pixel formats that any player of a codec shows."""
_LARGER = 1.05
"""How much larger than without a view images may become by having one."""
_NEGLIGIBLE = 1 / 50
"""Share of the raw size below which a video is kept even if zstd would be smaller."""


@dataclass(frozen=True, slots=True)
class Decision:
    """How images of one key are stored.

    Attributes:
        key: What they have in common.
        plans: The best first, ending with one for every image; none if they get no video.
        refusal: Why they get none.
    """

    key: StreamKey
    plans: Sequence[TrackPlan] = ()
    refusal: str = ""

    @property
    def texts(self) -> list[str]:
        """All of it in words: the same for equal decisions, in every process."""
        return [str(self.key), *(plan.text for plan in self.plans), self.refusal]


def decide(
    samples: Sequence[CameraMessage],
    options: PackOptions,
    threads: int,
    rate: float | None,
) -> Decision:
    """How images are stored, by looking at the first of them.

    Args:
        samples: The first images of one key, at least one, at most `SAMPLES`.
        options: What was asked for.
        threads: Of an encoder.
        rate: Frames per second, where known.

    Raises:
        ScoringError: A score is asked for that cannot be computed.
    """
    first = samples[0]
    try:
        if first.pixels is None:
            return Decision(first.key, _packet_plans(first, options))
        encoding = ENCODINGS[first.key.encoding]
        may_lose = not options.goal.lossless and encoding.name not in DEPTHS
        layout = _shown_layout(encoding, _pixels(samples)) if may_lose else None
        if layout is not None:
            plans = _lossy_plans(samples, layout, options, threads, rate)
        elif options.is_fast:
            plans = [_general_plan(first.key, options, is_fast=True)]
        else:
            plans = _lossless_plans(samples, options, threads)
        return Decision(first.key, plans)
    except Refused as reason:
        return Decision(first.key, refusal=str(reason))


def needs_trial(seen: CameraMessage, options: PackOptions) -> bool:
    """Whether `decide` benefits from having several messages."""
    if seen.pixels is None or options.is_fast:
        return False
    lossy = None if options.goal.lossless else ENCODINGS[seen.key.encoding].lossy
    is_tried = seen.key.body != "jpeg" and (lossy is None or bool(LAYOUTS[lossy].parameters))
    return is_tried or options.goal.target is not None


def _shown_layout(encoding: Encoding, pixels: Sequence[Pixels]) -> Layout | None:
    """The layout in which lossy videos show images; None if there is none."""
    return fit(encoding.lossy, encoding, pixels) if encoding.lossy else None


def _pixels(samples: Sequence[CameraMessage]) -> list[Pixels]:
    return [seen.pixels for seen in samples if seen.pixels is not None]


def _packet_plans(seen: CameraMessage, options: PackOptions) -> list[TrackPlan]:
    """Of what is kept as it came: with a view if one is asked for."""
    codec = seen.key.codec
    if not options.asks_for_views:
        can_shrink = codec == "mjpeg" and not options.goal.lossless
        return [TrackPlan(note=_KEPT_JPEG if can_shrink else "")]
    view = _view_coding([], ENCODINGS[seen.key.encoding], options)
    if view is None:
        return [TrackPlan()]
    name = view.recipe.codec
    if codec == name and packet_format(codec, seen.parameters, seen.parts.body) in _PLAYED:
        return [TrackPlan(note=f"its own packets are {name} that plays: it needs no view")]
    # the second for pictures that the view's encoder does not take
    return [TrackPlan(view=view), TrackPlan(note=f"without a view: {name} cannot encode its size")]


# ---------------------------------------------------------------- lossy

_SCORE_PRESET = "8"
"""SVT-AV1's preset for a score: a window is encoded several times, and preset 7 at its lowest crf
gets less close to a noisy original."""


def _lossy_plans(
    samples: Sequence[CameraMessage],
    layout: Layout,
    options: PackOptions,
    threads: int,
    rate: float | None,
) -> list[TrackPlan]:
    quality = options.goal
    key, target = samples[0].key, quality.target
    bits = layout.parameters.bits
    note = f"{bits} bits are kept as 8" if bits else ""
    crf, preset = quality.crf, options.preset
    if options.is_fast and target is None:
        preset = preset or fastest_preset(options.codec or DEFAULT_LOSSY)
    if crf is None:  # the search for a score starts there
        crf, table_preset = visual_setting(rate)
        if options.codec in (None, *AV1):
            usual = PURPOSE_PRESET if options.purpose else str(table_preset)
            if options.purpose == TRAINING:
                crf, usual = TRAINING_CRF, TRAINING_PRESET
            preset = preset or (_SCORE_PRESET if target else usual)
    recipe = recipe_for(
        layout.pixel_format,
        lossless=False,
        codec=options.codec,
        crf=crf,
        preset=preset,
        varied=target is not None,
    )
    coding = Coding(layout, recipe, options.group_frames)
    if target is None:
        plan = TrackPlan(coding, profile=str(quality), note=note)
        return [plan, *([_general_plan(key, options)] if layout.parameters.values else [])]
    coder = WindowCoder(coding, (key.width, key.height), target, threads, rate)
    is_jpeg = key.body == "jpeg"
    try:
        plan = TrackPlan(
            coding.with_crf(coder.start_crf(samples)),
            profile=str(target),
            target=target,
            note=note,
        )
    except EncoderRefusedError as error:
        raise Refused(str(error)) from None
    except Refused as reason:
        if is_jpeg:  # which is smaller than any lossless video of its pixels
            raise
        return _lossless_plans(samples, options, threads, note=f"kept lossless: {reason}")
    # for images that cannot reach it
    return [plan] if is_jpeg else [plan, _general_plan(key, options)]


# ---------------------------------------------------------------- lossless


def _general_plan(key: StreamKey, options: PackOptions, *, is_fast: bool = False) -> TrackPlan:
    """For every image of an encoding; fast: by what encodes in the least time (spec/notes.md)."""
    layout = layout_for(ENCODINGS[key.encoding], lossless=True)
    codec = preset = None
    if is_fast:
        able = lossless_codecs(layout.pixel_format)
        codec, preset = options.codec, options.preset
        if codec is None or codec not in able:  # of those that are, H.264 has the fastest presets
            codec, preset = ("h264" if "h264" in able else able[0]), None
        preset = preset or fastest_preset(codec)
    recipe = recipe_for(layout.pixel_format, lossless=True, codec=codec, preset=preset)
    return TrackPlan(Coding(layout, recipe, options.group_frames))


def _lossless_plans(
    samples: Sequence[CameraMessage],
    options: PackOptions,
    threads: int,
    note: str = "",
) -> list[TrackPlan]:
    encoding = ENCODINGS[samples[0].key.encoding]
    pixels, gop = _pixels(samples), options.group_frames
    codec, preset = options.codec, options.preset
    if not options.goal.lossless:
        codec = preset = None  # they were meant for lossy videos
        note = note or f"{encoding.name} is kept lossless"
    tried = partial(choose, pixels, encoding, gop=gop, threads=threads, purpose=options.purpose)
    try:
        try:
            best = tried(codec=codec, preset=preset)
        except (OptionError, EncoderRefusedError) as error:
            if codec is None:
                raise
            best = tried(codec=None, preset=None)
            note = "; ".join(filter(None, (note, f"coded as {best.recipe.codec}: {error}")))
    except EncoderRefusedError as error:
        raise Refused(str(error)) from None
    plan, least = TrackPlan(best, note=note), best.bytes_per_frame
    view = _view_coding(pixels, encoding, options)
    if view is not None:
        source = [best.layout] if best.layout.is_source else []
        is_usual = not source and options.gop is None and options.purpose is None
        with suppress(OptionError, EncoderRefusedError):
            both, beside = choose_predicted(
                pixels,
                source or difference_layouts(view.layout),
                view,
                least,  # which the first images make 1 to 3 % too large
                gop=gop,
                h264_gop=DIFFERENCES_GOP if is_usual else None,
                threads=threads,
                codec=codec,
                preset=preset,
                purpose=options.purpose,
            )
            is_predicted = both.bytes_per_frame <= least + beside
            size = min(both.bytes_per_frame, least + beside)
            if size > _LARGER * least:
                larger = f"with its view about {size / least:.1f} times as large as without"
                note = "; ".join(filter(None, (note, larger if options.asks_for_views else "")))
            if size <= _LARGER * least or options.asks_for_views:
                if not is_predicted:
                    view = _view_coding(pixels, encoding, options, beside=True)
                best, least = both if is_predicted else best, min(least, size)
                plan = TrackPlan(best, view, is_predicted, note=note)
    _refuse_noise(samples, least)
    if plan.view is None and best.layout.name == encoding.general:
        return [plan]
    return [plan, _general_plan(samples[0].key, options)]


def _view_coding(
    pixels: Sequence[Pixels], encoding: Encoding, options: PackOptions, *, beside: bool = False
) -> Coding | None:
    """How the view of lossless images is encoded, beside what it does not predict; None without."""
    layout = None if options.view == NO_VIEW else _shown_layout(encoding, pixels)
    if layout is None:
        return None
    codec = options.view or DEFAULT_LOSSY
    preset = PURPOSE_PRESET if options.purpose else BESIDE_PRESET if beside else VIEW_PRESET
    recipe = recipe_for(
        layout.pixel_format,
        lossless=False,
        codec=codec,
        crf=VIEW_CRF,
        preset=preset if codec in AV1 else None,
    )
    if codec == DEFAULT_LOSSY:
        recipe = replace(recipe, options={**recipe.options, "svtav1-params": VIEW_LEVELS})
    gop = VIEW_TRAINING_GOP if options.purpose == TRAINING else LOSSY_GOP
    return Coding(layout, recipe, gop)


def _refuse_noise(samples: Sequence[CameraMessage], video_size: float) -> None:
    """Refuse images that a video would not make smaller.

    Raises:
        Refused: Gives both sizes.
    """
    bodies = [seen.parts.body for seen in samples]
    raw = sum(map(len, bodies)) / len(bodies)
    if video_size <= raw * _NEGLIGIBLE:
        return
    verbatim = compressed_size(bodies) / len(bodies)
    if video_size > verbatim:
        raise Refused(
            f"a video would not be smaller: about {video_size / verbatim:.2f} times as large"
        )


# ---------------------------------------------------------------- plan and pieces

COPIED = "copied"
"""Name of the piece whose streams are copied from the dataset that is packed."""

PIECE_NAME = rf"all|{COPIED}|whole-[0-9]{{1,9}}|[0-9]{{5,9}}"
"""Pattern of the names of pieces, which are also folder names."""

_USUAL = PackOptions()


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
        frames: Messages of each topic of images; None where that is unknown.
        threads: Of each encoder.
        workers: Streams that a process encodes in parallel.
        tools: Versions of what packs: parts made by different ones may not fit together.
        decisions: How images of a camera channel, by its id, are stored in all pieces; none before
            `surveyed`, and for a single piece.
        copied: Topics of streams that are not encoded, but copied as a piece.
    """

    paths: Sequence[str]
    sources: Sequence[SourceState]
    options: PackOptions
    about: About | None
    pieces: Sequence[Piece]
    pairs: Mapping[int, int]
    frames: Mapping[str, int | None]
    threads: int
    workers: int
    tools: Mapping[str, str]
    decisions: Mapping[int, Sequence[Decision]] = field(default_factory=dict)
    copied: frozenset[str] = frozenset()

    @property
    def is_divided(self) -> bool:
        """Whether there are several pieces."""
        return len(self.pieces) > 1

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
        return open_recording(list(map(location, self.paths)), self.options)

    @property
    def hashed(self) -> list[SourceState]:
        """The files that are hashed: of a slice, not those that are read only in part."""
        is_part = self.options.is_slice
        return [
            source
            for source in self.sources
            if not is_part or location(source.path).name == MANIFEST_NAME
        ]

    def origin(
        self, reader: BagReader, part: PartRecord, digests: Mapping[str, Digest]
    ) -> dict[str, Any]:
        """The fields of a manifest that tell where a dataset came from.

        Args:
            reader: The recording.
            part: What was packed.
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
        return origin_of(reader, part, digests, self.about)


# ---------------------------------------------------------------- recordings


def open_recording(paths: Sequence[Path], options: PackOptions = _USUAL) -> BagReader:
    """Open what is to be packed.

    Args:
        paths: Recordings and datasets that belong together, or what is imported.
        options: How: salvaging, importing, or a slice with the latched messages of
            the topics that are packed.

    Raises:
        SourceError: It cannot be read.
        OptionError: The options do not apply to it.
    """
    images = options.images
    other = "what is imported" if images else "a dataset" if any(map(dataset_at, paths)) else ""
    if options.salvage and other:
        raise OptionError(f"`salvage` works with recordings, not with {other}.")
    if images is not None and len(paths) != 1:
        raise OptionError(
            f"Only one folder or video can be imported at a time, but {len(paths)} were given."
        )
    reader: BagReader
    if images is None:
        reader = open_sources(paths, salvage=options.salvage, opener=open_source)
    else:
        reader = plugin("importing.images:open_images")(paths[0], images)
    try:
        if options.is_slice:
            take_slice(reader, options, options.selected)
        if options.redact:
            reader = plugin("redacting:RedactedReader")(reader, options)
        if options.derives:
            reader = plugin("reducing:ReducedReader")(reader, options)
    except BaseException:
        reader.close()
        raise
    return reader


# ---------------------------------------------------------------- pieces

GOPS_PER_WINDOW = 10
"""Groups of pictures of the busiest camera in a window: a cut costs at most one key frame."""

LEAST_WINDOW = 300
"""Minimum frames of a window, unless the user says otherwise: each part has some overhead."""


def divide(
    reader: BagReader,
    paths: Sequence[Path],
    options: PackOptions,
    recordings: int = 1,
    copied: frozenset[str] = frozenset(),
) -> Plan:
    """Divide a recording into pieces.

    Args:
        reader: The recording.
        paths: What it was opened from.
        options: How to pack.
        recordings: How many are packed at the same time.
        copied: See `Plan`.

    Returns:
        The plan, without its survey.

    Raises:
        OptionError: An option is wrong.
    """
    selected = options.selected
    selected.check(channel.topic for channel in reader.channels)
    channels = [channel for channel in reader.channels if selected(channel.topic)]
    packed = [one for one in channels if is_camera(one) and one.topic not in copied]
    pairs = reader.pairs
    if pairs is None:
        pairs = pair_camera_infos(channels, chosen=choose_pairs(options.camera_info, channels))
    pieces = _pieces(reader, channels, pairs, options, copied) if reader.is_indexed else []
    cores = max(1, available_cores() // recordings)
    stats = reader.stats()
    frames: dict[str, int | None] = {}
    for channel in packed:
        unknown = 0 if reader.is_indexed else None
        count = stats[channel.id].count if channel.id in stats else unknown
        before = frames.get(channel.topic, 0)
        frames[channel.topic] = None if before is None or count is None else before + count
    if len(pieces) > 1:
        # where there are more cores than pieces, each has several: for streams, then for encoders
        spare = max(1, cores // len(pieces))
        workers = min(spare, len(packed))
        threads = max(1, spare // workers)
    else:
        pieces = [Piece("all", Excerpt(without=copied), is_solo=bool(copied))]
        cores = options.jobs or cores if recordings == 1 else cores
        workers = min(cores, len(list(filter(is_camera, reader.channels))) or 1)
        threads = max(1, -(-cores // workers))
    if copied:
        pieces.append(Piece(COPIED, Excerpt(topics=copied, others=False), is_solo=True))
    return Plan(
        paths=list(map(spelled, paths)),
        sources=[SourceState.of(path) for path in reader.files],
        options=options,
        about=None if options.about is None else load_about(options.about),
        pieces=pieces,
        pairs=pairs,
        frames=frames,
        threads=threads,
        workers=workers,
        tools=tools(),
        copied=copied,
    )


def _pieces(
    reader: BagReader,
    channels: Sequence[Channel],
    pairs: Mapping[int, int],
    options: PackOptions,
    copied: frozenset[str],
) -> list[Piece]:
    """The pieces of an indexed recording; fewer than two where it is packed at once."""
    cameras = [one for one in channels if is_camera(one) and one.topic not in copied]
    free = _independent(reader, cameras)
    if not free:
        return []
    window = options.window or GOPS_PER_WINDOW * options.group_frames
    if options.window is None and options.gop is None:
        window = max(window, LEAST_WINDOW)
    times = reader.times()
    columns = [times[channel.id] for channel in free if len(times.get(channel.id, ()))]
    cuts = cut_times(columns, window)
    if not cuts:
        return []
    topics = {channel.topic for channel in free}
    by_id = {channel.id: channel.topic for channel in channels}
    pieces: list[Piece] = []
    without = set(copied)
    for topic in dict.fromkeys(camera.topic for camera in cameras if camera.topic not in topics):
        own = {topic, *(by_id[info] for info, image in pairs.items() if by_id[image] == topic)}
        excerpt = Excerpt(topics=frozenset(own), others=False)
        pieces.append(Piece(f"whole-{len(pieces)}", excerpt, is_solo=True))
        without |= own
    for number, (start, end) in enumerate(pairwise([None, *cuts, None])):
        excerpt = Excerpt(start, end, without=frozenset(without), others=number == 0)
        pieces.append(Piece(f"{number:05}", excerpt))
    return pieces


def _independent(reader: BagReader, cameras: Sequence[Channel]) -> list[Channel]:
    """The camera channels that can be cut anywhere."""
    firsts = [(camera, reader.first(camera)) for camera in cameras]
    bound = {camera.topic for camera, one in firsts if one and depends_on_others(camera, one)}
    return [camera for camera in cameras if camera.topic not in bound]


# ---------------------------------------------------------------- what all pieces agree on


def surveyed(plan: Plan, reader: BagReader) -> Plan:
    """The plan with how images are stored in all its pieces.

    The images with which pieces begin are looked at.

    Args:
        plan: Of several pieces.
        reader: The recording.
    """
    if not plan.is_divided:
        return plan
    starts = [piece.excerpt.start for piece in plan.pieces if not piece.is_solo]
    starts = starts[:: -(-len(starts) // _MAX_LOOKS) or 1]
    decisions: dict[int, Sequence[Decision]] = {}
    chosen = [one for one in reader.channels if plan.options.selected(one.topic)]
    cameras = [one for one in chosen if is_camera(one) and one.topic not in plan.copied]
    for channel in _independent(reader, cameras):
        inspector = MessageInspector(channel, transcode=plan.options.transcode)
        stats = reader.stats().get(channel.id)
        found: dict[StreamKey, Decision] = {}
        for start in starts:
            excerpt = Excerpt(start=start, topics=frozenset([channel.topic]), others=False)
            samples = _samples(inspector, channel, reader.records(excerpt), plan.options)
            if samples and samples[0].key not in found:
                # one thread: on other cores, a pack that is resumed has to decide the same
                rate = stats.rate if stats else None
                decision = decide(samples, plan.options, 1, rate)
                found[decision.key] = decision
                if len(found) == MAX_STREAMS_PER_CHANNEL:
                    break
        decisions[channel.id] = list(found.values())
    return replace(plan, decisions=decisions)


def _samples(
    inspector: MessageInspector, channel: Channel, records: Iterator[object], options: PackOptions
) -> list[CameraMessage]:
    """The first images of one key, as many as needed to decide."""
    samples: list[CameraMessage] = []
    for record in islice(records, 4 * SAMPLES):
        if isinstance(record, Message) and record.channel.id == channel.id:
            with suppress(Refused):
                seen = inspector.inspect(record)
                if not samples or seen.key == samples[0].key:
                    samples.append(seen)
        enough = SAMPLES if samples and needs_trial(samples[0], options) else 1
        if len(samples) == enough:
            break
    return samples
