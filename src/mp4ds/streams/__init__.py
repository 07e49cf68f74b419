"""One stream of a dataset: messages into a video with its sidecar, and back."""

from __future__ import annotations

from mp4ds.streams.camera_info import CameraInfoWriter
from mp4ds.streams.columns import ColumnsWriter, Unsuited
from mp4ds.streams.reader import Frame, Stream
from mp4ds.streams.rebuild import CameraInfoRebuilder, ImageRebuilder
from mp4ds.streams.writer import StreamKey, StreamSettings, StreamWriter

__all__ = [
    "CameraInfoRebuilder",
    "CameraInfoWriter",
    "ColumnsWriter",
    "Frame",
    "ImageRebuilder",
    "Stream",
    "StreamKey",
    "StreamSettings",
    "StreamWriter",
    "Unsuited",
]
