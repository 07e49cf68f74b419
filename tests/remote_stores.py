"""Fixtures of the tests of URLs: an S3 with a bucket, and a plain web server."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from remote_servers import BUCKET, Server, s3_server, web_server

__all__ = ["Put", "folder_url", "put", "s3", "s3_running", "stores", "web"]

Put = Callable[[Path], str]
"""Uploads a file or folder by other means than mp4ds, and returns its URL."""


@pytest.fixture(scope="module")
def s3_running() -> Iterator[tuple[Server, Any]]:
    """An S3 with an empty bucket, in the environment as users have theirs."""
    import s3fs

    # The servers of the tests and their clients tell of every failure that is asked for.
    logging.disable(logging.ERROR)
    with s3_server() as server, pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", server.url)
        patch.setenv("AWS_ACCESS_KEY_ID", "tester")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv("AWS_MAX_ATTEMPTS", "2")
        s3fs.S3FileSystem.clear_instance_cache()
        files = s3fs.S3FileSystem(use_listings_cache=False)
        if not files.exists(BUCKET):  # one memory for all servers of a process
            files.mkdir(BUCKET)
        yield server, files
        s3fs.S3FileSystem.clear_instance_cache()
    logging.disable(logging.NOTSET)


@pytest.fixture
def s3(s3_running: tuple[Server, Any]) -> Iterator[Server]:
    """The S3, with nothing heard yet."""
    server, _ = s3_running
    server.forget()
    yield server
    server.forget()


@pytest.fixture
def stores(s3_running: tuple[Server, Any]) -> Any:
    """The files of the S3, by other means than mp4ds."""
    return s3_running[1]


@pytest.fixture
def folder_url(s3: Server) -> str:
    """A folder of the bucket for one test."""
    return f"s3://{BUCKET}/{uuid4().hex}"


@pytest.fixture
def put(stores: Any, s3: Server, folder_url: str) -> Put:
    """Uploads to the test's folder."""

    def upload(path: Path) -> str:
        url = f"{folder_url}/{path.name}"
        stores.put(str(path), url, recursive=path.is_dir())
        s3.forget()
        return url

    return upload


@pytest.fixture
def web(tmp_path: Path) -> Iterator[Server]:
    """A web server of ``tmp_path / "web"``, with nothing heard yet."""
    (tmp_path / "web").mkdir()
    with web_server(tmp_path / "web") as server:
        yield server
