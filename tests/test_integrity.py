"""A dataset is whole or visibly not: damage is found, and never unpacked as if whole."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import mp4ds
from coded_scenes import CODED
from compare import compare
from edits import Document, agreed, changed, digest
from mp4ds import Mp4dsError, SourceError
from scenes import Scene
from sources import SOURCES, scene

STEM = "cam_image_raw"
FILES = (f"{STEM}.mp4", f"{STEM}.yaml", "dataset.yaml", "messages.mcap")
TARGETS = {"bag-none": "bag", "mcap-ros2-zstd": "mcap", "rosbag2-sqlite3-v9": "rosbag2"}
POSITIONS = 25
DAMAGED_YAML = {
    "checksum-mismatch",
    "yaml-invalid",
    "schema-invalid",
    "model-invalid",
    "version-unsupported",
    "kind-unknown",
    "column-invalid",
}

CHANGED_FILE = {"size-mismatch", "hash-mismatch"}

MakePacked = Callable[[str], tuple[list[Path], Path]]


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> MakePacked:
    """Recordings of a source, or of coded pictures, and their datasets; not to be changed."""
    made: dict[str, tuple[list[Path], Path]] = {}

    def make(source: str) -> tuple[list[Path], Path]:
        if source not in made:
            folder = tmp_path_factory.mktemp(source)
            made_of = CODED[source](frames=6) if source in CODED else scene("bayer_rggb8")
            write = SOURCES["mcap-ros2-none" if source in CODED else source]
            paths = write(folder / "source", made_of)
            mp4ds.pack(paths, folder / "dataset")
            made[source] = paths, folder / "dataset"
        return made[source]

    return make


@pytest.fixture
def dataset(packed: MakePacked, tmp_path: Path) -> Path:
    """A dataset of a bag, to be damaged."""
    return Path(shutil.copytree(packed("bag-none")[1], tmp_path / "dataset"))


@pytest.fixture
def two_cameras(tmp_path: Path) -> Path:
    """A dataset of two streams, to be damaged."""
    left = scene("mono8", with_info=False).messages
    right = scene("rgb8", with_info=False, frames=6).messages
    messages = [replace(m, topic=f"/left{m.topic}") for m in left]
    messages += [replace(m, topic=f"/right{m.topic}") for m in right]
    messages.sort(key=lambda message: message.log_time)
    paths = SOURCES["bag-none"](tmp_path, Scene(messages))
    mp4ds.pack(paths, tmp_path / "dataset")
    return tmp_path / "dataset"


def codes(path: Path, *, deep: bool = True) -> list[str]:
    return sorted({problem.code for problem in mp4ds.validate(path, deep=deep)})


def unpacked(folder: Path, to: str, output: Path) -> str:
    """Unpack; returns the error's text, which may only be one that mp4ds raises on purpose."""
    before = sorted(output.parent.iterdir())
    try:
        mp4ds.unpack(folder, to, output)
    except Mp4dsError as error:
        assert sorted(output.parent.iterdir()) == before
        return str(error)
    return ""


def refused(folder: Path, to: str = "mcap") -> str:
    """The error of unpacking, which must fail."""
    text = unpacked(folder, to, folder.parent / "again")
    assert text, "it was unpacked"
    return text


# ---------------------------------------------------------------- single bits


def flips(data: bytes, seed: str) -> Iterator[tuple[int, bytes]]:
    """The file with one bit changed, at chosen places, the first and the last among them."""
    rng = random.Random(seed)
    chosen = {0, 1, len(data) - 2, len(data) - 1}
    chosen |= {rng.randrange(len(data)) for _ in range(POSITIONS)}
    for position in sorted(chosen):
        damaged = bytearray(data)
        damaged[position] ^= 1 << rng.randrange(8)
        yield position, bytes(damaged)


def found_in(folder: Path, name: str) -> str:
    """What is wrong with the answer of validate to a damaged file; empty if nothing is."""
    try:
        found = set(codes(folder))
    except Mp4dsError as error:
        return f"validate raised {error!r}"
    if not found:
        return "validate found no problem"
    if name == "dataset.yaml":
        return "" if found & DAMAGED_YAML else f"validate found {found}"
    if "hash-mismatch" not in found:
        return f"validate found {found} and no hash-mismatch"
    if name.endswith(".yaml") and not found & DAMAGED_YAML:
        return f"validate found only {found}"
    return ""


@pytest.mark.one_in(8)
@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("source", TARGETS)
def test_a_flipped_bit_is_found(
    source: str,
    name: str,
    packed: MakePacked,
    tmp_path: Path,
) -> None:
    recording, good = packed(source)
    folder = shutil.copytree(good, tmp_path / "dataset")
    (tmp_path / "out").mkdir()
    output = (
        tmp_path / "out" / f"again{ {'bag': '.bag', 'mcap': '.mcap'}.get(TARGETS[source], '') }"
    )
    wrong = []
    for position, data in flips((good / name).read_bytes(), f"{source} {name}"):
        (folder / name).write_bytes(data)
        if problem := found_in(folder, name):
            wrong.append(f"byte {position}: {problem}")
        if not unpacked(folder, TARGETS[source], output):
            wrong += [f"byte {position}: unpacked: {text}" for text in compare(recording, output)]
            shutil.rmtree(output) if output.is_dir() else output.unlink()
    assert wrong == []


def test_a_manifest_lists_no_other_file(dataset: Path) -> None:
    (dataset / "notes.txt").write_text("windy")
    entry = digest(dataset / "notes.txt")
    changed(dataset / "dataset.yaml", lambda manifest: manifest["files"].append(entry))
    assert codes(dataset) == ["manifest-inconsistent"]


# ---------------------------------------------------------------- coded pictures and packets

CODED_KINDS = [
    *("jpeg-rgb", "png-16-bit-cv2", "depth-16UC1-png", "depth-32FC1-rvl", "video-h264"),
    *("video-h265", "video-av1", "ffmpeg-libx264"),
]


def copied(good: Path, folder: Path) -> tuple[Path, Path]:
    """A copy of a dataset of one stream, and the video in it."""
    copy = Path(shutil.copytree(good, folder / "dataset"))
    (video,) = copy.glob("*.mp4")
    return copy, video


def unsealed(document: Document) -> None:
    """Without what tells that the video is another one."""
    del document["video"]["size"], document["video"]["sha256"]


def coded_data(video: bytes) -> tuple[int, int]:
    """Where the coded frames of an mp4 begin and end."""
    start = video.index(b"mdat")
    return start + 4, start - 4 + int.from_bytes(video[start - 4 : start], "big")


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", CODED_KINDS)
def test_digests_tell_of_each_coded_byte(kind: str, packed: MakePacked, tmp_path: Path) -> None:
    """Although sidecar and manifest agree with the damaged video."""
    folder, video = copied(packed(kind)[1], tmp_path)
    data, sidecar = video.read_bytes(), video.with_suffix(".yaml")
    changed(sidecar, unsealed)
    start, end = coded_data(data)
    rng = random.Random(kind)
    for position in sorted({start, end - 1, *(rng.randrange(start, end) for _ in range(12))}):
        damaged = bytearray(data)
        damaged[position] ^= 1 << rng.randrange(8)
        video.write_bytes(damaged)
        agreed(folder)
        found = set(codes(folder))
        assert found, f"byte {position}"
        found.discard("references-invalid")  # of which no message is made
        assert found <= {"digest-mismatch", "decode-failed", "header-mismatch"}, f"byte {position}"
        assert any(f"[{code}]" in refused(folder) for code in found)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("length", [0, 1, 40, 0.3, 0.9, -1])
@pytest.mark.parametrize("kind", CODED_KINDS)
def test_a_video_of_coded_pictures_that_was_cut_short(
    kind: str, length: float, packed: MakePacked, tmp_path: Path
) -> None:
    folder, video = copied(packed(kind)[1], tmp_path)
    data = video.read_bytes()
    video.write_bytes(data[: int(length * len(data)) if 0 < length < 1 else int(length)])
    assert "size-mismatch" in codes(folder, deep=False)
    if length != -1:
        refused(folder)
    changed(video.with_suffix(".yaml"), unsealed)
    agreed(folder)
    # the last byte of an mp4 belongs to a text, without which every message is whole
    assert set(codes(folder)) <= {"video-unreadable", "frame-count"}
    if length != -1:
        assert codes(folder)
        refused(folder)


# ---------------------------------------------------------------- whole files


def test_a_manifest_that_is_missing(dataset: Path) -> None:
    (dataset / "dataset.yaml").unlink()
    with pytest.raises(SourceError, match="dataset"):
        mp4ds.validate(dataset)
    assert "dataset" in refused(dataset)


def swap(folder: Path, suffix: str) -> None:
    left, right = (folder / f"{side}_cam_image_raw{suffix}" for side in ("left", "right"))
    first, second = left.read_bytes(), right.read_bytes()
    left.write_bytes(second)
    right.write_bytes(first)


def test_two_videos_that_were_swapped(two_cameras: Path) -> None:
    swap(two_cameras, ".mp4")
    found = codes(two_cameras)
    assert CHANGED_FILE & set(found)
    assert {"codec-mismatch", "geometry-mismatch", "frame-count"} & set(found)
    refused(two_cameras)


def test_swapped_sidecars_whose_manifest_was_made_to_agree(two_cameras: Path) -> None:
    swap(two_cameras, ".yaml")
    agreed(two_cameras)
    assert codes(two_cameras) == ["manifest-inconsistent"]


@pytest.mark.parametrize("length", [0, 1, 40, 0.3, 0.9, -1])
def test_messages_that_were_cut_short(length: float, dataset: Path) -> None:
    path = dataset / "messages.mcap"
    data = path.read_bytes()
    end = int(length * len(data)) if 0 < length < 1 else int(length) % len(data)
    path.write_bytes(data[:end])
    assert codes(dataset) == ["size-mismatch"]
    assert "messages.mcap" in refused(dataset)


def test_messages_of_another_dataset(dataset: Path, packed: MakePacked, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other = SOURCES["bag-none"](tmp_path / "other", scene("mono8", frames=4))
    mp4ds.pack(other, tmp_path / "other" / "dataset")
    shutil.copy(tmp_path / "other" / "dataset" / "messages.mcap", dataset)
    assert CHANGED_FILE & set(codes(dataset))
    agreed(dataset)
    assert codes(dataset) == ["message-count"]
    refused(dataset)


# ---------------------------------------------------------------- contradictions


@pytest.mark.parametrize(
    ("source", "column", "value"),
    [
        ("bag-none", "log_time", 2**32 * 10**9),
        ("rosbag2-sqlite3-v9", "log_time", -1),
        ("mcap-ros2-zstd", "publish_time", -1),
        ("mcap-ros2-zstd", "sequence", 2**32),
    ],
)
def test_what_the_format_of_the_recording_cannot_hold(
    source: str, column: str, value: int, packed: MakePacked, tmp_path: Path
) -> None:
    dataset = Path(shutil.copytree(packed(source)[1], tmp_path / "dataset"))

    def change(document: Document) -> None:
        values = document["columns"]
        values[column] = dict(values.get(column, values["log_time"])) | {"start": value}

    changed(dataset / f"{STEM}.yaml", change)
    agreed(dataset)
    for deep in (False, True):
        assert codes(dataset, deep=deep) == ["message-invalid"]
    refused(dataset, TARGETS[source])


def test_a_digest_that_was_changed_names_the_message(dataset: Path) -> None:
    def change(document: Document) -> None:
        digests = document["digests"]["values"].split()
        digests[5] = "0" * 16
        document["digests"]["values"] = " ".join(digests)

    changed(dataset / f"{STEM}.yaml", change)
    agreed(dataset)
    assert codes(dataset, deep=False) == []
    problems = mp4ds.validate(dataset, deep=True)
    assert [problem.code for problem in problems] == ["digest-mismatch"]
    assert "frame 5 of /cam/image_raw" in str(problems[0])
    assert "frame 5 of /cam/image_raw" in refused(dataset)


def test_a_stamp_that_was_changed(dataset: Path) -> None:
    def change(document: Document) -> None:
        document["columns"]["stamp"]["start"] += 1

    changed(dataset / f"{STEM}.yaml", change)
    agreed(dataset)
    (problem,) = mp4ds.validate(dataset, deep=True)
    assert problem.code == "digest-mismatch"
    assert "frames 0 to 7 of /cam/image_raw (stamp " in problem.message


# ---------------------------------------------------------------- several faults


def test_all_of_three_faults_are_listed(two_cameras: Path) -> None:
    video = two_cameras / "left_cam_image_raw.mp4"
    video.write_bytes(video.read_bytes()[:-100])
    changed(two_cameras / "right_cam_image_raw.yaml", lambda d: d["digests"].update(values="00"))
    (two_cameras / "messages.mcap").unlink()
    found = {(p.code, Path(p.place.split(" at ")[0]).name) for p in mp4ds.validate(two_cameras)}
    assert found >= {
        ("size-mismatch", "left_cam_image_raw.mp4"),
        ("column-invalid", "right_cam_image_raw.yaml"),
        ("file-missing", "messages.mcap"),
    }
