"""Datasets and recordings are made for URLs: whole, or visibly not."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from commands import call
from compare import compare
from in_parts import InlineExecutor, facts, use
from mp4ds.errors import (
    PartsFailedError,
    RemoteError,
    TargetError,
    TargetExistsError,
)
from mp4ds.packing.options import PackOptions, PackProgress
from mp4ds.packing.pack import pack_each
from mp4ds.unpacking.unpack import UnpackOptions
from remote_servers import Request, Server
from remote_stores import Put, folder_url, put, s3, s3_running, stores
from round_trips import TARGETS
from sources import scene, write_bag

__all__ = ["folder_url", "put", "s3", "s3_running", "stores"]

FAST = PackOptions(codec="h264", preset="ultrafast")
FILES = {"cam_image_raw.mp4", "cam_image_raw.yaml", "messages.mcap", "dataset.yaml"}


@pytest.fixture(autouse=True)
def staging(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The system's temporary folder for one test."""
    folder = tmp_path / "staging"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


@pytest.fixture
def source(tmp_path: Path) -> Path:
    write_bag(tmp_path / "drive.bag", scene("bayer_rggb8", frames=9))
    return tmp_path / "drive.bag"


@dataclass
class Store:
    """A folder of the S3, and what else a test looks at.

    Attributes:
        folder: Its URL.
        files: All files of the S3, by other means than mp4ds.
        server: What it was asked for.
        staging: The system's temporary folder.
    """

    folder: str
    files: Any
    server: Server
    staging: Path

    @property
    def url(self) -> str:
        """Where the dataset goes."""
        return f"{self.folder}/drive"

    def names(self, url: str = "") -> set[str]:
        """Names of the files at a URL, without one those of the dataset."""
        key = (url or self.url).removeprefix("s3://")
        self.files.invalidate_cache()
        return {path.removeprefix(key).strip("/") for path in self.files.find(key)}

    def kept(self) -> list[str]:
        """What is kept here for a later run."""
        paths = (path for path in self.staging.rglob("*") if path.is_file())
        return sorted(path.relative_to(self.staging).as_posix() for path in paths)

    def unpacked(self) -> Path:
        """What the dataset gives, copied here, as a bag."""
        back = self.staging.parent / "back"
        self.files.get(self.url, str(back), recursive=True)
        assert mp4ds.validate(back, deep=True) == []
        mp4ds.unpack(back, "bag", back.with_suffix(".bag"))
        return back.with_suffix(".bag")


@pytest.fixture
def store(folder_url: str, stores: Any, s3: Server, staging: Path) -> Store:
    return Store(folder_url, stores, s3, staging)


def refusing(name: str, method: str = "PUT") -> Callable[[Request], int | None]:
    """Refuses requests for files of a name."""
    return lambda heard: 403 if heard.method == method and heard.path.endswith(name) else None


# ---------------------------------------------------------------- packs


@pytest.mark.parametrize("window", [None, 3])
def test_a_pack_is_uploaded_the_manifest_last(
    window: int | None,
    source: Path,
    store: Store,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    executor = use(monkeypatch, InlineExecutor())
    told: list[PackProgress] = []
    summary = mp4ds.pack(source, store.url, replace(FAST, window=window), progress=told.append)
    assert bool(executor.ran) == bool(window)
    assert str(summary.dataset) == store.url
    assert {str(state.dataset) for state in told} == {store.url}
    assert "uploading" in {state.phase for state in told}
    assert store.names() == FILES
    assert store.server.put()[0] == ".mp4ds-upload"  # shows before the work that it can be uploaded
    assert store.server.put()[-1] == "dataset.yaml"
    assert store.kept() == []
    assert mp4ds.validate(store.url, deep=True) == []
    assert compare([source], store.unpacked()) == []
    here = mp4ds.pack(source, tmp_path / "here", replace(FAST, window=window))
    assert facts(tmp_path / "here") == facts(tmp_path / "back")
    assert replace(summary, dataset=here.dataset) == here


@pytest.mark.parametrize("force", [False, True])
def test_what_is_there_is_kept(force: bool, source: Path, store: Store) -> None:
    store.files.pipe_file(f"{store.url}/thesis.tex", b"years of work")
    store.server.forget()
    with pytest.raises(TargetError, match=rf"{store.url}: (already )?exists"):
        mp4ds.pack(source, store.url, replace(FAST, force=force))
    assert store.server.put() == []
    assert store.names() == {"thesis.tex"}
    assert store.kept() == []


def test_force_replaces_the_manifest_first(source: Path, store: Store) -> None:
    mp4ds.pack(source, store.url, FAST)
    store.server.forget()
    with pytest.raises(TargetExistsError, match=rf"{store.url}: already exists"):
        mp4ds.pack(source, store.url, FAST)
    assert (store.server.put(), store.names()) == ([], FILES)
    store.files.pipe_file(f"{store.url}/old.mp4", b"of another pack")
    store.files.pipe_file(f"{store.url}2/cam.mp4", b"a neighbour")
    with pytest.raises(TargetError, match=r"holds 1 item that mp4ds did not write \(old\.mp4\)"):
        mp4ds.pack(source, store.url, replace(FAST, force=True))
    assert store.names() == {*FILES, "old.mp4"}
    store.files.rm_file(f"{store.url}/old.mp4")
    store.server.forget()
    mp4ds.pack(source, store.url, replace(FAST, force=True, exclude=["/cam/*"]))
    assert store.names() == {"messages.mcap", "dataset.yaml"}
    assert store.names(f"{store.url}2") == {"cam.mp4"}
    changes = [
        (method, path.rpartition("/")[2])
        for method, path, _ in store.server.requests
        if method in ("PUT", "DELETE")
    ]
    assert changes[2] == ("DELETE", "dataset.yaml")
    assert changes[-1] == ("PUT", "dataset.yaml")
    assert mp4ds.validate(store.url, deep=True) == []


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["cam_image_raw.mp4", "messages.mcap", "dataset.yaml"])
@pytest.mark.parametrize("replaced", [False, True])
def test_a_failed_upload_keeps_what_was_made(
    name: str, replaced: bool, source: Path, store: Store
) -> None:
    options = replace(FAST, force=replaced)
    if replaced:
        mp4ds.pack(source, store.url, replace(FAST, exclude=["/imu"]))
    store.server.forget()
    store.server.fails = refusing(name)
    with pytest.raises(
        TargetError, match=r"\(dataset\.yaml last\), or run the command again"
    ) as failure:
        mp4ds.pack(source, store.url, options)
    assert f"{store.url}/{name}: cannot be uploaded: access denied" in str(failure.value)
    assert store.names() == set()  # what was there is replaced, and of the new one nothing
    (kept,) = store.staging.glob(f"mp4ds-{os.getuid()}/*/drive")
    assert f"kept in {kept}: copy it with" in str(failure.value)
    assert mp4ds.validate(kept, deep=True) == []
    store.server.forget()
    mp4ds.pack(source, store.url, replace(options, force=False))
    assert store.names() == FILES
    assert store.kept() == []
    assert compare([source], store.unpacked()) == []


def test_what_is_uploaded_is_counted(
    source: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    import s3fs

    async def short(self: Any, local: str, key: str, **_: Any) -> None:
        await self._pipe_file(key, Path(local).read_bytes()[:-1])

    monkeypatch.setattr("s3fs.S3FileSystem._put_file", short)
    s3fs.S3FileSystem.clear_instance_cache()  # their methods are bound when they are made
    with pytest.raises(RemoteError, match=r"could not be uploaded: only \d+ of \d+ bytes arrived"):
        mp4ds.pack(source, store.url, FAST)
    s3fs.S3FileSystem.clear_instance_cache()


def test_a_store_that_refuses_is_told_before_the_work(source: Path, store: Store) -> None:
    store.server.fails = lambda heard: 403 if heard.method == "PUT" else None
    with pytest.raises(TargetError, match=r"cannot be uploaded: access denied"):
        mp4ds.pack(source, store.url, FAST)
    store.server.forget()
    for url, words in (
        ("s3://nobodys-bucket/drive", r"cannot be uploaded: .*bucket does not exist"),
        ("s3://bucket", r"is an entire bucket\. Give a folder in it"),
        ("https://host/drive", "does not accept uploads"),
    ):
        with pytest.raises(TargetError, match=words):
            mp4ds.pack(source, url, FAST)
    assert store.kept() == []


def test_a_divided_pack_goes_on(
    source: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = replace(FAST, window=3)
    use(monkeypatch, InlineExecutor(lambda task: task == "00001"))
    with pytest.raises(PartsFailedError):
        mp4ds.pack(source, store.url, options)
    assert store.names() == set()
    assert any("00000" in name for name in store.kept())
    going_on = use(monkeypatch, InlineExecutor())
    mp4ds.pack(source, store.url, options)
    assert "00000" not in going_on.ran
    assert store.kept() == []
    assert compare([source], store.unpacked()) == []


def test_one_dataset_each(source: Path, store: Store, put: Put, tmp_path: Path) -> None:
    write_bag(tmp_path / "other.bag", scene("mono8", frames=3))
    urls, folder = [put(source), put(tmp_path / "other.bag")], f"{store.folder}/all"
    made = [str(summary.dataset) for summary in pack_each(urls, f"{folder}/", FAST)]
    assert made == [f"{folder}/drive", f"{folder}/other"]
    assert pack_each(urls, f"{folder}/", FAST) == []
    store.files.put(str(source), urls[1])
    with pytest.raises(TargetExistsError):
        pack_each(urls, f"{folder}/", FAST)
    assert mp4ds.validate(folder) == []


def test_the_temporary_folder_is_ones_own(source: Path, store: Store, tmp_path: Path) -> None:
    (store.staging / f"mp4ds-{os.getuid()}").symlink_to(tmp_path)
    with pytest.raises(TargetError, match=r"belongs to another user\. Set TMPDIR to another"):
        mp4ds.pack(source, store.url, FAST)


# ---------------------------------------------------------------- unpacks


@pytest.mark.one_in(2)
@pytest.mark.parametrize("target", TARGETS)
def test_an_unpack_is_uploaded(target: str, packed_bag: Path, store: Store, tmp_path: Path) -> None:
    to, storage = TARGETS[target]
    name = "again" + {"bag": ".bag", "mcap": ".mcap"}.get(to, "")
    url, options = f"{store.folder}/{name}", UnpackOptions(storage=storage)
    summary = mp4ds.unpack(packed_bag, to, url, options)
    assert str(summary.output) == url
    assert store.kept() == []
    here = mp4ds.unpack(packed_bag, to, tmp_path / name, options)
    assert replace(summary, output=here.output) == here
    if to == "rosbag2":
        assert store.server.put()[-1] == "metadata.yaml"
    store.files.get(url, str(tmp_path / f"back-{name}"), recursive=to == "rosbag2")
    assert compare([tmp_path / name], tmp_path / f"back-{name}") == []
    with pytest.raises(TargetExistsError):
        mp4ds.unpack(packed_bag, to, url, options)
    mp4ds.unpack(packed_bag, to, url, replace(options, force=True))
    assert not any(name.endswith(".mp4ds-upload") for name in store.names(store.folder))


def test_images_are_uploaded(packed_bag: Path, store: Store, tmp_path: Path) -> None:
    url = store.url
    store.server.fails = refusing("5.png")
    with pytest.raises(TargetError, match=r"with a tool of your choice, or run again\.$"):
        mp4ds.unpack(packed_bag, "images", url)
    assert store.names() == set()
    store.server.forget()
    mp4ds.unpack(packed_bag, "images", url)
    local = tmp_path / "pictures"
    mp4ds.unpack(packed_bag, "images", local)
    here = {path.relative_to(local).as_posix(): path.read_bytes() for path in local.rglob("*.*")}
    assert {name: store.files.cat(f"{url}/{name}") for name in store.names()} == here
    with pytest.raises(TargetExistsError):
        mp4ds.unpack(packed_bag, "images", url)
    mp4ds.unpack(packed_bag, "images", url, UnpackOptions(force=True, image_format="jpeg"))
    assert not any(name.endswith(".png") for name in store.names())


def test_the_command_line(source: Path, folder_url: str, put: Put, s3: Server) -> None:
    def run(*arguments: str) -> Any:
        result = call(*arguments, "--json")
        assert result.code == 0, result.err
        return json.loads(result.out)

    recording, dataset = put(source), f"{folder_url}/dataset"
    assert run("info", recording)["path"] == recording
    packed = run("pack", recording, "-o", dataset, "--codec", "h264", "--preset", "ultrafast")
    assert packed["dataset"] == dataset
    assert run("info", dataset)["kind"] == "dataset"
    assert run("validate", dataset, "--deep") == {
        "path": dataset,
        "deep": True,
        "problems": [],
        "absent": "",
        "reduced": "",
    }
    again = f"{folder_url}/again.bag"
    assert run("unpack", dataset, "--to", "bag", "-o", again)["output"] == again
    assert run("info", again)["topics"] == run("info", recording)["topics"]
