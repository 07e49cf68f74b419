"""Calls on the workers of a Dask cluster, and what becomes of them when machines die."""

from __future__ import annotations

import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, as_completed
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path

import dask
import pytest

import clusters
from clusters import WITH_NANNY, RealCluster
from mp4ds.errors import Mp4dsError, OptionError, RemoteError
from mp4ds.plugins import cluster as access
from mp4ds.plugins.cluster import cluster_executor
from waiting import is_alive, until


@pytest.fixture(autouse=True)
def _settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the packages from writing their defaults into the home folder."""
    monkeypatch.setattr(dask.config, "PATH", str(tmp_path / "settings"))
    import_module("dask_jobqueue")  # brings settings, which those of a test are to cover


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
    executor = cluster_executor(cluster.address, 12)
    assert not errors(executor, clusters.write, tmp_path, *names)
    assert results(tmp_path) == {name: clusters.result(name) for name in names}
    assert len({path.suffix for path in started(tmp_path)}) == 2  # processes: both worked
    assert len(started(tmp_path)) == len(names)  # once each


def test_errors_of_calls_are_told_and_not_tried_again(cluster: RealCluster, tmp_path: Path) -> None:
    names = ["source", "disk", "odd", "silent", "memory", "fine"]
    executor = cluster_executor(cluster.address, 6)
    found = errors(executor, clusters.fail, tmp_path, *names)
    for name, sentence in [
        ("source", "drive.bag: is damaged. Copy it again."),
        ("disk", "a file: No space left on device"),
        ("odd", "strange"),
        ("silent", "RuntimeError"),
        ("memory", "out of memory"),
    ]:
        said = rf"on worker tcp://127.0.0.1:\d+: {re.escape(sentence)}"
        assert isinstance(found[name], Mp4dsError)
        assert re.fullmatch(said, str(found[name]))
    assert "fine" not in found
    assert all((tmp_path / name).read_text() == "once\n" for name in names)


def test_a_function_that_the_cluster_lacks(tmp_path: Path) -> None:
    with RealCluster(tmp_path / "dask", workers=1, path=tmp_path) as cluster:
        found = errors(cluster_executor(cluster.address, 2), clusters.write, tmp_path, "a", "b")
    for error in found.values():
        assert "No module named 'clusters'" in str(error)
        assert "must have the same version of mp4ds" in str(error)
    assert len(found) == 2


def test_an_error_of_the_caller_drops_what_waits_and_leaves_the_cluster(
    cluster: RealCluster, tmp_path: Path
) -> None:
    with pytest.raises(KeyError), cluster_executor(cluster.address, 2) as executor:  # noqa: PT012
        calls = [executor.submit(clusters.write, str(tmp_path), name) for name in numbered(50)]
        next(as_completed(calls)).result()
        raise KeyError
    begun = len(started(tmp_path))
    time.sleep(4 * clusters.SECONDS)
    assert len(started(tmp_path)) <= begun + 2  # those that workers had fetched
    (tmp_path / "next").mkdir()
    executor = cluster_executor(cluster.address, 2)
    assert not errors(executor, clusters.write, tmp_path / "next", *numbered(4))
    assert cluster.scheduler.poll() is None
    assert all(worker.poll() is None for worker in cluster.workers)


# ---------------------------------------------------------------- deaths


def test_calls_of_a_killed_worker_are_made_on_another(tmp_path: Path) -> None:
    names = numbered(8)
    with (
        RealCluster(tmp_path / "dask") as cluster,
        cluster_executor(cluster.address, 8) as executor,
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
        executor = cluster_executor(cluster.address, 7)
        found = errors(executor, clusters.die, tmp_path, "deadly", *numbered(6))
    assert set(found) == {"deadly"}
    assert re.search("2 different workers, but all those workers died", str(found["deadly"]))


@pytest.mark.slow
def test_a_lost_scheduler_is_an_error_and_the_next_one_goes_on(tmp_path: Path) -> None:
    names = numbered(8)
    with (
        RealCluster(tmp_path / "dask") as cluster,
        cluster_executor(cluster.address, 8) as executor,
    ):
        calls = [executor.submit(clusters.write, str(tmp_path), name) for name in names]
        next(as_completed(calls))
        cluster.scheduler.kill()
        found = [error for call in calls if (error := call.exception())]
        assert found
        assert all(isinstance(error, RemoteError) for error in found)
        assert all("run the same command again to resume" in str(error) for error in found)
        with pytest.raises(RemoteError):
            executor.submit(os.getpid)
    kept = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("0??")}
    assert 0 < len(kept) < len(names)
    with RealCluster(tmp_path / "dask-2", workers=1) as cluster:
        executor = cluster_executor(cluster.address, 8)
        assert not errors(executor, clusters.write, tmp_path, *names)
    assert results(tmp_path).keys() >= set(names)
    assert all((tmp_path / name).stat().st_mtime_ns == kept[name] for name in kept)


def test_a_cluster_without_workers_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "_LOOK_SECONDS", 0.5)
    with (
        RealCluster(tmp_path / "dask", workers=0) as cluster,
        dask.config.set({"mp4ds.worker-timeout": "1 s"}),
    ):
        executor = cluster_executor(cluster.address, 1)
        found = errors(executor, clusters.write, tmp_path, "a")
        assert "has had no worker for 1 s. Start some, or find out" in str(found["a"])


# ---------------------------------------------------------------- ways to a cluster


@pytest.mark.parametrize(
    "address",
    [
        *("", "slrum", "127.0.0.1:8786", "tcp://127.0.0.1", "tcp://:8786", "tcp://host:99999"),
        *("http://127.0.0.1:8786", "tcp://host:1/path", "tcp://[::1:8786", "tcp://host:x", "\0"),
    ],
)
def test_other_addresses_are_refused(address: str) -> None:
    with (
        pytest.raises(OptionError, match=r"tcp://HOST:PORT .* slurm, pbs,"),
        cluster_executor(address, 1),
    ):
        pass


@pytest.mark.parametrize(
    ("address", "module", "package"),
    [("tcp://127.0.0.1:1", "distributed", "distributed")]
    + [(system, "dask_jobqueue", "dask-jobqueue") for system in access.BATCH_SYSTEMS],
)
def test_a_missing_package_is_named(
    address: str, module: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with (
        pytest.raises(OptionError, match=rf"needs {package}.*pip install 'mp4ds\[cluster\]'"),
        cluster_executor(address, 1),
    ):
        pass


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "_CONNECT_SECONDS", 1.0)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "tcp://no-such-host.invalid:8786"])
def test_nobody_at_the_address(address: str, tmp_path: Path) -> None:
    with pytest.raises(RemoteError, match="no Dask scheduler can be reached"):
        errors(cluster_executor(address, 1), clusters.write, tmp_path, "a")


def test_tls_needs_certificates(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="needs certificates"):
        errors(cluster_executor("tls://127.0.0.1:1", 1), clusters.write, tmp_path, "a")


# ---------------------------------------------------------------- batch systems

SBATCH = """#!/bin/sh
[ -e {folder}/refuse ] && echo "sbatch: error: invalid partition specified: robots" >&2 && exit 1
cp "$1" {folder}/script-$$
setsid bash {folder}/script-$$ >> {folder}/log 2>&1 &
echo $! >> {folder}/jobs
echo "Submitted batch job $!"
"""
SCANCEL = """#!/bin/sh
echo $1 >> {folder}/cancelled
grep -q {folder} /proc/$1/cmdline && kill -TERM -- -$1  # its number may be another's by now
"""


class Batch:
    """Stands in for SLURM: jobs are processes of this machine, their numbers process groups."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder = folder
        for name, script in [("sbatch", SBATCH), ("scancel", SCANCEL)]:
            path = folder / name
            path.write_text(script.format(folder=folder))
            path.chmod(0o755)

    def numbers(self, name: str) -> list[int]:
        path = self.folder / name
        return [int(line) for line in path.read_text().split()] if path.exists() else []


@pytest.fixture
def batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Batch]:
    system = Batch(tmp_path / "batch")
    monkeypatch.setenv("PATH", f"{system.folder}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    slurm = {
        "cores": 1,
        "processes": 1,
        "memory": "1GiB",
        "local-directory": str(system.folder),
        "scheduler-options": {"host": "127.0.0.1", "dashboard_address": ":0"},
        "worker-extra-args": ["--host", "127.0.0.1", "--no-dashboard"],
    }
    settings = {f"jobqueue.slurm.{name}": value for name, value in slurm.items()}
    with dask.config.set({**settings, "distributed.deploy.lost-worker-timeout": "100 ms"}):
        yield system
    assert sorted(set(system.numbers("jobs"))) == sorted(set(system.numbers("cancelled")))
    until(lambda: not any(map(is_alive, system.numbers("jobs"))))


@pytest.mark.parametrize(("calls", "jobs"), [(8, 2), pytest.param(1, 1, marks=pytest.mark.slow)])
def test_jobs_of_a_batch_system_make_the_calls(
    calls: int, jobs: int, batch: Batch, tmp_path: Path
) -> None:
    with dask.config.set({"mp4ds.jobs": 2}):
        executor = cluster_executor("slurm", calls)
        assert not errors(executor, clusters.write, tmp_path, *numbered(calls))
    assert len(batch.numbers("jobs")) == jobs


@pytest.mark.slow
def test_a_job_that_ended_is_submitted_again(
    batch: Batch, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access, "_LOOK_SECONDS", 0.5)
    with dask.config.set({"mp4ds.jobs": 1}), cluster_executor("slurm", 6) as executor:
        calls = [executor.submit(clusters.write, str(tmp_path), name) for name in numbered(6)]
        next(as_completed(calls))
        os.killpg(batch.numbers("jobs")[0], signal.SIGKILL)
        assert [call.exception() for call in calls] == [None] * 6
    assert len(batch.numbers("jobs")) == 2


def test_what_the_batch_system_refuses_is_told(batch: Batch, tmp_path: Path) -> None:
    (batch.folder / "refuse").touch()
    with pytest.raises(RemoteError, match=r"could not be submitted.*invalid partition specified"):
        errors(cluster_executor("slurm", 2), clusters.write, tmp_path, "a")


@pytest.mark.parametrize("system", access.BATCH_SYSTEMS)
def test_a_batch_system_that_is_not_there(system: str, tmp_path: Path) -> None:
    settings = {
        "cores": 1,
        "memory": "1GiB",
        "disk": "1GiB",  # of HTCondor
        "memory-per-core-property-name": "mem_core",  # of OAR
        "scheduler-options": {"host": "127.0.0.1", "dashboard_address": ":0"},
    }
    named = {f"jobqueue.{system}.{name}": value for name, value in settings.items()}
    with dask.config.set(named), pytest.raises(RemoteError, match="could not be submitted"):
        errors(cluster_executor(system, 1), clusters.write, tmp_path, "a")


@pytest.mark.parametrize(
    ("name", "value", "variable"),
    [("mp4ds.jobs", value, "DASK_MP4DS__JOBS") for value in (0, -1, "many", 1.5)]
    + [("mp4ds.worker-timeout", v, "DASK_MP4DS__WORKER_TIMEOUT") for v in ("soon", [])],
)
def test_settings_are_checked(
    name: str, value: object, variable: str, batch: Batch, tmp_path: Path
) -> None:
    with dask.config.set({name: value}), pytest.raises(OptionError, match=variable):
        errors(cluster_executor("slurm", 1), clusters.write, tmp_path, "a")
