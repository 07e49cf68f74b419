"""Bad input and hard times: one clear sentence, the right exit code, and nothing left behind.

Exit codes: 0 done; 1 the job failed or problems were found; 2 wrong input or options; 130
interrupted.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from commands import (
    Result,
    call,
    refused,
    run,
    start,
    tree,
    unchanged,
    without_progress,
)
from compare import compare
from scenes import ENCODINGS, IMAGE, START, Record, Scene, image_cdr, image_ros1, picture
from sources import SOURCES, scene, write_bag, write_mcap, write_rosbag2
from test_faults import disk_of
from waiting import WATCHDOG_S, until


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a bag of two cameras and its dataset; not to be changed."""
    folder = tmp_path_factory.mktemp("demo")
    assert call("demo", folder / "drive.bag", "--seconds", 1).code == 0
    assert call("pack", folder / "drive.bag", "-o", folder / "drive").code == 0
    return folder


@pytest.fixture
def small_bag(tmp_path: Path) -> Path:
    write_bag(tmp_path / "drive.bag", scene("mono8", frames=4))
    return tmp_path / "drive.bag"


@pytest.fixture
def small_dataset(packed_bag: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(packed_bag, tmp_path / "dataset"))


# ---------------------------------------------------------------- sources that cannot be read

LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0123\nsize 123456789\n"
SUFFIXES = ("bag", "mcap", "db3")


def written(name: str, data: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def of_kind(kind: str, folder: Path) -> Path:
    """A good file of a kind, with images, calibrations and other messages."""
    path = folder / f"drive.{kind}"
    if kind == "bag":
        write_bag(path, scene("mono8"))
    elif kind == "mcap":
        write_mcap(path, scene("mono8"))
    else:
        write_rosbag2(folder / "whole", scene("mono8"))
        shutil.move(str(next((folder / "whole").glob("*.db3"))), path)
        shutil.rmtree(folder / "whole")
    return path


def cut(kind: str) -> Callable[[Path], Path]:
    """A file that ends in its middle."""

    def make(folder: Path) -> Path:
        path = of_kind(kind, folder)
        os.truncate(path, path.stat().st_size // 2)
        return path

    return make


def damaged(folder: Path) -> Path:
    """A file whose index is whole and whose messages are not."""
    path = of_kind("mcap", folder)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(byte ^ 0x55 for byte in data[middle : middle + 64])
    path.write_bytes(data)
    return path


def folder_of(change: Callable[[Path], object], **options: Any) -> Callable[[Path], Path]:
    """A rosbag2 folder that was changed."""

    def make(folder: Path) -> Path:
        write_rosbag2(folder / "drive", scene("mono8"), **options)
        change(folder / "drive")
        return folder / "drive"

    return make


def database(folder: Path) -> Path:
    with contextlib.closing(sqlite3.connect(folder / "other.db3")) as connection:
        connection.execute("CREATE TABLE messages (id INTEGER, text TEXT)")
        connection.commit()
    return folder / "other.db3"


def empty_folder(folder: Path) -> Path:
    (folder / "drive").mkdir()
    return folder / "drive"


def pipe(folder: Path) -> Path:
    """Which nobody writes into: reading it would wait for ever."""
    os.mkfifo(folder / "drive.bag")
    return folder / "drive.bag"


BAD_SOURCES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "missing": (lambda folder: folder / "none.bag", "no such file"),
    "name-too-long": (lambda folder: folder / ("x" * 300 + ".bag"), "xxx.bag"),
    "below-a-file": (lambda folder: written("a.bag", b"")(folder) / "b.bag", "b.bag"),
    **{f"text.{s}": (written(f"drive.{s}", b"hello\n" * 9), "is not a") for s in SUFFIXES},
    **{f"empty.{s}": (written(f"drive.{s}", b""), "is empty") for s in SUFFIXES},
    **{f"git-lfs.{s}": (written(f"drive.{s}", LFS_POINTER), "git lfs pull") for s in SUFFIXES},
    "text": (written("notes.txt", b"hello\n"), "is not in a recording format"),
    "no-suffix": (written("notes", b""), "is not in a recording format"),
    **{f"half.{s}": (cut(s), "drive." + s) for s in SUFFIXES},
    "damaged.mcap": (damaged, "is damaged"),
    "other-database": (database, "but not of rosbag2"),
    "empty-folder": (empty_folder, "has no metadata.yaml"),
    "pipe": (pipe, "drive.bag"),
    "metadata-junk": (
        folder_of(lambda folder: (folder / "metadata.yaml").write_bytes(b"\xff: [")),
        "metadata.yaml",
    ),
    "split-missing": (
        folder_of(lambda folder: sorted(folder.glob("*.db3"))[1].unlink(), files=3),
        "is missing",
    ),
}


@pytest.mark.parametrize(
    ("command", "name"),
    [
        *(("pack", name) for name in BAD_SOURCES),
        *(("info", name) for name in BAD_SOURCES if name != "damaged.mcap"),  # reads no images
    ],
)
def test_a_source_that_cannot_be_read(command: str, name: str, tmp_path: Path) -> None:
    make, word = BAD_SOURCES[name]
    path = make(tmp_path)
    options = ("-o", tmp_path / "dataset") if command == "pack" else ()
    with unchanged(tmp_path):
        refused(call(command, path, *options), 2, word)


def test_a_source_that_is_given_twice(small_bag: Path, tmp_path: Path) -> None:
    (tmp_path / "link.bag").symlink_to(small_bag.name)
    for other in (small_bag, tmp_path / "." / "drive.bag", tmp_path / "link.bag"):
        with unchanged(tmp_path):
            result = call("pack", small_bag, other, "-o", tmp_path / "dataset")
            refused(result, 2, "is given twice")


# ---------------------------------------------------------------- sources that are unusual


def round_trip(source: Path, to: str, tmp_path: Path) -> Result:
    """Pack, validate, unpack and compare; returns what pack said."""
    before = tree(source) if source.is_dir() else source.read_bytes()
    packed = call("pack", source, "-o", tmp_path / "dataset")
    assert packed.code == 0, packed.err
    assert packed.err == ""
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    output = tmp_path / f"again{ {'bag': '.bag', 'mcap': '.mcap'}.get(to, '') }"
    unpacked = call("unpack", tmp_path / "dataset", "--to", to, "-o", output)
    assert unpacked.code == 0, unpacked.err
    assert compare([source], output) == []
    assert (tree(source) if source.is_dir() else source.read_bytes()) == before
    return packed


def only(source: Scene, *topics: str) -> Scene:
    return Scene([message for message in source.messages if message.topic in topics])


EMPTY = Scene([], {"/cam/image_raw": IMAGE, "/chatter": "std_msgs/msg/String"})
NO_IMAGES = only(scene("mono8"), "/imu", "/tf", "/cam/camera_info")


@pytest.mark.parametrize("kind", ["bag", "mcap", "rosbag2"])
@pytest.mark.parametrize("content", ["no-messages", "no-channels", "no-images"])
def test_nothing_for_a_video(content: str, kind: str, tmp_path: Path) -> None:
    made = {"no-messages": EMPTY, "no-channels": Scene([]), "no-images": NO_IMAGES}[content]
    name = {"bag": "bag-none", "mcap": "mcap-ros2-zstd", "rosbag2": "rosbag2-sqlite3-v9"}[kind]
    source = SOURCES[name](tmp_path, made)[0]
    packed = round_trip(source, kind, tmp_path)
    assert "no topic became a video" in packed.out
    assert not list(tmp_path.glob("dataset/*.mp4"))


def with_short_images() -> Scene:
    """Eight images, of which numbers 3 and 6 have less data than their headers say."""
    messages = []
    for n in range(8):
        pixels = picture("mono8", frame=n, width=32, height=24, rng=None).tobytes()
        data = pixels[:-5] if n in (3, 6) else pixels
        fields: dict[str, Any] = {"width": 32, "height": 24, "encoding": "mono8", "step": 32}
        stamp = START + n * 10**8
        ros1 = image_ros1(**fields, data=data, stamp=stamp, seq=n)
        cdr = image_cdr(**fields, data=data, stamp=stamp)
        messages.append(Record("/odd/image", IMAGE, stamp, ros1=ros1, cdr=cdr))
    return Scene(messages)


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_an_image_with_less_data_than_its_header_says(kind: str, tmp_path: Path) -> None:
    name = {"bag": "bag-none", "mcap": "mcap-ros2-zstd"}[kind]
    source = SOURCES[name](tmp_path, with_short_images())[0]
    packed = round_trip(source, kind, tmp_path)
    said = [line for line in packed.out.splitlines() if "verbatim" in line]
    assert len(said) == 1
    assert said[0].startswith("/odd/image: 2 of 8 messages stored verbatim in messages.mcap: ")
    assert "763 bytes of pixels where step x height says 768" in said[0]
    assert "first: message 3" in said[0]
    shutil.rmtree(tmp_path / "dataset")
    packed = call("pack", source, "-o", tmp_path / "dataset", "--json")
    topic = json.loads(packed.out)["topics"][0]
    assert (topic["topic"], topic["messages"], topic["frames"]) == ("/odd/image", 8, 6)
    assert list(topic["verbatim"].values()) == [[2, 3]]


def cameras(*topics: str) -> Scene:
    messages = []
    for number, topic in enumerate(topics):
        made = scene(ENCODINGS[number % 3], frames=3, with_info=False, seed=number)
        messages += [replace(m, topic=topic) for m in only(made, "/cam/image_raw").messages]
    return Scene(sorted(messages, key=lambda message: message.log_time))


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_topics_that_map_to_one_file_name(kind: str, tmp_path: Path) -> None:
    topics = ("/a/b", "/a_b", "/A/b", "/a.b/", "/a_b-2")
    name = {"bag": "bag-none", "mcap": "mcap-ros2-zstd"}[kind]
    source = SOURCES[name](tmp_path, cameras(*topics))[0]
    packed = round_trip(source, kind, tmp_path)
    with mp4ds.open(tmp_path / "dataset") as dataset:
        files = {stream.topic: stream.sidecar.video.file for stream in dataset.streams}
    assert sorted(files) == sorted(topics)
    assert len({name.casefold() for name in files.values()}) == len(topics)
    for topic, file in files.items():
        if re.search(r"-\d\.mp4$", file) and topic != "/a_b-2":
            assert f"{topic}: stored as {file}" in packed.out
    assert packed.out.count("stored as") >= 2


@pytest.mark.parametrize(
    "topics",
    [("/../x", "/..", "..", "/."), ("", "/"), ("/dataset", "/messages", "/con"), ("/ä", "/相机"),
     ("/a\nb", "/\x1b[31mred", "/[bold]", "/a[/b]"), ("/" + "x" * 300, "/" + "x" * 299 + "y")],
)  # fmt: skip
def test_topics_with_odd_names(topics: tuple[str, ...], tmp_path: Path) -> None:
    write_mcap(tmp_path / "drive.mcap", cameras(*topics))
    packed = round_trip(tmp_path / "drive.mcap", "mcap", tmp_path)
    names = {path.name for path in (tmp_path / "dataset").iterdir()}
    assert all(re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}", name) for name in names)
    assert len(names) == 2 + 3 * len(topics)
    assert "\x1b" not in packed.out
    assert call("info", tmp_path / "dataset").code == 0


def test_a_terminal_that_cannot_show_a_topic(tmp_path: Path) -> None:
    write_mcap(tmp_path / "drive.mcap", cameras("/ä", "/相机"))
    environment = {"PYTHONIOENCODING": "ascii"}
    packed = run("pack", tmp_path / "drive.mcap", "-o", tmp_path / "dataset", env=environment)
    assert "Traceback" not in packed.err
    assert packed.code == 0
    assert "topic.mp4" in packed.out


@pytest.mark.one_in(2)
@pytest.mark.parametrize("job", ["pack", "slice", "lerobot", "evaluate"])
def test_a_pyav_that_only_reads(
    job: str, demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mp4ds.video.codecs.AV_VERSION", (17, 0))
    arguments = {
        "pack": ("pack", demo / "drive.bag", "-o", tmp_path / "x"),
        "slice": ("pack", demo / "drive", "-o", tmp_path / "x", "--duration", 0.5),
        "lerobot": ("export", "lerobot", demo / "drive", "-o", tmp_path / "x"),
        "evaluate": ("evaluate", demo / "drive", "-o", tmp_path / "x"),
    }[job]
    with unchanged(tmp_path):
        refused(call(*arguments), 1, "To write videos", "run pip install 'av>=17.1'")
    assert call("validate", demo / "drive").code == 0


# ---------------------------------------------------------------- targets that may not be written


@pytest.mark.parametrize("command", ["pack", "unpack", "demo"])
@pytest.mark.parametrize("place", ["below-a-file", "no-parent", "exists", "dangling-link"])
def test_a_target_that_may_not_be_written(
    place: str, command: str, small_bag: Path, small_dataset: Path, tmp_path: Path
) -> None:
    (tmp_path / "there").write_text("mine")
    (tmp_path / "link").symlink_to("nowhere")
    name = {"below-a-file": "there/x", "no-parent": "none/x", "exists": "there"}.get(place, "link")
    target = tmp_path / name
    if command == "demo":
        target = target.with_suffix(".mcap")
        if place == "exists":
            target.write_text("mine")
        elif place == "dangling-link":
            target.symlink_to("nowhere")
    arguments = {
        "pack": ("pack", small_bag, "-o", target),
        "unpack": ("unpack", small_dataset, "--to", "mcap", "-o", target),
        "demo": ("demo", target, "--seconds", 0.1),
    }[command]
    with unchanged(tmp_path):
        result = call(*arguments)
        refused(result, 2, str(target))
        if place in ("exists", "dangling-link"):
            assert "--force" in result.err


def test_a_folder_that_is_read_only(demo: Path, tmp_path: Path) -> None:
    with disk_of(tmp_path / "disk", "size=512k,ro") as disk:
        for arguments in (
            ("pack", demo / "drive.bag", "-o", disk / "x"),
            ("unpack", demo / "drive", "--to", "mcap", "-o", disk / "x.mcap"),
            ("demo", disk / "x.mcap"),
        ):
            refused(call(*arguments), 2, str(disk / "x"), "Read-only file system")


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere"
)
def test_a_folder_without_permission(small_bag: Path, small_dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o555)
    target = tmp_path / "locked" / "x"
    with unchanged(tmp_path):
        refused(call("pack", small_bag, "-o", target), 2, str(target), "Permission denied")
        result = call("unpack", small_dataset, "--to", "mcap", "-o", target)
        refused(result, 2, str(target), "Permission denied")
    small_bag.chmod(0)
    refused(call("pack", small_bag, "-o", tmp_path / "x"), 2, "Permission denied")


def test_what_is_replaced_stays_until_the_new_one_is_whole(
    small_dataset: Path, tmp_path: Path
) -> None:
    bad = damaged(tmp_path)
    with unchanged(tmp_path):
        refused(call("pack", bad, "-o", small_dataset, "--force"), 2, "is damaged")
    assert call("unpack", small_dataset, "--to", "bag", "-o", tmp_path / "again.bag").code == 0
    video = small_dataset / "cam_image_raw.mp4"
    os.truncate(video, video.stat().st_size - 2000)
    with unchanged(tmp_path):
        target = tmp_path / "again.bag"
        refused(call("unpack", small_dataset, "--to", "bag", "-o", target, "--force"), 1)


# ---------------------------------------------------------------- a target that is the source


@pytest.mark.parametrize("name", ["bag-none", "rosbag2-sqlite3-v9"])
def test_packing_onto_the_source(name: str, tmp_path: Path) -> None:
    source = SOURCES[name](tmp_path, scene("mono8", frames=3))[0]
    for force in ((), ("--force",)):
        with unchanged(tmp_path):
            refused(call("pack", source, "-o", source, *force), 2, str(source))


@pytest.mark.parametrize("name", ["messages.mcap", "cam_image_raw.mp4", "dataset.yaml", "new.mcap"])
@pytest.mark.parametrize("to", ["bag", "mcap"])
def test_unpacking_into_the_dataset(
    to: str, name: str, small_dataset: Path, tmp_path: Path
) -> None:
    target = small_dataset / name
    with unchanged(tmp_path):
        result = call("unpack", small_dataset, "--to", to, "-o", target, "--force")
        refused(result, 2, str(small_dataset))


# ---------------------------------------------------------------- a disk that is full

TARGETS = {
    "bag": ("unpack", "--to", "bag", "-o", "x.bag"),
    "mcap": ("unpack", "--to", "mcap", "-o", "x.mcap"),
    "rosbag2-sqlite3": ("unpack", "--to", "rosbag2", "--storage", "sqlite3", "-o", "x"),
    "rosbag2-mcap": ("unpack", "--to", "rosbag2", "--storage", "mcap", "-o", "x"),
    "images": ("export", "images", "-o", "x"),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("job", ["pack", "pack-lossy", "demo", *TARGETS])
def test_a_disk_that_is_full_half_way(job: str, demo: Path, tmp_path: Path) -> None:
    with disk_of(tmp_path / "disk", "size=512k") as disk, unchanged(demo):
        if job == "demo":
            result = call("demo", disk / "x.mcap", "--seconds", 1)
        elif job == "pack":
            result = call("pack", demo / "drive.bag", "-o", disk / "x")
        elif job == "pack-lossy":
            lossy = ("--quality", "crf=1", "--codec", "h264", "--preset", "ultrafast")
            result = call("pack", demo / "drive.bag", "-o", disk / "x", *lossy)
        else:
            *words, name = TARGETS[job]
            result = call(*words, disk / name, demo / "drive")
        refused(result, 1, str(disk / "x"), "No space left")
        assert tree(disk) == {}


# ---------------------------------------------------------------- an interruption


@pytest.fixture(scope="module")
def long_demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag that takes several seconds to pack; not to be changed."""
    path = tmp_path_factory.mktemp("long") / "drive.bag"
    assert call("demo", path, "--seconds", 2).code == 0
    return path


def interrupted(
    folder: Path, *arguments: object, numbers: Sequence[int] = (signal.SIGINT,), **options: Any
) -> Result:
    """A command that gets SIGINT, or other signals, as soon as it has begun to write."""
    process = start(*arguments, **options)
    until(lambda: list(folder.glob(".*.part/*")), process)
    for number in numbers:
        process.send_signal(number)
    out, err = process.communicate(timeout=WATCHDOG_S)
    return Result(process.returncode, out, without_progress(err))


SLOW = ("--quality", "crf=20", "--preset", "2")


def test_interrupting_a_pack(long_demo: Path, tmp_path: Path) -> None:
    with unchanged(tmp_path), unchanged(long_demo.parent):
        result = interrupted(tmp_path, "pack", long_demo, "-o", tmp_path / "x", *SLOW)
        refused(result, 130, "interrupted")


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("numbers", "is_ignored", "code"),
    [
        ([signal.SIGTERM], False, 143),
        ([signal.SIGHUP], False, 129),
        ([signal.SIGHUP] * 3, False, 129),
        ([signal.SIGHUP, signal.SIGTERM], True, 143),
    ],
    ids=["SIGTERM", "SIGHUP", "SIGHUP thrice", "nohup"],
)
def test_a_lost_terminal_leaves_nothing(
    numbers: list[int], is_ignored: bool, code: int, long_demo: Path, tmp_path: Path
) -> None:
    def ignore() -> None:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    with unchanged(tmp_path):
        arguments = ("pack", long_demo, "-o", tmp_path / "x", *SLOW)
        options = {"numbers": numbers, "preexec_fn": ignore if is_ignored else None}
        result = interrupted(tmp_path, *arguments, **options)
        refused(result, code, "terminated; no partial output was left behind")  # nor is any kept


def test_interrupting_an_export(long_demo: Path, tmp_path: Path) -> None:
    fast = ("--quality", "crf=40", "--codec", "h264", "--preset", "ultrafast")
    assert call("pack", long_demo, "-o", tmp_path / "dataset", *fast).code == 0
    with unchanged(tmp_path):
        target = tmp_path / "images"
        arguments = ("export", "images", tmp_path / "dataset", "-o", target)
        refused(interrupted(tmp_path, *arguments), 130, "interrupted")


# ---------------------------------------------------------------- options

BAD_OPTIONS: dict[str, tuple[tuple[str, ...], str]] = {
    **{
        f"quality {value}": (("pack", "BAG", "-o", "OUT", "--quality", value), "lossless, visual")
        for value in ("best", "crf=64", "crf=1.5", "crf=\u0661", "")
    },
    "codec": (("pack", "BAG", "-o", "OUT", "--codec", "theora"), "h264"),
    "codec-lossless": (("pack", "BAG", "-o", "OUT", "--codec", "av1"), "av1"),
    "codec-lossy": (("pack", "BAG", "-o", "OUT", "--quality", "crf=20", "--codec", "ffv1"), "ffv1"),
    "topics": (("pack", "BAG", "-o", "OUT", "--topics", "/none/*"), "/cam/image_raw"),
    "exclude": (("pack", "BAG", "-o", "OUT", "--exclude", "/none/*"), "/cam/image_raw"),
    "to": (("unpack", "DATASET", "--to", "zip", "-o", "OUT"), "bag, rosbag2, mcap"),
    "storage": (
        ("unpack", "DATASET", "--to", "rosbag2", "--storage", "zip", "-o", "OUT"),
        "sqlite3, mcap",
    ),
    "to images": (("unpack", "DATASET", "--to", "images", "-o", "OUT"), "`mp4ds export images`"),
    "to images twice": (
        ("unpack", "DATASET", "DATASET", "--to", "images", "-o", "OUT"),
        "`mp4ds export images`",
    ),
    "unpack-topics": (("unpack", "DATASET", "--to", "bag", "-o", "OUT", "-t", "/no"), "/imu"),
    "unpack-exclude": (("unpack", "DATASET", "--to", "bag", "-o", "OUT", "-x", "/no"), "/imu"),
    "demo": (("demo", "OUT.db3"), ".mcap, .bag (ROS 1), or without a suffix"),
    "transcode-lossless": (("pack", "BAG", "-o", "OUT", "--transcode"), "--quality"),
    **{
        f"camera-info {value}": (("pack", "BAG", "-o", "OUT", "--camera-info", value), word)
        for value, word in {
            "/cam/image_raw": "IMAGE=INFO",
            "=": "IMAGE=INFO",
            "/none=/cam/camera_info": "'/none'",
            "/cam/image_raw=/none": "'/none'",
        }.items()
    },
    "images-kind": (
        ("unpack", "DATASET", "--to", "bag", "--images", "gif", "-o", "OUT"),
        "raw, jpeg, png, compressed-video",
    ),
    **{
        f"resize {value}": (("pack", "BAG", "-o", "OUT", "--resize", value), "--resize")
        for value in ("", "0", "-1", "640x", "640x480x3", "nan", "1e9", "big", "99999x9")
    },
    **{
        f"max-rate {value}": (("pack", "BAG", "-o", "OUT", "--max-rate", value), "Hz")
        for value in ("0", "-3", "nan", "inf")
    },
    **{
        f"below {option}": ((command, *given, option, "0"), f"{option} 0 is")
        for command, *given, option in (
            ("pack", "BAG", "-o", "OUT", "--gop"),
            ("pack", "BAG", "-o", "OUT", "--jobs"),
            ("pack", "BAG", "-o", "OUT", "--every"),
        )
    },
}


@pytest.mark.parametrize("name", BAD_OPTIONS)
def test_an_option_that_is_wrong(
    name: str, small_bag: Path, small_dataset: Path, tmp_path: Path
) -> None:
    arguments, word = BAD_OPTIONS[name]
    paths = {"BAG": small_bag, "DATASET": small_dataset, "OUT": tmp_path / "out"}
    with unchanged(tmp_path):
        refused(call(*(paths.get(argument, argument) for argument in arguments)), 2, word)


@pytest.mark.parametrize("codec", ["h264", "av1"])
def test_a_preset_that_is_wrong(codec: str, small_bag: Path, tmp_path: Path) -> None:
    # as a process: encoders write to stderr on their own
    with unchanged(tmp_path):
        options = ("--quality", "crf=20", "--codec", codec, "--preset", "quick")
        refused(run("pack", small_bag, "-o", tmp_path / "x", *options), 2, "'quick'")


@pytest.mark.parametrize(
    "arguments",
    [
        ("pack",),
        ("pack", "BAG", "-o", "OUT", "--gop", "many"),
        ("pack", "BAG", "-o", "OUT", "--fast"),
        ("unpack",),
        ("pack", "BAG", "-o", "OUT", "--every", "1.5"),
        ("sell", "BAG"),
    ],
    ids=" ".join,
)
def test_a_command_line_that_cannot_be_understood(
    arguments: tuple[str, ...], small_bag: Path, small_dataset: Path, tmp_path: Path
) -> None:
    paths = {"BAG": small_bag, "DATASET": small_dataset, "OUT": tmp_path / "out"}
    with unchanged(tmp_path):
        result = call(*(paths.get(argument, argument) for argument in arguments))
        assert result.code == 2
        assert "Traceback" not in result.err
        assert re.search(r"^Error: |^mp4ds: \S+ .* (below|from) ", result.err, re.MULTILINE)


# ---------------------------------------------------------------- datasets that are none

NO_DATASETS: dict[str, Callable[[Path], Path]] = {
    "missing": lambda folder: folder / "none",
    "name-too-long": lambda folder: folder / ("x" * 300),
    "text": written("notes.txt", b"hello\n"),
    "empty-folder": empty_folder,
    "bag": lambda folder: of_kind("bag", folder),
    "mcap": lambda folder: of_kind("mcap", folder),
    "rosbag2": folder_of(lambda folder: None),
}


@pytest.mark.parametrize("command", ["unpack", "validate"])
@pytest.mark.parametrize("name", NO_DATASETS)
def test_not_a_dataset(name: str, command: str, tmp_path: Path) -> None:
    path = NO_DATASETS[name](tmp_path)
    options = ("--to", "mcap", "-o", tmp_path / "out.mcap") if command == "unpack" else ()
    with unchanged(tmp_path):
        refused(call(command, path, *options), 2, str(path))


@pytest.mark.parametrize("to", ["bag", "rosbag2"])
def test_messages_that_a_target_cannot_hold(to: str, tmp_path: Path) -> None:
    source = SOURCES["mcap-none-profile"](tmp_path, scene("mono8"))[0]
    assert call("pack", source, "-o", tmp_path / "dataset").code == 0
    with unchanged(tmp_path):
        result = call("unpack", tmp_path / "dataset", "--to", to, "-o", tmp_path / "out")
        refused(result, 1, "topic /", "json", "--exclude", "mcap")


# ---------------------------------------------------------------- --json


def parsed(result: Result) -> Any:
    """Standard output as strict JSON."""

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is no JSON")

    return json.loads(result.out, parse_constant=refuse)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("pack", "none.bag", "-o", "OUT"), 2),
        (("pack", "BAG", "-o", "OUT", "--quality", "best"), 2),
        (("unpack", "none", "--to", "bag"), 2),
        (("unpack", "DATASET", "--to", "zip"), 2),
        (("validate", "none"), 2),
        (("info", "none.bag"), 2),
        (("demo", "OUT.db3"), 2),
    ],
)
def test_json_of_failure(
    arguments: tuple[str, ...], code: int, small_bag: Path, small_dataset: Path, tmp_path: Path
) -> None:
    paths = {"BAG": small_bag, "DATASET": small_dataset, "OUT": tmp_path / "out"}
    with unchanged(tmp_path):
        result = call(*(paths.get(argument, argument) for argument in arguments), "--json")
    found = parsed(result)
    assert (result.code, found["exit_code"]) == (code, code)
    assert result.err == f"mp4ds: {found['error']}\n"


def test_json_of_problems(small_dataset: Path) -> None:
    (small_dataset / "messages.mcap").unlink()
    result = call("validate", small_dataset, "--json")
    assert (result.code, result.err) == (1, "")
    problems = parsed(result)["problems"]
    assert [problem["code"] for problem in problems] == ["file-missing"]
    assert set(problems[0]) >= {"code", "place", "message"}


def test_a_newer_minor_version_is_told_in_one_line(small_dataset: Path) -> None:
    path = small_dataset / "cam_image_raw.yaml"
    text = path.read_bytes()
    text = text[: text.rindex(b"checksum:")].replace(b'mp4ds: "2.0"', b'mp4ds: "2.7"\nfancy: 1')
    path.write_bytes(text)
    result = run("info", path)
    assert result.code == 0, result.err
    assert re.fullmatch(r"mp4ds: [^\n]*2\.7[^\n]*\n", result.err), result.err
