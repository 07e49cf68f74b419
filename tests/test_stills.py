"""Frames saved as images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mp4ds
from commands import call
from mp4ds.errors import FrameNotFoundError, OptionError
from mp4ds.options import parse_time
from mp4ds.plugins.reporting.stills import (
    Look,
    StillOptions,
    frames,
    number_at,
)
from report_scenes import COLOUR, FRAMES, HEIGHT, WIDTH, blocks, pack_cameras, two_cameras
from sources import COMMON, ENCODINGS, scene

START = 1_700_000_000_123_456_789


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lossless dataset of a colour camera and one of depth; not to be changed."""
    return pack_cameras(tmp_path_factory.mktemp("stills"), two_cameras(), quality="lossless")


def read(path: Path) -> np.ndarray[Any, Any]:
    """An image as OpenCV reads it, RGB."""
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return cv2.cvtColor(found, cv2.COLOR_BGR2RGB) if found.ndim == 3 else found


# ---------------------------------------------------------------- times


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("+0", START),
        ("+2.5", START + 2_500_000_000),
        ("+0.000000001", START + 1),
        ("1700000000.123456789", START),
        ("1700000000.5", 1_700_000_000_500_000_000),
        ("1700000000123456789", START),
        ("2.5", START + 2_500_000_000),
        ("60", START + 60_000_000_000),
        ("1700000000", 1_700_000_000_000_000_000),
        ("2023-11-14T22:13:20.123456789Z", START),
        ("2023-11-14 22:13:21", 1_700_000_001_000_000_000),
    ],
)
def test_times_as_they_are_written(text: str, time: int) -> None:
    assert parse_time(text).after(START) == time


def test_the_nearest_frame_is_meant(drive: Path) -> None:
    with mp4ds.open(drive) as dataset:
        stream = dataset[COLOUR]
        stamps = stream.stamps.tolist()

        def number(text: str) -> int:
            at = StillOptions(at=text).at
            return number_at(stream, at)

        assert number(str(stamps[7])) == 7
        assert number(str(stamps[7] + 9_000_000)) == 7
        assert number(f"+{(stamps[9] - stamps[0]) / 1e9:.9f}") == 9
        assert number("#29") == FRAMES - 1
        assert number(str(stamps[0] - 900_000_000)) == 0
        for text in (str(stamps[0] - 1_100_000_000), "+99", "12"):
            with pytest.raises(FrameNotFoundError):
                number(text)
        with pytest.raises(OptionError, match="#0 to #29"):
            number("#30")


# ---------------------------------------------------------------- one frame


def test_a_frame_is_saved_as_it_is(drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.png"
    summary = frames(drive, out, StillOptions(topic=COLOUR, at="+0.5"))
    with mp4ds.open(drive) as dataset:
        frame = dataset[COLOUR].at(int(dataset[COLOUR].stamps[0]) + 500_000_000)
    assert np.array_equal(read(out), frame.data)
    assert (summary.index, summary.stamp_ns) == (frame.index, frame.stamp_ns)
    assert summary.log_time_ns == frame.log_time_ns
    assert summary.size == (WIDTH, HEIGHT)


SOME = {*COMMON, "rgb16", "yuyv", "8UC2", "32FC1", "bgra8", "bayer_gbrg16"}


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    "encoding",
    [name if name in SOME else pytest.param(name, marks=pytest.mark.slow) for name in ENCODINGS],
)
def test_every_encoding_can_be_looked_at(encoding: str, tmp_path: Path) -> None:
    made = scene(encoding, frames=4, width=64, height=48, with_info=False)
    dataset = pack_cameras(tmp_path, made, quality="lossless")
    summaries = {}
    for name in ("out.png", "out.jpg"):
        summaries[name] = frames(dataset, tmp_path / name, StillOptions(at="#2"))
    with mp4ds.open(dataset) as opened:
        (stream,) = opened
        frame = stream[2].data
        seen = Look(stream, stream.image_size).picture(frame)
    jpeg = read(tmp_path / "out.jpg")
    assert jpeg.shape == seen.shape
    if not encoding.startswith("bayer") and not encoding.endswith("16"):
        assert np.abs(blocks(jpeg) - blocks(seen)).mean() < 4
    png = read(tmp_path / "out.png")
    assert png.shape == seen.shape
    assert png.dtype == np.uint8
    assert png.max() > 150  # dark ones of 16 bits, too, whose exact values look black


# ---------------------------------------------------------------- options and the command


NO_TIMES = ("", "#x", "#-1", "now", "1e9", "+", "+1.0000000001", "-5", "2023-13-14T22:13:20")


@pytest.mark.parametrize(
    "options",
    [
        *({"at": text} for text in (*NO_TIMES, "1.5 s", "12:30", "٣")),
        {"at": "+1", "exact": True, "resize": 0.5},
    ],
)
def test_options_that_are_wrong_or_do_not_go_together(options: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match="`"):
        StillOptions(**options)


def test_the_command(drive: Path, tmp_path: Path) -> None:
    out = str(tmp_path / "out.png")
    done = call("frames", drive, "--topic", COLOUR, "--at", "+0.4", "-o", out)
    assert done.code == 0, done.err
    assert f"frame 12 of {COLOUR}" in done.out
    assert call("frames", drive, "--topic", COLOUR, "--at", "+0.4", "-o", out).code == 2
    told = call("frames", drive, "-t", COLOUR, "-o", out, "--force", "--json")
    assert json.loads(told.out)["index"] == 0
    assert call("frames", drive, "--topic", COLOUR, "--at", "+99", "-o", out, "-f").code == 2
