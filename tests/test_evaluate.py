"""`mp4ds evaluate`: that its figures are those of a pack."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

import mp4ds
from coded_scenes import CODED
from commands import call, typed
from mp4ds.cli.report import print_evaluation
from mp4ds.errors import (
    OptionError,
    Refused,
    ScoringError,
    SourceError,
    TargetError,
    TargetExistsError,
)
from mp4ds.messages.encodings import ENCODINGS as ENCODING_TABLE
from mp4ds.messages.layouts import LAYOUTS
from mp4ds.packing.options import PackOptions
from mp4ds.plugins.demo import demo
from mp4ds.plugins.evaluating.evaluate import (
    EvaluateOptions,
    evaluate,
)
from mp4ds.plugins.evaluating.page import page
from mp4ds.plugins.evaluating.trials import (
    Cell,
    Evaluation,
    Setting,
    chosen,
    make_clip,
    open_cameras,
    recommend,
)
from mp4ds.video.codecs import QualityTarget
from mp4ds.video.scores import ScoreSummary
from scenes import TRAITS, Scene, odd_scene
from sources import ENCODINGS, SOURCES, scene, write_bag

ROOT = Path(__file__).parents[1]
TOPIC = "/cam/image_raw"
QUICK = EvaluateOptions(
    codecs=["h264"], presets=["ultrafast"], crf=["24"], frames=10, target="psnr=20",
    threads=1,
)  # fmt: skip

needs_vmaf = pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="needs imageio-ffmpeg"
)


def camera_scene(encoding: str, *, width: int = 96, frames: int = 10) -> Scene:
    return scene(encoding, frames=frames, width=width, height=64)


def recording(folder: Path, encoding: str = "rgb8", source: str = "bag-none", **size: Any) -> Path:
    return SOURCES[source](folder / "source", camera_scene(encoding, **size))[0]


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"codecs": ["vp9"]}, "`codecs` 'vp9'"),
        ({"codecs": []}, "`codecs`"),
        ({"presets": ["fastest"]}, "`presets` 'fastest'"),
        ({"codecs": ["h264"], "crf": ["60"]}, "0 settings"),
        ({"frames": 0}, "`frames` 0"),
        ({"start": -1.0}, "`start` -1"),
    ],
)
def test_options_that_are_wrong(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=said):
        evaluate(tmp_path, replace(QUICK, **changed), output=tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- recommendation


def cell(crf: int, score: float, size: float, cpu: float, preset: str = "fast") -> Cell:
    summary = ScoreSummary(score, score, score, score)
    return Cell(
        Setting("h264", preset, crf), 2 * cpu, cpu, 100, 1, size, size, 1, {"vmaf": summary},
        "none.png", 1, 1,
    )  # fmt: skip


def test_the_smallest_and_the_fastest_that_reach_the_target_are_recommended() -> None:
    cells = [
        cell(10, 99.9, 90, 9), cell(20, 99.6, 50, 8), cell(20, 99.55, 70, 2, "veryfast"),
        cell(30, 99.4, 20, 1),
    ]  # fmt: skip
    smallest, fastest = recommend([(cells, 99.5)], QualityTarget("vmaf", 99.5))
    assert (smallest.why, smallest.setting) == ("smallest", cells[1].setting)
    assert (fastest.why, fastest.setting) == ("fastest", cells[2].setting)
    assert smallest.options == "--quality crf=20 --codec h264 --preset fast"
    assert recommend([(cells, 99.95)], QualityTarget("vmaf", 99.5)) == []
    other = [replace(item, scores={"vmaf": ScoreSummary(99, 99, 99, 99)}) for item in cells]
    other[0] = cells[0]
    both = recommend([(cells, 99.5), (other, 99.5)], QualityTarget("vmaf", 99.5))
    assert {item.setting for item in both} == {cells[0].setting}


def packet_bytes(path: Path) -> int:
    with av.open(str(path)) as container:
        return sum(packet.size for packet in container.demux(video=0))


# ---------------------------------------------------------------- every kind of source


LOSSY = PackOptions(quality="crf=10", codec="h264")
PACKED = {"dataset": PackOptions(), "lossy dataset": LOSSY, "video": LOSSY}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", ["bag-lz4", "rosbag2-sqlite3-v9", "mcap-unindexed", *PACKED])
def test_every_kind_of_source(kind: str, tmp_path: Path) -> None:
    source = recording(tmp_path, "bayer_grbg8", "bag-none" if kind in PACKED else kind)
    if kind in PACKED:
        source = mp4ds.pack(source, tmp_path / "drive", PACKED[kind]).dataset
    if kind == "video":
        source = Path(shutil.copy(source / "cam_image_raw.mp4", tmp_path / "alone.mp4"))
    (camera,) = evaluate(source, QUICK, output=tmp_path / "out").cameras
    if kind != "video":  # which is no mosaic
        assert (camera.topic, camera.clip.encoding) == (TOPIC, "bayer_grbg8")
    assert camera.clip.image_size == (96, 64)
    assert camera.clip.frames == camera.clip.source_frames == 10
    assert camera.clip.rate == pytest.approx(30, rel=0.02)
    assert 25 < camera.cells[0].scores["psnr_y"].mean < 60


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("encoding", "width", "codec", "preset"),
    [
        *((name, 96, "h264", "ultrafast") for name in ("mono8", "bayer_rggb8", "yuv422")),
        ("rgb8", 97, "h264", "ultrafast"),
        ("rgb8", 96, "av1", "12"),
        ("rgb8", 96, "h265", "ultrafast"),
        ("jpeg-420", 96, "h264", "ultrafast"),
    ],
)
def test_the_videos_are_those_of_a_pack(
    encoding: str, width: int, codec: str, preset: str, tmp_path: Path
) -> None:
    """To the byte of their packets: a recommendation can be packed with."""
    is_jpeg = encoding in CODED
    path = tmp_path / "drive.bag"
    write_bag(path, CODED[encoding]() if is_jpeg else camera_scene(encoding, width=width))
    options = replace(QUICK, codecs=[codec], presets=[preset])
    (camera,) = evaluate(path, options, output=tmp_path / "out").cameras
    assert is_jpeg or camera.clip.image_size == (width, 64)
    assert any("--transcode" in note for note in camera.notes) == is_jpeg
    packing = PackOptions(quality="crf=24", codec=codec, preset=preset, jobs=1, transcode=is_jpeg)
    mp4ds.pack(path, tmp_path / "drive", packing)
    (video,) = (tmp_path / "drive").glob("*.mp4")
    assert packet_bytes(video) == camera.cells[0].size


@pytest.mark.parametrize(
    ("encoding", "changed", "said"),
    [
        ("mono16", {}, f"{TOPIC} has mono16 images"),
        ("rgb8", {"topics": ["/none"]}, "matches no topic"),
        ("rgb8", {"exclude": ["*"]}, "no camera"),
        ("", {}, "no such file"),
    ],
)
def test_nothing_to_evaluate(
    encoding: str, changed: dict[str, Any], said: str, tmp_path: Path
) -> None:
    source = recording(tmp_path, encoding) if encoding else tmp_path / "none.bag"
    with pytest.raises((OptionError, SourceError), match=said):
        evaluate(source, replace(QUICK, **changed), output=tmp_path / "out")


def encoded(name: str) -> Scene:
    return camera_scene(name)


@pytest.mark.one_in(5)
@pytest.mark.parametrize(
    ("make", "name"),
    [
        *((encoded, name) for name in ENCODINGS),
        *((lambda name: CODED[name](), name) for name in CODED),
        *((odd_scene, trait) for trait in TRAITS),
    ],
)
def test_all_that_cameras_send_is_tried_or_told(
    make: Callable[[str], Scene], name: str, tmp_path: Path
) -> None:
    made = make(name)
    write_bag(tmp_path / "drive.bag", made)
    with open_cameras(tmp_path / "drive.bag") as (cameras, left_out):
        said = [*left_out.values()]
        for camera in cameras:
            try:
                clip = make_clip(camera, chosen(camera.times, 0, 150), tmp_path)
            except Refused as reason:
                said.append(str(reason))
                continue
            sent = sum("camera_info" not in message.topic for message in made.messages)
            assert 0 < clip.frames <= clip.frames + clip.left_out <= sent
            assert make is not encoded or (clip.frames, clip.left_out) == (10, 0)
            with closing(clip.open(tmp_path)) as opened:
                shapes = {tuple(plane.shape for plane in planes) for planes in opened}
            columns, rows = clip.size
            assert shapes == {((rows, columns), *[(rows // 2, columns // 2)] * 2)}
            ticks = np.load(tmp_path / "ticks.npy").tolist()
            assert ticks == sorted(set(ticks))
    if make is encoded:
        lossy = ENCODING_TABLE[name].lossy
        assert bool(said) == (lossy is None or bool(LAYOUTS[lossy].parameters))
        assert all(f"has {name} images" in sentence for sentence in said)
    if name.startswith(("depth-", "video-")):
        assert said


# ---------------------------------------------------------------- the demo, looked over


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("evaluated") / "demo.bag"
    demo(path, seconds=0.8)
    return path


WHOLE = EvaluateOptions(
    codecs=["av1", "h264"], presets=["12", "ultrafast"], crf=["8", "40"], frames=12,
    target="vmaf=95", topics=["/left/*"], threads=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def whole(bag: Path) -> Evaluation:
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        pytest.skip("needs imageio-ffmpeg")
    return evaluate(bag, WHOLE, output=bag.parent / "out")


def test_figures_are_sound(whole: Evaluation) -> None:
    (camera,) = whole.cameras
    assert [item.setting.name for item in camera.cells] == [
        "av1 12 crf 8", "av1 12 crf 40", "h264 ultrafast crf 8", "h264 ultrafast crf 40",
    ]  # fmt: skip
    for good, bad in (camera.cells[:2], camera.cells[2:]):
        assert good.size > bad.size
        assert good.kbps > bad.kbps
        for metric in ("vmaf", "psnr_y", "ssim"):
            assert good.scores[metric].mean > bad.scores[metric].mean
            assert good.scores[metric].mean < camera.ceiling[metric].mean
    for item in camera.cells:
        vmaf = item.scores["vmaf"]
        assert vmaf.minimum <= vmaf.percentile_5 <= vmaf.mean
        assert vmaf.minimum <= vmaf.harmonic_mean <= vmaf.mean
        assert item.encode_cpu_seconds > 0
        assert item.encode_seconds > 0
        assert item.kbps == pytest.approx(item.frame_bytes * 8 * 15 / 1000, rel=0.02)
        assert item.whole_bytes == pytest.approx(item.frame_bytes * 12)


def test_the_recommendation_reaches_the_target(whole: Evaluation) -> None:
    (camera,) = whole.cameras
    assert [item.why for item in camera.recommended] == ["smallest", "fastest"]
    assert camera.reachable == 95
    for item in camera.recommended:
        assert item.score >= 95
        assert item.setting.crf == 8


def test_files(whole: Evaluation) -> None:
    folder, (camera,) = whole.output, whole.cameras
    lines = list(csv.DictReader((folder / "evaluation.csv").read_text().splitlines()))
    assert len(lines) == len(camera.cells)
    for line, item in zip(lines, camera.cells, strict=True):
        assert (line["codec"], int(line["crf"])) == (item.setting.codec, item.setting.crf)
        assert float(line["vmaf_mean"]) == pytest.approx(item.scores["vmaf"].mean, abs=1e-5)
        assert float(line["kbps"]) == pytest.approx(item.kbps, abs=1e-5)
    values = json.loads((folder / "evaluation.json").read_text())
    assert values["options"]["frames"] == 12
    assert len(values["cameras"][0]["cells"]) == len(camera.cells)
    for kind in ("bitrate", "time"):
        name = f"left_image_raw-{kind}"
        root = ET.fromstring((folder / "plots" / f"{name}.svg").read_text())
        assert len(root.findall(".//{*}circle/{*}title")) == len(camera.cells)
    with Image.open(folder / camera.ground_truth) as image:
        assert image.size == (256, 192)
        truth = np.asarray(image, np.float64)
    near, far = (
        np.abs(np.asarray(Image.open(folder / item.picture), np.float64) - truth).mean()
        for item in camera.cells[2:]
    )
    assert 0 < near < far


def test_the_page_needs_nothing_else(whole: Evaluation) -> None:
    text = (whole.output / "index.html").read_text()
    references = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert len(references) == 1 + len(whole.cameras[0].cells)
    assert all(item.startswith("data:image/png;base64,") for item in references)
    assert text.count("<svg ") == 2
    assert "http" not in text.replace("http://www.w3.org/2000/svg", "")
    for tag in ("p", "table", "tr", "td", "figure", "svg", "div", "h2"):
        assert len(re.findall(rf"<{tag}[ >]", text)) == text.count(f"</{tag}>")


def test_force_replaces_another_one(tmp_path: Path) -> None:
    path, out = recording(tmp_path), tmp_path / "out"
    evaluate(path, replace(QUICK, crf=["20:22"]), output=out)
    with pytest.raises(TargetExistsError):
        evaluate(path, QUICK, output=out)
    again = evaluate(path, replace(QUICK, force=True), output=out)
    assert again.tried == len(list((out / "pictures").glob("*crf*"))) == 1
    (out / "own.txt").touch()
    with pytest.raises(TargetError):
        evaluate(path, replace(QUICK, force=True), output=out)
    assert (out / "own.txt").exists()


# ---------------------------------------------------------------- what goes wrong


def no_ffmpeg() -> None:
    raise ScoringError("VMAF needs an ffmpeg with libvmaf.")


def test_without_libvmaf(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("mp4ds.plugins.evaluating.evaluate.find_ffmpeg", no_ffmpeg)
    path = recording(tmp_path)
    with pytest.raises(ScoringError, match="`target` psnr"):
        evaluate(path, replace(QUICK, target="vmaf=99.5"), output=tmp_path / "out")
    found = evaluate(path, QUICK, output=tmp_path / "out")
    (camera,) = found.cameras
    assert set(camera.cells[0].scores) == {"psnr_y", "psnr_cb", "psnr_cr", "ssim"}
    assert camera.recommended
    assert found.versions.pop("vmaf") == "none"
    print_evaluation(found)
    for text in (page(found, found.output), capsys.readouterr().out):
        assert "PSNR Y" in text
        assert not re.search(r"\bVMAF\b|harmonic|5 %|>least<", text)


# ---------------------------------------------------------------- command line, documents


def test_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = recording(tmp_path)
    monkeypatch.chdir(tmp_path)
    plain = ("--codecs", "h264", "--presets", "ultrafast", "--frames", "10", "--crf", "24")
    given = ("evaluate", path, *plain, "--target", "psnr=20")
    out = call(*given).out
    assert re.search(r"h264 +ultrafast +24 ", out)
    assert "smallest: --quality crf=24 --codec h264 --preset ultrafast" in out
    assert (tmp_path / "drive_evaluation" / "index.html").is_file()
    assert out.rstrip().endswith("index.html: 1 setting tried")
    values = json.loads(call(*given, "--json", "--force").out)
    assert values["tried"] == 1
    for wrong in (("--crf", "x"), ("--target", "x=1"), ("--codecs", "vp9")):
        done = call(*given, *wrong)
        assert done.code == 2
        assert done.err.startswith(f"mp4ds: {wrong[0]}")


@pytest.mark.slow
@needs_vmaf
def test_the_commands_of_the_page(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "evaluate.md").read_text()
    shells = "".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL))
    lines = re.findall(r"^mp4ds .*", shells, re.MULTILINE)
    assert sum(line.startswith("mp4ds evaluate ") for line in lines) == 1
    for line in lines:
        done = typed(line, tmp_path)
        assert done.code == 0, done.err
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    out = subprocess.check_output([sys.executable, "-c", code], cwd=tmp_path, text=True)
    assert out.count("av1 12 crf 24") == 2
