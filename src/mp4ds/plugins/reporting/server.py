"""Serves a page to this machine's browsers, with byte ranges, which they need for seeking.

Other sites in such a browser, and other users of this machine, can reach the port, too. They do not
know the token in the paths, and embedding is refused.
"""

from __future__ import annotations

import os
import re
import secrets
import sys
from collections.abc import Mapping
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import BinaryIO
from urllib.parse import unquote

from mp4ds.errors import OptionError

_HOST = "127.0.0.1"
_BLOCK = 1 << 18
_LONGEST_RANGE = 64  # characters
_TOKEN_BYTES = 18
_SAME_SITE = ("none", "same-origin")  # Sec-Fetch-Site: typed by the user, or from this page
_GUARDS = {
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
"""Headers of every response: no other site may include, frame or retain it."""

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".mp4": "video/mp4",
}


class ReportServer(ThreadingHTTPServer):
    """Serves some files, and nothing else.

    Args:
        files: The files, by URL path, such as ``/index.html``, unquoted. An unguessable token
            precedes it.
        start: Path of the page, quoted.
        port: Port to listen on; 0 for a free one.

    Attributes:
        root: Prefix of all URLs, without a trailing slash.
        url: Of the page.

    Raises:
        OptionError: The port is taken.
    """

    daemon_threads = True

    def __init__(self, files: Mapping[str, Path], start: str, *, port: int = 0) -> None:
        token = secrets.token_urlsafe(_TOKEN_BYTES)
        served = {f"/{token}{path}": file for path, file in files.items()}
        try:
            super().__init__((_HOST, port), partial(_Handler, served))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise OptionError(f"`port` {port} cannot be used: {reason}.") from None
        self.root = f"http://{_HOST}:{self.server_port}/{token}"
        self.url = f"{self.root}{start}"

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore connections closed by the browser."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 60

    def __init__(self, files: Mapping[str, Path], *arguments: object) -> None:
        self._files = files
        super().__init__(*arguments)  # type: ignore[arg-type]

    def log_message(self, *_: object) -> None:
        """Log nothing."""

    def end_headers(self) -> None:
        for name, value in _GUARDS.items():
            self.send_header(name, value)
        super().end_headers()

    def _is_own(self) -> bool:
        """Whether the request comes from the page or the user, not from another site."""
        port = self.connection.getsockname()[1]
        hosts = [f"{name}:{port}" for name in (_HOST, "localhost")]
        if port == 80:
            hosts += [_HOST, "localhost"]
        if self.headers.get("Host") not in hosts:  # otherwise another site, under its own name
            return False
        site = self.headers.get("Sec-Fetch-Site", "none")  # old browsers do not send it
        # a link to the page may be anywhere, such as in a web-based terminal
        return site in _SAME_SITE or self.headers.get("Sec-Fetch-Dest") == "document"

    def do_GET(self) -> None:
        """Answer with a file, or a part of it."""
        if not self._is_own():
            self._refuse(HTTPStatus.FORBIDDEN)
            return
        path = self._files.get(unquote(self.path.partition("?")[0]))
        try:
            file = path.open("rb") if path else None
        except OSError:
            file = None
        if path is None or file is None:
            self._refuse(HTTPStatus.NOT_FOUND)
            return
        with file:
            self._send(file, path)

    def _send(self, file: BinaryIO, path: Path) -> None:
        size = os.fstat(file.fileno()).st_size
        wanted = self.headers.get("Range")
        part = (0, size) if wanted is None else byte_range(wanted, size)
        if part is None:
            self._refuse(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, f"bytes */{size}")
            return
        start, end = part
        self.send_response(HTTPStatus.OK if wanted is None else HTTPStatus.PARTIAL_CONTENT)
        if wanted is not None:
            self.send_header("Content-Range", f"bytes {start}-{end - 1}/{size}")
        self.send_header("Content-Type", _TYPES.get(path.suffix, "application/octet-stream"))
        self.send_header("Content-Length", str(end - start))
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("Cache-Control", "no-cache")
        self.end_headers()
        file.seek(start)
        left = end - start
        while left and (block := file.read(min(left, _BLOCK))):
            self.wfile.write(block)
            left -= len(block)
        if left:  # the file was truncated
            self.close_connection = True

    def _refuse(self, status: HTTPStatus, content_range: str = "") -> None:
        self.send_response(status)
        if content_range:
            self.send_header("Content-Range", content_range)
        self.send_header("Content-Length", "0")
        self.end_headers()


def byte_range(wanted: str, size: int) -> tuple[int, int] | None:
    """The first byte of a range and the one after its last (RFC 9110, section 14).

    Args:
        wanted: The header ``Range``.
        size: Size of the file.

    Returns:
        All of it if the header is of another kind; None if the range is outside the file.
    """
    match = re.fullmatch(r"bytes=([0-9]*)-([0-9]*)", wanted.strip()[:_LONGEST_RANGE])
    if not match or not (match[1] or match[2]):
        return 0, size
    if not match[1]:
        start, end = max(0, size - int(match[2])), size
    else:
        start, end = int(match[1]), min(int(match[2]) + 1 if match[2] else size, size)
    return (start, end) if start < end else None
