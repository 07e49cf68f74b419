"""LeRobotDataset v3.0: videos and tables at a constant rate, each dataset an episode."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from mp4ds.dataset.topic import Topic
from mp4ds.errors import OptionError
from mp4ds.messages.encodings import Pixels
from mp4ds.plan import FileNames
from mp4ds.plugins.exporting.job import ExportedCamera, ExportedDataset, ExportJob
from mp4ds.plugins.exporting.motion import Vectors, in_order
from mp4ds.times import TIMESCALE, nearest
from mp4ds.video.codecs import CODECS, recipe_for
from mp4ds.video.encoder import VideoEncoder
from mp4ds.video.packets import PacketReader, join_segments

_STEP_FROM = 300  # pixels of a side, above which pixels are subsampled
_SIDE = 150

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Statistics:
    """Minimum, maximum, mean and standard deviation of each number of a feature.

    Attributes:
        least: Shape of the feature; (3, 1, 1) of pictures.
        most: The same.
        mean: The same.
        deviation: The same.
        count: Rows, or pictures.
    """

    least: Floats
    most: Floats
    mean: Floats
    deviation: Floats
    count: int

    @classmethod
    def of(cls, values: NDArray[Any]) -> Statistics:
        """Statistics of rows, shape (rows, numbers)."""
        rows = values.astype(np.float64)
        return cls(rows.min(0), rows.max(0), rows.mean(0), rows.std(0), len(rows))

    @classmethod
    def of_picture(cls, pixels: Pixels) -> Statistics:
        """Statistics of a picture's colours from 0 to 1, subsampled if it is large.

        Args:
            pixels: uint8, shape (H, W, 3).
        """
        side = max(pixels.shape[:2])
        step = side // _SIDE if side >= _STEP_FROM else 1
        flat = pixels[::step, ::step].reshape(-1, 3) / 255.0
        found = cls.of(flat)
        shape = (3, 1, 1)
        return cls(
            found.least.reshape(shape),
            found.most.reshape(shape),
            found.mean.reshape(shape),
            found.deviation.reshape(shape),
            count=1,
        )

    def as_lists(self) -> dict[str, Any]:
        """The statistics under LeRobot's names."""
        return {
            "min": self.least.tolist(),
            "max": self.most.tolist(),
            "mean": self.mean.tolist(),
            "std": self.deviation.tolist(),
            "count": [self.count],
        }


def merged(parts: Sequence[Statistics]) -> Statistics:
    """The statistics of all parts combined."""
    counts = np.array([part.count for part in parts], np.float64)
    weights = counts / counts.sum()
    means = np.stack([part.mean for part in parts])
    mean = np.tensordot(weights, means, 1)
    squares = np.stack([part.deviation for part in parts]) ** 2 + (means - mean) ** 2
    return Statistics(
        np.stack([part.least for part in parts]).min(0),
        np.stack([part.most for part in parts]).max(0),
        mean,
        np.sqrt(np.tensordot(weights, squares, 1)),
        sum(part.count for part in parts),
    )


# ---------------------------------------------------------------- tables


def write_frames(
    path: Path,
    vectors: Mapping[str, NDArray[np.float32]],
    length: int,
    fps: int,
    episode: int,
    first: int,
) -> None:
    """Write the table of an episode's frames.

    Args:
        path: The file.
        vectors: Feature -> numbers, shape (frames, numbers).
        length: Frames.
        fps: Frames per second.
        episode: Number of the episode.
        first: Number of its first frame among those of all episodes.
    """
    columns: dict[str, pa.Array] = {}
    for name, values in vectors.items():
        flat = pa.array(values.ravel(), pa.float32())
        count = values.shape[1]
        # a single number is stored as a scalar
        columns[name] = flat if count == 1 else pa.FixedSizeListArray.from_arrays(flat, count)
    numbers = np.arange(length, dtype=np.int64)
    columns["timestamp"] = pa.array((numbers / fps).astype(np.float32))
    columns["frame_index"] = pa.array(numbers)
    columns["episode_index"] = pa.array(np.full(length, episode, np.int64))
    columns["index"] = pa.array(numbers + first)
    columns["task_index"] = pa.array(np.zeros(length, np.int64))
    _write(path, pa.table(columns))


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the table of tasks, which pandas reads with the task as its index."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": [*tasks]})
    kinds = [("task_index", "int64", "int64"), ("task", "unicode", "object")]
    told = {
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
    _write(path, table.replace_schema_metadata({"pandas": json.dumps(told)}))


def write_episodes(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the table of episodes, one row for each."""
    _write(path, pa.table({name: [row[name] for row in rows] for name in rows[0]}))


def _write(path: Path, table: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


# ---------------------------------------------------------------- episodes

VERSION = "v3.0"
CHUNK = 1000
"""Files per folder."""

Integers = NDArray[np.int64]

_NS = 10**9
_GOP = 2  # frames between key frames, as in LeRobot: samples are read individually
_SAMPLES = 100  # frames used for a camera's statistics
_MOST_THREADS = 8
_TELL_EVERY = 16  # frames
_PLAYED = ("av1", "h264", "h265", "vp9")  # codecs of videos that are copied
# whose decoders also signal full range by the pixel format: for others, torchcodec, LeRobot's
# decoder, mistakes it for limited range
_RANGE_TOLD = ("h264", "h265")
_VECTORS = {"observation.state": "state", "action": "action"}  # feature -> option


@dataclass
class Episode:
    """A dataset as an episode.

    Attributes:
        length: Frames.
        vectors: Feature -> numbers, float32, shape (frames, numbers).
        statistics: Feature -> its statistics.
        videos: Feature -> width, height, codec and pixel format of its video.
    """

    length: int
    vectors: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    statistics: dict[str, Statistics] = field(default_factory=dict)
    videos: dict[str, dict[str, Any]] = field(default_factory=dict)


def write(job: ExportJob) -> None:
    """Write the format."""
    cameras = [_shown(source) for source in job.sources]
    rate = cameras[0][0].rate if cameras[0] else 0.0
    fps = job.options.fps or max(1, round(rate))
    job.path.mkdir()
    episodes: list[Episode] = []
    features: dict[str, dict[str, Any]] = {}
    first = 0
    for number, (source, own) in enumerate(zip(job.sources, cameras, strict=True)):
        job.tell(f"episode {number + 1} of {len(job.sources)}", number / len(job.sources))
        episode = _Maker(job, source, own, number, fps).make()
        found = _features(source, job, episode, fps)
        if features and found != features:
            raise OptionError(
                f"{source.dataset.path} differs in cameras, sizes or vector lengths from "
                f"{job.sources[0].dataset.path}, but LeRobot episodes must agree. Select with "
                "`topics`, and `resize` WxH."
            )
        features = found
        write_frames(
            job.path / data_path(number), episode.vectors, episode.length, fps, number, first
        )
        episodes.append(episode)
        first += episode.length
    task = job.options.task
    write_tasks(job.path / "meta/tasks.parquet", [task])
    rows = [_row(number, episode, task, fps, episodes) for number, episode in enumerate(episodes)]
    write_episodes(job.path / "meta/episodes/chunk-000/file-000.parquet", rows)
    names = episodes[0].statistics
    statistics = {
        name: merged([episode.statistics[name] for episode in episodes]).as_lists()
        for name in names
    }
    _write_json(job.path / "meta/stats.json", statistics)
    _write_json(job.path / "meta/info.json", _info(episodes, features, fps))
    if not task:
        job.note("no --task was given: every frame's task is empty")
    job.note(
        f"stamps count up at {fps} frames per second from the first frame; recorded stamps are "
        "not kept"
    )


def data_path(number: int) -> str:
    """Path of an episode's table."""
    return f"data/chunk-{number // CHUNK:03d}/file-{number % CHUNK:03d}.parquet"


def _video_path(feature: str, number: int) -> str:
    return f"videos/{feature}/chunk-{number // CHUNK:03d}/file-{number % CHUNK:03d}.mp4"


def _shown(source: ExportedDataset) -> list[ExportedCamera]:
    """The cameras that LeRobot's videos can show."""
    found = []
    for camera in source.cameras:
        reason = ""
        if camera.view.encoding.name != "rgb8":
            reason = f"LeRobot's videos are in 8-bit colour, not {camera.stream.encoding}"
        if reason or not len(camera):
            source.stats.add_left_out(camera.topic, reason, len(camera))
            continue
        is_later = camera.numbers >= np.maximum.accumulate(camera.numbers)
        source.stats.add_left_out(camera.topic, "its stamp goes backwards", int((~is_later).sum()))
        found.append(camera.at(np.flatnonzero(is_later)))
    if not found:
        raise OptionError(
            f"{source.dataset.path} has no camera for LeRobot, whose videos are in 8-bit colour."
        )
    return found


class _Maker:
    """Makes an episode."""

    def __init__(
        self,
        job: ExportJob,
        source: ExportedDataset,
        cameras: Sequence[ExportedCamera],
        number: int,
        fps: int,
    ) -> None:
        self._job, self._source, self._cameras = job, source, cameras
        self._number, self._fps = number, fps
        start = max(int(camera.times[0]) for camera in cameras)
        end = min(int(camera.times[-1]) for camera in cameras)
        if end < start:
            raise OptionError(
                f"{source.dataset.path}: its cameras do not overlap in time. Select some with "
                "`topics`."
            )
        length = ((end - start) * fps + _NS // 2) // _NS + 1
        # integers throughout: floats would shift late frames
        self._times = start + (np.arange(length, dtype=np.int64) * _NS + fps // 2) // fps

    def make(self) -> Episode:
        """The episode; writes its videos."""
        episode = Episode(len(self._times))
        names = FileNames()
        for camera in self._cameras:
            feature = f"observation.images.{names.name_for(camera.topic)[0]}"
            episode.videos[feature] = self._write_video(camera, feature)
            episode.statistics[feature] = self._sampled(camera)
            self._job.places[f"videos/{feature}"] = camera.topic
        known: dict[str, NDArray[np.float32]] = {}
        for feature, option in _VECTORS.items():
            topic = getattr(self._job.options, option)
            if topic:
                if topic not in known:  # one topic may be both, and is counted once
                    known[topic] = self._vector(Vectors(self._source.dataset, topic, f"`{option}`"))
                episode.vectors[feature] = known[topic]
                episode.statistics[feature] = Statistics.of(known[topic])
                self._job.places[feature] = topic
        return episode

    def _write_video(self, camera: ExportedCamera, feature: str) -> dict[str, Any]:
        stats, length = self._source.stats, len(self._times)
        places = nearest(camera.times, self._times)
        used, repeats = np.unique(places, return_counts=True)
        stats.add_exported(camera.topic, len(used))
        is_within = (camera.times >= self._times[0]) & (camera.times <= self._times[-1])
        unused = np.ones(len(camera), np.bool_)
        unused[used] = False
        stats.add_left_out(
            camera.topic,
            f"another frame is nearer at {self._fps} frames per second",
            int((unused & is_within).sum()),
        )
        stats.add_left_out(
            camera.topic,
            "before the first or after the last frame of all cameras",
            int((unused & ~is_within).sum()),
        )
        if length > len(used):
            self._source.notes.append(
                f"{camera.topic}: {length - len(used)} of {length} frames repeat the previous "
                f"one, to reach {self._fps} per second"
            )
        path = self._job.path / _video_path(feature, self._number)
        path.parent.mkdir(parents=True, exist_ok=True)
        numbers = np.arange(length, dtype=np.int64)
        ticks = (numbers * TIMESCALE + self._fps // 2) // self._fps
        sidecar = camera.stream.sidecar
        is_whole = length == len(used) == len(camera.stream)
        size = sidecar.video.width, sidecar.video.height
        is_shown = sidecar.body == "packet" or sidecar.layout.is_shown
        if (
            is_whole
            and is_shown
            and sidecar.video.codec in _PLAYED
            and (sidecar.video.codec in _RANGE_TOLD or not sidecar.video.full_range)
            and size == camera.size == camera.stream.image_size
            and not camera.stream.hidden_frames
        ):
            camera.stream.verify_video()
            join_segments([camera.stream.video_path], ticks.tolist(), path)
            self._source.notes.append(f"{camera.topic}: its video is copied, not re-encoded")
            return _video_facts(path, size, sidecar.video.codec)
        return self._encode(camera.at(used), repeats.tolist(), ticks.tolist(), path)

    def _encode(
        self, camera: ExportedCamera, repeats: Sequence[int], ticks: Sequence[int], path: Path
    ) -> dict[str, Any]:
        options = self._job.options
        recipe = recipe_for("rgb24", lossless=False, codec=options.codec, crf=options.crf)
        recipe = replace(recipe, full_range=False)  # which LeRobot's decoder assumes for all AV1
        due = iter(ticks)
        with VideoEncoder(
            path,
            recipe,
            picture_format="rgb24",
            width=camera.size[0],
            height=camera.size[1],
            gop=_GOP,
            threads=min(os.cpu_count() or 1, _MOST_THREADS),
            rate=float(self._fps),
        ) as encoder:
            for number, (place, pixels) in enumerate(camera.pictures()):
                if number % _TELL_EVERY == 0:
                    self._job.tell(f"{camera.topic}: frame {number} of {len(camera)}", None)
                for _ in range(repeats[place]):
                    encoder.write((pixels,), next(due))
        return _video_facts(path, (encoder.width, encoder.height), options.codec)

    def _sampled(self, camera: ExportedCamera) -> Statistics:
        """The statistics of some frames' pixels, 0 to 1, by colour."""
        count = min(_SAMPLES, len(camera))
        chosen = np.unique(np.linspace(0, len(camera) - 1, count).astype(np.int64))
        found = []
        with closing(Topic([camera.stream])) as topic:
            for number in camera.numbers[chosen].tolist():
                pixels = topic.read([number], resize=self._job.options.reduction.resize)[0]
                found.append(Statistics.of_picture(pixels))
        return merged(found)

    def _vector(self, vectors: Vectors) -> NDArray[np.float32]:
        count = len(vectors.names)
        times, rows = [], []
        for time, values in in_order(vectors.rows()):
            if len(values) != count:
                raise OptionError(
                    f"{vectors.topic} has messages of {count} and of {len(values)} numbers, but "
                    "LeRobot needs the same number in each frame."
                )
            times.append(time)
            rows.append(values)
        places = nearest(np.array(times, np.int64), self._times)
        used = len(np.unique(places))
        self._source.stats.add_exported(vectors.topic, used)
        self._source.stats.add_left_out(
            vectors.topic,
            f"another message is nearer at {self._fps} frames per second",
            len(rows) - used,
        )
        away = int(np.abs(np.array(times, np.int64)[places] - self._times).max())
        self._source.notes.append(
            f"{vectors.topic}: each frame gets the nearest message, at most {away / _NS:.3f} s away"
        )
        return np.array(rows, np.float32).reshape(-1, count)[places]


def _video_facts(path: Path, size: tuple[int, int], codec: str) -> dict[str, Any]:
    with PacketReader(path, codec=codec) as packets:
        pixel_format = packets.pixel_format
    name = CODECS[codec].ffmpeg
    return {"width": size[0], "height": size[1], "codec": name, "pix_fmt": pixel_format}


def _features(
    source: ExportedDataset, job: ExportJob, episode: Episode, fps: int
) -> dict[str, dict[str, Any]]:
    """The features of info.json."""
    found: dict[str, dict[str, Any]] = {}
    for feature, option in _VECTORS.items():
        if feature in episode.vectors:
            names = Vectors(source.dataset, getattr(job.options, option), f"`{option}`").names
            found[feature] = {"dtype": "float32", "shape": [len(names)], "names": [*names]}
    for feature, video in episode.videos.items():
        found[feature] = {
            "dtype": "video",
            "shape": [video["height"], video["width"], 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": video["height"],
                "video.width": video["width"],
                "video.codec": video["codec"],
                "video.pix_fmt": video["pix_fmt"],
                "video.is_depth_map": False,
                "video.fps": fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
    found["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        found[name] = {"dtype": "int64", "shape": [1], "names": None}
    return found


def _row(
    number: int, episode: Episode, task: str, fps: int, episodes: Sequence[Episode]
) -> dict[str, Any]:
    """The row of an episode in the table of episodes."""
    first = sum(other.length for other in episodes[:number])
    chunk, file = divmod(number, CHUNK)
    row: dict[str, Any] = {
        "episode_index": number,
        "tasks": [task],
        "length": episode.length,
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": first,
        "dataset_to_index": first + episode.length,
    }
    for feature in episode.videos:
        row[f"videos/{feature}/chunk_index"] = chunk
        row[f"videos/{feature}/file_index"] = file
        row[f"videos/{feature}/from_timestamp"] = 0.0
        row[f"videos/{feature}/to_timestamp"] = episode.length / fps
    for feature, statistics in episode.statistics.items():
        for name, values in statistics.as_lists().items():
            row[f"stats/{feature}/{name}"] = values
    row["meta/episodes/chunk_index"] = row["meta/episodes/file_index"] = 0
    return row


def _info(
    episodes: Sequence[Episode], features: Mapping[str, dict[str, Any]], fps: int
) -> dict[str, Any]:
    return {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": sum(episode.length for episode in episodes),
        "total_tasks": 1,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }


def _write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=4) + "\n", encoding="utf-8")
