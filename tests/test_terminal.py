"""What terminals and streams get: nothing that a recording decides, never a traceback."""

from __future__ import annotations

import io
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import commands
import mp4ds
from commands import Result, program
from scenes import Scene
from sources import scene, write_mcap

TITLE = "/a\x1b]0;title\x07\x1b]8;;http://x\x1b\\b"
TOPICS = (TITLE, "/b[/foo]", "/c[link=http://x]d[red]", "/e\x9b31m\u202e")
LIMITED = pytest.mark.skipif(sys.platform != "linux", reason="how limits act is the system's")


class Screen(io.StringIO):
    """Takes what a terminal would show."""

    def isatty(self) -> bool:
        return True


def call(*arguments: object) -> Result:
    """A command in this process, on a terminal."""
    return commands.call(*arguments, screen=Screen)


def drive() -> Scene:
    """A camera for each of the topics."""
    images = [m for m in scene("rgb8", frames=4, with_info=False).messages if "image" in m.topic]
    messages = [replace(m, topic=topic) for topic in TOPICS for m in images]
    return Scene(sorted(messages, key=lambda message: message.log_time))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    write_mcap(path, drive())
    return path


@pytest.fixture(scope="module")
def dataset(recording: Path) -> Path:
    mp4ds.pack(recording, recording.parent / "dataset")
    return recording.parent / "dataset"


COMMANDS = {
    "pack": "pack RECORDING -o OUT",
    "pack-parts": "pack RECORDING -o OUT --gop 2 --window 2",
    "info": "info RECORDING",
    "info-dataset": "info DATASET",
    "validate": "validate DATASET --deep",
    "unpack": "unpack DATASET --to mcap -o OUT.mcap",
    "report": "report DATASET -o OUT",
    "export-images": "export images DATASET -o OUT",
    "export-euroc": "export euroc DATASET -o OUT",
    "export-tum": "export tum DATASET -o OUT",
    "frames": "frames DATASET -t TOPIC --at #1 -o OUT.png",
    "evaluate": "evaluate RECORDING -o OUT --codecs h264 --frames 4 --crf 30 --presets ultrafast "
    "--target psnr=20 --jobs 1",
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name == "evaluate" else [])
        for name in COMMANDS
    ],
)
def test_topics_steer_no_terminal(
    name: str, recording: Path, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "200")
    places = {"RECORDING": recording, "DATASET": dataset, "TOPIC": TITLE}
    places |= {f"OUT{end}": tmp_path / f"out{end}" for end in ("", ".mcap", ".png")}
    done = call(*(places.get(word, word) for word in COMMANDS[name].split()))
    assert "Traceback" not in done.err
    assert done.code == 0, done.err
    shown = done.out + done.err
    assert "\x1b]" not in shown
    assert "\x07" not in shown
    assert "\x9b" not in shown
    assert "\u202e" not in shown
    assert "http://x" not in re.sub(r"\\x1b]8;;http://x|\[link=http://x\]", "", shown)


# ---------------------------------------------------------------- standard streams


def run(words: str, where: str, folder: Path, first: str = "") -> Result:
    """A command as a process of its own, its streams as a shell is told."""
    return program("bash", "-c", f"{first}mp4ds {words} {where}", cwd=folder, code=None)


FULL = r"mp4ds: standard output: No space left on device[^\n]*\n"
STREAMS = {
    "full": ("info drive.mcap", "> /dev/full", 1, FULL),
    "full-json": ("info drive.mcap --json", "> /dev/full", 1, FULL),
    "full-help": ("--help", "> /dev/full", 1, FULL),
    "full-error": ("info none.mcap --json", "> /dev/full", 2, r"mp4ds: none.mcap[^\n]*\n"),
    "full-stderr": ("info none.mcap", "2> /dev/full", 2, ""),
    "no-stderr": ("info none.mcap", "2>&-", 2, ""),
    "no-stdout": ("info drive.mcap", ">&-", 0, ""),
    "nothing": ("pack drive.mcap -o OUT", ">&- 2>&- <&-", 0, ""),
}


@pytest.mark.one_in(4)
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("name", STREAMS)
def test_a_standard_stream_that_takes_nothing(name: str, recording: Path, tmp_path: Path) -> None:
    words, where, code, said = STREAMS[name]
    done = run(words.replace("OUT", str(tmp_path / "out")), where, recording.parent)
    assert done.code == code, done.err
    assert done.out == ""
    assert re.fullmatch(said, done.err), done.err
    if "OUT" in words:
        assert mp4ds.validate(tmp_path / "out", deep=True) == []


# ---------------------------------------------------------------- errors that nobody thought of


@pytest.mark.parametrize("as_json", [False, True])
@pytest.mark.parametrize("debug", [False, True])
def test_an_error_that_nobody_thought_of(
    as_json: bool, debug: bool, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise TypeError("open() got an unexpected keyword argument 'x'\n\x1b[31m.")

    monkeypatch.setattr("mp4ds.plugins.info.info", broken)
    monkeypatch.setenv("MP4DS_DEBUG", "1" if debug else "")
    done = call("info", recording, *(["--json"] if as_json else []))
    assert done.code == 1
    *trace, sentence, versions = done.err.splitlines()
    assert any("Traceback" in line for line in trace) == debug
    assert sentence.startswith("mp4ds: TypeError in cli/")
    assert "unexpected keyword argument 'x' \\x1b[31m. This" in sentence
    assert "MP4DS_DEBUG=1" in sentence
    for name in ("Python", "av", "numpy", "rosbags", "mcap", "pydantic", "click"):
        assert re.search(rf"\b{name} \d+\.\d+", versions), versions
    assert "pytest" not in versions
    if as_json:
        told = json.loads(done.out)
        assert told["error"].startswith("TypeError in cli/")
        assert told["exit_code"] == 1
        assert told["versions"]["mp4ds"] == mp4ds.__version__


# ---------------------------------------------------------------- limits of the system

WITHIN = """
import resource, sys
from pathlib import Path
import mp4ds.dataset.checks, mp4ds.packing.pack, mp4ds.unpacking.unpack
from mp4ds.cli import main
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
limit = used + int(sys.argv.pop(1)) * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
main()
"""


@LIMITED
@pytest.mark.parametrize(("name", "mebibytes"), [("validate", 2), ("pack", 24), ("unpack", 24)])
def test_running_out_of_memory_is_not_damage(
    name: str, mebibytes: int, recording: Path, dataset: Path, tmp_path: Path
) -> None:
    """Whatever ffmpeg says of it."""
    places = {"RECORDING": recording, "DATASET": dataset}
    places |= {f"OUT{end}": tmp_path / f"out{end}" for end in ("", ".mcap")}
    words = [str(places.get(word, word)) for word in COMMANDS[name].split()]
    done = program("-c", WITHIN, mebibytes, *words, code=None)
    if done.code or mebibytes < 8:
        assert done.code == 1, done.out
        assert done.out == ""
        assert done.err.endswith("mp4ds: out of memory; try fewer --jobs\n"), done.err
        assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@LIMITED
def test_more_cameras_than_open_files(tmp_path: Path) -> None:
    """Each has a file while it is packed; as many may be open as the system lets."""
    made = scene("mono8", frames=8, with_info=False, width=16, height=12).messages
    images = [message for message in made if "image" in message.topic]
    messages = [replace(m, topic=f"/cam{number}") for number in range(48) for m in images]
    write_mcap(tmp_path / "d.mcap", Scene(sorted(messages, key=lambda m: m.log_time)))
    limits = "ulimit -Sn 40; ulimit -Hn 40; "
    for parts in ("", " --gop 2 --window 2"):
        done = run(f"pack d.mcap -o d --force{parts}", "", tmp_path, limits)
        assert done.code == 1
        assert "too many files are open at once; `ulimit -n` allows more" in done.err
        assert not (tmp_path / "d").exists()
    done = run("pack d.mcap -o d --restart", "", tmp_path, "ulimit -Sn 40; ")
    assert done.code == 0, done.err
    assert mp4ds.validate(tmp_path / "d", deep=True) == []
    done = run("unpack d --to mcap -o again.mcap", "", tmp_path, limits)
    assert done.code == 1
    assert "too many files are open at once; `ulimit -n` allows more" in done.err
