"""The report in headless Chromium, from the disk: what it shows, plays and plots."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import mp4ds
from chromium import Tab, chromium
from mp4ds.plugins.reporting.report import report
from mp4ds.plugins.reporting.stills import Look
from mp4ds.times import intervals, lost_frames
from report_scenes import (
    COLOUR,
    DEPTH,
    FRAMES,
    HEIGHT,
    WIDTH,
    blocks,
    pack_cameras,
    two_cameras,
)
from waiting import WATCHDOG_S, until

pytestmark = pytest.mark.browser

READY = "typeof mp4dsReport === 'object' && mp4dsReport.ready.then(() => true)"
SETTLED = "mp4dsReport.settled()"
CAMERAS = (DEPTH, COLOUR)  # in the order of the page


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with its report; not to be changed."""
    folder = pack_cameras(tmp_path_factory.mktemp("shown"), two_cameras(second="mono8"))
    report(folder)
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with chromium(tmp_path_factory.mktemp("profile")) as tab:
        yield tab


@contextmanager
def window(browser: Tab, width: int, height: int) -> Iterator[None]:
    """Another size of the window."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    browser.command("Emulation.setDeviceMetricsOverride", **size)
    try:
        yield
    finally:
        browser.command("Emulation.clearDeviceMetricsOverride")


def show(browser: Tab, url: str) -> Tab:
    browser.problems.clear()
    browser.requests.clear()
    browser.open("about:blank", ready="true")
    browser.open(url, ready=READY)
    assert browser.evaluate(SETTLED)
    return browser


@pytest.fixture
def page(browser: Tab, drive: Path) -> Tab:
    """The page as it is opened from the disk, at its first frame."""
    return show(browser, (drive / "index.html").as_uri())


class Recorded:
    """What the page is compared with."""

    def __init__(self, drive: Path) -> None:
        with mp4ds.open(drive) as dataset:
            topics = [dataset[topic] for topic in CAMERAS]
            self.stamps = [topic.stamps.copy() for topic in topics]
            self.logs = [topic.log_times.copy() for topic in topics]
            looks = [Look(topic, topic.image_size) for topic in topics]
            self.pictures = [
                [look.picture(frame.data) for frame in topic]
                for look, topic in zip(looks, topics, strict=True)
            ]
        self.base = min(int(stamps[0]) for stamps in self.stamps)

    def frame_at(self, camera: int, time: float) -> int:
        """The last frame whose stamp is not later, of stamps that never fall."""
        at = np.maximum.accumulate(self.stamps[camera] - self.base)
        return max(0, int(np.searchsorted(at, time, side="right")) - 1)


@pytest.fixture(scope="module")
def recorded(drive: Path) -> Recorded:
    return Recorded(drive)


def shown_number(page: Tab, recorded: Recorded, camera: int) -> int:
    """The frame whose decoded pixels are those on the screen."""
    picture = blocks(page.picture(f".camera:nth-child({camera + 1}) :is(video, img)"))
    distances = [np.abs(picture - blocks(other)).mean() for other in recorded.pictures[camera]]
    assert min(distances) < 6
    return int(np.argmin(distances))


def readout(page: Tab, camera: int) -> dict[str, str]:
    """What is written under a camera."""
    found = page.evaluate(
        f"Object.fromEntries(Object.entries(mp4dsReport.player.cameras[{camera}].values)"
        ".map(([key, value]) => [key, value.textContent]))"
    )
    return dict(found)


def text_of(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9:09}"


def assert_shows(page: Tab, recorded: Recorded, camera: int, number: int) -> None:
    assert page.evaluate(SETTLED)
    values = readout(page, camera)
    assert values["frame"] == f"{number} of {len(recorded.stamps[camera])}"
    assert values["stamp"] == text_of(int(recorded.stamps[camera][number]))
    assert values["log"] == text_of(int(recorded.logs[camera][number]))
    # the screen of a busy machine may be a picture behind what the decoder has given
    until(lambda: shown_number(page, recorded, camera) == number)


# ---------------------------------------------------------------- frames


def test_it_opens_from_the_disk_and_asks_no_network(page: Tab, recorded: Recorded) -> None:
    for camera in (0, 1):
        assert_shows(page, recorded, camera, 0)
    assert page.problems == []
    assert page.requests
    assert all(url.startswith(("file:", "data:", "about:")) for url in page.requests)
    assert page.evaluate("document.title") == "drive - mp4ds report"


@pytest.mark.slow
def test_every_frame_is_found_by_its_number(page: Tab, recorded: Recorded) -> None:
    for number in range(FRAMES - 1, -1, -1):
        time = f"mp4dsReport.player.cameras[1].position[{number}]"
        page.evaluate(f"mp4dsReport.player.go({time})")
        assert page.evaluate(SETTLED)
        assert readout(page, 1)["stamp"] == text_of(int(recorded.stamps[1][number]))
        assert shown_number(page, recorded, 1) == number
        if number % 10 == 5:
            time = float(recorded.stamps[1][number] - recorded.base)
            assert_shows(page, recorded, 0, recorded.frame_at(0, time))


@pytest.mark.parametrize("kind", ["seconds", "decimal", "nanoseconds"])
def test_going_to_a_time_that_is_typed(kind: str, page: Tab, recorded: Recorded) -> None:
    stamp = int(recorded.stamps[1][17])
    texts = {"seconds": repr((stamp - recorded.base) / 1e9 + 1e-8), "decimal": text_of(stamp)}
    page.evaluate(
        f"document.querySelector('#goto-time').value = {texts.get(kind, str(stamp))!r};"
        "document.querySelector('#goto').requestSubmit()"
    )
    assert_shows(page, recorded, 1, 17)


@pytest.mark.parametrize("speed", [1, 2])
def test_cameras_play_in_step(speed: float, page: Tab, recorded: Recorded) -> None:
    page.evaluate(f"mp4dsReport.player.speed = {speed}; mp4dsReport.player.time = 0")
    page.press(" ", text=" ")
    state = (
        "(p => ({time: p.time, playing: p.isPlaying, shown: p.cameras.map(c => c.shown),"
        " due: p.cameras.map(c => c.frameAt(p.time))}))(mp4dsReport.player)"
    )
    seen = []
    end = time.monotonic() + WATCHDOG_S
    while time.monotonic() < end:
        found = page.evaluate(state)
        seen.append(found)
        if found["time"] > 0.75e9 or not found["playing"]:
            break
        time.sleep(0.03)
    assert seen[-1]["time"] > 0.75e9
    times = [found["time"] for found in seen]
    assert times == sorted(times)
    # a picture is on the screen a little after the clock says so, by the machine's load
    late = [abs(a - b) for found in seen for a, b in zip(found["shown"], found["due"], strict=True)]
    assert np.median(late) <= 6 * max(1, speed)
    page.evaluate("mp4dsReport.player.pause()")  # the key would start anew what has ended
    stopped = page.evaluate("mp4dsReport.player.time")
    for camera in (0, 1):
        assert_shows(page, recorded, camera, recorded.frame_at(camera, stopped))


# ---------------------------------------------------------------- plots


def series(page: Tab, plot: str, number: int = 0) -> NDArray[np.float64]:
    """What a plot draws: NaN where there is nothing."""
    found = page.evaluate(f"Array.from(mp4dsReport.plots[{plot!r}].series[{number}].y)")
    return np.array([np.nan if value is None else value for value in found], np.float64)


def test_plots_have_the_numbers_of_the_columns(page: Tab, recorded: Recorded) -> None:
    for camera in (0, 1):
        steps = intervals(recorded.stamps[camera])
        found = series(page, "interval", camera)
        assert np.isnan(found[0])
        np.testing.assert_allclose(found[1:], steps / 1e6, rtol=1e-12)
        lost = np.where(steps > 0, lost_frames(steps), -1)
        assert series(page, "lost", camera).tolist() == [0, *lost.tolist()]
        delay = (recorded.logs[camera] - recorded.stamps[camera]) / 1e6
        np.testing.assert_allclose(series(page, "delay", camera), delay, rtol=1e-12)
    own, other = recorded.stamps[1], recorded.stamps[0]
    offsets = [min((int(a - b) for b in other), key=abs) / 1e6 for a in own]
    np.testing.assert_allclose(series(page, "offset"), offsets, rtol=1e-12)


# ---------------------------------------------------------------- sizes, names and troubles


@pytest.mark.parametrize("width", [1280, 1920, 420])
def test_the_page_fits_the_window(width: int, browser: Tab, drive: Path) -> None:
    with window(browser, width, 900):
        show(browser, (drive / "index.html").as_uri())
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
        assert browser.evaluate("document.querySelector('video').clientWidth") > 0.4 * width / 2
        ratio = browser.evaluate(
            "(v => v.clientWidth / v.clientHeight)(document.querySelector('video'))"
        )
        assert ratio == pytest.approx(WIDTH / HEIGHT, rel=0.02)


def test_a_lossless_mosaic_plays_in_colour(browser: Tab, with_views: Path, tmp_path: Path) -> None:
    drive = Path(shutil.copytree(with_views, tmp_path / "drive"))
    report(drive)
    page = show(browser, (drive / "index.html").as_uri())
    with mp4ds.open(drive) as dataset:
        left = dataset["/left/image_raw"]
        assert left.encoding == "bayer_rggb8"
        expected = left.get([len(left) - 1], format="rgb")[0].data
    page.press("End")
    assert page.evaluate(SETTLED)

    def is_shown() -> bool:
        seen = page.picture(".camera:nth-child(1) video")
        return bool(np.abs(blocks(seen) - blocks(expected)).mean() < 6)

    until(is_shown)


def test_hostile_names_run_nothing(browser: Tab, tmp_path: Path) -> None:
    names = (
        "/a</script><script>window.evil=1</script>",
        "/b<img src=x onerror=window.evil=1>\u2028'\"",
    )
    folder = tmp_path / "<b>&amp;'\" #%41"
    folder.mkdir()
    dataset = pack_cameras(folder, two_cameras(second="mono8", names=names))
    report(dataset)
    show(browser, (dataset / "index.html").as_uri())
    heads = browser.evaluate("[...document.querySelectorAll('.camera h3')].map(h => h.textContent)")
    assert heads == list(names)
    assert browser.evaluate("window.evil === undefined && !document.querySelector('main img')")
    assert browser.problems == []


def test_troubles_are_told(browser: Tab, drive: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(drive, tmp_path / "copy"))
    (copy / "depth_image_raw.mp4").write_bytes(b"no video" * 100)
    report(copy)
    (copy / "front_image_raw.mp4").write_bytes(b"no video at all")
    show(browser, (copy / "index.html").as_uri())
    notices = "[...document.querySelectorAll('.nothing')].map(n => n.hidden ? '' : n.textContent)"
    end = time.monotonic() + WATCHDOG_S
    while not all(browser.evaluate(notices)) and time.monotonic() < end:
        time.sleep(0.05)
    depth, colour = browser.evaluate(notices)
    assert re.fullmatch(r"No picture: .*depth_image_raw\.mp4.*", depth)
    assert colour.startswith("This browser cannot play front_image_raw.mp4")
    browser.evaluate("mp4dsReport.player.go(5e8)")
    assert browser.evaluate(SETTLED)
    assert browser.evaluate("mp4dsReport.player.cameras[0].shown") > 5
    (copy / "report" / "columns-0.js").unlink()
    browser.open("about:blank", ready="true")
    told = "document.querySelector('#message') && !document.querySelector('#message').hidden"
    browser.open((copy / "index.html").as_uri(), ready=told)
    assert "columns-0.js is missing" in browser.evaluate(
        "document.querySelector('#message').textContent"
    )
