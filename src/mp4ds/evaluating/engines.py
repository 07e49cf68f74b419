"""What runs the trials of an evaluation: processes of this machine, or the workers of a cluster."""

from __future__ import annotations

from contextlib import ExitStack

from mp4ds.engine import Engine, ProcessEngine
from mp4ds.evaluating.options import EvaluateOptions
from mp4ds.evaluating.work import command, run_task


class Engines:
    """Makes engines, which share one connection to a cluster. A context manager that ends it.

    Args:
        options: Of the evaluation.
        most: Trials that there are at a time.

    Raises:
        OptionError: There is no such cluster, or a package is missing.
    """

    def __init__(self, options: EvaluateOptions, most: int) -> None:
        self._jobs = options.jobs
        self._stack = ExitStack()
        self._connection = None
        if options.cluster:
            from mp4ds.engine.cluster_access import Connection

            self._connection = self._stack.enter_context(Connection(options.cluster, most))

    def engine(self, task_bytes: int) -> Engine:
        """An engine for trials.

        Args:
            task_bytes: Memory of the largest one.
        """
        if self._connection is None:
            return ProcessEngine(command, self._jobs)
        from mp4ds.engine.cluster import ClusterEngine

        return ClusterEngine(run_task, self._connection, task_bytes=task_bytes)

    def __enter__(self) -> Engines:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
