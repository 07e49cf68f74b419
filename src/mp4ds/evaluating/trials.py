"""Runs settings on clips, and keeps what was measured, so that nothing is measured twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mp4ds.engine import Outcome
from mp4ds.evaluating.clips import Clip, clip_seconds
from mp4ds.evaluating.engines import Engines
from mp4ds.evaluating.options import Setting
from mp4ds.evaluating.results import Cell
from mp4ds.evaluating.work import REFUSED, Trial, task_bytes
from mp4ds.outputs import is_seen, write_synced
from mp4ds.scoring import ScoringError, Summary

_SHORT = 12  # digits of a digest in a name
_MEASURED = (
    *("encode_seconds", "encode_cpu_seconds", "decode_cpu_seconds"),
    *("size", "frame_bytes"),
)


@dataclass(frozen=True, slots=True)
class Failure:
    """A setting that could not be tried.

    Attributes:
        setting: Which.
        sentence: Why.
    """

    setting: Setting | None
    sentence: str


Found = dict[str, Any] | Failure
"""What was measured with a setting, or why nothing was."""


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
        engines: Run them.
        versions: Of what makes videos and scores: with others, all is measured anew.
        threads: Of an encoder.
    """

    def __init__(
        self,
        folder: Path,
        work: Path,
        engines: Engines,
        *,
        versions: dict[str, str],
        threads: int,
    ) -> None:
        self._folder = folder
        self._work = work
        self._engines = engines
        self._versions = versions
        self._threads = threads
        self.tried = 0
        self.known = 0

    def run(
        self,
        place: ClipPlace,
        settings: Sequence[Setting | None],
        on_done: Callable[[int], None] = lambda _: None,
    ) -> dict[Setting | None, Found]:
        """Try settings on a clip, but for those whose results are there.

        Args:
            place: The clip.
            settings: Each once; None scores the clip as it is.
            on_done: Called with the number of settings that are done, None left out.

        Returns:
            What was measured by setting, or why nothing was.

        Raises:
            ScoringError: The clip as it is could not be scored, so that the others are of no use.
            ClusterError: The cluster does not answer, or was lost.
        """
        found: dict[Setting | None, Found] = {}
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
        on_done(len(found.keys() - {None}))
        engine = self._engines.engine(task_bytes(place.clip, settings, self._threads))
        with closing(engine.run(list(tasks), lambda *_: None)) as outcomes:
            for outcome in outcomes:
                setting = tasks[outcome.task]
                found[setting] = self._found(place, setting, outcome)
                on_done(len(found.keys() - {None}))
        return found

    def _found(self, place: ClipPlace, setting: Setting | None, outcome: Outcome) -> Found:
        """What became of a trial.

        Raises:
            ScoringError: It failed, and without it the others are of no use.
        """
        sentence = outcome.error[1] if outcome.error else ""
        if not sentence and not self._is_seen(place, setting):
            folder = self._folder / "cells"
            sentence = f"its result is not seen in {folder}; all machines must share this folder."
        result = None if sentence else self._read(place, setting)
        if result is not None:
            self.tried += 1
            return result
        if setting is None:
            raise ScoringError(sentence)
        return Failure(setting, sentence)

    def _is_seen(self, place: ClipPlace, setting: Setting | None) -> bool:
        folders = self._folder / "cells", self._folder / "pictures"
        return is_seen(lambda: self._read(place, setting) is not None, *folders)

    def _trial(self, place: ClipPlace, setting: Setting | None) -> Trial:
        return Trial(
            clip=str(place.path),
            result=str(self._result(place, setting)),
            picture=str(self._folder / self.picture(place, setting)),
            setting=setting,
            threads=self._threads,
            versions=self._versions,
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

    def _read(self, place: ClipPlace, setting: Setting | None) -> Found | None:
        """What was measured before, if that is whole."""
        try:
            values = json.loads(self._result(place, setting).read_bytes())
            if REFUSED in values:
                return Failure(setting, str(values[REFUSED]))
            scores = {name: Summary(**score) for name, score in values["scores"].items()}
            figures = [values[name] for name in _MEASURED] if setting else []  # else not encoded
            figures += [figure for score in scores.values() for figure in asdict(score).values()]
            if not all(isinstance(figure, (int, float)) for figure in figures):
                return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None
        if not (self._folder / self.picture(place, setting)).is_file():
            return None
        return {**values, "scores": scores}

    def cells(
        self, place: ClipPlace, measured: dict[Setting | None, Found]
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
            machine=str(values.get("machine", "")),
        )
