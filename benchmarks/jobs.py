"""What the benchmarks measure, each in a process of its own: ``python jobs.py NAME JSON``.

Each function returns what is printed as JSON. CPU time is user and system time of all threads,
between the marks that the function sets.
"""

from __future__ import annotations

import json
import resource
import shutil
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np

HERTZ = 30.0
"""Frames per second of the recordings."""


class Cpu:
    """Seconds of CPU time spent inside of `measured` blocks."""

    def __init__(self) -> None:
        self.seconds = 0.0

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Count what is spent inside."""
        start = _cpu_seconds()
        yield
        self.seconds += _cpu_seconds() - start


def _cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def pack(
    source: str, target: str, codec: str | None = None, jobs: int | None = None
) -> dict[str, Any]:
    """Pack losslessly, after importing.

    Returns:
        ``cpu`` seconds; the ``recipe`` that was used, layout and codec, None where the codec
        asked for has no lossless form; ``reasons`` of messages stored verbatim, with their
        number; ``peak`` of memory; bytes of ``dataset`` and ``video``.
    """
    import mp4ds

    run, options = mp4ds.pack, mp4ds.PackOptions(codec=codec, jobs=jobs)
    cpu = Cpu()
    with cpu.measured():
        try:
            summary = run(source, target, options)
        except mp4ds.OptionError:
            return {"recipe": None}
    recipes = [video_of(path) for path in sidecars(target)]
    reasons = {r: count for topic in summary.topics for r, (count, _) in topic.verbatim.items()}
    return {
        "cpu": cpu.seconds,
        "peak": _peak_bytes(),
        "dataset": summary.dataset_bytes,
        "recipe": ", ".join(f"{v.layout} {v.codec}" for v in recipes) or "verbatim",
        "codecs": [video.codec for video in recipes],
        "reasons": reasons,
        "video": sum(path.stat().st_size for path in Path(target).glob("*.mp4")),
    }


def sidecars(dataset: str) -> list[Path]:
    """Those of a dataset's streams."""
    return sorted(Path(dataset).glob("*_raw*.yaml"))


def video_of(path: Path) -> Any:
    """What a sidecar says of its video."""
    from mp4ds.format.sidecars import load_stream

    return load_stream(path).video


def _peak_bytes() -> int:
    """Largest resident memory of this process.

    Linux counts it from the program's start in VmHWM, while ru_maxrss begins with what the
    parent had when it started this process.
    """
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    except OSError:
        unit = 1 if sys.platform == "darwin" else 1024
        return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def decode(dataset: str, frames: str) -> dict[str, Any]:
    """Read all frames of a dataset's streams; then compare all images with the clip, unmeasured.

    Returns:
        ``cpu`` seconds, and whether each image, in a video or verbatim, is ``exact``: the bytes
        of its pixels, so that one NaN is not another.
    """
    from mp4ds.dataset.dataset import Dataset
    from recordings import times

    cpu = Cpu()
    clip = np.load(frames, mmap_mode="r")
    missing = dict(zip(times(len(clip), HERTZ)[0].tolist(), clip, strict=True))
    with Dataset(dataset) as opened:
        with cpu.measured():
            count = sum(1 for stream in opened.streams for _ in stream)
        for stream in opened.streams:
            for frame in stream:
                expected = missing.pop(frame.stamp_ns)
                if frame.data.dtype != expected.dtype or frame.data.shape != expected.shape:
                    return {"cpu": cpu.seconds, "exact": False}
                if frame.data.tobytes() != expected.tobytes():
                    return {"cpu": cpu.seconds, "exact": False}
    found = list(_verbatim(Path(dataset) / "messages.mcap"))
    exact = count + len(found) == len(clip) and all(
        data == missing.pop(stamp).tobytes() for stamp, data in found
    )
    return {"cpu": cpu.seconds, "exact": exact and not missing}


def _verbatim(path: Path) -> Iterator[tuple[int, bytes]]:
    """Stamps and pixels of the images in messages.mcap, read without mp4ds."""
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_typestore

    from recordings import IMAGE, TOPIC

    store = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(topics=[TOPIC]):
            image: Any = store.deserialize_cdr(message.data, IMAGE)
            time = image.header.stamp
            yield time.sec * 10**9 + time.nanosec, image.data.tobytes()


def recipes(source: str, folder: str, frames: str, codecs: list[str | None]) -> dict[str, Any]:
    """Pack with each codec, None for the default, and decode again, one after the other.

    Returns:
        ``results`` of `pack` with those of `decode` as ``decoded``.
    """
    import mp4ds
    from mp4ds.dataset.dataset import Dataset

    _ = mp4ds.pack, Dataset  # imported before anything is measured
    results: list[dict[str, Any]] = []
    for codec in codecs:
        target = Path(folder) / f"dataset-{codec}"
        packed = pack(source, str(target), codec)
        if packed["recipe"]:
            packed["decoded"] = decode(str(target), frames)
            shutil.rmtree(target)
        results.append(packed)
    return {"results": results}


def bare(dataset: str, frames: str, output: str, threads: int) -> dict[str, Any]:
    """Encode the same pictures with the same encoder through PyAV alone.

    Loading the frames, laying them out as the stream's picture, converting them to the
    encoder's pixel format and all imports are done before the measurement starts.

    Args:
        dataset: What pack made of the clip: tells encoder, options and times.
        frames: The clip as .npy.
        output: The .mp4 to make.
        threads: Of the encoder.

    Returns:
        ``cpu`` seconds, and bytes of the ``video``.
    """
    from fractions import Fraction

    import av

    from mp4ds.format.sidecars import load_stream
    from mp4ds.messages.encodings import ENCODINGS, NO_PARAMETERS, Parameters
    from mp4ds.messages.layouts import bind
    from mp4ds.video.pixels import PictureConverter, picture_to_frame

    sidecar = load_stream(sidecars(dataset)[0])
    video, values = sidecar.video, sidecar.video.parameters
    parameters = (
        Parameters.from_values(values.model_dump(exclude_none=True)) if values else NO_PARAMETERS
    )
    layout = bind(video.layout, ENCODINGS[sidecar.image.encoding], parameters)
    converter, coded = PictureConverter(), video.pixel_format or layout.pixel_format
    stamps = sidecar.columns.stamp.decode(sidecar.frames)
    ticks = ((stamps - stamps[0]) // 1000).tolist()
    prepared = []
    for pixels in np.load(frames):
        picture = tuple(np.ascontiguousarray(plane) for plane in layout.to_picture(pixels))
        prepared.append(picture_to_frame(picture, layout.pixel_format, coded, converter))
    time_base = Fraction(1, 1_000_000)
    cpu = Cpu()
    with cpu.measured():
        scale = str(time_base.denominator)
        options = {"video_track_timescale": scale, "movie_timescale": scale}
        with av.open(output, "w", format="mp4", options=options) as container:
            stream = container.add_stream(video.encoder, rate=30, options=dict(video.options))
            stream.width, stream.height = video.width, video.height
            stream.pix_fmt = video.pixel_format
            stream.time_base = stream.codec_context.time_base = time_base
            stream.codec_context.thread_count = threads
            for frame, tick in zip(prepared, ticks, strict=True):
                frame.pts, frame.time_base = tick, time_base
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    return {"cpu": cpu.seconds, "video": Path(output).stat().st_size}


def write_long(path: str, minutes: float, width: int, height: int, hertz: float) -> dict[str, Any]:
    """A recording of a Bayer camera, from a few noisy frames over and over, one at a time."""
    import clips
    from recordings import write_mcap

    spec = clips.specs("bayer_rggb8", 30, (width, height), ("low",))[0]
    frames = clips.load(spec)
    count = round(minutes * 60 * hertz)
    write_mcap(
        Path(path),
        islice(cycle(frames), count),
        count,
        spec.encoding,
        compression="none",
        hertz=hertz,
    )
    return {"frames": count, "bytes": Path(path).stat().st_size}


def write_sidecar(path: str, frames: int, kind: str) -> dict[str, Any]:
    """A stream's sidecar with jittered times and digests, as pack writes it.

    Args:
        path: The .yaml to make.
        frames: Number of frames.
        kind: ``ros1``; ``ros2`` with publish times and sequence numbers; or ``ros1-info``
            with a CameraInfo per frame.
    """
    from mp4ds.dataset.rebuild import ColumnsWriter
    from mp4ds.format.fields import FORMAT_VERSION, Digests
    from mp4ds.format.models import (
        Calibration,
        CameraInfo,
        ChannelModel,
        Header,
        Image,
        StreamSidecar,
        VideoModel,
    )
    from mp4ds.format.sidecars import dump_document
    from mp4ds.messages.wire import ImageFields, Parts
    from mp4ds.records import Channel, Message, Schema
    from recordings import times

    ros1 = kind.startswith("ros1")
    type_name = "sensor_msgs/Image" if ros1 else "sensor_msgs/msg/Image"
    definition = Schema(type_name, "ros1msg" if ros1 else "ros2msg", b"uint32 height\n" * 100)
    channel = Channel(0, "/camera/image_raw", "ros1" if ros1 else "cdr", definition)

    fields = ImageFields("bayer_rggb8", 1280, 720, 1280, 0)

    def columns(delay: int) -> Any:
        writer = ColumnsWriter()
        stamps, log_times = times(frames, 60.0)
        published = stamps + np.random.default_rng(1).integers(500_000, 1_500_000, frames)
        rows = zip(stamps.tolist(), (log_times + delay).tolist(), published.tolist(), strict=True)
        for number, (stamp, log_time, publish_time) in enumerate(rows):
            if ros1:
                message = Message(channel, log_time, log_time, 0, b"")
            else:
                message = Message(channel, log_time, publish_time, number, b"")
            seq = number if ros1 else None
            parts = Parts(stamp, seq, None, "camera", fields, memoryview(b""), b"")
            writer.append(message, parts, variant=0, ordinal=number)
        return writer.to_model()

    words = np.random.default_rng(2).integers(0, 2**63, frames)
    lines = [" ".join(f"{word:016x}" for word in words[i : i + 6]) for i in range(0, frames, 6)]
    info = None
    if kind == "ros1-info":
        calibration = Calibration(
            frame_id="camera",
            height=720,
            width=1280,
            distortion_model="plumb_bob",
            d=[0.0] * 5,
            k=[1.0] * 9,
            r=[1.0] * 9,
            p=[1.0] * 12,
        )
        info = CameraInfo(
            channel=ChannelModel.from_record(channel),
            wire="ros1",
            messages=frames,
            calibrations=[calibration],
            columns=columns(20_000),
        )
    sidecar = StreamSidecar(
        mp4ds=FORMAT_VERSION,
        kind="stream",
        profile="lossless",
        frames=frames,
        channel=ChannelModel.from_record(channel),
        wire="ros1" if ros1 else "cdr-le",
        image=Image(encoding="bayer_rggb8", width=1280, height=720, step=1280, is_bigendian=0),
        headers=[Header(frame_id="camera")],
        video=VideoModel(
            file="camera.mp4",
            layout="mosaic8",
            codec="h264",
            pixel_format="gray",
            width=1280,
            height=720,
        ),
        camera_info=info,
        columns=columns(0),
        digests=Digests(algorithm="xxh64", values="\n".join(lines) + "\n"),
    )
    data = dump_document(sidecar)
    Path(path).write_bytes(data)
    return {"bytes": len(data)}


def load_sidecar(path: str, rounds: int) -> dict[str, Any]:
    """Load a sidecar through all tiers, to arrays, several times after importing.

    Returns:
        CPU seconds of each step, a list with one value per round, and their ``sum``.
    """
    from jsonschema import Draft202012Validator

    from mp4ds.dataset.rebuild import decode_columns
    from mp4ds.format.models import StreamSidecar
    from mp4ds.format.sidecars import load_document, schema_text

    steps: dict[str, list[float]] = {}
    for _ in range(rounds):
        cpu: defaultdict[str, Cpu] = defaultdict(Cpu)
        with cpu["yaml"].measured():
            document = load_document(Path(path))
        schema = json.loads(schema_text("stream"))
        with cpu["schema"].measured():
            Draft202012Validator(schema).validate(document)
        with cpu["model"].measured():
            model = StreamSidecar.model_validate(document)
        info = model.camera_info
        with cpu["columns"].measured():
            decode_columns(model.columns, model.frames, 1, path)
            if info and info.columns:
                decode_columns(info.columns, info.messages, 1, path)
        if model.digests:
            with cpu["digests"].measured():
                model.digests.decode(model.frames)
        for name, step in cpu.items():
            steps.setdefault(name, []).append(step.seconds)
        steps.setdefault("sum", []).append(sum(step.seconds for step in cpu.values()))
    return steps


JOBS: dict[str, Callable[..., dict[str, Any]]] = {
    function.__name__: function
    for function in (pack, decode, recipes, bare, write_long, write_sidecar, load_sidecar)
}

if __name__ == "__main__":
    print(json.dumps(JOBS[sys.argv[1]](**json.loads(sys.argv[2]))))
