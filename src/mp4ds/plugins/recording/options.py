"""The options of a recorder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mp4ds.options import (
    WHAT,
    Options,
    Parsed,
    about,
    argument,
    force,
    option,
    parse_size,
)
from mp4ds.plan import LOSSLESS, MAX_GOP, QualitySetting, parse_quality
from mp4ds.plugins.publishing.names import PLAIN, NodeNames


@dataclass(frozen=True, kw_only=True)
class RecordOptions(Options):
    """How to record."""

    to: str | None = argument("ros1 or ros2; default: the one that is sourced.")
    all: bool = option(
        "Record all topics, including new ones, and all service events (ROS 2).",
        False,
        "-a",
        panel=WHAT,
    )
    all_topics: bool = option(
        "Record all topics, but no service events.",
        False,
        panel=WHAT,
    )
    all_services: bool = option(
        "Record all service events (ROS 2).",
        False,
        panel=WHAT,
    )
    topic_types: Sequence[str] = option(
        "Record topics of this type; repeatable.", (), metavar="TYPE", panel=WHAT
    )
    regex: str = option(
        "Record topics whose name matches a regular expression.", "", "-e", panel=WHAT
    )
    exclude: Sequence[str] = option(
        "Leave out topics that match; repeatable.", (), "--exclude", metavar="GLOB", panel=WHAT
    )
    exclude_topic_types: Sequence[str] = option(
        "Leave out topics of this type; repeatable.", (), metavar="TYPE", panel=WHAT
    )
    exclude_regex: str = option(
        "Leave out topics whose name matches a regular expression.",
        "",
        "--exclude-regex",
        "-x",
        panel=WHAT,
    )
    duration: float | None = option(
        "Stop after N seconds.",
        None,
        "--duration",
        panel=WHAT,
    )
    max_duration: float | None = option(
        "Start a new dataset after this many seconds; 0: never.",
        None,
        "--max-bag-duration",
        "-d",
        metavar="SECONDS",
        panel=WHAT,
    )
    max_size: Parsed[int | None] = option(
        "Start a new dataset at this size, such as 4G.",
        None,
        "--max-size",
        metavar="SIZE",
        parse=parse_size,
        panel=WHAT,
    )
    buffer: int = option(
        "Buffer size in MB; when the buffer is full, the oldest messages are dropped and counted.",
        256,
        "--buffsize",
        "-b",
        least=1,
        most=1_000_000,
    )
    quality: Parsed[QualitySetting] = option(
        "lossless, visual or crf=N.", LOSSLESS, parse=parse_quality
    )
    codec: str | None = option("As in pack; default: the fastest to encode.")
    preset: str | None = option("Encoder preset; default: the fastest.")
    gop: int | None = option(
        "Maximum key frame interval in frames; default: 10, or 30 if lossy.",
        least=1,
        most=MAX_GOP,
    )
    start_paused: bool = option(
        "Start paused.",
        False,
        "--start-paused",
        "--pause",
        panel=WHAT,
    )
    use_sim_time: bool = option("Take log times from /clock, and wait for it.", False)
    node: str | None = option(
        "Node name; default: that of ROS's own recorder.", None, "--node-name"
    )
    discover: bool = option("Keep looking for new topics.", True, "--discovery/--no-discovery")
    polling_interval: float = option(
        "Milliseconds between two checks for new topics.", 100.0, "--polling-interval", "-p"
    )
    hidden: bool = option(
        "Include hidden topics (ROS 2).", False, "--include-hidden-topics", panel=WHAT
    )
    unpublished: bool = option(
        "Include topics without a publisher (ROS 2, with rclpy).",
        False,
        "--include-unpublished-topics",
        panel=WHAT,
    )
    ignore_leaf: bool = option(
        "Leave out topics without a subscriber (ROS 2).", False, "--ignore-leaf-topics", panel=WHAT
    )
    qos_overrides: Path | None = option(
        "QoS profiles to subscribe with, by topic (ROS 2).",
        None,
        "--qos-profile-overrides-path",
        metavar="YAML",
    )
    custom_data: Sequence[str] = option(
        "Entry for custom_data of the rosbag2 metadata (ROS 2); repeatable.",
        (),
        metavar="KEY=VALUE",
    )
    about: str | None = about()
    force: bool = force()
    names: NodeNames = argument("Name, namespace and remappings of the node.", PLAIN)
