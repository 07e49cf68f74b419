"""Recordings and datasets are read at URLs as they are here, and no more of them than is needed."""

from __future__ import annotations

import random
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mp4ds
from commands import call, program, refused
from compare import compare
from in_parts import InlineExecutor, leftovers, use
from mp4ds.bags.formats import open_sources
from mp4ds.errors import OptionError, PartsFailedError, RemoteError, SourceError
from mp4ds.files.ranges import BLOCK, KEPT_BYTES, Blocks, RemoteFile
from mp4ds.packing.options import PackOptions
from mp4ds.packing.packer import Packer
from mp4ds.plugins.info import info
from mp4ds.records import Message
from remote_servers import Request, Server, web_server
from remote_stores import Put, folder_url, put, s3, s3_running, stores, web
from round_trips import own_target, unpacked
from sources import SOURCES, Scene, scene, write_bag, write_mcap

__all__ = ["folder_url", "put", "s3", "s3_running", "stores", "web"]

TOPIC = "/cam/image_raw"
SECRET = "X-Amz-Signature=4711"


@pytest.fixture
def executor(monkeypatch: pytest.MonkeyPatch) -> InlineExecutor:
    return use(monkeypatch, InlineExecutor())


def large_scene() -> Scene:
    """Noise of 196 kB an image, which no compression makes smaller."""
    return scene("mono8", frames=60, width=512, height=384)


def covered(ranges: Sequence[tuple[int, int]]) -> int:
    """Bytes that ranges have in all."""
    return sum(end - start for start, end in ranges)


# ---------------------------------------------------------------- names


def test_nothing_of_it_is_imported_for_local_paths(packed_bag: Path) -> None:
    code = (
        "import sys, mp4ds, mp4ds.cli\n"
        "from mp4ds.plugins.info import info\n"
        f"info({str(packed_bag)!r}), mp4ds.validate({str(packed_bag)!r})\n"
        "print({'fsspec', 's3fs', 'aiohttp', 'asyncio'} & set(sys.modules))\n"
    )
    assert program("-c", code).out.strip() == "set()"


# ---------------------------------------------------------------- a file by ranges


class Origin:
    """A file that is somewhere else, and what was fetched of it."""

    def __init__(self, size: int) -> None:
        self.data = random.Random(size).randbytes(size)
        self.fetched: list[tuple[int, int]] = []
        self.blocks = Blocks()

    def fetch(self, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        self.fetched += ranges
        assert all(0 <= start < end <= len(self.data) for start, end in ranges)
        return [self.data[start:end] for start, end in ranges]

    def open(self) -> RemoteFile:
        return RemoteFile(len(self.data), self.fetch, self.blocks)


RANGES = st.lists(st.tuples(st.integers(0, 600_000), st.integers(1, 300_000)), max_size=8)


@settings(deadline=None)
@given(
    size=st.sampled_from([0, 1, 100, 2**17, 700_001]),
    passes=st.lists(
        st.tuples(RANGES, st.lists(st.tuples(st.integers(0, 800_000), st.integers(-1, 400_000)))),
        min_size=1,
        max_size=4,
    ),
)
def test_reads_are_exact_whatever_was_announced(size: int, passes: Any) -> None:
    origin = Origin(size)
    for announced, reads in passes:
        with origin.open() as stream:
            stream.expect([(start, start + length) for start, length in announced])
            for place, length in reads:
                stream.seek(place)
                end = None if length < 0 else place + length
                assert stream.read(length) == origin.data[place:end]
                assert stream.tell() == max(place, size if end is None else min(end, size))
    assert len(origin.fetched) <= sum(len(a) + 2 * len(r) for a, r in passes) + 8


def kept(blocks: Blocks) -> int:
    """Bytes of a file of `3 * KEPT_BYTES` that are kept."""
    return BLOCK * sum(number in blocks for number in range(3 * KEPT_BYTES // BLOCK))


def test_of_a_file_that_is_read_little_is_kept() -> None:
    origin = Origin(3 * KEPT_BYTES)
    with origin.open() as stream:
        stream.read()
        assert kept(origin.blocks) <= KEPT_BYTES
    assert kept(origin.blocks) <= 2**20


# ---------------------------------------------------------------- recordings


def round_trip(paths: Sequence[Path], urls: Sequence[str], folder: Path, source: str) -> None:
    mp4ds.pack(urls, folder / "dataset", PackOptions(window=3))
    assert mp4ds.validate(folder / "dataset", deep=True) == []
    assert compare(paths, unpacked(folder, own_target(source))) == []


def some(first: int) -> list[Any]:
    """Every source, of which all but every tenth are slow."""
    marks = [[] if n % 10 == first else [pytest.mark.slow] for n in range(len(SOURCES))]
    return [pytest.param(name, marks=mark) for name, mark in zip(SOURCES, marks, strict=True)]


@pytest.mark.parametrize("source", some(0))
def test_every_source_in_a_store(
    source: str, tmp_path: Path, put: Put, executor: InlineExecutor
) -> None:
    paths = SOURCES[source](tmp_path / "source", scene("bayer_rggb8", frames=7))
    round_trip(paths, [put(path) for path in paths], tmp_path, source)


@pytest.mark.parametrize("source", some(1))
def test_every_source_on_a_web_server(
    source: str, tmp_path: Path, web: Server, executor: InlineExecutor
) -> None:
    paths = SOURCES[source](tmp_path / "web", scene("bayer_rggb8", frames=7))
    round_trip(paths, [f"{web.url}/{path.name}" for path in paths], tmp_path, source)


@pytest.mark.slow
def test_windows_are_packed_by_other_processes(tmp_path: Path, put: Put) -> None:
    write_bag(tmp_path / "drive.bag", scene("mono8", frames=6))
    mp4ds.pack(put(tmp_path / "drive.bag"), tmp_path / "dataset", PackOptions(window=3, jobs=1))
    assert compare([tmp_path / "drive.bag"], unpacked(tmp_path, "bag")) == []


@pytest.mark.parametrize("source", ["bag-lz4", "mcap-ros2-zstd", "rosbag2-mcap-split"])
def test_info_says_the_same(source: str, tmp_path: Path, web: Server, put: Put) -> None:
    (path,) = SOURCES[source](tmp_path / "web", scene("mono8"))
    here = info(path)
    for url in (put(path), f"{web.url}/{path.name}"):
        there = info(url)
        assert str(there.path) == url
        there.path = path
        assert there == here


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a bag and an MCAP file of 12 MB."""
    folder = tmp_path_factory.mktemp("large")
    write_bag(folder / "drive.bag", large_scene(), chunk_size=400_000)
    write_mcap(folder / "drive.mcap", large_scene())
    return folder


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap"])
def test_info_reads_the_ends_and_the_index(name: str, large: Path) -> None:
    with web_server(large) as web:
        found = info(f"{web.url}/{name}")
        assert found.topics == info(large / name).topics
        size = (large / name).stat().st_size
        assert covered(web.fetched(name)) < 0.2 * size  # of several GB, the same few chunks


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap", "dataset"])
def test_a_slice_fetches_what_is_in_it(name: str, large: Path, tmp_path: Path) -> None:
    """Of a dataset whole groups of pictures; it is given as the recording's own slice."""
    if name == "dataset":
        (tmp_path / "there").mkdir()
        mp4ds.pack(large / "drive.bag", tmp_path / "there" / name, PackOptions(gop=4))
    with open_sources([large / "drive.bag"]) as reader:
        (channel,) = (channel for channel in reader.channels if channel.topic == TOPIC)
        times = reader.times()[channel.id]
    start, end = int(times[30]), int(times[36])
    folder = tmp_path / "there" if name == "dataset" else large
    with web_server(folder) as web:
        span = PackOptions(start=str(start), end=str(end), latched=False)
        mp4ds.pack(f"{web.url}/{name}", tmp_path / "slice", span)
        names = ["image_raw.mp4"] if name == "dataset" else [name]
        fetched = sum(covered(web.fetched(ending)) for ending in names)
    size = sum(path.stat().st_size for path in (folder / name).glob("*.mp4"))
    assert 0 < fetched < 0.5 * (size or (large / name).stat().st_size)
    source = large / ("drive.mcap" if name == "drive.mcap" else "drive.bag")
    mp4ds.unpack(tmp_path / "slice", None, tmp_path / ("again" + source.suffix))
    assert compare(source, tmp_path / ("again" + source.suffix), start=start, end=end) == []


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap"])
def test_a_pass_fetches_the_file_once(name: str, large: Path, tmp_path: Path) -> None:
    """It is hashed, too; some is read before, for planning."""
    with web_server(large) as web:
        fast = PackOptions(jobs=1, codec="h264", preset="ultrafast")
        mp4ds.pack(f"{web.url}/{name}", tmp_path / "dataset", fast)
        size = (large / name).stat().st_size
        assert size <= covered(web.fetched(name)) < 1.3 * size


def test_a_database_comes_with_what_is_beside_it(tmp_path: Path, put: Put) -> None:
    (path,) = SOURCES["rosbag2-sqlite3-v9"](tmp_path, scene("mono8"))
    (database,) = path.glob("*.db3")
    journal = database.with_name(f"{database.name}-journal")
    journal.write_bytes(b"\xd9\xd5\x05\xf9 not a journal")
    for where in (path, put(path)):
        with pytest.raises(SourceError, match=r"was not closed properly"):
            info(where)


# ---------------------------------------------------------------- datasets


@pytest.fixture(params=["s3", "web"])
def dataset_url(
    request: pytest.FixtureRequest, packed_bag: Path, put: Put
) -> Iterator[tuple[str, Path, Server]]:
    if request.param == "s3":
        yield put(packed_bag), packed_bag, request.getfixturevalue("s3")
    else:
        with web_server(packed_bag.parent) as web:
            yield f"{web.url}/{packed_bag.name}", packed_bag, web


def test_a_dataset_is_used_there_as_here(
    dataset_url: tuple[str, Path, Server], tmp_path: Path
) -> None:
    url, here, _ = dataset_url
    with mp4ds.open(url) as there, mp4ds.open(here) as local:
        assert there.topics == local.topics
        for number in (5, 0, -1):
            assert np.array_equal(there[TOPIC][number].data, local[TOPIC][number].data)
        for ours, theirs in zip(there.records(), local.records(), strict=True):
            if isinstance(ours, Message):
                assert bytes(ours.data) == bytes(theirs.data)  # type: ignore[union-attr]
    with mp4ds.open(f"{url}/cam_image_raw.mp4") as alone:
        assert len(alone[TOPIC]) == 8
    assert mp4ds.validate(url, deep=True) == []
    assert mp4ds.validate(f"{url}/cam_image_raw.yaml", deep=True) == []
    facts = info(url)
    assert facts.kind == "dataset"
    assert (facts.topics, facts.bytes) == (info(here).topics, info(here).bytes)
    mp4ds.unpack(url, "bag", tmp_path / "again.bag")
    mp4ds.unpack(here, "bag", tmp_path / "local.bag")
    assert compare([tmp_path / "again.bag"], tmp_path / "local.bag") == []


def test_problems_of_a_dataset_are_found_there(
    packed_bag: Path, put: Put, stores: Any, s3: Server
) -> None:
    url = put(packed_bag)
    stores.pipe_file(f"{url}/stray.mp4", b"x")
    stores.pipe_file(f"{url}/messages.mcap", b"x")
    codes = {problem.code for problem in mp4ds.validate(url)}
    assert codes == {"file-unlisted", "size-mismatch"}
    stores.rm_file(f"{url}/messages.mcap")
    assert "file-missing" in {problem.code for problem in mp4ds.validate(url)}
    assert mp4ds.validate(url.rpartition("/")[0]) != []  # the folder that it is in


# ---------------------------------------------------------------- failures


@pytest.mark.parametrize("command", [["info"], ["validate"], ["pack", "-o", "x"]])
def test_what_is_not_there_or_refused(
    command: list[str], folder_url: str, s3: Server, web: Server
) -> None:
    for url in (f"{folder_url}/none.bag", "s3://nobody/none.bag", f"{web.url}/none.bag"):
        refused(call(*command, url), 2, f"{url}: no such file or folder. Check the path.")
    for server, url in ((s3, "s3://bucket/x.bag"), (web, f"{web.url}/x.bag")):
        server.fails = lambda _: 403
        refused(call(*command, url), 2, f"{url}: cannot be read: access denied: ", "403")


@pytest.mark.parametrize(
    "words",
    ["pack", "pack --shard 1/2", "pack several/", "unpack --to bag several/", "export tum"],
)
def test_outputs_are_local(words: str, packed_bag: Path, tmp_path: Path) -> None:
    command, *rest = words.split()
    url = "s3://bucket/" + (rest.pop() if words.endswith("/") else "out")
    source = packed_bag
    if command == "pack":
        source = tmp_path / "drive.bag"
        write_bag(source, scene("mono8"))
    result = call(command, *rest, source, "-o", url)
    refused(result, 2, "mp4ds: s3://bucket/", "is a URL, and outputs are written to local folders")
    assert [path.name for path in tmp_path.iterdir()] in ([], ["drive.bag"])


def test_a_connection_that_is_closed_early(web: Server, tmp_path: Path) -> None:
    write_bag(tmp_path / "web" / "early.bag", scene("mono8"))
    web.breaks_off = True
    said = call("info", f"{web.url}/early.bag")
    refused(said, 1, "could not be read: the server closed the connection before it had sent all. ")
    assert not re.search(r"\b400\b", said.err)  # nor a port with these digits


def test_without_credentials(s3: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    import s3fs

    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    s3fs.S3FileSystem.clear_instance_cache()
    said = call("info", "s3://bucket/x.bag")
    s3fs.S3FileSystem.clear_instance_cache()
    refused(said, 2, "access denied: Unable to locate credentials")


def test_a_server_that_is_not_there() -> None:
    url = "http://127.0.0.1:9/x.bag"
    refused(call("info", url), 1, f"{url}: could not be read: ", "Check the network")


@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap", "drive.db3"])
def test_a_server_without_ranges(name: str, tmp_path: Path) -> None:
    with (tmp_path / name).open("wb") as stream:
        stream.truncate(2**30)
    with web_server(tmp_path, ranges=False) as web:
        for look in (info, lambda url: mp4ds.pack(url, tmp_path / "x")):
            with pytest.raises(SourceError, match=r"does not support range requests\. Download it"):
                look(f"{web.url}/{name}")
        assert web.sent < 2**26  # what is under way when the connection is closed


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", ["drive.bag", "drive.mcap"])
@pytest.mark.parametrize("after", [3, 8, 20])
def test_a_network_that_fails_is_no_damage(
    name: str, after: int, large: Path, tmp_path: Path
) -> None:
    with web_server(large) as web:
        web.fails = lambda _: 500 if len(web.requests) > after else None
        with pytest.raises(RemoteError, match=r"could not be read: 500 Internal Server Error"):
            mp4ds.pack(f"{web.url}/{name}", tmp_path / "dataset")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_network_that_fails_while_a_video_is_read(
    packed_bag: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with web_server(packed_bag.parent) as web:
        assert mp4ds.validate(f"{web.url}/{packed_bag.name}", deep=True) == []
        requests = len(web.requests)
    for after in range(2, requests - 1, 3):
        with web_server(packed_bag.parent) as web:
            url = f"{web.url}/{packed_bag.name}"

            def fails(_: Request, web: Server = web, after: int = after) -> int | None:
                return 500 if len(web.requests) > after else None

            web.fails = fails
            with pytest.raises(RemoteError, match=r"could not be read"):
                mp4ds.validate(url, deep=True)
    assert capfd.readouterr().err == ""


def test_a_recording_that_changes_while_it_is_packed(
    tmp_path: Path, put: Put, stores: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bag(tmp_path / "drive.bag", scene("mono8", frames=9))
    write_bag(tmp_path / "other.bag", scene("mono8", frames=9, seed=1))
    url = put(tmp_path / "drive.bag")
    run = Packer.run

    def changing(packer: Packer) -> Any:
        made = run(packer)
        stores.put(str(tmp_path / "other.bag"), url)
        return made

    monkeypatch.setattr(Packer, "run", changing)
    with pytest.raises(SourceError, match=r"changed while it was being read"):
        mp4ds.pack(url, tmp_path / "dataset")
    assert leftovers(tmp_path) == []


def test_secrets_are_sent_and_not_told(tmp_path: Path, web: Server) -> None:
    """The query goes with every request."""
    write_mcap(tmp_path / "web" / "x.mcap", scene("mono8"))
    (tmp_path / "web" / "x.bag").write_bytes(b"nonsense")
    assert info(f"{web.url}/x.mcap?{SECRET}").topics
    for fails in (lambda _: None, lambda _: 403, lambda _: 500):
        web.fails = fails
        said = call("info", f"{web.url}/x.bag?{SECRET}")
        assert "x.bag" in said.err
        assert "4711" not in said.out + said.err
    assert {path.partition("?")[2] for _, path, _ in web.requests} == {SECRET}


def test_a_signed_address_goes_on_while_it_is_the_same(
    tmp_path: Path, web: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bag(tmp_path / "web" / "x.bag", scene("mono8", frames=9))
    url, dataset = f"{web.url}/x.bag?{SECRET}", tmp_path / "dataset"
    use(monkeypatch, InlineExecutor(lambda task: task == "00001"))
    with pytest.raises(PartsFailedError):
        mp4ds.pack(url, dataset, PackOptions(window=3))
    with pytest.raises(OptionError, match=r"unfinished pack of http.*/x\.bag\.") as refusal:
        mp4ds.pack(f"{web.url}/x.bag?other", dataset, PackOptions(window=3))
    assert "4711" not in str(refusal.value)
    going_on = use(monkeypatch, InlineExecutor())
    mp4ds.pack(url, dataset, PackOptions(window=3))
    assert "00000" not in going_on.ran


# ---------------------------------------------------------------- what is installed


@pytest.mark.parametrize(
    ("url", "module", "remedy"),
    [
        ("s3://bucket/x.bag", "fsspec", r"pip install 'mp4ds\[remote\]'"),
        ("s3://bucket/x.bag", "s3fs", r"pip install 'mp4ds\[remote\]'"),
        ("https://host/x.bag", "fsspec.implementations.http", r"pip install 'mp4ds\[remote\]'"),
        ("gs://bucket/x.bag", "gcsfs", "gcsfs"),
    ],
)
def test_without_a_stores_package(
    url: str, module: str, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("fsspec")
    for name in ("_registry", "registry"):  # what was found before
        monkeypatch.setattr(sys.modules["fsspec.registry"], name, {})
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(OptionError, match=remedy):
        info(url)


def test_a_frame_costs_its_group_of_pictures(tmp_path: Path) -> None:
    """One of 12 groups of some 250 kB, and the index."""
    source = scene("mono8", frames=48, width=320, height=240)
    (path,) = SOURCES["mcap-ros2-none"](tmp_path / "source", source)
    mp4ds.pack(path, tmp_path / "drive", PackOptions(codec="h264", gop=4))
    with web_server(tmp_path) as web, mp4ds.open(f"{web.url}/drive") as dataset:
        stream = dataset[TOPIC]
        name = f"drive/{stream.streams[0].video_path.name}"
        with mp4ds.open(tmp_path / "drive") as here:
            expected = [here[TOPIC][number].data for number in (25, 26)]
        size = (tmp_path / name).stat().st_size
        assert np.array_equal(stream[25].data, expected[0])
        first = covered(web.fetched(name))
        assert first < 0.25 * size
        assert np.array_equal(stream[26].data, expected[1])  # goes on from there
        assert covered(web.fetched(name)) - first < 0.05 * size
