"""Robot camera recordings as mp4 files with YAML sidecars, and back again exactly.

The public API, and nothing else:

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

from mp4ds._version import __version__ as __version__

TYPE_CHECKING = False  # without typing, whose import costs more than all of this
if TYPE_CHECKING:
    from typing import Any

    from mp4ds.dataset.checks import Problem as Problem
    from mp4ds.dataset.checks import validate as validate
    from mp4ds.dataset.dataset import Dataset as Dataset
    from mp4ds.dataset.dataset import open_dataset as open
    from mp4ds.dataset.messages import RecordedMessage as RecordedMessage
    from mp4ds.dataset.redaction import Box as Box
    from mp4ds.dataset.stream import Stream as Stream
    from mp4ds.dataset.topic import Frame as Frame
    from mp4ds.dataset.topic import Topic as Topic
    from mp4ds.errors import ConversionError as ConversionError
    from mp4ds.errors import EncoderRefusedError as EncoderRefusedError
    from mp4ds.errors import FormatError as FormatError
    from mp4ds.errors import FrameNotFoundError as FrameNotFoundError
    from mp4ds.errors import Mp4dsError as Mp4dsError
    from mp4ds.errors import OptionError as OptionError
    from mp4ds.errors import PartsFailedError as PartsFailedError
    from mp4ds.errors import PathError as PathError
    from mp4ds.errors import RemoteError as RemoteError
    from mp4ds.errors import SampleError as SampleError
    from mp4ds.errors import ScoringError as ScoringError
    from mp4ds.errors import SourceError as SourceError
    from mp4ds.errors import SourceNotFoundError as SourceNotFoundError
    from mp4ds.errors import TargetError as TargetError
    from mp4ds.errors import TargetExistsError as TargetExistsError
    from mp4ds.errors import VersionError as VersionError
    from mp4ds.errors import VideoError as VideoError
    from mp4ds.errors import WriteError as WriteError
    from mp4ds.packing.options import ImportOptions as ImportOptions
    from mp4ds.packing.options import PackOptions as PackOptions
    from mp4ds.packing.options import PackSummary as PackSummary
    from mp4ds.packing.pack import pack as pack
    from mp4ds.packing.pack import pack_each as pack_each
    from mp4ds.packing.pack import pack_share as pack_share
    from mp4ds.plugins.evaluating.evaluate import EvaluateOptions as EvaluateOptions
    from mp4ds.plugins.evaluating.evaluate import evaluate as evaluate
    from mp4ds.plugins.evaluating.trials import Evaluation as Evaluation
    from mp4ds.plugins.exporting.export import export as export
    from mp4ds.plugins.exporting.job import ExportOptions as ExportOptions
    from mp4ds.plugins.exporting.job import ExportSummary as ExportSummary
    from mp4ds.plugins.importing.ros_mp4 import import_ros_mp4 as import_ros_mp4
    from mp4ds.plugins.playing.options import PlayOptions as PlayOptions
    from mp4ds.plugins.playing.player import PlaySummary as PlaySummary
    from mp4ds.plugins.playing.player import play as play
    from mp4ds.plugins.recording.options import RecordOptions as RecordOptions
    from mp4ds.plugins.recording.record import RecordSummary as RecordSummary
    from mp4ds.plugins.recording.record import record as record
    from mp4ds.plugins.reporting.report import ReportOptions as ReportOptions
    from mp4ds.plugins.reporting.report import ReportSummary as ReportSummary
    from mp4ds.plugins.reporting.report import report as report
    from mp4ds.times import Sync as Sync
    from mp4ds.unpacking.unpack import UnpackOptions as UnpackOptions
    from mp4ds.unpacking.unpack import UnpackSummary as UnpackSummary
    from mp4ds.unpacking.unpack import unpack as unpack

_HOMES = {
    "dataset.checks": "Problem validate",
    "dataset.dataset": "Dataset open",
    "dataset.messages": "RecordedMessage",
    "dataset.redaction": "Box",
    "dataset.stream": "Stream",
    "dataset.topic": "Frame Topic",
    "errors": (
        "ConversionError EncoderRefusedError FormatError FrameNotFoundError Mp4dsError "
        "OptionError PartsFailedError PathError RemoteError SampleError ScoringError "
        "SourceError SourceNotFoundError TargetError TargetExistsError VersionError "
        "VideoError WriteError"
    ),
    "packing.options": "ImportOptions PackOptions PackSummary",
    "packing.pack": "pack pack_each pack_share",
    "plugins.evaluating.evaluate": "EvaluateOptions evaluate",
    "plugins.evaluating.trials": "Evaluation",
    "plugins.exporting.export": "export",
    "plugins.exporting.job": "ExportOptions ExportSummary",
    "plugins.importing.ros_mp4": "import_ros_mp4",
    "plugins.playing.options": "PlayOptions",
    "plugins.playing.player": "PlaySummary play",
    "plugins.recording.options": "RecordOptions",
    "plugins.recording.record": "RecordSummary record",
    "plugins.reporting.report": "ReportOptions ReportSummary report",
    "times": "Sync",
    "unpacking.unpack": "UnpackOptions UnpackSummary unpack",
}
"""Modules that are imported when one of their names is first used -> the names."""

__all__ = sorted(["__version__", *" ".join(_HOMES.values()).split()])


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names.split():
            own_name = "open_dataset" if name == "open" else name
            return getattr(import_module(f"mp4ds.{module}"), own_name)
    raise AttributeError(f"module 'mp4ds' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
