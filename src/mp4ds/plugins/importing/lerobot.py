"""An episode of a LeRobotDataset v3: packets of its shared videos, and rows as messages."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from mp4ds.dataset.vectors import COLUMNS
from mp4ds.errors import OptionError, SourceError
from mp4ds.packing.options import ImportOptions
from mp4ds.plugins.exporting.lerobot import DEPTH_FORMAT, LEROBOT_SCALE, DepthScale
from mp4ds.plugins.importing.images import MAX_STAMP
from mp4ds.plugins.importing.reader import ImagesReader
from mp4ds.times import nearest
from mp4ds.video.decoder import Clip, open_video

_INFO = "meta/info.json"

_TASKS = "meta/tasks.parquet"
_EPISODES = "meta/episodes"
_PATHS = {
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}
_PICTURES = ("video", "image")  # types of features
_MAX_BYTES, _MAX_NUMBERS, _MAX_NAME = 2**24, 2**20, 200
_NS = 10**9


class _Folder:
    """What the folder says about all of its episodes.

    Raises:
        SourceError: It is not of this version, or not valid.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.info_path = path / _INFO
        try:
            if self.info_path.stat().st_size > _MAX_BYTES:
                raise ValueError(f"it is larger than {_MAX_BYTES} bytes")
            self.info = json.loads(self.info_path.read_text(encoding="utf-8"))
            version = str(self.info["codebase_version"])
            self.fps = float(self.info["fps"])
            self.features: Mapping[str, Any] = self.info["features"]
            if not 0 < self.fps < math.inf:
                raise ValueError(f"fps is {self.fps}")
            for name, feature in self.features.items():
                _check_feature(name, feature)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise SourceError(self.info_path, f"is not valid: {_told(error)}") from None
        if not version.startswith("v3."):
            raise SourceError(
                path,
                f"is a LeRobotDataset {version[:20]}, not v3",
                "Convert it with LeRobot: python -m lerobot.scripts.convert_dataset_v21_to_v30",
            )

    def file(self, kind: str, row: Mapping[str, Any], prefix: str, key: str = "") -> Path:
        """A file of an episode.

        Raises:
            SourceError: It is outside of the folder, or there is none.
        """
        pattern = _PATHS[kind]
        if self.info.get(kind, pattern) != pattern:
            raise SourceError(self.info_path, f"{kind} is not {pattern}, as LeRobot has it")
        places = {name: int(row[f"{prefix}/{name}"]) for name in ("chunk_index", "file_index")}
        name = PurePosixPath(pattern.format(video_key=key, **places))
        if ".." in name.parts:
            raise SourceError(self.info_path, f"{key} names a file outside of its folder")
        if not (self.path / name).is_file():
            raise SourceError(self.path / name, "does not exist, but an episode is in it")
        return self.path / name

    def episodes(self, number: int | None = None) -> list[tuple[Path, dict[str, Any]]]:
        """The rows of all episodes, or of one, without statistics, and their files."""
        found: list[tuple[Path, dict[str, Any]]] = []
        only = None if number is None else [("episode_index", "==", number)]
        for path in sorted((self.path / _EPISODES).glob("chunk-*/file-*.parquet")):
            with _reading(path):
                names = [name for name in pq.read_schema(path).names if name[:6] != "stats/"]
                rows = pq.read_table(path, columns=names, filters=only).to_pylist()
                if (least := min((int(row["episode_index"]) for row in rows), default=0)) < 0:
                    raise ValueError(f"it has an episode {least}")
                found += ((path, row) for row in rows)
        return found


def _check_feature(name: str, feature: Any) -> None:
    if not (name and name.isprintable() and len(name) <= _MAX_NAME):
        raise ValueError(f"{name[:40]!r} is no name of a feature")
    shape = feature["shape"]
    if not all(type(side) is int and side > 0 for side in shape) or not str(feature["dtype"]):
        raise ValueError(f"the shape of {name} is not positive numbers")
    if not isinstance(feature.get("info") or {}, dict):
        raise ValueError(f"the info of {name} is no mapping")
    if math.prod(shape) > _MAX_NUMBERS and feature["dtype"] not in _PICTURES:
        raise ValueError(f"{name} has more than {_MAX_NUMBERS} numbers")


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Errors of a table in the terms of a source."""
    try:
        yield
    except (pa.ArrowException, OSError, KeyError, ValueError, TypeError, OverflowError) as error:
        if isinstance(error, SourceError) or getattr(error, "errno", None):
            raise
        problem = f"is damaged, or not a table of LeRobot's: {_told(error)}"
        raise SourceError(path, problem) from None


def _told(error: Exception) -> str:
    """An error of a library in one line."""
    text = str(error).partition("\n")[0].rstrip(".")
    return f"{text} is missing" if isinstance(error, KeyError) and " " not in text else text


def episodes_in(folder: Path) -> list[int]:
    """The numbers of the episodes in a folder.

    Raises:
        SourceError: It is not a LeRobotDataset v3, or has none.
    """
    found = sorted(row["episode_index"] for _, row in _Folder(folder).episodes())
    if not found:
        raise SourceError(folder, "has no episodes")
    if twice := {one for one, other in pairwise(found) if one == other}:
        raise SourceError(folder, f"has episode {min(twice)} twice")
    return found


def open_episode(folder: Path, options: ImportOptions) -> ImagesReader:
    """Open an episode as a recording.

    Args:
        folder: The folder.
        options: Which episode, and whether to decode its videos.

    Raises:
        SourceError: The folder is damaged, or a video cannot be copied.
        OptionError: There is no such episode, or several and none is chosen.
    """
    options.check_for("lerobot")
    known, reader = _Folder(folder), ImagesReader(folder)
    path, row = _chosen(known, options.episode)
    for file in (known.info_path, folder / _TASKS):
        if file.is_file():
            reader.add_file(file, is_kept=file == known.info_path)
    reader.add_file(path)
    with _reading(path):
        number, length = int(row["episode_index"]), int(row["length"])
        data = known.file("data_path", row, "data")
    reader.add_file(data)
    with _reading(data):
        held = pq.read_schema(data).names
        rows = {name for name, one in known.features.items() if one["dtype"] not in _PICTURES}
        wanted = [name for name in held if name in COLUMNS or name in rows]
        table = pq.read_table(data, columns=wanted, filters=[("episode_index", "==", number)])
        if table.num_rows != length or not length:
            raise ValueError(f"it has {table.num_rows} rows of episode {number}, not {length}")
        order = table["frame_index"].to_numpy()
        if not np.array_equal(order, np.arange(length)):
            raise ValueError(f"the frames of episode {number} are not numbered from 0")
        times = table["timestamp"].to_numpy()
        stamps = _stamps(times)
        tasks = table["task_index"].to_numpy()
    if all(feature["dtype"] != "video" for feature in known.features.values()):
        raise SourceError(folder, "holds no images")
    for key, feature in known.features.items():
        if key in COLUMNS:
            continue
        if feature["dtype"] == "video":
            with _reading(path):
                video = known.file("video_path", row, f"videos/{key}", key)
                begin = float(row[f"videos/{key}/from_timestamp"])
                if not 0 <= begin < MAX_STAMP // _NS:
                    raise ValueError(f"episode {number} begins at {begin} s of {video.name}")
            _add_video(reader, known, key, video, begin + times.astype(np.float64), stamps, options)
        elif feature["dtype"] == "image":
            reader.left_out[f"images of {key}, which are not in a video"] = length
        elif key in held and not _has_messages(table.schema.field(key).type):
            reader.left_out[f"rows of {key}, whose type has no message"] = length
        else:
            with _reading(data):
                _add_rows(reader, _topic(key), feature, table[key], stamps)
    _add_tasks(reader, folder / _TASKS, tasks, stamps)
    if others := {*held} - {*known.features, *COLUMNS}:
        reader.left_out["columns that are not features"] = len(others)
    return reader


def _topic(key: str) -> str:
    return "/" + key.strip("./").replace(".", "/")


def _chosen(folder: _Folder, number: int | None) -> tuple[Path, dict[str, Any]]:
    """The row of an episode."""
    found = folder.episodes(number)
    if not found:
        raise OptionError(f"{folder.path} has no `episode` {number}.")
    if len(found) > 1 and number is not None:
        raise SourceError(folder.path, f"has episode {number} twice")
    if len(found) > 1:
        raise OptionError(
            f"{folder.path} has {len(found)} episodes. Give `episode`, or use "
            "mp4ds import lerobot, which takes all."
        )
    return found[0]


def _stamps(times: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
    """Nanoseconds of a table's seconds; in single precision, they are these seconds again."""
    if not (np.isfinite(times).all() and 0 <= times.min() <= times.max() < MAX_STAMP // _NS):
        raise ValueError("its timestamps are not seconds")
    stamps: NDArray[np.int64] = np.rint(times.astype(np.float64) * _NS).astype(np.int64)
    if (np.diff(stamps) <= 0).any():
        raise ValueError("its timestamps do not increase")
    return stamps


# ---------------------------------------------------------------- videos


def _add_video(
    reader: ImagesReader,
    folder: _Folder,
    key: str,
    path: Path,
    times: NDArray[np.float64],
    stamps: NDArray[np.int64],
    options: ImportOptions,
) -> None:
    """Add the frames of an episode, which are some of those of a video.

    Args:
        reader: Gets them.
        folder: What is known of the folder.
        key: Of the feature.
        path: The video.
        times: When the episode's frames are shown, seconds.
        stamps: Of their messages.
        options: How.

    Raises:
        SourceError: The video has other frames, or cannot be copied.
    """
    file = open_video(path)
    due = np.rint(times * _NS).astype(np.int64)
    numbers = nearest(file.times, due)
    away = np.abs(file.times[numbers] - due).max()
    if away > _NS / folder.fps / 2 or (np.diff(numbers) != 1).any():
        problem = "has other frames than the tables say: one is not where, or not alone where"
        raise SourceError(path, f"{problem} a row has it")
    info = folder.features[key].get("info") or {}
    is_depth = bool(info.get("is_depth_map") or info.get("video.is_depth_map"))
    pictures = DEPTH_FORMAT if is_depth else "rgb24" if options.decode else ""
    frames = range(int(numbers[0]), int(numbers[-1]) + 1)
    depths = None
    if is_depth:
        given = {name: info.get(f"video.{name}") for name in DepthScale._fields}
        told = {name: value for name, value in given.items() if value is not None}
        with _reading(folder.info_path):
            scale = LEROBOT_SCALE._replace(**told)
            depths = scale.table(in_metres=info.get("depth_unit") == "m")
    reader.add_clip(
        _topic(key),
        key.rpartition(".")[2],
        Clip(file, pictures=pictures, numbers=frames),
        stamps,
        depths=depths,
    )
    reader.add_file(path)


# ---------------------------------------------------------------- rows


def _add_rows(
    reader: ImagesReader,
    topic: str,
    feature: Mapping[str, Any],
    column: Any,
    stamps: NDArray[np.int64],
) -> None:
    """Add a feature's rows: with names as joints, which keep them, else as plain numbers."""
    count = math.prod(feature["shape"])
    values = column.combine_chunks()
    while pa.types.is_nested(values.type):
        if len(pc.list_value_length(values).unique()) != 1:
            raise ValueError("its rows differ in length")
        values = values.flatten()
    if values.null_count or len(values) != len(stamps) * count:
        raise ValueError(f"its rows are not of {count} numbers each")
    rows: NDArray[Any] = values.to_numpy(zero_copy_only=False).reshape(-1, count)
    names: Any = feature.get("names")
    if isinstance(names, dict) and len(names) == 1:
        (names,) = names.values()
    is_named = isinstance(names, list) and len(names) == count
    if is_named and rows.dtype.kind == "f" and all(isinstance(name, str) for name in names):
        reader.add_joints(topic, names, stamps, rows.astype(np.float64))
    else:
        reader.add_numbers(topic, stamps, rows, feature["shape"])


def _has_messages(kind: Any) -> bool:
    """Whether a column is of numbers, texts, or lists of these."""
    while pa.types.is_nested(kind) and hasattr(kind, "value_type"):
        kind = kind.value_type
    # a column without any value is of no type, and refused later
    plain = (pa.float32(), pa.float64(), pa.bool_(), pa.string(), pa.null())
    return kind in plain or bool(pa.types.is_integer(kind))


def _add_tasks(
    reader: ImagesReader, path: Path, numbers: NDArray[np.int64], stamps: NDArray[np.int64]
) -> None:
    """Add the tasks, where they change."""
    if not path.is_file():
        reader.left_out["numbers of tasks, of which no texts are there"] = len(numbers)
        return
    with _reading(path):
        table = pq.read_table(path, columns=["task_index", "task"]).to_pydict()
        texts = dict(zip(table["task_index"], table["task"], strict=True))
        changes = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
        tasks = [str(texts[number]) for number in numbers[changes].tolist()]
    rows = np.array(tasks, str).reshape(-1, 1)
    reader.add_numbers("/task", stamps[changes], rows, [1], latched=True)
