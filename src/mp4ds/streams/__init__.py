"""One stream of a dataset: messages into a video with its sidecar, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mp4ds.lazily import names_of

if TYPE_CHECKING:
    from mp4ds.streams.bodies import MessageRebuilder
    from mp4ds.streams.camera_info import CameraInfoWriter
    from mp4ds.streams.columns import ColumnsWriter, Unsuited
    from mp4ds.streams.frames import Frame, Frames
    from mp4ds.streams.headers import Forms
    from mp4ds.streams.join import StreamJoin
    from mp4ds.streams.look import Looker, Seen, StreamKey, depends_on_others
    from mp4ds.streams.planning import needs_trial, plan_from_values, plan_to_values, plan_tracks
    from mp4ds.streams.reader import Stream
    from mp4ds.streams.rebuild import CameraInfoRebuilder
    from mp4ds.streams.topic_frames import TopicFrames
    from mp4ds.streams.tracks import (
        OutOfReachError,
        PicturePlan,
        StreamSettings,
        TargetPlan,
        TrackPlan,
    )
    from mp4ds.streams.video_file import Video
    from mp4ds.streams.writer import StreamWriter
else:
    __getattr__ = names_of(
        __name__,
        bodies="MessageRebuilder",
        camera_info="CameraInfoWriter",
        columns="ColumnsWriter Unsuited",
        frames="Frame Frames",
        headers="Forms",
        join="StreamJoin",
        look="Looker Seen StreamKey depends_on_others",
        planning="needs_trial plan_from_values plan_to_values plan_tracks",
        reader="Stream",
        rebuild="CameraInfoRebuilder",
        topic_frames="TopicFrames",
        tracks="OutOfReachError PicturePlan StreamSettings TargetPlan TrackPlan",
        video_file="Video",
        writer="StreamWriter",
    )

__all__ = [
    "CameraInfoRebuilder",
    "CameraInfoWriter",
    "ColumnsWriter",
    "Forms",
    "Frame",
    "Frames",
    "Looker",
    "MessageRebuilder",
    "OutOfReachError",
    "PicturePlan",
    "Seen",
    "Stream",
    "StreamJoin",
    "StreamKey",
    "StreamSettings",
    "StreamWriter",
    "TargetPlan",
    "TopicFrames",
    "TrackPlan",
    "Unsuited",
    "Video",
    "depends_on_others",
    "needs_trial",
    "plan_from_values",
    "plan_to_values",
    "plan_tracks",
]
