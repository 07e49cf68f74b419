"""Ways to a Dask cluster: a scheduler that runs, jobs of a batch system, this machine."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from mp4ds.engine.cluster_batch import BATCH_SYSTEMS, batch_cluster
from mp4ds.errors import ClusterError, OptionError

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

LOCAL = "local"
_LOOPBACK = "127.0.0.1"
_SCHEMES = ("tcp", "tls")
_CONNECT_SECONDS = 15.0
_CONNECT_POLL_SECONDS = 0.1
_ENDED = ("closing", "closed")
_LOOK_SECONDS = 5.0
_WORKER_SECONDS = 5 * 60.0
_BATCH_WORKER_SECONDS = 12 * 3600.0
_GO_ON = "What is finished is kept: run the same command again to go on."


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
                f"Start some, or see why they ended. {_GO_ON}",
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
            "the connection to the Dask scheduler was lost, or it has dropped the tasks",
            f"See whether it still runs. {_GO_ON}",
        )


def check_address(address: str) -> None:
    """Refuse what is no way to a cluster, or needs a package that is not there.

    Raises:
        OptionError: Says what is wrong.
    """
    if address not in (LOCAL, *BATCH_SYSTEMS) and not _is_of_scheduler(address):
        raise OptionError(
            f"--cluster {address!r} is neither tcp://HOST:PORT or tls://HOST:PORT of a Dask "
            f"scheduler nor one of {', '.join(BATCH_SYSTEMS)}, {LOCAL}."
        )
    needed = {LOCAL: "cryptography"} | dict.fromkeys(BATCH_SYSTEMS, "dask_jobqueue")
    for name in filter(None, ("distributed", needed.get(address))):
        if find_spec(name) is None:
            raise OptionError(
                f"--cluster {address} needs {name.replace('_', '-')}, which is not installed. "
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
    """See whether a scheduler answers: a client waits for ever where something else listens.

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
                f"--cluster {address} needs certificates: name them under distributed.comm.tls "
                "in the configuration of Dask, ~/.config/dask/distributed.yaml."
            )
        greeting = connect(address, timeout=_CONNECT_SECONDS, **arguments)
        comm = await asyncio.wait_for(greeting, _CONNECT_SECONDS)
    except OptionError:
        raise
    except (OSError, asyncio.TimeoutError) as error:
        raise _unreachable(address, error) from None
    except Exception:  # of any kind, as it takes what it reads for lengths
        raise ClusterError(
            address, "what answers there is not a Dask scheduler", "Check the port."
        ) from None
    comm.abort()


def _unreachable(address: str, error: Exception) -> ClusterError:
    reason = str(error.__cause__ or error)
    return ClusterError(
        address,
        "no Dask scheduler could be reached" + (f" ({reason})" if reason else ""),
        "Check the address, that `dask scheduler` runs there, and that a firewall lets it through.",
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
            "DASK_MP4DS__WORKER_TIMEOUT, or mp4ds.worker-timeout in the configuration of Dask, "
            f"is {patience!r}. Give a time, such as '10 minutes'."
        ) from None
