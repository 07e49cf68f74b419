"""Datasets of the conformance suite that break a rule of a whole dataset, one each."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from conformance_files import Document, both, replacing, setting, without
from mp4ds import yamlio

Edit = Callable[[Document], None]
MESSAGES = "messages.mcap"
_GARBAGE = b"no MCAP file\n" * 7


@dataclass(frozen=True)
class DatasetCase:
    """A dataset that is broken: a good one with a change.

    Attributes:
        shows: What is wrong, in words.
        codes: Of its problems.
        edit: Changes the manifest.
        files: Files that are added or replaced; None: removed.
        write: The manifest's bytes.
    """

    shows: str
    codes: tuple[str, ...]
    edit: Edit = lambda document: None
    files: Mapping[str, bytes | None] = field(default_factory=dict)
    write: Callable[[Document], bytes] = lambda document: yamlio.dump(document)


def _entry(name: str, **values: Any) -> Edit:
    """Says something else of a file."""

    def edit(document: Document) -> None:
        next(entry for entry in document["files"] if entry["name"] == name).update(values)

    return edit


def _unlisted(name: str) -> Edit:
    def edit(document: Document) -> None:
        document["files"] = [entry for entry in document["files"] if entry["name"] != name]

    return edit


def _replaced(name: str, data: bytes) -> tuple[Edit, dict[str, bytes | None]]:
    """Another file, of which the manifest knows."""
    return _entry(name, size=len(data), sha256=hashlib.sha256(data).hexdigest()), {name: data}


def _without_index(data: bytes) -> bytes:
    """An MCAP file that ends behind its data."""
    footer = struct.pack("<BQQQI", 2, 20, 0, 0, 0) + data[:8]
    return data[: struct.unpack_from("<Q", data, len(data) - 28)[0]] + footer


def broken(good: Path) -> dict[str, DatasetCase]:
    """All of them.

    Args:
        good: The good dataset, a topic of which has two streams.
    """
    manifest = yamlio.load((good / "dataset.yaml").read_bytes(), "")
    first, second = manifest["streams"][:2]
    early = yamlio.load((good / first["sidecar"]).read_bytes(), "")
    early["columns"]["log_time"]["start"] = -1
    stream_lost = both(
        lambda document: document["streams"].remove(document["streams"][1]),
        _unlisted(second["sidecar"]),
        _unlisted(second["video"]),
    )
    twice = lambda document: document["files"].append(document["files"][0])  # noqa: E731
    return {
        "file-missing": DatasetCase(
            "messages.mcap is not there", ("file-missing",), files={MESSAGES: None}
        ),
        "file-unlisted": DatasetCase(
            "a video that the manifest does not list",
            ("file-unlisted",),
            files={"left_over.mp4": b"?"},
        ),
        "other-files": DatasetCase(
            "a file of another kind, which may be there", (), files={"notes.txt": b"windy\n"}
        ),
        "size-mismatch": DatasetCase(
            "another size of messages.mcap", ("size-mismatch",), _entry(MESSAGES, size=1)
        ),
        "hash-mismatch": DatasetCase(
            "another SHA-256 of messages.mcap",
            ("hash-mismatch",),
            _entry(MESSAGES, sha256="0" * 64),
        ),
        "frames": DatasetCase(
            "another number of frames than the sidecar says",
            ("manifest-inconsistent",),
            setting("streams.0.frames", first["frames"] + 1),
        ),
        "topic": DatasetCase(
            "another topic than the sidecar says",
            ("manifest-inconsistent",),
            setting("streams.0.topic", "/elsewhere"),
        ),
        "video-not-listed": DatasetCase(
            "a stream's video is not among the files",
            ("file-unlisted", "manifest-inconsistent"),
            _unlisted(first["video"]),
        ),
        "verbatim-topic": DatasetCase(
            "messages stored verbatim of a topic that is not there",
            ("manifest-inconsistent",),
            setting(
                "verbatim",
                [{"topic": "/elsewhere", "messages": 1, "first": 0, "reason": "no reason"}],
            ),
        ),
        "time-range": DatasetCase(
            "another time of the last message",
            ("manifest-inconsistent",),
            setting("time_range.end", manifest["time_range"]["end"] + 1),
        ),
        "messages-missing": DatasetCase(
            "a stream was taken away: its ordinals are a gap",
            ("messages-missing",),
            stream_lost,
            files={second["sidecar"]: None, second["video"]: None},
        ),
        "messages-unreadable": DatasetCase(
            "messages.mcap is no MCAP file",
            ("messages-unreadable",),
            _entry(MESSAGES, size=len(_GARBAGE), sha256=hashlib.sha256(_GARBAGE).hexdigest()),
            files={MESSAGES: _GARBAGE},
        ),
        "messages-without-index": DatasetCase(
            "messages.mcap has lost its index",
            ("messages-unreadable",),
            *_replaced(MESSAGES, _without_index((good / MESSAGES).read_bytes())),
        ),
        "message-invalid": DatasetCase(
            "a log time that MCAP, the recording's format, cannot hold",
            ("message-invalid",),
            *_replaced(first["sidecar"], yamlio.dump(early)),
        ),
        "message-count": DatasetCase(
            "more messages than there are",
            ("message-count",),
            setting("messages", manifest["messages"] + 1),
        ),
        "manifest-listed-twice": DatasetCase(
            "a file that is listed twice", ("model-invalid",), twice
        ),
        "manifest-key": DatasetCase(
            "a manifest without sources", ("schema-invalid",), without("sources")
        ),
        "manifest-name": DatasetCase(
            "a sidecar that leaves the folder",
            ("schema-invalid",),
            setting("streams.0.sidecar", "/etc/passwd"),
        ),
        "manifest-version": DatasetCase(
            "a newer major version", ("version-unsupported",), setting("mp4ds", "2.0")
        ),
        "manifest-kind": DatasetCase(
            "a sidecar's kind in a manifest", ("kind-unknown",), setting("kind", "stream")
        ),
        "manifest-yaml": DatasetCase(
            "an alias in a manifest",
            ("yaml-invalid",),
            write=replacing(b"kind: dataset", b"kind: &a dataset\nlibrary: *a"),
        ),
        "manifest-checksum": DatasetCase(
            "a manifest that was damaged",
            ("checksum-mismatch",),
            write=lambda document: yamlio.dump(document).replace(b"ros1", b"ros2", 1),
        ),
    }
