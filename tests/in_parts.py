"""Recordings packed in parts, within the tests' own process, and what to compare of them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import pytest

import mp4ds
from mp4ds.errors import Mp4dsError
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest, load_stream
from mp4ds.packing.options import PackOptions
from mp4ds.packing.parts import PartPacker
from sources import SOURCES, scene

WORK = ".dataset.mp4ds-part"
IN_PARTS = PackOptions(window=3, codec="h264")

_ExecutorT = TypeVar("_ExecutorT", bound=Executor)


class InlineExecutor(Executor):
    """Makes calls at once, in this thread.

    Args:
        fails: Whether a piece is to fail, by its name.

    Attributes:
        ran: Names of the pieces that were packed.
        keep_going: Whether calls after one that failed are made.
    """

    def __init__(self, fails: Callable[[str], bool] = lambda _: False) -> None:
        self.ran: list[str] = []
        self.keep_going = False
        self._fails = fails
        self._has_failed = False

    def __enter__(self) -> InlineExecutor:
        self._has_failed = False
        return self

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if self._has_failed and not self.keep_going:
            return future  # nobody waits for it
        try:
            if isinstance(fn, PartPacker):
                (name,) = (piece.name for piece in args)
                if self._fails(name):
                    raise Mp4dsError("the disk is full")
                self.ran.append(name)
            future.set_result(fn(*args, **kwargs))
        except (Mp4dsError, OSError) as error:
            self._has_failed = True
            future.set_exception(error)
        return future


def use(monkeypatch: pytest.MonkeyPatch, executor: _ExecutorT) -> _ExecutorT:
    """Have pieces packed by an executor."""

    def chosen(_: object, options: PackOptions) -> Executor:
        if isinstance(executor, InlineExecutor):
            executor.keep_going = options.keep_going
        return executor

    monkeypatch.setattr("mp4ds.packing.pack._executor", chosen)
    return executor


def facts(dataset: Path) -> dict[str, Any]:
    """All that two packs of the same images have in common, however they were divided."""
    manifest = load_manifest(dataset / MANIFEST_NAME)
    found: dict[str, Any] = manifest.model_dump(exclude={"files", "streams", "tools"})
    found["streams"] = {}
    for entry in manifest.streams:
        sidecar = load_stream(dataset / entry.sidecar)
        values = sidecar.model_dump()
        for video in filter(None, (values["video"], values["view"])):
            del video["size"], video["sha256"]
        if values["view"]:  # which has a key frame where a part begins
            del values["view"]["references"]
        found["streams"][entry.sidecar] = values
    return found


def leftovers(folder: Path) -> list[str]:
    """Names of what no finished pack leaves beside its dataset."""
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


class Pack:
    """A pack in parts of three frames that meets hard times, and is then to end well.

    Args:
        folder: Where all of it is.
        kind: Of the recording.
        patch: Undoes what is changed for it.
        frames: Of its camera.
    """

    def __init__(self, folder: Path, kind: str, patch: pytest.MonkeyPatch, frames: int = 6) -> None:
        (self.source,) = SOURCES[kind](folder / "source", scene("mono8", frames=frames))
        self.target = folder / "dataset"
        self._folder, self._patch = folder, patch

    @cached_property
    def expected(self) -> dict[str, Any]:
        """What an undisturbed pack in one pass makes."""
        mp4ds.pack(self.source, self._folder / "undisturbed", PackOptions(codec="h264"))
        return facts(self._folder / "undisturbed")

    def run(
        self,
        executor: Executor | None = None,
        progress: Callable[[mp4ds.PackProgress], None] | None = None,
        **options: Any,
    ) -> list[str]:
        """The command; returns the tasks that it ran."""
        inline = InlineExecutor()
        use(self._patch, executor or inline)
        mp4ds.pack(self.source, self.target, replace(IN_PARTS, **options), progress=progress)
        return inline.ran

    def refused(self, words: str | None, *given: Any, **options: Any) -> Mp4dsError:
        """The error of the command, which leaves nothing under the dataset's name."""
        with pytest.raises(Mp4dsError, match=words) as caught:
            self.run(*given, **options)
        assert not self.target.exists()
        return caught.value

    def goes_on(self) -> list[str]:
        """The same command ends well; returns the tasks that it ran."""
        ran = self.run()
        assert facts(self.target) == self.expected
        assert mp4ds.validate(self.target, deep=True) == []
        assert leftovers(self.target.parent) == []
        return ran
