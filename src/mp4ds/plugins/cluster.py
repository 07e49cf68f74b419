"""An executor whose calls run on Dask workers: of a cluster, or of batch jobs."""

from __future__ import annotations

import asyncio
import importlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar
from urllib.parse import urlsplit

from mp4ds.errors import ClusterError, OptionError
from mp4ds.packing.processes import CallError, call_error, release_memory

if TYPE_CHECKING:
    from dask_jobqueue import JobQueueCluster
    from distributed import Client

_P = ParamSpec("_P")
_T = TypeVar("_T")


def attempt(call: Callable[[], _T]) -> _T:
    """Make a call in a thread of this worker.

    Raises:
        CallError: It failed.
    """
    from distributed import get_worker

    try:
        return call()
    except Exception as error:
        told = call_error(error)
        sentence = f"on worker {get_worker().address}: {told.sentence}"
        raise CallError(sentence, told.exit_code) from None
    finally:
        release_memory()  # a worker using too much is paused and gets no more calls


# ---------------------------------------------------------------- batch systems

BATCH_SYSTEMS = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "sge": "SGECluster",
    "lsf": "LSFCluster",
    "htcondor": "HTCondorCluster",
    "oar": "OARCluster",
}
"""Name, also of its configuration -> class of dask-jobqueue."""

_MOST_JOBS = 16
_SETTINGS = "~/.config/dask/jobqueue.yaml"


@contextmanager
def batch_cluster(system: str, tasks: int) -> Iterator[tuple[JobQueueCluster, Callable[[], None]]]:
    """Submit jobs, and cancel them at the end.

    Args:
        system: A name of `BATCH_SYSTEMS`.
        tasks: Number of tasks to run.

    Yields:
        The cluster, and a function that resubmits jobs that have ended.

    Raises:
        ClusterError: The batch system refuses the jobs.
        OptionError: The configuration lacks something.
    """
    module = importlib.import_module("dask_jobqueue")  # loads its part of the configuration
    jobs = min(tasks, _jobs())
    with _opened_jobs(getattr(module, BATCH_SYSTEMS[system]), system) as cluster:
        problem = _submit(cluster, jobs)
        if problem:
            raise ClusterError(
                system,
                f"the jobs could not be submitted: {problem.rstrip('.')}",
                f"The settings are in {_SETTINGS}.",
            )

        def refill() -> None:
            _submit(cluster, jobs)  # what is refused now may be accepted next time

        yield cluster, refill


@contextmanager
def _opened_jobs(kind: type[JobQueueCluster], system: str) -> Iterator[JobQueueCluster]:
    import dask

    for name in ("cores", "memory"):
        if dask.config.get(f"jobqueue.{system}.{name}", None) is None:
            raise OptionError(
                f"`cluster` {system}: {_SETTINGS} does not say how many cores and how much "
                f"memory a job has: set cores and memory under jobqueue: {system}."
            )
    try:
        cluster = kind()
    except (ValueError, TypeError, RuntimeError, OSError) as error:
        raise OptionError(
            f"`cluster` {system}: {_line(error)} The settings are in {_SETTINGS}, under jobqueue: "
            f"{system}."
        ) from None
    with cluster:
        yield cluster


def _submit(cluster: JobQueueCluster, jobs: int) -> str:
    """Submit the missing jobs.

    Unlike the cluster's own `scale`, it reports what the batch system refuses.

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
                    # otherwise the cluster takes it for one that is starting
                    job.status = Status.failed
                    del cluster.workers[name]

    try:
        cluster.sync(submit)
    except (RuntimeError, ValueError, OSError) as error:
        return _line(error)
    return ""


def _jobs() -> int:
    """Maximum number of jobs.

    Raises:
        OptionError: The configured value is not a number.
    """
    import dask

    jobs = dask.config.get("mp4ds.jobs", _MOST_JOBS)
    if not isinstance(jobs, int) or jobs < 1:
        raise OptionError(
            f"DASK_MP4DS__JOBS, or mp4ds.jobs in Dask's configuration, is {jobs!r}. Give a number "
            "of jobs, 1 or more."
        )
    return jobs


def _line(error: Exception) -> str:
    """The most informative line of an error: for a command, the last one it wrote."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not lines:
        return type(error).__name__
    return lines[-1] if lines[0].startswith("Command exited") else lines[0]


# ---------------------------------------------------------------- access

_SCHEMES = ("tcp", "tls")
_CONNECT_SECONDS = 15.0
_CONNECT_POLL_SECONDS = 0.1
_ENDED = ("closing", "closed")
_LOOK_SECONDS = 5.0
_WORKER_SECONDS = 5 * 60.0
_BATCH_WORKER_SECONDS = 12 * 3600.0
_GO_ON = "Finished work is kept: run the same command again to resume."


class Watch:
    """Detects when tasks will never finish.

    Args:
        client: Connected.
        address: The cluster's address as given by the user.
        patience: Seconds to wait without any worker.
        refill: Restarts workers that have ended, if that is possible from here.
    """

    def __init__(
        self,
        client: Client,
        address: str,
        *,
        patience: float,
        refill: Callable[[], None] | None = None,
    ) -> None:
        self._client = client
        self._address = address
        self._patience = patience
        self._refill = refill
        self._next = 0.0
        self._empty_since: float | None = None

    def look(self, *, is_waiting: bool) -> None:
        """Check the cluster, unless it was just checked.

        Args:
            is_waiting: Whether there are calls; time without any does not count.

        Raises:
            ClusterError: The scheduler is lost, or there have been no workers for too long.
        """
        if not is_waiting:
            self._empty_since = None
            return
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + _LOOK_SECONDS
        if self._client.status in _ENDED:
            raise self.lost()
        if self._client.status != "running":
            return  # it reconnects, or gives up
        if self._refill is not None:
            self._refill()
        try:
            has_workers = bool(self._client.nthreads())
        except OSError:
            has_workers = False  # unknown
        if has_workers:
            self._empty_since = None
        elif self._empty_since is None:
            self._empty_since = now
        elif now - self._empty_since >= self._patience:
            raise ClusterError(
                self._address,
                f"has had no worker for {self._patience:g} s",
                f"Start some, or find out why they ended. {_GO_ON}",
            )

    def wait_until_connected(self) -> None:
        """Wait for a client to reconnect.

        Raises:
            ClusterError: The scheduler is lost.
        """
        while self._client.status != "running":
            if self._client.status in _ENDED:
                raise self.lost()
            time.sleep(_CONNECT_POLL_SECONDS)

    def lost(self) -> ClusterError:
        """The error for when the scheduler no longer knows the tasks."""
        return ClusterError(
            self._address,
            "the connection to the Dask scheduler was lost, or it dropped the tasks",
            f"Check whether it is still running. {_GO_ON}",
        )


def check_address(address: str) -> None:
    """Refuse an invalid cluster address, or one that needs a package that is not there.

    Raises:
        OptionError: Says what is wrong.
    """
    if address not in BATCH_SYSTEMS and not _is_of_scheduler(address):
        raise OptionError(
            f"`cluster` {address!r} is neither tcp://HOST:PORT or tls://HOST:PORT of a Dask "
            f"scheduler nor one of {', '.join(BATCH_SYSTEMS)}."
        )
    for name in ("distributed", "dask_jobqueue")[: 1 + (address in BATCH_SYSTEMS)]:
        if find_spec(name) is None:
            raise OptionError(
                f"`cluster` {address} needs {name.replace('_', '-')}, which is not installed. "
                "Install it with: pip install 'mp4ds[cluster]'"
            )


def _is_of_scheduler(address: str) -> bool:
    try:
        parts = urlsplit(address)
        complete = parts.scheme in _SCHEMES and parts.hostname and parts.port
    except ValueError:
        return False
    return bool(complete) and not (parts.path or parts.query or parts.fragment)


@contextmanager
def _opened(address: str, tasks: int) -> Iterator[tuple[Client, Watch]]:
    """Open a connection to a cluster; whatever is started for it ends with it.

    Args:
        address: One accepted by `check_address`.
        tasks: Number of tasks to run.

    Raises:
        ClusterError: No scheduler responds within 15 s, or the batch system refuses the jobs.
        OptionError: The configuration lacks something.
    """
    from distributed import Client
    from distributed.utils import silence_logging_cmgr

    is_batch = address in BATCH_SYSTEMS
    patience = _patience(_BATCH_WORKER_SECONDS if is_batch else _WORKER_SECONDS)
    with ExitStack() as stack:
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL))  # errors that matter are raised
        place: object = address
        refill = None
        if is_batch:
            place, refill = stack.enter_context(batch_cluster(address, tasks))
        else:
            _check_scheduler(address)
        try:
            client = Client(place, timeout=_CONNECT_SECONDS, set_as_default=False)
        except (OSError, ImportError) as error:
            raise _unreachable(address, error) from None
        stack.enter_context(client)
        yield client, Watch(client, address, patience=patience, refill=refill)


def _check_scheduler(address: str) -> None:
    """Check that a scheduler answers: a client waits forever if something else listens.

    Raises:
        ClusterError: None does.
        OptionError: There are no certificates.
    """
    with ThreadPoolExecutor(1) as thread:  # the caller's thread may have a running loop
        thread.submit(asyncio.run, _greet(address)).result()


async def _greet(address: str) -> None:
    from distributed.comm import connect
    from distributed.security import Security

    try:
        arguments = Security().get_connection_args("client")
        if address.startswith("tls:") and arguments.get("ssl_context") is None:
            raise OptionError(
                f"`cluster` {address} needs certificates: set them under distributed.comm.tls in "
                "Dask's configuration, ~/.config/dask/distributed.yaml."
            )
        greeting = connect(address, timeout=_CONNECT_SECONDS, **arguments)
        comm = await asyncio.wait_for(greeting, _CONNECT_SECONDS)
    except OptionError:
        raise
    except (OSError, asyncio.TimeoutError) as error:
        raise _unreachable(address, error) from None
    except Exception:  # of any kind, since it interprets what it reads as lengths
        raise ClusterError(
            address, "the server there is not a Dask scheduler", "Check the port."
        ) from None
    comm.abort()


def _unreachable(address: str, error: Exception) -> ClusterError:
    reason = str(error.__cause__ or error)
    return ClusterError(
        address,
        "no Dask scheduler can be reached" + (f" ({reason})" if reason else ""),
        "Check the address, that `dask scheduler` is running there, and that no firewall "
        "blocks it.",
    )


def _patience(seconds: float) -> float:
    """Seconds to wait without any worker.

    Raises:
        OptionError: The configured value is not a time.
    """
    import dask
    from dask.utils import parse_timedelta

    patience = dask.config.get("mp4ds.worker-timeout", seconds)
    try:
        return float(parse_timedelta(patience))
    except (AttributeError, KeyError, TypeError, ValueError):
        raise OptionError(
            "DASK_MP4DS__WORKER_TIMEOUT, or mp4ds.worker-timeout in Dask's configuration, is "
            f"{patience!r}. Give a time, such as '10 minutes'."
        ) from None


# ---------------------------------------------------------------- the executor

_POLL_SECONDS = 1.0
_MAX_DROPS = 3


@dataclass
class _Call:
    """A call that was handed out.

    Attributes:
        future: Gets its result.
        function: With all its arguments.
        theirs: Dask's future; the scheduler forgets results that nobody holds.
        drops: How often the scheduler dropped it.
    """

    future: Future[Any]
    function: Callable[[], Any]
    theirs: Any = None
    drops: int = 0


class ClusterExecutor(Executor):
    """Makes each call on a worker of a Dask cluster, which imports what is called by its name.

    It is connected at the first call and stays so: batch jobs, which may have had to queue, serve
    all calls. A call whose worker dies is made on another one, as often as the scheduler's
    ``distributed.scheduler.allowed-failures`` allows; one that raises is not. Calls that the
    scheduler drops, as when the connection breaks, are submitted again. If the cluster is lost, or
    has no workers for long, all calls fail with a `ClusterError`.

    A context manager: leaving it with an exception drops waiting calls; on a cluster that keeps
    running, running calls finish, since a worker's thread cannot be stopped from outside. Whatever
    was started for it ends with it.

    Args:
        address: ``tcp://HOST:PORT`` or ``tls://HOST:PORT`` of a scheduler, which is left as it
            is; ``slurm``, ``pbs``, ``sge``, ``lsf``, ``htcondor`` or ``oar`` for jobs of that
            batch system, as dask-jobqueue is configured, which are ended after the last call.
        calls: Maximum number of parallel calls.

    Raises:
        OptionError: The address has none of these forms, or a package is missing.
    """

    def __init__(self, address: str, calls: int) -> None:
        check_address(address)
        self._address = address
        self._most = calls
        self._stack = ExitStack()
        self._client: Client | None = None
        self._thread: threading.Thread | None = None
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._calls: dict[str, _Call] = {}  # by Dask's key
        self._lost: ClusterError | None = None

    def submit(self, fn: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Make a call on a worker.

        Raises:
            ClusterError: No scheduler responds within 15 s, the batch system refuses the jobs, or
                the cluster was lost.
            OptionError: The configuration of Dask lacks something.
        """
        if self._client is None:
            self._client, watch = self._stack.enter_context(_opened(self._address, self._most))
            self._thread = threading.Thread(
                target=self._follow, args=(self._client, watch), daemon=True
            )
            self._thread.start()
        if self._lost is not None:
            raise self._lost
        call = _Call(Future(), partial(fn, *args, **kwargs))
        self._hand_out(self._client, call)
        return call.future

    def _hand_out(self, client: Client, call: _Call) -> None:
        # not pure: another call with the same arguments shares nothing with this one
        call.theirs = client.submit(attempt, call.function, pure=False)
        self._calls[call.theirs.key] = call
        call.theirs.add_done_callback(self._ended.put)

    def _follow(self, client: Client, watch: Watch) -> None:
        """Hand on what becomes of calls, until the executor is shut down; in a thread."""
        try:
            while True:
                watch.look(is_waiting=bool(self._calls))
                try:
                    ended = self._ended.get(timeout=_POLL_SECONDS)
                except queue.Empty:
                    continue
                if ended is None:
                    return
                call = self._calls.pop(ended.key)
                if call.future.cancelled() or _settle(call.future, ended):
                    continue
                call.drops += 1
                if call.drops > _MAX_DROPS:
                    self._calls[ended.key] = call
                    raise watch.lost()
                watch.wait_until_connected()
                self._hand_out(client, call)
        except ClusterError as error:
            self._lost = error
            for call in list(self._calls.values()):
                if not call.future.cancelled():
                    call.future.set_exception(error)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more calls.

        Args:
            wait: Wait for those that were taken.
            cancel_futures: Drop them.
        """
        calls = list(self._calls.values())
        if cancel_futures:
            for call in calls:
                call.future.cancel()
            if calls and self._client is not None and self._client.status == "running":
                with suppress(OSError):
                    self._client.cancel([call.theirs for call in calls])
        elif wait and self._lost is None:
            wait_for([call.future for call in calls])
        if self._thread is not None:
            self._ended.put(None)
            self._thread.join()
        self._client = self._thread = None
        self._stack.close()

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        self.shutdown(cancel_futures=exc_type is not None)


def _settle(future: Future[Any], theirs: Any) -> bool:
    """Give a call what Dask's future has; false if the scheduler has dropped the call."""
    try:
        if theirs.status == "finished":
            future.set_result(theirs.result())
            return True
        if theirs.status == "error":
            future.set_exception(_call_error(theirs.exception()))
            return True
    except Exception:  # of many kinds: the worker that has it died just then
        return False
    return False


def _call_error(error: Any) -> CallError:
    if isinstance(error, CallError):
        return error
    if type(error).__name__ == "KilledWorker":
        return CallError(
            f"{error.allowed_failures + 1} workers died on it, perhaps for lack of memory. See "
            "their logs."
        )
    lines = str(error.__cause__ or error).strip().splitlines() or [""]
    return CallError(
        f"the cluster could not run it ({type(error).__name__}: {lines[0]}). The same version of "
        "mp4ds must be installed where the scheduler and its workers run."
    )
