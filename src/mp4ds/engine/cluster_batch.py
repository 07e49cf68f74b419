"""Dask clusters whose workers are jobs of a batch system, by dask-jobqueue."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from mp4ds.errors import ClusterError, OptionError

if TYPE_CHECKING:
    from dask_jobqueue import JobQueueCluster

BATCH_SYSTEMS = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "sge": "SGECluster",
    "lsf": "LSFCluster",
    "htcondor": "HTCondorCluster",
    "oar": "OARCluster",
}
"""Name, which is that of its configuration, too -> class of dask-jobqueue."""

_MOST_JOBS = 16
_SETTINGS = "~/.config/dask/jobqueue.yaml"


@contextmanager
def batch_cluster(system: str, tasks: int) -> Iterator[tuple[JobQueueCluster, Callable[[], None]]]:
    """Submit jobs, and cancel them at the end.

    Args:
        system: A name of `BATCH_SYSTEMS`.
        tasks: How many there are to run.

    Yields:
        The cluster, and what submits jobs again that have ended.

    Raises:
        ClusterError: The batch system refuses the jobs.
        OptionError: The configuration lacks something.
    """
    module = importlib.import_module("dask_jobqueue")  # brings its part of the configuration
    jobs = min(tasks, _jobs())
    with _opened(getattr(module, BATCH_SYSTEMS[system]), system) as cluster:
        problem = _submit(cluster, jobs)
        if problem:
            raise ClusterError(
                system,
                f"the jobs could not be submitted: {problem.rstrip('.')}",
                f"Their settings are in {_SETTINGS}.",
            )

        def refill() -> None:
            _submit(cluster, jobs)  # what is refused now may be taken the next time

        yield cluster, refill


@contextmanager
def _opened(kind: type[JobQueueCluster], system: str) -> Iterator[JobQueueCluster]:
    import dask

    for name in ("cores", "memory"):
        if dask.config.get(f"jobqueue.{system}.{name}", None) is None:
            raise OptionError(
                f"--cluster {system}: {_SETTINGS} does not say how many cores and how much "
                f"memory a job has: set cores and memory under jobqueue: {system}."
            )
    try:
        cluster = kind()
    except (ValueError, TypeError, RuntimeError, OSError) as error:
        raise OptionError(
            f"--cluster {system}: {_line(error)} The settings are in {_SETTINGS}, "
            f"under jobqueue: {system}."
        ) from None
    with cluster:
        yield cluster


def _submit(cluster: JobQueueCluster, jobs: int) -> str:
    """Submit the jobs that are not there.

    Unlike the cluster's own `scale`, it tells what the batch system refuses.

    Returns:
        What went wrong, or nothing.
    """
    from distributed import Status

    async def submit() -> None:
        while len(cluster.worker_spec) < jobs:
            cluster.worker_spec.update(cluster.new_worker_spec())
        try:
            await cluster
        finally:
            for name, job in list(cluster.workers.items()):
                if job.job_id is None:
                    job.status = Status.failed  # else the cluster takes it for one that begins
                    del cluster.workers[name]

    try:
        cluster.sync(submit)
    except (RuntimeError, ValueError, OSError) as error:
        return _line(error)
    return ""


def _jobs() -> int:
    """Most jobs at a time.

    Raises:
        OptionError: The configuration has no number there.
    """
    import dask

    jobs = dask.config.get("mp4ds.jobs", _MOST_JOBS)
    if not isinstance(jobs, int) or jobs < 1:
        raise OptionError(
            f"DASK_MP4DS__JOBS, or mp4ds.jobs in the configuration of Dask, is {jobs!r}. "
            "Give a number of jobs, from 1."
        )
    return jobs


def _line(error: Exception) -> str:
    """The line of an error that says most: of a command, the last that it wrote."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not lines:
        return type(error).__name__
    return lines[-1] if lines[0].startswith("Command exited") else lines[0]
