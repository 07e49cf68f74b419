"""One stream of a dataset: messages into a video with its sidecar, and back."""

from __future__ import annotations

from mp4ds.streams.camera_info import CameraInfoWriter
from mp4ds.streams.columns import ColumnsWriter
from mp4ds.streams.rebuild import CameraInfoRebuilder, ImageRebuilder
from mp4ds.streams.writer import StreamKey, StreamSettings, StreamWriter, Unsuited

__all__ = [
    "CameraInfoRebuilder",
    "CameraInfoWriter",
    "ColumnsWriter",
    "ImageRebuilder",
    "StreamKey",
    "StreamSettings",
    "StreamWriter",
    "Unsuited",
]
