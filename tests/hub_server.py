"""A stand-in for the Hugging Face Hub: as much of its API as reading datasets takes."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from remote_servers import Many, Quiet, serving

REPOSITORY = "someone/drives"
_COMMIT = "0" * 40


@dataclass
class Hub:
    """A running hub with one public repository.

    Attributes:
        folder: What is in the repository.
        url: Of the hub.
        sent: Path and bytes of each answer with a file's content.
    """

    folder: Path
    url: str = ""
    sent: list[tuple[str, int]] = field(default_factory=list)

    def entry(self, path: Path) -> dict[str, Any]:
        """What the API tells of a file or folder."""
        told: dict[str, Any] = {"path": path.relative_to(self.folder).as_posix(), "size": 0}
        if path.is_dir():
            return {**told, "type": "directory", "oid": "1" * 40}
        data = path.read_bytes()
        return {**told, "type": "file", "size": len(data), "oid": hashlib.sha1(data).hexdigest()}

    def answer(self, method: str, url: str, body: dict[str, list[str]]) -> Any:
        """The JSON of an API's address; None for nothing there."""
        parts = urlsplit(url)
        found = re.fullmatch(
            rf"/api/datasets/{REPOSITORY}(?:/(revision|paths-info|tree)/([^/]+)/?(.*))?",
            unquote(parts.path),
        )
        if not found:
            return None
        if found[1] in (None, "revision"):
            return {"id": REPOSITORY, "sha": _COMMIT, "private": False, "tags": [], "downloads": 0}
        if found[1] == "paths-info":
            paths = [self.folder / path for path in body.get("paths", [])]
            return [self.entry(path) for path in paths if path.exists()]
        place = self.folder / found[3]
        is_deep = parse_qs(parts.query).get("recursive", ["false"])[0].lower() == "true"
        if not place.is_dir():
            return None
        return [
            self.entry(path) for path in sorted(place.rglob("*") if is_deep else place.iterdir())
        ]


@contextmanager
def hub_server(folder: Path) -> Iterator[Hub]:
    """A hub whose repository is a folder."""
    hub = Hub(folder)

    class Handler(Quiet):
        def do_POST(self) -> None:
            data = self.rfile.read(int(self.headers["Content-Length"]))
            is_json = "json" in self.headers["Content-Type"]
            self._api(json.loads(data) if is_json else parse_qs(data.decode()))

        def do_GET(self) -> None:
            prefix = rf"/datasets/{REPOSITORY}/resolve/[^/]+/"
            if found := re.match(prefix, unquote(self.path)):
                self._file(unquote(urlsplit(self.path).path)[found.end() :])
            else:
                self._api({})

        def do_HEAD(self) -> None:
            self.do_GET()

        def _api(self, body: dict[str, list[str]]) -> None:
            told = hub.answer(self.command, self.path, body)
            is_there = f"/{REPOSITORY}" in unquote(self.path)
            code = "" if told is not None else "EntryNotFound" if is_there else "RepoNotFound"
            data = json.dumps({"error": "not found"} if told is None else told).encode()
            headers = {
                "Content-Type": "application/json",
                **({"X-Error-Code": code} if code else {}),
            }
            self._send(404 if told is None else 200, data, headers)

        def _file(self, name: str) -> None:
            path = hub.folder / name
            if not path.is_file():
                self._send(404, b"", {"X-Error-Code": "EntryNotFound"})
                return
            data, status = path.read_bytes(), 200
            if span := re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("range", "")):
                data, status = data[int(span[1]) : int(span[2]) + 1], 206
            hub.sent.append((name, len(data)))
            self._send(status, data, {"Content-Type": "application/octet-stream"})

        def _send(self, status: int, data: bytes, headers: dict[str, str]) -> None:
            self.send_response(status)
            for name, value in {**headers, "X-Repo-Commit": _COMMIT}.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(data)

    with serving(Many(("127.0.0.1", 0), Handler)) as hub.url:
        yield hub
