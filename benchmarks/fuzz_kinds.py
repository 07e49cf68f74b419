"""What is changed: small recordings, datasets, and what an ended pack leaves; see fuzz.py."""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import xxhash

import mp4ds
from fuzz_bytes import damaged
from fuzz_dataset import MANIFEST, Good, changed_dataset
from fuzz_mcap import changed_mcap, changed_mcap_records
from fuzz_records import (
    changed_bag,
    changed_bag_records,
    changed_metadata,
    changed_sqlite,
    packed_with_zstd,
    unpacked_of_zstd,
)
from fuzz_rules import BrokenRuleError, check_dataset, check_recording
from in_parts import InlineEngine
from mp4ds import Mp4dsError
from mp4ds.packing.manifest import PartFacts
from mp4ds.packing.options import PackOptions
from mp4ds.packing.workplace import Workplace
from scenes import Scene
from sources import SOURCES, scene

_PACK = PackOptions(window=3, codec="h264")
_RECORDINGS = (
    *("bag-none", "bag-bz2", "bag-lz4", "mcap-ros2-none", "mcap-ros2-lz4", "mcap-ros2-zstd"),
    *("mcap-unchunked", "mcap-unindexed", "rosbag2-sqlite3-v9", "rosbag2-mcap-v9"),
    *("rosbag2-sqlite3-zstd-file", "rosbag2-sqlite3-zstd-message"),
)
_DATASETS = ("bag-none", "mcap-ros2-zstd", "rosbag2-sqlite3-v9")

Make = Callable[[Path, random.Random], None]
"""Fills an empty folder with what is read."""

Check = Callable[[Path, Path, random.Random], str]
"""Checks what is in a folder, with another one for outputs, and says what became of it."""


@dataclass(frozen=True)
class Kind:
    """What is changed, and how it is checked.

    Attributes:
        make: Puts a changed copy into a folder.
        check: Holds mp4ds to its rules.
        weight: How many of its inputs there are beside those of other kinds.
    """

    make: Make
    check: Check
    weight: int = 1


# ---------------------------------------------------------------- what is changed


def make_kinds(folder: Path) -> dict[str, Kind]:
    """Good recordings and datasets of every kind, and how they are changed.

    Args:
        folder: Where they are made, empty.
    """
    kinds: dict[str, Kind] = {}
    for name in _RECORDINGS:
        place = folder / name
        place.mkdir()
        (path,) = SOURCES[name](place, _scene(len(kinds)))
        check = partial(_check_recording, name=path.name)
        if path.is_dir():
            files = {p.name: p.read_bytes() for p in path.iterdir()}
            kinds[name] = Kind(partial(_make_rosbag2, name=path.name, files=files), check)
        else:
            make = partial(_make_file, name=path.name, data=path.read_bytes())
            kinds[name] = Kind(make, check, 3)
    for name in _DATASETS:
        place = folder / f"dataset-{name}"
        place.mkdir()
        (place / "source").mkdir()
        images = scene("bayer_rggb8", frames=4, width=32, height=16)
        images = Scene([m for m in images.messages if m.topic not in ("/tf", "/imu")])
        (source,) = SOURCES[name](place / "source", images)
        mp4ds.pack(source, place / "drive", PackOptions(codec="h264"))
        good = Good.read(place / "drive")
        for part in ("manifest", "sidecar", "columns", "video", "messages"):
            make = partial(_make_dataset, good=good, part=part)
            kinds[f"{part}-{name}"] = Kind(make, _check_dataset, 1 if part == "video" else 2)
    return kinds | _work_kinds(folder)


def _scene(number: int) -> Scene:
    """A camera and two other topics; for most of the recordings these alone, which is faster."""
    made = scene("mono8", frames=3, width=32, height=16)
    topics = ("/imu", "/chatter") if number % 3 else ("/imu", "/chatter", "/cam/image_raw")
    return Scene([message for message in made.messages if message.topic in topics])


def _make_file(folder: Path, rng: random.Random, *, name: str, data: bytes) -> None:
    is_bag = name.endswith(".bag")
    content, records = (
        (changed_bag, changed_bag_records) if is_bag else (changed_mcap, changed_mcap_records)
    )
    change = rng.choice((content, content, records, records, damaged))
    data = change(data, rng)
    if rng.random() < 0.1:
        data = damaged(data, rng)
    (folder / name).write_bytes(data)


def _make_rosbag2(folder: Path, rng: random.Random, *, name: str, files: dict[str, bytes]) -> None:
    place = folder / name
    place.mkdir()
    for file, data in files.items():
        (place / file).write_bytes(data)
    storage = place / next(file for file in files if not file.endswith(".yaml"))
    kind = rng.random()
    if kind < 0.25:
        path = place / "metadata.yaml"
        change = rng.choice((damaged, changed_metadata, changed_metadata))
        path.write_bytes(change(path.read_bytes(), rng))
    elif kind < 0.35:
        storage.write_bytes(damaged(storage.read_bytes(), rng))
    elif storage.suffix == ".db3":
        changed_sqlite(storage, rng)
    elif storage.suffix == ".mcap":
        change = rng.choice((changed_mcap, changed_mcap_records))
        storage.write_bytes(change(storage.read_bytes(), rng))
    else:
        plain = folder / "plain.db3"
        plain.write_bytes(unpacked_of_zstd(storage.read_bytes()))
        changed_sqlite(plain, rng)
        storage.write_bytes(packed_with_zstd(plain.read_bytes()))
        plain.unlink()


def _make_dataset(folder: Path, rng: random.Random, *, good: Good, part: str) -> None:
    place = folder / "drive"
    place.mkdir()
    if rng.random() < 0.1:
        files = dict(good.files)
        chosen = {"manifest": MANIFEST, "video": ".mp4", "messages": ".mcap"}.get(
            part, "image_raw.yaml"
        )
        name = next(file for file in files if file.endswith(chosen))
        files[name] = damaged(files[name], rng)
        if name.endswith(".yaml") and rng.random() < 0.5:
            files[name] = _signed(files[name])
    else:
        files = changed_dataset(good, part, rng)
    for name, data in files.items():
        (place / name).write_bytes(data)


def _signed(data: bytes) -> bytes:
    body = data[: data.rfind(b"checksum:")]
    return body + b'checksum: "xxh64:%s"\n' % xxhash.xxh64(body).hexdigest().encode()


def _check_recording(folder: Path, out: Path, rng: random.Random, *, name: str) -> str:
    return check_recording(folder / name, out, rng)


def _check_dataset(folder: Path, out: Path, rng: random.Random) -> str:
    return check_dataset(folder / "drive", out, rng)


def _work_kinds(folder: Path) -> dict[str, Kind]:
    """What a pack in parts leaves that was ended, and how it goes on."""
    place = folder / "work"
    place.mkdir()
    (source,) = SOURCES["bag-none"](place, scene("bayer_rggb8", frames=6))
    engine = InlineEngine(lambda name: name == "00001-0")
    with suppress(Mp4dsError):
        _pack(source, place / "drive", engine)
    work = ".drive.mp4ds-part"
    part = f"{work}/parts/00000-0"
    if not (place / part).is_dir():
        raise RuntimeError("no part was made")
    # in its copies, the job names this very recording
    victims = {"job": [f"{work}/job.json"], "part": [f"{part}/part.json"]}
    others = [f"{part}/{p.name}" for p in sorted((place / part).iterdir())]
    victims["part-files"] = [name for name in others if not name.endswith("part.json")]
    check = partial(_check_work, source=source)
    return {
        name: Kind(partial(_make_work, good=place, victims=files), check)
        for name, files in victims.items()
    }


def _make_work(folder: Path, rng: random.Random, *, good: Path, victims: list[str]) -> None:
    shutil.copytree(good, folder, dirs_exist_ok=True)
    victim = folder / rng.choice(victims)
    data = victim.read_bytes()
    if victim.suffix == ".json" and rng.random() < 0.8:  # with a checksum that fits
        data = _kept(damaged(_text_of(data), rng))
    else:
        data = damaged(data, rng)
    victim.write_bytes(data)


_MARK = b',\n"xxh64": "'


def _text_of(data: bytes) -> bytes:
    return data.rpartition(_MARK)[0]


def _kept(text: bytes) -> bytes:
    """A file as a divided pack keeps it, with its checksum."""
    return text + _MARK + xxhash.xxh64_hexdigest(text).encode() + b'"}\n'


def _check_work(folder: Path, out: Path, rng: random.Random, *, source: Path) -> str:
    shutil.copytree(folder, out, dirs_exist_ok=True)
    place = Workplace(out / ".drive.mp4ds-part")
    job_file = place.folder / "job.json"
    text = _text_of(job_file.read_bytes())
    if _kept(text) == job_file.read_bytes():  # let it be one that was begun there
        inode = place.folder.lstat().st_ino
        job_file.write_bytes(_kept(re.sub(rb'"place": \d+', b'"place": %d' % inode, text)))
    with suppress(Mp4dsError):
        job = place.job(shared=rng.random() < 0.5)
        if job is not None:
            [place.is_done(task) for task in job.tasks]
    with suppress(Mp4dsError):
        PartFacts.load(place.parts / "00000-0")
    if rng.random() < 0.25:
        _pack(source, out / "drive", InlineEngine())
        if problems := mp4ds.validate(out / "drive", deep=True):
            raise BrokenRuleError(f"what was packed has a problem: {problems[0]}")
        return "packed"
    return "read"


def _pack(source: Path, target: Path, engine: InlineEngine) -> None:
    packing: Any = import_module("mp4ds.packing.pack")
    packing._engine = lambda *_: engine
    mp4ds.pack(source, target, _PACK)
