"""Packing that keeps a score: that every window has it, and what is done where it cannot."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray

import mp4ds
from compare import compare
from definitions import IMAGE
from in_parts import InlineExecutor, leftovers, use
from mp4ds import yamlio
from mp4ds.errors import ScoringError
from mp4ds.format.fields import Quality
from mp4ds.packing.options import PackOptions
from mp4ds.plugins.demo import demo
from mp4ds.plugins.info import info
from mp4ds.video.scores import find_ffmpeg, scores_of
from round_trips import unpacked
from scenes import Record, instant, together
from sources import SOURCES

TOPIC = "/cam/image_raw"
WIDTH, HEIGHT = 64, 48
WINDOW = 10
QUICK: dict[str, Any] = {"codec": "h264", "preset": "ultrafast", "gop": WINDOW}

needs_vmaf = pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs imageio-ffmpeg"
)


@pytest.fixture(autouse=True)
def executor(monkeypatch: pytest.MonkeyPatch) -> InlineExecutor:
    inline = InlineExecutor()
    use(monkeypatch, inline)
    monkeypatch.setattr("mp4ds.packing.windows._FRAMES", WINDOW)
    return inline


# ---------------------------------------------------------------- recordings


def luma(n: int, noise: float) -> NDArray[np.uint8]:
    """A pattern that moves, with noise of a standard deviation, shape (HEIGHT, WIDTH)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    smooth = 120 + 60 * np.sin((x + 2 * n) / 9) + 30 * np.sin((y - n) / 7)
    rng = np.random.default_rng(n)
    return np.clip(smooth + rng.normal(0, noise, smooth.shape), 0, 255).astype(np.uint8)


def recording(folder: Path, noises: list[float], source: str = "mcap-ros2-none") -> list[Path]:
    """Images of nv12, whose luma is what is encoded; with a noise for each window."""
    rng = np.random.default_rng(0)
    groups = []
    for n in range(WINDOW * len(noises)):
        stamp, log = instant(n, rng)
        data = np.full((HEIGHT * 3 // 2, WIDTH), 128, np.uint8)
        data[:HEIGHT] = luma(n, noises[n // WINDOW])
        image = {
            "header": {"seq": n, "stamp": stamp, "frame_id": "cam"},
            "height": HEIGHT, "width": WIDTH, "encoding": "nv12", "step": WIDTH,
            "data": data.ravel(),
        }  # fmt: skip
        groups.append([Record(TOPIC, IMAGE, log, image)])
    return SOURCES[source](folder / "source", together(groups))


def decoded(video: Path) -> Iterator[NDArray[np.uint8]]:
    """The luma of each frame of a video."""
    with av.open(str(video)) as container:
        for frame in container.decode(video=0):
            if frame.format.name == "yuv420p10le":  # of the limited range
                wide = np.frombuffer(bytes(frame.planes[0]), "<u2").reshape(frame.height, -1)
                yield np.rint(wide[:, : frame.width] / 4).astype(np.uint8)
            else:
                yield frame.to_ndarray(format="yuv420p")[: frame.height]


def own_psnr(video: Path, noises: list[float]) -> NDArray[np.float64]:
    """PSNR of each frame, by its definition."""
    found = []
    for n, made in enumerate(decoded(video)):
        error = np.mean((luma(n, noises[n // WINDOW]).astype(float) - made) ** 2)
        found.append(min(60.0, 10 * np.log10(255**2 / max(error, 1e-9))))
    return np.array(found)


def quality_of(dataset: Path) -> Quality:
    with mp4ds.open(dataset) as opened:
        (stream,) = opened.streams
        assert stream.sidecar.video.quality is not None
        return stream.sidecar.video.quality


def check_psnr(dataset: Path, noises: list[float], target: float) -> Quality:
    """What the sidecar tells is what the video has, and what was promised."""
    found = quality_of(dataset)
    own = own_psnr(dataset / "cam_image_raw.mp4", noises)
    assert len(own) == WINDOW * len(noises)
    windows = own.reshape(-1, WINDOW).mean(axis=1)
    assert np.abs(found.decode(len(own)) - own).max() <= 0.0051
    assert found.mean == pytest.approx(own.mean(), abs=0.01)
    assert found.p5 == pytest.approx(np.percentile(own, 5), abs=0.01)
    assert found.min == pytest.approx(own.min(), abs=0.01)
    assert found.worst_window == pytest.approx(windows.min(), abs=0.01)
    assert (found.metric, found.target, found.windows) == ("psnr", target, len(windows))
    assert own.mean() >= target - 0.005
    assert windows.min() >= target - 0.505
    return found


# ---------------------------------------------------------------- the promise


CHANGING = [0.0, 0.0, 8.0, 8.0, 0.0, 0.0]


@pytest.mark.parametrize("codec", ["h264", "h265", "av1", "av1-10bit"])
def test_every_window_has_the_score(codec: str, tmp_path: Path) -> None:
    """Windows of other difficulty have another crf, and one video."""
    preset = "12" if codec.startswith("av1") else "ultrafast"
    paths = recording(tmp_path, CHANGING)
    options = PackOptions(quality="psnr=40", codec=codec, preset=preset, gop=WINDOW)
    summary = mp4ds.pack(paths, tmp_path / "dataset", options)
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    found = check_psnr(tmp_path / "dataset", CHANGING, 40)
    assert found.reencoded >= 1
    (topic,) = (topic for topic in summary.topics if topic.topic == TOPIC)
    assert str(found) in topic.notes
    assert f"{TOPIC}: {found}" in info(tmp_path / "dataset").notes
    with mp4ds.open(tmp_path / "dataset") as dataset:
        sidecar = dataset.streams[0].sidecar
        assert (dataset.manifest.profile, sidecar.profile) == ("psnr=40", "psnr=40")
        assert sidecar.video.options["g"] == str(WINDOW)
    with av.open(str(tmp_path / "dataset/cam_image_raw.mp4")) as container:
        keys = [n for n, p in enumerate(container.demux(video=0)) if p.size and p.is_keyframe]
    assert set(range(0, WINDOW * len(CHANGING), WINDOW)) <= set(keys)


def test_in_parts_too_and_each_time_alike(tmp_path: Path, executor: InlineExecutor) -> None:
    """Parts begin with the same crf, and what comes out does not depend on an interruption."""
    noises = [0.0, 8.0, 0.0, 0.0, 4.0, 0.0]
    paths = recording(tmp_path, noises)
    options = PackOptions(quality="psnr=40", window=2 * WINDOW, **QUICK)
    mp4ds.pack(paths, tmp_path / "dataset", options)
    assert len([name for name in executor.ran if not name.startswith("source")]) == 3
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    found = check_psnr(tmp_path / "dataset", noises, 40)

    def fails(name: str) -> bool:
        return name == "00001"

    broken = InlineExecutor(fails)
    with pytest.MonkeyPatch.context() as patch:
        use(patch, broken)
        with pytest.raises(mp4ds.PartsFailedError):
            mp4ds.pack(paths, tmp_path / "again", options)
    mp4ds.pack(paths, tmp_path / "again", options)
    assert quality_of(tmp_path / "again") == found
    videos = [tmp_path / name / "cam_image_raw.mp4" for name in ("dataset", "again")]
    assert videos[0].read_bytes() == videos[1].read_bytes()
    assert leftovers(tmp_path) == []


# ---------------------------------------------------------------- out of reach


@pytest.mark.parametrize("window", [None, 2 * WINDOW])
def test_what_cannot_have_it_later_on_is_lossless(
    window: int | None,
    tmp_path: Path,
) -> None:
    """The first images have it, later ones do not: with parts, only theirs are lossless."""
    noises = [0.0, 0.0, 30.0, 0.0, 0.0, 0.0]
    paths = recording(tmp_path, noises)
    options = PackOptions(
        quality="psnr=55", window=window, **{**QUICK, "codec": "av1", "preset": "12"}
    )
    summary = mp4ds.pack(paths, tmp_path / "dataset", options)
    (topic,) = (topic for topic in summary.topics if topic.topic == TOPIC)
    assert topic.frames == topic.messages == WINDOW * len(noises)
    assert any("kept lossless: psnr=55 is out of reach" in note for note in topic.notes)
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(paths, unpacked(tmp_path, "mcap"), ignore_pixels=[TOPIC]) == []
    with mp4ds.open(tmp_path / "dataset") as dataset:
        profiles = {stream.sidecar.profile: len(stream) for stream in dataset.streams}
    assert profiles == ({"lossless": 60} if window is None else {"psnr=55": 40, "lossless": 20})


# ---------------------------------------------------------------- what is written is checked


def test_scores_that_do_not_come_to_what_is_told(tmp_path: Path) -> None:
    mp4ds.pack(recording(tmp_path, [0.0]), tmp_path / "d", PackOptions(quality="psnr=40", **QUICK))
    path = tmp_path / "d/cam_image_raw.yaml"
    document = yamlio.load(path.read_bytes(), "it")
    for change, code in (
        ({"mean": 50.0}, "scores-invalid"),
        ({"scores": {"start": 1, "step": 0, "values": ""}}, "scores-invalid"),
        ({"target": 41.0}, "model-invalid"),
        ({"reencoded": 9}, "model-invalid"),
        ({"metric": "msssim"}, "schema-invalid"),
    ):
        quality = {**document["video"]["quality"], **change}
        changed = {**document, "video": {**document["video"], "quality": quality}}
        changed.pop("checksum", None)
        path.write_bytes(yamlio.dump(changed))
        assert [problem.code for problem in mp4ds.validate(path)] == [code]


# ---------------------------------------------------------------- VMAF


@needs_vmaf
def test_vmaf(tmp_path: Path) -> None:
    """The scores are those of libvmaf; a scene at rest cannot have more than its ceiling."""
    noises = [2.0, 6.0]
    paths = recording(tmp_path, noises)
    mp4ds.pack(paths, tmp_path / "dataset", PackOptions(quality="vmaf=93", **QUICK))
    found = quality_of(tmp_path / "dataset")
    assert found.mean >= 93
    assert found.worst_window >= 92.5
    chroma = np.full((2, HEIGHT // 2, WIDTH // 2), 128, np.uint8)
    originals = [(luma(n, noises[n // WINDOW]), *chroma) for n in range(WINDOW * len(noises))]
    made = [(y, *chroma) for y in decoded(tmp_path / "dataset/cam_image_raw.mp4")]
    own = scores_of(originals, made, ["vmaf"], ffmpeg=find_ffmpeg(), before=originals[1])["vmaf"]
    # but for the first and last frames of windows, which tell less of what moves
    inner = np.arange(len(own)) % WINDOW
    same = (inner > 0) & (inner < WINDOW - 1)
    assert np.abs(found.decode(len(own)) - own)[same].max() < 0.02
    assert found.mean == pytest.approx(own.mean(), abs=0.5)


def test_without_libvmaf_it_is_said_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = recording(tmp_path, [0.0])
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ScoringError, match=r"pip install 'mp4ds\[vmaf\]'"):
        mp4ds.pack(paths, tmp_path / "dataset", PackOptions(quality="vmaf=95"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["source"]


@needs_vmaf
@pytest.mark.slow
def test_vmaf_of_a_noisy_camera_is_measured_against_its_ceiling(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The demonstration: the few samples before the first window do not decide that it cannot."""
    monkeypatch.undo()
    demo(tmp_path / "demo.bag", seconds=2)
    options = PackOptions(quality="vmaf=99.5", topics=["/left/image_raw"])
    summary = mp4ds.pack(tmp_path / "demo.bag", tmp_path / "dataset", options)
    found = quality_of(tmp_path / "dataset")
    assert (found.windows, found.limited) == (1, 1)
    assert 98.5 < found.mean < 99.5
    (topic,) = (topic for topic in summary.topics if topic.frames)
    assert "limited to 0.5 below the score of the originals against themselves" in topic.notes[0]
