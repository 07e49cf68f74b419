"""The examples run, and the commands of the README and the first pages, as for a new user."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import pytest

import mp4ds
from commands import program, typed
from mp4ds.cli import COMMANDS
from mp4ds.cli.pack import import_command
from mp4ds.plugins.demo import demo
from sources import SOURCES, scene
from test_tutorials import ROOT, blocks_of
from test_tutorials import commands as typed_in


def run(*command: object, cwd: Path) -> str:
    return program(*command, cwd=cwd).out


@pytest.fixture(scope="module")
def demo_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    demo(folder / "demo.mcap", seconds=0.4)
    mp4ds.pack(folder / "demo.mcap", folder / "demo")
    return folder / "demo"


def test_frames(demo_dataset: Path) -> None:
    out = run(sys.executable, str(ROOT / "examples/frames.py"), str(demo_dataset), cwd=ROOT)
    assert out.count("bayer_rggb8 (360, 480)") == 3
    assert out.count("rgb8 (360, 480, 3)") == 3
    assert out.count("fx 300.0") == 6


def test_other_topics(tmp_path: Path) -> None:
    mp4ds.pack(SOURCES["mcap-ros2-zstd"](tmp_path / "source", scene("mono8")), tmp_path / "drive")
    out = run(
        sys.executable, str(ROOT / "examples/other_topics.py"), str(tmp_path / "drive"), cwd=ROOT
    )
    assert "/imu (sensor_msgs/msg/Imu)" in out
    assert "/cam/image_raw" not in out


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["recording", "images"])
def test_public_data(kind: str, demo_dataset: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    if kind == "recording":
        source = source.with_suffix(".mcap")
        mp4ds.unpack(demo_dataset, "mcap", source)
    else:
        camera = mp4ds.ExportOptions(topics=["/right/image_raw"])
        mp4ds.export(demo_dataset, "images", source, camera)
        source = source / "right_image_raw"
        (source / "stamps.csv").unlink()
    script = str(ROOT / "examples/public_data.py")
    words = [kind, str(source), "out", "--frames", "4", "--crf", "30"]
    words += ["--rate", "15"] if kind == "images" else []
    out = run(sys.executable, script, *words, cwd=tmp_path)
    told = dict(line.strip("| ").split(" | ") for line in out.splitlines())
    assert told["validate lossless --deep"] == "0 problems"
    assert any("rgb8 480x360" in result for result in told.values())
    assert re.search(r"[1-9]\.\d times smaller", told["lossless"])
    assert any(step.startswith("evaluate /") for step in told)
    assert (tmp_path / told["report"].split(",")[0]).is_file()
    assert any(re.match(r"[1-9]\d* messages held", result) for result in told.values())


@pytest.mark.slow  # .ci/run runs it with the lowest versions of what it needs
def test_quickstart(tmp_path: Path) -> None:
    """The README's first command, but for the installation, which CI does in a fresh clone."""
    script = (ROOT / "examples/quickstart.sh").read_text()
    starts = ("mkdir", "mp4ds", "python tools")
    lines = [line for line in script.splitlines() if line.startswith(starts)]
    assert len(lines) == 6
    shutil.copytree(ROOT / "tools", tmp_path / "tools")
    script = "work=quickstart\n" + "\n".join(lines)
    for _ in range(2):  # also over what it left
        out = run("bash", "-euc", script, cwd=tmp_path)
        assert "no problems" in out
        assert out.rstrip().endswith("EQUAL")


@pytest.mark.parametrize(
    "page",
    ["README.md", pytest.param("docs/commands.md", marks=pytest.mark.slow), "docs/conversions.md"],
)
def test_commands_of_a_page(page: str, demo_dataset: Path, tmp_path: Path) -> None:
    """Each mp4ds line of its shell blocks, on the demo under the names that the page has."""
    text = "".join(block for kind, block in blocks_of(ROOT / page) if kind == "sh")
    lines = [line for line, _ in typed_in(text) if line.startswith("mp4ds ")]
    assert len(lines) >= 3
    source = SOURCES["rosbag2-mcap-v9"](tmp_path / "source", scene("mono8"))[0]
    shutil.copytree(source, tmp_path / "rosbag2_drive")
    for name in ("drive_0.mcap", "drive.mcap"):
        if f"mp4ds demo {name}" not in text:
            shutil.copy(demo_dataset.parent / "demo.mcap", tmp_path / name)
    if not any(re.search(r"-o drive( |$)|pack drive[.]mcap$", line) for line in lines):
        shutil.copytree(demo_dataset, tmp_path / "drive")
    for line in lines:
        brief = " --seconds 0.4" if line.startswith("mp4ds demo") else ""
        done = typed(line + brief, tmp_path)
        assert done.code == 0, f"{line}\n{done}"


def test_readme_python(demo_dataset: Path, tmp_path: Path) -> None:
    (code,) = (text for kind, text in blocks_of(ROOT / "README.md") if kind == "python")
    shutil.copytree(demo_dataset, tmp_path / "drive")
    run(sys.executable, "-c", code, cwd=tmp_path)


def test_every_command_is_in_the_list() -> None:
    text = (ROOT / "docs/commands.md").read_text()
    imports = {f"import {name}" for name in import_command.commands}
    for command in {*COMMANDS, *imports} - {"import", "repack"}:
        assert f"`mp4ds {command}" in text
