"""Calls on the workers of a Dask cluster, and what becomes of them when machines die."""

from __future__ import annotations

import re
import socket
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, as_completed, wait
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

import clusters
from clusters import WITH_NANNY, RealCluster
from mp4ds.errors import OptionError, RemoteError
from mp4ds.packing.options import plugin
from mp4ds.plugins import cluster as access
from mp4ds.plugins.cluster import cluster_executor
from waiting import until


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCluster]:
    """One that no test harms."""
    with RealCluster(tmp_path_factory.mktemp("cluster")) as cluster:
        yield cluster


def numbered(count: int) -> list[str]:
    return [f"{number:03}" for number in range(count)]


def errors(
    executor: AbstractContextManager[Executor],
    function: Callable[[str, str], None],
    folder: Path,
    *names: str,
) -> dict[str, BaseException]:
    """Make a call for each name; by name, their errors."""
    with executor as opened:
        calls = {name: opened.submit(function, str(folder), name) for name in names}
        found = {name: call.exception() for name, call in calls.items()}
    return {name: error for name, error in found.items() if error is not None}


def results(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("[0-9]*") if not path.suffix}


def started(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.by-*"))


# ---------------------------------------------------------------- calls


def test_all_calls_are_made(cluster: RealCluster, tmp_path: Path) -> None:
    names = numbered(12)
    executor = cluster_executor(cluster.address)
    assert not errors(executor, clusters.write, tmp_path, *names)
    assert results(tmp_path) == {name: clusters.result(name) for name in names}
    assert len({path.suffix for path in started(tmp_path)}) == 2  # processes: both worked
    assert len(started(tmp_path)) == len(names)  # once each


def test_an_error_of_the_caller_drops_what_waits_and_leaves_the_cluster(
    cluster: RealCluster, tmp_path: Path
) -> None:
    with pytest.raises(KeyError), cluster_executor(cluster.address) as executor:  # noqa: PT012
        calls = [executor.submit(clusters.write, str(tmp_path), name) for name in numbered(50)]
        next(as_completed(calls)).result()
        raise KeyError
    begun = len(started(tmp_path))
    time.sleep(4 * clusters.SECONDS)
    assert len(started(tmp_path)) <= begun + 2  # those that workers had fetched
    (tmp_path / "next").mkdir()
    executor = cluster_executor(cluster.address)
    assert not errors(executor, clusters.write, tmp_path / "next", *numbered(4))
    assert cluster.scheduler.poll() is None
    assert all(worker.poll() is None for worker in cluster.workers)


# ---------------------------------------------------------------- deaths


@pytest.mark.slow
def test_calls_of_a_killed_worker_are_made_on_another(tmp_path: Path) -> None:
    names = numbered(8)
    with (
        RealCluster(tmp_path / "dask") as cluster,
        cluster_executor(cluster.address) as executor,
    ):
        calls = [executor.submit(clusters.write, str(tmp_path), name) for name in names]
        next(as_completed(calls))
        victim = cluster.workers[0]
        mine = f"*.by-{victim.pid}"

        def is_at_work() -> bool:
            return any(not path.with_suffix("").exists() for path in tmp_path.glob(mine))

        until(is_at_work)
        victim.kill()
        unfinished = [p.stem for p in tmp_path.glob(mine) if not p.with_suffix("").exists()]
        assert unfinished
        assert [call.exception() for call in calls] == [None] * 8
    assert results(tmp_path) == {name: clusters.result(name) for name in names}
    for name in unfinished:
        assert len(list(tmp_path.glob(f"{name}.by-*"))) == 2


@pytest.mark.slow
def test_a_call_that_kills_its_workers_is_given_up(tmp_path: Path) -> None:
    config = {
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
        "DASK_DISTRIBUTED__SCHEDULER__WORKER_SATURATION": "1.0",
    }
    # more workers than it kills: on a loaded machine a nanny may not bring one back
    with RealCluster(tmp_path / "dask", workers=3, arguments=WITH_NANNY, config=config) as cluster:
        executor = cluster_executor(cluster.address)
        found = errors(executor, clusters.die, tmp_path, "deadly", *numbered(6))
    assert set(found) == {"deadly"}
    assert re.search("2 different workers, but all those workers died", str(found["deadly"]))


@pytest.mark.slow
def test_a_lost_scheduler_cancels_calls(tmp_path: Path) -> None:
    with (
        RealCluster(tmp_path / "dask") as cluster,
        cluster_executor(cluster.address) as executor,
    ):
        calls = [executor.submit(clusters.write, str(tmp_path), name) for name in numbered(8)]
        next(as_completed(calls))
        cluster.scheduler.kill()
        wait(calls)
        assert any(call.cancelled() for call in calls)


def test_a_cluster_without_workers_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "_WORKER_SECONDS", 1.0)
    with (
        RealCluster(tmp_path / "dask", workers=0) as cluster,
        pytest.raises(RemoteError, match=r"has had no worker for 1 s\. Start some"),
        cluster_executor(cluster.address),
    ):
        pass


# ---------------------------------------------------------------- ways to a cluster


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "mp4ds.plugins.cluster")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(OptionError, match=r"needs distributed.*pip install 'mp4ds\[cluster\]'"):
        plugin("cluster:cluster_executor")


@pytest.mark.parametrize(
    "address",
    [
        *("", "slurm", "tcp://127.0.0.1", "http://127.0.0.1:1", "tcp://[::1:8786"),
        *("tcp://127.0.0.1:1", "tcp://no-such-host.invalid:8786", "tls://127.0.0.1:1"),
    ],
)
def test_nobody_at_the_address(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "_CONNECT_SECONDS", 1.0)
    found = pytest.raises(RemoteError, match=r"no Dask scheduler can be reached.*tcp://HOST:PORT")
    with found, cluster_executor(address):
        pass


def test_another_server_at_the_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "_CONNECT_SECONDS", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as server:  # which says nothing
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with (
            pytest.raises(RemoteError, match="no Dask scheduler can be reached"),
            cluster_executor(address),
        ):
            pass
