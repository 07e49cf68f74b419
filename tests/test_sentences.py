"""What commands say of their results, and of what is wrong with their input."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import mp4ds
from each import each, fresh
from scenes import START, Record, Scene
from sources import scene, write_bag
from test_bad_input import call

VIDEO, SIDECAR = "cam_image_raw.mp4", "cam_image_raw.yaml"


@fresh
def dataset(packed_bag: Path, tmp_path: Path) -> Path:
    """A dataset that may be damaged."""
    shutil.copytree(packed_bag, tmp_path / "drive")
    return tmp_path / "drive"


# ---------------------------------------------------------------- results


def test_what_has_no_bytes_has_no_ratio(tmp_path: Path) -> None:
    """A slice that holds nothing but messages without fields."""
    words = Record("/chatter", "std_msgs/msg/String", START, {"data": "x"})
    empty = Record("/start", "std_msgs/msg/Empty", START + 10**9, ros1=b"")
    write_bag(tmp_path / "drive.bag", Scene([words, empty]))
    done = call("pack", tmp_path / "drive.bag", "-o", tmp_path / "drive", "--start", "0.5")
    assert (done.code, done.err) == (0, "")
    assert "drive: 0 B -> " in done.out
    assert "times" not in done.out


def test_what_was_checked_of_a_dataset(dataset: Path) -> None:
    done = call("validate", "--deep", dataset)
    assert done.out.endswith(
        "no problems; every video was decoded, every message with a digest checked\n"
    )
    (dataset / VIDEO).unlink()
    done = call("validate", "--deep", dataset)
    assert done.code == 1
    assert done.out.splitlines() == [
        f"{dataset / VIDEO}: is listed in the manifest but missing [file-missing]",
        f"{dataset}: 1 problem",
    ]


# ---------------------------------------------------------------- what is wrong


def cut(name: str, before: bytes) -> Callable[[Path], None]:
    """Cut a file of a dataset short."""

    def damage(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: data.index(before)])

    return damage


CUT = {
    "a video, before its index": (cut(VIDEO, b"moov"), VIDEO, "was cut short: it has no index"),
    "a video, in its index": (
        cut(VIDEO, b"mvhd"),
        VIDEO,
        "was cut short or damaged: the file ends in the middle of a box",
    ),
    "a sidecar, between keys": (cut(SIDECAR, b"headers:"), SIDECAR, "ends without headers, video"),
    "a sidecar, in a key": (
        cut(SIDECAR, b"aders:"),
        SIDECAR,
        "is not valid YAML of the subset, perhaps cut",
    ),
    "a manifest": (cut("dataset.yaml", b"files:"), "dataset.yaml", "ends without files: it was"),
    "a manifest, in a text": (
        cut("dataset.yaml", b'"\n'),
        "dataset.yaml",
        "is not valid YAML of the subset, perhaps cut short: line 2: found unexpected",
    ),
}


@each("what", CUT)
def test_what_was_cut_short(what: str, dataset: Path) -> None:
    """By `validate`, which says so once, and by whatever reads it."""
    damage, name, words = CUT[what]
    damage(dataset)
    said = call("validate", dataset).out
    assert f"{dataset / name}: {words}" in said
    assert said.count(words) == 1
    assert "schema-invalid" not in said.replace("short [schema-invalid]", "")
    read = call("unpack", dataset, "--to", "mcap", "-o", dataset.parent / "again.mcap")
    assert read.code == 1
    assert "This is a bug" not in read.err
    if name != VIDEO:
        assert f"{dataset / name}: {words}" in read.err


def test_a_video_alone_that_was_cut_short(dataset: Path, tmp_path: Path) -> None:
    data = (dataset / VIDEO).read_bytes()
    for size in (len(data) - 10, data.index(b"moov") + 60, len(data) // 3):
        (tmp_path / "alone.mp4").write_bytes(data[:size])
        with pytest.raises(mp4ds.VideoError, match="the file ends in the middle of a box"):
            mp4ds.open(tmp_path / "alone.mp4")
    (tmp_path / "alone.mp4").write_bytes(b"")
    with pytest.raises(mp4ds.VideoError, match="is empty"):
        mp4ds.open(tmp_path / "alone.mp4")


def test_a_folder_of_datasets_is_not_one(dataset: Path) -> None:
    with pytest.raises(mp4ds.SourceError) as caught:
        mp4ds.open(dataset.parent)
    assert str(caught.value) == (
        f"{dataset.parent}: is a folder of 1 dataset, not a dataset. Open one of them, such as "
        f"{dataset}."
    )


@each(
    ("words", "said"),
    [
        ("pack IN -o OUT --gop 0", "Invalid value for '--gop': 0 is below 1"),
        ("pack IN -o OUT --gop 200000", "Invalid value for '--gop': 200000 is above 100000"),
        ("pack IN -o OUT --gop ten", "Invalid value for '--gop': 'ten' is not a whole number"),
        ("demo OUT --seconds ten", "Invalid value for '--seconds': 'ten' is not a number"),
        ("validate IN --jobs 0", "0 is below 1"),
        ("pack IN -o OUT --codec bogus", "--codec 'bogus' is not one that mp4ds can encode. Use "),
        ("pack IN -o OUT --codec av1", "--codec 'av1' does not support lossless packing. Use "),
        ("pack IN -o OUT --duration +1e9", "--duration '+1e9' is not a number of seconds"),
        ("demo /proc/no.bag", "no.bag: "),
    ],
)
def test_what_an_option_may_be(words: str, said: str, tmp_path: Path) -> None:
    write_bag(tmp_path / "drive.bag", scene("mono8", frames=2))
    places = {"IN": tmp_path / "drive.bag", "OUT": tmp_path / "out"}
    done = call(*(places.get(word, word) for word in words.split()))
    assert done.code in (1, 2)
    assert said in done.err
    assert not re.search("Input should|source is untouched", done.err)
    assert not (tmp_path / "out").exists()


def test_h265_is_also_called_hevc(tmp_path: Path) -> None:
    write_bag(tmp_path / "drive.bag", scene("mono8", frames=2))
    options = mp4ds.PackOptions(codec="hevc", quality="crf=30", preset="ultrafast")
    mp4ds.pack(tmp_path / "drive.bag", tmp_path / "drive", options)
    with mp4ds.open(tmp_path / "drive") as opened:
        assert [stream.sidecar.video.codec for stream in opened.streams] == ["h265"]
