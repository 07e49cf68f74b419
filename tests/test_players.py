"""The videos outside of mp4ds: in ffmpeg, PyAV and a browser, without any sidecar."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import yaml
from av.video.reformatter import ColorRange
from numpy.typing import NDArray

import images
import mp4ds
from chromium import Tab, played, video_player
from coded_scenes import CODED
from definitions import PICTURES
from mp4ds.packing.options import PackOptions
from pictures import CAREFUL, blocks
from scenes import Record, Scene
from sources import SOURCES, scene
from test_video import video_decoder

WIDTH, HEIGHT, FRAMES = 96, 66, 12


@dataclass(frozen=True)
class Case:
    """A kind of video.

    Attributes:
        kind: Encoding of the images, or name of a scene of `CODED`.
        options: Of the pack.
        codec: ffprobe's name.
        pixel_formats: Those that ffprobe may tell; versions differ for grey H.264.
        matrix: ffprobe's colour space; None where the stream tells none.
        range: ffprobe's colour range.
        raw: What ffmpeg calls the bytes of a lossless image; empty if they are not compared.
        browser: Whether browsers play it with the right colours.
        frames: Of the video.
        height: Of its pictures.
        is_left: Whether chroma is where H.264 and H.265 have it if nothing is said: beside the
            left of two pixels, not between them. Old players do not heed it.
    """

    kind: str
    options: dict[str, Any]
    codec: str
    pixel_formats: tuple[str, ...]
    matrix: str | None = "bt709"
    range: str | None = "pc"
    raw: str = ""
    browser: bool = False
    frames: int = FRAMES
    height: int = HEIGHT
    is_left: bool = False

    def scene(self) -> Scene:
        """What is recorded."""
        if self.kind in CODED:
            return CODED[self.kind](frames=FRAMES, width=WIDTH, height=HEIGHT)
        size = {"frames": FRAMES, "width": WIDTH, "height": HEIGHT}
        return scene(self.kind, **size, noisy=False, with_info=False)

    def images(self) -> list[Record]:
        """The camera's messages."""
        return [m for m in self.scene().messages if m.msgtype in PICTURES]


YUV = ("yuv420p", "yuvj420p")
GREY_H264 = ("gray", "yuvj420p", "yuv420p")
VISUAL: dict[str, Any] = {"quality": "visual"}
CRF: dict[str, Any] = {"quality": "crf=20", "codec": "h264"}
H264: dict[str, Any] = {"codec": "h264"}
FFV1: dict[str, Any] = {"codec": "ffv1"}
BT601: dict[str, Any] = {"matrix": "smpte170m", "range": "tv"}
H26X: dict[str, Any] = {"matrix": None, "range": None, "is_left": True}
BT601_LEFT: dict[str, Any] = BT601 | {"is_left": True}
JPEG: dict[str, Any] = {"matrix": "bt470bg"}
CASES: dict[str, Case] = {
    "mono8": Case("mono8", H264, "h264", GREY_H264, None, raw="gray", browser=True),
    "bayer": Case("bayer_grbg8", H264, "h264", GREY_H264, None, raw="gray", browser=True),
    "rgb8": Case("rgb8", H264, "h264", ("gbrp",), "gbr", raw="rgb24", browser=True),
    "bgr8": Case("bgr8", H264, "h264", ("gbrp",), "gbr", raw="bgr24", browser=True),
    "mono16": Case("mono16", {}, "ffv1", ("gray16le",), raw="gray16le"),
    "mono8 ffv1": Case("mono8", FFV1, "ffv1", ("gray",), raw="gray"),
    "rgb8 ffv1": Case("rgb8", FFV1, "ffv1", ("bgr0",), "gbr", raw="rgb24"),
    "bgr8 ffv1": Case("bgr8", FFV1, "ffv1", ("bgr0",), "gbr", raw="bgr24"),
    "rgba8": Case("rgba8", {}, "ffv1", ("bgra",), "gbr", raw="rgba"),
    "bgra8": Case("bgra8", {}, "ffv1", ("bgra",), "gbr", raw="bgra"),
    "rgb16": Case("rgb16", {}, "ffv1", ("gbrp16le",), "gbr", raw="rgb48le"),
    "uyvy": Case("uyvy", H264, "h264", ("yuv422p",), **BT601, raw="uyvy422"),
    "yuyv ffv1": Case("yuyv", FFV1, "ffv1", ("yuv422p",), **BT601, raw="yuyv422"),
    "nv12": Case("nv12", H264, "h264", ("yuv420p",), **BT601_LEFT, raw="nv12", browser=True),
    "nv21 ffv1": Case("nv21", FFV1, "ffv1", ("yuv420p",), **BT601, raw="nv21"),
    "nv24": Case("nv24", H264, "h264", ("yuv444p",), **BT601, raw="nv24", browser=True),
    "mono8 visual": Case("mono8", VISUAL, "av1", YUV, browser=True),
    "rgb8 visual": Case("rgb8", VISUAL, "av1", YUV, browser=True),
    "bgr8 visual": Case("bgr8", VISUAL, "av1", YUV, browser=True),
    "bayer visual": Case("bayer_rggb8", VISUAL, "av1", YUV, browser=True),
    "uyvy visual": Case("uyvy", VISUAL, "av1", YUV, **BT601, browser=True),
    "nv12 visual": Case("nv12", VISUAL, "av1", YUV, **BT601, browser=True),
    "16UC1 visual": Case("16UC1", VISUAL, "ffv1", ("gray16le",), raw="gray16le"),
    "rgb8 h264": Case("rgb8", CRF, "h264", YUV, browser=True),
    "mono8 h264": Case("mono8", CRF, "h264", YUV, browser=True),
    "bayer h264": Case("bayer_gbrg8", CRF, "h264", YUV, browser=True),
    "yuyv h264": Case("yuyv", CRF, "h264", YUV, **BT601_LEFT, browser=True),
    "rgb8 h265": Case("rgb8", CRF | {"codec": "h265"}, "hevc", YUV),
    "jpeg": Case("jpeg-rgb", {}, "mjpeg", ("yuvj420p",), **JPEG),
    "jpeg gray": Case("jpeg-gray", {}, "mjpeg", ("gray",), "bt470bg", None),
    "jpeg 444": Case("jpeg-444", {}, "mjpeg", ("yuvj444p",), **JPEG),
    "jpeg progressive": Case("jpeg-progressive", {}, "mjpeg", ("yuvj420p",), **JPEG),
    "jpeg transcoded": Case("jpeg-rgb", VISUAL | {"transcode": True}, "av1", YUV, browser=True),
    "png": Case("png-rgba-cv2", {}, "ffv1", ("bgra",), "gbr", raw="bgra"),
    "png gray": Case("png-gray-cv2", H264, "h264", GREY_H264, None, raw="gray"),
    # the low bits stand below the others
    "png 16-bit": Case("png-16-bit-cv2", {}, "ffv1", ("gray",), raw="gray", height=2 * HEIGHT),
    "depth png": Case("depth-16UC1-png", {}, "ffv1", ("gray",), height=2 * HEIGHT),
    "depth rvl": Case("depth-16UC1-rvl", {}, "ffv1", ("gray",), height=2 * HEIGHT),
    "packets h264": Case("video-h264", {}, "h264", ("yuv420p",), **H26X, browser=True),
    "packets h264 mid": Case("video-h264-mid-gop", {}, "h264", ("yuv420p",), **H26X, frames=8),
    "packets ffmpeg": Case("ffmpeg-libx264", {}, "h264", ("yuv420p",), **H26X, browser=True),
    "packets h265": Case("video-h265", {}, "hevc", ("yuv420p",), None, "tv", is_left=True),
    "packets av1": Case("video-av1", {}, "av1", ("yuv420p",), None, "tv", browser=True),
}
PLAYED = [name for name, case in CASES.items() if case.browser]


class Datasets(dict[str, Path]):
    """A dataset of each kind, made when it is asked for."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder

    def __missing__(self, name: str) -> Path:
        case, place = CASES[name], self._folder / name.replace(" ", "_")
        paths = SOURCES["bag-none"](place / "source", case.scene())
        options = PackOptions(topics=["/cam/*"], **case.options)
        self[name] = mp4ds.pack(paths, place / "dataset", options).dataset
        return self[name]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Datasets:
    return Datasets(tmp_path_factory.mktemp("players"))


def video_of(dataset: Path) -> Path:
    """What players show of a dataset of one stream: of two videos, the view."""
    return min(dataset.glob("*.mp4"), key=lambda path: len(path.name))


def case_of(name: str, dataset: Path) -> Case:
    """What is known of a dataset's video: where lossless images got a view, that of visual ones."""
    case = CASES[name]
    if len([*dataset.glob("*.mp4")]) == 1:
        return case
    kind = "mono8" if case.kind in CODED else case.kind
    return CASES.get(f"{kind} visual", CASES["rgb8 visual"])


def shown_pictures(dataset: Path, *, centred: bool = False) -> list[NDArray[np.uint8]]:
    """What is to be seen, by our decoder: RGB, for a lossless Bayer its four grey tiles.

    Args:
        dataset: Of one stream.
        centred: Take chroma for that of the middle of its pixels, as players do.
    """
    with mp4ds.open(dataset, layer="view") as opened:
        frames, video = len(opened.streams[0]), opened.streams[0].sidecar.video
    grey = video.layout in ("gray8", "mosaic8")
    size = (video.width, video.height)
    with video_decoder(
        dataset / video.file,
        codec=video.codec,
        coded_size=size,
        frames=frames,
        picture_format="gray" if grey else "yuv420p" if centred else "rgb24",
        picture_size=size,
        # a camera's own YUV is shown as it is tagged
        matrix=None if video.matrix == "smpte170m" else video.matrix,
        full_range=video.full_range,
    ) as decoder:
        pictures = [
            tuple(plane.copy() for plane in planes)
            for _, planes in decoder.pictures_at(range(frames))
        ]
    if centred:
        return [without_site(picture) for picture in pictures]
    if grey:
        return [np.repeat(picture[0][..., None], 3, axis=2) for picture in pictures]
    return [picture[0] for picture in pictures]


def without_site(planes: tuple[NDArray[np.uint8], ...]) -> NDArray[np.uint8]:
    """Planes of BT.601, limited range, as RGB; the frame does not say where its chroma is."""
    stacked = np.concatenate([plane.ravel() for plane in planes]).reshape(-1, WIDTH)
    frame = av.VideoFrame.from_ndarray(stacked, format="yuv420p")
    rgb = frame.reformat(
        format="rgb24",
        src_colorspace="itu601",
        dst_colorspace="itu601",
        src_color_range=ColorRange.MPEG,
        dst_color_range=ColorRange.JPEG,
        interpolation=CAREFUL,
    )
    return rgb.to_ndarray()


def expected_ticks(dataset: Path) -> list[int]:
    """Microseconds since the first frame."""
    with mp4ds.open(dataset) as opened:
        stamps = opened.streams[0].stamps
    return [int(stamp - stamps[0]) // 1000 for stamp in stamps]


# ---------------------------------------------------------------- ffmpeg


def ffmpeg(path: Path, pixel_format: str, *filters: str) -> bytes:
    """All frames, as ffmpeg converts them."""
    if not shutil.which("ffmpeg"):
        pytest.skip("there is no ffmpeg")
    command = ["ffmpeg", "-v", "error", "-i", str(path), "-fps_mode", "passthrough", *filters]
    command += ["-f", "rawvideo", "-pix_fmt", pixel_format, "-"]
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert not done.stderr, done.stderr.decode()
    return done.stdout


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", [name for name in CASES if CASES[name].raw])
def test_ffmpeg_has_the_pixels_of_a_lossless_video(name: str, datasets: Datasets) -> None:
    """Without mp4ds: by ffmpeg, and the reader of the conformance suite."""
    case, path = CASES[name], video_of(datasets[name])
    if not case_of(name, datasets[name]).raw:
        pytest.skip("its pixels are made of two videos")
    side = yaml.safe_load(path.with_suffix(".yaml").read_bytes())
    frames = np.frombuffer(ffmpeg(path, case.raw), np.uint8).reshape(FRAMES, -1)
    for frame, image in zip(frames, case.images(), strict=True):
        data = np.frombuffer(bytes(image.values["data"]), np.uint8)
        if case.kind in CODED:
            data = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if case.raw == "gray":
            planes = [frame.reshape(case.height, WIDTH)]
            frame = images.pixels(side["image"], side["video"], planes)
        assert np.array_equal(np.ravel(frame).view(np.uint8), np.ravel(data).view(np.uint8))


# ---------------------------------------------------------------- PyAV


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", CASES)
def test_pyav_plays_and_seeks(name: str, datasets: Datasets) -> None:
    ticks = expected_ticks(datasets[name])
    with av.open(str(video_of(datasets[name]))) as container:
        stream = container.streams.video[0]
        assert stream.frames == len(ticks) == CASES[name].frames
        assert [frame.pts for frame in container.decode(stream)] == ticks
        for tick in (ticks[7], ticks[0], ticks[-1]):
            container.seek(tick, stream=stream)
            assert tick in [frame.pts for frame in container.decode(stream)]
        container.seek(0)
        first = next(container.decode(stream))
        assert (first.width, first.height) == (WIDTH, CASES[name].height)
        assert first.to_ndarray(format="rgb24").std() > 10


# ---------------------------------------------------------------- a browser


@pytest.fixture(scope="module")
def player(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with video_player(tmp_path_factory.mktemp("player")) as tab:
        yield tab


CHOSEN = (0, 7, 3, FRAMES - 2)


def middle_times(dataset: Path) -> list[float]:
    """Seconds at which the chosen frames are surely shown: half-way to the next one."""
    ticks = expected_ticks(dataset)
    return [(ticks[number] + ticks[number + 1]) / 2e6 for number in CHOSEN]


@pytest.mark.browser
@pytest.mark.one_in(10)
@pytest.mark.parametrize("name", PLAYED)
def test_a_browser_shows_the_right_frames_in_the_right_colours(
    name: str, player: Tab, datasets: Datasets
) -> None:
    result = played(player, video_of(datasets[name]), middle_times(datasets[name]))
    assert result["size"] == [WIDTH, HEIGHT]
    ticks = expected_ticks(datasets[name])
    assert ticks[-1] / 1e6 < result["duration"] < ticks[-1] / 1e6 + 0.2
    assert result["ended"] == pytest.approx(result["duration"], abs=0.05)
    assert result["decoded"] == FRAMES
    pictures = shown_pictures(datasets[name], centred=case_of(name, datasets[name]).is_left)
    assert len(result["frames"]) == len(CHOSEN)
    for number, found in zip(CHOSEN, result["frames"], strict=True):
        assert found["mediaTime"] == pytest.approx(ticks[number] / 1e6, abs=2e-6)
        shown = np.array(found["means"]).reshape(6, 8, 3)
        distances = [np.abs(shown - blocks(picture)).max() for picture in pictures]
        assert distances[number] <= 4
        assert int(np.argmin(distances)) == number
