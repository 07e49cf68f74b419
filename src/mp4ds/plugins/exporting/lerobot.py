"""LeRobotDataset v3.0: videos and tables at a constant rate, each dataset an episode."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from mp4ds.dataset.topic import Topic
from mp4ds.dataset.vectors import (
    ACTION,
    COLUMNS,
    SAMPLES,
    STATE,
    Statistics,
    fields_of,
    image_features,
    merged,
    read_vectors,
    sampled_statistics,
    statistics_of,
    vector_feature,
    video_feature,
)
from mp4ds.errors import OptionError
from mp4ds.messages.encodings import Pixels
from mp4ds.plugins.exporting.job import ExportedCamera, ExportJob, ros_type
from mp4ds.times import TIMESCALE, Integers, constant_rate, nearest
from mp4ds.video.codecs import CODECS, recipe_for
from mp4ds.video.encoder import VideoEncoder
from mp4ds.video.packets import PacketReader

_VERSION = "v3.0"
_CHUNK = 1000  # files per folder
_NS = 10**9
_GOP = 2  # frames between key frames, as in LeRobot: samples are read individually
_MOST_THREADS = 8
_TELL_EVERY = 16  # frames
_VECTORS = {STATE: "state", ACTION: "action"}  # feature -> option
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
_FILE = "chunk-{chunk:03d}/file-{file:03d}"


# ---------------------------------------------------------------- episodes


@dataclass
class Episode:
    """A dataset as an episode.

    Attributes:
        number: From 0.
        first: Number of its first frame among those of all episodes.
        times: Of its frames, nanoseconds, shape (frames,).
        vectors: Feature -> numbers, float32, shape (frames, numbers).
        features: As in info.json.
        statistics: By feature.
        videos: Features that are videos.
        tasks: Of its frames.
    """

    number: int
    first: int
    times: Integers
    vectors: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    features: dict[str, dict[str, Any]] = field(default_factory=dict)
    statistics: dict[str, Statistics] = field(default_factory=dict)
    videos: list[str] = field(default_factory=list)
    tasks: list[str] = field(default_factory=list)

    def path(self, folder: str, suffix: str) -> str:
        """Path of its file in a folder of chunks."""
        chunk, file = divmod(self.number, _CHUNK)
        return f"{folder}/{_FILE.format(chunk=chunk, file=file)}.{suffix}"


def write(*jobs: ExportJob) -> None:
    """Write the format."""
    cameras = [_shown(job) for job in jobs]
    path = jobs[0].path
    fps = jobs[0].options.fps or max(1, round(cameras[0][0].rate))
    episodes: list[Episode] = []
    tasks: dict[str, int] = {}
    first = 0
    for number, (job, own) in enumerate(zip(jobs, cameras, strict=True)):
        job.tell(f"episode {number + 1} of {len(jobs)}", number / len(jobs))
        times = constant_rate([camera.times for camera in own], fps, job.dataset.path)
        episode = Episode(number, first, times)
        episode.tasks = _tasks(job, episode.times, fps)
        for task in episode.tasks:
            tasks.setdefault(task, len(tasks))
        _add_vectors(job, episode, fps)  # first: their topic may be unsuitable
        _add_videos(job, own, episode, fps)
        if episodes and episode.features != episodes[0].features:
            raise OptionError(
                f"{job.dataset.path} differs in cameras, sizes or vector lengths from "
                f"{jobs[0].dataset.path}, but LeRobot episodes must agree. Select with "
                "`topics`, and `resize` WxH."
            )
        _write_table(path / episode.path("data", "parquet"), _frames_table(episode, tasks, fps))
        episodes.append(episode)
        first += len(episode.times)
    _write_table(path / "meta/tasks.parquet", _tasks_table([*tasks]))
    rows = [_episode_row(episode, fps) for episode in episodes]
    table = pa.table({name: [row[name] for row in rows] for name in rows[0]})
    _write_table(path / _EPISODES_PATH, table)
    statistics = {
        name: _as_lists(merged([episode.statistics[name] for episode in episodes]))
        for name in episodes[0].statistics
    }
    _write_json(path / "meta/stats.json", statistics)
    _write_json(path / "meta/info.json", _info(episodes, len(tasks), fps))
    if not jobs[0].options.task:
        jobs[0].note("no --task was given: every frame's task is empty")
    jobs[0].note(
        f"stamps count up at {fps} frames per second from the first frame; recorded stamps are "
        "not kept"
    )


def _shown(job: ExportJob) -> list[ExportedCamera]:
    """The cameras that LeRobot's videos can show, in the order of their frames; depth is last."""
    found = []
    for camera in sorted(job.cameras, key=_is_depth):
        if camera.view.encoding.name != "rgb8" and not _is_depth(camera):
            reason = f"LeRobot's videos are in 8-bit colour or depth, not {camera.stream.encoding}"
            job.leave_out(camera.topic, reason, len(camera))
            continue
        is_later = camera.numbers >= np.maximum.accumulate(camera.numbers)
        job.leave_out(camera.topic, "its stamp goes backwards", int((~is_later).sum()))
        found.append(camera.at(np.flatnonzero(is_later)))
    if not found:
        raise OptionError(
            f"{job.dataset.path} has no camera for LeRobot, whose videos are in 8-bit colour or "
            "depth."
        )
    return found


def _is_depth(camera: ExportedCamera) -> bool:
    return camera.view.encoding.name in _UNITS


# ---------------------------------------------------------------- videos


def _add_videos(
    job: ExportJob, cameras: Sequence[ExportedCamera], episode: Episode, fps: int
) -> None:
    features = image_features([camera.topic for camera in cameras])
    for feature, camera in zip(features, cameras, strict=True):
        path = job.path / episode.path(f"videos/{feature}", "mp4")
        path.parent.mkdir(parents=True, exist_ok=True)
        used, repeats = np.unique(nearest(camera.times, episode.times), return_counts=True)
        job.keep(camera.topic, len(used))
        is_unused = np.ones(len(camera), np.bool_)
        is_unused[used] = False
        is_within = (camera.times >= episode.times[0]) & (camera.times <= episode.times[-1])
        for reason, which in (
            (f"another frame is nearer at {fps} frames per second", is_within),
            ("before the first or after the last frame of all cameras", ~is_within),
        ):
            job.leave_out(camera.topic, reason, int((is_unused & which).sum()))
        if repeated := len(episode.times) - len(used):
            job.note(
                f"{camera.topic}: {repeated} of {len(episode.times)} frames repeat the previous "
                f"one, to reach {fps} per second"
            )
        depths = DepthCodes(camera.view.encoding.name) if _is_depth(camera) else None
        size = _encode(job, camera.at(used), repeats.tolist(), path, fps, depths)
        codec = "h265" if depths else job.options.codec
        with PacketReader(path, codec=codec) as packets:
            info = {"video.codec": CODECS[codec].ffmpeg, "video.pix_fmt": packets.pixel_format}
        episode.features[feature] = video_feature(size, fps, info, depths.info if depths else None)
        if depths:
            job.note(f"{camera.topic}: {depths}")
        view = {
            "resize": job.options.size_of(camera.topic, camera.stream.image_size),
            "format": "native" if depths else "rgb",
        }
        with closing(Topic([camera.stream])) as topic:
            numbers = camera.numbers[used]
            episode.statistics[feature] = sampled_statistics(topic, numbers, SAMPLES, **view)
        episode.videos.append(feature)
        job.places[f"videos/{feature}"] = camera.topic


def _encode(
    job: ExportJob,
    camera: ExportedCamera,
    repeats: Sequence[int],
    path: Path,
    fps: int,
    depths: DepthCodes | None,
) -> tuple[int, int]:
    """Write a video; returns its width and height, which are even."""
    if depths:
        recipe = recipe_for(DEPTH_FORMAT, lossless=True, codec="h265")
    else:
        recipe = recipe_for("rgb24", lossless=False, codec=job.options.codec, crf=job.options.crf)
        # torchcodec, LeRobot's decoder, takes all AV1 for limited range
        recipe = replace(recipe, full_range=False)
    written = 0
    with VideoEncoder(
        path,
        recipe,
        picture_format=DEPTH_FORMAT if depths else "rgb24",
        width=camera.size[0],
        height=camera.size[1],
        gop=_GOP,
        threads=min(os.cpu_count() or 1, _MOST_THREADS),
        rate=float(fps),
    ) as encoder:
        for number, (place, pixels) in enumerate(camera.pictures()):
            if number % _TELL_EVERY == 0:
                job.tell(f"{camera.topic}: frame {number} of {len(camera)}", None)
            shown = depths.of(pixels) if depths else pixels
            for _ in range(repeats[place]):
                encoder.write((shown,), (written * TIMESCALE + fps // 2) // fps)
                written += 1
        return encoder.width, encoder.height


# ---------------------------------------------------------------- depths

# codes of 12 bits on a logarithmic scale, in a lossless video; the constants and the steps in
# single precision are LeRobot's (0.6.1), so that codes are its own

DEPTH_FORMAT = "gray12le"
"""Pixel format of the videos."""

_UNITS = {"16UC1": ("mm", 1.0), "32FC1": ("m", 1000.0)}
"""Encoding of depths -> unit of its numbers, in LeRobot's words, and millimetres in it; ``mono16``
may also be infrared."""

_MOST = 2**12 - 1
_MM = 1000.0


class DepthScale(NamedTuple):
    """What depths codes stand for, as LeRobot names it; metres."""

    depth_min: float = 0.01
    depth_max: float = 10.0
    shift: float = 3.5
    use_log: bool = True

    def table(self, *, in_metres: bool = False) -> NDArray[Any]:
        """The depths that LeRobot gives for codes, by code.

        Args:
            in_metres: Whether as float32 in metres; else as uint16 in millimetres.

        Raises:
            ValueError: There are no such codes.
        """
        near, far = float(self.depth_min), float(self.depth_max)
        shift = float(self.shift) if self.use_log else 0.0
        ends = [math.log(x + shift) if self.use_log else x for x in (near, far)]
        if not 0 <= near < far < math.inf:
            raise ValueError(f"depths from {near} to {far} m")
        scale, offset = np.float32((ends[1] - ends[0]) / _MOST), np.float32(ends[0])
        depth = np.arange(_MOST + 1, dtype=np.float32) * scale + offset
        depth = np.exp(depth) - np.float32(shift) if self.use_log else depth
        depth = depth.clip(near, far).astype(np.float32)
        return depth if in_metres else np.rint(depth * np.float32(_MM)).clip(0, 65535).astype("<u2")


# others would do, but datasets with different ones cannot be merged
LEROBOT_SCALE = DepthScale()
"""That of LeRobot's own recordings."""

_NEAR, _FAR, _SHIFT, _ = LEROBOT_SCALE
_RESTORED = LEROBOT_SCALE.table().astype(np.float64)


class DepthCodes:
    """The codes of a camera's depths, and how far off they are.

    Args:
        encoding: Of its images.
    """

    def __init__(self, encoding: str) -> None:
        self._unit, self._in_mm = _UNITS[encoding]
        self._measured = self._missing = self._outside = 0
        self._sum = self._most = 0.0

    @property
    def info(self) -> dict[str, Any]:
        """What LeRobot's loader has to know to make depths of the codes."""
        return {
            "is_depth_map": True,
            "depth_unit": self._unit,
            **{f"video.{name}": value for name, value in LEROBOT_SCALE._asdict().items()},
        }

    def of(self, pixels: Pixels) -> NDArray[np.uint16]:
        """The codes of an image, whose errors are counted.

        Args:
            pixels: Depths, shape (H, W).
        """
        depth = pixels.astype(np.float32)
        is_there = depth > 0  # not a number is no measurement, either
        depth[~is_there] = 0
        shift, near, far = (np.float32(x * _MM / self._in_mm) for x in (_SHIFT, _NEAR, _FAR))
        low, high = math.log(float(near + shift)), math.log(float(far + shift))
        scaled = (np.log(depth + shift) - low) / (high - low)
        codes: NDArray[np.uint16] = np.rint(scaled * _MOST).clip(0, _MOST).astype(np.uint16)
        is_within = (depth >= near) & (depth <= far)
        off = np.abs(_RESTORED[codes[is_within]] - depth[is_within].astype(float) * self._in_mm)
        self._measured += off.size
        self._missing += int((~is_there).sum())
        self._outside += int(is_there.sum()) - off.size
        self._sum += float(off.sum())
        self._most = max(self._most, float(off.max(initial=0)))
        return codes

    def __str__(self) -> str:
        total = max(1, self._measured + self._missing + self._outside) / 100
        text = (
            "its depths are LeRobot's codes of 12 bits, which it gives back "
            f"{self._sum / max(1, self._measured):.2f} mm off on average, "
            f"at most {self._most:.1f} mm"
        )
        if self._missing:
            share = self._missing / total
            text += f"; {share:.1f} % of the pixels have no measurement and become 10 mm"
        if self._outside:
            share = self._outside / total
            text += f"; {share:.1f} % are not from 10 mm to 10 m and become the nearer of these"
        return text


# ---------------------------------------------------------------- vectors


def _add_vectors(job: ExportJob, episode: Episode, fps: int) -> None:
    counted: set[str] = set()  # a topic may be both, and is counted once
    for feature, option in _VECTORS.items():
        given = getattr(job.options, option)
        if not given:
            continue
        ((topic, paths),) = fields_of(given, f"`{option}`").items()
        found = read_vectors(job.dataset, topic, paths)
        places = found.nearest(episode.times)
        if topic not in counted:
            used = len(np.unique(places))
            job.keep(topic, used)
            reason = f"another message is nearer at {fps} frames per second"
            job.leave_out(topic, reason, len(found.times) - used)
            away = int(np.abs(found.times[places] - episode.times).max()) / _NS
            job.note(f"{topic}: each frame gets the nearest message, at most {away:.3f} s away")
        values = found.values[places]
        episode.vectors[feature] = values
        episode.features[feature] = vector_feature(found.names)
        episode.statistics[feature] = statistics_of(values)
        job.places[feature] = topic
        counted.add(topic)


# ---------------------------------------------------------------- tables


def _tasks(job: ExportJob, times: Integers, fps: int) -> list[str]:
    """The task of each frame: the one given, or what a topic last said until then.

    Raises:
        OptionError: There is no such topic.
    """
    topic = job.options.task
    if not topic.startswith("/"):
        return [topic] * len(times)
    if ros_type(job.dataset, topic) != "std_msgs/String":
        raise OptionError(
            f"`task` {topic} is not a topic of std_msgs/String in {job.dataset.path}."
        )
    said = [(one.log_time_ns, str(one.decoded.data)) for one in job.dataset.messages([topic])]
    if not said:
        raise OptionError(f"`task` {topic} has no message in {job.dataset.path}.")
    job.keep(topic, len(said))
    # a message that comes with a frame is that frame's, whatever its rounding
    last = np.searchsorted([time for time, _ in said], times + _NS // fps // 2) - 1
    return [said[place][1] for place in last.clip(0).tolist()]


def _frames_table(episode: Episode, tasks: Mapping[str, int], fps: int) -> Any:
    columns: dict[str, pa.Array] = {}
    for name, values in episode.vectors.items():
        flat, count = pa.array(values.ravel(), pa.float32()), values.shape[1]
        # a single number is stored as a scalar
        columns[name] = flat if count == 1 else pa.FixedSizeListArray.from_arrays(flat, count)
    numbers = np.arange(len(episode.times), dtype=np.int64)
    columns["timestamp"] = pa.array((numbers / fps).astype(np.float32))
    columns["frame_index"] = pa.array(numbers)
    columns["episode_index"] = pa.array(np.full(len(numbers), episode.number, np.int64))
    columns["index"] = pa.array(numbers + episode.first)
    columns["task_index"] = pa.array([tasks[task] for task in episode.tasks], pa.int64())
    return pa.table(columns)


def _tasks_table(tasks: Sequence[str]) -> Any:
    """The table of tasks, which pandas reads with the task as its index."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    kinds = [("task_index", "int64", "int64"), ("task", "unicode", "object")]
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": held}
            | {"metadata": None}
            for name, kind, held in kinds
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _episode_row(episode: Episode, fps: int) -> dict[str, Any]:
    """The row of an episode in the table of episodes."""
    length = len(episode.times)
    chunk, file = divmod(episode.number, _CHUNK)
    row: dict[str, Any] = {
        "episode_index": episode.number,
        "tasks": [*dict.fromkeys(episode.tasks)],
        "length": length,
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": episode.first,
        "dataset_to_index": episode.first + length,
    }
    for feature in episode.videos:
        row[f"videos/{feature}/chunk_index"] = chunk
        row[f"videos/{feature}/file_index"] = file
        row[f"videos/{feature}/from_timestamp"] = 0.0
        row[f"videos/{feature}/to_timestamp"] = length / fps
    for feature, statistics in episode.statistics.items():
        for name, values in _as_lists(statistics).items():
            row[f"stats/{feature}/{name}"] = values
    row["meta/episodes/chunk_index"] = row["meta/episodes/file_index"] = 0
    return row


def _info(episodes: Sequence[Episode], tasks: int, fps: int) -> dict[str, Any]:
    path = _FILE.replace("chunk:", "chunk_index:").replace("file:", "file_index:")
    return {
        "codebase_version": _VERSION,
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": sum(len(episode.times) for episode in episodes),
        "total_tasks": tasks,
        "chunks_size": _CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": f"data/{path}.parquet",
        "video_path": f"videos/{{video_key}}/{path}.mp4",
        "features": {**episodes[0].features, **COLUMNS},
    }


def _as_lists(statistics: Statistics) -> dict[str, Any]:
    return {name: values.tolist() for name, values in statistics.items()}


def _write_table(path: Path, table: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=4) + "\n", encoding="utf-8")
