"""Settings tried on a Dask cluster: what is found is what one machine finds, but for the times."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

import mp4ds
from clusters import OTHER_VERSION, RealCluster
from mp4ds.errors import ClusterError, Mp4dsError, OptionError, ScoringError
from mp4ds.packing.engine import Outcome
from mp4ds.plugins.evaluating.options import EvaluateOptions
from mp4ds.plugins.evaluating.results import Evaluation
from mp4ds.plugins.evaluating.trials import command, run_task
from sources import scene, write_bag
from waiting import WATCHDOG_S, until

CRF = "20:40:4"
NOBODY = "tcp://127.0.0.1:1"
TIMES = {"encode_seconds", "encode_cpu_seconds", "decode_fps", "encode_fps", "whole_seconds"}
QUICK = EvaluateOptions(
    codecs=["x264", "x265"], presets=["ultrafast"], crf=[CRF], target="psnr_y=20", threads=1
)
SETTINGS = 6  # of x264; x265 takes no images of so few columns


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealCluster]:
    """One that no test harms."""
    with RealCluster(tmp_path_factory.mktemp("cluster")) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("source") / "drive.bag"
    write_bag(path, scene("bayer_rggb8", frames=10, width=48, height=64))
    return path


@pytest.fixture(scope="module")
def expected(bag: Path) -> dict[str, Any]:
    return facts(mp4ds.evaluate(bag, QUICK, output=bag.parent / "expected"))


def facts(found: Evaluation) -> dict[str, Any]:
    """All that two evaluations have in common, whatever machines they ran on."""
    (camera,) = (asdict(camera) for camera in found.cameras)
    for cell in camera["cells"]:
        for name in (*TIMES, "machine"):
            del cell[name]
    for row in camera["storage"]:
        del row["days"], row["cpu_days"]
    camera["notes"] = [note for note in camera["notes"] if not note.startswith("times were")]
    del camera["recommended"]  # one of which is the fastest
    pictures = [camera["ground_truth"], *(cell["picture"] for cell in camera["cells"])]
    camera["pictures"] = [(found.output / name).read_bytes() for name in pictures]
    return camera


def on(cluster: RealCluster) -> EvaluateOptions:
    return replace(QUICK, cluster=cluster.address)


def at_work(bag: Path, folder: Path, cluster: RealCluster) -> subprocess.Popen[str]:
    """The command line, trying settings on a cluster."""
    options = ["--codecs", "x264,x265", "--presets", "ultrafast", "--crf", CRF]
    options += ["--threads", "1", "--target", "psnr_y=20", "--cluster", cluster.address]
    return subprocess.Popen(
        [sys.executable, "-m", "mp4ds", "evaluate", bag, "-o", folder / "out", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def measured(folder: Path) -> dict[str, int]:
    """Results of settings that are there -> when they came."""
    paths = (folder / "out").glob("cells/*.json")
    return {path.name: path.stat().st_mtime_ns for path in paths if "-original-" not in path.name}


def trials_of(worker: subprocess.Popen[bytes]) -> list[int]:
    """The processes of trials that a worker has."""
    found = []
    for path in Path(f"/proc/{worker.pid}/task").glob("*/children"):
        for pid in path.read_text().split():
            with suppress(OSError):
                if b"mp4ds.plugins.evaluating.trials" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    found.append(int(pid))
    return found


# ---------------------------------------------------------------- results


@pytest.mark.slow
def test_it_finds_the_same(
    cluster: RealCluster, bag: Path, expected: dict[str, Any], tmp_path: Path
) -> None:
    found = mp4ds.evaluate(bag, on(cluster), output=tmp_path / "out")
    assert (found.tried, found.known) == (SETTINGS, 0)
    assert facts(found) == expected
    (camera,) = found.cameras
    assert len(camera.cells) == SETTINGS
    assert {cell.machine for cell in camera.cells} == {socket.gethostname()}
    assert all(cell.encode_cpu_seconds > 0 for cell in camera.cells)
    assert any(note.startswith("not tried: h265") for note in camera.notes)
    assert any("several settings running at once" in note for note in camera.notes)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        *("cells", "evaluation.csv", "evaluation.json", "index.html"),
        *("mp4ds_evaluation.json", "pictures", "plots"),
    ]
    # what is known needs no cluster
    again = mp4ds.evaluate(bag, replace(QUICK, cluster=NOBODY), output=tmp_path / "out")
    assert (again.tried, again.known) == (0, SETTINGS)
    assert facts(again) == expected


@pytest.mark.slow
def test_what_one_machine_began_a_cluster_ends(
    cluster: RealCluster, bag: Path, expected: dict[str, Any], tmp_path: Path
) -> None:
    mp4ds.evaluate(bag, replace(QUICK, crf=["20:24:4"]), output=tmp_path / "out")
    (known,) = (tmp_path / "out" / "cells").glob("*h264*crf-24*")
    values = json.loads(known.read_text())
    known.write_text(json.dumps({**values, "machine": "another"}))
    found = mp4ds.evaluate(bag, on(cluster), output=tmp_path / "out")
    assert found.known == 2
    assert facts(found) == expected
    (note,) = (note for note in found.cameras[0].notes if "machines" in note)
    assert note.startswith("times were measured on 2 machines")
    assert ",another," in (tmp_path / "out" / "evaluation.csv").read_text()


@pytest.mark.slow
def test_rates_are_searched_on_a_cluster(cluster: RealCluster, bag: Path, tmp_path: Path) -> None:
    options = replace(QUICK, codecs=["x264"], crf=["24"], rates=[5], target="psnr_y=35")
    here = mp4ds.evaluate(bag, options, output=tmp_path / "here")
    there = mp4ds.evaluate(
        bag, replace(options, cluster=cluster.address), output=tmp_path / "there"
    )
    (ours,), (theirs,) = here.cameras[0].rates, there.cameras[0].rates
    assert (theirs.cell.setting, theirs.cell.size) == (ours.cell.setting, ours.cell.size)


# ---------------------------------------------------------------- what goes wrong


@pytest.mark.slow
def test_a_killed_worker_does_not_matter(
    bag: Path, expected: dict[str, Any], tmp_path: Path
) -> None:
    with RealCluster(tmp_path / "dask") as cluster:
        victim = cluster.workers[0]
        with at_work(bag, tmp_path, cluster) as process:
            until(lambda: bool(measured(tmp_path)) and bool(trials_of(victim)))
            orphans = trials_of(victim)
            victim.kill()
            _, stderr = process.communicate(timeout=WATCHDOG_S)
        assert process.returncode == 0, stderr
        until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in orphans))
    found = mp4ds.evaluate(bag, QUICK, output=tmp_path / "out")
    assert (found.tried, found.known) == (0, SETTINGS)
    assert facts(found) == expected


@pytest.mark.slow
def test_a_lost_scheduler_is_told(bag: Path, expected: dict[str, Any], tmp_path: Path) -> None:
    with RealCluster(tmp_path / "dask") as lost, at_work(bag, tmp_path, lost) as process:
        until(lambda: len(measured(tmp_path)) >= 2)
        lost.scheduler.kill()
        _, stderr = process.communicate(timeout=WATCHDOG_S)
    assert process.returncode == 1
    assert "Traceback" not in stderr
    assert "the connection to the Dask scheduler was lost" in " ".join(stderr.split())
    kept = sum("-h264-" in name for name in measured(tmp_path))
    found = mp4ds.evaluate(bag, QUICK, output=tmp_path / "out")
    assert found.known == kept
    assert facts(found) == expected


@pytest.mark.slow
def test_one_that_is_interrupted_leaves_the_cluster_idle(
    cluster: RealCluster, bag: Path, expected: dict[str, Any], tmp_path: Path
) -> None:
    with at_work(bag, tmp_path, cluster) as process:
        until(lambda: len(measured(tmp_path)) >= 2)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=WATCHDOG_S)
    assert process.returncode == 130
    assert not re.search("distributed|dask|Traceback|Warning", stderr)
    assert "run the same command again to resume" in " ".join(stderr.split())
    assert not list((tmp_path / "out").glob("work*"))
    until(cluster.is_idle)
    idle = measured(tmp_path)
    time.sleep(1)
    assert measured(tmp_path) == idle
    assert len(idle) < 2 * SETTINGS
    assert all(p.poll() is None for p in (cluster.scheduler, *cluster.workers))
    found = mp4ds.evaluate(bag, on(cluster), output=tmp_path / "out")
    assert found.known == sum("-h264-" in name for name in idle)
    assert facts(found) == expected


@pytest.mark.slow
def test_workers_of_another_version_are_refused(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(OTHER_VERSION)
    with (
        RealCluster(tmp_path / "dask", path=tmp_path) as cluster,
        pytest.raises(
            ScoringError, match=r"on worker tcp:.* versions differ .* mp4ds 0.0.1 instead of"
        ),
    ):
        mp4ds.evaluate(bag, on(cluster), output=tmp_path / "out")
    assert not measured(tmp_path)


def test_a_worker_that_does_not_see_the_folder(tmp_path: Path) -> None:
    with pytest.raises(Mp4dsError, match=r"0\.job does not exist: all machines must share"):
        run_task(str(tmp_path / "0.job"))


class Elsewhere:
    """An engine whose tasks leave their results where nobody sees them."""

    def run(self, tasks: Sequence[tuple[str, ...]], _: object) -> Generator[Outcome, None, None]:
        yield from map(Outcome, tasks)


def test_results_that_are_not_seen(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mp4ds.files.outputs._SEEN_SECONDS", 0.1)
    monkeypatch.setattr("mp4ds.files.outputs._LOOK_SECONDS", 0.01)
    monkeypatch.setattr("mp4ds.plugins.evaluating.evaluate.ProcessEngine", lambda *_: Elsewhere())
    with pytest.raises(ScoringError, match=r"did not appear in .*cells; all machines must share"):
        mp4ds.evaluate(bag, QUICK, output=tmp_path / "out")


def test_nobody_at_the_address(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mp4ds.plugins.cluster._CONNECT_SECONDS", 1.0)
    with pytest.raises(ClusterError, match="no Dask scheduler can be reached"):
        mp4ds.evaluate(bag, replace(QUICK, cluster=NOBODY), output=tmp_path / "out")
    assert not list((tmp_path / "out").glob("work*"))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"cluster": "slrum"}, "`cluster` 'slrum' is neither"),
        ({"cluster": NOBODY, "jobs": 2}, "`jobs` is for this machine"),
    ],
)
def test_options_that_are_wrong(
    changed: dict[str, Any], said: str, bag: Path, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=said):
        mp4ds.evaluate(bag, replace(QUICK, **changed), output=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_encoders_have_one_thread_on_a_cluster() -> None:
    assert EvaluateOptions(cluster=NOBODY).encoder_threads == 1
    assert EvaluateOptions(cluster=NOBODY, threads=3).encoder_threads == 3


# ---------------------------------------------------------------- trials


@pytest.mark.slow
def test_a_trial_may_be_run_twice_at_once(
    bag: Path, expected: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a cluster does that takes a worker for lost."""

    class Twice:
        def run(
            self, tasks: Sequence[tuple[str, ...]], _: object
        ) -> Generator[Outcome, None, None]:
            for task in tasks:
                both = [subprocess.Popen(command(task), stdin=subprocess.PIPE) for _ in range(2)]
                assert [process.wait(WATCHDOG_S) for process in both] == [0, 0]
                for process in both:
                    process.communicate()
                yield Outcome(task)

    monkeypatch.setattr("mp4ds.plugins.evaluating.evaluate.ProcessEngine", lambda *_: Twice())
    options = replace(QUICK, codecs=["x264"], crf=["20:24:4"])
    found = facts(mp4ds.evaluate(bag, options, output=tmp_path / "out"))
    assert found["cells"] == expected["cells"][:2]
    assert not list((tmp_path / "out" / "cells").glob("*.mp4"))
