"""Tasks on the workers of a Dask cluster: one that runs, jobs of a batch system, this machine."""

from __future__ import annotations

import asyncio
import importlib
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from mp4ds.errors import ClusterError, OptionError
from mp4ds.packing.engine import Outcome, give_back

if TYPE_CHECKING:
    from dask_jobqueue import JobQueueCluster
    from distributed import Client, Future, LocalCluster

_PATIENCE_SECONDS = 3.0
_MIB = 2**20


class TaskFailedError(Exception):
    """What a task failed with, in strings: the error itself may not survive the journey.

    Args:
        kind: Name of its class.
        sentence: What it says.
    """

    def __init__(self, kind: str, sentence: str) -> None:
        self.kind = kind
        self.sentence = sentence
        super().__init__(kind, sentence)


class Room:
    """The memory of a worker, as its tasks share it out among themselves.

    Args:
        size: Bytes.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._taken = 0
        self._changed = threading.Condition()

    @contextmanager
    def taken(self, count: int) -> Iterator[bool]:
        """Hold some of it.

        Args:
            count: Bytes.

        Yields:
            Whether they came free in a few seconds.
        """
        with self._changed:
            has_room = self._changed.wait_for(
                lambda: self._taken + count <= self.size, _PATIENCE_SECONDS
            )
            self._taken += count * has_room
        try:
            yield has_room
        finally:
            with self._changed:
                self._taken -= count * has_room
                self._changed.notify_all()


def attempt(task: tuple[str, ...], *, function: Callable[..., None], task_bytes: int) -> None:
    """Run a task in a thread of this worker.

    Where other tasks hold the worker's memory, it goes back to the scheduler, which gives it to
    another worker or here again: a task that waited here would keep a thread, and would run
    even if it is no longer wanted.

    Args:
        task: Strings that the function takes.
        function: What to call.
        task_bytes: Memory that it takes.

    Raises:
        TaskFailedError: It failed, or this worker is too small.
        Reschedule: There is no room now.
    """
    from distributed import Reschedule, get_worker

    worker = get_worker()
    limit: int | None = worker.memory_manager.memory_limit
    if not limit:
        return _call(function, task, worker.address)
    if limit < task_bytes:
        raise TaskFailedError(
            "OptionError",
            f"on worker {worker.address}: it has {limit // _MIB} MiB of memory, and a task takes "
            f"up to {-(-task_bytes // _MIB)} MiB. Start workers with a larger --memory-limit.",
        )
    # The worker keeps it, for all packs that it works for share its memory.
    room: Room = vars(worker).setdefault("mp4ds_room", Room(limit))
    with room.taken(task_bytes) as has_room:
        if not has_room:
            raise Reschedule
        return _call(function, task, worker.address)


def _call(function: Callable[..., None], task: tuple[str, ...], where: str) -> None:
    try:
        function(*task)
    except MemoryError:
        raise TaskFailedError("MemoryError", f"on worker {where}: out of memory.") from None
    except Exception as error:
        kind = type(error).__name__
        raise TaskFailedError(kind, f"on worker {where}: {str(error) or kind}") from None
    finally:
        give_back()  # with too much of it, a worker is paused and takes no more tasks


# ---------------------------------------------------------------- batch systems

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
    with _opened_jobs(getattr(module, BATCH_SYSTEMS[system]), system) as cluster:
        problem = _submit(cluster, jobs)
        if problem:
            raise ClusterError(
                system,
                f"the jobs could not be submitted: {problem.rstrip('.')}",
                f"The settings are in {_SETTINGS}.",
            )

        def refill() -> None:
            _submit(cluster, jobs)  # what is refused now may be taken the next time

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
            f"DASK_MP4DS__JOBS, or mp4ds.jobs in Dask's configuration, is {jobs!r}. Give a number "
            "of jobs, 1 or more."
        )
    return jobs


def _line(error: Exception) -> str:
    """The line of an error that says most: of a command, the last that it wrote."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not lines:
        return type(error).__name__
    return lines[-1] if lines[0].startswith("Command exited") else lines[0]


# ---------------------------------------------------------------- access

LOCAL = "local"
_LOOPBACK = "127.0.0.1"
_SCHEMES = ("tcp", "tls")
_CONNECT_SECONDS = 15.0
_CONNECT_POLL_SECONDS = 0.1
_ENDED = ("closing", "closed")
_LOOK_SECONDS = 5.0
_WORKER_SECONDS = 5 * 60.0
_BATCH_WORKER_SECONDS = 12 * 3600.0
_GO_ON = "Finished work is kept: run the same command again to resume."


class Watch:
    """Notices when nothing will be heard of tasks any more.

    Args:
        client: Connected.
        address: What the user called the cluster.
        patience: Seconds without any worker that are borne.
        refill: Brings back workers that have ended, where that can be done from here.
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

    def begin(self) -> None:
        """Begin to wait for tasks; the time before, in which there were none, does not count.

        Raises:
            ClusterError: The scheduler is lost.
        """
        self._next = 0.0
        self._empty_since = None
        self.wait_until_connected()

    def look(self) -> None:
        """Look after the cluster, unless that was done just now.

        Raises:
            ClusterError: The scheduler is lost, or there have been no workers for too long.
        """
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + _LOOK_SECONDS
        if self._client.status in _ENDED:
            raise self.lost()
        if self._client.status != "running":
            return  # it connects again, or gives up
        if self._refill is not None:
            self._refill()
        try:
            has_workers = bool(self._client.nthreads())
        except OSError:
            has_workers = False  # that is not known
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
        """Wait for a client that connects again.

        Raises:
            ClusterError: The scheduler is lost.
        """
        while self._client.status != "running":
            if self._client.status in _ENDED:
                raise self.lost()
            time.sleep(_CONNECT_POLL_SECONDS)

    def lost(self) -> ClusterError:
        """What to raise when the scheduler does not know the tasks any more."""
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
    if address not in (LOCAL, *BATCH_SYSTEMS) and not _is_of_scheduler(address):
        raise OptionError(
            f"`cluster` {address!r} is neither tcp://HOST:PORT or tls://HOST:PORT of a Dask "
            f"scheduler nor one of {', '.join(BATCH_SYSTEMS)}, {LOCAL}."
        )
    needed = {LOCAL: "cryptography"} | dict.fromkeys(BATCH_SYSTEMS, "dask_jobqueue")
    for name in filter(None, ("distributed", needed.get(address))):
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


class Connection:
    """A way to a cluster, opened when it is first needed, and kept.

    Jobs of a batch system, which may have had to queue, are so of use to more than one run of
    tasks. A context manager; what was started for it is ended with it.

    Args:
        address: As `ClusterEngine` takes it.
        tasks: Most that there are to run at a time.

    Raises:
        OptionError: The address is none, or a package is missing.
    """

    def __init__(self, address: str, tasks: int) -> None:
        check_address(address)
        self._address = address
        self._tasks = tasks
        self._stack = ExitStack()
        self._way: tuple[Client, Watch] | None = None

    def way(self) -> tuple[Client, Watch]:
        """What tasks are handed out with, ready for some.

        Raises:
            ClusterError: No scheduler answers in 15 s, the batch system refuses the jobs, or the
                scheduler was lost since.
            OptionError: The configuration lacks something.
        """
        if self._way is None:
            self._way = self._stack.enter_context(_opened(self._address, self._tasks))
        self._way[1].begin()
        return self._way

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_: object) -> None:
        self._way = None
        self._stack.close()


@contextmanager
def _opened(address: str, tasks: int) -> Iterator[tuple[Client, Watch]]:
    """Open the way to a cluster; what is started for it is ended with it.

    Args:
        address: One that `check_address` takes.
        tasks: How many there are to run.

    Raises:
        ClusterError: No scheduler answers in 15 s, or the batch system refuses the jobs.
        OptionError: The configuration lacks something.
    """
    from distributed import Client
    from distributed.utils import silence_logging_cmgr

    is_batch = address in BATCH_SYSTEMS
    patience = _patience(_BATCH_WORKER_SECONDS if is_batch else _WORKER_SECONDS)
    with ExitStack() as stack:
        stack.enter_context(silence_logging_cmgr(logging.CRITICAL))  # what matters is raised
        place: object = address
        refill = None
        if is_batch:
            place, refill = stack.enter_context(batch_cluster(address, tasks))
        elif address == LOCAL:
            place = stack.enter_context(_local_cluster(tasks))
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
    with ThreadPoolExecutor(1) as thread:  # in the caller's own, a loop may be running
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
    except Exception:  # of any kind, as it takes what it reads for lengths
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


@contextmanager
def _local_cluster(tasks: int) -> Iterator[LocalCluster]:
    """Workers of this user alone: who connects needs a certificate that is in memory only.

    Dask listens for HTTP, too, whatever it is told: on the loopback, and there is nothing to see.
    """
    import dask
    from dask.system import CPU_COUNT
    from distributed import LocalCluster, Security

    no_pages: dict[str, list[str]] = {
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
    }
    with (
        dask.config.set(no_pages),  # workers are given it when they start
        TemporaryDirectory(prefix="mp4ds-") as folder,
        LocalCluster(
            n_workers=min(tasks, CPU_COUNT),
            threads_per_worker=1,
            host=_LOOPBACK,
            security=Security.temporary(),
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": f"{_LOOPBACK}:0"},
            worker_dashboard_address=f"{_LOOPBACK}:0",
            local_directory=folder,
            silence_logs=logging.CRITICAL,
        ) as cluster,
    ):
        yield cluster


def _patience(seconds: float) -> float:
    """Seconds without any worker that are borne.

    Raises:
        OptionError: The configuration has no time there.
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


# ---------------------------------------------------------------- the engine

_POLL_SECONDS = 1.0
_MAX_DROPS = 3


class ClusterEngine:
    """Runs each task on a worker of a Dask cluster. See `Engine`.

    A task whose worker dies is run on another one, as often as the scheduler's
    ``distributed.scheduler.allowed-failures`` says; one that raises is not run again. Tasks that
    the scheduler drops, as it does when the connection breaks, are handed out again. What a task
    tells while it runs is not heard.

    Args:
        function: Called with the strings of a task; workers import it by its name.
        address: ``tcp://HOST:PORT`` or ``tls://HOST:PORT`` of a scheduler, which is left as it
            is; ``slurm``, ``pbs``, ``sge``, ``lsf``, ``htcondor`` or ``oar`` for jobs of that
            batch system, as dask-jobqueue is configured, which are ended after the last task;
            ``local`` for workers on this machine. Or a connection, which several engines and runs
            share.
        task_bytes: Memory of a task; a worker runs as many at a time as its own holds.

    Raises:
        OptionError: The address is none of these, or a package is missing.
    """

    def __init__(
        self, function: Callable[..., None], address: str | Connection, *, task_bytes: int
    ) -> None:
        if isinstance(address, str):
            check_address(address)
        self._function = function
        self._address = address
        self._task_bytes = task_bytes

    def run(
        self,
        tasks: Sequence[tuple[str, ...]],
        on_progress: Callable[[tuple[str, ...], dict[str, Any]], None],
    ) -> Generator[Outcome, None, None]:
        """See `Engine.run`.

        Closing the generator drops the tasks that wait; on a cluster that continues, those that
        run come to their end, for nothing stops the thread of a worker from outside.

        Raises:
            ClusterError: No scheduler answers, it was lost, or there are no workers.
            OptionError: The configuration of Dask lacks something.
        """
        if not tasks:
            return
        with ExitStack() as stack:
            connection = self._address
            if isinstance(connection, str):
                connection = stack.enter_context(Connection(connection, len(tasks)))
            yield from self._run(*connection.way(), tasks)

    def _run(
        self, client: Client, watch: Watch, tasks: Sequence[tuple[str, ...]]
    ) -> Generator[Outcome, None, None]:
        waiting: dict[str, tuple[tuple[str, ...], Future]] = {}
        heard: queue.SimpleQueue[Future] = queue.SimpleQueue()
        drops: Counter[tuple[str, ...]] = Counter()

        def hand_out(some: Sequence[tuple[str, ...]]) -> None:
            futures = client.map(
                attempt,
                list(some),
                function=self._function,
                task_bytes=self._task_bytes,
                key=f"mp4ds-{self._function.__name__}",
                pure=False,  # another run of the same tasks shares nothing with this one
            )
            for task, future in zip(some, futures, strict=True):
                waiting[future.key] = (task, future)
                future.add_done_callback(heard.put)

        hand_out(tasks)
        try:
            while waiting:
                watch.look()
                try:
                    ended = heard.get(timeout=_POLL_SECONDS)
                except queue.Empty:
                    continue
                task, _ = waiting.pop(ended.key)
                outcome = self._outcome(task, ended)
                del ended, _  # the scheduler forgets what nobody holds
                if outcome is not None:
                    yield outcome
                    continue
                drops[task] += 1
                if drops[task] > _MAX_DROPS:
                    raise watch.lost()
                watch.wait_until_connected()
                hand_out([task])
        finally:
            if waiting and client.status == "running":
                with suppress(OSError):
                    client.cancel([future for _, future in waiting.values()])

    def _outcome(self, task: tuple[str, ...], future: Future) -> Outcome | None:
        """What became of a task; None if the scheduler has dropped it and nobody knows."""
        if future.status == "finished":
            return Outcome(task)
        if future.status != "error":
            return None
        error = future.exception()
        if isinstance(error, TaskFailedError):
            return Outcome(task, (error.kind, error.sentence))
        if type(error).__name__ == "KilledWorker":
            said = (
                f"{error.allowed_failures + 1} workers died on it, perhaps for lack of memory: it "
                f"takes up to {-(-self._task_bytes // _MIB)} MiB. See their logs."
            )
            return Outcome(task, ("Killed", said))
        lines = str(error.__cause__ or error).strip().splitlines() or [""]
        said = (
            f"the cluster could not run it ({type(error).__name__}: {lines[0]}). The same version "
            "of mp4ds must be installed where the scheduler and its workers run."
        )
        return Outcome(task, ("Failed", said))
