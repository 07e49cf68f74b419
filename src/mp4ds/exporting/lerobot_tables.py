"""The Parquet files of LeRobot."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray


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
        fps: Frames in a second.
        episode: Number of the episode.
        first: Number of its first frame among those of all episodes.
    """
    columns: dict[str, pa.Array] = {}
    for name, values in vectors.items():
        flat = pa.array(values.ravel(), pa.float32())
        count = values.shape[1]
        # a single number stands by itself
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
