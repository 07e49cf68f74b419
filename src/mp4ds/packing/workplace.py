"""The folder in which a divided pack is made: its job, and the results of its tasks.

It is next to the dataset, on the same file system, under a name derived from the dataset's, so that
the same command finds it again. A task's result appears in it by one rename, when complete.

Somebody else may have put a folder there: in a shared folder, or in an unpacked archive. So nothing
is read from it, written to it or removed from it unless all of it belongs to this user and has
expected names, without any links; a job records the inode of its folder, so that a copy is not
mistaken for the original; and encoder settings are derived again (`video.codecs.remade`). Other
processes of the same user are trusted, and, where machines share the folder and see other inodes
(--shard, --join, --cluster), so is whatever that user has put there.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from mp4ds.errors import OptionError, TargetError, WriteError, counted
from mp4ds.files.outputs import as_write_error, is_mine, lock, sync, sync_folder, write_synced
from mp4ds.files.urls import location
from mp4ds.packing.job import TASK_NAME, Job, Task, tools
from mp4ds.packing.manifest import read_record

_SUFFIX = ".mp4ds-part"
_JOB_NAME = "job.json"
_ANEW = "Start over with `restart`."
_FULL = (errno.ENOSPC, errno.EDQUOT)
_NAMED = 3
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)

_BEGUN = re.compile(rf"\.({TASK_NAME})\.[a-z0-9_]{{8}}")  # a result in progress
_NAMES = re.compile(  # from the folder on; of folders, with a slash at the end
    r"lock|job\.json|\.job\.json\.[^/]+\.part|parts/|(dataset|replaced)/(.*/)?[^/]*"
    rf"|parts/({TASK_NAME}|{_BEGUN.pattern})/(.*/)?[^/]*",
    re.DOTALL,
)


class Workplace:
    """See the module.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.parts = folder / "parts"
        self.joined = folder / "dataset"
        self.replaced = folder / "replaced" / folder.name[1 : -len(_SUFFIX)]

    @classmethod
    def beside(cls, target: Path) -> Workplace:
        """The work folder of a dataset, whether it exists or not."""
        return cls(target.parent / f".{target.name}{_SUFFIX}")

    @contextmanager
    def claimed(self, *, shared: bool) -> Iterator[None]:
        """Lock the folder while working in it.

        Args:
            shared: Others may work on other tasks at the same time.

        Raises:
            TargetError: Another pack is working there, the folder cannot be created, or holds
                unexpected entries.
            WriteError: The disk is full.
        """
        try:
            self.folder.mkdir(mode=0o700, exist_ok=True)
            self._check_folders()
            self.parts.mkdir(exist_ok=True)
            self._check_folders()
            handle = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT | _NO_LINK, 0o600)
        except OSError as error:
            if isinstance(error, TargetError):
                raise
            if error.errno in _FULL:
                self._remove_empty()
                raise WriteError(self.folder, error) from None
            raise TargetError(
                self.folder, f"cannot be created: {error.strerror}", "Choose another folder."
            ) from None
        with os.fdopen(handle, "r+b") as file:
            try:
                lock(file, shared=shared)  # even without locks, results appear complete
            except BlockingIOError:
                raise TargetError(
                    self.folder, "another mp4ds is working there", "Wait for it, or stop it."
                ) from None
            self._check()
            self._give_back()
            yield

    def _check_folders(self) -> None:
        """Refuse a folder that somebody else has put there.

        Raises:
            TargetError: It is another user's, or a link.
        """
        for path in (self.folder, self.parts):
            with suppress(FileNotFoundError):
                found = path.lstat()
                if not stat.S_ISDIR(found.st_mode):
                    raise TargetError(
                        path,
                        "is not a folder, or is a symbolic link",
                        "Remove it; mp4ds creates its own.",
                    )
                if not is_mine(found, self.folder.parent):
                    raise TargetError(path, "belongs to another user", "Choose another folder.")

    def _check(self) -> None:
        """Refuse what is not made here.

        Raises:
            TargetError: Names some of it.
        """
        owner = self.folder.lstat().st_uid
        strange: list[str] = []
        waiting = [(self.folder, "")]
        while waiting:
            place, prefix = waiting.pop()
            with suppress(FileNotFoundError), os.scandir(place) as entries:
                for entry in entries:
                    with suppress(FileNotFoundError):  # others finish tasks meanwhile
                        found = entry.stat(follow_symlinks=False)
                        is_folder = stat.S_ISDIR(found.st_mode)
                        name = prefix + entry.name + "/" * is_folder
                        is_plain = is_folder or stat.S_ISREG(found.st_mode)
                        if not (is_plain and found.st_uid == owner and _NAMES.fullmatch(name)):
                            strange.append(name)
                        elif is_folder:
                            waiting.append((Path(entry.path), name))
        if strange:
            listed = ", ".join(sorted(strange)[:_NAMED]) + ", ..." * (len(strange) > _NAMED)
            raise TargetError(
                self.folder,
                f"holds {counted(len(strange), 'item')} that mp4ds did not make: {listed}",
                "Check what they are; if you remove the folder, packing starts over.",
            )

    def _give_back(self) -> None:
        """Give a dataset its name again whose replacement was killed between two renames."""
        target = self.folder.parent / self.replaced.name
        if self.replaced.exists() and not os.path.lexists(target):
            self.replaced.rename(target)

    def job(self, *, shared: bool) -> Job | None:
        """The job that was begun here, or None.

        Args:
            shared: It may have been begun by another machine.

        Raises:
            TargetError: It is damaged, another version's, or of another folder.
        """
        self._check_folders()
        path = self.folder / _JOB_NAME
        try:
            if not stat.S_ISREG(path.lstat().st_mode):
                raise TargetError(path, "is not a file, or is a symbolic link", "Remove it.")
            data = path.read_bytes()
        except OSError as error:
            if isinstance(error, TargetError):
                raise
            return None
        try:
            job = Job.from_json(data)
        except ValueError as error:
            raise TargetError(self.folder, f"holds an unfinished pack, {error}", _ANEW) from None
        if not shared and job.place != self.folder.lstat().st_ino:
            raise TargetError(
                self.folder, "holds an unfinished pack that was started elsewhere", _ANEW
            )
        if job.tools != tools():
            theirs = ", ".join(f"{name} {version}" for name, version in job.tools.items())
            raise TargetError(
                self.folder, f"holds a pack started with other versions: {theirs}", _ANEW
            )
        return job

    def begin(self, job: Job) -> Job:
        """Keep a job, or take over the one that another has kept meanwhile."""
        job = replace(job, place=self.folder.lstat().st_ino)
        try:
            write_synced(self.folder / _JOB_NAME, job.to_json(), replace=False)
        except FileExistsError:
            return self.job(shared=True) or job
        except OSError as error:
            raise as_write_error(error, self.folder / _JOB_NAME) from None
        return job

    def check(self, job: Job, options: dict[str, object], paths: list[str]) -> None:
        """Refuse to continue with a job that is another one.

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
                    f"The pack was started with a different `{name}`: {job.options.get(name)!r}, "
                    f"and now it is {value!r}. Give the same value to resume. " + _ANEW
                )
        job.check_sources()

    def is_done(self, task: Task) -> bool:
        """Whether the result of a task is there, and whole."""
        return read_record(self.parts / task.name) is not None

    @contextmanager
    def making(self, task: Task) -> Iterator[Path | None]:
        """Make the result of a task.

        Yields:
            The folder to fill, with the record last; None if the result is there already.

        Raises:
            OSError: It cannot be written.
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
        """Whether there is anything to continue from."""
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
            if _BEGUN.fullmatch(place.name):
                shutil.rmtree(place, ignore_errors=True)
        for path in self.folder.glob(f".{_JOB_NAME}.*.part"):
            path.unlink(missing_ok=True)

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
        """Remove everything that is made here."""
        for place in (self.parts, self.joined, self.replaced.parent):
            shutil.rmtree(place, ignore_errors=True)
        with suppress(OSError):
            for name in (_JOB_NAME, "lock"):
                (self.folder / name).unlink(missing_ok=True)
            self.folder.rmdir()
