"""The package of ros/: it is where ROS looks for it, and its launch files start nodes."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

import mp4ds
from mp4ds.bags.formats import open_sources
from mp4ds.cli import commands
from mp4ds.errors import SourceError
from mp4ds.files.sources import UNFINISHED
from mp4ds.records import Message
from player_scenes import make_drive
from roscore import RECORD, Core, python
from roscore import _core as _core
from roscore import roscore as roscore
from test_examples import ROOT
from test_record_ros1 import contents
from waiting import WATCHDOG_S, until

PACKAGE = ROOT / "ros" / "mp4ds"
LAUNCHED = {
    "ros1 play": PACKAGE / "launch" / "play.launch",
    "ros1 record": PACKAGE / "launch" / "record.launch",
    "ros2 play": PACKAGE / "launch" / "play.launch.xml",
    "ros2 record": PACKAGE / "launch" / "record.launch.xml",
}
DESCRIBE = """
import json, os, sys
from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import parse_package
package = parse_package(sys.argv[1])
package.validate()
package.evaluate_conditions(os.environ)
changelog = get_changelog_from_path(os.path.join(sys.argv[1], "CHANGELOG.rst"))
needs = [*package.buildtool_depends, *package.exec_depends]
print(json.dumps({
    "build_type": package.get_build_type(),
    "needs": sorted(one.name for one in needs if one.evaluated_condition),
    "changes": [str(version) for version, *_ in changelog.foreach_version()],
}))
"""
"""What catkin_pkg, which catkin, rosdep, bloom and the ROS index use, makes of a package."""

NEEDS = {
    "": ("catkin", ["catkin", "roslaunch", "rospy"]),  # Debian's ROS 1 sets no version
    "1": ("catkin", ["catkin", "roslaunch", "rospy"]),
    "2": ("ament_python", ["launch_xml", "rclpy", "ros2launch"]),
}
"""Version of ROS -> build type, and what only this version needs."""

UNSET = "unset@mp4ds.invalid"
"""In package.xml, which must have one, while pyproject.toml has no address of mail."""


def done(command: Sequence[str], **options: Any) -> str:
    result = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


# ---------------------------------------------------------------- what the files say


def test_it_says_what_the_project_says() -> None:
    """Version, license, addresses, and the maintainer, who may have no address of mail yet."""
    found = ElementTree.parse(PACKAGE / "package.xml")
    pyproject = (ROOT / "pyproject.toml").read_text()

    def told(key: str) -> str:
        match = re.search(rf'^{key} = "(.*)"$', pyproject, re.M)
        assert match, key
        return match[1]

    assert found.findtext("version") == mp4ds.__version__
    assert (found.findtext("name"), found.findtext("license")) == ("mp4ds", told("license"))
    assert (PACKAGE / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert {one.attrib["type"]: one.text for one in found.findall("url")} == {
        "website": told("Documentation"),
        "repository": told("Repository"),
        "bugtracker": told("Issues"),
    }
    (maintainer,) = found.findall("maintainer")
    listed = re.search(
        r'^maintainers = \[{ name = "(.*?)"(?:, email = "(.*)")? }\]$', pyproject, re.M
    )
    assert listed, "maintainers of pyproject.toml"
    assert (maintainer.text, maintainer.attrib["email"]) == (listed[1], listed[2] or UNSET)


def release(path: Path, email: str = UNSET) -> None:
    """Change a file as one does to release."""
    text = path.read_text().replace("## [Unreleased]", f"## [{mp4ds.__version__}]")
    heading = f"{mp4ds.__version__} (2026-12-01)"
    text = text.replace("Forthcoming\n-----------", f"{heading}\n{'-' * len(heading)}")
    path.write_text(re.sub(r'email="[^"]*"', f'email="{email}"', text))


@pytest.mark.parametrize("email", [UNSET, "somebody@robots.example"])
def test_no_release_without_an_address(email: str, tmp_path: Path) -> None:
    """What the workflow runs on a tag: ROS wants the address of somebody who reads it."""
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())
    script = workflow["jobs"]["version"]["steps"][-1]["run"]
    version = mp4ds.__version__
    names = ["src/mp4ds/_version.py", "CITATION.cff", "CHANGELOG.md"]
    names += ["ros/mp4ds/package.xml", "ros/mp4ds/CHANGELOG.rst"]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
        release(tmp_path / name, email)
    command = ["bash", "-e", "-c", script]
    environment = {"PATH": "/usr/bin:/bin", "GITHUB_REF_NAME": f"v{version}"}
    result = subprocess.run(command, cwd=tmp_path, env=environment, check=False)
    assert (result.returncode == 0) == (email != UNSET)


@pytest.mark.parametrize("version", NEEDS)
def test_catkin_pkg_takes_it(version: str, tmp_path: Path) -> None:
    python = shutil.which("python3", path="/usr/bin")
    if not python or subprocess.run([python, "-c", "import catkin_pkg"], check=False).returncode:
        pytest.skip("catkin_pkg is not installed")
    environment = {"PATH": "/usr/bin:/bin", **({"ROS_VERSION": version} if version else {})}
    shutil.copytree(PACKAGE, tmp_path / "mp4ds")
    release(tmp_path / "mp4ds" / "CHANGELOG.rst")
    command = [python, "-c", DESCRIBE, str(tmp_path / "mp4ds")]
    found = json.loads(done(command, env=environment))
    build_type, needs = NEEDS[version]
    assert found["build_type"] == build_type
    assert found["needs"] == sorted([*needs, "python3-mp4ds-pip", "ros_environment"])
    assert found["changes"][0] == mp4ds.__version__


def test_entries_of_the_ros_index() -> None:
    package = ElementTree.parse(PACKAGE / "package.xml")
    rules = yaml.safe_load((ROOT / "ros" / "rosdep.yaml").read_text())
    assert {*rules} <= {one.text for one in package.findall("exec_depend")}
    for system in ("debian", "ubuntu"):  # which the index asks for
        assert rules["python3-mp4ds-pip"][system] == {"pip": {"packages": ["mp4ds"]}}
    index = yaml.safe_load((ROOT / "ros" / "distribution.yaml").read_text())
    (url,) = (one.text for one in package.findall("url") if one.get("type") == "repository")
    source = {"type": "git", "url": f"{url}.git", "version": "main"}
    assert index["repositories"] == {
        "mp4ds": {"doc": source, "source": source, "status": "maintained"}
    }


@pytest.mark.parametrize("kind", LAUNCHED)
def test_the_page_has_every_argument(kind: str) -> None:
    page = (ROOT / "docs" / "ros.md").read_text()
    ros, command = kind.split()
    table = page[page.index(f"`{command}.launch`\n") :].partition("\n##")[0]
    rows = re.findall(r"^\| `(\w+)` \|([^|]*)\|([^|]*)\|", table, re.M)
    told = {
        name: default.strip().strip("`")
        for name, default, text in rows
        if ros == "ros2" or "(ROS 2" not in text
    }
    assert told == {
        one.attrib["name"]: one.attrib.get("default", "required")
        for one in ElementTree.parse(LAUNCHED[kind]).getroot().findall("arg")
    }


def substituted(text: str, values: dict[str, str]) -> str:
    return re.sub(r"\$\(var (\w+)\)", lambda match: values[match[1]], text)


@pytest.mark.parametrize("command", ["play", "record"])
def test_launch_files_of_ros2(command: str, tmp_path: Path) -> None:
    """With every condition met, their words are options of the command."""
    root = ElementTree.parse(LAUNCHED[f"ros2 {command}"]).getroot()
    values = {one.attrib["name"]: one.attrib.get("default", "drive") for one in root.iter("arg")}
    values |= {"topics": "/camera/* /tf", "output": "live"}
    values["options"] = "--force --exclude /a*" if command == "record" else ""
    for let in root.iter("let"):
        values[let.attrib["name"]] = substituted(let.attrib["value"], values)
        assert {*let.attrib} <= {"name", "value", "if", "unless"}
    (node,) = root.iter("node")
    assert node.attrib["pkg"] == "mp4ds"
    program = PACKAGE / "scripts" / node.attrib["exec"]
    assert os.access(program, os.X_OK)
    words = substituted(node.attrib["args"], values).split()
    environment = {
        one.attrib["name"]: substituted(one.attrib["value"], values) for one in node.findall("env")
    }
    (tmp_path / "python3").write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    (tmp_path / "python3").chmod(0o755)
    (tmp_path / "camera").mkdir()  # no file is taken for a topic
    told = done(
        [str(program), *words, "--ros-args", "-r", "__node:=x", "-p", "use_sim_time:=true"],
        env={"PATH": f"{tmp_path}:/usr/bin:/bin", "ROS_VERSION": "2", **environment},
        cwd=tmp_path,
    ).splitlines()
    assert told[:4] == ["-m", "mp4ds", command, "--ros2"]
    made: Any = commands.get_command(None, command)
    context = made.make_context(command, told[3:])
    assert context.params["ros2"]
    if command == "play":
        assert context.params["datasets"] == ("drive",)
        assert context.params["loop"]
        assert context.params["clock"]
        assert context.params["paused"]
        assert context.params["topics"] == ("/camera/*", "/tf")
    else:
        assert context.params["topics"] == ("/camera/*", "/tf")
        assert context.params["exclude"] == ("/a*",)
        assert context.params["output"] == "live"


def test_ros2_finds_it(tmp_path: Path) -> None:
    """As colcon installs it: with setuptools, under a prefix."""
    pytest.importorskip("setuptools")
    shutil.copytree(PACKAGE, tmp_path / "source")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    command += ["--no-build-isolation", "--ignore-installed", "--prefix", str(tmp_path / "prefix")]
    done([*command, str(tmp_path / "source")])
    prefix = tmp_path / "prefix"
    index = prefix / "share" / "ament_index" / "resource_index" / "packages" / "mp4ds"
    assert index.exists()
    share = prefix / "share" / "mp4ds"
    assert (share / "package.xml").read_bytes() == (PACKAGE / "package.xml").read_bytes()
    for name in ("play", "record"):
        assert (share / "launch" / f"{name}.launch.xml").exists()
        assert os.access(prefix / "lib" / "mp4ds" / name, os.X_OK)
    # of an egg where setuptools is old and has no wheel beside it, as on Python 3.10
    (metadata,) = (path for name in ("METADATA", "PKG-INFO") for path in prefix.rglob(name))
    text = metadata.read_text()
    # mp4ds itself stays what Python finds by its name
    assert f"Name: mp4ds-ros\nVersion: {mp4ds.__version__}\n" in text


# ---------------------------------------------------------------- ROS 1


class Workspace:
    """A workspace of catkin in which the package is installed.

    Args:
        folder: Where to make it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shutil.copytree(PACKAGE, folder / "src" / "mp4ds")
        environment = {"PATH": "/usr/bin:/bin", "HOME": str(folder)}
        done(["/usr/bin/catkin_make", "install"], cwd=folder, env=environment)
        # the Python of the tests, with ROS's packages behind its own
        interpreter, option, program = python()
        (folder / "program.py").write_text(program)
        (folder / "bin").mkdir()
        shim = folder / "bin" / "python3"
        shim.write_text(
            f'#!/bin/sh\nshift\nexec {interpreter} {option} "$(cat {folder}/program.py)" "$@"\n'
        )
        shim.chmod(0o755)

    def command(self, place: Path, *words: str) -> list[str]:
        """A command as typed in a folder, with the workspace sourced."""
        program = 'cd "$1" && . "$0/install/setup.sh" && shift && PATH="$0/bin:$PATH" exec "$@"'
        return ["sh", "-c", program, str(self.folder), str(place), *words]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    for program in ("roslaunch", "rosrun", "catkin_make", "make"):
        if not Path("/usr/bin", program).exists():
            pytest.skip(f"ROS 1 is not installed: no /usr/bin/{program}")
    return Workspace(tmp_path_factory.mktemp("catkin"))


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Twenty images and other topics, packed; the bag lies beside it."""
    mp4ds.pack(make_drive(tmp_path / "a drive.bag"), tmp_path / "a drive")
    return tmp_path / "a drive"


IMAGES = "/camera/image_raw"


def payloads(recording: Path) -> dict[str, list[bytes]]:
    return {topic: found for (topic, *_), found in contents(recording).items()}


def noted(folder: Path) -> int:
    """Images that a recorder has written."""
    count = 0
    for path in folder.with_name(folder.name + UNFINISHED).glob("*.mcap"):
        if path.with_suffix("").exists():  # packed, and counted there
            continue
        with suppress(SourceError), open_sources([path], salvage=True) as reader:
            found = (record for record in reader.records() if isinstance(record, Message))
            count += sum(message.channel.type_name == "sensor_msgs/Image" for message in found)
    for path in folder.with_name(folder.name + UNFINISHED).glob("??????"):
        with mp4ds.open(path) as dataset:
            count += sum(map(len, dataset.streams))
    return count


def test_roslaunch(roscore: Core, workspace: Workspace, drive: Path, tmp_path: Path) -> None:
    """One launch file records what another one plays, until Ctrl-C; paths are of the shell."""
    made = tmp_path / "a live one_0"
    start = workspace.command(tmp_path, "roslaunch", "mp4ds", "record.launch")
    start += ["output:=a live one", "topics:=/camera/* /tf", "options:=--max-size 4G"]
    recorder = roscore.start(*start, "name:=bag")
    try:
        until(lambda: "/bag" in roscore.nodes())
        start = workspace.command(tmp_path, "roslaunch", "mp4ds", "play.launch")
        start += ["dataset:=a drive", "clock:=true", f"topics:={IMAGES} /tf", "rate:=2"]
        code, output, errors = roscore.run(*start, "options:=--wait-for-subscribers")
        assert code == 0, errors
        assert "has died" not in output + errors
        assert roscore.run("rosparam", "get", "/use_sim_time")[1].strip() == "true"
        until(lambda: noted(made) == 20)
    finally:
        recorder.send_signal(signal.SIGINT)
        code = recorder.wait(WATCHDOG_S)
        roscore.run("rosparam", "delete", "/use_sim_time")
    log = (roscore.folder / "sh.log").read_text()
    assert code == 0, log
    assert "has died" not in log
    assert "escalating" not in log
    assert not [*tmp_path.glob(f"*{UNFINISHED}")]
    assert mp4ds.validate(made, deep=True) == []
    mp4ds.unpack(made, None, tmp_path / "again.bag")
    found, due = payloads(tmp_path / "again.bag"), payloads(tmp_path / "a drive.bag")
    assert {*found} == {IMAGES, "/tf"}
    assert found[IMAGES] == due[IMAGES]
    assert found["/tf"] == due["/tf"][: len(found["/tf"])]


NAMES = ("/renamed:=/camera/image_raw", "__ns:=/camera", "__log:=/tmp/a log")


def test_rosrun_renames_topics(
    roscore: Core, workspace: Workspace, drive: Path, tmp_path: Path
) -> None:
    """As `rosrun rosbag record` does; names from the root on, where that keeps relative ones."""
    ours = workspace.command(tmp_path, "rosrun", "mp4ds", "record", "-o", "live")
    words = ("/renamed", "/tf", "/tf:=/none", *NAMES)
    theirs = [RECORD, "-O", str(tmp_path / "theirs.bag"), *words]
    started = [roscore.start(*command) for command in ([*ours, *words, "__name:=ours"], theirs)]
    play = workspace.command(tmp_path, "rosrun", "mp4ds", "play", "-q", "--pause", "--topics")
    try:
        started.append(roscore.start(*play, IMAGES, str(drive), "__name:=player"))
        until(lambda: roscore.connections("/player")[IMAGES] == 2)
        pause = ("rosservice", "call", "/player/pause_playback")
        assert roscore.run(*pause, "false")[0] == 0
        started[-1].wait(WATCHDOG_S)
        until(lambda: noted(tmp_path / "live") == 20)
        until(lambda: not any(map(roscore.connections, roscore.nodes())))
    finally:
        for process in started:
            process.send_signal(signal.SIGINT)  # which nobody gets where it has ended
        codes = [process.wait(WATCHDOG_S) for process in started]
    assert codes == [0, 0, 0], (roscore.folder / "sh.log").read_text()
    mp4ds.unpack(tmp_path / "live", None, tmp_path / "again.bag")
    found, due = payloads(tmp_path / "again.bag"), payloads(tmp_path / "theirs.bag")
    assert found == due
    assert {*found} == {"/renamed"}
