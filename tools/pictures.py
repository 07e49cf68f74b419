"""Make the pictures of docs/ again: pages of `report` and `evaluate` in headless Chromium, players.

python tools/pictures.py     (that of VLC is left out where there is no vlc)
"""

from __future__ import annotations

import base64
import io
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from PIL import Image

import mp4ds
from mp4ds.plugins.demo import demo

ROOT = Path(__file__).resolve().parents[1]
REPORT = {"x": 0, "y": 0, "width": 1280, "height": 955}
EVALUATION = {"x": 0, "y": 0, "width": 800, "height": 900}
PLAYERS = {"x": 0, "y": 0, "width": 1096, "height": 306}
SHOWN_S = 2.5
_READY = "typeof mp4dsReport === 'object' && mp4dsReport.ready.then(() => true)"
_SETTLED = "mp4dsReport.settled()"


def main() -> None:
    """Make a demonstration, its pages, and pictures of them."""
    sys.path.insert(0, str(ROOT / "tests"))
    from chromium import chromium

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        demo(folder / "demo.mcap", seconds=6.0)
        mp4ds.pack(folder / "demo.mcap", folder / "demo")
        report = mp4ds.report(folder / "demo").index
        options = mp4ds.EvaluateOptions(
            codecs=["av1", "h264"],
            crf=["6:36:6"],
            presets=["6", "10", "medium"],
            frames=60,
            topics=["/right/image_raw"],
            target="vmaf=97",
        )
        mp4ds.evaluate(folder / "demo.mcap", options, output=folder / "evaluation")
        (folder / "profile").mkdir()
        with chromium(folder / "profile", width=1280, height=1340) as tab:
            show_players(tab, folder)
            tab.open(f"{report.as_uri()}#t={SHOWN_S}", ready=_READY)
            tab.evaluate(_SETTLED)
            save(tab.screenshot(**REPORT), "report.png")
            tab.command(
                "Emulation.setDeviceMetricsOverride",
                width=EVALUATION["width"],
                height=EVALUATION["height"],
                deviceScaleFactor=1,
                mobile=False,
            )
            page = (folder / "evaluation/index.html").as_uri()
            tab.open(page, ready="document.readyState === 'complete'")
            save(tab.screenshot(**EVALUATION), "evaluate.png")


_PAGE = """<!doctype html><meta charset="utf-8"><style>
body { margin: 8px; display: flex; gap: 8px; font: 13px/1.4 "DejaVu Sans"; color: #222; }
figure { margin: 0; width: 355px; } figcaption { padding: 3px 0; }
video, img { width: 355px; height: 266px; display: block; }
</style>"""


def show_players(tab: Any, folder: Path) -> None:
    """The two videos of a lossless Bayer camera: its view in two players, and what makes it exact.

    Args:
        tab: Of the browser.
        folder: Has the dataset ``demo``.
    """
    view, exact = (folder / "demo" / f"left_image_raw{end}" for end in (".mp4", ".exact.mp4"))
    size = f"{view.stat().st_size / 1e3:.0f} kB"
    figures = [(f'<video muted src="{view.as_uri()}"></video>', f"{view.name}, {size}: Chromium")]
    if vlc := shutil.which("vlc"):
        figures.append((_image(_played(vlc, view, folder / "played.y4m")), "the same by VLC"))
    with av.open(str(exact)) as video:
        video.seek(int(SHOWN_S * av.time_base))
        picture = next(video.decode(video=0)).to_image()
    size = f"{exact.stat().st_size / 1e6:.1f} MB"
    figures.append((_image(picture), f"{exact.name}, {size}"))
    shown = "".join(f"<figure>{one}<figcaption>{text}</figure>" for one, text in figures)
    (folder / "players.html").write_text(_PAGE + shown, encoding="utf-8")
    seek = f"Object.assign(document.querySelector('video'), {{currentTime: {SHOWN_S}}})"
    page = (folder / "players.html").as_uri()
    tab.open(page, ready="document.querySelector('video').readyState >= 2")
    tab.evaluate(
        "new Promise(done => { const video = " + seek + ";"
        " video.requestVideoFrameCallback(() => done()); })"
    )
    save(tab.screenshot(**PLAYERS), "players.png")


def _played(vlc: str, view: Path, made: Path) -> Image.Image:
    """A frame as VLC gives it to a screen, which is what its tags say: BT.709, full range."""
    output = ("--vout=yuv", f"--yuv-file={made}", "--yuv-yuv4mpeg2", "--no-video-title-show")
    command = (vlc, "-I", "dummy", "--no-audio", *output, str(view), "vlc://quit")
    subprocess.run(command, check=True, capture_output=True)
    with av.open(str(view)) as video:
        width = video.streams.video[0].width
        number = sum(frame.time <= SHOWN_S for frame in video.decode(video=0))
    planes = made.read_bytes().split(b"FRAME\n")[number]
    array = np.frombuffer(planes, np.uint8).reshape(-1, width)
    given = av.VideoFrame.from_ndarray(array, format="yuv420p")
    given.colorspace, given.color_range = Colorspace.ITU709, ColorRange.JPEG
    return given.reformat(format="rgb24", dst_color_range=ColorRange.JPEG).to_image()


def _image(picture: Image.Image) -> str:
    with io.BytesIO() as file:
        picture.save(file, "png")
        return f'<img src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}">'


def save(data: bytes, name: str) -> None:
    """Keep a picture, of 256 colours."""
    path = ROOT / "docs" / name
    with Image.open(io.BytesIO(data)) as picture:
        picture.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
