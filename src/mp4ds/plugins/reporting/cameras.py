"""What the page shows of a camera: its video or stills, columns, timing and calibrations."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.stream import Stream
from mp4ds.dataset.views import effective, lens_of
from mp4ds.errors import FormatError, Refused, VideoError
from mp4ds.format.models import Calibration
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.plugins.info import calibration_changes
from mp4ds.times import Floats, Integers, differences, intervals
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
    reason = _why_not_in_browsers(stream.video_path)
    if not reason and stream.sidecar.body != "packet" and not stream.sidecar.layout.is_shown:
        reason = f"its video stores {stream.encoding} and does not look like the image"
    encoding = ENCODINGS[stream.encoding]
    if reason and encoding.lossy and encoding.channels < 4:  # alpha has no view
        reason += "; `mp4ds pack DATASET -o NEW --view` adds a video that does"
    return reason


def _why_not_in_browsers(path: Path) -> str:
    with closing(Media(path)) as media:
        context = media.track.codec_context
        name, pixel_format = context.codec.canonical_name, pixel_format_of(context)
    if name not in _PLAYED:
        return f"{'few browsers play' if name in _FEW else 'no browser plays'} {name}"
    if pixel_format not in _PLAYED[name]:
        return f"no browser plays {name} in the pixel format {pixel_format}"
    return ""


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
    spans = {name: _span([columns[name] for columns in cameras]) for name in ("stamp", "log_time")}
    is_one_clock = spans["stamp"] <= _WIDER * spans["log_time"] + _SLACK_NS
    return "stamp" if is_one_clock else "log_time"


def _span(columns: Sequence[Integers]) -> int:
    if not columns:
        return 0
    return max(int(c.max()) for c in columns) - min(int(c.min()) for c in columns)


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


def pack_floats(values: NDArray[np.float32]) -> str:
    """32-bit floats, little-endian, in base64; NaN if there is none."""
    return base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()


# ---------------------------------------------------------------- grids

_CELLS = 12  # over the width of the image
_POINTS = 97  # of a line
_MARGIN = 0.02  # of the image's sides, beyond which a line is cut
_REACH, _FARTHEST = 2.5, 5  # times the image without distortion, from its principal point
_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
_MOST_D = 12  # beyond are the tilts of a sensor


def overlay_of(calibration: Calibration, image_size: tuple[int, int], topic: str) -> dict[str, Any]:
    """A grid of straight lines as a calibrated camera sees it, to draw over its images.

    The lines are evenly spaced in a plane in front of the camera.

    Args:
        calibration: Of the camera.
        image_size: Width and height of the images, pixels.
        topic: Of the images: on image_proc's rectified topics P applies, without distortion.

    Returns:
        ``lines``, each a list of x, y, x, y ...; ``axes``, the indices of those through the
        principal point; ``center``, x and y of that point; ``problem``, why there are no lines.
        All as fractions of the image's width and height.
    """
    k, p = (np.array(matrix) for matrix in effective(calibration.fields))
    is_rectified = any(part.startswith("image_rect") for part in topic.split("/"))
    matrix = p[:, :3] if is_rectified else k
    model, d = ("none", []) if is_rectified else lens_of(calibration)
    problem = _problem(calibration, matrix, model, d, image_size)
    if problem:
        return {"lines": [], "axes": [], "center": [], "problem": problem}
    width, height = image_size
    (fx, _, cx), (_, fy, cy) = matrix[0], matrix[1]
    step = width / fx / _CELLS
    lines: list[list[float]] = []
    axes: list[int] = []
    reach = [
        min(_REACH * max(center, side - center), _FARTHEST * side)
        for center, side in ((cx, width), (cy, height))
    ]
    ends = reach[0] / fx, reach[1] / fy
    for axis in (0, 1):
        along = np.linspace(-ends[1 - axis], ends[1 - axis], _POINTS)
        for number in range(-int(ends[axis] / step), int(ends[axis] / step) + 1):
            across = np.full(_POINTS, number * step)
            x, y = (across, along) if axis == 0 else (along, across)
            distorted_x, distorted_y, is_sound = _distort(x, y, model, d)
            u = (fx * distorted_x + matrix[0, 1] * distorted_y + cx + 0.5) / width
            v = (fy * distorted_y + cy + 0.5) / height
            for line in _inside(u, v, is_sound):
                axes += [len(lines)] if number == 0 else []
                lines.append(line)
    center = [round((cx + 0.5) / width, 5), round((cy + 0.5) / height, 5)]
    return {"lines": lines, "axes": axes, "center": center, "problem": ""}


def _problem(
    calibration: Calibration,
    matrix: Floats,
    model: str,
    d: Sequence[float],
    image_size: tuple[int, int],
) -> str:
    """Why no grid is possible."""
    size = calibration.width, calibration.height
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        return "the camera is not calibrated"
    roi = calibration.roi
    cut = (roi.width or size[0], roi.height or size[1]) if roi else size
    seen = cut[0] // max(1, calibration.binning_x), cut[1] // max(1, calibration.binning_y)
    if 0 not in size and seen != image_size:
        return f"it is for images of {seen[0]}x{seen[1]}, these are {image_size[0]}x{image_size[1]}"
    if not any(d):
        return ""
    if model not in _MODELS:
        return f"the distortion model {model!r} is not supported here"
    if not np.isfinite(d).all() or any(d[_MOST_D:]):
        return "its sensor is tilted, which is not supported"
    return ""


def _distort(
    x: Floats, y: Floats, model: str, d: Sequence[float]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Where a lens maps points of the plane at distance 1, and which of them are in view."""
    if not any(d):
        return x, y, np.ones(len(x), np.bool_)
    with np.errstate(all="ignore"):  # far outside the view
        if model == "equidistant":
            return _fisheye(x, y, d)
        return _polynomial(x, y, d)


def _fisheye(x: Floats, y: Floats, d: Sequence[float]) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    coefficients = [*d[:4], *[0.0] * (4 - len(d[:4]))]
    radius = np.hypot(x, y)
    angle = np.arctan(radius)
    square = angle * angle
    factor, slope = np.ones_like(angle), np.ones_like(angle)
    for power, value in enumerate(coefficients, 1):
        factor += value * square**power
        slope += (2 * power + 1) * value * square**power
    scale = np.where(radius > 0, angle * factor / np.where(radius > 0, radius, 1.0), 1.0)
    return x * scale, y * scale, (slope > 0) & (factor > 0)


def _polynomial(
    x: Floats, y: Floats, d: Sequence[float]
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = [*d[:_MOST_D], *[0.0] * (_MOST_D - len(d))][
        :_MOST_D
    ]
    square = x * x + y * y
    above = 1 + square * (k1 + square * (k2 + square * k3))
    below = 1 + square * (k4 + square * (k5 + square * k6))
    factor = above / below
    # beyond its turning point the polynomial is meaningless
    above_slope = k1 + square * (2 * k2 + square * 3 * k3)
    below_slope = k4 + square * (2 * k5 + square * 3 * k6)
    slope = factor + 2 * square * (above_slope * below - above * below_slope) / (below * below)
    distorted_x = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    distorted_y = y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    distorted_x += square * (s1 + square * s2)
    distorted_y += square * (s3 + square * s4)
    return distorted_x, distorted_y, (slope > 0) & (below > 0)


def _inside(u: Floats, v: Floats, is_sound: NDArray[np.bool_]) -> list[list[float]]:
    """The parts of a line inside the image."""
    with np.errstate(invalid="ignore"):
        seen = is_sound & (np.abs(u - 0.5) < 0.5 + _MARGIN) & (np.abs(v - 0.5) < 0.5 + _MARGIN)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], seen.astype(np.int8), [0]))))
    parts = []
    for start, end in edges.reshape(-1, 2):
        if end - start > 1:
            points = np.stack([u[start:end], v[start:end]], axis=1)
            parts.append(np.round(points, 5).ravel().tolist())
    return parts


# ---------------------------------------------------------------- cameras

_MOST_CALIBRATIONS = 64
"""Calibration changes listed on the page; a self-calibrating camera has more."""

_MOST_OVERLAYS = 8


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
            return {quality.metric: pack_floats(quality.decode(len(self.stream)).astype("<f4"))}
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
        steps = np.empty(0, np.int64) if seq is None else np.diff(seq)
        return {
            "name": self.name,
            "columns": f"report/columns-{number}.js",
            "frames": len(self.stream),
            "encoding": sidecar.image.encoding,
            "width": sidecar.image.width,
            "height": sidecar.image.height,
            "stored": self._stored(),
            "file": sidecar.video.file,
            "video": self.video,
            "stills": [{"frame": number, "file": url} for number, url in self.stills.items()],
            "note": self.note,
            "caption": self.caption,
            "shown": self._shown(),
            "seq_missing": None if seq is None else sum((steps[steps > 1] - 1).tolist()),
            "untimed": untimed,
            **self._calibrations(),
        }

    def _stored(self) -> str:
        """Codec and profile, after those of the view if there is one."""
        layers = dict.fromkeys((self.stream, self.recorded))
        return ", ".join(f"{one.sidecar.video.codec} {one.sidecar.profile}" for one in layers)

    def _shown(self) -> list[float]:
        """The image's fraction of the played video's width and height: a video may be padded."""
        image, video = self.stream.sidecar.image, self.stream.sidecar.video
        if not self.video:
            return [1.0, 1.0]
        return [image.width / video.width, image.height / video.height]

    def _calibrations(self) -> dict[str, Any]:
        """Each calibration that differs from the previous one, and its first frame."""
        info, changes = self.stream.sidecar.camera_info, calibration_changes(self.stream)
        listed: list[dict[str, Any]] = []
        for number, (item, _, log_time) in enumerate(changes[:_MOST_CALIBRATIONS]):
            made = item.model_dump(exclude={"template"})
            made["from_frame"] = 0  # the first one also applies before it
            if number and log_time is not None:
                made["from_frame"] = int(np.searchsorted(self.stream.log_times, log_time))
            if number < _MOST_OVERLAYS:
                made["overlay"] = overlay_of(item, self.stream.image_size, self.stream.topic)
            listed.append(made)
        return {
            "calibrations": listed,
            "calibration_topic": info.channel.topic if info else "",
            "calibrations_more": max(0, len(changes) - _MOST_CALIBRATIONS),
        }
