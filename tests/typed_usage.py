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


def imports(folder: Path) -> list[str]:
    """Topics of a folder of images, and of a pair of the paper's tool."""
    plain = mp4ds.ImageFolder(layout="plain", rate="20", topic="/cam/image_raw")
    images: mp4ds.PackSummary = mp4ds.pack(folder, "images", mp4ds.PackOptions(images=plain))
    pair: mp4ds.PackSummary = mp4ds.import_ros_mp4("a.mp4", Path("a.yaml"), "pair", force=True)
    return [topic.topic for summary in (images, pair) for topic in summary.topics]


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


def export(datasets: list[str]) -> dict[str, dict[str, int]]:
    """What could not be held."""
    options = mp4ds.ExportOptions(resize=(64, 48), tolerance_ns=5_000_000, pixels="gray")
    summary: mp4ds.ExportSummary = mp4ds.export(Path(datasets[0]), "euroc", "out", options)
    others = mp4ds.ExportOptions(fps=10, state="/joint_states", task="push")
    use(mp4ds.export(datasets, "lerobot", "episodes", others, progress=use).messages)
    use(summary.output.name, summary.format.upper(), summary.places, summary.notes)
    return summary.left_out


def evaluate(source: str | Path) -> dict[str, float]:
    """Mean VMAF of each setting, by the options that pack with it."""
    options = mp4ds.EvaluateOptions(
        codecs=["av1"], crf=["16:25:3"], target="vmaf=97", cluster="slurm", threads=4
    )
    found: mp4ds.Evaluation = mp4ds.evaluate(source, options, output=Path("out"), progress=use)
    use(mp4ds.evaluate(Path("drive.bag")).output.name, found.left_out, found.tried + found.known)
    for item in found.recommended:
        use(item.why.upper(), item.options.upper(), item.score, item.setting.crf)
    scores: dict[str, float] = {}
    for camera in found.cameras:
        for cell in camera.cells:
            scores[cell.setting.pack_options] = cell.scores["vmaf"].mean
            use(cell.kbps, cell.encode_cpu_seconds, cell.machine.upper())
    return scores


def play(dataset: str | Path) -> float:
    """Seconds that the clock stood still."""
    options = mp4ds.PlayOptions(to="ros1", rate=0.5, clock=100.0, topics=["/cam*"], every=2)
    summary: mp4ds.PlaySummary = mp4ds.play([dataset, str(dataset)], options, progress=use)
    counts: dict[str, int] = summary.messages
    use(counts, summary.stopped, summary.thinned, summary.as_recorded)
    return summary.slowed_s


def recorded(dataset: Path) -> list[Path]:
    """Datasets that were recorded."""
    options = mp4ds.RecordOptions(to="ros2", exclude=["/rosout"], max_duration=600.0)
    summary: mp4ds.RecordSummary = mp4ds.record(["/cam*/*"], dataset, options, progress=use)
    counts: dict[str, int] = summary.dropped
    use(counts, summary.lost, summary.warnings)
    return [made.dataset for made in summary.datasets]


def problems(dataset: Path) -> list[str]:
    """Codes of all problems."""
    found: list[mp4ds.Problem] = mp4ds.validate(dataset, deep=True, progress=use)
    return [problem.code for problem in found if problem.place and problem.message]


def page(dataset: Path) -> Path:
    """A page of a dataset."""
    found: mp4ds.ReportSummary = mp4ds.report(dataset, mp4ds.ReportOptions(proxies="none"))
    return found.index


def brightness(path: str) -> list[tuple[int, float]]:
    """Stamp and mean of every frame of the first stream."""
    with mp4ds.open(path) as dataset:
        stream: mp4ds.Topic = dataset["/cam/image_raw"]
        last: mp4ds.Frame = stream[-1]
        some: list[mp4ds.Frame] = stream[2:7:2]
        stamps: NDArray[np.int64] = stream.stamps
        data: NDArray[Any] = last.data
        use(len(stream), stamps[0], data.shape, [frame.index for frame in some])
        if last.intrinsics is not None:
            k: Sequence[float] = last.intrinsics.k
            use(k[0], last.frame_id.upper(), last.encoding.upper())
        return [(frame.stamp_ns, float(frame.data.mean())) for frame in stream]


def batches(path: str) -> NDArray[Any]:
    """Pixels, times and messages of a dataset, asked for in all ways."""
    with mp4ds.open(path) as dataset:
        sync: mp4ds.Sync = dataset.sync(["/left", "/right"], tolerance_ns=5_000_000)
        pairs: NDArray[np.int64] = sync.indices
        use(len(sync), sync.stamps[0], sync.topics[0].upper(), sync.unmatched["/left"].tolist())
        frames: mp4ds.Topic = dataset["/left"]
        height, width = frames.shape[:2]
        out: NDArray[Any] = np.empty((len(pairs), height, width, 3), frames.dtype)
        frames.read(pairs[:, 0], format="bgr", out=out)
        small: list[mp4ds.Frame] = frames.get([3, -1, 3], format="gray", resize=0.5)
        part = frames.read(range(4), crop=(0, 0, 64, 48), resize=(32, 24))
        use(small[0].data, part.shape, frames.encoding.upper(), frames.topic, frames.log_times)
        start: int = int(frames.stamps[0])
        try:
            frame: mp4ds.Frame = frames.at(start + 7, mode="before", tolerance_ns=10)
            number: int = frames.index_at(frame.stamp_ns, mode="exact")
            use(number)
        except mp4ds.FrameNotFoundError as error:
            nearest: int = error.nearest_ns
            use(nearest)
        use(*[frame.index for frame in frames.between(start, start + 10**9, format="rgb")])
        for message in dataset.messages(["/imu"]):
            found: mp4ds.RecordedMessage = message
            use(found.topic, found.type_name, found.log_time_ns - found.publish_time_ns)
            use(found.decoded.angular_velocity, len(found.raw))
        for whole in dataset:
            parts: list[mp4ds.Stream] = whole.streams
            use(parts, whole.read([0, -1], resize=(32, 24)), whole.topic)
        return out


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
