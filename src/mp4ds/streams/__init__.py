"""One stream of a dataset: messages into a video with its sidecar, and back."""

from __future__ import annotations

from mp4ds.streams.bodies import MessageRebuilder
from mp4ds.streams.camera_info import CameraInfoWriter
from mp4ds.streams.columns import ColumnsWriter, Unsuited
from mp4ds.streams.headers import Forms
from mp4ds.streams.look import Looker, Seen, StreamKey
from mp4ds.streams.reader import Frame, Stream
from mp4ds.streams.rebuild import CameraInfoRebuilder
from mp4ds.streams.tracks import StreamSettings, TrackPlan, needs_trial, plan_tracks
from mp4ds.streams.writer import StreamWriter

__all__ = [
    "CameraInfoRebuilder",
    "CameraInfoWriter",
    "ColumnsWriter",
    "Forms",
    "Frame",
    "Looker",
    "MessageRebuilder",
    "Seen",
    "Stream",
    "StreamKey",
    "StreamSettings",
    "StreamWriter",
    "TrackPlan",
    "Unsuited",
    "needs_trial",
    "plan_tracks",
]
