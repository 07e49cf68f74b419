"""How users of `rosbag record` and `ros2 bag record` type the options of `mp4ds record`."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from commands import call
from mp4ds.cli.record_words import known_words, spelled
from mp4ds.errors import OptionError
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

VALUED = {"-o", "--output", "-e", "--regex", "-x", "--exclude-regex", "-d", "-b", "--max-size"}


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("-o drive -a", "-o drive -a"),
        ("-O drive.bag /a /b", "--output drive.bag /a /b"),
        ("--ros2 --topics /a /b -o d", "--ros2 -o d /a /b"),
        ("--exclude-topics /a /b -a", "--exclude /a --exclude /b -a"),
        ("--ros2 -a -b 4000000000 -s mcap", "--ros2 -a --max-size 4000000000"),
        ("--ros1 -a -b 512", "--ros1 -a -b 512"),
        ("--ros2 -a --max-cache-size 104857600", "--ros2 -a --buffsize 104"),
        ("--ros1 -a --split --duration=60", "--ros1 -a --max-bag-duration 60"),
        ("--ros1 -a --split --size 1024", "--ros1 -a --max-size 1024M"),
        ("--ros1 -a --duration 5m", "--ros1 -a --duration 300"),
        ("--ros1 --topic /a --topic /b", "--ros1 /a /b"),
        ("--ros1 -e /cam.* /imu -j", "--ros1 --regex ^(?:/cam.*|/imu)$"),
        ("--ros2 -e cam /imu", "--ros2 -e cam /imu"),
        ("--ros1 -a -x /rosout.*", "--ros1 -a -x ^(?:/rosout.*)$"),
        ("--ros2 -a -x rosout", "--ros2 -a -x rosout"),
        ("-a --ros-args -r __node:=eye -r __ns:=/robot", "-a"),
        ("-a __name:=eye", "-a"),
        (
            "--ros2 --services /arm /leg/_service_event",
            "--ros2 /arm/_service_event /leg/_service_event",
        ),
        ("--ros2 -a --exclude-services /arm", "--ros2 -a --exclude /arm/_service_event"),
        (
            "--ros2 --topic-types a_msgs/msg/A b_msgs/msg/B --custom-data x=1 y=2 --all-services",
            "--ros2 --topic-types a_msgs/msg/A --topic-types b_msgs/msg/B"
            " --custom-data x=1 --custom-data y=2 --all-services",
        ),
        ("--ros2 -a --storage-preset-profile fastwrite", "--ros2 -a"),
    ],
)
def test_words(typed: str, meant: str) -> None:
    words, _ = spelled(typed.split(), VALUED.__contains__)
    assert words == meant.split()


def test_options_of_jazzy_are_taken() -> None:
    """But for those that the page says are not."""
    shown = call("record", "--help").out
    known = {*known_words(), *re.findall(r"--[a-z][\w-]*", shown)}
    assert JAZZY - known == {"--snapshot-mode"}


def test_a_value_that_is_missing() -> None:
    with pytest.raises(OptionError, match="--storage requires an argument"):
        spelled(["--ros2", "-a", "-s"], VALUED.__contains__)
    with pytest.raises(OptionError, match="'1G' is not a number of bytes"):
        spelled(["--max-cache-size", "1G"], VALUED.__contains__)


def test_the_page_lists_the_options_of_both_recorders() -> None:
    """Those of rosbag record as it tells them, those of rosbag2 by name."""
    table = (ROOT / "docs/recording.md").read_text().partition("## Options")[2]
    listed = set(re.findall(r"(?<![\w-])--?[a-zA-Z][\w-]*", table))
    assert known_words() - {"--ros-args", "-r", "--size"} <= listed | {"--compression-mode"}
    assert JAZZY - listed == set()
    if not Path(RECORD).exists():
        pytest.skip("ROS 1 is not installed")
    told = subprocess.run([RECORD, "--help"], capture_output=True, text=True).stdout
    theirs = set(re.findall(r"(?<![\w-])--[a-z][\w-]*", told)) - {"--help"}
    assert theirs
    assert theirs - listed == set()
