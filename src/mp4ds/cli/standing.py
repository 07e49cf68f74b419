"""Where a job of one or several packs stands."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from mp4ds.cli.pace import Pace

if TYPE_CHECKING:
    from mp4ds.packing import PackProgress

_RATE_SECONDS, _RATE_STEP, _LEAST_RATE_SECONDS = 30.0, 5.0, 1.0
_JOIN_RATE = 200e6  # bytes a second, until a dataset of the job was joined
_JOIN_MEASURABLE = 1.0


@dataclass
class DatasetStanding:
    """Where one dataset of a job stands.

    Attributes:
        state: What was told last.
        heard: When that was, seconds.
        uncounted: Share of the work that says nothing of this run's pace.
        round: Joins that had been made when `state` was told.
        is_joined: Whether it is finished.
        join: The pace of joining, while it is joined.
        join_began: When that began, seconds.
    """

    state: PackProgress
    heard: float
    uncounted: float
    round: int = 0
    is_joined: bool = False
    join: Pace | None = None
    join_began: float = 0.0
    _samples: deque[tuple[float, PackProgress]] = field(default_factory=deque)

    @property
    def weight(self) -> float:
        """Its part in the work of the job: bytes of its source."""
        return max(1.0, float(self.state.bytes_total))

    @property
    def packed(self) -> float | None:
        """Share of it that is packed; None where nothing tells."""
        state = self.state
        if state.phase == "planning":
            return 0.0
        if state.phase == "joining" or self.is_joined:
            return 1.0
        if state.done is not None:
            return min(1.0, max(0.0, state.done))
        return min(1.0, state.tasks_done / state.tasks_total) if state.tasks_total else None

    @property
    def left(self) -> float:
        """Share of it that is to be packed still; parts that failed are not."""
        state = self.state
        failed = state.failed / state.tasks_total if state.tasks_total else 0.0
        return max(0.0, 1.0 - failed - (self.packed or 0.0))

    @property
    def is_in_work(self) -> bool:
        """Whether it was begun and is not finished."""
        if self.is_joined:
            return False
        state = self.state
        if state.phase != "packing":
            return True
        begun = bool(self.packed) or state.frames > 0 or state.tasks_done > 0
        return begun and self.packed != 1.0

    @property
    def is_finished(self) -> bool:
        """Whether nothing is to be done for it any more, as far as it was told."""
        return self.is_joined or (not self.state.tasks_total and self.packed == 1.0)

    @property
    def phase_share(self) -> float | None:
        """Share of what is being done now; None where nothing tells."""
        if self.state.phase == "packing":
            return self.packed
        done = self.state.done
        # joining that does not tell how far it is keeps the whole share of packing
        return done if done is not None and done < 1 else None

    @property
    def bytes_to_join(self) -> float:
        """Bytes that joining its parts will copy."""
        state = self.state
        if self.is_joined or not state.tasks_done:
            return 0.0
        if state.phase == "joining":
            return float(state.bytes_written)
        return state.bytes_written * state.tasks_total / state.tasks_done

    def take(self, state: PackProgress, now: float, joins: int) -> None:
        """Take what is told.

        Args:
            state: Of this dataset.
            now: Seconds.
            joins: Datasets that were joined so far.
        """
        before = self.state
        packed = self.packed or 0.0
        self.state, self.heard = state, now
        if state.tasks_before != before.tasks_before or joins != self.round:
            self.uncounted += (self.packed or 0.0) - packed
            self._samples.clear()
        self.round = joins
        samples = self._samples
        if not samples or now - samples[-1][0] >= _RATE_STEP:
            samples.append((now, state))
        while len(samples) > 1 and now - samples[1][0] >= _RATE_SECONDS:
            samples.popleft()

    def byte_rate(self, now: float) -> float | None:
        """Bytes read a second over the last 30 s or so; None while that is not known."""
        old = self._sample(now)
        if old is None:
            return None
        return max(0.0, (self.state.bytes_read - old[1].bytes_read) / (now - old[0]))

    def topic_rates(self, now: float) -> Mapping[str, float | None]:
        """Messages a second over the last 30 s or so, by topic; None while that is not known."""
        old = self._sample(now)
        if old is None:
            return dict.fromkeys(self.state.topics)
        time, earlier = old
        return {
            topic: max(0.0, (done - earlier.topics.get(topic, (0, None))[0]) / (now - time))
            for topic, (done, _) in self.state.topics.items()
        }

    def _sample(self, now: float) -> tuple[float, PackProgress] | None:
        known = self.state.phase == "packing" and self._samples
        if not known or now - self._samples[0][0] < _LEAST_RATE_SECONDS:
            return None
        return self._samples[0]


class JobStanding:
    """Where a job of one or several packs stands.

    Time left is that of packing, by `Pace`, and that of joining parts. Work is the share that
    each dataset tells, weighed with the bytes of its source. Only what this run does counts for
    the pace: not the share at a dataset's first report, nor parts that an earlier run did. While
    parts are joined, the clock of packing stands still, and what was packed meanwhile does not
    count. Joining takes its bytes at 200 MB/s, or as fast as the last dataset was joined, unless
    it tells its own share; where it takes longer than that, nothing is told. Parts that failed
    are no work to be done.

    Args:
        whole: Whether this run is to do all that is told of; else, of a share of a job, no time
            left is told.
    """

    def __init__(self, *, whole: bool = True) -> None:
        self._whole = whole
        self._pace = Pace()
        self._datasets: dict[Path, DatasetStanding] = {}
        self._joining: DatasetStanding | None = None
        self._joins = 0
        self._join_rate = _JOIN_RATE
        self._stood = 0.0  # seconds that the clock of packing stood still

    @property
    def datasets(self) -> Iterable[DatasetStanding]:
        """Those that were heard of."""
        return self._datasets.values()

    def dataset(self, path: Path) -> DatasetStanding:
        """One that was heard of."""
        return self._datasets[path]

    @property
    def in_work(self) -> list[DatasetStanding]:
        """Those that were begun and are not finished."""
        return [one for one in self.datasets if one.is_in_work]

    @property
    def joining(self) -> DatasetStanding | None:
        """The dataset whose parts are being joined."""
        return self._joining

    @property
    def share(self) -> float | None:
        """Share of the packing of all datasets that is done, 0 to 1; None where nothing tells."""
        packed = [one.packed for one in self.datasets]
        if not packed or None in packed:
            return None
        done = sum(one.weight * (one.packed or 0.0) for one in self.datasets)
        return done / self._total

    @property
    def _total(self) -> float:
        return sum(one.weight for one in self.datasets)

    def take(self, state: PackProgress, now: float) -> None:
        """Take what is told.

        Args:
            state: Of any dataset.
            now: Seconds of a clock that does not go back.
        """
        one = self._datasets.get(state.dataset)
        if self._joining is not None and (one is not self._joining or state.phase != "joining"):
            self._end_join(self._joining, now)
        if one is None:
            one = DatasetStanding(state, now, 0.0, self._joins)
            one.uncounted = one.packed or 0.0
            self._datasets[state.dataset] = one
        one.take(state, now, self._joins)
        if state.phase == "joining":
            self._join(one, now)
        elif state.phase == "packing":
            self._pace.told(self._counted, self._total, now - self._stood)

    @property
    def _counted(self) -> float:
        return sum(one.weight * ((one.packed or 0.0) - one.uncounted) for one in self.datasets)

    def _join(self, one: DatasetStanding, now: float) -> None:
        if one.join is None:
            one.join, one.join_began = Pace(), now
            self._joining = one
        if (done := one.state.done) is not None:
            one.join.told(done, 1.0, now)

    def _end_join(self, one: DatasetStanding, now: float) -> None:
        seconds = now - one.join_began
        if seconds >= _JOIN_MEASURABLE and one.bytes_to_join:
            self._join_rate = one.bytes_to_join / seconds
        one.is_joined = True
        self._joining = None
        self._joins += 1
        self._stood += seconds

    def seconds_left(self, now: float) -> float | None:
        """Seconds that the job takes still, never negative; None where too little is known."""
        known = self._whole and self.share is not None
        if not known or any(one.state.phase == "planning" for one in self.datasets):
            return None
        packing: float | None = 0.0
        left = sum(one.weight * one.left for one in self.datasets)
        if left > 0:
            stands = now - self._joining.join_began if self._joining else 0.0
            clock = now - self._stood - stands
            packing = self._pace.seconds(self._counted + left, self._total, clock)
        joining: float | None = 0.0
        if self._joining is not None:
            joining = self._join_left(self._joining, now)
        if packing is None or joining is None:
            return None
        later = (one.bytes_to_join for one in self.datasets if one is not self._joining)
        return packing + joining + sum(later) / self._join_rate

    def _join_left(self, one: DatasetStanding, now: float) -> float | None:
        told = one.join.seconds(1.0, 1.0, now) if one.join else None
        if told is not None:
            return told
        left = one.bytes_to_join / self._join_rate - (now - one.join_began)
        return left if left > 0 else None
