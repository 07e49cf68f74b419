"""An executor whose calls run on the workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager

from distributed import Client
from distributed.comm import connect
from distributed.security import Security
from distributed.utils import silence_logging_cmgr

from mp4ds.errors import RemoteError

_CONNECT_SECONDS = 15.0
_WORKER_SECONDS = 300.0


@contextmanager
def cluster_executor(address: str) -> Iterator[Executor]:
    """Dask's own executor of a cluster; leaving drops the calls that wait.

    A call whose worker dies is made on another one, as often as the scheduler's
    ``distributed.scheduler.allowed-failures`` allows. If the connection breaks, calls are
    cancelled.

    Args:
        address: ``tcp://HOST:PORT`` or ``tls://HOST:PORT`` of a scheduler.

    Raises:
        RemoteError: No scheduler responds there within 15 s, or it has no worker for 5 minutes.
    """
    with silence_logging_cmgr(logging.CRITICAL):  # what matters is raised
        try:
            with ThreadPoolExecutor(1) as thread:  # the caller's thread may have a running loop
                thread.submit(asyncio.run, _greet(address)).result()
            client = Client(address, timeout=_CONNECT_SECONDS, set_as_default=False)
        except Exception as error:  # of any kind, since it interprets what another server says
            why = str(error.__cause__ or error) or type(error).__name__
            raise RemoteError(
                address,
                f"no Dask scheduler can be reached ({why})",
                "Give tcp://HOST:PORT, and check that `dask scheduler` is running there and that "
                "no firewall blocks it.",
            ) from None
        with client:  # a scheduler drops the waiting calls of a client that leaves
            try:
                client.wait_for_workers(1, timeout=_WORKER_SECONDS)
            except asyncio.TimeoutError:
                problem = f"has had no worker for {_WORKER_SECONDS:g} s"
                raise RemoteError(address, problem, "Start some.") from None
            # not pure: another call with the same arguments shares nothing with this one
            yield client.get_executor(pure=False)


async def _greet(address: str) -> None:
    """Connect, and leave: a client waits for ever if something else listens."""
    arguments = Security().get_connection_args("client")
    greeting = connect(address, timeout=_CONNECT_SECONDS, **arguments)
    (await asyncio.wait_for(greeting, _CONNECT_SECONDS)).abort()
