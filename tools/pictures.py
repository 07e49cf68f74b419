"""Make the pictures of docs/ again: pages of `report` and `evaluate` in headless Chromium.

python tools/pictures.py
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

import mp4ds
from mp4ds.plugins.demo import demo

ROOT = Path(__file__).resolve().parents[1]
REPORT = {"x": 0, "y": 0, "width": 1280, "height": 955}
EVALUATION = {"x": 0, "y": 0, "width": 800, "height": 900}
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
            tab.open(f"{report.as_uri()}#t=2.5", ready=_READY)
            tab.evaluate(_SETTLED)
            tab.press("g", text="g")
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


def save(data: bytes, name: str) -> None:
    """Keep a picture, of 256 colours."""
    path = ROOT / "docs" / name
    with Image.open(io.BytesIO(data)) as picture:
        picture.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
