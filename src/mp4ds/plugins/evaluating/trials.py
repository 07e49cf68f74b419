"""Clips of cameras, the trials of settings on them, each in its own process, and what follows."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain, product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.formats import open_reader
from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.dataset import open_dataset
from mp4ds.dataset.recording import DatasetReader
from mp4ds.errors import Refused
from mp4ds.format.sidecars import names_dataset
from mp4ds.messages.encodings import ENCODINGS, Pixels
from mp4ds.messages.layouts import LAYOUTS, layout_for
from mp4ds.messages.serializations import is_camera, kind_of
from mp4ds.messages.wire import CodedFields
from mp4ds.packing.inspection import MessageInspector, depends_on_others
from mp4ds.packing.options import ImportOptions
from mp4ds.plugins.importing.images import open_images
from mp4ds.records import Channel, Excerpt, Message
from mp4ds.times import TIMESCALE, PresentationClock
from mp4ds.video.codecs import LOSSLESS, LOSSY_GOP, QualityTarget, Recipe, recipe_for
from mp4ds.video.encoder import VideoEncoder
from mp4ds.video.images import png_file
from mp4ds.video.packets import PacketReader
from mp4ds.video.pixels import (
    PLANES_FORMAT,
    PictureConverter,
    Planes,
    PlaneSpool,
    decoded_planes,
    rgb_of,
    to_planes,
)
from mp4ds.video.scores import (
    SMALLEST,
    ScoreSummary,
    find_ffmpeg,
    scores_of,
    summary_of,
)

PICTURES = "pictures"
"""The folder of an evaluation for the details shown."""

FRAMES, TICKS = "frames.yuv", "ticks.npy"
"""The files of a clip: its frames (see `PlaneSpool`), and when each is shown, as in a packed
video."""

_ENLARGED = 2


@dataclass(frozen=True, slots=True)
class Setting:
    """How to encode a clip, in the terms of ``mp4ds pack``.

    Attributes:
        codec: ``av1``, ``av1-10bit``, ``h264`` or ``h265``.
        preset: Of its encoder.
        crf: Constant rate factor.
        gop: Most frames between key frames.
    """

    codec: str
    preset: str
    crf: int
    gop: int = LOSSY_GOP

    @property
    def name(self) -> str:
        """A short name, unique within a grid."""
        return f"{self.codec} {self.preset} crf {self.crf}"

    @property
    def pack_options(self) -> str:
        """The corresponding options of ``mp4ds pack``."""
        gop = f" --gop {self.gop}" if self.gop != LOSSY_GOP else ""
        return f"--quality crf={self.crf} --codec {self.codec} --preset {self.preset}{gop}"


@dataclass(frozen=True)
class Clip:
    """Frames of a camera as encoder input.

    Attributes:
        encoding: ROS encoding of the images.
        picture_format: Pixel format of their pictures, which determines their tags.
        image_size: Width and height of an image.
        size: Columns and rows of a frame, even.
        rate: Frames per second of the camera; None if unknown.
        frames: How many there are.
        seconds: Their duration, the last one as long as the others.
        detail: x, y, width and height of the detail shown.
        detail_frame: Number of the frame shown.
        start: Log time of the first frame, seconds from the camera's first one.
        source_frames: Total number of the camera's images.
        left_out: Images in between with another size or encoding, or unreadable.
    """

    encoding: str
    picture_format: str
    image_size: tuple[int, int]
    size: tuple[int, int]
    rate: float | None
    frames: int
    seconds: float
    detail: tuple[int, int, int, int]
    detail_frame: int
    start: float
    source_frames: int
    left_out: int

    @property
    def recipe(self) -> Recipe:
        """One that says how the colours of the frames are coded."""
        return recipe_for(self.picture_format, lossless=False, crf=1)

    def open(self, folder: Path) -> PlaneSpool:
        """Open the file of the frames."""
        return PlaneSpool(folder / FRAMES, *self.size, frames=self.frames)

    def picture(self, planes: Planes, recipe: Recipe) -> bytes:
        """The detail of a frame, enlarged, as a PNG file."""
        x, y, width, height = self.detail
        rows, columns = slice(y // 2, (y + height) // 2), slice(x // 2, (x + width) // 2)
        luma = planes[0][y : y + height, x : x + width]
        rgb = rgb_of((luma, planes[1][rows, columns], planes[2][rows, columns]), recipe)
        return png_file(rgb.repeat(_ENLARGED, axis=0).repeat(_ENLARGED, axis=1))


@dataclass(frozen=True)
class Cell:
    """The results of one setting on one clip.

    Attributes:
        setting: How it was encoded.
        encode_seconds: Time to encode the clip.
        encode_cpu_seconds: CPU time of that, over all threads.
        decode_fps: Frames decoded per second of CPU time.
        size: Bytes of the coded frames of the clip.
        frame_bytes: Bytes of a frame of a long video.
        kbps: Kilobits per second of a long video.
        encode_fps: Frames encoded per second.
        scores: Of the clip, by metric.
        picture: Name of the PNG file of its detail, in the folder of the evaluation.
        whole_bytes: Bytes of the camera's whole recording.
        whole_seconds: Time to encode the camera's whole recording.
    """

    setting: Setting
    encode_seconds: float
    encode_cpu_seconds: float
    decode_fps: float
    size: int
    frame_bytes: float
    kbps: float
    encode_fps: float
    scores: Mapping[str, ScoreSummary]
    picture: str
    whole_bytes: float
    whole_seconds: float


# ---------------------------------------------------------------- in a process


def try_setting(
    clip: Clip,
    setting: Setting,
    work: Path,
    picture: Path,
    *,
    threads: int,
    has_vmaf: bool,
) -> Cell:
    """Encode a clip as `mp4ds pack` does, decode it, and score it.

    Args:
        clip: The clip.
        setting: How to encode.
        work: The folder with the files of the clip.
        picture: The PNG file of its detail to write, in the folder for these.
        threads: Of the encoder and of libvmaf.
        has_vmaf: Whether VMAF is computed.

    Raises:
        Mp4dsError: The encoder refuses, or libvmaf failed.
        OSError: A file cannot be written.
    """
    ffmpeg = find_ffmpeg() if has_vmaf else None
    recipe = recipe_for(
        clip.picture_format,
        lossless=False,
        codec=setting.codec,
        crf=setting.crf,
        preset=setting.preset,
    )
    ticks = np.load(work / TICKS).tolist()
    with closing(clip.open(work)) as frames, TemporaryDirectory(dir=work) as folder:
        for _ in frames:
            pass  # so that the encoder does not wait for a disk or network
        video = Path(folder, "video.mp4")
        wall, cpu = time.perf_counter(), time.process_time()
        with VideoEncoder(
            video,
            recipe,
            picture_format=PLANES_FORMAT,
            width=frames.width,
            height=frames.height,
            gop=setting.gop,
            threads=threads,
            rate=clip.rate,
        ) as encoder:
            for planes, tick in zip(frames, ticks, strict=True):
                encoder.write(planes, tick)
        seconds, encoded = time.perf_counter() - wall, time.process_time()
        for _ in decoded_planes(video):
            pass
        decode_seconds = time.process_time() - encoded
        with PacketReader(video, codec=recipe.codec) as packets:
            size = sum(packets.sizes)
            frame_bytes = mean_size(packets.sizes, packets.keyframes, setting.gop)

        def watched(decoded: Iterable[Planes]) -> Iterator[Planes]:
            for number, planes in enumerate(decoded):
                if number == clip.detail_frame:
                    picture.write_bytes(clip.picture(planes, recipe))
                yield planes

        scores = scores_of(frames, watched(decoded_planes(video)), ffmpeg=ffmpeg, threads=threads)
    return Cell(
        setting=setting,
        encode_seconds=seconds,
        encode_cpu_seconds=encoded - cpu,
        decode_fps=clip.frames / max(1e-9, decode_seconds),
        size=size,
        frame_bytes=frame_bytes,
        kbps=frame_bytes * clip.frames / clip.seconds * 8 / 1000,
        encode_fps=clip.frames / max(1e-9, seconds),
        scores={name: summary_of(values) for name, values in scores.items()},
        picture=f"{PICTURES}/{picture.name}",
        whole_bytes=frame_bytes * clip.source_frames,
        whole_seconds=seconds / clip.frames * clip.source_frames,
    )


def mean_size(sizes: Sequence[int], keyframes: Sequence[int], gop: int) -> float:
    """Mean bytes per frame of a long video: a short clip has a larger share of key frames.

    Args:
        sizes: Of the packets of the clip.
        keyframes: Whether each is a key frame.
        gop: Frames from one key frame to the next.
    """
    keys = [size for size, is_key in zip(sizes, keyframes, strict=True) if is_key]
    others = [size for size, is_key in zip(sizes, keyframes, strict=True) if not is_key]
    key = sum(keys) / max(1, len(keys))
    return (key + (gop - 1) * sum(others) / len(others)) / gop if others else key


# ---------------------------------------------------------------- results


@dataclass(frozen=True, slots=True)
class Recommendation:
    """A setting that reaches the target.

    Attributes:
        why: ``smallest`` or ``fastest``.
        setting: What to pack with.
        score: Mean of the target's metric.
        options: The corresponding options of ``mp4ds pack``.
    """

    why: str
    setting: Setting
    score: float
    options: str


@dataclass
class CameraEvaluation:
    """The results for one camera.

    Attributes:
        topic: Of its images.
        name: Of its files.
        clip: What was tried on.
        ceiling: Scores of the clip against itself, which no setting can exceed.
        target: The score to reach.
        reachable: The same, or lower if the ceiling is too close.
        cells: By setting, in the order of the grid.
        recommended: The smallest and the fastest setting that reach the target; empty if none.
        ground_truth: Name of the PNG file of the clip's detail.
        notes: Anything else worth knowing.
    """

    topic: str
    name: str
    clip: Clip
    ceiling: Mapping[str, ScoreSummary]
    target: QualityTarget
    reachable: float
    cells: Sequence[Cell]
    recommended: Sequence[Recommendation]
    ground_truth: str
    notes: list[str] = field(default_factory=list)


@dataclass
class Evaluation:
    """The results for a recording.

    Attributes:
        source: The evaluated source.
        output: The folder with the results.
        cameras: In the order of their topics.
        left_out: Topics of cameras that were not evaluated, and why.
        versions: Of the software that made the videos and scores.
        recommended: The smallest and the fastest setting that reach the targets of all cameras,
            with their lowest score; empty if none.
        tried: Number of cells measured.
    """

    source: Path
    output: Path
    cameras: list[CameraEvaluation]
    left_out: dict[str, str]
    versions: dict[str, str]
    recommended: Sequence[Recommendation] = ()
    tried: int = 0


# ---------------------------------------------------------------- conclusions


def mean_score(scores: Mapping[str, ScoreSummary], target: QualityTarget) -> float:
    """Mean score in the target's metric."""
    return scores["psnr_y" if target.metric == "psnr" else target.metric].mean


def recommend(
    cameras: Sequence[tuple[Sequence[Cell], float]], target: QualityTarget
) -> list[Recommendation]:
    """The smallest and the fastest setting that reach the scores of all cameras.

    Args:
        cameras: At least one: its cells, and the score to reach.
        target: The target, whose metric is compared.

    Returns:
        None if no setting does.
    """
    able = set.intersection(
        *(
            {cell.setting for cell in cells if mean_score(cell.scores, target) >= due}
            for cells, due in cameras
        )
    )
    cells = [cell for own, _ in cameras for cell in own if cell.setting in able]

    def total(setting: Setting, figure: str) -> float:
        return sum(float(getattr(cell, figure)) for cell in cells if cell.setting == setting)

    found = []
    for why, figure in (("smallest", "frame_bytes"), ("fastest", "encode_cpu_seconds")):
        # by name, so that ties are resolved consistently
        costs = {(total(setting, figure), setting.name): setting for setting in able}
        if costs:
            setting = costs[min(costs)]
            score = min(
                mean_score(cell.scores, target) for cell in cells if cell.setting == setting
            )
            found.append(Recommendation(why, setting, score, setting.pack_options))
    return found


# ---------------------------------------------------------------- cameras

_JPEG = "JPEG files, which `mp4ds pack` re-encodes only with --transcode"

_SECOND = 1_000_000_000
_DETAIL = (96, 128)  # rows and columns shown side by side


Shot = tuple[tuple[str, int, int], Pixels, int, int]
"""One image of a camera: its ROS encoding, width and height; pixels of the encoding; header stamp,
and when it was recorded, nanoseconds."""


@dataclass(frozen=True)
class Camera:
    """One camera of a source.

    Attributes:
        reader: Of the source.
        channel: Of its images.
        times: Log times of all its images, nanoseconds, sorted, at least one.
        lossy: The lossy encoding they already went through; empty if none is known.
    """

    reader: BagReader
    channel: Channel
    times: NDArray[np.int64]
    lossy: str = ""

    @property
    def topic(self) -> str:
        """Its topic, or the name of a video."""
        return self.channel.topic

    @property
    def rate(self) -> float | None:
        """Images per second; None below two, or without a time span."""
        span = int(self.times[-1] - self.times[0])
        return (len(self.times) - 1) * 1e9 / span if span > 0 else None

    def shots(self, indices: Sequence[int]) -> Iterator[Shot]:
        """Images by increasing number, without messages that hold none."""
        first, last = (int(self.times[indices[place]]) for place in (0, -1))
        number = int(np.searchsorted(self.times, first))
        excerpt = Excerpt(first, last + 1, frozenset([self.topic]), others=False)
        inspector, wanted = MessageInspector(self.channel, transcode=True), set(indices)
        for record in self.reader.records(excerpt):
            if not isinstance(record, Message) or record.channel.id != self.channel.id:
                continue
            if number in wanted:
                with suppress(Refused):
                    seen = inspector.inspect(record)
                    if seen.pixels is not None:
                        kind = seen.key.encoding, seen.key.width, seen.key.height
                        yield kind, seen.pixels, seen.parts.stamp, record.log_time
            number += 1


@contextmanager
def open_cameras(place: Path) -> Iterator[tuple[list[Camera], dict[str, str]]]:
    """Open a recording, a dataset, or a video.

    Yields:
        Its cameras, and the topics of those whose images no encoder takes, with the reason.

    Raises:
        SourceError: It is not a recording, a dataset or a video.
        FormatError: It is a dataset, and breaks a rule of the format.
    """
    lossy = ""
    with ExitStack() as stack:
        if not names_dataset(place):
            reader = stack.enter_context(open_reader(place))
        elif (dataset := stack.enter_context(open_dataset(place))).channels:
            reader = DatasetReader(dataset)
            profiles = (stream.sidecar.profile for stream in dataset.streams)
            lossy = next((f"a dataset of {one}" for one in profiles if one != LOSSLESS), "")
        else:  # a video of any other program
            reader = stack.enter_context(open_images(place, ImportOptions(decode=True)))
        times, cameras = reader.times(), list[Camera]()
        left_out: dict[str, str] = {}
        for channel in filter(is_camera, reader.channels):
            own, first = times.get(channel.id, ()), reader.first(channel)
            if first is None or not len(own):
                left_out[channel.topic] = "has no images"
            elif kind_of(channel) is CodedFields and depends_on_others(channel, first):
                left_out[channel.topic] = "has video packets, which `mp4ds pack` copies"
            else:
                known = lossy or (_JPEG if _is_jpeg(first) else "")
                cameras.append(Camera(reader, channel, np.asarray(own), known))
        yield cameras, left_out


def _is_jpeg(message: Message) -> bool:
    with suppress(Refused):
        return MessageInspector(message.channel).inspect(message).key.codec == "mjpeg"
    return False


# ---------------------------------------------------------------- clips


def chosen(
    times: NDArray[np.int64], origin: int, frames: int, start: float | None = None
) -> list[int]:
    """The images of a clip.

    Args:
        times: Of a camera's images, nanoseconds, sorted.
        origin: Log time at which the source begins, nanoseconds.
        frames: Maximum number.
        start: Where the clip begins, seconds from the origin; None: it is in the middle.

    Raises:
        Refused: There are none.
    """
    first = max(0, (len(times) - frames) // 2)
    if start is not None:
        first = int(np.searchsorted(times, origin + round(start * _SECOND)))
    if first >= len(times):
        raise Refused("has no images in the requested time")
    return list(range(first, min(len(times), first + frames)))


def make_clip(camera: Camera, indices: list[int], folder: Path) -> Clip:
    """Write images to files as encoder input.

    Args:
        camera: The camera.
        indices: Numbers of the images, increasing.
        folder: Where to make the files.

    Raises:
        Refused: The camera's images are not usable.
        SourceError: The source is damaged.
        OSError: It cannot be written.
    """
    shots = camera.shots(indices)
    first = next(shots, None)
    if first is None:
        raise Refused("has no readable images in its clip")
    encoding, width, height = first[0]
    lossy = ENCODINGS[encoding].lossy
    if lossy is None or LAYOUTS[lossy].parameters:
        raise Refused(f"has {encoding} images; scores are of images of 8 bits without alpha")
    if min(width, height) < SMALLEST:
        raise Refused(f"has images of {width}x{height}, too small to score")
    layout = layout_for(ENCODINGS[encoding], lossless=False)
    converter, clock = PictureConverter(), PresentationClock()
    size = width + width % 2, height + height % 2
    ticks: list[int] = []
    with closing(PlaneSpool(folder / FRAMES, *size)) as spool:
        for kind, pixels, stamp, log_time in chain([first], shots):
            if kind != first[0]:
                continue
            spool.append(to_planes(layout.to_picture(pixels), layout.pixel_format, converter))
            ticks.append(clock.tick(stamp, log_time))
        middle = (len(ticks) - 1) // 2
        detail = _detail(spool.frame(middle)[0])
    np.save(folder / TICKS, ticks)
    gap = (ticks[-1] - ticks[0]) / TIMESCALE / max(1, len(ticks) - 1)
    return Clip(
        encoding=encoding,
        picture_format=layout.pixel_format,
        image_size=(width, height),
        size=size,
        rate=camera.rate,
        frames=len(ticks),
        seconds=len(ticks) * (gap or 1 / (camera.rate or 1.0)),
        detail=detail,
        detail_frame=middle,
        start=(int(camera.times[indices[0]]) - int(camera.times[0])) / _SECOND,
        source_frames=len(camera.times),
        left_out=len(indices) - len(ticks),
    )


def _detail(luma: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """The part of a frame with the most detail, at even coordinates."""
    height, width = (min(sides) for sides in zip(_DETAIL, luma.shape, strict=True))
    # roots of the gradients: a broad texture counts more than one sharp edge
    down, across = (np.sqrt(np.abs(np.diff(luma.astype(np.float32), axis=n))) for n in (0, 1))

    def texture(place: tuple[int, int]) -> float:
        y, x = place
        rows = down[y : y + height - 1, x : x + width]
        columns = across[y : y + height, x : x + width - 1]
        return float(rows.mean() + columns.mean())

    tops, lefts = (
        range(0, whole - part + 1, max(2, part // 4 * 2))
        for whole, part in zip(luma.shape, (height, width), strict=True)
    )
    y, x = max(product(tops, lefts), key=texture)
    return x, y, width // 2 * 2, height // 2 * 2
