"""One task of a divided pack; ``python -m mp4ds.packing.work FOLDER TASK`` runs it.

Every engine calls `run_task`. It is idempotent: if its result exists, it does nothing.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from mp4ds.bags.protocols import BagReader
from mp4ds.errors import Mp4dsError, sentence_of
from mp4ds.files.outputs import write_synced
from mp4ds.files.sources import unchanged
from mp4ds.packing.engine import release_memory, serve, tell
from mp4ds.packing.job import Job, Task, digest_source
from mp4ds.packing.manifest import RECORD_NAME, Origin, PartRecord, dump_kept, write_manifest
from mp4ds.packing.packer import Exact, Packer, until_in_reach
from mp4ds.packing.workplace import Workplace

_REPORT_SECONDS = 0.5
_KEPT_BYTES = 400 * 2**20


Progress = Callable[[dict[str, Any]], None]


def run_task(folder: str, name: str, progress: Progress | None = None) -> None:
    """Make the result of a task, unless it exists.

    Args:
        folder: Of the pack.
        name: Of the task.
        progress: Called twice a second with frames and messages done, by topic.

    Raises:
        SourceError: The recording is damaged, or has changed.
        OSError: It cannot be written.
    """
    with Tasks() as tasks:
        tasks.run(folder, name, progress)


class Tasks:
    """Runs tasks one after another; a recording stays open between those of one pack."""

    def __init__(self) -> None:
        self._job: Job | None = None
        self._reader: BagReader | None = None

    def run(self, folder: str, name: str, progress: Progress | None = None) -> None:
        """See `run_task`."""
        place = Workplace(Path(folder))
        job = place.job(shared=True)  # the caller has checked the owner
        if job is None:
            raise Mp4dsError(f"{folder} holds no pack in progress.")
        task = job.task(name)
        with place.making(task) as into:
            if into is None:
                return
            with unchanged(job.sources):
                if task.source is not None:
                    _digest(job, task.source, into)
                else:
                    self._pack(job, task, into, progress)

    def _pack(self, job: Job, task: Task, into: Path, progress: Progress | None) -> None:
        next_report = 0.0

        def report(part: PartRecord) -> None:
            nonlocal next_report
            now = time.monotonic()
            if progress is not None and now >= next_report:
                next_report = now + _REPORT_SECONDS
                progress(told(part))

        def make(exact: Exact) -> PartRecord:
            for path in into.iterdir():
                path.unlink()
            return Packer(reader, into, job.settings(task, exact), report).run()

        reader = self._open(job)

        part = until_in_reach(make)
        if progress is not None:
            progress(told(part))
        write_manifest(part, reader, Origin(), job.options["quality"])
        part.save()

    def _open(self, job: Job) -> BagReader:
        # avoid reading an index of millions of messages for every task
        if self._reader is None or self._job != job:
            self.close()
            self._reader = job.open()
            self._job = job
        return self._reader

    def close(self) -> None:
        """Close the recording."""
        if self._reader is not None:
            self._reader.__exit__()
        self._reader = None

    def __enter__(self) -> Tasks:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _digest(job: Job, number: int, into: Path) -> None:
    size, sha256 = digest_source(job.sources[number])
    record = {"size": size, "sha256": sha256, "files": {}}
    write_synced(into / RECORD_NAME, dump_kept(record))


def told(part: PartRecord) -> dict[str, Any]:
    """A task's progress: messages and bytes of each topic."""
    return {
        "topics": {topic.topic: (topic.messages, topic.raw_bytes) for topic in part.topics.values()}
    }


def command(task: tuple[str, ...]) -> list[str]:
    """The command line that runs a task, and then further ones from standard input."""
    return [sys.executable, "-m", "mp4ds.packing.work", *task]


def _outcome(tasks: Tasks, folder: str, name: str) -> dict[str, Any]:
    """Run a task and report its outcome."""
    begun, used = time.monotonic(), time.process_time()
    try:
        tasks.run(folder, name, tell)
    except MemoryError:
        return {"error": ("MemoryError", "out of memory; try fewer `jobs`")}
    except (Mp4dsError, OSError) as error:
        tasks.close()  # it may be damaged in the part that was prefetched
        said = str(error) if isinstance(error, Mp4dsError) else sentence_of(error)
        return {"error": (type(error).__name__, said), "ready": True}
    peak = _memory("VmHWM")
    release_memory()
    return {
        "done": True,
        # memory fragmented by large encoders is only released by exiting
        "ready": _memory("VmRSS") < _KEPT_BYTES,
        "seconds": time.monotonic() - begun,
        "cpu_seconds": time.process_time() - used,
        "peak_bytes": peak,
    }


def _memory(name: str) -> int:
    """A figure of this process's memory, in bytes; 0 if unknown."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        # not getrusage, which counts what the process was forked from
        words = Path("/proc/self/status").read_text().split()
        return 1024 * int(words[words.index(f"{name}:") + 1])
    return 0


def _main() -> None:
    with Tasks() as tasks:
        serve(partial(_outcome, tasks))


if __name__ == "__main__":
    _main()
