"""The folder in which a divided pack is made: its job, and the results of its tasks.

It stands beside the dataset, on the same file system, under a name that the dataset's tells, so
that the same command finds it again. A task's result appears in it by one rename, when whole.
"""

from __future__ import annotations

import errno
import fcntl
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mp4ds.errors import OptionError, TargetError, WriteError
from mp4ds.outputs import as_write_error, sync, sync_folder, write_synced
from mp4ds.packing.job import Job, Task, tools
from mp4ds.packing.part import read_record
from mp4ds.remote import location

_JOB_NAME = "job.json"
_ANEW = "Begin anew with --restart."
_FULL = (errno.ENOSPC, errno.EDQUOT)


class Workplace:
    """See the module.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.parts = folder / "parts"

    @classmethod
    def beside(cls, target: Path) -> Workplace:
        """That of a dataset, whether it exists or not."""
        return cls(target.parent / f".{target.name}.mp4ds-part")

    @contextmanager
    def claimed(self, *, shared: bool) -> Iterator[None]:
        """Hold the place while working in it.

        Args:
            shared: Others may work on other tasks at the same time.

        Raises:
            TargetError: Another pack is at work, or the folder cannot be made.
            WriteError: The disk is full.
        """
        try:
            self.parts.mkdir(parents=True, exist_ok=True)
            lock = (self.folder / "lock").open("w")
        except OSError as error:
            if error.errno in _FULL:
                self._remove_empty()
                raise WriteError(self.folder, error) from None
            raise TargetError(
                self.folder, f"cannot be made: {error.strerror}", "Choose another folder."
            ) from None
        with lock:
            try:
                fcntl.flock(lock, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            except BlockingIOError:
                raise TargetError(
                    self.folder, "another mp4ds is at work there", "Wait for it, or end it."
                ) from None
            except OSError:
                pass  # a file system without locks: results appear whole all the same
            yield

    def job(self) -> Job | None:
        """The job that was begun here, or None.

        Raises:
            TargetError: It is damaged, or another version's.
        """
        try:
            data = (self.folder / _JOB_NAME).read_bytes()
        except OSError:
            return None
        try:
            job = Job.from_json(data)
        except ValueError as error:
            raise TargetError(self.folder, f"holds an unfinished pack, {error}", _ANEW) from None
        if job.tools != tools():
            theirs = ", ".join(f"{name} {version}" for name, version in job.tools.items())
            raise TargetError(
                self.folder, f"holds a pack begun with other versions: {theirs}", _ANEW
            )
        return job

    def begin(self, job: Job) -> Job:
        """Keep a job, or take over the one that another has kept meanwhile."""
        try:
            write_synced(self.folder / _JOB_NAME, job.to_json(), replace=False)
        except FileExistsError:
            return self.job() or job
        except OSError as error:
            raise as_write_error(error, self.folder / _JOB_NAME) from None
        return job

    def check(self, job: Job, options: dict[str, object], paths: list[str]) -> None:
        """Refuse to go on with a job that is another one.

        Raises:
            OptionError: The options or recordings are others.
            SourceError: The recording has changed.
        """
        if paths != job.paths:
            theirs = ", ".join(str(location(path)) for path in job.paths)
            raise OptionError(f"{self.folder} holds an unfinished pack of {theirs}. {_ANEW}")
        for name, value in options.items():
            if job.options.get(name) != value:
                raise OptionError(
                    f"The pack was begun with another --{name.replace('_', '-')}: "
                    f"{job.options.get(name)!r}, and now it is {value!r}. Give the same to go on. "
                    + _ANEW
                )
        job.check_sources()

    def is_done(self, task: Task) -> bool:
        """Whether the result of a task is there, and whole."""
        return read_record(self.parts / task.name) is not None

    @contextmanager
    def making(self, task: Task) -> Iterator[Path | None]:
        """Make the result of a task.

        Yields:
            The folder to fill, with the record last; None where the result is there already.

        Raises:
            OSError: The disk refused.
        """
        place = self.parts / task.name
        if self.is_done(task):
            yield None
            return
        try:
            folder = Path(tempfile.mkdtemp(prefix=f".{task.name}.", dir=self.parts))
        except OSError as error:
            raise WriteError(place, error) from None
        try:
            yield folder
            sync(folder)
            sync_folder(folder)
            if not self.is_done(task):
                shutil.rmtree(place, ignore_errors=True)  # of one that is not whole
                folder.rename(place)
                sync_folder(self.parts)
        except OSError as error:
            if not self.is_done(task):  # else another was quicker
                raise as_write_error(error, place) from None
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def has_results(self) -> bool:
        """Whether there is anything to go on from."""
        try:
            return any(
                read_record(place) is not None
                for place in self.parts.iterdir()
                if not place.name.startswith((".", "source-"))
            )
        except FileNotFoundError:
            return False
        except OSError:
            return True  # for all one knows

    def sweep(self) -> None:
        """Remove what tasks left that were ended; nobody else may be at work."""
        for place in self.parts.iterdir():
            if place.name.startswith("."):
                shutil.rmtree(place, ignore_errors=True)

    def clear(self) -> None:
        """Forget the job and all results.

        Raises:
            TargetError: They cannot be removed.
        """
        try:
            (self.folder / _JOB_NAME).unlink(missing_ok=True)
            shutil.rmtree(self.parts)
            self.parts.mkdir()
        except OSError as error:
            raise TargetError(
                self.folder, f"cannot be emptied: {error.strerror}", "Remove it yourself."
            ) from None

    def _remove_empty(self) -> None:
        with suppress(OSError):
            self.parts.rmdir()
            self.folder.rmdir()

    def remove(self) -> None:
        """Remove everything."""
        shutil.rmtree(self.folder, ignore_errors=True)
