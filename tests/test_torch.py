"""Frames as samples for PyTorch: in this process, in workers, in order and at random."""

from __future__ import annotations

import dataclasses
import gc
import hashlib
import json
import os
import pickle
import re
import shutil
import signal
from collections import Counter
from itertools import islice
from pathlib import Path
from typing import Any

import av
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

import mp4ds
from commands import program
from mp4ds.messages.depth import DEPTHS
from mp4ds.packing.options import PackOptions
from scenes import PERIOD, Scene, scene
from sources import SOURCES
from test_examples import ROOT

torch = pytest.importorskip("torch")

from torch.utils.data import DataLoader, default_collate  # noqa: E402

from mp4ds.torch import FrameDataset, FrameStream, SampleError  # noqa: E402
from waiting import WATCHDOG_S  # noqa: E402

LEFT, RIGHT = BOTH = ["/left/image_raw", "/right/image_raw"]
FRAMES, GOP = 24, 6
LOST = 7  # a frame of the right camera that was not recorded

pytestmark = pytest.mark.filterwarnings(
    # Python's and torch's words about the fork, which these tests want
    "ignore:.*fork.*:DeprecationWarning",
    "ignore:This process .* is multi-threaded:DeprecationWarning",
)


def camera(topic: str, encoding: str, seed: int, lost: int | None = None) -> Scene:
    """A camera of its own name, maybe with a frame that was lost."""
    made = scene(encoding, frames=FRAMES, seed=seed, with_info=False)
    images = [m for m in made.messages if m.topic == "/cam/image_raw"]
    return Scene([dataclasses.replace(m, topic=topic) for n, m in enumerate(images) if n != lost])


def packed(folder: Path, *cameras: Scene, quality: str = "visual") -> Path:
    """A dataset of cameras."""
    folder.mkdir()
    messages = sorted((m for made in cameras for m in made.messages), key=lambda m: m.log_time)
    sources = SOURCES["mcap-ros2-none"](folder, Scene(messages))
    mp4ds.pack(sources, folder / "drive", PackOptions(codec="h264", gop=GOP, quality=quality))
    return folder / "drive"


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three recordings of two cameras; not to be changed."""
    folder = tmp_path_factory.mktemp("drives")
    return [
        packed(
            folder / str(n),
            camera(LEFT, "rgb8", 2 * n),
            camera(RIGHT, "rgb8", 2 * n + 1, lost=LOST),
        )
        for n in range(3)
    ]


@pytest.fixture(scope="module")
def grey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera of 16 bits."""
    return packed(tmp_path_factory.mktemp("grey") / "grey", camera(LEFT, "mono16", 0))


def frames_of(drive: Path, topic: str) -> list[mp4ds.Frame]:
    with mp4ds.open(drive) as dataset:
        return list(dataset[topic])


def first(frame: mp4ds.Frame) -> Any:
    """Channels first."""
    return torch.from_numpy(np.ascontiguousarray(frame.data)).permute(2, 0, 1)


def matched(drive: Path) -> list[tuple[mp4ds.Frame, mp4ds.Frame]]:
    """Frames of both cameras that belong together, as the scene was made."""
    right = frames_of(drive, RIGHT)
    left = [frame for n, frame in enumerate(frames_of(drive, LEFT)) if n != LOST]
    return list(zip(left, right, strict=True))


# ---------------------------------------------------------------- one camera

CASES = sorted((ROOT / "conformance/cases/datasets").iterdir())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_samples_of_the_conformance_suite(case: Path) -> None:
    """From the last to the first, they have the pixels that are due."""
    for stream in json.loads((case / "expected.json").read_text())["streams"]:
        name, due = Path(stream["sidecar"]).stem, dict.fromkeys(("view", "exact"), stream["pixels"])
        if "view" in stream and stream["image"]["encoding"] not in DEPTHS:  # which are always exact
            due["view"] = stream["view"]["pixels"]
        if case.name.endswith("-alone"):
            del due["exact"]
        for layer, digests in due.items():
            if digests is None:  # of packets, whose pixels depend on the decoder
                continue
            samples = FrameDataset(
                case,
                topics=[name],
                layer=layer,
                format="native",
                dtype="native",
                channels_first=False,
            )
            found = [samples[-1 - n][name].numpy().tobytes() for n in range(len(samples))]
            assert [hashlib.sha256(one).hexdigest() for one in reversed(found)] == digests


def test_a_sample_is_the_frame_of_its_number(drives: list[Path]) -> None:
    dataset = FrameDataset(drives[0], topics=[LEFT])
    frames = frames_of(drives[0], LEFT)
    assert len(dataset) == len(frames) == FRAMES
    for number in [0, 13, FRAMES - 1, -1, -FRAMES]:
        sample, frame = dataset[number], frames[number]
        assert list(sample) == [LEFT, f"{LEFT}_is_pad", "stamp_ns", "index", "dataset"]
        assert torch.equal(sample[LEFT], first(frame))
        assert sample[LEFT].dtype == torch.uint8
        assert sample[f"{LEFT}_is_pad"].tolist() == [False]
        assert (sample["stamp_ns"], sample["index"]) == (frame.stamp_ns, frame.index)
        assert sample["dataset"] == 0
    for number in (FRAMES, -FRAMES - 1):
        with pytest.raises(IndexError, match=f"{FRAMES} samples, and none with number {number}"):
            dataset[number]


def test_floats_are_fractions(drives: list[Path], grey: Path) -> None:
    bytes_ = FrameDataset(drives[0], topics=[LEFT])[5][LEFT]
    floats = FrameDataset(drives[0], topics=[LEFT], dtype="float32")[5][LEFT]
    assert floats.dtype == torch.float32
    assert torch.equal(floats, bytes_.to(torch.float32) / 255)
    (wide,) = FrameDataset(grey, dtype="float32", format="gray")[5][LEFT]
    data = frames_of(grey, LEFT)[5].data
    assert torch.equal(wide, torch.from_numpy(data.astype(np.float32) / np.float32(65535)))
    (native,) = FrameDataset(grey, dtype="float32", format="native")[5][LEFT]
    assert np.array_equal(native.numpy(), data), "native values keep their numbers"


def test_bits_beyond_bytes_are_kept(grey: Path) -> None:
    (image,) = FrameDataset(grey, format="native")[5][LEFT]
    assert image.dtype == torch.uint16
    assert np.array_equal(image.numpy(), frames_of(grey, LEFT)[5].data)
    with pytest.raises(mp4ds.OptionError, match=f"{LEFT}: has frames of uint16, not uint8"):
        FrameDataset(grey, format="native", dtype="uint8")[5]


def test_a_video_without_sidecar(drives: list[Path], tmp_path: Path) -> None:
    shutil.copy(drives[0] / "left_image_raw.mp4", tmp_path / "clip.mp4")
    frames = frames_of(tmp_path / "clip.mp4", "clip")
    for dataset in (FrameDataset(tmp_path / "clip.mp4"), FrameStream(tmp_path / "clip.mp4")):
        seen = {sample["index"]: sample for sample in dataset}
        assert len(seen) == FRAMES
        for number, sample in seen.items():
            assert torch.equal(sample["clip"], first(frames[number]))
            assert sample["stamp_ns"] == frames[number].stamp_ns


# ---------------------------------------------------------------- many at a time


def test_many_samples_of_several_datasets(drives: list[Path]) -> None:
    """In any order, repeated, and without shared memory."""
    dataset = FrameDataset(drives, topics=[LEFT])
    assert dataset.lengths == [FRAMES] * 3
    assert dataset.paths == list(map(str, drives))
    wanted = [2 * FRAMES, FRAMES - 1, 3, 3, FRAMES, 0, -1]
    samples = dataset.__getitems__(wanted)
    for number, sample in zip(wanted, samples, strict=True):
        recording, row = divmod(number % len(dataset), FRAMES)
        assert (sample["index"], sample["dataset"]) == (number % len(dataset), recording)
        assert torch.equal(sample[LEFT], first(frames_of(drives[recording], LEFT)[row]))
    samples[2][LEFT].zero_()
    assert torch.equal(samples[3][LEFT], first(frames_of(drives[0], LEFT)[3]))


def open_videos() -> int:
    links = (os.path.realpath(link) for link in Path("/proc/self/fd").iterdir())
    return sum(link.endswith(".mp4") for link in links)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc")
def test_few_videos_are_open(drives: list[Path]) -> None:
    before = open_videos()
    dataset = FrameDataset(drives, topics=BOTH, cache_files=2)
    for _ in range(2):
        dataset.__getitems__(list(range(0, len(dataset), 5)))
        assert open_videos() - before == 2
    dataset.close()
    assert open_videos() == before
    assert dataset[0][LEFT].shape == (3, 48, 64), "opened again"
    dataset.close()


# ---------------------------------------------------------------- offsets


def test_offsets_in_frames(drives: list[Path]) -> None:
    dataset = FrameDataset(drives[:2], topics=[LEFT], offsets=(-2, 0, 1))
    frames = frames_of(drives[1], LEFT)
    for row, wanted, padded in [
        (0, [0, 0, 1], [True, False, False]),
        (1, [0, 1, 2], [True, False, False]),
        (9, [7, 9, 10], [False] * 3),
        (FRAMES - 1, [FRAMES - 3, FRAMES - 1, FRAMES - 1], [False, False, True]),
    ]:
        sample = dataset[FRAMES + row]
        assert torch.equal(sample[LEFT], torch.stack([first(frames[n]) for n in wanted]))
        assert sample[f"{LEFT}_is_pad"].tolist() == padded
        assert sample["stamp_ns"] == frames[row].stamp_ns


def test_offsets_in_seconds(drives: list[Path]) -> None:
    """To the nearest frame; where one was lost, what is nearest is padding."""
    frames = frames_of(drives[0], RIGHT)
    dataset = FrameDataset(
        drives[0], topics=[RIGHT], offsets=(-0.1, 0, 0.035), offsets_in="seconds"
    )
    stamps = np.array([frame.stamp_ns for frame in frames])
    for row in range(len(frames)):
        times = stamps[row] + np.array([-100_000_000, 0, 35_000_000])
        away = np.abs(stamps - times[:, None])
        sample = dataset[row]
        expected = [first(frames[n]) for n in away.argmin(axis=1)]
        assert torch.equal(sample[RIGHT], torch.stack(expected))
        missing = away.min(axis=1) > PERIOD / 2 + 10_000
        assert sample[f"{RIGHT}_is_pad"].tolist() == missing.tolist()
    assert dataset[LOST + 2][f"{RIGHT}_is_pad"].tolist() == [True, False, False]
    assert dataset[LOST - 1][f"{RIGHT}_is_pad"].tolist() == [False, False, True]


# ---------------------------------------------------------------- several cameras


def test_cameras_are_matched(drives: list[Path]) -> None:
    dataset = FrameDataset(drives[0], topics=BOTH)
    pairs = matched(drives[0])
    assert dataset.topics == tuple(BOTH)
    assert sorted(FrameDataset(drives[0]).topics) == BOTH
    assert len(dataset) == len(pairs) == FRAMES - 1
    for sample, (left, right) in zip(dataset.__getitems__(range(len(dataset))), pairs, strict=True):
        assert torch.equal(sample[LEFT], first(left))
        assert torch.equal(sample[RIGHT], first(right))
        assert sample["stamp_ns"] == left.stamp_ns
    (unmatched,) = dataset.unmatched
    assert {topic: found.tolist() for topic, found in unmatched.items()} == {
        LEFT: [LOST],
        RIGHT: [],
    }


def test_nothing_matches(tmp_path: Path) -> None:
    """The second camera recorded after the first."""
    early, late = camera(LEFT, "rgb8", 0), camera(RIGHT, "rgb8", 1)
    for message in late.messages:
        message.values["header"]["stamp"] += 10**12
    drive = packed(tmp_path / "a", early, late)
    with pytest.raises(mp4ds.OptionError, match=f"no frames of {LEFT}, {RIGHT} .*20000000 ns"):
        FrameDataset(drive, topics=BOTH)


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"topics": ["/up"]}, "has no topic '/up'; there are: /"),
        ({"topics": []}, "topics is empty"),
        ({"offsets": 2}, "offsets is 2, but a list such as (-1, 0)"),
        ({"topics": LEFT}, "topics is a list"),
        ({"topics": [LEFT, LEFT]}, "/left/image_raw is given twice"),
        ({"offsets": ()}, "offsets is empty"),
        ({"offsets": [-0.1, 0]}, 'in frames must be integers; for seconds, give offsets_in="seco'),
        ({"resize": 224}, "is a factor; for pixels, use (224, 224)"),
        ({"offsets_in": "minutes"}, "offsets_in is 'minutes'"),
        ({"offsets": (float("nan"),), "offsets_in": "seconds"}, "at most 1e9"),
        ({"tolerance_ns": 5}, 'belongs to offsets_in="seconds"'),
        ({"tolerance_ns": -5, "offsets_in": "seconds"}, "tolerance_ns is -5"),
        ({"sync_tolerance_ns": -1}, "sync_tolerance_ns is -1"),
        ({"format": "hsv"}, "format is 'hsv', not one of native, rgb, bgr, gray"),
        ({"format": {"/up": "rgb"}}, "format is given for '/up'"),
        ({"dtype": "float16"}, "dtype is 'float16'"),
        ({"backend": "other"}, "backend is 'other'"),
        ({"layer": "best"}, "layer is 'best', not one of exact, view"),
        ({"device": "cuda"}, "needs backend='torchcodec'"),
        ({"backend": "torchcodec", "format": "gray"}, "gives format='rgb' without resize"),
        ({"cache_files": 0}, "cache_files is 0"),
    ],
)
def test_wrong_options(drives: list[Path], options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(mp4ds.OptionError) as caught:
        FrameDataset(drives[0], **options)
    assert sentence in str(caught.value)


# ---------------------------------------------------------------- layers


@pytest.mark.parametrize("kind", [FrameDataset, FrameStream])
def test_the_view_of_a_lossless_camera_is_read_unless_the_exact_frames_are_asked_for(
    kind: Any, with_views: Path
) -> None:
    options: dict[str, Any] = {"topics": ["/left/image_raw"], "channels_first": False}
    if kind is FrameStream:
        options["shuffle"] = False
    for given, layer in (({}, "view"), ({"layer": "view"}, "view"), ({"layer": "exact"}, "exact")):
        with mp4ds.open(with_views) as dataset:
            frames = dataset["/left/image_raw"]
            expected = frames.read(range(len(frames)), layer=layer)
            other = frames.read([0], layer="exact" if layer == "view" else "view")
        samples = list(kind(with_views, **options, **given))
        assert len(samples) == len(expected)
        for sample, pixels in zip(samples, expected, strict=True):
            np.testing.assert_array_equal(sample["/left/image_raw"].numpy(), pixels)
        assert (samples[0]["/left/image_raw"].numpy() != other[0]).any()


def test_exact_frames_that_are_not_here_are_told_at_once(with_views: Path, tmp_path: Path) -> None:
    drive = Path(shutil.copytree(with_views, tmp_path / "drive"))
    (drive / "left_image_raw.exact.mp4").unlink()
    FrameDataset(drive, topics=["/left/image_raw"])[0]
    FrameDataset(drive, topics=["/right/image_raw"], layer="exact")[0]
    with pytest.raises(mp4ds.OptionError, match=r"/left/image_raw has no exact frames here"):
        FrameDataset(drive, topics=["/left/image_raw"], layer="exact")


def test_without_torch() -> None:
    code = "import sys; sys.modules['torch'] = None; import mp4ds.torch"
    assert "ImportError: mp4ds.torch needs PyTorch" in program("-c", code, code=1).err


# ---------------------------------------------------------------- workers

WORKERS = [(0, None), (2, "fork"), pytest.param(2, "spawn", marks=pytest.mark.slow)]


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"topics": BOTH},
        {"offsets": (-1, 0), "topics": BOTH},
        {"dtype": "float32", "offsets": (0, 2)},
        {"channels_first": False, "resize": (20, 10)},
        {"format": "gray", "dtype": "float32"},
        {"format": {LEFT: "native", RIGHT: "gray"}, "topics": BOTH},
    ],
)
@pytest.mark.parametrize("batch", [[0], [5, 6, 7], [3, 30, 3, 60, 1]])
def test_batches_are_collated_as_usual(
    drives: list[Path], options: dict[str, Any], batch: list[int]
) -> None:
    dataset = FrameDataset(drives, **options)
    samples = dataset.__getitems__(batch)
    ours, usual = dataset.collate(samples), default_collate(samples)
    assert ours.keys() == usual.keys()
    for key in usual:
        assert ours[key].dtype == usual[key].dtype
        assert torch.equal(ours[key], usual[key])
    for topic in dataset.topics:  # nothing was copied
        assert ours[topic].data_ptr() == samples[0][topic].data_ptr()
    dataset.close()


def loader(dataset: Any, workers: int, method: str | None, **options: Any) -> Any:
    return DataLoader(
        dataset,
        num_workers=workers,
        multiprocessing_context=method,
        timeout=WATCHDOG_S * bool(workers),
        **options,
    )


def failure(batches: Any) -> Exception:
    """What ends an epoch; without tracebacks, which would keep the workers."""
    try:
        list(batches)
    except Exception as error:
        error.__cause__ = error.__context__ = None
        return error.with_traceback(None)
    raise AssertionError("nothing failed")


@pytest.mark.parametrize(("workers", "method"), WORKERS)
def test_an_epoch(drives: list[Path], workers: int, method: str | None) -> None:
    """Also where the dataset was in use before the workers were started."""
    dataset = FrameDataset(drives[:2], topics=BOTH, offsets=(-1, 0))
    dataset.__getitems__([0, 30])
    expected = dataset.__getitems__(range(len(dataset)))
    seen = []
    own = {"collate_fn": dataset.collate} if workers else {}
    for batch in loader(dataset, workers, method, batch_size=7, shuffle=True, **own):
        for place, number in enumerate(batch["index"].tolist()):
            seen.append(number)
            for key in (LEFT, RIGHT, f"{LEFT}_is_pad", f"{RIGHT}_is_pad"):
                assert torch.equal(batch[key][place], expected[number][key])
            assert int(batch["stamp_ns"][place]) == expected[number]["stamp_ns"]
    assert sorted(seen) == list(range(len(dataset)))
    assert batch["stamp_ns"].dtype == torch.int64
    assert torch.equal(dataset[3][LEFT], expected[3][LEFT]), "and in the parent afterwards"


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_what_was_dropped_does_not_stop_workers(drives: list[Path]) -> None:
    """A worker that collects the parent's garbage must not wait for threads of its decoders."""
    dataset = FrameDataset(drives[0], topics=BOTH)
    frames = mp4ds.open(drives[0])[LEFT]
    video = av.open(frames.streams[0].video_path)
    video.streams.video[0].thread_type = "SLICE"
    video.streams.video[0].thread_count = 2
    next(video.decode(video=0))
    dropped: list[Any] = [dataset, frames, video]
    dataset[0], frames[0]
    dropped.append(dropped)  # so that it waits for the garbage collector
    gc.disable()
    try:
        del dataset, frames, video, dropped
        child = os.fork()
        if child == 0:
            signal.alarm(20)
            gc.collect()
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
    finally:
        gc.enable()
        gc.collect()


class Killer:
    """Kills the worker in which it runs."""

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        if sample["index"] == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return sample


def test_a_killed_worker_is_an_error(drives: list[Path]) -> None:
    dataset = FrameDataset(drives[0], topics=[LEFT], transform=Killer())
    # one batch ahead: none is still to be taken from a worker when it is killed
    error = failure(loader(dataset, 2, "fork", batch_size=2, prefetch_factor=1))
    assert isinstance(error, RuntimeError)
    assert re.search(r"worker.*(killed|exited)", str(error))


# ---------------------------------------------------------------- damage


@pytest.fixture
def damaged(drives: list[Path], tmp_path: Path) -> Path:
    """A dataset with zeros in a frame of the right camera."""
    drive = tmp_path / "drive"
    shutil.copytree(drives[0], drive)
    (video,) = drive.glob("right*.mp4")
    data = bytearray(video.read_bytes())
    from mp4ds.video.mp4 import read_sample_table

    with video.open("rb") as file:
        table = read_sample_table(file, len(data), "")
    start, size = int(table.places[BROKEN]), int(table.sizes[BROKEN])
    data[start : start + size] = bytes(size)
    video.write_bytes(data)
    return drive


BROKEN = 2 * GOP


@pytest.mark.parametrize(("workers", "method"), WORKERS[:2])
def test_damage_is_named(damaged: Path, workers: int, method: str | None) -> None:
    dataset = FrameDataset(damaged, topics=[RIGHT])
    assert dataset[0][RIGHT].shape == (3, 48, 64)
    error = failure(loader(dataset, workers, method, batch_size=8))
    last = str(error).strip().splitlines()[-1]
    assert f"{damaged}, topic {RIGHT}: " in last
    assert f"frame {BROKEN} of {RIGHT} (stamp " in last
    assert last.endswith("[decode-failed].")
    assert isinstance(error, SampleError)
    assert isinstance(error, mp4ds.Mp4dsError)


@pytest.mark.parametrize(
    "error",
    [
        mp4ds.SourceError("drive", "is odd", "Fix it."),
        mp4ds.TargetExistsError("drive"),
        mp4ds.VersionError("drive", "9.0", "1.0"),
        mp4ds.VideoError("decode-failed", "drive", "is odd"),
        mp4ds.WriteError("drive", OSError(28, "No space left on device")),
        mp4ds.PartsFailedError("drive", [("0001", "is odd")], 3, 2),
        SampleError("is odd"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_come_through_processes(error: mp4ds.Mp4dsError) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)


def test_a_missing_video_is_named(damaged: Path) -> None:
    (video,) = damaged.glob("right*.mp4")
    video.unlink()
    with pytest.raises(SampleError, match=f"^{damaged}, topic {RIGHT}.*{video.name}.*file-missing"):
        FrameDataset(damaged, topics=[RIGHT])[0]
    with pytest.raises(SampleError, match=f"^{damaged}, topic {RIGHT}.*{video.name}"):
        next(iter(FrameStream(damaged, topics=[RIGHT])))


# ---------------------------------------------------------------- streams


def indices(samples: Any) -> list[int]:
    return [int(sample["index"]) for sample in samples]


def test_a_stream_in_order(drives: list[Path]) -> None:
    """The same samples as by number."""
    stream = FrameStream(drives[:2], topics=BOTH, shuffle=False, window=5)
    dataset = FrameDataset(drives[:2], topics=BOTH)
    samples = list(stream)
    assert indices(samples) == list(range(len(dataset))) == list(range(stream.samples))
    for sample, other in zip(samples, dataset.__getitems__(range(len(dataset))), strict=True):
        assert list(sample) == list(other)
        for key, value in sample.items():
            assert torch.equal(torch.as_tensor(value), torch.as_tensor(other[key]))


def test_windows_begin_with_key_frames(drives: list[Path]) -> None:
    stream = FrameStream(drives, topics=[LEFT], window=GOP, seed=3)
    numbers = indices(stream)
    assert sorted(numbers) == list(range(3 * FRAMES))
    starts = [b for a, b in zip([-2, *numbers], numbers, strict=False) if b != a + 1]
    for start in starts:
        with mp4ds.open(drives[start // FRAMES]) as dataset:
            path = dataset[LEFT].streams[0].video_path
        with av.open(str(path)) as video:
            keys = [packet.is_keyframe for packet in video.demux(video=0) if packet.size]
        assert keys[start % FRAMES]
    assert len(starts) > 3


def test_epochs_differ_and_repeat(drives: list[Path]) -> None:
    def order(epoch: int, **options: Any) -> list[int]:
        stream = FrameStream(drives, topics=[LEFT], window=GOP, **options)
        stream.set_epoch(epoch)
        return indices(stream)

    assert order(0) == order(0) != order(1)
    assert order(0) != order(0, seed=1)
    mixed = order(0, buffer=20)
    assert mixed == order(0, buffer=20) != order(0)
    assert sorted(mixed) == sorted(order(0))


@pytest.mark.parametrize("drop_last", [False, True])
@pytest.mark.parametrize(
    ("workers", "method", "ranks"),
    [
        (0, None, 5),
        pytest.param(2, "fork", 2, marks=pytest.mark.slow),
        pytest.param(1, "spawn", 3, marks=pytest.mark.slow),
    ],
)
def test_processes_of_a_training_get_equal_numbers(
    drives: list[Path], workers: int, method: str | None, ranks: int, drop_last: bool
) -> None:
    total, shares = 3 * FRAMES, ranks * max(1, workers)
    of_ranks = []
    for rank in range(ranks):
        share: dict[str, Any] = {"rank": rank, "world_size": ranks, "drop_last": drop_last}
        stream = FrameStream(drives, topics=[LEFT], window=GOP, **share)
        batches = loader(stream, workers, method, batch_size=4)
        of_ranks.append([int(number) for batch in batches for number in batch["index"]])
    assert {len(numbers) for numbers in of_ranks} == {
        max(1, workers) * (total // shares if drop_last else -(-total // shares))
    }
    seen = Counter(number for numbers in of_ranks for number in numbers)
    if drop_last:
        assert set(seen.values()) == {1}
        assert total - len(seen) < shares
    else:
        assert set(seen) == set(range(total))
        assert max(seen.values()) <= 2


@pytest.mark.parametrize("buffer", [0, 7])
@pytest.mark.parametrize("share", [{}, {"rank": 1, "world_size": 2}])
def test_an_epoch_goes_on_where_it_stood(
    drives: list[Path], buffer: int, share: dict[str, Any]
) -> None:
    def stream() -> FrameStream:
        return FrameStream(drives[:2], topics=[LEFT], window=GOP, seed=1, buffer=buffer, **share)

    first = stream()
    first.set_epoch(3)
    whole = [(sample["index"], sample[LEFT]) for sample in first]
    for stop in (0, 1, 5, len(whole) - 2, len(whole)):
        first, other = stream(), stream()
        first.set_epoch(3)
        given = indices(islice(iter(first), stop))
        state = json.loads(json.dumps(first.state_dict()))
        other.load_state_dict(state)
        assert other.state_dict() == state
        rest = [(sample["index"], sample[LEFT]) for sample in other]
        assert given + [index for index, _ in rest] == [index for index, _ in whole]
        for (_, image), (_, expected) in zip(rest, whole[stop:], strict=True):
            assert torch.equal(image, expected)
        assert indices(other) == [index for index, _ in whole]  # from the beginning again


@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated")  # torchdata still calls it
@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_torchdata_keeps_where_an_epoch_stands(drives: list[Path], workers: int) -> None:
    stateful = pytest.importorskip("torchdata.stateful_dataloader")

    def batches() -> Any:
        stream = FrameStream(drives, topics=[LEFT], window=GOP, buffer=5)
        context = "fork" if workers else None
        return stateful.StatefulDataLoader(
            stream, batch_size=4, num_workers=workers, multiprocessing_context=context
        )

    def numbers(found: Any) -> list[list[int]]:
        return [batch["index"].tolist() for batch in found]

    whole = numbers(batches())
    first, second = batches(), batches()
    given = numbers(islice(iter(first), 5))
    second.load_state_dict(first.state_dict())
    assert given + numbers(second) == whole


def test_workers_that_stay_learn_of_the_epoch(drives: list[Path]) -> None:
    stream = FrameStream(drives, topics=[LEFT], window=GOP)
    batches = loader(stream, 1, "fork", batch_size=None, persistent_workers=True)
    orders = []
    for epoch in (0, 1, 0):
        stream.set_epoch(epoch)
        orders.append(indices(batches))
    assert orders[0] == orders[2] != orders[1]


# ---------------------------------------------------------------- torchcodec


@pytest.fixture
def torchcodec() -> None:
    try:
        import torchcodec.decoders  # noqa: F401
    except (ImportError, OSError, RuntimeError) as error:
        pytest.skip(f"torchcodec cannot be used: {error}")


@pytest.mark.usefixtures("torchcodec")
def test_torchcodec_gives_the_same_frames(drives: list[Path]) -> None:
    """The right ones, in colours that are nearly the same."""
    options: dict[str, Any] = {"topics": BOTH, "offsets": (0, -2), "crop": (8, 4, 32, 24)}
    ours = FrameDataset(drives[0], **options)
    theirs = FrameDataset(drives[0], **options, backend="torchcodec")
    wanted = [11, 2, 22, 2]
    for a, b in zip(ours.__getitems__(wanted), theirs.__getitems__(wanted), strict=True):
        assert (a["stamp_ns"], a["index"]) == (b["stamp_ns"], b["index"])
        for topic in BOTH:
            assert a[topic].shape == b[topic].shape
            # decoders have chroma of half the resolution grow in their ways
            away = torch.nn.functional.avg_pool2d(a[topic].float() - b[topic].float(), 2)
            assert away.abs().mean() < 4


@pytest.mark.usefixtures("torchcodec")
@pytest.mark.parametrize("codec", ["h264", "h265", "av1", "av1-10bit"])
def test_torchcodec_gives_lossy_videos_their_contrast_or_nothing(
    codec: str, tmp_path: Path
) -> None:
    paths = SOURCES["mcap-ros2-none"](tmp_path, camera(LEFT, "rgb8", 0))
    options = PackOptions(quality="crf=20", codec=codec)
    drive = mp4ds.pack(paths, tmp_path / "drive", options).dataset
    ours = FrameDataset(drive)[3][LEFT].float().mean(0).ravel()
    refusal = ""
    try:
        theirs = FrameDataset(drive, backend="torchcodec")[3][LEFT].float().mean(0).ravel()
    except mp4ds.OptionError as error:
        refusal = str(error)
    if codec.startswith("av1") and refusal:  # others tell their range by the pixel format, too
        assert "its full-range video as limited-range" in refusal
    else:
        assert np.polyfit(ours, theirs, 1)[0] == pytest.approx(1, abs=0.04)


@pytest.mark.usefixtures("torchcodec")
def test_torchcodec_refuses_what_it_would_show_wrongly(tmp_path: Path) -> None:
    drive = packed(tmp_path / "a", camera(LEFT, "bayer_rggb8", 0), quality="lossless")
    with pytest.raises(mp4ds.OptionError, match=r"bayer_rggb8 images .* layout mosaic8"):
        FrameDataset(drive, backend="torchcodec")[0]


@pytest.mark.usefixtures("torchcodec")
def test_torchcodec_never_shows_differences(with_views: Path) -> None:
    options: dict[str, Any] = {"topics": ["/right/image_raw"], "backend": "torchcodec"}
    with pytest.raises(mp4ds.OptionError, match="made of two videos"):
        FrameDataset(with_views, layer="exact", **options)[0]


# ---------------------------------------------------------------- the notebook


@pytest.mark.slow
def test_a_policy_learns_in_the_notebook(tmp_path: Path) -> None:
    notebook: Any = nbformat.read(ROOT / "examples/train.ipynb", 4)
    where = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=None, resources=where).execute()
    (last,) = notebook.cells[-1].outputs
    found = re.fullmatch(r"of 50 targets the policy reaches (\d+), random moves (\d+)\n", last.text)
    assert found
    assert int(found[1]) > 25 > int(found[2])
