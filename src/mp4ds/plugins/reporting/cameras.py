"""What the page shows of a camera: its video or stills, columns, timing and calibrations."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.stream import Stream
from mp4ds.errors import FormatError, Refused, VideoError
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.times import Integers, differences, intervals
from mp4ds.video.media import Media, pixel_format_of
from mp4ds.video.mp4 import sample_table_of

# ---------------------------------------------------------------- videos

_MICROSECONDS = 1_000_000
_8BIT = frozenset({"yuv420p", "yuv422p", "yuv444p", "gbrp"})
_PLAYED = {
    "h264": _8BIT
    | {"yuvj420p", "yuvj422p", "yuvj444p", "gray"}
    | {"yuv420p10le", "yuv422p10le", "yuv444p10le", "gray10le"},
    "av1": frozenset({"yuv420p", "yuvj420p", "gray", "yuv420p10le", "gray10le"}),
    "vp9": _8BIT,
}
"""What Chromium plays directly, by test; other browsers play less."""

_FEW = ("hevc",)  # if the system or the GPU decodes it


def why_not_played(stream: Stream) -> str:
    """Why browsers do not show a stream's images by its video; empty if Chromium-based ones do.

    Raises:
        VideoError: The video cannot be read.
    """
    with closing(Media(stream.video_path)) as media:
        context = media.track.codec_context
        name, pixel_format = context.codec.canonical_name, pixel_format_of(context)
    reason, encoding = "", ENCODINGS[stream.encoding]
    if name not in _PLAYED:
        reason = f"{'few browsers play' if name in _FEW else 'no browser plays'} {name}"
    elif pixel_format not in _PLAYED[name]:
        reason = f"no browser plays {name} in the pixel format {pixel_format}"
    elif stream.sidecar.body != "packet" and not stream.sidecar.layout.is_shown:
        reason = f"its video stores {stream.encoding} and does not look like the image"
    if reason and encoding.lossy and encoding.channels < 4:  # alpha has no view
        reason += "; `mp4ds pack DATASET -o NEW --view` adds a video that does"
    return reason


def presentation_times(stream: Stream) -> NDArray[np.int64]:
    """When a player shows each frame of a stream's video, microseconds, as its mp4 says.

    Raises:
        VideoError: It cannot be read, or its number of frames differs from its sidecar.
    """
    path = stream.video_path
    if not path.is_file():
        raise VideoError("file-missing", path, "does not exist")
    try:
        table = sample_table_of(path)
    except Refused as reason:
        raise VideoError("video-unreadable", path, f"has no plain index: {reason}") from None
    except OSError as error:
        raise VideoError("video-unreadable", path, f"cannot be read: {error}") from None
    ticks = table.presentation[table.order]
    if len(ticks) != len(stream):
        raise VideoError(
            "frame-count", path, f"has {len(ticks)} frames, but its sidecar says {len(stream)}"
        )
    whole, part = np.divmod(ticks, table.timescale)
    times: NDArray[np.int64] = whole * _MICROSECONDS + part * _MICROSECONDS // table.timescale
    if (np.diff(times) <= 0).any():
        raise VideoError("video-unreadable", path, "has presentation times that do not increase")
    return times


# ---------------------------------------------------------------- timing

_WIDER = 2  # times the span of the log times; beyond it, stamps come from several clocks
_SLACK_NS = 10 * 10**9
_DAY_NS = 86_400 * 10**9
_NO_STAMPS, _OTHER_CLOCK = "no header stamps", "stamps from another clock"


def untimed(cameras: Sequence[Mapping[str, Integers]]) -> list[str]:
    """Why the stamps of each camera cannot be compared with the others'; empty if they can.

    Args:
        cameras: Columns ``stamp`` and ``log_time`` of each.
    """
    have_stamps = [bool(columns["stamp"].any()) for columns in cameras]
    is_far = [
        abs(float(np.median(differences(columns["log_time"], columns["stamp"])))) > _DAY_NS
        for columns in cameras
    ]
    # if all are far from the record times, as in a simulation, they are close to each other
    pairs = list(zip(have_stamps, is_far, strict=True))
    has_near = (True, False) in pairs
    return [
        _NO_STAMPS if not has else _OTHER_CLOCK if far and has_near else "" for has, far in pairs
    ]


def axis_of(cameras: Sequence[Mapping[str, Integers]]) -> str:
    """Which times synchronise all cameras: ``stamp`` or ``log_time``.

    Stamps, if those of every camera mostly advance and come from one clock.

    Args:
        cameras: Columns ``stamp`` and ``log_time`` of each.
    """
    for columns in cameras:
        steps = intervals(columns["stamp"])
        if 2 * int((steps > 0).sum()) < len(steps):
            return "log_time"
    stamps, log_times = (
        max((int(columns[name].max()) for columns in cameras), default=0)
        - min((int(columns[name].min()) for columns in cameras), default=0)
        for name in ("stamp", "log_time")
    )
    is_one_clock = stamps <= _WIDER * log_times + _SLACK_NS
    return "stamp" if is_one_clock else "log_time"


# ---------------------------------------------------------------- packed columns


def pack_column(values: NDArray[np.int64]) -> dict[str, Any]:
    """A column of 64-bit integers, exactly.

    ``value[0] = start`` and ``value[i] = value[i-1] + step + residual[i-1]``, modulo 2^64.

    Args:
        values: At least one.

    Returns:
        ``start`` and ``step`` in decimal digits, since JavaScript numbers have 53 bits; the
        residuals as ``values`` in base64, little-endian, each of ``size`` bytes.
    """
    with np.errstate(over="ignore"):
        steps = np.diff(values)
        step = np.partition(steps, len(steps) // 2)[len(steps) // 2] if len(steps) else np.int64(0)
        residuals = steps - step
    size = next(n for n in (1, 2, 4, 8) if (residuals.astype(f"<i{n}") == residuals).all())
    return {
        "start": str(int(values[0])),
        "step": str(int(step)),
        "size": size,
        "values": base64.b64encode(residuals.astype(f"<i{size}").tobytes()).decode(),
    }


# ---------------------------------------------------------------- cameras

_MOST_CALIBRATIONS = 64
"""Calibration changes listed on the page; a self-calibrating camera has more."""


@dataclass
class ReportedCamera:
    """One stream on the page.

    Attributes:
        stream: What is shown: the view of the recorded stream if it has one.
        recorded: What holds the messages, as far as that is here.
        name: Its topic, with its file name if the topic has several streams.
        times: Presentation times of its frames, microseconds; None if the video is damaged.
        video: URL of the video to play, relative to the page; empty: none.
        stills: URL of a picture by the number of its frame, where no video is played.
        note: Why none is played.
        caption: How the stills differ from the image.
    """

    stream: Stream
    recorded: Stream
    name: str
    times: NDArray[np.int64] | None = None
    video: str = ""
    stills: dict[int, str] = field(default_factory=dict)
    note: str = ""
    caption: str = ""

    @property
    def plays(self) -> str:
        """What the page shows: its ``video``, ``stills`` or ``nothing``."""
        return "video" if self.video else "stills" if self.stills else "nothing"

    def check(self) -> None:
        """Read its columns.

        Raises:
            FormatError: They break a rule of the format, or there is no video.
        """
        _ = self.stream.columns
        _ = self.stream.infos and self.stream.infos.columns
        _ = self._scores()

    def columns(self) -> dict[str, Any]:
        """All of its columns, for the page."""
        columns: dict[str, Any] = {
            "frames": len(self.stream),
            "stamp": pack_column(self.stream.stamps),
            "log_time": pack_column(self.stream.log_times),
            "scores": self._scores(),
        }
        if self.times is not None:
            columns["ticks"] = pack_column(self.times)
        return columns

    def _scores(self) -> dict[str, str]:
        """The score of each frame, if some were measured when packing."""
        quality = self.stream.sidecar.video.quality
        if quality is None:
            return {}
        try:
            scores = quality.decode(len(self.stream)).astype("<f4").tobytes()
            return {quality.metric: base64.b64encode(scores).decode()}  # NaN if there is none
        except ValueError as error:
            place = f"{self.stream.path} at video.quality.scores"
            raise FormatError("scores-invalid", place, str(error)) from None

    def facts(self, number: int, untimed: str) -> dict[str, Any]:
        """What the page shows about it besides its columns, and what it computes of them.

        Args:
            number: Of the camera on the page.
            untimed: Why its stamps are not compared with others; empty: they are.
        """
        sidecar, seq = self.stream.sidecar, self.stream.columns.seq
        image, video = sidecar.image, sidecar.video
        layers = dict.fromkeys((self.stream, self.recorded))  # the view first
        # a video may be padded
        shown = (image.width / video.width, image.height / video.height) if self.video else (1, 1)
        steps = np.empty(0, np.int64) if seq is None else np.diff(seq)
        return {
            "name": self.name,
            "columns": f"report/columns-{number}.js",
            "frames": len(self.stream),
            "encoding": image.encoding,
            "width": image.width,
            "height": image.height,
            "stored": ", ".join(f"{o.sidecar.video.codec} {o.sidecar.profile}" for o in layers),
            "file": video.file,
            "video": self.video,
            "stills": [{"frame": number, "file": url} for number, url in self.stills.items()],
            "note": self.note,
            "caption": self.caption,
            "shown": shown,
            "seq_missing": None if seq is None else sum((steps[steps > 1] - 1).tolist()),
            "untimed": untimed,
            **self._calibrations(),
        }

    def _calibrations(self) -> dict[str, Any]:
        """Each calibration that differs from the previous one, and its first frame."""
        info, infos = self.stream.sidecar.camera_info, self.stream.infos
        known = info.calibrations if info else []
        frames = [0] * len(known)  # without messages
        if infos is not None:
            places = np.flatnonzero(np.diff(infos.columns.variant, prepend=-1))
            known = [known[variant] for variant in infos.columns.variant[places].tolist()]
            frames = np.searchsorted(self.stream.log_times, infos.columns.log_time[places]).tolist()
            frames[:1] = [0]  # the first one also applies before it
        return {
            "calibrations": [
                item.model_dump(exclude={"template"}) | {"from_frame": frame}
                for item, frame in zip(known, frames, strict=True)
            ][:_MOST_CALIBRATIONS],
            "calibration_topic": info.channel.topic if info else "",
            "calibrations_more": max(0, len(known) - _MOST_CALIBRATIONS),
        }
