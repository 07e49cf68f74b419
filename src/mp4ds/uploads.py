"""Outputs for URLs: made in a folder of this machine, then uploaded file by file.

The file by which an output is recognised comes last, so that what is there without it is visibly
not whole. Where an upload fails, what was made is kept, and the same command uploads the rest.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from mp4ds.errors import Mp4dsError, RemoteError, TargetError, TargetExistsError
from mp4ds.outputs import write_synced
from mp4ds.owned import Owned, refuse_not_ours, refuse_strangers
from mp4ds.remote import RemotePath
from mp4ds.system import lock

Report = Callable[[str, int, int], None]
"""Called with the file that is being uploaded, bytes uploaded, and bytes in all."""

_STATE, _LOCK = "upload.json", "lock"
_SAVE_SECONDS = 2.0
_MARK = ".mp4ds-upload"
_MARK_TEXT = "mp4ds is making what is to be here, or was interrupted"


class Upload:
    """One output for a URL.

    Args:
        target: Where it goes.
        is_folder: Whether it is a folder.
        last: Of a folder, the file in it that is uploaded last; without it, it is not whole.

    Attributes:
        folder: Where it is made: in the system's temporary folder (``TMPDIR``), of a name that the
            target's tells.
        local: What is made there.

    Raises:
        TargetError: Nothing can be uploaded there, or no folder made here.
    """

    def __init__(self, target: RemotePath, *, is_folder: bool = True, last: str = "") -> None:
        self._shown = cast(Path, target)
        if not target.is_writable:
            problem = "is on a web server, which takes no uploads"
            raise TargetError(self._shown, problem, "Name a place in a store, such as s3://.")
        if target.parent == target:
            raise TargetError(self._shown, "is a whole bucket", "Name a folder in it.")
        self._target = target
        self._is_folder = is_folder
        self._last = last
        self._old: set[str] = set()  # names of what is to be replaced
        self._was_begun = False
        self._mark = target / _MARK if is_folder else target.with_name(f"{target.name}{_MARK}")
        digest = hashlib.sha256(str(target).encode()).hexdigest()
        self.folder = _own_folder() / f"{target.name[:60]}-{digest[:16]}"
        self.local = self.folder / target.name

    @contextmanager
    def _claimed(self) -> Iterator[None]:
        """Hold the folder while working in it; what is of no use to a later run is removed.

        Raises:
            TargetError: Another run is at work there.
        """
        self.folder.mkdir(exist_ok=True)
        with (self.folder / _LOCK).open("w") as file:
            try:
                lock(file)
            except BlockingIOError:
                raise TargetError(
                    self._shown, "another mp4ds is making it here", "Wait for it, or end it."
                ) from None
            try:
                yield
            finally:
                if {path.name for path in self.folder.glob("*")} <= {_LOCK}:
                    shutil.rmtree(self.folder, ignore_errors=True)

    def _check(self, *, force: bool, owned: Owned) -> None:
        """Refuse a target early, before any work is done; see `outputs.check_target`.

        Leaves a mark there, which shows that it can be written to.

        Raises:
            TargetExistsError: Something is there and ``force`` is not set.
            TargetError: It may not be written or replaced.
            RemoteError: The store does not answer.
        """
        now = self._now()
        self._old = set()
        if now.exists():
            if self._is_unfinished(now):
                self._was_begun = True
                names: Iterable[str] | None = self._marked().union(self._state().get("files", ()))
            elif force:
                names = owned(cast(Path, now))
            else:
                raise TargetExistsError(self._shown)
            self._old = refuse_not_ours(self._shown, names)
            if self._is_folder:
                refuse_strangers(self._shown, self._there() - self._old)
        self._leave_mark(self._old)

    def _there(self) -> set[str]:
        """Names of all files that are there, but for the mark."""
        begin = len(self._target.url) + 1
        return {path.url[begin:] for path in self._now().files() if path != self._mark}

    def _leave_mark(self, names: Iterable[str]) -> None:
        """Tell there what is being made, and which files of it may be replaced."""
        with tempfile.NamedTemporaryFile(dir=self.folder) as file:
            file.write(json.dumps({"about": _MARK_TEXT, "files": sorted(names)}).encode())
            file.flush()
            self._mark.upload(Path(file.name))

    def _marked(self) -> set[str]:
        """The names that the mark of an upload tells, which was not finished."""
        try:
            return set(map(str, json.loads(RemotePath(self._mark.url).read_bytes())["files"]))
        except (OSError, ValueError, LookupError, TypeError):
            return set()

    def _now(self) -> RemotePath:
        """The target as it is now."""
        return RemotePath(self._target.url)

    def _is_unfinished(self, now: RemotePath) -> bool:
        """Whether what is there is an upload that was not finished."""
        if not self._is_folder or (self._last and (now / self._last).exists()):
            return False
        return bool(self._state().get("begun")) or RemotePath(self._mark.url).exists()

    def _leave(self) -> None:
        """Take the mark away again, where nothing was uploaded."""
        if not self._was_begun and not self._state().get("begun"):
            with suppress(Mp4dsError):
                self._mark.remove()

    def run(
        self,
        order: Callable[[], Mapping[str, Any]],
        make: Callable[[Path], Mapping[str, Any]],
        *,
        force: bool,
        owned: Owned,
        report: Report | None = None,
    ) -> Mapping[str, Any]:
        """Make the output here, unless an earlier run did, and upload it.

        Args:
            order: Tells what is asked for, as JSON has it: of the same, what was made is the same.
            make: Makes the output at a path, and returns what there is to tell of it.
            force: Replace what is there.
            owned: Tells which files of it mp4ds wrote.
            report: Told of the upload.

        Returns:
            What `make` returned, now or earlier.

        Raises:
            TargetError: The target may not be written or replaced.
            RemoteError: It could not be uploaded; what was made is kept here.
        """
        with self._claimed():
            self._check(force=force, owned=owned)
            try:
                asked = order()
                kept = self._kept(asked)
                told = kept if kept is not None else self._make(make, asked)
                self._send(report)
            except BaseException:
                self._leave()
                raise
        return told

    def _make(
        self, make: Callable[[Path], Mapping[str, Any]], asked: Mapping[str, Any]
    ) -> Mapping[str, Any]:
        if self.local.is_dir():
            shutil.rmtree(self.local)  # what an earlier run made of something else
        self.local.unlink(missing_ok=True)
        told = make(self.local)
        self._keep(asked, told)
        return told

    # ---------------------------------------------------------------- what was made

    def _state(self) -> dict[str, Any]:
        try:
            state: dict[str, Any] = json.loads((self.folder / _STATE).read_bytes())
        except (OSError, ValueError):
            return {}
        return state

    def _save(self, state: Mapping[str, Any]) -> None:
        write_synced(self.folder / _STATE, json.dumps(state).encode())

    def _kept(self, order: Mapping[str, Any]) -> dict[str, Any] | None:
        """What `_keep` was told of an earlier run's output, if that is here, whole.

        Args:
            order: What was asked for; of another one, nothing is kept.
        """
        state = self._state()
        if state.get("order") != json.loads(json.dumps(order)):
            return None
        if state.get("files") != self._files():
            return None
        summary: dict[str, Any] = state["summary"]
        return summary

    def _keep(self, order: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Note that `local` is whole.

        Args:
            order: What it was made of, and how; as JSON has it.
            summary: What to tell of it.
        """
        made = {"order": order, "summary": summary, "files": self._files()}
        self._save({**made, "sent": {}, "begun": self._state().get("begun", False)})

    def _files(self) -> dict[str, int]:
        """Sizes of the files to upload, by their names in `local`; the last one last."""
        if self.local.is_file():
            return {"": self.local.stat().st_size}
        files = {
            path.relative_to(self.local).as_posix(): path.stat().st_size
            for path in sorted(self.local.rglob("*"))
            if path.is_file()
        }
        if self._last in files:
            files[self._last] = files.pop(self._last)
        return files

    # ---------------------------------------------------------------- uploading

    def _send(self, report: Report | None = None) -> None:
        """Upload what was kept, in the place of what is there; then it is no longer kept here.

        Raises:
            TargetError: The store refuses.
            RemoteError: It does not answer, or the network failed.
        """
        state = {**self._state(), "begun": True}
        self._save(state)
        kept = f"What was made is kept in {self.folder}: run the same command again to go on."
        try:
            self._send_files(state, report)
        except (TargetError, RemoteError) as error:
            raise type(error)(self._shown, str(error).rstrip("."), kept) from None
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"interrupted while uploading. {kept}") from None
        with suppress(Mp4dsError):
            self._mark.remove()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _send_files(self, state: dict[str, Any], report: Report | None) -> None:
        files, sent = self._files(), state["sent"]
        if self._is_folder:
            self._leave_mark({*files, *self._old})
        total, done, saved = sum(files.values()), 0, time.monotonic()
        sent = {name: tag for name, tag in sent.items() if self._is_sent(name, files[name], tag)}
        self._clear({self._place(name) for name in sent})
        try:
            for name, size in files.items():
                if report:
                    report(name or self._target.name, done, total)
                if name not in sent:
                    local = self.local / name if name else self.local
                    sent[name] = self._place(name).upload(local).tag
                done += size
                if time.monotonic() > saved + _SAVE_SECONDS:
                    saved = time.monotonic()
                    self._save({**state, "sent": sent})
        except BaseException:
            self._save({**state, "sent": sent})
            raise

    def _place(self, name: str) -> RemotePath:
        return self._target / name if name else self._target

    def _is_sent(self, name: str, size: int, tag: str) -> bool:
        """Whether a file is there as it was uploaded."""
        there = RemotePath(self._place(name).url)
        return there.is_file() and there.stat().st_size == size and there.tag == tag

    def _clear(self, kept: set[RemotePath]) -> None:
        """Remove what is to be replaced, first that by which it is recognised."""
        if not self._is_folder:
            return
        old = {self._target / name for name in self._there() & self._old} - kept
        for path in sorted(old, key=lambda path: path != self._target / self._last):
            path.remove()


def _own_folder() -> Path:
    """The user's own folder in the system's temporary one, where nobody else can meddle."""
    folder = Path(tempfile.gettempdir()) / f"mp4ds-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        stat = folder.lstat()
    except OSError as error:
        raise TargetError(
            folder, f"cannot be made: {error.strerror}", "Name another folder by TMPDIR."
        ) from None
    if not folder.is_dir() or folder.is_symlink() or stat.st_uid != os.getuid():
        raise TargetError(folder, "belongs to somebody else", "Name another folder by TMPDIR.")
    return folder
