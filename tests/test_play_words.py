"""`mp4ds play` as users of other players type it, and the table of their options."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import click
import pytest

from mp4ds.cli.play import play_command
from mp4ds.errors import OptionError
from mp4ds.plugins.ros.node import PLAIN, NodeNames, node_arguments
from roscore import PLAY
from test_examples import ROOT


def words(typed: str) -> str:
    return " ".join(play_command.translated(click.Context(play_command), typed.split()))


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("bag --topics /a /b -r 2", "bag --topics /a --topics /b -r 2"),
        ("bag --topics /a {folder}", "bag --topics /a --topics {folder}"),
        ("--topics /a /b {folder} -r 2", "--topics /a --topics /b {folder} -r 2"),
        ("--topics /a /b --bags x {folder}", "--topics /a --topics /b x {folder}"),
        ("-r 2 bag --topics /a {folder}", "-r 2 bag --topics /a --topics {folder}"),
        ("--topics=/a /b", "--topics /a --topics /b"),
        ("--topics /a s3://bucket/drive", "--topics /a s3://bucket/drive"),
        ("-t /a bag", "-t /a bag"),
        ("--remap a:=b /c:=d bag", "--remap a:=b --remap /c:=d bag"),
        ("-m a:=b c:=d", "--remap a:=b --remap c:=d"),
        ("--exclude-topics /a /b", "--exclude-topics /a --exclude-topics /b"),
        ("bag --services /a --exclude-services /b",
         "bag --topics /a/_service_event --exclude-topics /b/_service_event"),
        ("--clock 50 bag", "--clock 50 bag"),
        ("--clock bag", "--clock 100 bag"),
        ("bag --clock --hz 7", "bag --clock 100 --hz 7"),
        ("--ros2 --clock bag", "--ros2 --clock 40 bag"),
        ("--ros2 bag --clock 7", "--ros2 bag --clock 7"),
        ("--ros2 bag -x a -s mcap", "--ros2 bag --exclude-regex a --storage mcap"),
        ("--ros1 bag -p /a -s 3", "--ros1 bag --prefix /a -s 3"),
        ("--ros1 bag -p/a", "--ros1 bag --prefix /a"),
        ("bag -x a -p -s 3", "bag -x a -p -s 3"),
        ("--ros2 -i one -i two", "--ros2 one two"),
        ("bag --ros-args -r /a:=/b -- -l", "bag -l"),
        ("bag -- --topics", "bag -- --topics"),
    ],
    ids=lambda value: value,
)  # fmt: skip
def test_words_of_other_players(typed: str, expected: str, tmp_path: Path) -> None:
    assert words(typed.format(folder=tmp_path)) == expected.format(folder=tmp_path)


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        ("--topics", "--topics requires an argument"),
        ("--ros-args --nonsense", "--nonsense is not known"),
        ("--ros-args -p use_sim_time:=perhaps", "use_sim_time must be true or false"),
        ("--ros-args -p use_sim_time", "is not a ROS parameter"),
        ("--ros-args --params-file /none/at.yaml", "/none/at.yaml: cannot be read"),
        ("--ros-args -r nonsense", "is not a remapping"),
        ("__ns:=/1", "is not a valid namespace"),
    ],
)
def test_what_has_no_counterpart_is_told(typed: str, says: str) -> None:
    with pytest.raises(OptionError, match=says):
        words(typed)


@pytest.mark.parametrize(
    ("typed", "names"),
    [
        ("", PLAIN),
        ("--ros-args -r __node:=x -p use_sim_time:=true -p a:=b",
         NodeNames("x", use_sim_time=True)),
        ("--ros-args --remap __ns:=/robot --log-level warn", NodeNames("", "/robot", (), "warn")),
        ("--ros-args -r player:__node:=x -r /a:=/b", NodeNames("x", "", (("/a", "/b"),))),
        ("--ros-args --log-level rcl:=debug --disable-rosout-logs --", PLAIN),
        ("__name:=x __ns:=/y __log:=/tmp/x.log _rate:=3 /a:=/b",
         NodeNames("x", "/y", (("/a", "/b"),))),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_ros_tells_names(typed: str, names: NodeNames) -> None:
    assert node_arguments(["drive", *typed.split()]) == (["drive"], names)


@pytest.mark.parametrize(
    ("text", "node", "expected"),
    [
        ("/**:\n  ros__parameters:\n    use_sim_time: true\n", "", True),
        ("/robot/x:\n  ros__parameters: {use_sim_time: true, a: [1, 2]}\n", "x", True),
        ("robot:\n  x:\n    ros__parameters:\n      use_sim_time: true\n", "x", True),
        ("/robot/y:\n  ros__parameters:\n    use_sim_time: true\n", "x", None),
        ("/**: {ros__parameters: {use_sim_time: true}}\n"
         "/robot/x: {ros__parameters: {use_sim_time: false}}\n", "x", False),
        ("", "x", None),
    ],
    ids=["all", "name", "nested", "another", "both", "empty"],
)  # fmt: skip
def test_parameters_in_a_file(text: str, node: str, expected: bool | None, tmp_path: Path) -> None:
    """As launch files of ROS 2 give them; the name may stand behind the file."""
    (tmp_path / "f.yaml").write_text(text)
    words = ["--ros-args", "--params-file", str(tmp_path / "f.yaml"), "-r", "__ns:=/robot"]
    words += ["-r", f"__node:={node}"] if node else []
    assert node_arguments(words)[1].use_sim_time is expected


def test_ros1_tells_a_namespace_by_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_NAMESPACE", "/robot")
    assert PLAIN.in_world("ros1").resolved("imu") == "/robot/imu"
    assert PLAIN.in_world("ros2").resolved("imu") == "/imu"
    assert NodeNames(namespace="/own").in_world("ros1").resolved("imu") == "/own/imu"


# ---------------------------------------------------------------- the table of docs/playing.md

ROS2_OPTIONS = {
    *("--storage", "--storage-config-file", "--read-ahead-queue-size", "--rate", "--topics"),
    *("--services", "--regex", "--exclude-regex", "--exclude-topics", "--exclude-services"),
    *("--qos-profile-overrides-path", "--loop", "--remap", "--clock", "--clock-topics"),
    *("--clock-topics-all", "--delay", "--playback-duration", "--playback-until-sec"),
    *("--playback-until-nsec", "--disable-keyboard-controls", "--start-paused", "--start-offset"),
    *("--wait-for-all-acked", "--disable-loan-message", "--publish-service-requests"),
    *("--service-requests-source", "--log-level", "--input", "--message-order"),
    *("--progress-bar-update-rate", "--progress-bar-separation-lines"),
}
"""Of ros2bag's play verb, in Jazzy and later."""


def rows() -> dict[str, tuple[str, str]]:
    """Options of each player -> whose they are, and what is here."""
    page = (ROOT / "docs" / "playing.md").read_text()
    table = page[page.index("| rosbag play") :].partition("\n\n")[0]
    found = {}
    for line in table.splitlines()[2:]:
        ros1, ros2, here = (cell.strip() for cell in line.strip("|").split("|"))
        for player, cell in (("ros1", ros1), ("ros2", ros2)):
            for name in re.findall(r"`(--[a-z0-9-]+)", cell):
                found[f"{player} {name}"] = (name, here)
    return found


def test_the_table_has_every_option_of_ros2() -> None:
    assert {key.partition(" ")[2] for key in rows() if key.startswith("ros2")} == ROS2_OPTIONS


def test_the_table_has_every_option_of_ros1() -> None:
    if not Path(PLAY).exists():
        pytest.skip("there is no rosbag")
    told = subprocess.run([PLAY, "--help"], capture_output=True, text=True, check=False)
    options = set(re.findall(r"(?<![\w<-])--[a-z][a-z-]+", told.stdout + told.stderr)) - {"--help"}
    assert {key.partition(" ")[2] for key in rows() if key.startswith("ros1")} == options
