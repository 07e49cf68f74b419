"""The report in headless Chromium, from the disk: what it shows, plays and plots."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mp4ds
from chromium import Tab, chromium
from conftest import real
from mp4ds.plugins.reporting.cameras import nearest_offsets, pack_column
from mp4ds.plugins.reporting.page import as_script
from mp4ds.plugins.reporting.proxies import Look
from mp4ds.plugins.reporting.report import ReportOptions, report
from mp4ds.plugins.reporting.server import ReportServer
from mp4ds.times import intervals, lost_frames
from report_scenes import (
    COLOUR,
    DEPTH,
    FRAMES,
    HEIGHT,
    REPEATED,
    WIDTH,
    blocks,
    many_cameras,
    pack_cameras,
    two_cameras,
)
from waiting import WATCHDOG_S, until

pytestmark = pytest.mark.browser

READY = "typeof mp4dsReport === 'object' && mp4dsReport.ready.then(() => true)"
SETTLED = "mp4dsReport.settled()"
CAMERAS = (DEPTH, COLOUR)  # in the order of the page
INT64 = np.iinfo(np.int64)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with its report; not to be changed."""
    folder = pack_cameras(tmp_path_factory.mktemp("shown"), two_cameras())
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
            self.stamps = [dataset[topic].stamps.copy() for topic in CAMERAS]
            self.logs = [dataset[topic].log_times.copy() for topic in CAMERAS]
            depth, colour = (dataset[topic] for topic in CAMERAS)
            look = Look(depth, depth.image_size)
            self.pictures = [
                [look.picture(frame.data) for frame in depth],
                [frame.data for frame in colour.get(range(len(colour)), format="rgb")],
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
    picture = blocks(page.picture(f".camera:nth-child({camera + 1}) video"))
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


@pytest.mark.parametrize("seconds", [0.5, 0.01, 0.9, 0.41, 0.65, 0.966])
def test_a_time_is_shown_as_the_right_frames(seconds: float, page: Tab, recorded: Recorded) -> None:
    page.evaluate(f"mp4dsReport.player.go({seconds * 1e9})")
    for camera in (0, 1):
        assert_shows(page, recorded, camera, recorded.frame_at(camera, seconds * 1e9))


def test_every_frame_is_found_by_its_number(page: Tab, recorded: Recorded) -> None:
    for number in range(FRAMES - 1, -1, -1):
        time = f"mp4dsReport.player.cameras[1].position[{number}]"
        page.evaluate(f"mp4dsReport.player.go({time})")
        assert page.evaluate(SETTLED)
        assert readout(page, 1)["stamp"] == text_of(int(recorded.stamps[1][number]))
        assert shown_number(page, recorded, 1) == number


def test_steps_by_keys_follow_one_camera(page: Tab, recorded: Recorded) -> None:
    page.evaluate("document.querySelectorAll('.camera header')[1].click()")
    for _ in range(3):
        page.press("ArrowRight")
    assert_shows(page, recorded, 1, 3)
    assert_shows(page, recorded, 0, recorded.frame_at(0, recorded.stamps[1][3] - recorded.base))
    page.press("ArrowLeft")
    assert_shows(page, recorded, 1, 2)
    page.press("End")
    assert_shows(page, recorded, 0, FRAMES - 2)
    page.press("Home")
    assert_shows(page, recorded, 1, 0)
    page.press("ArrowLeft")
    assert_shows(page, recorded, 1, 0)


def test_a_repeated_stamp_is_a_step_of_its_own(page: Tab, recorded: Recorded) -> None:
    first = REPEATED - 2
    assert recorded.stamps[0][first] == recorded.stamps[0][first + 1]
    page.evaluate(f"mp4dsReport.player.go(mp4dsReport.player.cameras[0].position[{first - 1}])")
    for number in (first, first + 1, first + 2):
        page.press("ArrowRight")
        assert_shows(page, recorded, 0, number)
    page.press("ArrowLeft")
    assert_shows(page, recorded, 0, first + 1)
    page.press("ArrowLeft")
    assert_shows(page, recorded, 0, first)


def test_scrubbing_on_the_time_line(page: Tab, recorded: Recorded) -> None:
    page.evaluate("document.querySelector('#timeline').scrollIntoView({block: 'center'})")
    box = page.evaluate("document.querySelector('#timeline').getBoundingClientRect().toJSON()")
    end = page.evaluate("mp4dsReport.player.end")
    y = box["y"] + box["height"] / 2
    page.mouse("mousePressed", box["x"] + 0.1 * box["width"], y)
    for part in (0.2, 0.5, 0.9, 0.7):
        page.mouse("mouseMoved", box["x"] + part * box["width"], y)
    page.mouse("mouseReleased", box["x"] + 0.7 * box["width"], y)
    time = page.evaluate("mp4dsReport.player.time")
    assert time == pytest.approx(0.7 * end, abs=end / box["width"])
    for camera in (0, 1):
        assert_shows(page, recorded, camera, recorded.frame_at(camera, time))


@pytest.mark.parametrize("kind", ["seconds", "decimal", "nanoseconds"])
def test_going_to_a_time_that_is_typed(kind: str, page: Tab, recorded: Recorded) -> None:
    stamp = int(recorded.stamps[1][17])
    texts = {"seconds": repr((stamp - recorded.base) / 1e9 + 1e-8), "decimal": text_of(stamp)}
    page.evaluate(
        f"document.querySelector('#goto-time').value = {texts.get(kind, str(stamp))!r};"
        "document.querySelector('#goto').requestSubmit()"
    )
    assert_shows(page, recorded, 1, 17)


@pytest.mark.parametrize("speed", [0.5, 1, 2])
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


def test_playing_ends_at_the_end(page: Tab, recorded: Recorded) -> None:
    page.evaluate("mp4dsReport.player.go(mp4dsReport.player.end - 2e8); mp4dsReport.player.play()")
    end = time.monotonic() + WATCHDOG_S
    while page.evaluate("mp4dsReport.player.isPlaying") and time.monotonic() < end:
        time.sleep(0.05)
    assert page.evaluate("mp4dsReport.player.time === mp4dsReport.player.end")
    assert_shows(page, recorded, 0, FRAMES - 2)
    assert_shows(page, recorded, 1, recorded.frame_at(1, page.evaluate("mp4dsReport.player.end")))


REAL = {
    "bags/roboto_tiny_dvs.bag": 2,
    "bags/librealsense_depth_color.bag": 2,
    "bags/fiducials_aruco_marker_raspicam.bag": 1,
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", REAL)
def test_every_frame_of_real_recordings(name: str, browser: Tab, tmp_path: Path) -> None:
    mp4ds.pack(real(name), tmp_path / "real")
    summary = report(tmp_path / "real")
    assert summary.problems == []
    page = show(browser, summary.index.as_uri())
    assert page.problems == []
    assert page.evaluate("mp4dsReport.player.cameras.length") == REAL[name]
    with mp4ds.open(tmp_path / "real") as dataset:
        for camera in range(REAL[name]):
            own = f"mp4dsReport.player.cameras[{camera}]"
            stream = dataset[page.evaluate(f"{own}.facts.name")]
            look = Look(stream, stream.image_size)
            for number in range(len(stream)):
                page.evaluate(f"mp4dsReport.player.go({own}.position[{number}], {own}, {number})")
                assert page.evaluate(SETTLED)
                assert readout(page, camera)["stamp"] == text_of(int(stream.stamps[number]))
                seen = blocks(page.picture(f".camera:nth-child({camera + 1}) video"))
                expected = blocks(look.picture(stream[number].data))
                assert np.abs(seen - expected).mean() < 6


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
    offsets = nearest_offsets(recorded.stamps[1], recorded.stamps[0]) / 1e6
    np.testing.assert_allclose(series(page, "offset"), offsets, rtol=1e-12)


def test_the_jitter_is_that_of_the_columns(page: Tab, recorded: Recorded) -> None:
    page.evaluate("mp4dsReport.plots.jitter.count()")
    reach = page.evaluate("mp4dsReport.plots.jitter.reach")
    for camera in (0, 1):
        steps = intervals(recorded.stamps[camera])
        jitter = (steps - np.median(steps[steps > 0])) / 1e6
        counts, _ = np.histogram(jitter, bins=61, range=(-reach, reach))
        shares = page.evaluate(f"Array.from(mp4dsReport.plots.jitter.series[{camera}].shares)")
        assert np.abs(np.array(shares) - 100 * counts / len(jitter)).sum() < 1e-6 + 200 / len(
            jitter
        )


def test_the_figures_of_the_table(page: Tab, recorded: Recorded) -> None:
    rows = page.evaluate(
        "[...document.querySelectorAll('#timing tbody tr')]"
        ".map(row => [...row.cells].map(cell => cell.textContent))"
    )
    for row, stamps in zip(rows, recorded.stamps, strict=True):
        steps = intervals(stamps) / 1e6
        assert row[1] == str(len(stamps))
        assert row[3] == f"{np.median(steps[steps > 0]):.3f}"
        assert row[4] == f"{steps.std():.3f}"
        lost = lost_frames(steps)
        assert row[7] == (f"{lost.sum()} in {(lost > 0).sum()} gaps" if lost.any() else "0")
        assert row[8] == str((steps == 0).sum())


def test_reductions_are_least_and_most(page: Tab) -> None:
    rng = np.random.default_rng(5)
    values = np.round(rng.normal(size=5000), 6)
    ranges = [sorted(rng.integers(0, 5001, 2).tolist()) for _ in range(200)]
    ranges += [[0, 5000], [31, 33], [32, 64], [7, 7], [4999, 5000], [1024, 2048]]
    found = page.evaluate(
        f"(values => {{ const all = new mp4dsPlots.Reduction(Float64Array.from(values));"
        f" return {ranges}.map(([a, b]) => all.range(a, b)); }})({values.tolist()})"
    )
    for (first, end), [least, most] in zip(ranges, found, strict=True):
        if first == end:
            assert (least, most) == (None, None)  # infinities
        else:
            assert least == values[first:end].min()
            assert most == values[first:end].max()


@pytest.mark.parametrize(
    "values",
    [
        [INT64.min, INT64.max, 0, INT64.max, INT64.min, -1, 1],
        [10**18 + n * 16_666_667 + (n * n % 1000) for n in range(100)],
        [sum(1 << 7 * k for k in range(n % 9)) * (-1) ** n for n in range(60)],
        [3],
    ],
)
def test_columns_come_back_in_the_page(values: list[int], page: Tab) -> None:
    packed = json.dumps(pack_column(np.array(values, np.int64)))
    found = page.evaluate(f"Array.from(mp4dsColumns.decode({packed}, {len(values)}), String)")
    assert [int(value) for value in found] == values


def test_dragging_over_a_plot_zooms(page: Tab) -> None:
    page.evaluate("document.querySelector('.plot canvas').scrollIntoView({block: 'center'})")
    box = page.evaluate("document.querySelector('.plot canvas').getBoundingClientRect().toJSON()")
    y = box["y"] + 60
    left, right = box["x"] + 58, box["x"] + box["width"] - 8
    page.mouse("mousePressed", left + 0.25 * (right - left), y)
    page.mouse("mouseMoved", left + 0.4 * (right - left), y)
    page.mouse("mouseMoved", left + 0.5 * (right - left), y)
    page.mouse("mouseReleased", left + 0.5 * (right - left), y)
    view = page.evaluate("[mp4dsReport.view.from, mp4dsReport.view.to, mp4dsReport.view.end]")
    assert view[0] / view[2] == pytest.approx(0.25, abs=0.01)
    assert view[1] / view[2] == pytest.approx(0.5, abs=0.01)


def test_the_calibration_grid_is_drawn(page: Tab) -> None:
    canvas = "document.querySelectorAll('.camera canvas')[1]"
    painted = (
        f"(c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data"
        f".reduce((sum, value, i) => sum + (i % 4 === 3 && value > 0), 0))({canvas})"
    )
    assert page.evaluate(painted) == 0
    page.press("g")
    assert page.evaluate(painted) > 500
    page.press("g")
    assert page.evaluate(painted) == 0


# ---------------------------------------------------------------- many cameras

STAMPLESS, ARRAY = 3, 14


@pytest.fixture(scope="module")
def array(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Many cameras, one of them without stamps; not to be changed."""
    made = many_cameras(ARRAY, stampless=STAMPLESS)
    folder = pack_cameras(tmp_path_factory.mktemp("array"), made)
    report(folder)
    return folder


@pytest.fixture
def wall(browser: Tab, array: Path) -> Tab:
    """The page of many cameras."""
    return show(browser, (array / "index.html").as_uri())


def test_a_camera_without_stamps_bends_no_axis(wall: Tab) -> None:
    for plot in ("delay", "offset", "interval"):
        low, high = wall.evaluate(f"mp4dsReport.plots.{plot}.range()")
        assert -100 < low < high < 100
        without = f"mp4dsReport.plots.{plot}.canvas.parentElement.textContent"
        assert f"camera_{STAMPLESS:02}/image_raw (no header stamps)" in wall.evaluate(without)
    row = wall.evaluate(f"document.querySelectorAll('#timing tbody tr')[{STAMPLESS}].textContent")
    assert row.count("no header stamps") == 2
    assert wall.evaluate(f"mp4dsReport.player.cameras[{STAMPLESS}].stage.className") == "stage"


def test_colours_of_many_cameras_can_be_told_apart(wall: Tab) -> None:
    colours = wall.evaluate("mp4dsReport.player.cameras.map(camera => camera.colour)")
    bgr = np.array([[int(text[at : at + 2], 16) for at in (5, 3, 1)] for text in colours])
    lab = cv2.cvtColor((bgr[None] / 255).astype(np.float32), cv2.COLOR_BGR2Lab)[0]
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=2) + 1000 * np.eye(ARRAY)
    assert apart.min() > 25
    assert ((lab[:, 0] > 30) & (lab[:, 0] < 85)).all()  # on white and on black


def test_a_camera_is_enlarged_and_others_are_hidden(wall: Tab) -> None:
    width = "document.querySelectorAll('.camera')[%d].clientWidth"
    usual, page = wall.evaluate(width % 5), wall.evaluate("find = document.body.clientWidth")
    assert usual < page / 3
    wall.evaluate("document.querySelectorAll('.stage')[5].click()")
    assert wall.evaluate(width % 5) > 0.9 * page
    assert wall.evaluate("mp4dsReport.player.lead.number") == 5
    wall.press("Escape")
    assert wall.evaluate(width % 5) == usual
    wall.press("e")
    assert wall.evaluate(width % 5) > 0.9 * page
    wall.press("e")
    for _ in range(ARRAY):  # the last one stays
        wall.press("h")
    shown = "mp4dsReport.player.cameras.filter(each => each.panel.clientWidth).map(c => c.number)"
    [left] = wall.evaluate(shown)
    wall.evaluate("mp4dsReport.player.go(5e8)")
    assert wall.evaluate(SETTLED)
    assert wall.evaluate("mp4dsReport.player.cameras.every(c => c.video.paused)")
    wall.evaluate("document.querySelectorAll('#hidden button')[1].click()")
    assert wall.evaluate(SETTLED)
    assert wall.evaluate(shown) == sorted({1, left})
    pictures = "[1, %d].map(n => mp4dsReport.player.cameras[n]).map(c => c.shown - c.frameAt(5e8))"
    assert wall.evaluate(pictures % left) == [0, 0]
    assert "camera_00" in wall.evaluate("document.querySelector('#hidden').textContent")


def test_the_address_leads_to_a_time(wall: Tab) -> None:
    for text in ("0.5", "0.25"):
        wall.evaluate(
            "new Promise(done => { addEventListener('hashchange', done, {once: true});"
            f" location.hash = '#t={text}'; }}).then(() => 0)"
        )
        assert wall.evaluate("mp4dsReport.player.time") == float(text) * 1e9
    wall.evaluate(
        "new Promise(done => { addEventListener('hashchange', done, {once: true});"
        " location.hash = '#t=%E0%A4%A'; }).then(() => 0)"
    )
    assert wall.evaluate("mp4dsReport.player.time") == 0.25e9
    assert wall.problems == []


def test_names_and_numbers_are_whole_on_a_phone(browser: Tab, array: Path) -> None:
    with window(browser, 390, 844):
        show(browser, (array / "index.html").as_uri())
        cut = browser.evaluate(
            "[...document.querySelectorAll('h1, h3, .camera .kind, .camera dd, .clock, .facts dd,"
            " .plot .value, .legend label')].filter(each => { const box ="
            " each.getBoundingClientRect(); return each.scrollWidth > each.clientWidth + 1 &&"
            " each.clientWidth || box.right > 390 || box.width < 1 || box.left < 0; })"
            ".map(each => each.textContent)"
        )
        assert cut == []
        stamp = browser.evaluate("mp4dsReport.player.cameras[0].values.stamp.clientHeight")
        assert stamp < 25  # on one line
        assert browser.evaluate("document.documentElement.scrollWidth") <= 390


def test_the_clock_waits_on_a_busy_machine(wall: Tab) -> None:
    """What is on the screen, and the clock, at each step of playing on a slow processor."""
    wall.evaluate(
        "window.steps = []; mp4dsReport.player.listeners.push(() => { const p = mp4dsReport.player;"
        " if (p.isPlaying) steps.push([performance.now(), p.time, ...p.cameras.map(c => c.shown)]);"
        "}); window.positions = mp4dsReport.player.cameras.map(c => [...c.position]); 0"
    )
    wall.command("Emulation.setCPUThrottlingRate", rate=6)
    try:
        wall.evaluate("mp4dsReport.player.play()")
        end = time.monotonic() + WATCHDOG_S
        while wall.evaluate("mp4dsReport.player.isPlaying") and time.monotonic() < end:
            time.sleep(0.1)
        assert wall.evaluate("mp4dsReport.player.time === mp4dsReport.player.end")
    finally:
        wall.command("Emulation.setCPUThrottlingRate", rate=1)
    steps, positions = np.array(wall.evaluate("steps")), np.array(wall.evaluate("positions"))
    cameras = np.arange(ARRAY)
    shown = np.maximum(steps[:, 2:].astype(int), 0)
    until = np.column_stack([positions, np.full(ARRAY, np.inf)])[cameras, shown + 1]
    behind = (steps[:, 1:2] - until).max(axis=1)
    first = shown == 0
    ahead = np.where(first, 0, positions[cameras, shown] - steps[:, 1:2]).max(axis=1)
    assert behind.max() <= 0.2e9 + 1
    # a video runs on while the page itself stands still, and is brought back
    lasted = np.diff(steps[:, 0], append=steps[-1, 0])
    assert lasted[ahead > 0.3e9].sum() <= 0.25 * lasted.sum()


# ---------------------------------------------------------------- sizes, names and troubles


@pytest.mark.parametrize("count", [1, 3, 8])
def test_all_cameras_are_above_the_controls(count: int, browser: Tab, tmp_path: Path) -> None:
    folder = pack_cameras(tmp_path, many_cameras(count, stampless=-1))
    report(folder)
    with window(browser, 1400, 900):
        show(browser, (folder / "index.html").as_uri())
        bottoms = browser.evaluate(
            "[...document.querySelectorAll('.camera')].map(c => c.getBoundingClientRect().bottom)"
        )
        assert len(bottoms) == count
        bar = browser.evaluate("document.querySelector('#transport').getBoundingClientRect().top")
        assert max(bottoms) <= bar
        assert browser.evaluate("document.querySelector('video').clientWidth") >= 180


def test_the_controls_leave_room_on_a_phone(wall: Tab) -> None:
    height = "document.querySelector('#transport').offsetHeight"
    seen = "document.querySelector('#%s').offsetParent !== null"
    with window(wall, 390, 844):
        until(lambda: wall.evaluate(height) < 844 / 5)  # of fourteen cameras
        for name, is_seen in {"play": True, "seconds": True, "speed": False}.items():
            assert wall.evaluate(seen % name) == is_seen, name
        wall.evaluate("document.querySelector('#options').click()")
        for name in ("speed", "lead", "grid", "goto-time", "date"):
            assert wall.evaluate(seen % name), name
        assert wall.evaluate("document.documentElement.scrollWidth") <= 390
    assert not wall.evaluate(seen % "options")


@pytest.mark.parametrize("second", [0, 1e9])
def test_the_cursor_hides_no_time(second: float, page: Tab) -> None:
    """The line and its knob are below the labels, and whole at either end."""
    page.evaluate(f"mp4dsReport.player.go({second}); mp4dsReport.settled()")
    blue = page.evaluate(
        "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => {"
        " const c = document.querySelector('#timeline'), w = c.width, rows = [];"
        " const data = c.getContext('2d').getImageData(0, 0, w, 26).data;"
        " for (let y = 0; y < 26; y++) { let n = 0; for (let x = 0; x < w; x++) {"
        " const [r, g, b, a] = data.slice(4 * (y * w + x), 4 * (y * w + x) + 4);"
        " n += a > 200 && b > r + 100; } rows.push(n); } done(rows); })))"
    )
    assert sum(blue[:13]) == 0
    assert max(blue) >= 9


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


def test_videos_of_10_bits_are_shown_as_they_are(browser: Tab, tmp_path: Path) -> None:
    drive = pack_cameras(tmp_path, two_cameras(), codec="av1-10bit")
    report(drive)
    page, made = show(browser, (drive / "index.html").as_uri()), Recorded(drive)
    for number in (FRAMES - 1, 0, 5):
        page.evaluate(f"mp4dsReport.player.go({float(made.stamps[1][number] - made.base)})")
        assert_shows(page, made, 1, number)


def test_lossless_rgb_plays_itself_to_the_bit(browser: Tab, tmp_path: Path) -> None:
    drive = pack_cameras(tmp_path, two_cameras(), quality="lossless", codec="h264")
    summary = report(drive)
    assert [camera.plays for camera in summary.cameras] == ["proxy", "video"]
    with ReportServer(summary.files, summary.start) as server:
        thread = threading.Thread(target=server.serve)
        thread.start()
        try:
            page = show(browser, server.url)
            with mp4ds.open(drive) as dataset:
                for number in (0, FRAMES - 1, 11):
                    page.evaluate(
                        f"mp4dsReport.player.go(mp4dsReport.player.cameras[1].position[{number}])"
                    )
                    assert page.evaluate(SETTLED)
                    seen = page.evaluate(
                        "(v => { const c = new OffscreenCanvas(v.videoWidth, v.videoHeight)"
                        ".getContext('2d'); c.drawImage(v, 0, 0); return Array.from("
                        "c.getImageData(0, 0, v.videoWidth, v.videoHeight).data); })"
                        "(mp4dsReport.player.cameras[1].video)"
                    )
                    picture = np.array(seen, np.uint8).reshape(HEIGHT, WIDTH, 4)[..., :3]
                    np.testing.assert_array_equal(picture, dataset[COLOUR][number].data)
            page.open("about:blank", ready="true")
        finally:
            server.stop()
            thread.join()


def test_two_hours_at_60_hz(browser: Tab, drive: Path, tmp_path: Path) -> None:
    """432,000 frames in the columns of both cameras: shown, zoomed and stepped."""
    copy = Path(shutil.copytree(drive, tmp_path / "long"))
    count = 432_000
    rng = np.random.default_rng(3)
    stamps = 1_700_000_000 * 10**9 + np.arange(count) * 16_666_667
    stamps += rng.integers(-200_000, 200_000, count)
    columns = {"frames": count, "scores": {}}
    columns |= {"stamp": pack_column(stamps), "log_time": pack_column(stamps + 5_000_000)}
    for number in (0, 1):
        script = f"mp4dsReport.columns({number}, {as_script(columns)});"
        (copy / "report" / f"columns-{number}.js").write_text(script)
    assert sum(path.stat().st_size for path in (copy / "report").glob("*.js")) < 12_000_000
    data = copy / "report" / "data.js"
    text = data.read_text()
    base = json.loads(text[text.index("(") + 1 : -3])["base"]
    data.write_text(text.replace(f'"base":"{base}"', f'"base":"{int(stamps[0])}"'))
    show(browser, (copy / "index.html").as_uri())
    browser.evaluate(
        "(() => { const {view, plots, player} = mp4dsReport;"
        " for (let n = 0; n < 10; n++) { view.zoom(player.end / 3, 0.5); "
        " for (const plot of Object.values(plots)) plot.draw(); } return 0; })()"
    )
    at = 300_007
    browser.evaluate(f"mp4dsReport.player.go(mp4dsReport.player.cameras[1].position[{at}])")
    found = browser.evaluate(
        "String(mp4dsReport.player.cameras[1].stamp[mp4dsReport.player.cameras[1].shown])"
    )
    assert int(found) == stamps[at]
    least, most = browser.evaluate(
        f"mp4dsReport.plots.interval.series[1].reduction.range(1000, {at})"
    )
    steps = np.diff(stamps)[999 : at - 1] / 1e6
    assert (least, most) == pytest.approx((steps.min(), steps.max()), rel=1e-12)


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


def test_a_server_shows_the_same(
    browser: Tab, drive: Path, recorded: Recorded, tmp_path: Path
) -> None:
    summary = report(drive, ReportOptions(output=tmp_path / "else where"))
    with ReportServer(summary.files, summary.start) as server:
        thread = threading.Thread(target=server.serve)
        thread.start()
        try:
            page = show(browser, server.url)
            page.evaluate("mp4dsReport.player.go(7e8)")
            for camera in (0, 1):
                assert_shows(page, recorded, camera, recorded.frame_at(camera, 7e8))
            assert page.problems == []
            page.open("about:blank", ready="true")
        finally:
            server.stop()
            thread.join()


INTRUDER = """<!doctype html><title>intruder</title><script>
const root = "ROOT", got = [], tries = [];
const include = (name, facts, ready) => tries.push(new Promise(done => {
  const made = Object.assign(document.createElement(name), facts);
  made[ready] = () => { got.push(name); done(); };
  made.onerror = done;
  document.head.append(made);
}));
mp4dsReport = {dataset: facts => got.push(facts)};
include("script", {src: `${root}/report/data.js`}, "onload");
include("link", {rel: "stylesheet", href: `${root}/report/report.css`}, "onload");
include("video", {src: `${root}/front_image_raw.mp4`}, "onloadedmetadata");
for (const mode of ["cors", "no-cors"])
  tries.push(fetch(`${root}/report/data.js`, {mode}).then(() => got.push(mode), () => 0));
all = Promise.all(tries).then(() => got);
</script>"""


def test_another_origin_can_include_nothing(browser: Tab, drive: Path, tmp_path: Path) -> None:
    """Even one that has learned the token."""
    summary = report(drive)
    page = tmp_path / "intruder.html"
    with ReportServer(summary.files, summary.start) as server:
        page.write_text(INTRUDER.replace("ROOT", server.root))
        with ReportServer({"/intruder.html": page}, "/intruder.html") as other:
            threads = [threading.Thread(target=each.serve) for each in (server, other)]
            for thread in threads:
                thread.start()
            try:
                for url in (page.as_uri(), other.url, other.url.replace("127.0.0.1", "localhost")):
                    browser.open(url, ready="typeof all === 'object'")
                    assert browser.evaluate("all") == []
                browser.open("about:blank", ready="true")
            finally:
                for each, thread in zip((server, other), threads, strict=True):
                    each.stop()
                    thread.join()


def test_troubles_are_told(browser: Tab, drive: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(drive, tmp_path / "copy"))
    report(copy, ReportOptions(proxies="none"))
    (copy / "front_image_raw.mp4").write_bytes(b"no video at all")
    show(browser, (copy / "index.html").as_uri())
    notices = "[...document.querySelectorAll('.nothing')].map(n => n.hidden ? '' : n.textContent)"
    end = time.monotonic() + WATCHDOG_S
    while not all(browser.evaluate(notices)) and time.monotonic() < end:
        time.sleep(0.05)
    depth, colour = browser.evaluate(notices)
    assert depth == "No picture: no browser plays ffv1"
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


def test_a_page_without_cameras(browser: Tab, tmp_path: Path) -> None:
    made = two_cameras()
    made.messages = [message for message in made.messages if "image" not in message.topic]
    dataset = pack_cameras(tmp_path, made)
    report(dataset)
    show(browser, (dataset / "index.html").as_uri())
    assert browser.problems == []
    assert "/imu" in browser.evaluate("document.querySelector('#topics').textContent")
