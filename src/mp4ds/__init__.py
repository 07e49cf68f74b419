"""Robot camera recordings as mp4 files with YAML sidecars, and back again exactly.

The public API, and nothing else::

    mp4ds.pack("drive.mcap", "drive")            recording -> dataset
    mp4ds.unpack("drive", "bag", "again.bag")   dataset -> recording
    mp4ds.import_ros_mp4("a.mp4", "a.yaml", "a")   converts a pair made by the paper's tool
    mp4ds.export("drive", "euroc", "for_slam")  EuRoC, TUM, COLMAP, LeRobot
    mp4ds.evaluate("drive.mcap").recommended     encoder settings, tried on clips
    mp4ds.report("drive")                       a page with its cameras, timing and calibrations
    mp4ds.play("drive")                         publishes to ROS 1 or ROS 2
    mp4ds.record(["/imu", "/cam*/*"], "drive")  a live robot -> dataset
    mp4ds.validate("drive", deep=True)          every problem, or an empty list
    mp4ds.open("drive")["/camera/image_raw"][7].data
    mp4ds.open("drive")["/camera/image_raw"].read([7, 3, 9], format="rgb", resize=0.5)

Modules are imported when first used, so that ``import mp4ds`` is cheap.
"""

from __future__ import annotations

from importlib import import_module

from mp4ds._version import __version__
from mp4ds.errors import (
    ClusterError,
    ConversionError,
    EncoderRefusedError,
    FormatError,
    FrameNotFoundError,
    Mp4dsError,
    OptionError,
    PartsFailedError,
    PathError,
    PublishError,
    RemoteError,
    SampleError,
    ScoringError,
    SourceError,
    SourceNotFoundError,
    TargetError,
    TargetExistsError,
    VersionError,
    VideoError,
    WriteError,
)

TYPE_CHECKING = False  # without typing, whose import costs more than all of this
if TYPE_CHECKING:
    from typing import Any

    from mp4ds.dataset.checks import Problem, validate
    from mp4ds.dataset.dataset import Dataset
    from mp4ds.dataset.dataset import open_dataset as open
    from mp4ds.dataset.messages import RecordedMessage
    from mp4ds.dataset.stream import Stream
    from mp4ds.dataset.topic import Frame, Topic
    from mp4ds.packing.options import ImageFolder, PackOptions, PackSummary
    from mp4ds.packing.pack import pack, pack_each, pack_share
    from mp4ds.plugins.evaluating.evaluate import EvaluateOptions, evaluate
    from mp4ds.plugins.evaluating.trials import Evaluation
    from mp4ds.plugins.exporting.export import export
    from mp4ds.plugins.exporting.job import ExportOptions, ExportSummary
    from mp4ds.plugins.importing.ros_mp4 import import_ros_mp4
    from mp4ds.plugins.playing.options import PlayOptions
    from mp4ds.plugins.playing.play import play
    from mp4ds.plugins.playing.player import PlaySummary
    from mp4ds.plugins.recording.options import RecordOptions
    from mp4ds.plugins.recording.record import RecordSummary, record
    from mp4ds.plugins.reporting.report import ReportOptions, ReportSummary, report
    from mp4ds.times import Sync
    from mp4ds.unpacking.options import UnpackOptions, UnpackSummary
    from mp4ds.unpacking.unpack import unpack

_HOMES = {
    "dataset.checks": "Problem validate",
    "dataset.dataset": "Dataset open",
    "dataset.messages": "RecordedMessage",
    "dataset.stream": "Stream",
    "dataset.topic": "Frame Topic",
    "packing.options": "ImageFolder PackOptions PackSummary",
    "packing.pack": "pack pack_each pack_share",
    "plugins.evaluating.evaluate": "EvaluateOptions evaluate",
    "plugins.evaluating.trials": "Evaluation",
    "plugins.exporting.export": "export",
    "plugins.exporting.job": "ExportOptions ExportSummary",
    "plugins.importing.ros_mp4": "import_ros_mp4",
    "plugins.playing.options": "PlayOptions",
    "plugins.playing.play": "play",
    "plugins.playing.player": "PlaySummary",
    "plugins.recording.options": "RecordOptions",
    "plugins.recording.record": "RecordSummary record",
    "plugins.reporting.report": "ReportOptions ReportSummary report",
    "times": "Sync",
    "unpacking.options": "UnpackOptions UnpackSummary",
    "unpacking.unpack": "unpack",
}
"""Modules that are imported when one of their names is first used -> the names."""

__all__ = [
    "ClusterError",
    "ConversionError",
    "Dataset",
    "EncoderRefusedError",
    "EvaluateOptions",
    "Evaluation",
    "ExportOptions",
    "ExportSummary",
    "FormatError",
    "Frame",
    "FrameNotFoundError",
    "ImageFolder",
    "Mp4dsError",
    "OptionError",
    "PackOptions",
    "PackSummary",
    "PartsFailedError",
    "PathError",
    "PlayOptions",
    "PlaySummary",
    "Problem",
    "PublishError",
    "RecordOptions",
    "RecordSummary",
    "RecordedMessage",
    "RemoteError",
    "ReportOptions",
    "ReportSummary",
    "SampleError",
    "ScoringError",
    "SourceError",
    "SourceNotFoundError",
    "Stream",
    "Sync",
    "TargetError",
    "TargetExistsError",
    "Topic",
    "UnpackOptions",
    "UnpackSummary",
    "VersionError",
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
    "record",
    "report",
    "unpack",
    "validate",
]


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names.split():
            own_name = "open_dataset" if name == "open" else name
            return getattr(import_module(f"mp4ds.{module}"), own_name)
    raise AttributeError(f"module 'mp4ds' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
