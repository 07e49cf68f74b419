"""The report: its figures and columns, its stills, and what it may replace."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

import mp4ds
from coded_scenes import CODED
from commands import call
from mp4ds.errors import OptionError, SourceError
from mp4ds.plugins.reporting.report import ReportOptions, report
from mp4ds.plugins.reporting.stills import Look
from report_scenes import (
    COLOUR,
    DEPTH,
    FRAMES,
    blocks,
    pack_cameras,
    two_cameras,
)
from sources import COMMON, ENCODINGS, scene


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset without a report; not to be changed."""
    return pack_cameras(tmp_path_factory.mktemp("report"), two_cameras())


@pytest.fixture
def copy(drive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(drive, tmp_path / "drive"))


def data_of(folder: Path) -> dict[str, Any]:
    """What data.js hands to the page."""
    text = (folder / "report" / "data.js").read_text()
    match = re.fullmatch(r"/\* made by mp4ds report \*/\nmp4dsReport\.dataset\((.*)\);\n", text)
    assert match
    return dict(json.loads(match[1]))


def columns_of(folder: Path, number: int) -> dict[str, Any]:
    """What columns-N.js hands to the page."""
    text = (folder / "report" / f"columns-{number}.js").read_text()
    match = re.fullmatch(rf"mp4dsReport\.columns\({number}, (.*)\);\n", text)
    assert match
    return dict(json.loads(match[1]))


def unpacked(packed: dict[str, Any], count: int) -> list[int]:
    """A column, by the words of `pack_column` and Python's integers."""
    residuals = np.frombuffer(base64.b64decode(packed["values"]), f"<i{packed['size']}").tolist()
    assert len(residuals) == count - 1
    values = [int(packed["start"])]
    for residual in residuals:
        value = values[-1] + int(packed["step"]) + residual
        values.append((value + 2**63) % 2**64 - 2**63)
    return values


def digests(folder: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.glob("*.*")}


# ---------------------------------------------------------------- calibrations


# ---------------------------------------------------------------- the page's files


def test_the_report_of_a_dataset(copy: Path) -> None:
    before = digests(copy)
    summary = report(copy)
    assert [(c.topic, c.plays) for c in summary.cameras] == [(DEPTH, "stills"), (COLOUR, "video")]
    assert "ffv1" in summary.cameras[0].note
    assert summary.problems == []
    assert summary.index == copy / "index.html"
    assert mp4ds.validate(copy, deep=True) == []
    assert {name: digest for name, digest in digests(copy).items() if name in before} == before
    assert sorted(p.name for p in copy.iterdir() if p.name not in before) == [
        "index.html",
        "report",
    ]
    data = data_of(copy)
    with mp4ds.open(copy) as dataset:
        for number, camera in enumerate(data["cameras"]):
            stream, columns = dataset[camera["name"]], columns_of(copy, number)
            count = columns["frames"]
            assert count == len(stream) == camera["frames"]
            assert unpacked(columns["stamp"], count) == stream.stamps.tolist()
            assert unpacked(columns["log_time"], count) == stream.log_times.tolist()
            with av.open(str(stream.streams[0].video_path)) as container:
                ticks = [p.pts for p in container.demux(video=0) if p.pts is not None]
            assert unpacked(columns["ticks"], count) == ticks
    _, colour = data["cameras"]
    assert len(colour["calibrations"]) == 1


def test_topics_and_their_sizes(copy: Path) -> None:
    report(copy)
    with mp4ds.open(copy) as dataset:
        times = {c.topic: dataset.times()[c.id] for c in dataset.channels if c.topic == "/tf"}
    rows = {row["topic"]: row for row in data_of(copy)["topics"]}
    assert set(rows) >= {COLOUR, DEPTH, "/imu", "/tf", "/chatter", "/front/camera_info"}
    assert rows["/chatter"]["messages"] == FRAMES
    assert rows["/tf"]["rate_hz"] == pytest.approx(
        (FRAMES - 1) * 1e9 / (times["/tf"][-1] - times["/tf"][0])
    )
    stored = sum((copy / f"front_image_raw.{end}").stat().st_size for end in ("mp4", "yaml"))
    assert rows[COLOUR]["bytes"] == stored
    assert rows["/front/camera_info"]["stored"] == "in front_image_raw.yaml"


def test_a_report_elsewhere_plays_the_videos_where_they_are(copy: Path, tmp_path: Path) -> None:
    odd = tmp_path / "a #1 100% ü?"
    odd.mkdir()
    before = digests(copy)
    summary = report(copy, ReportOptions(output=odd / "page"))
    assert digests(copy) == before
    assert not (copy / "report").exists()
    assert summary.index == odd / "page" / "index.html"
    depth, colour = data_of(odd / "page")["cameras"]
    assert depth["stills"][0] == {"frame": 0, "file": "report/stills/depth_image_raw-0.jpg"}
    assert colour["video"] == "../../drive/front_image_raw.mp4"
    report(odd / "page" / ".." / ".." / "drive", ReportOptions(output=tmp_path / "x"))
    moved = shutil.move(copy, odd / "dri:ve")
    report(moved, ReportOptions(output=tmp_path / "y"))
    url = data_of(tmp_path / "y")["cameras"][1]["video"]
    assert url == "../a%20%231%20100%25%20%C3%BC%3F/dri%3Ave/front_image_raw.mp4"


def test_a_pair_alone_needs_a_place(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="`output`"):
        report(copy / "front_image_raw.mp4")
    summary = report(copy / "front_image_raw.mp4", ReportOptions(output=tmp_path / "pair"))
    assert [camera.topic for camera in summary.cameras] == [COLOUR]


def test_lossless_cameras_play_their_views(with_views: Path, tmp_path: Path) -> None:
    """With both videos and with the views alone; what is said of sizes is of the files here."""
    dataset, stored = Path(shutil.copytree(with_views, tmp_path / "drive")), []
    for _ in range(2):
        summary = report(dataset)
        assert [(camera.plays, camera.note) for camera in summary.cameras] == [("video", "")] * 2
        data = data_of(dataset)
        names = [camera["video"] for camera in data["cameras"]]
        assert names == ["left_image_raw.mp4", "right_image_raw.mp4"]
        files = [path for path in dataset.glob("*.*") if path.stem not in ("dataset", "index")]
        own = sum(path.stat().st_size for path in files)
        assert data["summary"]["bytes"] == own
        stored.append([camera["stored"] for camera in data["cameras"]])
        for path in dataset.glob("*.exact.mp4"):
            path.unlink()
    both, views = stored
    assert all(re.fullmatch(r"av1 visual, \w+ lossless", one) for one in both)
    assert views == ["av1 visual"] * 2
    assert "exact layer not here" in "".join(data["notes"])


def test_a_remote_dataset_is_refused(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mp4ds.plugins.reporting.report.remote", lambda path: path)
    with pytest.raises(SourceError, match="not on this machine"):
        report(copy, ReportOptions(output=copy.parent / "page"))
    assert not (copy.parent / "page").exists()


def test_a_failure_leaves_what_was_there(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report(copy)
    before = sorted(p.relative_to(copy) for p in copy.rglob("*"))

    def fail(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mp4ds.plugins.reporting.report.notes_of", fail)
    with pytest.raises(KeyboardInterrupt):
        report(copy)
    assert sorted(p.relative_to(copy) for p in copy.rglob("*")) == before
    with pytest.raises(KeyboardInterrupt):
        report(copy, ReportOptions(output=copy.parent / "other"))
    assert not (copy.parent / "other").exists()


def test_a_damaged_video_is_told_and_the_rest_is_shown(copy: Path) -> None:
    video = copy / "depth_image_raw.mp4"
    data = bytearray(video.read_bytes())
    data[60 : len(data) // 2] = bytes(len(data) // 2 - 60)
    video.write_bytes(data)
    (copy / "messages.mcap").unlink()
    summary = report(copy)
    assert [camera.plays for camera in summary.cameras] == ["nothing", "video"]
    assert len(summary.problems) == 2
    data = data_of(copy)
    assert summary.problems[0] in data["notes"]
    assert data["cameras"][0]["note"] == summary.problems[0]
    assert data["topics"] == []
    assert not list((copy / "report").rglob("*.mp4"))


def test_hostile_names_are_only_text(tmp_path: Path) -> None:
    names = ("/a</script><script>alert(1)</script>", "/b\u2028\u2029'\"\\<!--")
    dataset = pack_cameras(tmp_path, two_cameras(second="mono8", names=names))
    report(dataset)
    assert sorted(camera["name"] for camera in data_of(dataset)["cameras"]) == sorted(names)
    for path in (dataset / "report").glob("*.js"):
        if path.name.startswith(("data", "columns-")):
            text = path.read_bytes()
            assert text.isascii()
            assert b"<" not in text.removeprefix(b"/* made by mp4ds report */")
    page = (dataset / "index.html").read_text()
    assert "alert" not in page


def test_no_code_of_the_page_makes_elements_of_text() -> None:
    folder = Path(sys.modules["mp4ds.plugins.reporting.report"].__file__ or "").parent / "page"
    code = "".join(path.read_text() for path in folder.glob("*.js"))
    forbidden = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function"
    assert len(code) > 10_000
    assert not re.search(forbidden, code)
    everything = code + (folder / "index.html").read_text() + (folder / "report.css").read_text()
    assert not re.search(r"https?://", everything)


# ---------------------------------------------------------------- stills

SOME = {*COMMON, "rgb16", "yuyv", "nv12", "8UC2", "32FC1", "64FC3", "bgra8", "bayer_gbrg16"}


CODED_KINDS = [
    *("jpeg-rgb", "video-h265", "video-h264-mid-gop", "png-rgba-cv2"),
    "depth-16UC1-rvl",
]


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    "kind",
    [name if name in SOME else pytest.param(name, marks=pytest.mark.slow) for name in ENCODINGS]
    + CODED_KINDS,
)
def test_every_kind_of_image_is_seen(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stills look like the images of their frames, and are spread over all of them."""
    monkeypatch.setattr("mp4ds.plugins.reporting.report.why_not_played", lambda _: "not asked to")
    if kind in CODED:
        made = CODED[kind](frames=8, width=96, height=66)
    else:
        made = scene(kind, frames=5, width=80, height=50, with_info=False)
    dataset = pack_cameras(tmp_path, made, quality="lossless")
    report(dataset)
    (facts,) = data_of(dataset)["cameras"]
    with mp4ds.open(dataset, layer="view") as opened:
        (stream,) = opened.streams
        look = Look(opened[stream.topic], stream.image_size)
        pictures = dict(stream.decodable_pictures(is_strict=False))
        seen = [number for number, picture in pictures.items() if picture is not None]
    assert [still["frame"] for still in facts["stills"]] == seen
    with mp4ds.open(dataset, layer="view") as opened:
        for still in facts["stills"]:
            shown = cv2.imread(str(dataset / still["file"]))[..., ::-1]
            (stream,) = opened.streams
            expected = look.picture(opened[stream.topic][still["frame"]].data)
            assert np.abs(blocks(shown) - blocks(expected)).mean() < 8


# ---------------------------------------------------------------- the command


def test_the_command(copy: Path) -> None:
    done = call("report", copy)
    assert f"{COLOUR}: plays its video" in done.out
    assert f"{DEPTH}: shows stills: no browser plays ffv1" in done.out
    assert str(copy / "index.html") in done.out
    (copy / "front_image_raw.mp4").unlink()
    told = call("report", copy, "--json")
    assert told.code == 1
    assert "front_image_raw.mp4" in json.loads(told.out)["problems"][0]
