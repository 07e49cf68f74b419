"""Runs settings on clips, and keeps what was measured, so that nothing is measured twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mp4ds.engine import ProcessEngine
from mp4ds.evaluating.clips import Clip, clip_seconds
from mp4ds.evaluating.options import Setting
from mp4ds.evaluating.results import Cell
from mp4ds.evaluating.work import Trial, command
from mp4ds.outputs import write_synced
from mp4ds.scoring import Ffmpeg, Summary

_SHORT = 12  # digits of a digest in a name


@dataclass(frozen=True, slots=True)
class Failure:
    """A setting that could not be tried.

    Attributes:
        setting: Which.
        sentence: Why.
    """

    setting: Setting | None
    sentence: str


@dataclass(frozen=True)
class ClipPlace:
    """A clip and where its frames are.

    Attributes:
        clip: What is known of it.
        path: Its file.
        name: Of its camera, for names of files.
    """

    clip: Clip
    path: Path
    name: str


class Trials:
    """The trials of one evaluation.

    Args:
        folder: Where results are kept; in ``cells`` and ``pictures``.
        work: Where files are that are not kept.
        ffmpeg: What computes VMAF, or None.
        versions: Of what makes videos and scores: with others, all is measured anew.
        threads: Of an encoder.
        jobs: Processes at a time.
    """

    def __init__(
        self,
        folder: Path,
        work: Path,
        *,
        ffmpeg: Ffmpeg | None,
        versions: dict[str, str],
        threads: int,
        jobs: int,
    ) -> None:
        self._folder = folder
        self._work = work
        self._ffmpeg = ffmpeg
        self._versions = versions
        self._threads = threads
        self._engine = ProcessEngine(command, jobs)
        self.tried = 0
        self.known = 0

    def run(
        self,
        place: ClipPlace,
        settings: Sequence[Setting | None],
        on_done: Callable[[int], None] = lambda _: None,
    ) -> dict[Setting | None, dict[str, Any] | Failure]:
        """Try settings on a clip, but for those whose results are there.

        Args:
            place: The clip.
            settings: Each once; None scores the clip as it is.
            on_done: Called with the number of those that are done.

        Returns:
            What was measured by setting, or why nothing was.
        """
        found: dict[Setting | None, dict[str, Any] | Failure] = {}
        tasks: dict[tuple[str, ...], Setting | None] = {}
        for setting in settings:
            known = self._read(place, setting)
            if known is not None:
                found[setting] = known
                continue
            job = self._work / f"{self._name(place, setting)}.job"
            write_synced(job, self._trial(place, setting).to_json())
            tasks[(str(job),)] = setting
        self.known += len(found)
        on_done(len(found))
        for outcome in self._engine.run(list(tasks), lambda *_: None):
            setting = tasks[outcome.task]
            result = self._read(place, setting)
            if outcome.error is None and result is not None:
                found[setting] = result
                self.tried += 1
            else:
                sentence = outcome.error[1] if outcome.error else "it left no result"
                found[setting] = Failure(setting, sentence)
            on_done(len(found))
        return found

    def _trial(self, place: ClipPlace, setting: Setting | None) -> Trial:
        return Trial(
            clip=str(place.path),
            result=str(self._result(place, setting)),
            picture=str(self._folder / self.picture(place, setting)),
            setting=setting,
            threads=self._threads,
            ffmpeg=self._ffmpeg.path if self._ffmpeg else None,
        )

    def _name(self, place: ClipPlace, setting: Setting | None) -> str:
        key = {
            "clip": place.clip.digest,
            "format": place.clip.picture_format,
            "rate": place.clip.rate,
            "setting": asdict(setting) if setting else None,
            "threads": self._threads,
            "versions": self._versions,
        }
        digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:_SHORT]
        what = setting.name.replace(" ", "-") if setting else "original"
        return f"{place.name}-{what}-{digest}"

    def _result(self, place: ClipPlace, setting: Setting | None) -> Path:
        return self._folder / "cells" / f"{self._name(place, setting)}.json"

    def picture(self, place: ClipPlace, setting: Setting | None) -> str:
        """Name of a PNG file of a clip's detail, in the folder."""
        return f"pictures/{self._name(place, setting)}.png"

    def _read(self, place: ClipPlace, setting: Setting | None) -> dict[str, Any] | None:
        """What was measured before, if that is whole."""
        try:
            values = json.loads(self._result(place, setting).read_bytes())
            scores = {name: Summary(**score) for name, score in values["scores"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None
        if not (self._folder / self.picture(place, setting)).is_file():
            return None
        return {**values, "scores": scores}

    def cells(
        self, place: ClipPlace, measured: dict[Setting | None, dict[str, Any] | Failure]
    ) -> Iterator[Cell | Failure]:
        """What was measured, made into figures."""
        for setting, values in measured.items():
            if isinstance(values, Failure):
                yield values
            elif setting is not None:
                yield self._cell(place, setting, values)

    def _cell(self, place: ClipPlace, setting: Setting, values: dict[str, Any]) -> Cell:
        clip = place.clip
        seconds, frame_bytes = values["encode_seconds"], values["frame_bytes"]
        rate = clip.frames / clip_seconds(clip)
        return Cell(
            setting=setting,
            encode_seconds=seconds,
            encode_cpu_seconds=values["encode_cpu_seconds"],
            decode_fps=clip.frames / max(1e-9, values["decode_cpu_seconds"]),
            size=values["size"],
            frame_bytes=frame_bytes,
            kbps=frame_bytes * rate * 8 / 1000,
            encode_fps=clip.frames / max(1e-9, seconds),
            scores=values["scores"],
            picture=self.picture(place, setting),
            whole_bytes=frame_bytes * clip.source_frames,
            whole_seconds=seconds / clip.frames * clip.source_frames,
        )
