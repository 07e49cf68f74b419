"""Damaged datasets: what is left out does not matter, what can be read of the rest comes back."""

from __future__ import annotations

import json
import random
import re
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from coded_scenes import CODED
from commands import call
from damage import Key, all_messages, pieces_of
from edits import flip
from mp4ds import FormatError, SourceError, UnpackOptions
from mp4ds.plugins.playing.player import open_player
from mp4ds.records import Loss
from player_scenes import RecordingPublisher
from round_trips import packed as packed_scene
from scenes import Record, Scene
from sources import SOURCES, scene

FRAMES = 8
CAMERAS = ("left", "right", "front")
SALVAGE = UnpackOptions(salvage=True)


def camera(made: Scene, name: str) -> list[Record]:
    """The images and calibrations of a scene on the topics of a camera."""
    messages = [m for m in made.messages if m.topic.startswith("/cam/")]
    return [replace(m, topic=m.topic.replace("/cam/", f"/{name}/")) for m in messages]


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A recording of three cameras amid other topics, and its dataset; not to be changed."""
    folder = tmp_path_factory.mktemp("three")
    left = scene("mono8", frames=FRAMES)
    messages = [m for m in left.messages if not m.topic.startswith("/cam/")]
    messages += camera(left, "left")
    messages += camera(scene("rgb8", frames=FRAMES, seed=1), "right")
    messages += camera(CODED["jpeg-rgb"](frames=FRAMES, seed=2), "front")
    messages.sort(key=lambda message: message.log_time)
    (path,) = SOURCES["bag-none"](folder, Scene(messages, left.silent))
    mp4ds.pack(path, folder / "dataset", mp4ds.PackOptions(gop=4))
    return path, folder / "dataset"


@pytest.fixture
def dataset(packed: tuple[Path, Path], tmp_path: Path) -> Path:
    """The dataset, to be damaged."""
    return Path(shutil.copytree(packed[1], tmp_path / "dataset"))


def file_of(dataset: Path, name: str) -> Path:
    """A file of a dataset by the beginning of its name, and its suffixes."""
    stem, _, suffix = name.partition(".")
    return min(dataset.glob(f"{stem}*.{suffix}"), key=lambda path: len(path.suffixes))


def zero(path: Path, start: float, size: int = 512) -> None:
    data = bytearray(path.read_bytes())
    first = int(start * len(data))
    data[first : first + size] = bytes(len(data[first : first + size]))
    path.write_bytes(data)


def truncate(path: Path, place: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(place * len(data))])


def break_index(path: Path) -> None:
    """Nothing tells any more where frames are."""
    data = path.read_bytes()
    assert b"stsz" in data
    path.write_bytes(data.replace(b"stsz", b"free"))


def messages(path: Path) -> Counter[Key]:
    return Counter(all_messages(pieces_of(path)))


def topics(found: Counter[Key]) -> set[str]:
    return {topic for topic, _, _ in found}


# ---------------------------------------------------------------- what is left out


DAMAGES: dict[str, Callable[[Path], None]] = {
    "video-flip": lambda folder: flip(file_of(folder, "left.mp4"), 0.5),
    "video-header": lambda folder: break_index(file_of(folder, "left.mp4")),
    "video-cut": lambda folder: truncate(file_of(folder, "left.mp4"), 0.7),
    "video-missing": lambda folder: file_of(folder, "left.mp4").unlink(),
    "video-exact-flip": lambda folder: flip(file_of(folder, "left.exact.mp4"), 0.5),
    "video-exact-header": lambda folder: break_index(file_of(folder, "left.exact.mp4")),
    "video-exact-cut": lambda folder: truncate(file_of(folder, "left.exact.mp4"), 0.7),
    "sidecar-flip": lambda folder: flip(file_of(folder, "left.yaml"), 0.5),
    "sidecar-zero": lambda folder: zero(file_of(folder, "left.yaml"), 0, 10**9),
    "sidecar-missing": lambda folder: file_of(folder, "left.yaml").unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_camera_that_is_left_out_may_be_damaged(
    damage: str, dataset: Path, packed: tuple[Path, Path], tmp_path: Path
) -> None:
    DAMAGES[damage](dataset)
    out = tmp_path / "out.bag"
    with pytest.raises(FormatError, match=r"/left|left_image_raw.* `salvage` restores what can"):
        mp4ds.unpack(dataset, "bag", out)
    assert not out.exists()
    options = UnpackOptions(exclude=["/left/*"])
    summary = mp4ds.unpack(dataset, "bag", out, options)
    whole, rest = messages(packed[0]), messages(out)
    assert rest == Counter({key: n for key, n in whole.items() if not key[0].startswith("/left/")})
    assert summary.losses == []
    assert "/left/image_raw" in summary.left_out
    pictures = tmp_path / "pictures"
    mp4ds.export(dataset, "images", pictures, mp4ds.ExportOptions(exclude=["/left/*"]))
    assert len(list(pictures.glob("*/*.*g"))) == 2 * FRAMES


@pytest.mark.parametrize(
    ("damage", "options"),
    [
        ("sidecar-flip", {"exclude": ["/left/image_raw"]}),  # which has their calibrations, too
        ("messages-zero", {"topics": ["/left/*"]}),  # of which nothing tells what topics it has
    ],
)
def test_what_may_be_wanted_must_be_whole(
    damage: str, options: dict[str, Any], dataset: Path, tmp_path: Path
) -> None:
    WORSE[damage](dataset)
    with pytest.raises(FormatError, match=r"(left_image_raw\.yaml|messages\.mcap): .* `salvage`"):
        mp4ds.unpack(dataset, "bag", tmp_path / "x.bag", UnpackOptions(**options))


@pytest.mark.parametrize("place", [0.2, 0.4, 0.9, 0.999])
def test_messages_that_are_left_out_may_be_damaged(
    place: float, dataset: Path, packed: tuple[Path, Path], tmp_path: Path
) -> None:
    flip(dataset / "messages.mcap", place)
    out = tmp_path / "out.bag"
    summary = mp4ds.unpack(dataset, "bag", out, UnpackOptions(topics=["/left/*"]))
    whole = messages(packed[0])
    assert messages(out) == Counter({k: n for k, n in whole.items() if k[0].startswith("/left/")})
    assert any("messages.mcap" in note for note in summary.notes)
    with pytest.raises(FormatError, match=r"messages\.mcap: .* `salvage` restores"):
        mp4ds.unpack(dataset, "bag", tmp_path / "y.bag", UnpackOptions(topics=["/left/*", "/imu"]))


# ---------------------------------------------------------------- what can be read


def check_salvage(dataset: Path, original: Path, out: Path) -> Sequence[Loss]:
    """Unpack what can be read, and compare it and what is lost with the original."""
    if out.exists():
        out.unlink()
    summary = mp4ds.unpack(dataset, "bag", out, SALVAGE)
    whole, found = messages(original), messages(out)
    images = {f"/{name}/image_raw" for name in CAMERAS} | {"/front/image_raw/compressed"}
    wrong = found - whole
    assert not topics(wrong) & images, "an image was restored that was not recorded"
    is_altered = any("altered" in loss.problem for loss in summary.losses)
    assert not wrong or is_altered
    missing = whole - found
    if missing and not is_altered:
        counts = [loss.messages for loss in summary.losses]
        assert counts
        if None not in counts:
            assert sum(count or 0 for count in counts) == missing.total()
    # each frame that is lost is named
    for topic in topics(missing) & images:
        times = sorted(time for name, time, _ in whole if name == topic)
        named: list[int] = []
        for loss in summary.losses:
            if loss.topics == (topic,) and loss.frames:
                first, last = loss.frames
                assert (loss.start, loss.end) == (times[first], times[last])
                named += times[first : last + 1]
            elif loss.topics == (topic,):
                named += times[: loss.messages]
        assert sorted(named) == sorted(time for name, time, _ in missing if name == topic)
    json.dumps([asdict(loss) for loss in summary.losses])
    return summary.losses


PARTS = [
    *("left.mp4", "left.exact.mp4", "right.mp4", "right.exact.mp4", "front.mp4"),
    *("left.yaml", "messages.mcap", "dataset.yaml"),
]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", PARTS)
def test_flipped_bits(name: str, dataset: Path, packed: tuple[Path, Path], tmp_path: Path) -> None:
    original, _ = packed
    path = file_of(dataset, name)
    whole = path.read_bytes()
    rng = random.Random(name)
    for _ in range(12):
        flip(path, rng.random())
        losses = check_salvage(dataset, original, tmp_path / "out.bag")
        if not losses:  # where nothing is stored
            assert messages(tmp_path / "out.bag") == messages(original)
            assert path.suffix == ".mp4"
        if name != "dataset.yaml":
            assert {loss.file for loss in losses} <= {
                path.name,
                path.with_suffix(".mp4").name,
                "dataset.yaml",
            }
        path.write_bytes(whole)
    assert check_salvage(dataset, original, tmp_path / "out.bag") == []


WORSE: dict[str, Callable[[Path], None]] = DAMAGES | {
    "zeros-in-video": lambda folder: zero(file_of(folder, "right.mp4"), 0.4),
    "zeros-in-packets": lambda folder: zero(file_of(folder, "front.mp4"), 0.4),
    "packets-cut": lambda folder: truncate(file_of(folder, "front.mp4"), 0.5),
    "video-empty": lambda folder: truncate(file_of(folder, "left.mp4"), 0),
    "messages-cut": lambda folder: truncate(folder / "messages.mcap", 0.5),
    "messages-zero": lambda folder: zero(folder / "messages.mcap", 0, 10**9),
    "messages-empty": lambda folder: truncate(folder / "messages.mcap", 0),
    "messages-missing": lambda folder: (folder / "messages.mcap").unlink(),
    "manifest-zero": lambda folder: zero(folder / "dataset.yaml", 0, 10**9),
    "manifest-cut": lambda folder: truncate(folder / "dataset.yaml", 0.3),
}


@pytest.mark.parametrize("damage", WORSE)
def test_what_is_there_comes_back(
    damage: str, dataset: Path, packed: tuple[Path, Path], tmp_path: Path
) -> None:
    WORSE[damage](dataset)
    out = tmp_path / "out.bag"
    losses = check_salvage(dataset, packed[0], out)
    assert losses
    whole, found = messages(packed[0]), messages(out)
    if damage.startswith(("video", "sidecar")):
        others = {key for key in whole if not key[0].startswith("/left/")}
        assert others <= set(found)
    if damage.startswith("video"):  # calibrations are in the sidecar
        assert {key for key in whole if key[0] == "/left/camera_info"} <= set(found)
    if damage.startswith("messages"):
        in_videos = {key for key in whole if key[0].split("/")[1] in CAMERAS}
        assert in_videos <= set(found)
    if damage.startswith("manifest"):
        assert whole == found


@pytest.mark.parametrize(("name", "has_later_key_frames"), [("left", False), ("left.exact", True)])
def test_frames_of_a_damaged_video(
    name: str,
    has_later_key_frames: bool,
    dataset: Path,
    packed: tuple[Path, Path],
    tmp_path: Path,
) -> None:
    """Only those up to the next key frame are lost; the error and `validate` name them, too."""
    video = file_of(dataset, f"{name}.mp4")
    data = video.read_bytes()
    start = data.index(b"mdat") + 4
    end = data.index(b"moov") - 4
    flip(video, (start + 0.3 * (end - start)) / len(data))
    losses = check_salvage(dataset, packed[0], tmp_path / "out.bag")
    lost = [loss for loss in losses if loss.frames]
    assert lost
    assert all(loss.topics == ("/left/image_raw",) for loss in lost)
    last = max(loss.frames[1] for loss in lost if loss.frames)
    assert (last < FRAMES - 1) == has_later_key_frames
    first = min(loss.frames[0] for loss in lost if loss.frames)
    stamps = mp4ds.open(dataset)["/left/image_raw"].stamps
    stamp = f"{stamps[first] // 10**9}.{stamps[first] % 10**9:09d}"
    with pytest.raises(
        FormatError, match=rf"frame {first} of /left/image_raw \(stamp {stamp}, log"
    ):
        mp4ds.unpack(dataset, "bag", tmp_path / "no.bag")
    problems = mp4ds.validate(dataset, deep=True)
    told = [p.message for p in problems if p.code in ("decode-failed", "digest-mismatch")]
    assert re.search(rf"frames? {first} .*of /left/image_raw \(stamp {stamp}[ ,]", told[0])
    numbers = {number for loss in lost if loss.frames for number in range(*loss.frames)}
    assert len(told) == len(lost), numbers


def test_images_of_a_damaged_video(
    dataset: Path, packed: tuple[Path, Path], tmp_path: Path
) -> None:
    flip(file_of(dataset, "right.mp4"), 0.3)
    with pytest.raises(FormatError, match=r"right_image_raw\.mp4: .*unpack --salvage` restores"):
        mp4ds.export(dataset, "images", tmp_path / "images")
    mp4ds.export(packed[1], "images", tmp_path / "whole")
    summary = mp4ds.unpack(dataset, "bag", tmp_path / "rest.bag", SALVAGE)
    lost = {n for loss in summary.losses if loss.frames for n in range(*loss.frames)}
    lost |= {loss.frames[1] for loss in summary.losses if loss.frames}
    assert 0 < len(lost) < FRAMES
    mp4ds.pack(tmp_path / "rest.bag", tmp_path / "rest")
    mp4ds.export(tmp_path / "rest", "images", tmp_path / "images")
    for camera, without in (("left", set()), ("right", lost), ("front", set())):
        whole, found = (
            sorted((tmp_path / name / f"{camera}_image_raw").glob("*.[pj]*g"))
            for name in ("whole", "images")
        )
        assert [path.read_bytes() for path in found] == [
            path.read_bytes() for number, path in enumerate(whole) if number not in without
        ]


def test_a_lossy_video_has_no_digests(packed: tuple[Path, Path], tmp_path: Path) -> None:
    """So its frames are restored as they decode, and nothing is said to be exact."""
    dataset = tmp_path / "visual"
    mp4ds.pack(packed[0], dataset, mp4ds.PackOptions(quality="visual", topics=["/left/*"]))
    summary = mp4ds.unpack(dataset, "bag", tmp_path / "whole.bag")
    assert summary.notes == [
        "/left/image_raw: its pixels differ from those recorded: it was packed with quality visual"
    ]
    data = file_of(dataset, "left.mp4").read_bytes()
    flip(file_of(dataset, "left.mp4"), (data.index(b"mdat") + 400) / len(data))
    summary = mp4ds.unpack(dataset, "bag", tmp_path / "out.bag", SALVAGE)
    assert any("have no digests: some may be altered" in loss.problem for loss in summary.losses)


@pytest.mark.parametrize("damaged", ["left.mp4", "left.exact.mp4"])
def test_a_pair_on_its_own(
    damaged: str, dataset: Path, packed: tuple[Path, Path], tmp_path: Path
) -> None:
    pair = tmp_path / "pair"
    pair.mkdir()
    for name in ("left.mp4", "left.exact.mp4", "left.yaml"):
        shutil.copy(file_of(dataset, name), pair)
    flip(file_of(pair, damaged), 0.3)
    video = file_of(pair, "left.mp4")
    summary = mp4ds.unpack(video, "bag", tmp_path / "out.bag", SALVAGE)
    kept = summary.messages.get("/left/image_raw", 0)  # all frames may refer to one of the view
    assert (0 if damaged == "left.mp4" else 1) <= kept < FRAMES
    assert summary.messages["/left/camera_info"] == FRAMES
    assert not messages(tmp_path / "out.bag") - messages(packed[0])
    file_of(pair, "left.exact.mp4").unlink()
    with pytest.raises(SourceError, match=r"has views only .* give `quality` visual to go on"):
        mp4ds.unpack(video, "bag", tmp_path / "no.bag", SALVAGE)
    seen = mp4ds.unpack(video, "bag", tmp_path / "seen.bag", replace(SALVAGE, quality="visual"))
    assert bool(seen.losses) == (damaged == "left.mp4")
    assert seen.messages["/left/camera_info"] == FRAMES


def test_on_the_command_line(dataset: Path, tmp_path: Path) -> None:
    flip(file_of(dataset, "left.mp4"), 0.3)
    refused = call("unpack", dataset, "-o", tmp_path / "no.bag")
    assert refused.code == 1
    assert "--salvage restores what can be read" in refused.err
    done = call("unpack", dataset, "--salvage", "-o", tmp_path / "out.bag")
    assert done.code == 0
    assert re.search(
        r"lost: left_image_raw\.mp4: frames? \d.* of /left/image_raw, log time", done.out
    )
    done = call("unpack", dataset, "--salvage", "--json", "-o", tmp_path / "json.bag")
    (loss, *_) = json.loads(done.out)["losses"]
    assert loss["topics"] == ["/left/image_raw"]
    assert loss["frames"][0] <= loss["frames"][1]
    assert loss["start"] <= loss["end"]


# ---------------------------------------------------------------- other commands


def test_errors_of_other_commands_say_where_the_damage_is(dataset: Path, tmp_path: Path) -> None:
    flip(file_of(dataset, "left.mp4"), 0.3)
    words = (
        r"left_image_raw\.mp4: does not match .*; it has frames of /left/image_raw .*`mp4ds "
        "validate --deep` finds all damage, and `mp4ds unpack --salvage` restores"
    )
    with pytest.raises(FormatError, match=words):
        mp4ds.export(dataset, "euroc", tmp_path / "export")
    words = r"frame (\d) of /left/image_raw \(stamp \d+\.\d{9}, log time \d+\.\d{9}\): "
    play = mp4ds.PlayOptions(immediate=True)
    publisher = RecordingPublisher(world="ros1")
    with (
        open_player(dataset, play, node=publisher) as player,
        pytest.raises(FormatError, match=words) as found,
    ):
        player.run()
    assert found.value.frame is not None
    zero(file_of(dataset, "left.exact.mp4"), 0.3, 2000)
    with mp4ds.open(dataset) as opened, pytest.raises(FormatError, match=words):
        opened["/left/image_raw"].get(range(FRAMES))


def test_an_edited_sidecar_is_not_claimed_to_be_exact(dataset: Path, tmp_path: Path) -> None:
    """Its images have digests, its calibrations have none."""
    path = file_of(dataset, "left.yaml")
    text = path.read_text()
    edited = re.sub(r"(distortion_model: )\w+", r"\1equidistant", text)
    assert edited != text
    path.write_text(edited[: edited.rindex("checksum:")])
    with pytest.raises(FormatError, match=r"left_image_raw\.yaml: .* `salvage` restores"):
        mp4ds.unpack(dataset, "bag", tmp_path / "no.bag")
    summary = mp4ds.unpack(dataset, "bag", tmp_path / "out.bag", SALVAGE)
    (loss,) = summary.losses
    assert (loss.file, loss.messages) == (path.name, 0)
    assert "calibrations, may be altered" in loss.problem
    left = {"/left/image_raw": FRAMES, "/left/camera_info": FRAMES}
    assert left.items() <= summary.messages.items()


@pytest.mark.parametrize("span", [{"start": "0"}, {"start": "0.1", "end": "0.2"}])
def test_a_slice_of_a_damaged_lossy_video(span: dict[str, str], tmp_path: Path) -> None:
    """It has no digests of messages that would show the damage of a frame."""
    dataset = packed_scene(tmp_path, scene("rgb8", frames=20, noisy=False), quality="visual")
    flip(dataset / "cam_image_raw.mp4", 0.4)
    with pytest.raises(FormatError, match="hash-mismatch"):
        mp4ds.unpack(dataset, "bag", tmp_path / "again.bag", UnpackOptions(**span))
    assert not (tmp_path / "again.bag").exists()
    with pytest.raises(FormatError, match="hash-mismatch"):
        mp4ds.export(dataset, "euroc", tmp_path / "again", mp4ds.ExportOptions(**span))
    assert not (tmp_path / "again").exists()
