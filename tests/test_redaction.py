"""Boxes of images that are filled or blurred: ``pack --redact``."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mp4ds
from coded_scenes import CODED
from commands import call
from compare_redacted import compare, parsed, pixels, read
from conftest import real
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from mp4ds import Box, PackOptions
from mp4ds.dataset.redaction import placed, redact
from mp4ds.errors import Mp4dsError, OptionError, SourceError
from mp4ds.format.sidecars import dump_document, load_manifest
from mp4ds.messages.encodings import ENCODINGS
from pictures import GENERIC
from scenes import Scene, odd_scene, scene
from sources import SOURCES

TOPIC = "/cam/image_raw"
BOX = [10, 6, 22, 14]
RULE = {"topic": "/cam/*", "start": 0.06, "end": 0.2, "box": BOX}
INSIDE = np.s_[BOX[1] : BOX[1] + BOX[3], BOX[0] : BOX[0] + BOX[2]]


def rules(folder: Path, *told: dict[str, Any], **more: Any) -> Path:
    """A file of rules, `RULE` by default."""
    path = folder / "boxes.yaml"
    path.write_text(json.dumps({"rules": told or [RULE], **more}))
    return path


def recorded(folder: Path, made: Scene, kind: str = "mcap-ros2-zstd") -> Path:
    (path,) = SOURCES[kind](folder / "in", made)
    return path


def packed(source: Path, target: Path, told: Any, **options: Any) -> Path:
    mp4ds.pack(source, target, PackOptions(redact=told, **options))
    return target


def unpacked(dataset: Path) -> Path:
    output = dataset.with_suffix(".out.mcap")
    return output if output.exists() else mp4ds.unpack(dataset, "mcap", output).output


def proven(source: Path, dataset: Path, told: Path) -> dict[str, int]:
    """What differs, by a script that shares no code with the package."""
    problems, counts = compare(source, unpacked(dataset), told)
    assert problems == []
    assert counts["pixels outside"] == 0 < counts["pixels inside"]
    assert mp4ds.validate(dataset, deep=True) == []
    return counts


def messages(path: Path) -> list[tuple[Any, ...]]:
    return sorted((one.channel.topic, one.time, one.data) for one in read(path))


# ---------------------------------------------------------------- recordings of others


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("name", "told", "changed"),
    [
        ("bags/roboto_tiny_dvs.bag", {"topic": "/dvs/*", "start": 0.03, "end": 0.1}, 2),
        ("bags/librealsense_depth_color.bag", {"topic": "*Color_0*", "blur": 16}, 1),
        ("bags/librealsense_depth_color.bag", {"topic": "*Depth_0*", "fill": 65535}, 2),
        ("bags/fiducials_aruco_marker_raspicam.bag", {"topic": "/raspicam_node/*"}, 1),
        ("bags/spot_compressedDepth.bag", {"topic": "/spot/*"}, 1),
    ],
)
def test_real_recordings(name: str, told: dict[str, Any], changed: int, tmp_path: Path) -> None:
    source = real(name)
    file = rules(tmp_path, {"box": [101, 83, 90, 61], **told})
    found = proven(source, packed(source, tmp_path / "out", file), file)
    assert found["changed images"] == changed
    assert found["equal messages"] == len(list(read(source))) - changed


# ---------------------------------------------------------------- every kind of image

FILLS = {"rgb8": [255, 0, 10], "32FC1": "nan", "8SC1": -7, "16UC3": [1, 2, 65535]}
RAW = ["mono8", "bgr8", "rgba8", "mono16", "rgb16", "bayer_grbg8", "bayer_rggb16", "yuv422", "yuyv"]
KINDS: dict[str, Callable[..., Scene]] = {
    **{name: partial(scene, name) for name in (*RAW, *GENERIC)},
    "padded": partial(scene, "bgr8", pad=5),
    "big-endian": partial(scene, "mono16", big_endian=True),
    **{
        name: CODED[name]
        for name in ("jpeg-rgb", "jpeg-gray", "jpeg-exif-trailing", "png-rgba-cv2", "png-palette")
    },
}


@pytest.mark.one_in(20)
@pytest.mark.parametrize("change", ["fill", "blur"])
@pytest.mark.parametrize("name", KINDS)
def test_boxes_alone_change(name: str, change: str, tmp_path: Path) -> None:
    source = recorded(tmp_path, KINDS[name](frames=8))
    value = FILLS.get(name, 0) if change == "fill" else 8
    file = rules(tmp_path, {**RULE, change: value})
    if change == "blur" and name in ("16UC1", "32FC1"):
        with pytest.raises(OptionError, match=r"rule 1 \(/cam/\*\): blur of .* make up distances"):
            packed(source, tmp_path / "out", file)
        return
    assert proven(source, packed(source, tmp_path / "out", file), file)["changed images"] > 2


@pytest.mark.parametrize("name", ["depth-16UC1-png", "depth-16UC1-rvl", "depth-32FC1-rvl"])
def test_compressed_depths(name: str, tmp_path: Path) -> None:
    """Of those as RVL, no other library reads the pixels: the dataset is asked."""
    source = recorded(tmp_path, CODED[name](frames=8))
    file = rules(tmp_path)
    mp4ds.pack(source, tmp_path / "whole")
    packed(source, tmp_path / "out", file)
    assert mp4ds.validate(tmp_path / "out", deep=True) == []
    with mp4ds.open(tmp_path / "whole") as whole, mp4ds.open(tmp_path / "out") as made:
        (topic,) = made.topics
        before, after = (one[topic].read(range(8), format="native") for one in (whole, made))
    is_changed = (before != after).any((1, 2))
    assert 2 < is_changed.sum() < 8
    assert (after[is_changed][:, INSIDE[0], INSIDE[1]] == 0).all()
    after[:, INSIDE[0], INSIDE[1]] = before[:, INSIDE[0], INSIDE[1]]
    assert (before == after).all()
    with pytest.raises(OptionError, match="fill"):
        packed(source, tmp_path / "no", rules(tmp_path, {**RULE, "fill": 70000}))


@pytest.mark.parametrize("name", ["nv12", "nv21", "nv24", "uyvy"])
def test_colours_of_yuv(name: str, tmp_path: Path) -> None:
    source = recorded(tmp_path, scene(name, frames=2))
    told = {"topic": TOPIC, "box": BOX}
    packed(source, tmp_path / "out", rules(tmp_path, {**told, "fill": [255, 0, 0]}))
    with mp4ds.open(tmp_path / "out", layer="exact") as made:
        red = made[TOPIC].get([0], format="rgb")[0].data[INSIDE][4:-4, 4:-4]
    assert (abs(red.astype(int) - [255, 0, 0]) < 12).all()
    made_of = {one.time: np.frombuffer(parsed(one).data, np.uint8) for one in _images(source)}
    for one in _images(unpacked(tmp_path / "out")):
        differs = made_of[one.time] != np.frombuffer(parsed(one).data, np.uint8)
        area = BOX[2] * BOX[3]
        samples = {"nv12": 1.5, "nv21": 1.5, "nv24": 3, "uyvy": 2}[name] * area
        assert 0.8 * samples < differs.sum() <= samples
    blurred = packed(source, tmp_path / "blurred", rules(tmp_path, {**told, "blur": 8}))
    assert mp4ds.validate(blurred, deep=True) == []
    odd = rules(tmp_path, {**told, "box": [10, 6, 21, 14]})
    if name != "nv24":
        with pytest.raises(OptionError, match=r"share their chroma: .* use \[10, 6, 22, 14\]"):
            packed(source, tmp_path / "no", odd)


def _images(path: Path) -> list[Any]:
    return [one for one in read(path) if "Image" in one.channel.type]


# ---------------------------------------------------------------- nothing of it is left


@pytest.mark.parametrize("name", ["mono8", "bayer_grbg8", "nv12"])
@pytest.mark.parametrize(("width", "height"), [(34, 18), (10, 34), (2, 2)])
def test_blur_has_no_small_squares(name: str, width: int, height: int) -> None:
    """What remains beside whole squares is part of the last ones; a tiny box is widened."""
    encoding = ENCODINGS[name]
    image = np.random.default_rng(0).integers(0, 256, encoding.shape(64, 64), np.uint8)
    made, box = image.copy(), Box(62 - width, 62 - height, width, height, blur=16)
    part = placed(box, encoding, (64, 64), widened=True)
    assert part is not None
    redact(made, encoding, box, part)
    x, y, width, height = part
    assert min(width, height) >= 8
    step = 2 if encoding.mosaic else 1
    corner = made[:64][y + height - 8 : y + height, x + width - 8 : x + width]
    for place in np.ndindex(step, step):
        assert np.unique(corner[place[0] :: step, place[1] :: step]).size == 1


@pytest.mark.parametrize("name", ["jpeg-exif-trailing", "png-rgba-cv2", "video-h264", "padded"])
def test_nothing_of_changed_images_is_left(name: str, tmp_path: Path) -> None:
    """Coded bytes of each image are looked for in all files; they are where nothing changed."""
    made = KINDS[name](frames=8) if name in KINDS else CODED[name](frames=8)
    if name == "padded":  # rows longer than the image hold what is beside it
        rng = np.random.default_rng(0)
        for one in made.messages:
            if one.topic == TOPIC:
                data = one.values["data"].reshape(48, -1)
                data[:, -5:] = rng.integers(1, 255, data[:, -5:].shape)
    source = recorded(tmp_path, made)
    camera = [one for one in read(source) if one.channel.topic.startswith(("/cam/i", "/cam/v"))]
    packed(source, tmp_path / "out", rules(tmp_path), view="av1")
    begin = min(one.time for one in read(source))
    changed = [0.06 <= (one.time - begin) / 1e9 < 0.2 for one in camera]
    assert 2 < sum(changed) < 8
    if name == "padded":
        for one, is_changed in zip(_images(unpacked(tmp_path / "out")), changed, strict=True):
            padding = parsed(one).data.reshape(48, -1)[:, -5:]
            assert padding[:6].all()
            assert padding[6:20].any() != is_changed
        return
    stored = b"".join(path.read_bytes() for path in (tmp_path / "out").iterdir())
    data = [bytes(parsed(one).data) for one in camera]
    found = [_own(one, b"".join(other for other in data if other != one)) in stored for one in data]
    if name == "jpeg-exif-trailing":
        assert found == [not one for one in changed]
    assert not any(one for one, is_changed in zip(found, changed, strict=True) if is_changed)
    if name == "video-h264":  # no packet refers to what was there
        assert not any(found)
    with mp4ds.open(tmp_path / "out", layer="view") as views:
        (topic,) = views.topics
        frames = views[topic].get(range(8), format="rgb")
    for frame, is_changed in zip(frames, changed, strict=True):
        assert (frame.data[INSIDE][4:-4, 4:-4].max() < 40) == is_changed


def _own(data: bytes, others: bytes) -> bytes:
    """Some bytes that no other message has."""
    middle = len(data) // 2
    return next(
        found
        for at in (*range(middle, len(data), 40), *range(0, middle, 40))
        if len(found := data[at : at + 40]) == 40 and found not in others
    )


@pytest.mark.parametrize("kind", ["mcap-ros2-zstd", "bag-none"])
def test_nothing_after_a_message_is_left(kind: str, tmp_path: Path) -> None:
    """What a reused buffer held before may be there, such as another image."""
    source = recorded(tmp_path, odd_scene("tail-bytes"), kind)
    told = rules(tmp_path, {"topic": "/odd/*", "box": [2, 2, 8, 8]})
    due = [one.data for one in _images(source)]
    found = [one.data for one in _images(unpacked(packed(source, tmp_path / "out", told)))]
    for number, (before, after) in enumerate(zip(due, found, strict=True)):
        tail = 3 if number % 2 else 4
        assert len(after) == len(before)
        assert before[-tail:] != after[-tail:] == bytes(tail)


# ---------------------------------------------------------------- how it is packed


def test_in_parts_shards_and_resumed(tmp_path: Path) -> None:
    source = recorded(tmp_path, scene("rgb8", frames=24))
    other = rules(tmp_path, {**RULE, "box": [0, 0, 9, 9]})
    wrong = PackOptions(redact=other, window=6)
    wrong = PackOptions(redact=wrong.redact, window=6)  # the file may change now
    told = rules(tmp_path, RULE, {**RULE, "start": 0.5, "end": None, "box": [40, 20, 8, 8]})
    whole = unpacked(packed(source, tmp_path / "whole", told))
    options = PackOptions(redact=told, window=6)
    mp4ds.pack_share(source, tmp_path / "parts", (1, 2), options)
    with pytest.raises(OptionError, match="different `redact`: 'rules with SHA-256"):
        mp4ds.pack(source, tmp_path / "parts", wrong)
    told.unlink()
    told.parent.joinpath("boxes.yaml").write_text("no rules")
    mp4ds.pack_share(source, tmp_path / "parts", (2, 2), options)
    mp4ds.pack(source, tmp_path / "parts", options)
    assert mp4ds.validate(tmp_path / "parts", deep=True) == []
    assert messages(unpacked(tmp_path / "parts")) == messages(whole)
    one, other_one = (
        load_manifest(tmp_path / name / "dataset.yaml") for name in ("whole", "parts")
    )
    (before,), (after,) = one.redactions, other_one.redactions
    assert (before.rules, before.proving()) == (after.rules, after.proving())
    assert len(after.topics[0].untouched.values.splitlines()) == 4  # type: ignore[union-attr]


def find_told(topic: str, time_ns: int, pixels: Any) -> list[tuple[int, int, int, int]]:
    """Nothing up to a time, where it fails; without a time, a box."""
    if time_ns > int(os.environ.get("FAILS_AFTER", time_ns)):
        raise ValueError("no model")
    return [] if "FAILS_AFTER" in os.environ else [(8, 8, 16, 16)]


def test_a_function_that_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It looks the same: nothing that it made before is used."""
    source = recorded(tmp_path, scene("rgb8", frames=24))
    times = sorted(one.time for one in read(source))
    target = tmp_path / "all" / source.stem
    target.parent.mkdir()
    options = PackOptions(redact=find_told, window=6, jobs=1)
    monkeypatch.setenv("FAILS_AFTER", str(times[len(times) // 2]))
    with pytest.raises((ValueError, Mp4dsError), match="no model"):
        mp4ds.pack(source, target, options)
    monkeypatch.delenv("FAILS_AFTER")
    mp4ds.pack(source, target, options)
    with mp4ds.open(target, layer="exact") as made:
        assert all(not frame.data[8:24, 8:24].any() for frame in made[TOPIC])
    with pytest.raises(Mp4dsError, match="already exists"):
        mp4ds.pack_each([source], target.parent, options)
    with pytest.raises(OptionError, match="`redact` is a function"):
        mp4ds.pack_share(source, tmp_path / "parts", (1, 2), options)


def test_datasets_and_reductions(tmp_path: Path) -> None:
    source = recorded(tmp_path, scene("bgr8", frames=8))
    told = rules(tmp_path)
    packed(source, tmp_path / "out", told)
    mp4ds.pack(source, tmp_path / "whole")
    packed(tmp_path / "whole", tmp_path / "again", told)
    due = messages(unpacked(tmp_path / "out"))
    assert messages(unpacked(tmp_path / "again")) == due
    small = PackOptions(crop=(8, 4, 40, 30), resize=(20, 15))
    mp4ds.pack(tmp_path / "out", tmp_path / "then", small)
    packed(source, tmp_path / "small", told, crop=small.crop, resize=small.resize)
    assert messages(unpacked(tmp_path / "small")) == messages(unpacked(tmp_path / "then"))
    begin = str(due[0][1])
    mp4ds.pack(tmp_path / "out", tmp_path / "copy")
    mp4ds.pack(tmp_path / "out", tmp_path / "part", PackOptions(end="0.15"))
    mp4ds.pack(tmp_path / "out", tmp_path / "tiny", PackOptions(end="0.15", gop=2))
    for name, is_proven in (("copy", True), ("part", False), ("tiny", False), ("small", False)):
        (entry,) = load_manifest(tmp_path / name / "dataset.yaml").redactions
        assert (entry.topics[0].untouched is not None) == is_proven, begin
        assert mp4ds.validate(tmp_path / name, deep=True) == []
        assert (
            "images were redacted before they were packed: 4 of 8"
            in call("info", tmp_path / name).out
        )
    (tmp_path / "whole" / "cam_image_raw.exact.mp4").unlink(missing_ok=True)
    mp4ds.pack(source, tmp_path / "seen", PackOptions(view="av1"))
    (tmp_path / "seen" / "cam_image_raw.exact.mp4").unlink()
    with pytest.raises(SourceError, match="has views only"):
        packed(tmp_path / "seen", tmp_path / "no", told)
    packed(tmp_path / "seen", tmp_path / "visual", told, quality="visual")
    assert mp4ds.validate(tmp_path / "visual", deep=True) == []
    with mp4ds.open(tmp_path / "visual") as made:
        assert made[TOPIC].get([4], format="rgb")[0].data[INSIDE][4:-4, 4:-4].max() < 40
    assert len(mp4ds.pack_each([source], tmp_path / "all", PackOptions(redact=told))) == 1
    assert mp4ds.pack_each([source], tmp_path / "all", PackOptions(redact=told)) == []
    with pytest.raises(Mp4dsError, match="already exists"):
        mp4ds.pack_each([source], tmp_path / "all")


def test_what_it_says(tmp_path: Path) -> None:
    source = recorded(tmp_path, scene("mono8", frames=8))
    found = call("pack", source, "-o", tmp_path / "out", "--redact", rules(tmp_path))
    assert "/cam/image_raw: 5 of 8 images redacted" in found.out
    source = recorded(tmp_path, CODED["video-h264"](frames=8))
    packed(source, tmp_path / "video", rules(tmp_path))
    with mp4ds.open(tmp_path / "video") as made:
        assert (made["/cam/video"].encoding, len(made["/cam/video"])) == ("rgb8", 8)


# ---------------------------------------------------------------- found by a function


def bright(topic: str, time: int, found: np.ndarray[Any, Any]) -> list[Any]:
    """Where red is brightest, partly beside the image, and what is beside it altogether."""
    assert (topic, found.shape, found.dtype) == (TOPIC, (48, 64, 3), np.uint8)
    if time % 3:
        return []
    return [(-3.5, 40.2, 10, 20), Box(50, 40, 30, 30, fill=255), (70, 0, 5, 5)]


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["bgr8", "mono8", "bayer_rggb8", "nv12"])
def test_a_function_finds_boxes(name: str, tmp_path: Path) -> None:
    source = recorded(tmp_path, scene(name, frames=12))
    whole = unpacked(packed(source, tmp_path / "whole", bright))
    calls: list[int] = []

    def nested(topic: str, time: int, found: np.ndarray[Any, Any]) -> list[Any]:
        calls.append(time)
        return bright(topic, time, found)

    packed(source, tmp_path / "one", nested, window=4)  # which no other process can call
    with pytest.raises(OptionError, match="cannot be sent to other machines"):
        packed(source, tmp_path / "no", nested, cluster="tcp://localhost:1")
    packed(source, tmp_path / "parts", bright, window=4)
    assert messages(whole) == messages(unpacked(tmp_path / "parts"))
    assert messages(whole) == messages(unpacked(tmp_path / "one"))
    assert mp4ds.validate(tmp_path / "parts", deep=True) == []
    (told,) = load_manifest(tmp_path / "parts" / "dataset.yaml").redactions
    changed = sum(time % 3 == 0 for time in set(calls))
    assert (told.function, told.topics[0].changed) == (f"{__name__}:bright", changed)
    with mp4ds.open(tmp_path / "whole", layer="exact") as made:
        for frame in made[TOPIC].get(range(12), format="rgb"):
            if frame.log_time_ns % 3 == 0:
                assert frame.data[42:46, :4].max() < 12
                assert frame.data[44:, 54:].min() > 240


@pytest.mark.parametrize(
    "given",
    [
        *((1, 2, 3), (1, 2, 3, 4, 0.9), (1e308, 0, 1e308, 1), "face", None),
        *(Box(0, 0, 9, 9, fill=[1]), Box(0, 0, 9, 9, fill=10**400), Box(0, 0, 9, 9, blur=8.5)),  # type: ignore[arg-type]
    ],
)
def test_a_function_that_finds_no_boxes(given: Any, tmp_path: Path) -> None:
    source = recorded(tmp_path, scene("rgb8", frames=2))

    def nested(*_: Any) -> Any:
        return [given] if given else None

    with pytest.raises(OptionError, match=r"`redact`, .*nested.* for /cam/image_raw at \d+ ns: "):
        packed(source, tmp_path / "out", nested)


# ---------------------------------------------------------------- proof


def test_digests_of_untouched_blocks(tmp_path: Path) -> None:
    """As the spec has them; changes beside the boxes are found without the original."""
    source = recorded(tmp_path, scene("mono16", frames=8, width=140, height=70))
    told = rules(tmp_path, {**RULE, "box": [60, 5, 10, 10]}, proof=3)
    packed(source, tmp_path / "out", told)
    begin = min(one.time for one in read(source))
    frames = [(one.time, pixels(parsed(one))) for one in _images(source)]
    changed = [0.06 <= (time - begin) / 1e9 < 0.2 for time, _ in frames]
    after = int(np.flatnonzero(np.cumsum(changed) == 3)[0]) + 1
    manifest = load_manifest(tmp_path / "out" / "dataset.yaml")
    (entry,) = manifest.redactions
    (topic,) = entry.topics
    assert topic.untouched is not None
    for line, own in zip(
        topic.untouched.values.splitlines(), (slice(after), slice(after, 8)), strict=True
    ):
        touched = {0, 1} if any(changed[own]) else set()
        digests = [
            hashlib.sha256(
                b"".join(one[y : y + 64, x : x + 64].tobytes() for _, one in frames[own])
            ).digest()
            for number, (y, x) in enumerate((y, x) for y in (0, 64) for x in (0, 64, 128))
            if number not in touched
        ]
        bits = "".join("0" if number in touched else "1" for number in range(6)) + "00"
        due = hashlib.sha256(b"".join(digests)).hexdigest()
        assert line == f"{len(frames[own])} {int(bits, 2):02x} {due}"
    other = scene("mono16", frames=8, width=140, height=70)
    image = next(one for one in other.messages if one.topic == TOPIC).values
    image["data"][140 * 2 * 69] ^= 1  # a bit of the first pixel of the last row
    shutil.rmtree(tmp_path / "in")
    packed(recorded(tmp_path, other), tmp_path / "forged", told)
    path = tmp_path / "forged" / "dataset.yaml"
    path.write_bytes(dump_document(load_manifest(path).model_copy(update={"redactions": [entry]})))
    (problem,) = mp4ds.validate(tmp_path / "forged", deep=True)
    assert problem.code == "redaction-mismatch"
    assert f"has blocks in images 0 to {after - 1} that are not as they were" in str(problem)
    fewer = topic.model_copy(update={"untouched": topic.untouched.model_copy(update={
        "values": topic.untouched.values.splitlines(keepends=True)[0]})})  # fmt: skip
    entry = entry.model_copy(update={"topics": [fewer]})
    path = tmp_path / "out" / "dataset.yaml"
    path.write_bytes(dump_document(manifest.model_copy(update={"redactions": [entry]})))
    (problem,) = mp4ds.validate(tmp_path / "out", deep=True)
    assert f"has more images than the {after}" in str(problem)
    assert entry.rules_text is None
    told = rules(tmp_path, proof=0, keep_rules=True)
    packed(source, tmp_path / "none", told)
    (entry,) = load_manifest(tmp_path / "none" / "dataset.yaml").redactions
    assert entry.topics[0].untouched is None
    assert entry.rules_text == told.read_text()


# ---------------------------------------------------------------- what cannot be done

HOSTILE = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [*{old}, *{old}, *{old}, *{old}, *{old}, *{old}]\n"
    for old, new in zip("abcdefg", "bcdefgh", strict=True)
)


@pytest.mark.parametrize(
    ("told", "problem"),
    [
        ({**RULE, "topic": "/front"}, "rule 1 (/front): matches no topic of images. Topics of"),
        ({**RULE, "box": [60, 40, 5, 8]}, "box [60, 40, 5, 8] is not inside the 64x48 image"),
        ({**RULE, "box": [-1, 40, 2, 8]}, "rule 1, box x: Input should be greater than or equal"),
        ({**RULE, "start": 2, "end": 2}, "rule 1: its range is empty: from +2.000000000 to +2"),
        ({**RULE, "start": 0, "end": "2001-09-09T01:46:40"}, "its range is empty."),
        ({**RULE, "start": "noon"}, "rule 1, start: 'noon' is not a valid time"),
        ({**RULE, "start": 90, "end": 99}, "there is no image of the topic from +90.000000000 to"),
        ({**RULE, "fill": 256}, "fill 256 is out of range for mono8 images (0 to 255)"),
        ({**RULE, "fill": [1, 2, 3]}, "mono8 images need a single value"),
        ({**RULE, "fill": 1, "blur": 9}, "rule 1: give blur or fill, not both"),
        ({**RULE, "blur": 2}, "rule 1, blur: Input should be greater than or equal to 8"),
        ({**RULE, "blur": 2**70}, "rule 1, blur: Input should be less than"),
        ({**RULE, "box": [1, 2, 9, 10**400]}, "rule 1, box height: Input should be less than"),
        ({**RULE, "box": [1, 2, 9, 7], "blur": 8}, "box [1, 2, 9, 7] is smaller than 8x8 pixels"),
        ({**RULE, "colour": 2}, "rule 1, colour: Extra inputs are not permitted"),
        ("rules: []", "rules: List should have at least 1 item"),
        ("rules: [\n", "is not valid YAML: line 2: did not find"),
        ("[" * 1000, "is nested deeper than 32 levels"),
        (HOSTILE, "its aliases stand for more than 10000 values"),
        ("#" * (2**24 + 1), "has more than 16777216 bytes"),
        (None, "boxes.yaml cannot be read: No such file or directory"),
    ],
)
def test_rules_that_cannot_be(told: Any, problem: str, tmp_path: Path) -> None:
    recorded(tmp_path, scene("mono8", frames=4))
    if isinstance(told, str):
        (tmp_path / "boxes.yaml").write_text(told)
    elif told:
        rules(tmp_path, told)
    words = ("--redact", tmp_path / "boxes.yaml")
    found = call("pack", tmp_path / "in" / "drive.mcap", "-o", tmp_path / "out", *words)
    assert (found.code, found.out) == (2, "")
    assert problem in " ".join(found.err.split())
    assert "--redact" in found.err or "rule 1" in found.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["mcap-ros2-zstd", "mcap-unindexed"])
def test_rules_for_what_is_not_packed(kind: str, tmp_path: Path) -> None:
    """A rule has to match unless its images are not packed; without an index it is read first."""
    source = recorded(tmp_path, scene("mono8", frames=8), kind)
    late = {**RULE, "start": 90, "end": None}
    with pytest.raises(OptionError, match=r"rule 2 .*there is no image of the topic from \+90"):
        packed(source, tmp_path / "no", rules(tmp_path, RULE, late))
    packed(source, tmp_path / "part", rules(tmp_path, RULE, {**late, "start": 0.2}), end="0.15")
    (entry,) = load_manifest(tmp_path / "part" / "dataset.yaml").redactions
    assert (len(entry.rules), entry.rules[1], entry.rules[0] > 0) == (2, 0, True)
    packed(source, tmp_path / "without", rules(tmp_path), exclude=[TOPIC])
    (entry,) = load_manifest(tmp_path / "without" / "dataset.yaml").redactions
    assert entry.topics == []


def test_no_time_is_out_of_reach(tmp_path: Path) -> None:
    """Images whose times no column holds are kept in messages.mcap, without what was in boxes."""
    made = scene("mono8", frames=4)
    last = max(place for place, one in enumerate(made.messages) if one.topic == TOPIC)
    made.messages.append(replace(made.messages.pop(last), log_time=2**64 - 1))
    source = recorded(tmp_path, made)
    packed(source, tmp_path / "out", rules(tmp_path, {"topic": TOPIC, "box": BOX, "fill": 7}))
    found = [pixels(parsed(one)) for one in _images(unpacked(tmp_path / "out"))]
    assert len(found) == 4
    assert all((one[INSIDE] == 7).all() for one in found)


@pytest.mark.parametrize("name", ["jpeg-cut-one", "video-h264-mid-gop", "video-empty"])
def test_images_that_cannot_be_decoded(name: str, tmp_path: Path) -> None:
    source = recorded(tmp_path, CODED[name](frames=8))
    told = rules(tmp_path, {"topic": "/cam/*", "box": BOX})
    with pytest.raises(SourceError, match=r"logged at \d+ ns cannot be redacted: .*`exclude`"):
        packed(source, tmp_path / "no", told)
    assert not (tmp_path / "no").exists()
    if name == "jpeg-cut-one":
        found = rules(tmp_path, {"topic": "/cam/*", "box": BOX, "end": 0.05})
        packed(source, tmp_path / "out", found)
        assert mp4ds.validate(tmp_path / "out", deep=True) == []


def test_foxglove_jpeg(tmp_path: Path) -> None:
    (source,) = FOXGLOVE_SOURCES["mcap-protobuf"](tmp_path, FOXGLOVE["jpeg-rgb"]())
    told = rules(tmp_path, {"topic": "/camera/*", "box": BOX})
    proven(source, packed(source, tmp_path / "out", told), told)
    formats = {parsed(one).format for one in _images(unpacked(tmp_path / "out"))}
    assert formats == {"png"}
