"""What the page knows of a camera: its columns, its figures, its calibrations."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.report.grid import Overlay, overlay_of
from mp4ds.report.packed import pack_column, pack_floats
from mp4ds.report.proxies import why_not_seen
from mp4ds.report.scores import Scores
from mp4ds.report.timing import Timing, nearest_offsets, timing_of
from mp4ds.streams import Stream

_MOST_CALIBRATIONS = 64
"""Changes of a calibration that the page lists; of a self-calibrating camera there are more."""

_MOST_OVERLAYS = 8
_NOT_SEEN = Overlay([], [], [], "what is played is not the image")


@dataclass
class Camera:
    """One stream on the page.

    Attributes:
        stream: The stream.
        name: Its topic, or that with the name of its file where the topic has several.
        times: Presentation times of its frames, microseconds; None where the video is damaged.
        video: URL of what the page plays, from the page; empty: nothing.
        is_proxy: Whether that is a proxy.
        note: Why there is a proxy, or nothing to play.
        caption: What the pictures show besides the image.
        scores: Of its frames.
    """

    stream: Stream
    name: str
    times: NDArray[np.int64] | None = None
    video: str = ""
    is_proxy: bool = False
    note: str = ""
    caption: str = ""
    scores: Scores = field(default_factory=dict)

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds."""
        return self.stream.stamps

    @property
    def log_times(self) -> NDArray[np.int64]:
        """Log times, nanoseconds."""
        return self.stream.log_times

    def check(self) -> None:
        """Read its columns.

        Raises:
            FormatError: They break a rule of the format, or there is no video.
        """
        _ = self.stream.rebuilder.columns
        _ = self.stream.camera_info_columns

    def timing(self) -> Timing:
        """Its figures."""
        return timing_of(self.stamps, self.log_times, self.stream.rebuilder.columns.seq)

    def columns(self) -> dict[str, Any]:
        """All of its columns, for the page."""
        columns: dict[str, Any] = {
            "frames": len(self.stream),
            "stamp": pack_column(self.stamps),
            "log_time": pack_column(self.log_times),
            "scores": {name: pack_floats(values) for name, values in self.scores.items()},
        }
        if self.times is not None:
            columns["ticks"] = pack_column(self.times)
        return columns

    def facts(self, number: int, reference: Camera | None, untimed: str) -> dict[str, Any]:
        """What the page shows of it besides its columns.

        Args:
            number: Of the camera on the page.
            reference: The camera whose stamps it is compared with; None: none.
            untimed: Why its stamps are not compared; empty: they are.
        """
        sidecar = self.stream.sidecar
        return {
            "name": self.name,
            "columns": f"report/columns-{number}.js",
            "frames": len(self.stream),
            "encoding": sidecar.image.encoding,
            "width": sidecar.image.width,
            "height": sidecar.image.height,
            "codec": sidecar.video.codec,
            "profile": sidecar.profile,
            "file": sidecar.video.file,
            "video": self.video,
            "proxy": self.is_proxy,
            "note": self.note,
            "caption": self.caption,
            "shown": self._shown(),
            "timing": asdict(self.timing()),
            "untimed": untimed,
            "offset": None if reference is None else _offset(self.stamps, reference.stamps),
            **self._calibrations(),
        }

    @property
    def _is_seen(self) -> bool:
        """Whether what is played looks like the image."""
        return self.is_proxy or not why_not_seen(self.stream)

    def _shown(self) -> list[float]:
        """The image's part of the width and height of what is played: a video may be padded."""
        image, video = self.stream.sidecar.image, self.stream.sidecar.video
        if self.is_proxy or not self._is_seen:
            return [1.0, 1.0]
        return [image.width / video.width, image.height / video.height]

    def _calibrations(self) -> dict[str, Any]:
        """Each calibration that differs from the one before, and the frame it holds from."""
        info = self.stream.sidecar.camera_info
        if info is None:
            return {"calibrations": [], "calibration_topic": "", "calibrations_more": 0}
        columns = self.stream.camera_info_columns
        if columns is None:
            changes, frames = np.arange(len(info.calibrations)), np.zeros(1, np.int64)
            variants = changes
        else:
            changes = np.flatnonzero(np.diff(columns.variant, prepend=-1))
            variants = columns.variant[changes]
            frames = np.searchsorted(self.log_times, columns.log_time[changes], side="left")
            frames[0] = 0  # the first one holds before it, too
        listed: list[dict[str, Any]] = []
        size = self.stream.image_size
        pairs = zip(variants.tolist(), frames.tolist(), strict=False)
        for variant, frame in list(pairs)[:_MOST_CALIBRATIONS]:
            item = info.calibrations[variant]
            made = item.model_dump(exclude={"template"})
            if len(listed) < _MOST_OVERLAYS:
                made["overlay"] = asdict(
                    overlay_of(item, size, self.stream.topic) if self._is_seen else _NOT_SEEN
                )
            listed.append({**made, "from_frame": frame})
        return {
            "calibrations": listed,
            "calibration_topic": info.channel.topic,
            "calibrations_more": max(0, len(changes) - _MOST_CALIBRATIONS),
        }


def _offset(stamps: NDArray[np.int64], reference: NDArray[np.int64]) -> dict[str, float]:
    """Figures of the offsets to another camera, milliseconds."""
    offsets = nearest_offsets(stamps, reference) / 1e6
    return {
        "median_ms": float(np.median(offsets)),
        "p99_ms": float(np.percentile(np.abs(offsets), 99)),
        "most_ms": float(np.abs(offsets).max()),
    }
