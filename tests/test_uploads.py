"""Datasets and recordings are made for URLs: whole, or visibly not."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import mp4ds
from in_parts import InlineExecutor, facts, use
from mp4ds.cli import commands
from mp4ds.errors import (
    OptionError,
    PartsFailedError,
    RemoteError,
    SourceError,
    TargetError,
    TargetExistsError,
)
from mp4ds.files.uploads import local_path
from mp4ds.files.urls import RemotePath
from mp4ds.packing.options import PackOptions, PackProgress
from mp4ds.packing.pack import pack_each, pack_share
from mp4ds.unpacking.options import UnpackOptions
from remote_servers import Request, Server
from remote_stores import Put, folder_url, put, s3, s3_running, stores
from round_trips import TARGETS, Compare
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


def left(staging: Path) -> list[str]:
    """What is kept here for a later run."""
    return sorted(
        path.relative_to(staging).as_posix() for path in staging.rglob("*") if path.is_file()
    )


def there(stores: Any, url: str) -> set[str]:
    """Names of the files at a URL."""
    key = url.removeprefix("s3://")
    stores.invalidate_cache()
    return {path.removeprefix(key).strip("/") for path in stores.find(key)}


def refusing(name: str, method: str = "PUT") -> Callable[[Request], int | None]:
    """Refuses requests for files of a name."""
    return lambda heard: 403 if heard.method == method and heard.path.endswith(name) else None


def again(stores: Any, url: str, folder: Path, compare: Compare, source: Path) -> list[str]:
    """Differences of a recording from what its dataset at a URL gives."""
    stores.get(url, str(folder), recursive=True)
    assert mp4ds.validate(folder, deep=True) == []
    mp4ds.unpack(folder, "bag", folder.with_suffix(".bag"))
    return compare([source], folder.with_suffix(".bag"))


# ---------------------------------------------------------------- packs


@pytest.mark.parametrize("window", [None, 3])
def test_a_pack_is_uploaded_the_manifest_last(
    window: int | None,
    source: Path,
    folder_url: str,
    stores: Any,
    s3: Server,
    staging: Path,
    tmp_path: Path,
    compare: Compare,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    executor = InlineExecutor()
    use(monkeypatch, executor)
    url = f"{folder_url}/drive"
    told: list[PackProgress] = []
    summary = mp4ds.pack(source, url, replace(FAST, window=window), progress=told.append)
    assert bool(executor.ran) == bool(window)
    assert str(summary.dataset) == url
    assert {str(state.dataset) for state in told} == {url}
    assert "uploading" in {state.phase for state in told}
    assert there(stores, url) == FILES
    assert s3.put()[0] == ".mp4ds-upload"  # shows before the work that it can be uploaded
    assert s3.put()[-1] == "dataset.yaml"
    assert left(staging) == []
    assert mp4ds.validate(url, deep=True) == []
    assert again(stores, url, tmp_path / "back", compare, source) == []
    here = mp4ds.pack(source, tmp_path / "here", replace(FAST, window=window))
    assert facts(tmp_path / "here") == facts(tmp_path / "back")
    assert replace(summary, dataset=here.dataset) == here


def test_large_files_go_in_parts(
    source: Path, folder_url: str, stores: Any, s3: Server, tmp_path: Path
) -> None:
    (tmp_path / "file").write_bytes(os.urandom(40_000_000))
    target = RemotePath(f"{folder_url}/file")
    assert target.upload(tmp_path / "file").stat().st_size == 40_000_000
    assert s3.put().count("file") == 3
    assert stores.cat(target.url) == (tmp_path / "file").read_bytes()


def test_an_existing_dataset_is_kept(
    source: Path, folder_url: str, stores: Any, s3: Server, staging: Path
) -> None:
    url = f"{folder_url}/drive"
    mp4ds.pack(source, url, FAST)
    s3.forget()
    with pytest.raises(TargetExistsError, match=rf"{url}: already exists"):
        mp4ds.pack(source, url, FAST)
    assert s3.put() == []
    assert there(stores, url) == FILES
    assert left(staging) == []


@pytest.mark.parametrize("force", [False, True])
def test_what_mp4ds_did_not_write_is_kept(
    force: bool, source: Path, folder_url: str, stores: Any, s3: Server
) -> None:
    stores.pipe_file(f"{folder_url}/drive/thesis.tex", b"years of work")
    with pytest.raises(TargetError, match=r"exists"):
        mp4ds.pack(source, f"{folder_url}/drive", replace(FAST, force=force))
    assert there(stores, f"{folder_url}/drive") == {"thesis.tex"}


def test_force_replaces_the_manifest_first(
    source: Path, folder_url: str, stores: Any, s3: Server, tmp_path: Path
) -> None:
    url = f"{folder_url}/drive"
    mp4ds.pack(source, url, FAST)
    stores.pipe_file(f"{url}/old.mp4", b"of another pack")
    stores.pipe_file(f"{url}2/cam.mp4", b"a neighbour")
    with pytest.raises(TargetError, match=r"holds 1 item that mp4ds did not write \(old\.mp4\)"):
        mp4ds.pack(source, url, replace(FAST, force=True))
    assert there(stores, url) == {*FILES, "old.mp4"}
    stores.rm_file(f"{url}/old.mp4")
    s3.forget()
    mp4ds.pack(source, url, replace(FAST, force=True, exclude=["/cam/*"]))
    assert there(stores, url) == {"messages.mcap", "dataset.yaml"}
    assert there(stores, f"{url}2") == {"cam.mp4"}
    changes = [
        (method, path.rpartition("/")[2])
        for method, path, _ in s3.requests
        if method in ("PUT", "DELETE")
    ]
    assert changes[2] == ("DELETE", "dataset.yaml")
    assert changes[-1] == ("PUT", "dataset.yaml")
    assert mp4ds.validate(url, deep=True) == []


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["cam_image_raw.mp4", "messages.mcap", "dataset.yaml"])
@pytest.mark.parametrize("replaced", [False, True])
def test_a_failed_upload_keeps_what_was_made(
    name: str,
    replaced: bool,
    source: Path,
    folder_url: str,
    stores: Any,
    s3: Server,
    staging: Path,
    tmp_path: Path,
    compare: Compare,
) -> None:
    url = f"{folder_url}/drive"
    options = replace(FAST, force=replaced)
    if replaced:
        mp4ds.pack(source, url, replace(FAST, exclude=["/imu"]))
    s3.forget()
    s3.fails = refusing(name)
    with pytest.raises(
        TargetError, match=r"\(dataset\.yaml last\), or run the command again"
    ) as failure:
        mp4ds.pack(source, url, options)
    assert f"{url}/{name}: cannot be uploaded: access denied" in str(failure.value)
    assert "dataset.yaml" not in there(stores, url)
    assert there(stores, url) == set()  # what was there is replaced, and of the new one nothing
    (kept,) = staging.glob(f"mp4ds-{os.getuid()}/*/drive")
    assert f"kept in {kept}: copy it with" in str(failure.value)
    assert mp4ds.validate(kept, deep=True) == []
    s3.forget()
    mp4ds.pack(source, url, replace(options, force=False))
    assert there(stores, url) == FILES
    assert left(staging) == []
    assert again(stores, url, tmp_path / "back", compare, source) == []


def test_what_is_uploaded_is_counted(
    source: Path, folder_url: str, s3: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    import s3fs

    async def short(self: Any, local: str, key: str, **_: Any) -> None:
        await self._pipe_file(key, Path(local).read_bytes()[:-1])

    monkeypatch.setattr("s3fs.S3FileSystem._put_file", short)
    s3fs.S3FileSystem.clear_instance_cache()  # their methods are bound when they are made
    with pytest.raises(RemoteError, match=r"could not be uploaded: only \d+ of \d+ bytes arrived"):
        mp4ds.pack(source, f"{folder_url}/drive", FAST)
    s3fs.S3FileSystem.clear_instance_cache()


def test_a_store_that_refuses_is_told_before_the_work(
    source: Path,
    folder_url: str,
    s3: Server,
    staging: Path,
) -> None:
    s3.fails = lambda heard: 403 if heard.method == "PUT" else None
    with pytest.raises(TargetError, match=r"cannot be uploaded: access denied"):
        mp4ds.pack(source, f"{folder_url}/drive", FAST)
    s3.forget()
    with pytest.raises(TargetError, match=r"cannot be uploaded: .*bucket does not exist"):
        mp4ds.pack(source, "s3://nobodys-bucket/drive", FAST)
    with pytest.raises(TargetError, match=r"is an entire bucket\. Give a folder in it"):
        mp4ds.pack(source, "s3://bucket", FAST)
    with pytest.raises(TargetError, match=r"does not accept uploads"):
        mp4ds.pack(source, "https://host/drive", FAST)
    assert left(staging) == []


def test_a_source_that_cannot_be_read_leaves_nothing(
    tmp_path: Path, folder_url: str, stores: Any, s3: Server, staging: Path
) -> None:
    (tmp_path / "broken.bag").write_bytes(b"#ROSBAG V2.0\n broken")
    for name in ("broken.bag", "none.bag"):
        with pytest.raises(SourceError):
            mp4ds.pack(tmp_path / name, f"{folder_url}/drive", FAST)
    assert there(stores, folder_url) == set()
    assert left(staging) == []


def test_a_divided_pack_goes_on(
    source: Path,
    folder_url: str,
    stores: Any,
    s3: Server,
    staging: Path,
    tmp_path: Path,
    compare: Compare,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url, options = f"{folder_url}/drive", replace(FAST, window=3)
    failing = InlineExecutor(lambda task: task == "00001")
    use(monkeypatch, failing)
    with pytest.raises(PartsFailedError):
        mp4ds.pack(source, url, options)
    assert there(stores, url) == set()
    assert any("00000" in name for name in left(staging))
    going_on = InlineExecutor()
    use(monkeypatch, going_on)
    mp4ds.pack(source, url, options)
    assert "00000" not in going_on.ran
    assert left(staging) == []
    assert again(stores, url, tmp_path / "back", compare, source) == []


def test_shares_meet_in_the_temporary_folder(
    source: Path,
    folder_url: str,
    stores: Any,
    s3: Server,
    tmp_path: Path,
    compare: Compare,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url, options = f"{folder_url}/drive", replace(FAST, window=3)
    use(monkeypatch, InlineExecutor())
    for number in (1, 2):
        pack_share(source, url, (number, 2), options)
    mp4ds.pack(source, url, replace(options, join=True))
    assert again(stores, url, tmp_path / "back", compare, source) == []


def test_nothing_to_join(source: Path, folder_url: str, s3: Server, staging: Path) -> None:
    with pytest.raises(OptionError, match=r"nothing to join"):
        mp4ds.pack(source, f"{folder_url}/drive", replace(FAST, join=True))
    assert left(staging) == []


def test_one_dataset_each(
    source: Path, folder_url: str, stores: Any, s3: Server, put: Put, tmp_path: Path
) -> None:
    write_bag(tmp_path / "other.bag", scene("mono8", frames=3))
    urls = [put(source), put(tmp_path / "other.bag")]
    summaries = pack_each(urls, f"{folder_url}/all/", FAST)
    assert [str(summary.dataset) for summary in summaries] == [
        f"{folder_url}/all/drive",
        f"{folder_url}/all/other",
    ]
    assert pack_each(urls, f"{folder_url}/all/", FAST) == []
    stores.put(str(source), urls[1])
    with pytest.raises(TargetExistsError):
        pack_each(urls, f"{folder_url}/all/", FAST)
    assert mp4ds.validate(f"{folder_url}/all") == []


def test_two_at_a_time(source: Path, folder_url: str, s3: Server) -> None:
    folder = local_path(RemotePath(f"{folder_url}/drive")).parent
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(TargetError, match=r"another mp4ds is already making it here"):
            mp4ds.pack(source, f"{folder_url}/drive", FAST)


def test_the_temporary_folder_is_ones_own(
    source: Path, folder_url: str, s3: Server, staging: Path, tmp_path: Path
) -> None:
    (staging / f"mp4ds-{os.getuid()}").symlink_to(tmp_path)
    with pytest.raises(TargetError, match=r"belongs to another user\. Set TMPDIR to another"):
        mp4ds.pack(source, f"{folder_url}/drive", FAST)


# ---------------------------------------------------------------- unpacks


@pytest.mark.parametrize("target", TARGETS)
def test_an_unpack_is_uploaded(
    target: str,
    packed_bag: Path,
    folder_url: str,
    stores: Any,
    s3: Server,
    staging: Path,
    tmp_path: Path,
    compare: Compare,
) -> None:
    to, storage = TARGETS[target]
    name = "again" + {"bag": ".bag", "mcap": ".mcap"}.get(to, "")
    url, options = f"{folder_url}/{name}", UnpackOptions(storage=storage)
    summary = mp4ds.unpack(packed_bag, to, url, options)
    assert str(summary.output) == url
    assert left(staging) == []
    here = mp4ds.unpack(packed_bag, to, tmp_path / name, options)
    assert replace(summary, output=here.output) == here
    if to == "rosbag2":
        assert s3.put()[-1] == "metadata.yaml"
    stores.get(url, str(tmp_path / f"back-{name}"), recursive=to == "rosbag2")
    assert compare([tmp_path / name], tmp_path / f"back-{name}") == []
    with pytest.raises(TargetExistsError):
        mp4ds.unpack(packed_bag, to, url, options)
    mp4ds.unpack(packed_bag, to, url, replace(options, force=True))
    assert not any(path.endswith(".mp4ds-upload") for path in stores.find(folder_url[5:]))


def test_a_file_stays_where_its_replacement_fails(
    packed_bag: Path, folder_url: str, stores: Any, s3: Server
) -> None:
    url = f"{folder_url}/again.bag"
    mp4ds.unpack(packed_bag, "bag", url)
    before = stores.cat(url)
    s3.fails = refusing("again.bag")
    with pytest.raises(TargetError, match=r"The output is kept in"):
        mp4ds.unpack(packed_bag, "bag", url, UnpackOptions(force=True, exclude=["/imu"]))
    assert there(stores, folder_url) == {"again.bag"}
    assert stores.cat(url) == before


def test_images_are_uploaded(
    packed_bag: Path, folder_url: str, stores: Any, s3: Server, tmp_path: Path
) -> None:
    url = f"{folder_url}/pictures"
    s3.fails = refusing("5.png")
    with pytest.raises(TargetError, match=r"with a tool of your choice, or run again\.$"):
        mp4ds.unpack(packed_bag, "images", url)
    assert there(stores, url) == set()
    s3.forget()
    mp4ds.unpack(packed_bag, "images", url)
    mp4ds.unpack(packed_bag, "images", tmp_path / "pictures")
    here = {p.relative_to(tmp_path / "pictures").as_posix(): p.read_bytes() for p in
            (tmp_path / "pictures").rglob("*.*")}  # fmt: skip
    assert {name: stores.cat(f"{url}/{name}") for name in there(stores, url)} == here
    with pytest.raises(TargetExistsError):
        mp4ds.unpack(packed_bag, "images", url)
    mp4ds.unpack(packed_bag, "images", url, UnpackOptions(force=True, image_format="jpeg"))
    assert not any(name.endswith(".png") for name in there(stores, url))


def test_from_a_url_to_a_url(
    packed_bag: Path, put: Put, folder_url: str, stores: Any, tmp_path: Path, compare: Compare
) -> None:
    mp4ds.unpack(put(packed_bag), "bag", f"{folder_url}/again.bag")
    stores.get(f"{folder_url}/again.bag", str(tmp_path / "again.bag"))
    mp4ds.unpack(packed_bag, "bag", tmp_path / "here.bag")
    assert compare([tmp_path / "here.bag"], tmp_path / "again.bag") == []


# ---------------------------------------------------------------- the command line


def test_the_command_line(source: Path, folder_url: str, put: Put, s3: Server) -> None:
    from click.testing import CliRunner

    def run(*arguments: str) -> Any:
        result = CliRunner().invoke(commands, [*arguments, "--json"])
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    recording, dataset = put(source), f"{folder_url}/dataset"
    assert run("info", recording)["path"] == recording
    packed = run("pack", recording, "-o", dataset, "--codec", "h264", "--preset", "ultrafast")
    assert packed["dataset"] == dataset
    assert run("info", dataset)["kind"] == "dataset"
    assert run("info", dataset, "--intrinsics")["path"] == dataset
    assert run("validate", dataset, "--deep") == {"path": dataset, "deep": True, "problems": []}
    again = f"{folder_url}/again.bag"
    assert run("unpack", dataset, "--to", "bag", "-o", again)["output"] == again
    assert run("info", again)["topics"] == run("info", recording)["topics"]


# ---------------------------------------------------------------- folders of images


def test_a_folder_of_images_is_packed_to_a_url(folder_url: str, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    slope = np.add.outer(np.arange(24), np.arange(32)).astype(np.uint8)
    for number in range(3):
        Image.fromarray(slope + number).save(tmp_path / "images" / f"{number}.png")
    options = PackOptions(codec="ffv1", images=mp4ds.ImageFolder(rate="2"))
    mp4ds.pack(tmp_path / "images", f"{folder_url}/ds", options)
    with mp4ds.open(f"{folder_url}/ds") as dataset:
        for number, frame in enumerate(dataset["/camera/image_raw"]):
            assert np.array_equal(frame.data, slope + number)
    with pytest.raises(SourceError, match="Download it first"):
        mp4ds.pack(f"{folder_url}/ds", tmp_path / "ds", options)
