"""The videos outside of mp4ds: in ffmpeg, PyAV and a browser, without any sidecar."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray

import mp4ds
from mp4ds.packing import PackOptions
from mp4ds.video import VideoDecoder
from sources import SOURCES, scene

WIDTH, HEIGHT, FRAMES = 96, 66, 12
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)


@dataclass(frozen=True)
class Case:
    """A kind of video.

    Attributes:
        encoding: Of the images.
        options: Of the pack.
        codec: ffprobe's name.
        pixel_formats: Those that ffprobe may tell; versions differ for grey H.264.
        matrix: ffprobe's colour space; None where the stream tells none.
        width: Of the video, where it is not that of the images.
        browser: Whether browsers play it with the right colours.
    """

    encoding: str
    options: dict[str, Any]
    codec: str
    pixel_formats: tuple[str, ...]
    matrix: str | None = "bt709"
    width: int = WIDTH
    browser: bool = True


YUV = ("yuv420p", "yuvj420p")
GREY_H264 = ("gray", "yuvj420p", "yuv420p")
VISUAL: dict[str, Any] = {"quality": "visual"}
H264: dict[str, Any] = {"quality": "crf=20", "codec": "h264"}
CASES: dict[str, Case] = {
    "mono8": Case("mono8", {}, "h264", GREY_H264, None),
    "bayer": Case("bayer_grbg8", {}, "h264", GREY_H264, None),
    "rgb8": Case("rgb8", {"codec": "h264"}, "h264", ("gbrp",), "gbr", browser=False),
    "bgr8": Case("bgr8", {"codec": "h264"}, "h264", ("gbrp",), "gbr", browser=False),
    "mono16": Case("mono16", {}, "ffv1", ("gray16le",), browser=False),
    "mono8 ffv1": Case("mono8", {"codec": "ffv1"}, "ffv1", ("gray",), browser=False),
    "rgb8 ffv1": Case("rgb8", {"codec": "ffv1"}, "ffv1", ("bgr0",), "gbr", browser=False),
    "bgr8 ffv1": Case("bgr8", {"codec": "ffv1"}, "ffv1", ("bgr0",), "gbr", browser=False),
    "mono8 visual": Case("mono8", VISUAL, "av1", YUV),
    "rgb8 visual": Case("rgb8", VISUAL, "av1", YUV),
    "bgr8 visual": Case("bgr8", VISUAL, "av1", YUV),
    "bayer visual": Case("bayer_rggb8", VISUAL, "av1", YUV),
    "16UC1 visual": Case("16UC1", VISUAL, "ffv1", ("gray16le",), browser=False),
    "rgb8 h264": Case("rgb8", H264, "h264", YUV),
    "mono8 h264": Case("mono8", H264, "h264", YUV),
    "bayer h264": Case("bayer_gbrg8", H264, "h264", YUV),
    "rgb8 h265": Case("rgb8", {"quality": "crf=20", "codec": "h265"}, "hevc", YUV, browser=False),
}
PLAYED = [name for name, case in CASES.items() if case.browser]


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A dataset of each kind."""
    folder = tmp_path_factory.mktemp("players")
    found = {}
    for name, case in CASES.items():
        place = folder / name.replace(" ", "_")
        (place / "source").mkdir(parents=True)
        recording = scene(
            case.encoding, frames=FRAMES, width=WIDTH, height=HEIGHT, noisy=False, with_info=False
        )
        paths = SOURCES["bag-none"](place / "source", recording)
        mp4ds.pack(paths, place / "dataset", PackOptions(topics=["/cam/*"], **case.options))
        found[name] = place / "dataset"
    return found


def video_of(dataset: Path) -> Path:
    (path,) = dataset.glob("*.mp4")
    return path


def shown_pictures(dataset: Path) -> list[NDArray[np.uint8]]:
    """What is to be seen, by our decoder: RGB, for a lossless Bayer its four grey tiles."""
    with mp4ds.open(dataset) as opened:
        video = opened.streams[0].sidecar.video
    grey = video.layout in ("gray8", "mosaic8")
    size = (video.width, video.height)
    with VideoDecoder(
        dataset / video.file,
        codec=video.codec,
        coded_size=size,
        frames=FRAMES,
        picture_format="gray" if grey else "rgb24",
        picture_size=size,
    ) as decoder:
        pictures = [picture.astype(np.uint8) for picture in decoder.pictures()]
    return [np.repeat(p[..., None], 3, axis=2) for p in pictures] if grey else pictures


def expected_ticks(dataset: Path) -> list[int]:
    """Microseconds since the first frame."""
    with mp4ds.open(dataset) as opened:
        stamps = opened.streams[0].stamps
    return [int(stamp - stamps[0]) // 1000 for stamp in stamps]


# ---------------------------------------------------------------- ffmpeg


def ffprobe(path: Path, *options: str) -> Any:
    if not shutil.which("ffprobe"):
        pytest.skip("there is no ffprobe")
    command = ["ffprobe", "-v", "error", "-of", "json", *options, str(path)]
    return json.loads(subprocess.run(command, capture_output=True, check=True).stdout)


@pytest.mark.parametrize("name", CASES)
def test_ffprobe_knows_all(name: str, datasets: dict[str, Path]) -> None:
    case, path = CASES[name], video_of(datasets[name])
    found = ffprobe(path, "-count_frames", "-show_streams", "-show_format")
    (stream,) = found["streams"]
    assert stream["codec_name"] == case.codec
    assert stream["pix_fmt"] in case.pixel_formats
    assert (stream["width"], stream["height"]) == (case.width, HEIGHT)
    assert int(stream["nb_read_frames"]) == int(stream["nb_frames"]) == FRAMES
    assert stream["has_b_frames"] == 0
    assert stream["time_base"] == "1/1000000"
    assert float(stream["start_time"]) == 0
    span = expected_ticks(datasets[name])[-1] / 1e6
    for duration in (stream["duration"], found["format"]["duration"]):
        assert span < float(duration) < span + 0.2
    tags = [stream.get(f"color_{tag}") for tag in ("range", "space", "transfer", "primaries")]
    assert tags == ["pc", case.matrix, "bt709", "bt709"]


@pytest.mark.parametrize("name", CASES)
def test_ffprobe_reads_the_times(name: str, datasets: dict[str, Path]) -> None:
    path = video_of(datasets[name])
    frames = ffprobe(path, "-show_entries", "frame=best_effort_timestamp,pict_type")["frames"]
    assert [frame["best_effort_timestamp"] for frame in frames] == expected_ticks(datasets[name])


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


def untile(picture: NDArray[Any]) -> NDArray[Any]:
    """spec/index.md, Layouts, mosaic8."""
    h, w = picture.shape[0] // 2, picture.shape[1] // 2
    y, x = np.mgrid[: 2 * h, : 2 * w]
    mosaic: NDArray[Any] = picture[(y % 2) * h + y // 2, (x % 2) * w + x // 2]
    return mosaic


@pytest.mark.parametrize(
    "name", [name for name in CASES if "visual" not in name and "26" not in name]
)
def test_ffmpeg_has_the_pixels_of_a_lossless_video(name: str, datasets: dict[str, Path]) -> None:
    """Without mp4ds: by ffmpeg, and the words of the spec."""
    case, path = CASES[name], video_of(datasets[name])
    recorded = scene(
        case.encoding, frames=FRAMES, width=WIDTH, height=HEIGHT, noisy=False, with_info=False
    )
    images = [m.values["data"] for m in recorded.messages if m.topic == "/cam/image_raw"]
    if case.encoding in ("rgb8", "bgr8"):
        raw = ffmpeg(path, f"{case.encoding[:3]}24")
    elif case.encoding == "mono16":
        raw = ffmpeg(path, "gray16le")
    else:
        raw = ffmpeg(path, "gray", "-vf", "extractplanes=y")
    frames = np.frombuffer(raw, np.uint8).reshape(FRAMES, HEIGHT, -1)
    for frame, image in zip(frames, images, strict=True):
        pixels = untile(frame) if case.encoding.startswith("bayer") else frame
        assert np.array_equal(pixels.ravel(), image)


@pytest.mark.parametrize("name", [name for name in CASES if CASES[name].pixel_formats == YUV])
def test_ffmpeg_shows_the_same_colours(name: str, datasets: dict[str, Path]) -> None:
    raw = ffmpeg(video_of(datasets[name]), "rgb24", "-sws_flags", "accurate_rnd+full_chroma_int")
    frames = np.frombuffer(raw, np.uint8).reshape(FRAMES, HEIGHT, WIDTH, 3)
    for frame, picture in zip(frames, shown_pictures(datasets[name]), strict=True):
        difference = blocks(frame) - blocks(picture)
        assert np.abs(difference).max() <= 4


def blocks(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Mean colours of a grid of 8 x 6 blocks."""
    height, width = picture.shape[0] // 6, picture.shape[1] // 8
    part = picture[: 6 * height, : 8 * width].astype(float)
    means: NDArray[np.float64] = part.reshape(6, height, 8, width, 3).mean(axis=(1, 3))
    return means


# ---------------------------------------------------------------- PyAV


@pytest.mark.parametrize("name", CASES)
def test_pyav_plays_and_seeks(name: str, datasets: dict[str, Path]) -> None:
    ticks = expected_ticks(datasets[name])
    with av.open(str(video_of(datasets[name]))) as container:
        stream = container.streams.video[0]
        assert stream.frames == FRAMES
        assert [frame.pts for frame in container.decode(stream)] == ticks
        for tick in (ticks[7], ticks[0], ticks[-1]):
            container.seek(tick, stream=stream)
            assert tick in [frame.pts for frame in container.decode(stream)]
        container.seek(0)
        first = next(container.decode(stream))
        assert (first.width, first.height) == (CASES[name].width, HEIGHT)
        assert first.to_ndarray(format="rgb24").std() > 10


# ---------------------------------------------------------------- a browser

PAGE = """<!doctype html><meta charset="utf-8"><title>player</title><script>
const once = (node, name) => new Promise((resolve, reject) => {
  node.addEventListener(name, resolve, {once: true});
  node.addEventListener("error", () => reject(
    new Error(`${name}: ${node.error && node.error.code} ${node.error && node.error.message}`)));
});
async function load(name) {
  const video = document.createElement("video");
  video.muted = true;
  video.preload = "auto";
  document.body.replaceChildren(video);
  const loaded = once(video, "loadeddata");
  video.src = "/video/" + encodeURIComponent(name);
  await loaded;
  return video;
}
// the metadata of the next frame that is shown: "seeked" comes before the picture is there
const presented = video => new Promise(
  resolve => video.requestVideoFrameCallback((_, metadata) => resolve(metadata)));
function means(video) {
  const canvas = document.createElement("canvas");
  canvas.width = video.videoWidth;
  canvas.height = video.videoHeight;
  const context = canvas.getContext("2d", {willReadFrequently: true});
  context.drawImage(video, 0, 0);
  const w = Math.floor(canvas.width / 8), h = Math.floor(canvas.height / 6), found = [];
  for (let row = 0; row < 6; row++) for (let column = 0; column < 8; column++) {
    const data = context.getImageData(column * w, row * h, w, h).data, sum = [0, 0, 0];
    for (let i = 0; i < data.length; i += 4) for (let c = 0; c < 3; c++) sum[c] += data[i + c];
    found.push(sum.map(value => value / (w * h)));
  }
  return found;
}
async function test(name, times) {
  const video = await load(name);
  const size = [video.videoWidth, video.videoHeight];
  const result = {duration: video.duration, size, frames: []};
  for (const time of times) {
    const seeked = once(video, "seeked"), shown = presented(video);
    video.currentTime = time;
    await seeked;
    const mediaTime = (await shown).mediaTime;
    result.frames.push({mediaTime, means: means(video)});
  }
  const fresh = await load(name), ended = once(fresh, "ended");
  await fresh.play();
  await ended;
  result.decoded = fresh.getVideoPlaybackQuality().totalVideoFrames;
  result.ended = fresh.currentTime;
  return result;
}
(async () => {
  for (const [name, times] of Object.entries(await (await fetch("/jobs")).json())) {
    let result;
    const late = new Promise((_, reject) => setTimeout(reject, 20000, new Error("takes too long")));
    try { result = await Promise.race([test(name, times), late]); }
    catch (error) { result = {error: String(error)}; }
    const body = JSON.stringify(result);
    await fetch("/result/" + encodeURIComponent(name), {method: "POST", body});
  }
})();
</script><body></body>"""


class Server(ThreadingHTTPServer):
    """Serves the page, the videos by byte ranges, and takes the results."""

    daemon_threads = True

    def __init__(self, videos: dict[str, Path], jobs: dict[str, list[float]]) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.videos = videos
        self.jobs = jobs
        self.results: dict[str, Any] = {}
        self.done = threading.Event()


class Handler(BaseHTTPRequestHandler):
    """Of one request."""

    server: Server
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        kind, _, name = self.path.lstrip("/").partition("/")
        if kind == "video":
            self._send_video(self.server.videos[name.replace("%20", " ")].read_bytes())
        elif kind == "jobs":
            self._send(200, "application/json", json.dumps(self.server.jobs).encode())
        elif kind == "":
            self._send(200, "text/html", PAGE.encode())
        else:
            self._send(404, "text/plain", b"")

    def do_POST(self) -> None:
        name = self.path.rpartition("/")[2].replace("%20", " ")
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.results[name] = json.loads(body)
        self._send(200, "text/plain", b"ok")
        if len(self.server.results) == len(self.server.jobs):
            self.server.done.set()

    def _send_video(self, data: bytes) -> None:
        first, last = 0, len(data) - 1
        asked = self.headers.get("Range", "")
        if asked.startswith("bytes="):
            start, _, end = asked.removeprefix("bytes=").partition("-")
            first, last = int(start), min(int(end or last), last)
        extra = {"Accept-Ranges": "bytes"}
        if asked:
            extra["Content-Range"] = f"bytes {first}-{last}/{len(data)}"
        self._send(206 if asked else 200, "video/mp4", data[first : last + 1], extra)

    def _send(
        self, status: int, kind: str, body: bytes, extra: dict[str, str] | None = None
    ) -> None:
        self.send_response(status)
        for key, value in {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
            **(extra or {}),
        }.items():
            self.send_header(key, value)
        self.end_headers()
        self.wfile.write(body)


@pytest.fixture(scope="module")
def played(
    datasets: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Any]]:
    """What a browser says of each video."""
    if not CHROMIUM:
        pytest.skip("there is no Chromium")
    videos = {name: video_of(datasets[name]) for name in PLAYED}
    jobs = {name: middle_times(datasets[name]) for name in PLAYED}
    profile = tmp_path_factory.mktemp("profile")
    with Server(videos, jobs) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        log = (profile / "log.txt").open("wb")
        browser = subprocess.Popen(
            [
                *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic"),
                *("--no-first-run", "--disable-background-networking", "--disable-sync"),
                *("--disable-component-update", "--disable-dev-shm-usage", "--mute-audio"),
                *("--autoplay-policy=no-user-gesture-required", "--hide-scrollbars"),
                *("--force-color-profile=srgb", "--remote-debugging-port=0"),
                *(f"--user-data-dir={profile}", f"http://127.0.0.1:{server.server_port}/"),
            ],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,  # a group of its own, to be ended as a whole
        )
        try:
            end = time.monotonic() + 90
            while not server.done.wait(0.1) and time.monotonic() < end and browser.poll() is None:
                pass
        finally:
            with suppress(ProcessLookupError):
                os.killpg(browser.pid, signal.SIGKILL)
            browser.wait()
            log.close()
            server.shutdown()
            thread.join()
        if not server.results:
            pytest.fail(f"the browser played nothing: {(profile / 'log.txt').read_text()[-2000:]}")
        yield server.results
    shutil.rmtree(profile, ignore_errors=True)


CHOSEN = (0, 7, 3, FRAMES - 2)


def middle_times(dataset: Path) -> list[float]:
    """Seconds at which the chosen frames are surely shown: half-way to the next one."""
    ticks = expected_ticks(dataset)
    return [(ticks[number] + ticks[number + 1]) / 2e6 for number in CHOSEN]


@pytest.mark.browser
@pytest.mark.parametrize("name", PLAYED)
def test_a_browser_plays_it(name: str, played: dict[str, Any], datasets: dict[str, Path]) -> None:
    assert name in played, "the browser did not come to this video in time"
    result = played[name]
    assert "error" not in result, result["error"]
    assert result["size"] == [CASES[name].width, HEIGHT]
    span = expected_ticks(datasets[name])[-1] / 1e6
    assert span < result["duration"] < span + 0.2
    assert result["ended"] == pytest.approx(result["duration"], abs=0.05)
    assert result["decoded"] == FRAMES


@pytest.mark.browser
@pytest.mark.parametrize("name", PLAYED)
def test_a_browser_shows_the_right_frames_in_the_right_colours(
    name: str, played: dict[str, Any], datasets: dict[str, Path]
) -> None:
    pictures, ticks = shown_pictures(datasets[name]), expected_ticks(datasets[name])
    assert len(played[name]["frames"]) == len(CHOSEN)
    for number, found in zip(CHOSEN, played[name]["frames"], strict=True):
        assert found["mediaTime"] == pytest.approx(ticks[number] / 1e6, abs=2e-6)
        shown = np.array(found["means"]).reshape(6, 8, 3)
        distances = [np.abs(shown - blocks(picture)).max() for picture in pictures]
        assert distances[number] <= 4
        assert int(np.argmin(distances)) == number
