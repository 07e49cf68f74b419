"""An executor whose calls run on Dask workers: of a cluster, or of batch jobs."""

from __future__ import annotations

import asyncio
import importlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, InvalidStateError, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar
from urllib.parse import urlsplit

from mp4ds.errors import Mp4dsError, OptionError, RemoteError
from mp4ds.processes import failure_of, release_memory

if TYPE_CHECKING:
    from dask_jobqueue import JobQueueCluster
    from distributed import Client

_P = ParamSpec("_P")
_T = TypeVar("_T")

BATCH_SYSTEMS = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "sge": "SGECluster",
    "lsf": "LSFCluster",
    "htcondor": "HTCondorCluster",
    "oar": "OARCluster",
}
"""Name, also of its configuration -> class of dask-jobqueue."""

_SCHEMES = ("tcp", "tls")
_CONNECT_SECONDS = 15.0
_LOOK_SECONDS = 5.0
_WORKER_SECONDS = 5 * 60.0
_BATCH_WORKER_SECONDS = 12 * 3600.0
_MOST_JOBS = 16
_SETTINGS = "~/.config/dask/jobqueue.yaml"
_DROPPED = "the connection to the Dask scheduler was lost, or it dropped the tasks"
_IS_IT_RUNNING = "Check whether it is still running."
_GO_ON = "Finished work is kept: run the same command again to resume."


@contextmanager
def cluster_executor(address: str, calls: int) -> Iterator[Executor]:
    """Connect to a Dask cluster; leaving with an exception drops the calls that wait.

    Each call is made on a worker, which imports what is called by its name. A call whose worker
    dies is made on another one, as often as the scheduler's
    ``distributed.scheduler.allowed-failures`` allows; one that raises is not. If the connection
    breaks, or the cluster has no workers for long, all calls fail with a `RemoteError`. On a
    cluster that keeps running, running calls finish: nothing can stop a thread of a worker from
    outside. Whatever was started for the calls ends with them.

    Args:
        address: ``tcp://HOST:PORT`` or ``tls://HOST:PORT`` of a scheduler, which is left as it
            is; ``slurm``, ``pbs``, ``sge``, ``lsf``, ``htcondor`` or ``oar`` for jobs of that
            batch system, as dask-jobqueue is configured, which are ended after the last call.
        calls: Maximum number of parallel calls.

    Raises:
        OptionError: The address has none of these forms, a package is missing, or the
            configuration of Dask lacks something.
        RemoteError: No scheduler responds within 15 s, or the batch system refuses the jobs.
    """
    _check_address(address)
    from distributed import Client
    from distributed.utils import silence_logging_cmgr

    is_batch = address in BATCH_SYSTEMS
    patience = _patience(_BATCH_WORKER_SECONDS if is_batch else _WORKER_SECONDS)
    with ExitStack() as stack:
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL))  # what matters is raised
        place: Any = address
        jobs = 0
        if is_batch:
            jobs = min(calls, _most_jobs())
            place = stack.enter_context(_batch_cluster(address, jobs))
        else:
            _check_scheduler(address)
        try:
            client = Client(place, timeout=_CONNECT_SECONDS, set_as_default=False)
        except (OSError, ImportError) as error:
            raise _unreachable(address, error) from None
        # a scheduler drops the waiting calls of a client that leaves
        executor = _ClientExecutor(stack.enter_context(client), address)

        def refill() -> None:
            if is_batch:
                _submit_jobs(place, jobs)  # what is refused now may be accepted next time

        watch = threading.Thread(target=executor.watch, args=(patience, refill), daemon=True)
        watch.start()
        stack.callback(watch.join)
        stack.callback(executor.closed.set)
        yield executor


class _ClientExecutor(Executor):
    """Makes calls by a client. Dask's own executor waits for ever when a connection breaks.

    Attributes:
        closed: Set when calls are no longer of interest.
    """

    def __init__(self, client: Client, address: str) -> None:
        self._client, self._address = client, address
        self._calls: dict[Future[Any], Any] = {}  # -> Dask's; what nobody holds is not made
        self._lost: RemoteError | None = None
        self.closed = threading.Event()

    def submit(self, fn: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Make a call on a worker.

        Raises:
            RemoteError: The cluster was lost.
        """
        if self._lost is not None:
            raise self._lost
        call: Future[_T] = Future()
        # not pure: another call with the same arguments shares nothing with this one
        theirs = self._client.submit(_attempt, partial(fn, *args, **kwargs), pure=False)
        self._calls[call] = theirs
        theirs.add_done_callback(partial(self._hand_on, call))
        return call

    def _hand_on(self, call: Future[Any], theirs: Any) -> None:
        """Give a call what Dask's future has; in a thread of the client."""
        if self.closed.is_set() or call.cancelled():
            return
        result, failure = None, None
        try:
            if theirs.status == "cancelled":
                raise ConnectionError  # as if it had broken while the result was fetched
            result = theirs.result()
        except Mp4dsError as error:
            failure = error
        except OSError:
            self._fail(_DROPPED, _IS_IT_RUNNING)
            return
        except Exception as error:  # of many kinds: its workers died, or lack what is called
            lines = str(error.__cause__ or error).strip().splitlines() or [type(error).__name__]
            failure = Mp4dsError(
                f"the cluster could not run it: {lines[0].rstrip('.')}. See the logs of its "
                "workers, which must have the same version of mp4ds."
            )
        with suppress(InvalidStateError):  # it failed with all others just now
            if failure is None:
                call.set_result(result)
            else:
                call.set_exception(failure)
        self._calls.pop(call, None)

    def _fail(self, problem: str, hint: str) -> None:
        """Let all calls fail: the cluster is lost."""
        self._lost = RemoteError(self._address, problem, f"{hint} {_GO_ON}")
        for call in list(self._calls):
            with suppress(InvalidStateError):  # it is done
                call.set_exception(self._lost)

    def watch(self, patience: float, refill: Callable[[], None]) -> None:
        """Detect that calls will never be made; in a thread."""
        seen = time.monotonic()
        while not self.closed.wait(_LOOK_SECONDS) and self._lost is None:
            if self._client.status in ("closing", "closed"):
                self._fail(_DROPPED, _IS_IT_RUNNING)
            elif self._client.status == "running":  # otherwise it reconnects, or gives up
                if self._calls:
                    refill()
                has_workers = False
                with suppress(OSError):  # unknown
                    has_workers = bool(self._client.nthreads())
                if has_workers or not self._calls:
                    seen = time.monotonic()
                elif time.monotonic() - seen >= patience:
                    problem = f"has had no worker for {patience:g} s"
                    self._fail(problem, "Start some, or find out why they ended.")


def _attempt(call: Callable[[], _T]) -> _T:
    """Make a call in a thread of this worker.

    Raises:
        Mp4dsError: It failed.
    """
    from distributed import get_worker

    try:
        return call()
    except Exception as error:
        told = failure_of(error)
        failure = Mp4dsError(f"on worker {get_worker().address}: {told}")
        failure.exit_code = told.exit_code
        raise failure from None
    finally:
        release_memory()  # a worker using too much is paused and gets no more calls


# ---------------------------------------------------------------- schedulers


def _check_address(address: str) -> None:
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


def _check_scheduler(address: str) -> None:
    """Check that a scheduler answers: a client waits forever if something else listens.

    Raises:
        RemoteError: None does.
        OptionError: There are no certificates.
    """
    with ThreadPoolExecutor(1) as thread:  # the caller's thread may have a running loop
        thread.submit(asyncio.run, _greet(address)).result()


async def _greet(address: str) -> None:
    from distributed.comm import connect
    from distributed.security import Security

    arguments = Security().get_connection_args("client")
    if address.startswith("tls:") and arguments.get("ssl_context") is None:
        raise OptionError(
            f"`cluster` {address} needs certificates: set them under distributed.comm.tls in "
            "Dask's configuration, ~/.config/dask/distributed.yaml."
        )
    try:
        greeting = connect(address, timeout=_CONNECT_SECONDS, **arguments)
        comm = await asyncio.wait_for(greeting, _CONNECT_SECONDS)
    except (OSError, asyncio.TimeoutError) as error:
        raise _unreachable(address, error) from None
    except Exception:  # of any kind, since it interprets what it reads as lengths
        raise RemoteError(
            address, "the server there is not a Dask scheduler", "Check the port."
        ) from None
    comm.abort()


def _unreachable(address: str, error: Exception) -> RemoteError:
    reason = str(error.__cause__ or error)
    return RemoteError(
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


# ---------------------------------------------------------------- batch systems


@contextmanager
def _batch_cluster(system: str, jobs: int) -> Iterator[JobQueueCluster]:
    """Submit jobs, and cancel them at the end.

    Raises:
        RemoteError: The batch system refuses the jobs.
        OptionError: The configuration lacks something.
    """
    import dask

    module = importlib.import_module("dask_jobqueue")  # loads its part of the configuration
    # it says so itself, but what it had made until then complains again when collected
    for name in ("cores", "memory"):
        if dask.config.get(f"jobqueue.{system}.{name}", None) is None:
            raise OptionError(
                f"`cluster` {system}: {_SETTINGS} does not say how many cores and how much "
                f"memory a job has: set cores and memory under jobqueue: {system}."
            )
    try:
        cluster = getattr(module, BATCH_SYSTEMS[system])()
    except (ValueError, TypeError, RuntimeError, OSError) as error:
        raise OptionError(
            f"`cluster` {system}: {_line(error)} The settings are in {_SETTINGS}, under jobqueue: "
            f"{system}."
        ) from None
    with cluster:
        if problem := _submit_jobs(cluster, jobs):
            raise RemoteError(
                system,
                f"the jobs could not be submitted: {problem.rstrip('.')}",
                f"The settings are in {_SETTINGS}.",
            )
        yield cluster


def _submit_jobs(cluster: JobQueueCluster, jobs: int) -> str:
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


def _most_jobs() -> int:
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
