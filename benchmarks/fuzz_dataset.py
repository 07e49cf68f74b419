"""Datasets with a value, a box or a record changed, and hashes that fit again; see fuzz.py."""

from __future__ import annotations

import copy
import hashlib
import json
import random
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuzz_mcap import changed_mcap, changed_mcap_records
from fuzz_records import LENGTHS, odd_number
from mp4ds import yamlio

Document = dict[str, Any]
MANIFEST = "dataset.yaml"
MESSAGES = "messages.mcap"

_ODD: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 255, 2**31, 2**32 - 1, 2**32, 2**63 - 1, -(2**63), 2**64, 1e300),
    *("", "0", "a", "\0", "../x", "x" * 3000, "\U0001f600", [], {}, [1], {"a": 1}, 0.5, "1 2"),
)
_WORDS = ("lossless", "visual", "crf=1", "ros1", "ros2", "cdr-le", "cdr-be", "gray", "h264", "ffv1")
_WORDS += ("bag", "mcap", "rosbag2", "mono8", "rgb8", "16UC1", "xxh64", "jpeg", "packet", "pixels")
_COLUMNS = ("log_time", "publish_time", "sequence", "seq", "pts", "variant", "ordinal")
_CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"dinf")


@dataclass(frozen=True)
class Good:
    """A good dataset in memory.

    Attributes:
        files: Content by name.
        documents: Its YAML files, parsed.
    """

    files: dict[str, bytes]
    documents: dict[str, Document]

    @classmethod
    def read(cls, folder: Path) -> Good:
        """Read one."""
        files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
        documents = {
            name: yamlio.load(data, name) for name, data in files.items() if name.endswith("yaml")
        }
        return cls(files, documents)


def changed_dataset(good: Good, kind: str, rng: random.Random) -> dict[str, bytes]:
    """The files of a dataset of which one is changed.

    Args:
        good: The dataset.
        kind: ``manifest``, ``sidecar``, ``columns``, ``video`` or ``messages``.
        rng: Says how.
    """
    files = dict(good.files)
    documents = copy.deepcopy(good.documents)
    sidecars = [name for name in documents if name != MANIFEST]
    name = rng.choice(sidecars)
    document = documents[name]
    if kind == "manifest":
        document, name = documents[MANIFEST], MANIFEST
        _change_value(document, rng)
    elif kind == "sidecar":
        for _ in range(rng.choice((1, 1, 2))):
            _change_value(document, rng)
    elif kind == "columns":
        _change_columns(document, rng)
    elif kind == "video":
        video = document["video"]["file"]
        files[video] = changed_boxes(files[video], rng)
    else:
        change = rng.choice((changed_mcap, changed_mcap_records))
        files[MESSAGES] = change(files[MESSAGES], rng)
    if kind != "manifest" and rng.random() < 0.3:  # so that no digest tells first
        document.pop("digests", None)
        document["profile"] = documents[MANIFEST]["profile"] = "crf=1"
    _agree(files, documents, rng)
    return files


def _agree(files: dict[str, bytes], documents: dict[str, Document], rng: random.Random) -> None:
    """Let all say of the files what they are now, most of the times."""
    exact = rng.random() < 0.9
    for name, document in documents.items():
        if name == MANIFEST:
            continue
        video = document.get("video")
        data = files.get(str(video.get("file"))) if isinstance(video, dict) else None
        if exact and data is not None:
            video |= {key: value for key, value in _facts(data).items() if key in video}
        files[name] = _dumped(document)
    entries = documents[MANIFEST].get("files")
    for entry in entries if exact and isinstance(entries, list) else ():
        if isinstance(entry, dict) and isinstance(entry.get("name"), str):
            entry |= _facts(files[entry["name"]]) if entry["name"] in files else {}
    files[MANIFEST] = _dumped(documents[MANIFEST])


def _facts(data: bytes) -> Document:
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _dumped(document: Document) -> bytes:
    # JSON is YAML, and many times as fast to write; the checksum may be left out
    return json.dumps(document, ensure_ascii=False).encode("utf-8", "surrogatepass") + b"\n"


def _change_value(document: Document, rng: random.Random) -> None:
    """Give a value that is anywhere in a document to something else, or take it away."""
    where: Any = document
    while True:
        key = rng.choice([*where]) if isinstance(where, dict) else rng.randrange(len(where))
        value = where[key]
        if isinstance(value, (dict, list)) and value and rng.random() < 0.85:
            where = value
            continue
        break
    kind = rng.random()
    if kind < 0.15:
        del where[key]
    elif kind < 0.25 and isinstance(where, list):
        where.insert(key, copy.deepcopy(value))
    elif kind < 0.3 and isinstance(where, dict):
        where["more"] = value
    elif isinstance(value, bool) or value is None:
        where[key] = rng.choice((True, False, None, 1))
    elif isinstance(value, int) and kind < 0.8:
        where[key] = rng.choice((value + 1, value - 1, value * 2, -value, *LENGTHS))
    elif isinstance(value, str) and kind < 0.8:
        odd = (value + "2", value[:-1], value.upper(), value * 2, *_WORDS)
        where[key] = rng.choice(odd)
    else:
        where[key] = rng.choice(_ODD)


def _change_columns(document: Document, rng: random.Random) -> None:
    """Change a number of a column, of the stream or its calibrations, or their digests."""
    places = [part["columns"] for part in (document, document.get("camera_info")) if part]
    columns = rng.choice([place for place in places if place])
    if rng.random() < 0.1 and "digests" in document:
        document["digests"]["values"] = _odd_words(document["digests"]["values"], rng)
        return
    if rng.random() < 0.25:
        columns[rng.choice(_COLUMNS)] = dict(rng.choice([*columns.values()]))
    name = rng.choice([*columns])
    if not isinstance(columns[name], dict):
        return
    key = rng.choice(("start", "step", "values"))
    if key == "values":
        columns[name][key] = _odd_words(columns[name][key], rng)
    else:
        old = columns[name][key]
        columns[name][key] = rng.choice(
            (old + 1, old - 1, -old, 0, -1, 2**31, 2**32, 2**63 - 1, -(2**63), 2**32 * 10**9)
        )
    if rng.random() < 0.05:
        del columns[name]


def _odd_words(text: str, rng: random.Random) -> str:
    words = text.split()
    if not words:
        return rng.choice(("0", "1", "0*1"))
    at = rng.randrange(len(words))
    odd = ("0", "1", "-1", "0*2", "-", "*", "1*0", f"{2**63}", f"{2**63 - 1}*1", "", "x")
    words[at] = rng.choice((*odd, words[at] + " " + words[at], words[at][::-1]))
    return " ".join(words)


# ---------------------------------------------------------------- mp4

Box = tuple[bytes, Any]
"""Type, and the body, of a container a list of boxes."""


def _boxes(data: bytes) -> list[Box]:
    found, at = [], 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        size = size if size >= 8 else len(data) - at
        body = data[at + 8 : at + size]
        found.append((kind, _boxes(body) if kind in _CONTAINERS else body))
        at += size
    return found


def _joined(boxes: list[Box]) -> bytes:
    out = b""
    for kind, body in boxes:
        data = _joined(body) if isinstance(body, list) else body
        out += struct.pack(">I4s", len(data) + 8, kind) + data
    return out


def changed_boxes(data: bytes, rng: random.Random) -> bytes:
    """A video with a box gone, twice, elsewhere, of another type or size, or a number changed."""
    boxes = _boxes(data)
    inside = boxes
    while rng.random() < 0.85:
        deeper = [body for _, body in inside if isinstance(body, list)]
        if not deeper:
            break
        inside = rng.choice(deeper)
    at = rng.randrange(len(inside))
    kind, body = inside[at]
    choice = rng.random()
    if choice < 0.1:
        del inside[at]
    elif choice < 0.2:
        inside.insert(rng.randrange(len(inside)), inside[at])
    elif choice < 0.25:
        inside[at] = rng.choice((b"free", b"moov", b"stbl", b"co64", b"abcd")), body
    elif isinstance(body, bytes) and len(body) >= 4:
        size = rng.choice((1, 2, 4, 4, 4))
        place = rng.randrange(len(body) // size) * size
        old = int.from_bytes(body[place : place + size], "big")
        inside[at] = kind, body[:place] + odd_number(old, size, rng)[::-1] + body[place + size :]
    made = _joined(boxes)
    if choice > 0.95:  # a size that is not what it encloses
        place = max(made.find(kind, rng.randrange(len(made))) - 4, 0)
        made = made[:place] + odd_number(len(body), 4, rng)[::-1] + made[place + 4 :]
    return made
