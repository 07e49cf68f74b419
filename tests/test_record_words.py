"""How users of `rosbag record` and `ros2 bag record` type the options of `mp4ds record`."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from commands import call, refused
from mp4ds.cli.record import record_command
from mp4ds.errors import OptionError
from mp4ds.plugins.recording.options import RecordOptions
from mp4ds.plugins.ros.node import NodeNames
from roscore import RECORD

ROOT = Path(__file__).parents[1]
JAZZY = {
    *("--topics", "--services", "--topic-types", "--all", "--all-topics", "--all-services"),
    *("--regex", "--exclude-regex", "--exclude-topics", "--exclude-topic-types"),
    *("--exclude-services", "--include-unpublished-topics", "--include-hidden-topics"),
    *("--no-discovery", "--polling-interval", "--ignore-leaf-topics", "--output", "--storage"),
    *("--qos-profile-overrides-path", "--serialization-format", "--max-bag-size"),
    *("--max-bag-duration", "--max-cache-size", "--disable-keyboard-controls", "--start-paused"),
    *("--use-sim-time", "--node-name", "--custom-data", "--snapshot-mode", "--log-level"),
    *("--storage-preset-profile", "--storage-config-file", "--compression-queue-size"),
    *("--compression-threads", "--compression-threads-priority", "--compression-mode"),
    *("--compression-format",),
}
"""Options of Jazzy's `ros2 bag record`, by name: it is not installed here."""


def meant(typed: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the recorder would be asked for: topics, output, and options that are not usual."""
    asked: dict[str, Any] = {}

    def opened(topics: Sequence[str], output: str | None, options: RecordOptions, **_: Any) -> None:
        usual = RecordOptions(to=options.to)
        found = {item.name: getattr(options, item.name) for item in fields(options)}
        found = {k: getattr(v, "pattern", v) for k, v in found.items()}  # of expressions
        asked.update({k: v for k, v in found.items() if v != getattr(usual, k)})
        asked.update({"topics": tuple(topics)} if topics else {})
        asked.update({"output": output} if output else {})
        raise OptionError("enough")

    monkeypatch.setattr("mp4ds.cli.record.open_recorder", opened)
    refused(call("record", *typed.split()), 2, "enough")
    return asked


A_AND_B = {"topics": ("/a", "/b")}
ALL = {"all": True}


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("-o drive -a", {"output": "drive"} | ALL),
        ("-O drive.bag /a /b", {"output": "drive.bag"} | A_AND_B),
        ("--ros2 --topics /a /b -o d", {"output": "d"} | A_AND_B),
        ("--exclude-topics /a /b -a", {"exclude": ("/a", "/b")} | ALL),
        ("--ros2 -a -b 4000000000 -s mcap", {"max_size": 4_000_000_000} | ALL),
        ("--ros1 -a -b 512", {"buffer": 512} | ALL),
        ("--ros2 -a --max-cache-size 104857600", {"buffer": 104} | ALL),
        ("--ros1 -a --split --duration=60", {"max_duration": 60} | ALL),
        ("--ros1 -a --split --size 1024", {"max_size": 2**30} | ALL),
        (
            "--ros1 -a --min-space 2G --repeat-latched",
            {"min_space": 2**31, "repeat_latched": True} | ALL,
        ),
        (
            "--ros1 -a --split --max-splits 3 --duration 60",
            {"max_duration": 60, "max_splits": 3} | ALL,
        ),
        ("--ros1 -a --duration 5m", {"duration": 300} | ALL),
        ("--ros1 --topic /a --topic /b", A_AND_B),
        ("--ros1 -e /cam.* /imu -j", {"regex": "^(?:/cam.*|/imu)$"}),
        ("--ros2 -e cam /imu", {"regex": "cam", "topics": ("/imu",)}),
        ("--ros1 -a -x /rosout.*", {"exclude_regex": "^(?:/rosout.*)$"} | ALL),
        ("--ros2 -a -x rosout", {"exclude_regex": "rosout"} | ALL),
        (
            "-a --ros-args -r __node:=eye -r __ns:=/robot",
            {"names": NodeNames("eye", "/robot")} | ALL,
        ),
        ("-a __name:=eye", {"names": NodeNames("eye")} | ALL),
        (
            "--ros2 --services /arm /leg/_service_event",
            {"topics": ("/arm/_service_event", "/leg/_service_event")},
        ),
        ("--ros2 -a --exclude-services /arm", {"exclude": ("/arm/_service_event",)} | ALL),
        (
            "--ros2 --topic-types a_msgs/msg/A b_msgs/msg/B --custom-data x=1 y=2 --all-services",
            {
                "topic_types": ("a_msgs/msg/A", "b_msgs/msg/B"),
                "custom_data": ("x=1", "y=2"),
                "all_services": True,
            },
        ),
        ("--ros2 -a --storage-preset-profile fastwrite", ALL),
        (
            "--ros1 --node /slam -l 5 -L 2G --output-prefix run",
            {"of_node": "/slam", "limit": 5, "min_space": 2**31, "prefix": "run"},
        ),
        ("--ros2 -a --snapshot-mode", {"keep_last": 60} | ALL),
        ("--ros2 -a --snapshot-mode --max-cache-duration 5", {"keep_last": 5} | ALL),
        ("--ros2 -a --max-cache-duration 5", ALL),
        ("-a --keep-last 90s --and-then 2m", {"keep_last": 90, "and_then": 120} | ALL),
        ("-a --keep-last 5 --trigger /go", {"keep_last": 5, "trigger": ("/go",)} | ALL),
    ],
)
def test_words(typed: str, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    assert meant(typed, monkeypatch) == expected


def test_options_of_jazzy_are_taken() -> None:
    assert JAZZY - record_command.known == set()


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("--ros2 -a -s", "requires an argument"),
        ("--topics", "--topics requires an argument"),
        ("--max-cache-size 1G", "'1G' is not a valid integer"),
        ("--duration soon", "--duration soon is not a number of seconds, 5m or 2h"),
        (
            "-a --duration +1e9",
            "--duration +1e9 is not a number of seconds, 5m or 2h, from 0 to 999999999 s",
        ),
    ],
)
def test_a_value_that_is_wrong(typed: str, said: str) -> None:
    done = call("record", *typed.split())
    assert done.code == 2
    assert said in done.err


def test_the_page_lists_the_options_of_both_recorders() -> None:
    """Those of rosbag record as it tells them, those of rosbag2 by name."""
    table = (ROOT / "docs/recording.md").read_text().partition("## Options")[2]
    listed = set(re.findall(r"(?<![\w-])--?[a-zA-Z][\w-]*", table))
    theirs = {
        *record_command.lists,
        *(flag for item in record_command.params for flag in item.opts),
    }
    assert theirs & JAZZY <= listed | {"--compression-mode"}
    assert JAZZY - listed == set()
    if not Path(RECORD).exists():
        pytest.skip("ROS 1 is not installed")
    told = subprocess.run([RECORD, "--help"], capture_output=True, text=True).stdout
    theirs = set(re.findall(r"(?<![\w-])--[a-z][\w-]*", told)) - {"--help"}
    assert theirs
    assert theirs - listed == set()
