"""How a typed program uses the package: checked by ``mypy --strict`` in test_public.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mp4ds


def use(*values: object) -> None:
    """Take any values."""


def pack(source: Path, dataset: str) -> dict[str, tuple[int, int]]:
    """Messages and frames of each topic."""
    options = mp4ds.PackOptions(topics=["/cam*"], quality="crf=22", codec="av1", jobs=2)
    summary: mp4ds.PackSummary = mp4ds.pack(source, dataset, options)
    cameras = ["/cam/image_raw=/cam/camera_info"]
    anew = mp4ds.PackOptions(quality="visual", transcode=True, camera_info=cameras, gop=30)
    for topic in mp4ds.pack(source, Path(dataset), anew).topics:
        reasons: dict[str, tuple[int, int]] = topic.verbatim
        use(reasons, topic.notes, topic.files, topic.raw_bytes > topic.packed_bytes)
    mp4ds.pack([source, str(source)], Path(dataset), progress=lambda state: use(state.frames))
    share = (1, 2)
    mp4ds.pack_share(source, dataset, share, mp4ds.PackOptions(window=600))
    for other in mp4ds.pack_each([source], "datasets", mp4ds.PackOptions(keep_going=True)):
        use(other.dataset.name, other.losses)
    return {topic.topic: (topic.messages, topic.frames) for topic in summary.topics}


def unpack(dataset: str | Path) -> Path:
    """The recording made."""
    options = mp4ds.UnpackOptions(storage="mcap", force=True)
    summary: mp4ds.UnpackSummary = mp4ds.unpack(dataset, "rosbag2", "drive", options)
    others = mp4ds.UnpackOptions(images="jpeg", jpeg_quality=90, topics=["/cam*"])
    for old, new in mp4ds.unpack(dataset, "mcap", None, others).republished.items():
        use(old.upper(), new.topic.upper(), new.type_name.upper())
    reasons: dict[str, dict[str, int]] = summary.as_recorded
    counts: dict[str, int] = summary.messages
    use(reasons)
    omitted: dict[str, int] = summary.omitted
    use(sum(counts.values()), omitted, summary.converted, summary.left_out)
    return summary.output


def problems(dataset: Path) -> list[str]:
    """Codes of all problems."""
    found: list[mp4ds.Problem] = mp4ds.validate(dataset, deep=True, progress=use)
    return [problem.code for problem in found if problem.place and problem.message]


def brightness(path: str) -> list[tuple[int, float]]:
    """Stamp and mean of every frame of the first stream."""
    with mp4ds.open(path) as dataset:
        stream: mp4ds.Stream = dataset["/cam/image_raw"]
        last: mp4ds.Frame = stream[-1]
        some: list[mp4ds.Frame] = stream[2:7:2]
        stamps: NDArray[np.int64] = stream.stamps
        data: NDArray[Any] = last.data
        use(len(stream), stamps[0], data.shape, [frame.index for frame in some])
        if last.intrinsics is not None:
            k: Sequence[float] = last.intrinsics.k
            use(k[0], last.frame_id.upper(), last.encoding.upper())
        return [(frame.stamp_ns, float(frame.data.mean())) for frame in stream]


def guarded(path: str) -> int:
    """An exit code."""
    try:
        dataset: mp4ds.Dataset = mp4ds.open(path)
        topics: list[str] = dataset.topics
        use(topics)
    except mp4ds.SourceNotFoundError as error:
        missing: Path = error.path
        use(missing)
        return error.exit_code
    except mp4ds.VideoError as error:
        code: str = error.code
        use(code, error.place, error.problem)
        return error.exit_code
    except mp4ds.Mp4dsError as error:
        return error.exit_code
    return 0


VERSION: str = mp4ds.__version__
