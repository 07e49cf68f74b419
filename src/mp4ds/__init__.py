"""Robot camera recordings as mp4 files with YAML sidecars, and back again exactly.

The public surface, and nothing else::

    mp4ds.pack("drive.bag", "drive")            a recording into a dataset
    mp4ds.unpack("drive", "bag", "again.bag")   and back
    mp4ds.import_ros_mp4("a.mp4", "a.yaml", "a")   a dataset of the paper's tool as it is
    mp4ds.export("drive", "euroc", "for_slam")  EuRoC, TUM, KITTI, COLMAP, Rerun, LeRobot
    mp4ds.evaluate("drive.bag").recommended     encoder settings, tried on clips of its cameras
    mp4ds.play("drive")                         as if it were the recording: ROS 1, ROS 2, Foxglove
    mp4ds.validate("drive", deep=True)          every problem, or an empty list
    mp4ds.open("drive")["/camera/image_raw"][7].data
    mp4ds.open("drive")["/camera/image_raw"].read([7, 3, 9], format="rgb", resize=0.5)

Modules are imported when first used, so that ``import mp4ds`` is cheap.
"""

from __future__ import annotations

from importlib import import_module

from mp4ds._version import __version__

TYPE_CHECKING = False  # without typing, whose import costs more than all of this
if TYPE_CHECKING:
    from typing import Any

    from mp4ds.checks import Problem, validate
    from mp4ds.dataset import Dataset
    from mp4ds.dataset import open_dataset as open
    from mp4ds.errors import (
        ClusterError,
        ConversionError,
        FormatError,
        FrameNotFoundError,
        Mp4dsError,
        OptionError,
        PartsFailedError,
        PublishError,
        RemoteError,
        SourceError,
        SourceNotFoundError,
        TargetError,
        TargetExistsError,
        VersionError,
        VideoError,
        WriteError,
    )
    from mp4ds.evaluating import EvaluateOptions, Evaluation, evaluate
    from mp4ds.exporting import ExportOptions, ExportSummary, export
    from mp4ds.importing import ImageFolder
    from mp4ds.packing import PackOptions, PackSummary, pack, pack_each, pack_share
    from mp4ds.packing.ros_mp4 import import_ros_mp4
    from mp4ds.playing import PlayOptions, PlaySummary, play
    from mp4ds.recorded import RecordedMessage
    from mp4ds.streams import Frame, Frames, Stream, TopicFrames, Video
    from mp4ds.sync import Sync
    from mp4ds.unpacking import UnpackOptions, UnpackSummary, unpack

_HOMES = {
    "checks": ("Problem", "validate"),
    "dataset": ("Dataset",),
    "errors": (
        "ClusterError",
        "ConversionError",
        "FormatError",
        "FrameNotFoundError",
        "Mp4dsError",
        "OptionError",
        "PartsFailedError",
        "PublishError",
        "RemoteError",
        "SourceError",
        "SourceNotFoundError",
        "TargetError",
        "TargetExistsError",
        "VersionError",
        "VideoError",
        "WriteError",
    ),
    "importing": ("ImageFolder",),
    "packing": ("PackOptions", "PackSummary", "pack", "pack_each", "pack_share"),
    "packing.ros_mp4": ("import_ros_mp4",),
    "evaluating": ("EvaluateOptions", "Evaluation", "evaluate"),
    "exporting": ("ExportOptions", "ExportSummary", "export"),
    "playing": ("PlayOptions", "PlaySummary", "play"),
    "recorded": ("RecordedMessage",),
    "streams": ("Frame", "Frames", "Stream", "TopicFrames", "Video"),
    "sync": ("Sync",),
    "unpacking": ("UnpackOptions", "UnpackSummary", "unpack"),
}

__all__ = [
    "ClusterError",
    "ConversionError",
    "Dataset",
    "EvaluateOptions",
    "Evaluation",
    "ExportOptions",
    "ExportSummary",
    "FormatError",
    "Frame",
    "FrameNotFoundError",
    "Frames",
    "ImageFolder",
    "Mp4dsError",
    "OptionError",
    "PackOptions",
    "PackSummary",
    "PartsFailedError",
    "PlayOptions",
    "PlaySummary",
    "Problem",
    "PublishError",
    "RecordedMessage",
    "RemoteError",
    "SourceError",
    "SourceNotFoundError",
    "Stream",
    "Sync",
    "TargetError",
    "TargetExistsError",
    "TopicFrames",
    "UnpackOptions",
    "UnpackSummary",
    "VersionError",
    "Video",
    "VideoError",
    "WriteError",
    "__version__",
    "evaluate",
    "export",
    "import_ros_mp4",
    "open",
    "pack",
    "pack_each",
    "pack_share",
    "play",
    "unpack",
    "validate",
]


def __getattr__(name: str) -> Any:
    if name == "open":
        return import_module("mp4ds.dataset").open_dataset
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"mp4ds.{module}"), name)
    raise AttributeError(f"module 'mp4ds' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
