"""Web servers on this machine for the tests of URLs: S3, and plain ones with and without ranges.

Each tells what it was asked for, and fails where a test wants it to.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import WSGIRequestHandler, make_server

BUCKET = "bucket"
_BODY = '<?xml version="1.0"?><Error><Code>{code}</Code><Message>{code}</Message></Error>'
_CODES = {403: "AccessDenied", 404: "NoSuchKey", 500: "InternalError", 503: "SlowDown"}


class Request(NamedTuple):
    """What a server was asked for; the range is of first and last byte."""

    method: str
    path: str
    span: tuple[int, int] | None


@dataclass
class Server:
    """A running server.

    Attributes:
        url: What its paths are appended to.
        requests: What it was asked for.
        fails: The status to fail with, instead of an answer.
        delay: Seconds that it waits before each answer.
        sent: Bytes of files that a plain one sent.
        endless: Whether a plain one goes on sending after a range, without telling a length.
        breaks_off: Whether a plain one closes the connection in the middle of its answers.
    """

    url: str
    requests: list[Request] = field(default_factory=list)
    fails: Callable[[Request], int | None] = lambda _: None
    delay: float = 0.0
    sent: int = 0
    endless: bool = False
    breaks_off: bool = False

    def heard(self, method: str, path: str, header: str | None) -> int | None:
        """Note a request; the status to fail with, if it is to fail."""
        match = re.fullmatch(r"bytes=(\d+)-(\d*)", header or "")
        span = (int(match[1]), int(match[2] or 2**62)) if match else None
        request = Request(method, unquote(path), span)
        self.requests.append(request)
        time.sleep(self.delay)
        return self.fails(request)

    def fetched(self, name: str) -> list[tuple[int, int]]:
        """First byte and end of the ranges of a file that were asked for.

        A file that was asked for as a whole raises an error.
        """
        found = []
        for method, path, span in self.requests:
            if method == "GET" and path.endswith(name):
                assert span is not None, f"{path} was asked for as a whole"
                found.append((span[0], span[1] + 1))
        return found

    def forget(self) -> None:
        """Begin anew."""
        self.requests.clear()
        self.fails = lambda _: None
        self.delay = 0.0
        self.sent = 0
        self.breaks_off = False


class _Quiet(WSGIRequestHandler):
    def log(self, *_: Any) -> None:
        pass


def _without_server(start_response: Callable[..., Any]) -> Callable[..., Any]:
    """Without the header that the web server writes, too: clients may refuse to read it twice."""

    def start(status: str, headers: list[tuple[str, str]], *rest: Any) -> Any:
        once = [(name, value) for name, value in headers if name.lower() not in ("server", "date")]
        return start_response(status, once, *rest)

    return start


@contextmanager
def serving(server: Any) -> Iterator[str]:
    """The URL of an HTTP server of this machine, which runs meanwhile in a thread."""
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class Many(ThreadingHTTPServer):
    """A server of many requests at once."""

    daemon_threads = True
    request_queue_size = 128


class Quiet(BaseHTTPRequestHandler):
    """Answers without telling of it."""

    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        """Nothing."""


@contextmanager
def s3_server() -> Iterator[Server]:
    """An S3 that knows any credentials."""
    server = Server("")
    moto = DomainDispatcherApplication(create_backend_app)

    def app(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        status = server.heard(
            environ["REQUEST_METHOD"], environ["PATH_INFO"], environ.get("HTTP_RANGE")
        )
        if status is None:
            answer: Iterable[bytes] = moto(environ, _without_server(start_response))
            return answer
        environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
        start_response(f"{status} {_CODES[status]}", [("Content-Type", "application/xml")])
        body = _BODY.format(code=_CODES[status]).encode()
        return [] if environ["REQUEST_METHOD"] == "HEAD" else [body]

    running = make_server("127.0.0.1", 0, app, threaded=True, request_handler=_Quiet)
    with serving(running) as server.url:
        yield server


@contextmanager
def web_server(folder: Path, *, ranges: bool = True) -> Iterator[Server]:
    """A plain web server.

    Args:
        folder: What it serves; it lists nothing.
        ranges: Whether it serves parts of files.
    """
    server = Server("")

    class Handler(Quiet):
        def do_HEAD(self) -> None:
            self._answer(body=False)

        def do_GET(self) -> None:
            self._answer(body=True)

        def _answer(self, *, body: bool) -> None:
            path = unquote(self.path.partition("?")[0])
            status = server.heard(self.command, self.path, self.headers.get("Range"))
            file = folder / path.lstrip("/")
            if status is None and not file.is_file():
                status = 404
            if status is not None:
                self.send_response(status)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            size = file.stat().st_size
            match = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range") or "")
            start, end = 0, size
            if match and ranges:
                start, end = int(match[1]), min(size, int(match[2] or size) + 1)
                self.send_response(206)
                self.send_header("Content-Range", f"bytes {start}-{end - 1}/{size}")
            else:
                self.send_response(200)
            if not (body and server.endless):
                self.send_header("Content-Length", str(end - start))
            self.send_header("ETag", f'"{size}-{file.stat().st_mtime_ns}"')
            self.end_headers()
            if body and server.breaks_off:
                end = start + (end - start) // 2
                self.close_connection = True
            if body:
                self._send(file, start, end)
            while body and server.endless and not self.close_connection and server.sent < 2**30:
                self._send(file, 0, size)

        def _send(self, file: Path, start: int, end: int) -> None:
            with file.open("rb") as stream:
                stream.seek(start)
                while start < end:
                    block = stream.read(min(2**16, end - start))
                    try:
                        self.wfile.write(block)
                    except ConnectionError:  # who asked wants no more
                        self.close_connection = True
                        return
                    start += len(block)
                    server.sent += len(block)

    with serving(Many(("127.0.0.1", 0), Handler)) as server.url:
        yield server
