"""Sidecars of the conformance suite: how they are edits of good ones, and the valid ones."""

from __future__ import annotations

import base64
import copy
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mp4ds import yamlio

Document = dict[str, Any]
Edit = Callable[[Document], None]
Write = Callable[[Document], bytes]

REFUSED_BY_READERS = frozenset(
    {
        *("yaml-invalid", "checksum-mismatch", "version-unsupported", "migration-failed"),
        *("kind-unknown", "schema-invalid", "model-invalid", "column-invalid", "header-mismatch"),
        *("file-missing", "video-unreadable", "codec-mismatch", "geometry-mismatch"),
        *("frame-count", "decode-failed", "digest-mismatch", "messages-missing"),
        "messages-unreadable",
    }
)
"""What a reader cannot read past; the other codes are a validator's."""


PARTS = {
    "yaml": ("yaml-invalid", "checksum-mismatch"),
    "versions": ("version-unsupported", "kind-unknown"),
    "version-0": ("migration-failed",),
    "keys": ("schema-invalid",),
    "values": ("model-invalid", "manifest-inconsistent"),
    "columns": ("column-invalid",),
    "messages": ("header-mismatch", "digest-mismatch", "decode-failed"),
    "video": (
        *("file-missing", "video-unreadable", "codec-mismatch", "geometry-mismatch"),
        *("frame-count", "references-invalid"),
    ),
    "dataset": ("messages-missing", "messages-unreadable"),
    "integrity": (
        *("size-mismatch", "hash-mismatch", "file-unlisted", "message-count"),
        *("scores-invalid", "message-invalid"),
    ),
}
"""What an implementation may claim -> the problem codes that it then tells."""


def part_of(codes: Sequence[str]) -> str:
    """The part that a case with these problems belongs to."""
    return next(name for name, told in PARTS.items() if set(told) & set(codes))


@dataclass(frozen=True)
class FileCase:
    """A YAML file.

    Attributes:
        shows: What is told by it, in words.
        base: Name of the good document.
        edit: Changes the document.
        write: Its bytes.
        code: Of the problem; empty for a valid file.
        part: What it belongs to, if not that of its code.
    """

    shows: str
    base: str = "gray"
    edit: Edit = lambda document: None
    write: Write = lambda document: yamlio.dump(document)
    code: str = ""
    part: str = ""

    def data(self, documents: Mapping[str, Document]) -> bytes:
        """The file."""
        document = copy.deepcopy(documents[self.base])
        self.edit(document)
        return self.write(document)


def plain(document: Document) -> bytes:
    """Without the checksum line, as one who edits a file by hand leaves it."""
    return yamlio.dump(document).rsplit(b"checksum: ", 1)[0]


def _holder(document: Document, place: str) -> tuple[Any, Any]:
    """The map or list that holds a place, and its key or number there."""
    target: Any = document
    *parents, last = (int(key) if key.isdigit() else key for key in place.split("."))
    for key in parents:
        target = target[key]
    return target, last


def setting(place: str, value: Any) -> Edit:
    """Sets what is at a place such as ``headers.0.frame_id``."""

    def edit(document: Document) -> None:
        holder, key = _holder(document, place)
        holder[key] = value

    return edit


def without(*places: str) -> Edit:
    """Removes keys, each the last of a place."""

    def edit(document: Document) -> None:
        for place in places:
            holder, key = _holder(document, place)
            holder.pop(key, None)

    return edit


def both(*edits: Edit) -> Edit:
    """One edit after the other."""

    def edit(document: Document) -> None:
        for each in edits:
            each(document)

    return edit


def replacing(old: bytes, new: bytes, *, count: int = 1) -> Write:
    """A file in which something else stands, without its checksum."""

    def write(document: Document) -> bytes:
        data = plain(document)
        if old not in data:
            raise ValueError(f"{old!r} is not in the file")
        return data.replace(old, new, count)

    return write


def column(start: int, step: int, values: str) -> Document:
    """A column as a sidecar has it."""
    return {"start": start, "step": step, "values": values}


def _as_json(document: Document) -> bytes:
    return json.dumps(document, indent=1, ensure_ascii=False).encode() + b"\n"


def not_lossless(document: Document) -> None:
    """Makes a stream one that need not be exact, and has no digests."""
    document["profile"] = "crf=1"
    del document["digests"]


def _two_headers(document: Document) -> None:
    """What YAML 1.1 takes for booleans, numbers, times and dates are strings."""
    names = [
        *("yes", "010", "1_000", "12:30:00", "2024-01-01", ".5"),
        *("0x10", "True", "NULL", "=", "<<"),
    ]
    document["headers"] = [{"frame_id": name} for name in names]
    document["columns"]["variant"] = column(10, -3, "0*3")


def _unquoted(document: Document) -> bytes:
    data = plain(document)
    for header in document["headers"]:
        name = header["frame_id"].encode()
        if header["frame_id"] not in ("=", "<<"):
            data = data.replace(b'frame_id: "%s"' % name, b"frame_id: %s" % name)
    return data


def with_template(document: Document) -> None:
    """A blank that is not the plain one: bytes follow the message."""
    name = b"cam"
    blank = bytes(12) + len(name).to_bytes(4, "little") + name
    image = document["image"]
    for value in (image["height"], image["width"]):
        blank += value.to_bytes(4, "little")
    encoding = image["encoding"].encode()
    blank += len(encoding).to_bytes(4, "little") + encoding + bytes([image["is_bigendian"]])
    blank += image["step"].to_bytes(4, "little") + bytes(4) + b"tail"
    document["headers"][0]["template"] = base64.b64encode(blank).decode()


_TOP = 2**63 - 1


def scored(mean: float) -> Edit:
    """Makes it the sidecar of a video of four frames that keeps a score.

    Args:
        mean: Told of the scores, which have 41.5.
    """

    def edit(document: Document) -> None:
        not_lossless(document)
        document["profile"] = "psnr=41"
        document["video"]["quality"] = {
            "metric": "psnr",
            "target": 41.0,
            "mean": mean,
            "p5": 40.15,
            "min": 40.0,
            "worst_window": 40.5,
            "windows": 2,
            "reencoded": 1,
            "scores": column(4000, 100, "0*3"),
        }

    return edit


VALID: dict[str, FileCase] = {
    "scores": FileCase("the scores that frames were measured to have", edit=scored(41.5)),
    "as-written": FileCase("as mp4ds writes it, with a checksum"),
    "least": FileCase(
        "the required keys alone",
        edit=both(
            not_lossless,
            without(*("camera_info", "video.color", "video.encoder", "video.options")),
            without(*("video.size", "video.sha256", "columns.sequence", "columns.publish_time")),
            without("columns.seq", "channel.schema.text", "channel.metadata"),
            setting("channel.schema.text", ""),
        ),
        write=plain,
    ),
    "json": FileCase("JSON, which is YAML in flow style", write=_as_json),
    "comments": FileCase(
        "comments, a document marker, a key in quotes, null by its three names",
        write=lambda document: (
            b"# first\n---\n"
            + replacing(b"kind: stream", b"\"kind\": 'stream'  # of images")(document)
            + b"# last\n"
        ),
    ),
    "strings": FileCase(
        "plain scalars that are strings here and not in YAML 1.1; a variant that runs backwards",
        edit=_two_headers,
        write=_unquoted,
    ),
    "utf-8": FileCase(
        "a topic and a frame_id beyond ASCII, line separators as escapes",
        edit=both(
            setting("channel.topic", "/caméra/画像"),
            setting("headers.0.frame_id", "optisch \U0001f4f7\u2028\u0085\t"),
        ),
    ),
    "columns-runs": FileCase(
        "residuals in runs, over several lines, with spaces before and after",
        edit=both(
            setting("columns.publish_time", column(5, 7, "  -0*1\n\n 1*1   \n-2 \n")),
            setting("columns.sequence", column(0, 1, "0*3")),
        ),
    ),
    "columns-wrap": FileCase(
        "sums that wrap around, and the extremes with a count",
        edit=both(
            setting("columns.publish_time", column(_TOP, 1, "0 0 0")),
            setting("columns.log_time", column(-_TOP - 1, _TOP, f"{-_TOP - 1}*1 1 0")),
            setting("columns.sequence", column(2**32 - 1, 0, f"{_TOP}*1 {-_TOP}*1 0")),
        ),
    ),
    "stamps-extreme": FileCase(
        "the first and the last stamp of ros1, and one that repeats",
        edit=both(
            setting(
                "columns.stamp",
                column(0, 0, f"{2**32 * 10**9 - 1} 0 {-(2**32) * 10**9 + 1_000_000_000}"),
            ),
            setting("columns.seq", column(2**32 - 1, 0, f"{1 - 2**32} 0 7")),
        ),
    ),
    "ordinals": FileCase(
        "a pair alone whose other messages are elsewhere",
        edit=setting("columns.ordinal", column(2, 1, "0 5 0")),
    ),
    "template": FileCase("a blank message with bytes after it", edit=with_template),
    "without-calibration-messages": FileCase(
        "a calibration that holds without messages",
        edit=both(setting("camera_info.messages", 0), without("camera_info.columns")),
    ),
    "newer-minor": FileCase(
        "a newer minor version: keys that are not known are ignored",
        edit=both(
            setting("mp4ds", "1.7"),
            setting("weather", {"rain": True}),
            setting("video.grain", [1, 2.5, None]),
        ),
    ),
    "packets": FileCase("packets, with their framing", base="h264"),
    "version-0": FileCase(
        "version 0, which has float seconds", base="version-0", write=plain, part="version-0"
    ),
}
