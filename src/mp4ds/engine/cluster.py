"""Tasks on the workers of a Dask cluster.

The scheduler does what it is made for: it hands tasks to workers as these come and go, and those
of a dead worker to others. Only strings pass through it.
"""

from __future__ import annotations

import queue
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

from mp4ds.engine.cluster_access import Connection, Watch, check_address
from mp4ds.engine.cluster_worker import TaskFailedError, attempt
from mp4ds.engine.protocol import Outcome

if TYPE_CHECKING:
    from distributed import Client, Future

_POLL_SECONDS = 1.0
_MAX_DROPS = 3
_MIB = 2**20


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

        Closing the generator drops the tasks that wait; on a cluster that goes on, those that
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
        """What became of a task; None where the scheduler has dropped it and nobody knows."""
        if future.status == "finished":
            return Outcome(task)
        if future.status != "error":
            return None
        error = future.exception()
        if isinstance(error, TaskFailedError):
            return Outcome(task, (error.kind, error.sentence))
        if type(error).__name__ == "KilledWorker":
            said = (
                f"{error.allowed_failures + 1} workers died over it, perhaps for want of memory: "
                f"it takes up to {-(-self._task_bytes // _MIB)} MiB. Their logs tell more."
            )
            return Outcome(task, ("Killed", said))
        lines = str(error.__cause__ or error).strip().splitlines() or [""]
        said = (
            f"the cluster could not run it ({type(error).__name__}: {lines[0]}). The same version "
            "of mp4ds must be installed where the scheduler and its workers run."
        )
        return Outcome(task, ("Failed", said))
