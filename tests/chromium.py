"""A headless Chromium that tests can ask and look at, by its DevTools protocol."""

from __future__ import annotations

import base64
import json
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.sync.client import connect

from waiting import WATCHDOG_S, until

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)


class Tab:
    """One page in the browser."""

    def __init__(self, socket: Any, session: str) -> None:
        self._socket = socket
        self._session = session
        self._number = 0
        self.problems: list[str] = []
        self.requests: list[str] = []

    def command(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and wait for its answer."""
        self._number += 1
        order = {"id": self._number, "method": method, "params": parameters}
        self._socket.send(json.dumps(order | {"sessionId": self._session}))
        while True:
            found = json.loads(self._socket.recv(WATCHDOG_S))
            if found.get("id") == self._number:
                assert "error" not in found, found["error"]
                return dict(found["result"])
            self._event(found)

    def _event(self, found: dict[str, Any]) -> None:
        method, parameters = found.get("method"), found.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(parameters["exceptionDetails"])[:2000])
        elif method == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.problems.append(parameters["entry"]["text"] + parameters["entry"].get("url", ""))
        elif method == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])

    def evaluate(self, expression: str) -> Any:
        """The value of an expression, awaited."""
        found = self.command(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def open(self, url: str, *, ready: str) -> None:
        """Load a page and wait until it is ready.

        Args:
            url: Of the page.
            ready: An expression that then gives a true value.
        """
        self.command("Page.navigate", url=url)

        def is_ready() -> bool:
            with suppress(AssertionError):  # the page is not there yet
                return bool(self.evaluate(ready))
            return False

        until(is_ready)

    def press(self, key: str, *, text: str = "") -> None:
        """Press a key."""
        for kind in ("keyDown", "keyUp"):
            more = {"text": text} if text and kind == "keyDown" else {}
            self.command("Input.dispatchKeyEvent", type=kind, key=key, **more)

    def screenshot(self, **clip: float) -> bytes:
        """A PNG file of the window, or of a part of the page: x, y, width, height."""
        part = {"clip": clip | {"scale": 1}, "captureBeyondViewport": True} if clip else {}
        return base64.b64decode(
            self.command("Page.captureScreenshot", format="png", **part)["data"]
        )

    def picture(self, selector: str) -> NDArray[np.uint8]:
        """What an element looks like: RGB, shape (H, W, 3)."""
        self.evaluate(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center'}})")
        box = self.evaluate(
            f"(b => ({{x: b.x + scrollX, y: b.y + scrollY, width: b.width, height: b.height}}))"
            f"(document.querySelector({selector!r}).getBoundingClientRect())"
        )
        data = np.frombuffer(self.screenshot(**box), np.uint8)
        return cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


@contextmanager
def chromium(profile: Path, *flags: str, width: int = 1280, height: int = 900) -> Iterator[Tab]:
    """A browser with an empty page.

    Args:
        profile: An empty folder.
        flags: More words of its command line.
        width: Of the window, pixels.
        height: Of the window, pixels.
    """
    if not CHROMIUM:
        pytest.skip("there is no Chromium")
    log = (profile / "log.txt").open("wb")
    browser = subprocess.Popen(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic"),
            *("--no-first-run", "--disable-background-networking", "--disable-sync"),
            *("--disable-component-update", "--disable-dev-shm-usage", "--mute-audio"),
            *("--hide-scrollbars", "--force-color-profile=srgb", "--remote-debugging-port=0"),
            *(f"--window-size={width},{height}", f"--user-data-dir={profile}", *flags),
            "about:blank",
        ],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        start_new_session=True,  # a group of its own, to be ended as a whole
    )
    try:
        with connect(_address(profile, browser), max_size=None) as socket:
            yield _tab(socket)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(browser.pid, signal.SIGKILL)
        browser.wait()
        log.close()
        shutil.rmtree(profile, ignore_errors=True)


def _address(profile: Path, browser: subprocess.Popen[bytes]) -> str:
    """Where the browser takes commands."""
    told = profile / "DevToolsActivePort"
    until(lambda: told.is_file() and "\n" in told.read_text(), browser)
    port, path = told.read_text().split("\n")[:2]
    return f"ws://127.0.0.1:{int(port)}{path}"


def _tab(socket: Any) -> Tab:
    def ask(number: int, method: str, **parameters: Any) -> dict[str, Any]:
        socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while (found := json.loads(socket.recv(WATCHDOG_S))).get("id") != number:
            pass
        return dict(found["result"])

    pages = [t for t in ask(1, "Target.getTargets")["targetInfos"] if t["type"] == "page"]
    target = pages[0]["targetId"]
    tab = Tab(socket, ask(2, "Target.attachToTarget", targetId=target, flatten=True)["sessionId"])
    for domain in ("Page", "Runtime", "Log", "Network"):
        tab.command(f"{domain}.enable")
    return tab


# ---------------------------------------------------------------- videos

PAGE = """<!doctype html><meta charset="utf-8"><title>player</title><script>
const once = (node, name) => new Promise((resolve, reject) => {
  node.addEventListener(name, resolve, {once: true});
  node.addEventListener("error", () => reject(
    new Error(`${name}: ${node.error && node.error.code} ${node.error && node.error.message}`)));
});
async function load(url) {
  const video = document.createElement("video");
  video.muted = true;
  video.preload = "auto";
  document.body.replaceChildren(video);
  const loaded = once(video, "loadeddata");
  video.src = url;
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
async function test(url, times) {
  const video = await load(url);
  const size = [video.videoWidth, video.videoHeight];
  const result = {duration: video.duration, size, frames: []};
  for (const time of times) {
    const seeked = once(video, "seeked"), shown = presented(video);
    video.currentTime = time;
    await seeked;
    const mediaTime = (await shown).mediaTime;
    result.frames.push({mediaTime, means: means(video)});
  }
  const fresh = await load(url), ended = once(fresh, "ended");
  await fresh.play();
  await ended;
  result.decoded = fresh.getVideoPlaybackQuality().totalVideoFrames;
  result.ended = fresh.currentTime;
  return result;
}
</script><body></body>"""


@contextmanager
def video_player(folder: Path) -> Iterator[Tab]:
    """A browser that plays videos from the disk, whose pixels a page there may see."""
    (folder / "page.html").write_text(PAGE)
    (folder / "profile").mkdir()
    flags = ("--allow-file-access-from-files", "--autoplay-policy=no-user-gesture-required")
    with chromium(folder / "profile", *flags) as tab:
        tab.open((folder / "page.html").as_uri(), ready="typeof test === 'function'")
        yield tab


def played(player: Tab, video: Path, times: list[float]) -> dict[str, Any]:
    """What a browser says of a video: of the frames at some times, and when it is played."""
    return dict(player.evaluate(f"test({json.dumps(video.as_uri())}, {times})"))
