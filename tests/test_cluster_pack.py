"""A recording packed on a Dask cluster: what comes out is what one machine makes."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from clusters import OTHER_VERSION, RealCluster
from compare import compare
from in_parts import facts, leftovers
from mp4ds.errors import PartsFailedError
from mp4ds.packing.options import PackOptions
from round_trips import unpacked
from sources import SOURCES, scene
from waiting import WATCHDOG_S, until

FRAMES = 72
WINDOW = 3
PARTS = FRAMES // WINDOW
WORK = ".dataset.mp4ds-part"


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCluster]:
    """One that no test harms."""
    with RealCluster(tmp_path_factory.mktemp("cluster")) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    (path,) = SOURCES["bag-none"](folder, scene("bayer_rggb8", frames=FRAMES))
    return path


@pytest.fixture(scope="module")
def expected(source: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("expected")
    mp4ds.pack(source, folder / "dataset", PackOptions(codec="h264"))
    return facts(folder / "dataset")


def on(cluster: RealCluster) -> PackOptions:
    return PackOptions(codec="h264", window=WINDOW, cluster=cluster.address)


def command(source: Path, folder: Path, cluster: RealCluster) -> subprocess.Popen[str]:
    """The command line at work."""
    options = ["--codec", "h264", "--window", str(WINDOW), "--cluster", cluster.address]
    return subprocess.Popen(
        [sys.executable, "-m", "mp4ds", "pack", source, "-o", folder / "dataset", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(folder: Path) -> dict[str, int]:
    """Parts whose results are there -> when they came."""
    parts = sorted((folder / WORK).glob("0*"))
    return {part.name: part.stat().st_mtime_ns for part in parts}


@pytest.mark.slow
def test_it_is_the_same_dataset(
    cluster: RealCluster, source: Path, expected: dict[str, Any], tmp_path: Path
) -> None:
    seen = []
    mp4ds.pack(source, tmp_path / "dataset", on(cluster), progress=seen.append)
    assert facts(tmp_path / "dataset") == expected
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare([source], unpacked(tmp_path, "bag")) == []
    assert leftovers(tmp_path) == []
    done = [progress.tasks_done for progress in seen]
    assert any(0 < count < PARTS for count in done)  # each is told as it ends
    assert done[-1] == PARTS


@pytest.mark.slow
def test_a_killed_worker_does_not_matter(
    source: Path, expected: dict[str, Any], tmp_path: Path
) -> None:
    with (
        RealCluster(tmp_path / "dask") as cluster,
        command(source, tmp_path, cluster) as process,
    ):
        until(lambda: len(finished(tmp_path)) >= 2)
        cluster.workers[0].kill()
        assert len(finished(tmp_path)) < PARTS
        _, stderr = process.communicate(timeout=WATCHDOG_S)
    assert process.returncode == 0, stderr
    assert facts(tmp_path / "dataset") == expected


@pytest.mark.slow
@pytest.mark.parametrize(("sign", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_a_command_that_ended_leaves_the_cluster_idle(
    sign: int,
    code: int,
    cluster: RealCluster,
    source: Path,
    expected: dict[str, Any],
    tmp_path: Path,
) -> None:
    with command(source, tmp_path, cluster) as process:
        until(lambda: len(finished(tmp_path)) >= 2)
        process.send_signal(sign)
        _, stderr = process.communicate(timeout=WATCHDOG_S)
    assert process.returncode == code
    assert "Traceback" not in stderr
    if sign == signal.SIGINT:
        assert "run the same command again to resume" in " ".join(stderr.split())
    until(cluster.is_idle)
    idle = finished(tmp_path)
    time.sleep(1)
    assert finished(tmp_path) == idle
    assert len(idle) < PARTS
    assert all(p.poll() is None for p in (cluster.scheduler, *cluster.workers))
    mp4ds.pack(source, tmp_path / "dataset", on(cluster))
    assert facts(tmp_path / "dataset") == expected


@pytest.mark.slow
def test_workers_of_another_version_are_refused(source: Path, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(OTHER_VERSION)
    with (
        RealCluster(tmp_path / "dask", path=tmp_path) as cluster,
        pytest.raises(PartsFailedError, match=r"has other versions than mp4ds"),
    ):
        mp4ds.pack(source, tmp_path / "dataset", on(cluster))
    assert not (tmp_path / "dataset").exists()
